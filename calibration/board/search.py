"""Where a board may be: planes of a cloud, and all turns and places of the model on them, by correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.board.model import PITCH, Model
from tofcapture.poses import Float64, rotation_exp, transform

SEEDS = 120  # points whose surroundings propose a plane
NEIGHBOURS = 120
MOST_POINTS = 6000  # of a cloud, evenly
CELL = 0.008  # m
CELLS = 128
TURNS = 72  # 5 deg apart
BLUR = 0.010  # m; half a turn's step at a quarter of a metre
VOID = 1.5  # how much a surface point in a hole counts against one on the plate
CANDIDATES = 4
APART = (0.030, np.radians(12.0))  # m and rad between candidates


@dataclass(frozen=True)
class Plane:
    """A plane of a cloud: its frame (4, 4) with z towards the camera and the points (K, 3) on it."""

    T: Float64
    points: Float64


def planes(points: Float64, tolerance: float, most: int = 3) -> list[Plane]:
    """Find the largest planes of a cloud (N, 3), largest first, each without the points of the one before.

    Every seed's surroundings propose a plane; no chance is involved.
    """
    from scipy.spatial import cKDTree

    left = points[:: max(1, len(points) // MOST_POINTS)]
    found: list[Plane] = []
    while len(found) < most and len(left) >= 4 * NEIGHBOURS:
        _, near = cKDTree(left).query(left[:: max(1, len(left) // SEEDS)], NEIGHBOURS)
        frames = [_frame(left[i]) for i in near]
        counts = [int((np.abs(_height(T, left)) < 2 * tolerance).sum()) for T in frames]
        T = frames[int(np.argmax(counts))]
        for width in (2.0, 1.5, 1.0, 1.0):
            on = np.abs(_height(T, left)) < width * tolerance
            if on.sum() < NEIGHBOURS:
                break
            T = _frame(left[on])
        on = np.abs(_height(T, left)) < 1.5 * tolerance
        if on.sum() < NEIGHBOURS:
            break
        found.append(Plane(T, left[on]))
        left = left[np.abs(_height(T, left)) > 3 * tolerance]
    return found


def _height(T: Float64, points: Float64) -> Float64:
    out: Float64 = (points - T[:3, 3]) @ T[:3, 2]
    return out


def _frame(points: Float64) -> Float64:
    """Plane frame (4, 4) of points (N, 3): centroid, z along the normal that faces the camera."""
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - centre).T))
    z = axes[:, 0] if axes[:, 0] @ centre < 0 else -axes[:, 0]
    x = axes[:, 2]
    return transform(np.stack([x, np.cross(z, x), z], axis=1), centre)


def candidates(model: Model, plane: Plane, rims: Float64) -> list[Float64]:
    """Poses ``T_camera_board`` worth refining, best first: both sides, all turns, all places.

    Parameters
    ----------
    model
        The board.
    plane
        Where it may lie.
    rims
        (N, 3) rim points, camera frame, metres, near that plane.

    Returns
    -------
    list of (4, 4)
    """
    rim, surface = _grid(plane, rims), _grid(plane, plane.points)
    F_rim, F_surface = (np.conj(np.fft.rfft2(g / max(g.sum(), 1.0))) for g in (rim, surface))
    found = []
    for back in (False, True):
        for turn in range(TURNS):
            local = _placed(model, 2 * np.pi * turn / TURNS, back=back)
            edge, solid = _fields(model, local)
            score = np.fft.irfft2(
                np.conj(F_rim * np.fft.rfft2(edge) + 0.5 * F_surface * np.fft.rfft2(solid)), s=(CELLS, CELLS)
            )
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            shift = np.array([column, row], dtype=np.float64)
            shift -= CELLS * (shift >= CELLS / 2)
            at = local.copy()
            at[:2, 3] += CELL * shift
            found.append((float(score[row, column]), plane.T @ at))
    found.sort(key=lambda item: -item[0])
    return _distinct([T for _, T in found], model)


def _placed(model: Model, angle: float, *, back: bool) -> Float64:
    """Pose of the board in the plane's frame, its outline's centre over the origin and the visible face at z = 0."""
    R = rotation_exp([0.0, 0.0, angle]) @ (np.diag([1.0, -1.0, -1.0]) if back else np.eye(3))
    low, high = model.board.outline.min(axis=0), model.board.outline.max(axis=0)
    middle = np.array([*((low + high) / 2), 0.0 if back else model.board.thickness])
    return transform(R, -R @ middle)


def _grid(plane: Plane, points: Float64) -> Float64:
    """Occupancy (CELLS, CELLS) of points (N, 3) in the plane."""
    xy = (points - plane.T[:3, 3]) @ plane.T[:3, :2]
    cell = np.floor(xy / CELL + CELLS / 2).astype(int)
    cell = cell[((cell >= 0) & (cell < CELLS)).all(axis=1)]
    out = np.zeros((CELLS, CELLS))
    out[cell[:, 1], cell[:, 0]] = 1.0
    return out


def _fields(model: Model, local: Float64) -> tuple[Float64, Float64]:
    """Blurred edges, and material less void, of the model at a pose in the plane's frame."""
    from scipy.ndimage import map_coordinates

    table, low = model.grid
    at = (np.arange(CELLS) + 0.5 - CELLS / 2) * CELL
    xy = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    on_board = (xy - local[:2, 3]) @ local[:2, :2]
    place = (on_board - low) / PITCH
    sdf = map_coordinates(table, place[:, ::-1].T, order=1, mode="nearest").reshape(CELLS, CELLS)
    return np.exp(-np.square(sdf / BLUR)), np.clip(-sdf / CELL, -VOID, 1.0)


def _distinct(poses: list[Float64], model: Model) -> list[Float64]:
    middle = np.array([*model.board.outline.mean(axis=0), 0.0])
    kept: list[Float64] = []
    for T in poses:
        if all(
            distance_of(T, other, middle)[0] > APART[0] or distance_of(T, other, middle)[1] > APART[1]
            for other in kept
        ):
            kept.append(T)
        if len(kept) == CANDIDATES:
            break
    return kept


def distance_of(a: Float64, b: Float64, point: Float64) -> tuple[float, float]:
    """How far two poses differ: metres at a point (3,) of the board, and radians."""
    moved = a[:3, :3] @ point + a[:3, 3] - b[:3, :3] @ point - b[:3, 3]
    cosine = np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(moved)), float(np.arccos(cosine))
