"""Mixed pixels at depth edges."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera

_STEEP = float(np.tan(np.radians(80)))


def flying_pixels(
    depth: NDArray[np.floating[Any]], camera: Camera, scratch: NDArray[np.floating[Any]] | None = None
) -> NDArray[np.bool_]:
    """Pixels that neither neighbour of a row, or neither of a column, supports.

    A mixed pixel hangs between two surfaces (method.md 4.4): depth jumps on both of its sides. A jump is more than a surface
    at 80 degrees from the ray makes from one pixel to the next. Pixels beside holes are not flagged for them.

    Parameters
    ----------
    depth
        (H, W), metres; NaN: none.
    camera
        Gives the distance between neighbouring rays.
    scratch
        (2, H W) of depth's dtype, overwritten; ``None``: made here.
    """
    step_of, steep_of = np.empty((2, depth.size), depth.dtype) if scratch is None else scratch
    out = np.zeros(depth.shape, dtype=bool)
    flat, jump = np.ascontiguousarray(depth).ravel(), np.zeros(depth.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        # Row after row as one: a step across a seam is taken for column 0, which has no left neighbour and is not asked.
        for stride, focal in ((1, camera.fx), (depth.shape[1], camera.fy)):
            step = np.subtract(flat[stride:], flat[:-stride], out=step_of[stride:])
            steep = np.multiply(flat[stride:], _STEEP / focal, out=steep_of[stride:])
            np.greater(np.abs(step, out=step), steep, out=jump.ravel()[stride:])
            if stride == 1:
                np.logical_and(jump[:, 1:-1], jump[:, 2:], out=out[:, 1:-1])
            else:
                out[1:-1] |= jump[1:-1] & jump[2:]
    return out
