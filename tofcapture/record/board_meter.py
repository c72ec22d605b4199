"""What the board views taken so far cover, told from the arm's poses and where the station says the board is.

Nothing is detected: the meter says where the board should have been seen. ``tofcapture calibrate coverage`` says more afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tofcapture.camera import Camera
from tofcapture.poses import Float64, invert, look_at, transform_points

SECTORS = ("right", "lower right", "below", "lower left", "left", "upper left", "above", "upper right")
TILTS = (0.0, 8.0, 15.0, 25.0, 40.0, 90.0)  # deg
TILTED = 8.0  # deg; a board less tilted leans in no direction
RADIUS = 0.2  # m, of the disc that stands for the board
CELLS = (9, 12)  # of the image


def lean_of(T_base_tof: Float64, normal: Float64) -> Float64:
    """Find how the normal (3,) of the board's front leans in the image of poses (..., 4, 4): (..., 2), x right and y down.

    The length is the sine of the tilt to the axis.
    """
    return np.asarray(np.swapaxes(T_base_tof[..., :3, :2], -1, -2) @ normal, dtype=np.float64)


def meter(poses: Sequence[Float64], board: Float64, normal: Float64, camera: Camera) -> str:
    """Lay out tilts, directions, distances and the share of the image, in three lines.

    ``poses`` are ``T_base_tof`` (4, 4), ``board`` and ``normal`` (3,) centre and front of the board, base frame, metres.
    """
    if not poses:
        return "no board views yet"
    T = np.stack(poses)
    gap = T[:, :3, 3] - board
    distance = np.linalg.norm(gap, axis=1)
    normal = normal / np.linalg.norm(normal)
    tilt = np.degrees(np.arccos(np.clip(gap @ normal / distance, -1.0, 1.0)))
    lean = lean_of(T, normal)[tilt >= TILTED]
    sector = np.round(np.arctan2(lean[:, 1], lean[:, 0]) / (np.pi / 4)).astype(int) % 8
    faces = [f"{name} {count}" for name, count in zip(SECTORS, np.bincount(sector, minlength=8), strict=True)]
    counts = np.histogram(tilt, TILTS)[0]
    tilts = [f"{a:g}-{b:g} deg {n}" for a, b, n in zip(TILTS[:-1], TILTS[1:], counts, strict=True)]
    share = np.any([_seen(pose, board, normal, camera) for pose in poses], axis=0).mean()
    return "\n".join(
        [
            f"{len(poses)} board views, {distance.min():.2f} to {distance.max():.2f} m, image {100 * share:.0f} % covered",
            f"  tilts  {'  '.join(tilts)}",
            f"  faces  {'  '.join(faces)}",
        ]
    )


def _seen(T_base_tof: Float64, board: Float64, normal: Float64, camera: Camera) -> Float64:
    """Which cells of the image (9, 12) look at the board's disc."""
    v = (np.arange(CELLS[0]) + 0.5) * camera.height / CELLS[0] - 0.5
    u = (np.arange(CELLS[1]) + 0.5) * camera.width / CELLS[1] - 0.5
    rays = camera.rays_at(np.stack(np.meshgrid(u, v), axis=-1))
    T_board_tof = invert(look_at(board, board + normal)) @ T_base_tof
    way, eye = rays @ T_board_tof[:3, :3].T, T_board_tof[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = -eye[2] / way[..., 2]
        met = transform_points(T_board_tof, rays * reach[..., None])
    return np.asarray((reach > 0) & (np.hypot(met[..., 0], met[..., 1]) < RADIUS))
