"""A board as something to measure against: distance to its nearest edge, and which of its edges a camera sees as they are."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.board.geometry import Board, inside
from tofcapture.poses import Float64, invert

WALL = 0.0004  # m of the board's side in sight beyond a rim, above which the rim is the back's or a mixture, and does not count
PITCH = 0.004  # m, of the grid of distances
BORDER = 0.05  # m of that grid around the outline


@dataclass(frozen=True)
class Edges:
    """The nearest edge of a model to points of its plane.

    Attributes
    ----------
    distance
        (N,) signed, metres; positive off the material.
    gradient
        (N, 2) of the distance.
    outward
        (N, 2) from the material across the nearest edge.
    segment, ring
        (N,) index of the nearest side, and of its ring: 0 the outline, then the holes.
    """

    distance: Float64
    gradient: Float64
    outward: Float64
    segment: NDArray[np.intp]
    ring: NDArray[np.intp]


@dataclass(frozen=True)
class Model:
    """A board's edges, ready to be asked for."""

    board: Board

    @cached_property
    def sides(self) -> tuple[Float64, Float64, NDArray[np.intp]]:
        """Start and end (S, 2) of every straight side, and the ring that it belongs to."""
        straight = [0, *(i + 1 for i, hole in enumerate(self.board.holes) if hole.centre is None)]
        rings = [self.board.rings[i] for i in straight]
        ends = [np.roll(ring, -1, axis=0) for ring in rings]
        return np.concatenate(rings), np.concatenate(ends), np.repeat(straight, [len(r) for r in rings])

    @cached_property
    def circles(self) -> tuple[Float64, Float64, NDArray[np.intp]]:
        """Centres (C, 2) and radii (C,) of the round holes, and their rings."""
        found = [(i + 1, hole) for i, hole in enumerate(self.board.holes) if hole.centre is not None]
        centres = np.array([hole.centre for _, hole in found], dtype=np.float64).reshape(-1, 2)
        return centres, np.array([h.radius for _, h in found]), np.array([i for i, _ in found], dtype=np.intp)

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
        flat, round_ = self._straight(xy), self._round(xy)
        nearer = flat.distance <= round_.distance
        both = {
            name: np.where(nearer if a.ndim == 1 else nearer[:, None], a, getattr(round_, name))
            for name, a in vars(flat).items()
        }
        # Away from an edge the distance grows; the sign turns that into "off the material".
        gradient = sign[:, None] * both["gradient"]
        gradient = np.where(both["distance"][:, None] > 1e-9, gradient, both["outward"])
        return Edges(sign * both["distance"], gradient, both["outward"], both["segment"], both["ring"])

    def _straight(self, xy: Float64) -> Edges:
        """Nearest straight side, distance and gradient without sign."""
        start, end, owner = self.sides
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
        return Edges(
            length, gap / np.maximum(length, 1e-12)[:, None], outward[nearest], nearest, owner[nearest]
        )

    def _round(self, xy: Float64) -> Edges:
        """Nearest round hole, the same way; infinitely far where there is none."""
        centres, radii, owner = self.circles
        if not len(radii):
            zero = np.zeros(len(xy), dtype=np.intp)
            return Edges(np.full(len(xy), np.inf), np.zeros_like(xy), np.zeros_like(xy), zero, zero)
        off = xy[:, None] - centres
        length = np.linalg.norm(off, axis=-1)
        gap = length - radii
        nearest, rows = np.abs(gap).argmin(axis=1), np.arange(len(xy))
        away = off[rows, nearest] / np.maximum(length[rows, nearest], 1e-12)[:, None]
        signed = gap[rows, nearest]
        return Edges(np.abs(signed), np.sign(signed)[:, None] * away, -away, 500 + nearest, owner[nearest])


def on_front(T: Float64, board: Board, rays: Float64) -> Float64:
    """Where rays (N, 3) from the camera meet the board's front: (N, 2), board frame, metres."""
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
