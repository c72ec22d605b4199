"""Make self-contained pages of one style: no script, no address of another file, pictures inside, light and dark."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import (
    GOOD,
    MASK,
    Scale,
    UInt8,
    mask_classes,
    mask_colours,
    paint_normals,
    palette,
)
from tofcapture.errors import ConfigError
from tofcapture.files.png import png_bytes
from tofcapture.files.seal import write_text

_NORMAL_STEP = 4  # colours of normals in steps of 4 of 256: a degree or two, and half the bytes


@dataclass(frozen=True)
class Picture:
    """One picture of a page: its caption, words below it and for those who cannot see it, its ``data:`` address, pixels."""

    title: str
    note: str
    alt: str
    uri: str
    width: int
    height: int


def picture(title: str, image: UInt8, alt: str, note: str = "", colours: UInt8 | None = None) -> Picture:
    """Make a picture of colours (H, W, 3), or of indices (H, W) into ``colours`` (256, 3)."""
    uri = _data_uri(png_bytes(image, colours=colours, level=9))
    return Picture(title, note, alt, uri, image.shape[1], image.shape[0])


def map_picture(title: str, values: NDArray[Any], scale: Scale, alt: str, note: str = "") -> Picture:
    """Make a picture of a map (H, W) in the unit of its scale; NaN: none."""
    return picture(title, scale.indices(values), alt, note, palette(scale.colours))


def normal_picture(title: str, normals: NDArray[Any], alt: str, note: str = "") -> Picture:
    """Make a picture of camera-facing unit normals (H, W, 3)."""
    coarse = paint_normals(normals) // _NORMAL_STEP * _NORMAL_STEP
    return picture(title, coarse, alt, note)


def mask_picture(
    title: str, mask: NDArray[np.uint8], alt: str, note: str = "", window: tuple[slice, slice] | None = None
) -> Picture:
    """Make a picture of the bits of ground truth (H, W); the rim of a window is drawn white."""
    classes = mask_classes(mask)
    if window is not None:
        rim = np.zeros(mask.shape, bool)
        rim[window] = True
        rows, columns = window
        rim[rows.start + 2 : rows.stop - 2, columns.start + 2 : columns.stop - 2] = False
        classes[rim] = 255
    return picture(title, classes, alt, note, mask_colours())


def mask_legend(mask: NDArray[np.uint8]) -> list[tuple[str, str, str]]:
    """(CSS colour, words, share of the pixels) of every colour of a mask."""
    shares = np.bincount(mask_classes(mask).ravel(), minlength=1 + len(MASK)) / max(mask.size, 1)
    named = [(0, *GOOD), *((int(bit), *meaning) for bit, meaning in MASK.items())]
    return [
        (f"rgb{colour}", f"{bit}: {words}", f"{100 * share:.1f}\N{NO-BREAK SPACE}%")
        for (bit, colour, words), share in zip(named, shares, strict=True)
    ]


def write_page(template: Path, out: Path, content: Mapping[str, Any]) -> Path:
    """Write a page whose template extends ``base.html.j2``; everything but SVG is escaped. Same content, same bytes.

    Raises
    ------
    ConfigError
        jinja2 is missing.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as err:
        raise ConfigError(f"a page needs jinja2: {err}", hint="pip install 'tofcapture[report]'") from err
    environment = Environment(
        loader=FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["bar_of"] = _bar
    write_text(Path(out), environment.get_template(template.name).render(**content) + "\n")
    return Path(out)


def _bar(scale: Scale) -> str:
    """Data URI of a scale's colours, a strip one pixel high."""
    return _data_uri(png_bytes(np.arange(255, dtype=np.uint8)[None], colours=palette(scale.colours)))


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")
