"""Colours that colour-blind readers can tell apart; grey always means that there is no value.

Depth is viridis, amplitude cividis, signed error red-white-blue with white at zero, expected error magma. Mask bits and
clouds use the palette of Okabe and Ito (2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.files.layout import MaskBit
from tofcapture.viz.shots import Panel, PanelKind

UInt8 = NDArray[np.uint8]
GREY = (138, 138, 138)
SENSOR = (230, 159, 0)  # orange
GROUND_TRUTH = (86, 180, 233)  # sky blue
ESTIMATE = (0, 158, 115)  # bluish green
GOOD = (240, 240, 240)
MASK = {
    MaskBit.OUTSIDE: (0, 114, 178),
    MaskBit.EDGE: (240, 228, 66),
    MaskBit.GRAZING: (204, 121, 167),
    MaskBit.OCCLUDED: (213, 94, 0),
    MaskBit.NOT_HIT: (60, 60, 60),
}
MAPS: dict[PanelKind, tuple[str, str]] = {
    "depth": ("viridis", "m"),
    "amplitude": ("cividis", "raw units"),
    "error": ("RdBu_r", "mm"),
    "expected": ("magma", "mm"),
}
_LENGTHS = ("error", "expected")  # printed in millimetres


@dataclass(frozen=True)
class Painted:
    """A picture (H, W, 3) uint8 and what its colours mean: colour map, lowest, highest, unit; empty without a scale."""

    image: UInt8
    colours: str = ""
    low: float = 0.0
    high: float = 1.0
    unit: str = ""

    @property
    def legend(self) -> str:
        """The scale in words."""
        return f"{self.low:.3g} to {self.high:.3g} {self.unit}" if self.colours else ""


def shown(panel: Panel) -> NDArray[Any]:
    """(H, W) values in the unit that is printed."""
    return 1e3 * panel.values if panel.kind in _LENGTHS else panel.values


def limits(panels: list[Panel]) -> tuple[float, float]:
    """Ends of the scale that panels of one kind share: 2nd to 98th percentile, symmetric about 0 for signed errors."""
    values = np.concatenate([np.ravel(shown(p)[np.isfinite(p.values)]) for p in panels] or [np.zeros(0)])
    if values.size == 0:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(values, (2, 98)))
    kind = panels[0].kind
    if kind == "error":
        high = max(abs(low), abs(high), 1e-6)
        return -high, high
    return (0.0 if kind in {"amplitude", "expected"} else low), max(high, low + 1e-6)


def paint(panel: Panel, low: float, high: float) -> Painted:
    """Colour a panel.

    Parameters
    ----------
    panel
        What to paint.
    low, high
        Ends of the scale, in the unit that is printed; not used by normals and masks.
    """
    if panel.kind == "normals":
        return Painted(_normals(panel.values))
    if panel.kind == "mask":
        return Painted(_mask(panel.values))
    from matplotlib import colormaps

    name, unit = MAPS[panel.kind]
    values = shown(panel).astype(np.float64)
    there = np.isfinite(values)
    scaled = np.clip((np.where(there, values, low) - low) / (high - low), 0, 1)
    image = colormaps[name](scaled, bytes=True)[..., :3]
    return Painted(np.where(there[..., None], image, np.uint8(GREY[0])), name, low, high, unit)


def _normals(values: NDArray[Any]) -> UInt8:
    """Red to the right, green upwards, blue towards the camera."""
    there = np.isfinite(values).all(axis=-1, keepdims=True)
    colours = np.clip((np.nan_to_num(values) * [1, -1, -1] + 1) * 127.5, 0, 255)
    return np.where(there, colours, GREY).astype(np.uint8)


def _mask(values: NDArray[Any]) -> UInt8:
    image = np.empty((*values.shape, 3), np.uint8)
    image[:] = GOOD
    for bit, colour in MASK.items():  # the last reason wins, the gravest stands last
        image[(values & bit) != 0] = colour
    return image
