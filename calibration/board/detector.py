"""Find a board of known geometry in what one camera sees: its pose with covariance, or a refusal by name.

The model is fitted as a whole, outline and cut-outs together; no circle is searched for. The same code serves both cameras: a
ToF burst and a stereo frame are both reduced to rims and surface points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from calibration.board.fit import SCALES, Fit, Sight, refine
from calibration.board.geometry import Board, distance_to_ring, inside
from calibration.board.model import Model, clear_of_walls, on_front
from calibration.board.rims import stereo_rims, tof_rims
from calibration.board.search import Plane, candidates, distance_of, planes
from calibration.registration.clouds import stereo_cloud, surface_points, tof_depth
from tofcapture.camera import Camera
from tofcapture.errors import QualityError
from tofcapture.frames import StereoFrame, TofBurst
from tofcapture.poses import Float64, invert, transform_points

NEAR_PLANE = 0.030  # m; rims are this near to the board's plane, range errors included
MIN_RIMS = 60
MOST_RIMS = 2000  # of a camera; the rest repeats them
FEW_RIMS = 400  # for trying candidates
ON_EDGE = 0.003  # m; a rim this near to a model edge is explained
SAMPLES = 0.005  # m between the samples of a model edge
MARGIN = 6  # px from the image's border within which no rim is found
FOUND = 0.25  # share of an edge's samples with a rim beside them that makes a hole found
MIN_SAMPLES = 6  # of a hole's edge in sight: fewer say nothing
EXPLAINED = 0.85  # least share of rims on model edges
HOLES = 0.6  # least share of the holes in sight that are found
IN_VOID = 0.010  # m; surface this deep in a hole, or this far off the plate, contradicts the model
CONTRADICTED = 0.05  # most share of the plane's points about the board that may
RIVAL = 0.85  # a second pose that explains this share of what the best explains is a rival
APART = (0.010, np.radians(5.0))  # m and rad beyond which two poses differ


class BoardRefusal(StrEnum):
    """Why no pose is reported."""

    NO_PLANE = "no plane"
    NO_HOLES = "no holes visible"
    AMBIGUOUS = "ambiguous: symmetric board"
    WRONG_BOARD = "wrong board"


@dataclass(frozen=True)
class Detection:
    """A board's pose.

    Attributes
    ----------
    fit
        Pose ``T_camera_board``, covariance and residuals.
    explained
        Share of the rims on the board's plane that lie on a model edge.
    holes
        Name -> share of its edge in sight that has a rim; holes out of sight are left out.
    contradicted
        Share of the plane's points about the board that lie where the model has none.
    """

    fit: Fit
    explained: float
    holes: dict[str, float]
    contradicted: float

    @property
    def T_camera_board(self) -> Float64:
        """(4, 4)."""
        return self.fit.T

    @property
    def score(self) -> float:
        """What candidates are compared by: how much of the sight the model explains, and of the model is seen."""
        seen = float(np.mean(list(self.holes.values()))) if self.holes else 0.0
        return self.explained * (0.2 + seen) * (1 - min(1.0, 4 * self.contradicted))

    @property
    def certain(self) -> bool:
        """No other plane can hold the board: nearly all of the sight is explained, and nearly all holes are found."""
        good = [share > FOUND for share in self.holes.values()]
        return self.explained > 0.9 and self.contradicted < CONTRADICTED and len(good) >= 2 and all(good)


def tof_sight(burst: TofBurst) -> Sight:
    """Reduce a ToF burst: rims from mixed phasors, surface of the piece that fills the image's centre."""
    phasor, depth = tof_depth(burst)
    rims = tof_rims(phasor, depth, burst.info.camera).points
    return Sight(rims, surface_points(burst, depth), sigma=0.003, bias_sigma=0.020)


def stereo_sight(frame: StereoFrame) -> Sight:
    """Reduce a stereo frame: rims of its point map, and the dense cloud."""
    return Sight(
        stereo_rims(frame.points).points, stereo_cloud(frame).points, sigma=0.0007, bias_sigma=0.0003
    )


def detect(sight: Sight, board: Board, camera: Camera) -> Detection:
    """Find a board.

    Parameters
    ----------
    sight
        Rims and surface of one camera; ranges may be wrong by a centimetre in common.
    board
        Its geometry.
    camera
        Intrinsics, for what lies in the image.

    Returns
    -------
    Detection

    Raises
    ------
    QualityError
        Named by a :class:`BoardRefusal`: no plane, no holes visible, ambiguous, wrong board.
    """
    model = Model(board)
    thin = replace(sight, rims=sight.rims[:: max(1, len(sight.rims) // MOST_RIMS)])
    found: list[tuple[Detection, Sight]] = []
    for plane in planes(sight.surface, 2.5 * sight.sigma):
        found += _tried(model, thin, plane, camera)
        if any(d.certain for d, _ in found):
            break
    if not found:
        raise _refused(BoardRefusal.NO_PLANE, board, f"no plane with {MIN_RIMS} rims on it")
    found.sort(key=lambda item: -item[0].score)
    middle = np.array([*((board.outline.max(axis=0) + board.outline.min(axis=0)) / 2), 0.0])
    first, on_plane = found[0]
    best = judge(model, on_plane, refine(model, on_plane, first.T_camera_board), camera)
    _check(best, board, _inner_rims(model, on_plane, best))
    for rival, _ in found[1:]:
        metres, radians = distance_of(best.T_camera_board, rival.T_camera_board, middle)
        if (metres > APART[0] or radians > APART[1]) and rival.score > RIVAL * first.score:
            raise _refused(
                BoardRefusal.AMBIGUOUS,
                board,
                f"another pose, {np.degrees(radians):.0f} deg away, fits as well",
            )
    return best


def _tried(model: Model, sight: Sight, plane: Plane, camera: Camera) -> list[tuple[Detection, Sight]]:
    """Every candidate on a plane, coarsely refined, with the sight reduced to that plane."""
    height = (sight.rims - plane.T[:3, 3]) @ plane.T[:3, 2]
    rims = sight.rims[np.abs(height) < NEAR_PLANE]
    if len(rims) < MIN_RIMS:
        return []
    near = replace(sight, rims=rims, surface=plane.points)
    few = replace(near, rims=rims[:: max(1, len(rims) // FEW_RIMS)], surface=plane.points[::5])
    poses = [refine(model, few, T, SCALES[:3]) for T in candidates(model, plane, rims)]
    return [(judge(model, few, fit, camera), near) for fit in poses]


def judge(model: Model, sight: Sight, fit: Fit, camera: Camera) -> Detection:
    """Measure how well a pose explains a sight, and how much of the board is seen there."""
    xy = on_front(fit.T, model.board, sight.rims)
    edges = model.edges(xy)
    eye_side = clear_of_walls(fit.T, model.board, xy, edges.outward)
    about = (edges.distance < 0.03) & eye_side  # where the board's side is in sight, the rim is its back's
    share = float((np.abs(edges.distance[about]) < ON_EDGE).mean()) if about.any() else 0.0
    off = model.edges(transform_points(invert(fit.T), sight.surface)[::4, :2]).distance
    near = off < 0.06
    contradicted = float((off[near] > IN_VOID).mean()) if near.any() else 1.0
    return Detection(
        fit, share * float((edges.distance < 0.03).mean()), _holes(model, fit.T, xy, camera), contradicted
    )


def _holes(model: Model, T: Float64, rims: Float64, camera: Camera) -> dict[str, float]:
    """Share of the samples of each hole's edge, in the image and with the front as silhouette, that a rim (N, 2) lies beside."""
    from scipy.spatial import cKDTree

    tree = cKDTree(rims)
    out = {}
    for hole in model.board.holes:
        at, outward = _edge_samples(hole.corners)
        seen = at[
            clear_of_walls(T, model.board, at, outward) & _in_image(T, at, model.board.thickness, camera)
        ]
        if len(seen) >= MIN_SAMPLES:
            gap, _ = tree.query(seen)
            out[hole.name] = float((gap < 2 * ON_EDGE).mean())
    return out


def _edge_samples(ring: Float64) -> tuple[Float64, Float64]:
    """Points (M, 2) along a hole's edge and the directions (M, 2) from the material into the hole."""
    ends = np.roll(ring, -1, axis=0)
    at, outward = [], []
    for a, b in zip(ring, ends, strict=True):
        n = max(1, round(float(np.linalg.norm(b - a)) / SAMPLES))
        at.append(a + (b - a) * ((np.arange(n) + 0.5) / n)[:, None])
        side = (b - a) / np.linalg.norm(b - a)
        outward.append(np.broadcast_to([-side[1], side[0]], (n, 2)))
    return np.concatenate(at), np.concatenate(outward)


def _in_image(T: Float64, xy: Float64, z: float, camera: Camera) -> NDArray[np.bool_]:
    pixel, depth = camera.project(transform_points(T, np.column_stack([xy, np.full(len(xy), z)])))
    with np.errstate(invalid="ignore"):
        low = (pixel > MARGIN).all(axis=1)
        high = (pixel < np.array([camera.width, camera.height]) - 1 - MARGIN).all(axis=1)
    return np.asarray(low & high & (depth > 0))


def _inner_rims(model: Model, sight: Sight, found: Detection) -> int:
    """Count rims well inside the outline, wherever the model has its holes."""
    xy = on_front(found.T_camera_board, model.board, sight.rims)
    within = inside(model.board.outline, xy) & (distance_to_ring(model.board.outline, xy) > 0.012)
    return int(within.sum())


def _check(found: Detection, board: Board, inner_rims: int) -> None:
    """Refuse a best pose that is none.

    Raises
    ------
    QualityError
        See :func:`detect`.
    """
    if inner_rims < MIN_RIMS / 3 or not found.holes:
        raise _refused(BoardRefusal.NO_HOLES, board, f"{inner_rims} rims inside its outline")
    missing = [name for name, share in found.holes.items() if share < FOUND]
    if len(missing) > (1 - HOLES) * len(found.holes):
        raise _refused(BoardRefusal.WRONG_BOARD, board, f"not there: {', '.join(missing)}")
    if found.explained < EXPLAINED:
        raise _refused(
            BoardRefusal.WRONG_BOARD, board, f"{100 * found.explained:.0f} % of the rims lie on its edges"
        )
    if found.contradicted > CONTRADICTED:
        share = 100 * found.contradicted
        raise _refused(
            BoardRefusal.WRONG_BOARD, board, f"{share:.0f} % of the surface lies where it has a hole or ends"
        )


def _refused(why: BoardRefusal, board: Board, detail: str) -> QualityError:
    hints = {
        BoardRefusal.NO_PLANE: "the board must fill the image's centre, a background at least 4 cm behind it",
        BoardRefusal.NO_HOLES: "a background at least 4 cm behind the cut-outs, lit; a plate without holes has no pose",
        BoardRefusal.AMBIGUOUS: "a board that no turn maps onto itself: tofcapture calibrate board",
        BoardRefusal.WRONG_BOARD: "two boards confused? check which TOML belongs to the board in front of the cameras",
    }
    return QualityError(f"board {board.name!r}: {why} ({detail})", hint=hints[why])
