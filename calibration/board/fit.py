"""The pose of a board by fitting its model: rims on its edges, surface points on its plane.

A rim counts by its ray alone. The ray meets the board's front, and the signed distance of that point to the nearest edge of the
model is the residual, so that a range error costs nothing and the board's size gives its distance. Surface points hold the
tilt. Two nuisances are unknowns too: a range error common to the surface, and how far all rims seem to lie off the material.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.board.geometry import Board
from calibration.registration.gate import tukey_weights
from tofcapture.meshes import inside
from tofcapture.poses import Float64, exp, hat, invert, transform_points

WALL = 0.0004  # m of the board's side in sight beyond a rim, above which the rim is the back's or a mixture, and does not count
PITCH = 0.004  # m, of the grid of distances
BORDER = 0.05  # m of that grid around the outline

SCALES = (0.020, 0.010, 0.006, 0.004, 0.003)  # m, Tukey's scale on the rims, a few steps each
STEPS = 4
RIM_SIGMA = 0.0007  # m, one rim point
GROWTH_SIGMA = 0.0002  # m, by how much a camera may see all plates too large and all holes too small
UNKNOWNS = 8  # rho, phi, range error of the surface, growth
INDEPENDENT = 40  # surface points that count at most: neighbours share bias and waves
COMMON = 0.0002  # m, what all rims of a camera may be off sideways by together: a third of a stereo pixel
TILES = 4  # surface residuals share their bias over a piece of the board this many to a side


@dataclass(frozen=True)
class Edges:
    """The nearest edge of a model to N points of its plane."""

    distance: Float64  #: (N,) signed, metres; positive off the material
    gradient: Float64  #: (N, 2) of the distance
    outward: Float64  #: (N, 2) from the material across the nearest edge
    #: (N,) index of the nearest side, and of its ring: 0 the outline, then the holes
    segment: NDArray[np.intp]
    ring: NDArray[np.intp]


@dataclass(frozen=True)
class Model:
    """A board's edges, ready to be asked for."""

    board: Board

    @cached_property
    def grid(self) -> tuple[Float64, Float64]:
        """Signed distance (rows, columns) every ``PITCH`` metres about the board, and the (2,) place of its first value."""
        low = self.board.outline.min(axis=0) - BORDER
        count = np.ceil((np.ptp(self.board.outline, axis=0) + 2 * BORDER) / PITCH).astype(int) + 1
        x, y = (low[i] + PITCH * np.arange(count[i]) for i in (0, 1))
        xy = np.stack(np.meshgrid(x, y), axis=-1)
        return self.edges(xy.reshape(-1, 2)).distance.reshape(xy.shape[:2]), low

    def material(self, xy: Float64) -> NDArray[np.bool_]:
        """Say which points (N, 2) lie on the plate and in no hole."""
        solid = inside(self.board.outline, xy)
        for hole in self.board.holes:
            if hole.centre is None:
                solid &= ~inside(hole.corners, xy)
            else:
                solid &= np.linalg.norm(xy - hole.centre, axis=-1) >= hole.radius
        return solid

    def edges(self, xy: Float64) -> Edges:
        """Find the nearest edge of points (N, 2)."""
        sign = np.where(self.material(xy), -1.0, 1.0)
        flat, curved = self._straight(xy), self._round(xy)
        nearer = flat.distance <= curved.distance
        distance, gradient, outward, segment, ring = (
            np.where(nearer if a.ndim == 1 else nearer[:, None], a, b)
            for a, b in zip(vars(flat).values(), vars(curved).values(), strict=True)
        )
        # Away from an edge the distance grows; the sign turns that into "off the material".
        gradient = np.where(distance[:, None] > 1e-9, sign[:, None] * gradient, outward)
        return Edges(sign * distance, gradient, outward, segment, ring)

    @cached_property
    def _sides(self) -> tuple[Float64, Float64, NDArray[np.intp]]:
        """Start and end (S, 2) of every straight side, and the ring that it belongs to."""
        straight = [0, *(i + 1 for i, hole in enumerate(self.board.holes) if hole.centre is None)]
        rings = [self.board.rings[i] for i in straight]
        ends = [np.roll(ring, -1, axis=0) for ring in rings]
        return np.concatenate(rings), np.concatenate(ends), np.repeat(straight, [len(r) for r in rings])

    def _straight(self, xy: Float64) -> Edges:
        """Nearest straight side, distance and gradient without sign."""
        start, end, owner = self._sides
        side = end - start
        x, y = (xy[:, i, None] - start[:, i] for i in (0, 1))
        t = np.clip((x * side[:, 0] + y * side[:, 1]) / np.square(side).sum(axis=1), 0, 1)
        x, y = x - t * side[:, 0], y - t * side[:, 1]
        squared = x * x + y * y
        nearest, rows = squared.argmin(axis=1), np.arange(len(xy))
        gap = np.stack([x[rows, nearest], y[rows, nearest]], axis=1)
        length = np.sqrt(squared[rows, nearest])
        turned = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.linalg.norm(side, axis=1, keepdims=True)
        outward = np.where(owner == 0, 1.0, -1.0)[:, None] * turned  # all rings run counter-clockwise
        gradient = gap / np.maximum(length, 1e-12)[:, None]
        return Edges(length, gradient, outward[nearest], nearest, owner[nearest])

    def _round(self, xy: Float64) -> Edges:
        """Nearest round hole, the same way; infinitely far where there is none."""
        circles = [
            (i + 1, h.centre, h.radius) for i, h in enumerate(self.board.holes) if h.centre is not None
        ]
        if not circles:
            none = np.zeros(len(xy), dtype=np.intp)
            return Edges(np.full(len(xy), np.inf), np.zeros_like(xy), np.zeros_like(xy), none, none)
        owner, centres, radii = (np.array(part) for part in zip(*circles, strict=True))
        off = xy[:, None] - centres
        length = np.linalg.norm(off, axis=-1)
        gap = length - radii
        nearest, rows = np.abs(gap).argmin(axis=1), np.arange(len(xy))
        away = off[rows, nearest] / np.maximum(length[rows, nearest], 1e-12)[:, None]
        signed = gap[rows, nearest]
        return Edges(np.abs(signed), np.sign(signed)[:, None] * away, -away, 500 + nearest, owner[nearest])


def on_front(T: Float64, board: Board, rays: Float64) -> Float64:
    """Find where rays (N, 3) from the camera meet the front of a board at ``T_camera_board``: (N, 2), board frame, metres."""
    back = invert(T)
    origin, directions = back[:3, 3], rays @ back[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (board.thickness - origin[2]) / directions[:, 2]
    out: Float64 = origin[:2] + s[:, None] * directions[:, :2]
    return out


def clear_of_walls(T: Float64, board: Board, xy: Float64, outward: Float64) -> NDArray[np.bool_]:
    """Say at which edge points (N, 2) the front's edge is the silhouette: the board's side behind it is out of sight."""
    eye = invert(T)[:3, 3]
    across = ((eye[:2] - xy) * outward).sum(axis=-1)
    height = max(abs(float(eye[2]) - board.thickness), 1e-6)
    return np.asarray(board.thickness * across / height < WALL)


@dataclass(frozen=True)
class Sight:
    """Hold what a camera sees of a board."""

    rims: Float64  #: (N, 3) points on rims, camera frame, metres; only their rays count
    surface: Float64  #: (M, 3) surface points, camera frame, metres
    sigma: float  #: Noise of a surface point with the bias of its neighbourhood, metres
    bias_sigma: float  #: What a common range error may be, metres
    at: Float64 | None = None  #: (N, 2) where on the board the rims are known to be: corners of a pattern
    edge_sigma: float = RIM_SIGMA  #: Of a rim or corner on the board, metres
    common_sigma: float = COMMON  #: What all rims or corners may be off sideways by together, metres


@dataclass(frozen=True)
class Fit:
    """A refined pose."""

    T: Float64  #: (4, 4) ``T_camera_board``
    bias: float  #: Common range error of the surface points, metres; positive is measured too far
    #: (6, 6) of (displacement of the board's origin, rotation vector), camera axes, m^2 and rad^2.
    #: Cluster-robust: what one hole or one piece of the surface has in common counts once
    covariance: Float64


def refine(model: Model, sight: Sight, T: Float64, scales: Sequence[float] = SCALES) -> Fit:
    """Fit a pose by Gauss-Newton with Tukey's weights on the rims, coarse to fine.

    ``T`` (4, 4) is ``T_camera_board`` to within 2 cm and 4 degrees, the sight that of one plane. ``scales`` are Tukey's, metres,
    descending.
    """
    nuisance = np.zeros(UNKNOWNS - 6)
    prior = np.diag([0.0] * 6 + [1 / sight.bias_sigma**2, 1 / GROWTH_SIGMA**2])
    for scale in np.repeat(scales, STEPS):
        J, r, w, _ = _equations(model, sight, T, nuisance, scale)
        weighted = (J * w[:, None]).T
        g = weighted @ r + prior @ np.concatenate([np.zeros(6), nuisance])
        step = -np.linalg.solve(weighted @ J + prior + 1e-6 * np.eye(UNKNOWNS), g)
        T, nuisance = exp(step[:6]) @ T, nuisance + step[6:]
    equations = _equations(model, sight, T, nuisance, scales[-1])
    return Fit(T, float(nuisance[0]), _covariance(*equations, prior, T, sight.common_sigma))


def _equations(
    model: Model, sight: Sight, T: Float64, nuisance: Float64, scale: float
) -> tuple[Float64, Float64, Float64, NDArray[np.intp]]:
    """Jacobian (K, 8), residuals, weights and clusters (K,), rims first."""
    board, n = model.board, T[:3, 2]
    xy = on_front(T, board, sight.rims)
    if sight.at is None:
        found = model.edges(xy)
        gradient, r_rim, grows = found.gradient, found.distance - nuisance[1], -1.0
        w_rim = tukey_weights(r_rim, scale) * clear_of_walls(T, board, xy, found.outward)
        sides = np.where(found.ring == 0, found.segment, 1000 + found.ring)
    else:  # both coordinates of every corner
        gradient, r_rim, grows = np.tile(np.eye(2), (len(xy), 1)), (xy - sight.at).reshape(-1), 0.0
        w_rim, xy, sides = tukey_weights(r_rim, scale), np.repeat(xy, 2, axis=0), np.arange(2 * len(xy)) // 2
    X = transform_points(T, np.column_stack([xy, np.full(len(xy), board.thickness)]))
    g = gradient @ T[:3, :2].T
    a = n * ((g * X).sum(axis=1) / (X @ n))[:, None] - g
    J_rim = np.column_stack([a, np.cross(X, a), np.zeros(len(a)), np.full(len(a), grows)])
    w_rim = w_rim / sight.edge_sigma**2

    away = sight.surface / np.linalg.norm(sight.surface, axis=1, keepdims=True)
    P = sight.surface - nuisance[0] * away
    r_plane = (P - T[:3, 3]) @ n - board.thickness
    J_plane = np.column_stack([np.broadcast_to(-n, P.shape), -np.cross(P, n), -(away @ n), np.zeros(len(P))])
    w_plane = tukey_weights(r_plane, max(scale, 6 * sight.sigma)) / sight.sigma**2
    w_plane *= min(1.0, INDEPENDENT / max(len(P), 1))
    low, span = board.outline.min(axis=0), np.ptp(board.outline, axis=0)
    on_board = transform_points(invert(T), sight.surface)[:, :2]
    tile = np.clip((on_board - low) / span * TILES, 0, TILES - 1).astype(np.intp) @ [1, TILES]
    return (
        np.concatenate([J_rim, J_plane]),
        np.concatenate([r_rim, r_plane]),
        np.concatenate([w_rim, w_plane]),
        np.concatenate([sides, 2000 + tile]),
    )


def _covariance(
    J: Float64, r: Float64, w: Float64, cluster: NDArray[np.intp], prior: Float64, T: Float64, common: float
) -> Float64:
    """Covariance at the board's origin: what the weights promise, plus what the clusters show, plus what all rims share.

    The second is the sandwich ``H^-1 (sum_c g_c g_c^T) H^-1`` over clusters (Liang and Zeger, Biometrika 73, 1986). A bias that
    runs across clusters is not in it, one of every point alone is all that is in the first.
    """
    names, place = np.unique(cluster, return_inverse=True)
    scores = np.zeros((len(names), UNKNOWNS))
    np.add.at(scores, place, J * (w * r)[:, None])
    bread = np.linalg.inv((J * w[:, None]).T @ J + prior + 1e-6 * np.eye(UNKNOWNS))
    meat = scores.T @ scores * len(names) / max(len(names) - 1, 1) + prior
    C = (bread + bread @ meat @ bread)[:6, :6]
    move = np.eye(6)
    move[:3, 3:] = -hat(T[:3, 3])
    out: Float64 = move @ C @ move.T + np.diag([common**2] * 3 + [0.0] * 3)
    return out
