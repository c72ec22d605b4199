"""Make self-contained pages of one style: no script, no address of another file, pictures inside, light and dark.

Charts are drawn with matplotlib, the same each run, as SVG that takes the page's colours.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.colours import (
    GOOD,
    GREY,
    GROUND_TRUTH,
    MASK,
    SENSOR,
    Scale,
    UInt8,
    mask_classes,
    mask_colours,
    paint_normals,
    palette,
    png_bytes,
)
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing, write_text
from tofcapture.poses import Float64, invert, transform_points
from tofcapture.rig import Rig

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

    Raises :class:`ConfigError`: jinja2 is missing.
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


DPI = 100
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "svg": {"Date": None, "Creator": None, "Format": None, "Type": None},
}
"""What matplotlib would write of the day and of itself, by format."""

LINES = ("#2b85c2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
TOF, STEREO, FLANGE = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (SENSOR, GROUND_TRUTH, GREY))
_INK = "#010203"  # becomes the page's own text colour
_DOTS = 700  # of a scatter plot; medians use every point
_SIZE = (5.6, 2.5)  # inches
_FRUSTUM = 0.08  # m, length of a camera's drawing


@contextmanager
def canvas(ink: str = "black") -> Iterator[Any]:
    """Give an empty figure; nobody's matplotlibrc and no random mark of an SVG change its bytes.

    Raises :class:`ConfigError`: matplotlib is missing.
    """
    try:
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as err:
        raise ConfigError(f"drawing needs matplotlib: {err}", hint="pip install 'tofcapture[view]'") from err
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams |= {"svg.hashsalt": "tofcapture", "svg.fonttype": "none", "font.size": 9}
        mpl.rcParams |= dict.fromkeys(
            ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), ink
        )
        figure = Figure(dpi=DPI, layout=None, facecolor="white")
        FigureCanvasAgg(figure)
        yield figure


def save(figure: Any, path: Path, form: str) -> None:
    """Write a figure as ``png``, ``pdf`` or ``svg``; the file is replaced when it exists."""
    packed = {"pil_kwargs": {"compress_level": 9}} if form == "png" else {}
    with replacing(path) as partial:
        figure.savefig(partial, dpi=DPI, format=form, metadata=METADATA[form], **packed)


def chart(
    draw: Callable[[Any], None],
    words: str,
    x: str = "",
    y: str = "",
    size: tuple[float, float] = _SIZE,
    **axes: Any,
) -> str:
    """Draw one chart as an SVG element of a page; ``words`` say what it shows to those who cannot see it.

    ``x`` and ``y`` label the axes, ``size`` is in inches, ``axes`` are options of the axes.
    """
    with canvas(_INK) as figure:
        figure.set_size_inches(size)
        figure.set_layout_engine("constrained")
        on = figure.add_subplot(**axes)
        on.set_xlabel(x)
        on.set_ylabel(y)
        draw(on)
        return inline(figure, words)


def inline(figure: Any, words: str) -> str:
    """Turn a figure into an SVG element without names or addresses, whose text has the page's colour."""
    text = svg_text(figure, transparent=True)
    text = text[text.index("<svg") :]
    text = re.sub(
        r'<metadata>.*?</metadata>|<style.*?</style>|xmlns\S*="[^"]*"|<!--.*?-->', "", text, flags=re.DOTALL
    )
    text = re.sub(r'<g id="[^"]*"', "<g", text).replace("xlink:href", "href").replace(_INK, "currentColor")
    return text.replace("<svg", f'<svg class="chart" role="img" aria-label="{escape(words, quote=True)}"', 1)


def svg_text(figure: Any, *, transparent: bool = False) -> str:
    """SVG document of a figure."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=METADATA["svg"], transparent=transparent, dpi=2 * DPI)
    return buffer.getvalue()


def scatter(
    x: Float64, y: Float64, x_words: str, y_words: str, limit: float, *, logarithmic: bool = False
) -> str:
    """Draw dots (N,) with the median and the quartiles of twelve bins of equal size; "" for fewer than 20.

    The y axis runs from ``-limit`` to ``limit``; dots beyond are drawn at its ends.
    """
    if len(x) < 20:
        return ""
    step = max(1, len(x) // _DOTS)
    centre, quartile = binned(x, y, 12)

    def draw(axes: Any) -> None:
        dots = {"ms": 3, "alpha": 0.4, "mew": 0, "color": LINES[0], "rasterized": True, "clip_on": False}
        axes.plot(x[::step], np.clip(y[::step], -limit, limit), "o", **dots)
        axes.fill_between(centre, quartile[:, 0], quartile[:, 2], color=LINES[1], alpha=0.3, lw=0)
        axes.plot(centre, quartile[:, 1], color=LINES[1], lw=2)
        axes.axhline(0, color=_INK, lw=0.7, ls=":")
        if logarithmic:
            axes.set_xscale("log")
        axes.set_xlim(*np.quantile(x, (0.002, 0.998)))
        axes.set_ylim(-limit, limit)
        axes.spines[["top", "right"]].set_visible(False)

    return chart(draw, f"{y_words} over {x_words}", x_words, y_words)


def binned(x: Float64, y: Float64, bins: int) -> tuple[Float64, Float64]:
    """Centres (B,) and quartiles (B, 3) of ``y`` in bins of equal size along ``x``."""
    parts = [p for p in np.array_split(np.argsort(x, kind="stable"), bins) if len(p)]
    centres = np.array([np.median(x[p]) for p in parts])
    return centres, np.array([np.quantile(y[p], (0.25, 0.5, 0.75)) for p in parts])


def bars(names: Sequence[str], values: Sequence[float | None], good: Sequence[bool], words: str) -> str:
    """Draw one bar per view; refused views are hollow. "" where there is no value."""
    if all(v is None for v in values):
        return ""

    def draw(axes: Any) -> None:
        draw_bars(axes, names, [v or 0.0 for v in values], good)
        axes.spines[["top", "right"]].set_visible(False)

    return chart(draw, words, "view", words)


def draw_bars(axes: Any, names: Sequence[str], values: Sequence[float], good: Sequence[bool]) -> None:
    """Draw one bar per view on axes of matplotlib; refused views are hollow."""
    axes.bar(range(len(names)), values, color=[LINES[0] if g else "none" for g in good], edgecolor=LINES[0])
    some = range(0, len(names), len(names) // 16 + 1)
    axes.set_xticks(some, [names[i] for i in some])


def lines(
    series: Mapping[str, tuple[Sequence[float] | Float64, Sequence[float] | Float64]],
    x: str,
    y: str,
    words: str,
    *,
    log: str = "",
    span: tuple[float, float] | None = None,
) -> str:
    """Draw curves by name: their x and y; ``log`` names the logarithmic axis, ``span`` is what x shows."""

    def draw(axes: Any) -> None:
        for colour, (name, (along, up)) in zip(LINES, series.items(), strict=False):
            axes.plot(along, up, color=colour, lw=1.5, label=name)
        if log:
            getattr(axes, f"set_{log}scale")("log")
        if span:
            axes.set_xlim(*span)
        if len(series) > 1:
            axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)

    return chart(draw, words, x, y)


def heat(values: Float64, scale: Scale, words: str, names: Sequence[str] | None = None) -> str:
    """Draw a grid (rows, columns) of cells with their numbers; ``names`` of a square one's rows and columns."""
    rows, columns = values.shape
    image = scale.paint(values)

    def draw(axes: Any) -> None:
        axes.imshow(image, interpolation="nearest")
        for (r, c), value in np.ndenumerate(values):
            ink = "black" if image[r, c].mean() > 110 else "white"
            if np.isfinite(value):
                axes.text(c, r, f"{value:.2g}", color=ink, ha="center", va="center", fontsize=7)
        axes.set_xticks(range(columns) if names else [], names)
        axes.set_yticks(range(rows) if names else [], names)

    return chart(draw, words, size=(0.45 * columns, 0.45 * rows))


def polar(tilts: Sequence[float], leans: Sequence[float]) -> str:
    """Draw a dot per view: its radius is the tilt, its direction where the board faces in the image, degrees."""

    def draw(axes: Any) -> None:
        axes.set_theta_direction(-1)  # the image's y runs down
        axes.plot(np.radians(leans), np.minimum(tilts, 50.0), "o", ms=7, alpha=0.7, color=LINES[0])
        axes.set_rlim(0, 50)
        axes.set_rgrids((15, 30, 45), ("15°", "30°", "45°"))
        axes.set_xticklabels([])

    return chart(draw, "tilts of the views", size=(2.5, 2.5), projection="polar")


def frustum(camera: Camera, reach: float = _FRUSTUM) -> Float64:
    """One line (12, 3) along all edges of a camera's pyramid of that length, its own frame, metres."""
    w, h = camera.width - 1, camera.height - 1
    rays = camera.rays_at(np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64))
    a, b, c, d = reach * rays / rays[:, 2:]
    o = np.zeros(3)
    return np.stack([o, a, b, o, b, c, o, c, d, o, d, a])


def draw_rig(axes: Any, rig: Rig, across: int, along: int) -> None:
    """Draw flange and cameras to scale on two axes of the ToF frame, millimetres."""
    shown = [across, along]
    T_tof_flange = invert(rig.T_flange_tof)
    flange = 1e3 * T_tof_flange[:3, 3]
    for arm in 20 * T_tof_flange[:3, :3].T:
        axes.plot(*np.stack([flange, flange + arm])[:, shown].T, color=FLANGE, lw=2)
    labels = [("flange", flange, FLANGE, "center")]
    right = rig.T_tof_stereo[across, 3] > 0  # the stereo camera's name stands on its own side
    for name, T, camera, colour in (
        ("ToF", np.eye(4), rig.tof, TOF),
        ("stereo", rig.T_tof_stereo, rig.stereo, STEREO),
    ):
        drawn = 1e3 * transform_points(T, frustum(camera))
        axes.plot(*drawn[:, shown].T, color=colour, lw=1.5)
        labels.append((name, drawn[0], colour, "left" if right == (name == "stereo") else "right"))
    for name, at, colour, side in labels:
        axes.annotate(
            name,
            at[shown],
            xytext=(0, -11),
            textcoords="offset points",
            color=colour,
            fontsize=8,
            ha=side,
        )
    axes.set_xlabel(f"{'xyz'[across]}, ToF frame (mm)")
    axes.set_ylabel(f"{'xyz'[along]} (mm)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.2, 0.3)  # room for the names
    axes.grid(alpha=0.3)
