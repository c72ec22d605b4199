"""Find a board of known geometry in what one camera sees: its pose with covariance, or a refusal by name.

Candidates come from all turns and places of the model on the planes of the cloud, by correlation. The model is fitted as a whole,
outline and cut-outs together; no circle is searched for. The same code serves both cameras: a ToF burst and a stereo frame are both
reduced to rims and surface points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from calibration.board.fit import PITCH, SCALES, Fit, Model, Sight, clear_of_walls, on_front, refine
from calibration.board.geometry import Board, distance_to_ring, sampled
from calibration.registration.clouds import stereo_cloud, surface_points, tof_depth
from calibration.registration.rims import stereo_rims, tof_rims
from tofcapture.camera import Camera
from tofcapture.errors import QualityError
from tofcapture.frames import StereoFrame, TofBurst
from tofcapture.meshes import inside
from tofcapture.poses import Float64, invert, rotation_angle, rotation_exp, transform, transform_points

# Planes, and candidates on them.
SEEDS = 120  # points whose surroundings propose a plane
NEIGHBOURS = 120
MOST_POINTS = 6000  # of a cloud, evenly
MOST_PLANES = 3
CELL = 0.008  # m
CELLS = 128
TURNS = 72  # 5 deg apart
BLUR = 0.010  # m; half a turn's step at a quarter of a metre
VOID = 1.5  # how much a surface point in a hole counts against one on the plate
CANDIDATES = 4
DISTINCT = (0.030, np.radians(12.0))  # m and rad between candidates

# What a pose must explain.
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


HINTS = {
    BoardRefusal.NO_PLANE: "the board must fill the image's centre, a background at least 4 cm behind it",
    BoardRefusal.NO_HOLES: "a background at least 4 cm behind the cut-outs, lit; a plate without holes has no pose",
    BoardRefusal.AMBIGUOUS: "a board that no turn maps onto itself: tofcapture calibrate board",
    BoardRefusal.WRONG_BOARD: "two boards confused? check which TOML belongs to the board in front of the cameras",
}


@dataclass(frozen=True)
class Detection:
    """A board's pose."""

    fit: Fit  #: Pose ``T_camera_board`` and covariance
    explained: float  #: Share of the rims on the board's plane that lie on a model edge
    #: Name -> share of its edge in sight that has a rim; holes out of sight are left out
    holes: dict[str, float]
    contradicted: float  #: Share of the plane's points about the board that lie where the model has none

    @property
    def T_camera_board(self) -> Float64:
        """(4, 4)."""
        return self.fit.T

    @property
    def score(self) -> float:
        """Tell what candidates are compared by: how much of the sight the model explains, and of the model is seen."""
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
    rims = stereo_rims(frame.points).points
    return Sight(rims, stereo_cloud(frame).points, sigma=0.0007, bias_sigma=0.0003)


def detect(sight: Sight, board: Board, camera: Camera) -> Detection:
    """Find a board.

    The sight's ranges may be wrong by a centimetre in common; the camera's intrinsics say what lies in the image.

    :class:`QualityError` where no pose is certain, named by a :class:`BoardRefusal`.
    """
    model = Model(board)
    thin = replace(sight, rims=sight.rims[:: max(1, len(sight.rims) // MOST_RIMS)])
    found: list[tuple[Detection, Sight]] = []
    for T_camera_plane, points in _planes(sight.surface, 2.5 * sight.sigma):
        found += _tried(model, thin, T_camera_plane, points, camera)
        if any(d.certain for d, _ in found):
            break
    if not found:
        raise refused(BoardRefusal.NO_PLANE, board, f"no plane with {MIN_RIMS} rims on it")
    found.sort(key=lambda item: -item[0].score)
    first, on_plane = found[0]
    best = _explained(model, on_plane, refine(model, on_plane, first.T_camera_board), camera)
    _check(model, on_plane, best)
    for rival, _ in found[1:]:
        metres, radians = _distance(best.T_camera_board, rival.T_camera_board, np.array([*board.middle, 0.0]))
        if (metres > APART[0] or radians > APART[1]) and rival.score > RIVAL * first.score:
            detail = f"another pose, {np.degrees(radians):.0f} deg away, fits as well"
            raise refused(BoardRefusal.AMBIGUOUS, board, detail)
    return best


def _tried(
    model: Model, sight: Sight, plane: Float64, points: Float64, camera: Camera
) -> list[tuple[Detection, Sight]]:
    """Every candidate on a plane, coarsely refined, with the sight reduced to that plane."""
    rims = sight.rims[np.abs(_height(plane, sight.rims)) < NEAR_PLANE]
    if len(rims) < MIN_RIMS:
        return []
    near = replace(sight, rims=rims, surface=points)
    few = replace(near, rims=rims[:: max(1, len(rims) // FEW_RIMS)], surface=points[::5])
    poses = [refine(model, few, T, SCALES[:3]) for T in _candidates(model, plane, points, rims)]
    return [(_explained(model, few, fit, camera), near) for fit in poses]


def _planes(points: Float64, tolerance: float) -> list[tuple[Float64, Float64]]:
    """The largest planes of a cloud (N, 3), largest first: frame (4, 4) with z towards the camera, and the points (K, 3) on it.

    Every seed's surroundings propose a plane; no chance is involved.
    """
    from scipy.spatial import cKDTree

    left = points[:: max(1, len(points) // MOST_POINTS)]
    found: list[tuple[Float64, Float64]] = []
    while len(found) < MOST_PLANES and len(left) >= 4 * NEIGHBOURS:
        _, near = cKDTree(left).query(left[:: max(1, len(left) // SEEDS)], NEIGHBOURS)
        frames = [_plane_frame(left[i]) for i in near]
        counts = [int((np.abs(_height(T, left)) < 2 * tolerance).sum()) for T in frames]
        T = frames[int(np.argmax(counts))]
        for width in (2.0, 1.5, 1.0, 1.0):
            on = np.abs(_height(T, left)) < width * tolerance
            if on.sum() < NEIGHBOURS:
                break
            T = _plane_frame(left[on])
        on = np.abs(_height(T, left)) < 1.5 * tolerance
        if on.sum() < NEIGHBOURS:
            break
        found.append((T, left[on]))
        left = left[np.abs(_height(T, left)) > 3 * tolerance]
    return found


def _height(T: Float64, points: Float64) -> Float64:
    out: Float64 = (points - T[:3, 3]) @ T[:3, 2]
    return out


def _plane_frame(points: Float64) -> Float64:
    """Frame (4, 4) of the plane of points (N, 3): centroid, z along the normal that faces the camera."""
    centre = points.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points - centre).T))
    z = axes[:, 0] if axes[:, 0] @ centre < 0 else -axes[:, 0]
    x = axes[:, 2]
    return transform(np.stack([x, np.cross(z, x), z], axis=1), centre)


def _candidates(model: Model, plane: Float64, surface: Float64, rims: Float64) -> list[Float64]:
    """Poses ``T_camera_board`` on a plane worth refining, best first: both sides, all turns, all places."""
    grids = [_occupancy(plane, rims), _occupancy(plane, surface)]
    F_rim, F_surface = (np.conj(np.fft.rfft2(g / max(g.sum(), 1.0))) for g in grids)
    scored = []
    for visible in (np.eye(3), np.diag([1.0, -1.0, -1.0])):  # the front, the back
        middle = np.array([*model.board.middle, model.board.thickness if visible[2, 2] > 0 else 0.0])
        for turn in range(TURNS):
            R = rotation_exp([0.0, 0.0, 2 * np.pi * turn / TURNS]) @ visible
            local = transform(
                R, -R @ middle
            )  # the outline's centre over the origin, the visible face at z = 0
            edge, solid = _fields(model, local)
            overlap = np.conj(F_rim * np.fft.rfft2(edge) + 0.5 * F_surface * np.fft.rfft2(solid))
            score = np.fft.irfft2(overlap, s=(CELLS, CELLS))
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            shift = np.array([column, row], dtype=np.float64)
            local[:2, 3] += CELL * (shift - CELLS * (shift >= CELLS / 2))
            scored.append((float(score[row, column]), plane @ local))
    scored.sort(key=lambda item: -item[0])
    centre = np.array([*model.board.outline.mean(axis=0), 0.0])
    kept: list[Float64] = []
    for _, T in scored:
        gaps = [_distance(T, other, centre) for other in kept]
        if all(metres > DISTINCT[0] or radians > DISTINCT[1] for metres, radians in gaps):
            kept.append(T)
        if len(kept) == CANDIDATES:
            break
    return kept


def _occupancy(plane: Float64, points: Float64) -> Float64:
    """Which cells (CELLS, CELLS) of the plane hold points (N, 3), as 0 and 1."""
    xy = (points - plane[:3, 3]) @ plane[:3, :2]
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
    place = ((xy - local[:2, 3]) @ local[:2, :2] - low) / PITCH
    sdf = map_coordinates(table, place[:, ::-1].T, order=1, mode="nearest").reshape(CELLS, CELLS)
    return np.exp(-np.square(sdf / BLUR)), np.clip(-sdf / CELL, -VOID, 1.0)


def _distance(a: Float64, b: Float64, point: Float64) -> tuple[float, float]:
    """Tell how far two poses differ: metres at a point (3,) of the board, and radians."""
    moved = transform_points(a, point) - transform_points(b, point)
    return float(np.linalg.norm(moved)), rotation_angle(invert(a) @ b)


def _explained(model: Model, sight: Sight, fit: Fit, camera: Camera) -> Detection:
    """Measure how well a pose explains a sight, and how much of the board is seen there."""
    xy = on_front(fit.T, model.board, sight.rims)
    edges = model.edges(xy)
    eye_side = clear_of_walls(fit.T, model.board, xy, edges.outward)
    about = (edges.distance < 0.03) & eye_side  # where the board's side is in sight, the rim is its back's
    share = float((np.abs(edges.distance[about]) < ON_EDGE).mean()) if about.any() else 0.0
    off = model.edges(transform_points(invert(fit.T), sight.surface)[::4, :2]).distance
    near = off < 0.06
    contradicted = float((off[near] > IN_VOID).mean()) if near.any() else 1.0
    explained = share * float((edges.distance < 0.03).mean())
    return Detection(fit, explained, _holes(model.board, fit.T, xy, camera), contradicted)


def _holes(board: Board, T: Float64, rims: Float64, camera: Camera) -> dict[str, float]:
    """Share of each hole's edge in sight that a rim (N, 2) lies beside."""
    shares = {
        hole.name: share_found(board, T, *sampled(hole.corners, SAMPLES), rims, camera)
        for hole in board.holes
    }
    return {name: share for name, share in shares.items() if np.isfinite(share)}


def share_found(
    board: Board, T: Float64, at: Float64, inward: Float64, rims: Float64, camera: Camera
) -> float:
    """Share of an edge's samples (N, 2), in the image and with the front as silhouette, that a rim (M, 2) lies beside.

    ``inward`` (N, 2) points into the material. NaN where too few samples are in sight.
    """
    from scipy.spatial import cKDTree

    pixel, depth = camera.project(
        transform_points(T, np.column_stack([at, np.full(len(at), board.thickness)]))
    )
    with np.errstate(invalid="ignore"):
        in_image = (pixel > MARGIN) & (pixel < np.array([camera.width, camera.height]) - 1 - MARGIN)
    seen = at[clear_of_walls(T, board, at, -inward) & in_image.all(axis=1) & (depth > 0)]
    if len(seen) < MIN_SAMPLES:
        return float("nan")
    gap, _ = cKDTree(rims).query(seen)
    return float((gap < 2 * ON_EDGE).mean())


def _check(model: Model, sight: Sight, found: Detection) -> None:
    """Refuse a best pose that is none (:class:`QualityError`)."""
    board = model.board
    xy = on_front(found.T_camera_board, board, sight.rims)
    # Rims well inside the outline, wherever the model has its holes.
    inner = int((inside(board.outline, xy) & (distance_to_ring(board.outline, xy) > 0.012)).sum())
    if inner < MIN_RIMS / 3 or not found.holes:
        raise refused(BoardRefusal.NO_HOLES, board, f"{inner} rims inside its outline")
    missing = [name for name, share in found.holes.items() if share < FOUND]
    wrong = ""
    if len(missing) > (1 - HOLES) * len(found.holes):
        wrong = f"not there: {', '.join(missing)}"
    elif found.explained < EXPLAINED:
        wrong = f"{100 * found.explained:.0f} % of the rims lie on its edges"
    elif found.contradicted > CONTRADICTED:
        wrong = f"{100 * found.contradicted:.0f} % of the surface lies where it has a hole or ends"
    if wrong:
        raise refused(BoardRefusal.WRONG_BOARD, board, wrong)


def refused(why: BoardRefusal, board: Board, detail: str) -> QualityError:
    """Say why no pose is reported."""
    return QualityError(f"board {board.name!r}: {why} ({detail})", hint=HINTS[why])
