"""Points seen from the side, drawn with numpy: every point a small square, near ones over far ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tofcapture.poses import Float64, invert, look_at, rotate_vectors, transform_points
from tofcapture_model.report.pictures import NO_VALUE, UInt8, palette

SIZE = (360, 480)  # height and width of a picture
BACKGROUND = (27, 31, 36)
HUES, SHADES = 15, 17  # 14 steps of the colour map and one grey, each from dark to light: 255 colours
_TURN = np.radians(65.0)  # about the vertical, away from where the camera stood
_ELEVATION = np.radians(32.0)
_LIGHT = np.array([-0.35, -0.65, -0.68])  # towards the light, in the eye's frame: upper left, behind the eye


def side_view(T_base_tof: Float64, centre: Float64) -> Float64:
    """Pose of an eye that looks at a point from the side, upright in the base frame.

    Parameters
    ----------
    T_base_tof
        (4, 4) pose of the camera that took the view.
    centre
        (3,) ToF frame, metres: what to look at.

    Returns
    -------
    T_tof_eye, (4, 4)
    """
    target = transform_points(T_base_tof, centre)
    away = T_base_tof[:3, 3] - target
    azimuth = np.arctan2(away[1], away[0]) + _TURN
    flat = np.cos(_ELEVATION)
    direction = np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(_ELEVATION)])
    return invert(T_base_tof) @ look_at(target + direction, target)


def shaded_palette(name: str) -> UInt8:
    """(256, 3): each hue of a colour map, and grey, in shades; the last colour is the background."""
    hues = np.vstack(
        [palette(name)[np.linspace(0, NO_VALUE - 1, HUES - 1).round().astype(int)], [[170, 170, 170]]]
    )
    shades = np.linspace(0.3, 1.0, SHADES)
    table = np.full((256, 3), BACKGROUND, np.uint8)
    table[: HUES * SHADES] = np.rint(hues[:, None] * shades[:, None]).reshape(-1, 3)
    return table


def render(
    points: Float64,
    normals: NDArray[np.floating],
    values: NDArray[np.floating],
    T_tof_eye: Float64,
    metres_per_pixel: float,
    dot: int = 3,
) -> UInt8:
    """Draw points by parallel projection.

    Parameters
    ----------
    points, normals
        (N, 3) ToF frame, metres; unit.
    values
        (N,) in [0, 1], position on the colour map; NaN: grey.
    T_tof_eye
        (4, 4) pose of the eye, whose axis passes through the picture's middle.
    metres_per_pixel
        Size of a pixel.
    dot
        Side of a point in pixels.

    Returns
    -------
    (H, W) indices into :func:`shaded_palette`
    """
    T_eye_tof = invert(T_tof_eye)
    eye = transform_points(T_eye_tof, points)
    colour = _colours(rotate_vectors(T_eye_tof, normals), values)
    order = np.argsort(-eye[:, 2], kind="stable")
    half = np.array([SIZE[1], SIZE[0]]) / 2
    at = np.floor(eye[order, :2] / metres_per_pixel + half).astype(np.int64)
    return _splat(at, eye[order, 2], colour[order], dot)


def _colours(normals: Float64, values: NDArray[np.floating]) -> UInt8:
    hue = np.where(np.isfinite(values), np.rint(np.clip(np.nan_to_num(values), 0, 1) * (HUES - 2)), HUES - 1)
    light = np.clip(np.nan_to_num(normals @ (_LIGHT / np.linalg.norm(_LIGHT))), 0, 1)
    indices: UInt8 = (hue * SHADES + np.rint(light * (SHADES - 1))).astype(np.uint8)
    return indices


def _splat(at: NDArray[np.int64], depth: Float64, colour: UInt8, dot: int) -> UInt8:
    """Paint squares, far ones first; of two squares on a pixel the nearer one stays."""
    image = np.full(SIZE, NO_VALUE, np.uint8)
    nearest = np.full(SIZE, np.inf)
    reach = range(-(dot // 2), dot - dot // 2)
    for dy, dx in ((dy, dx) for dy in reach for dx in reach):
        u, v = at[:, 0] + dx, at[:, 1] + dy
        inside = (u >= 0) & (u < SIZE[1]) & (v >= 0) & (v < SIZE[0])
        layer, front = np.full(SIZE, NO_VALUE, np.uint8), np.full(SIZE, np.inf)
        layer[v[inside], u[inside]] = colour[inside]  # the last one, which is the nearest, wins
        front[v[inside], u[inside]] = depth[inside]
        closer = front < nearest
        image[closer], nearest[closer] = layer[closer], front[closer]
    return image
