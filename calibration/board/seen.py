"""Where a board stands, whatever its kind: by its cut-outs in rims, or by its corners in an image, with the surface beside both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.board.detector import (
    MIN_RIMS,
    NEAR_PLANE,
    SAMPLES,
    BoardRefusal,
    detect,
    refused,
    share_found,
    stereo_sight,
    tof_sight,
)
from calibration.board.fit import SCALES, Fit, Model, Sight, on_front, refine
from calibration.board.geometry import Board, sampled
from calibration.board.printed import corners_in, printed_pose
from calibration.registration.clouds import MAX_SIGMA, range_sigma, tof_depth
from tofcapture.camera import Camera
from tofcapture.errors import QualityError
from tofcapture.frames import StereoFrame, TofBurst
from tofcapture.poses import Float64, transform

CORNER_SIGMA = 0.1  # px, of a corner, to begin with: the corners' own scatter follows
LEAST_SIGMA = 0.02  # px; also what all corners of an image may be off by together
OUTLINE = 0.7  # least share of the outline in sight that has rims beside it
NUDGES = ((0.0, 0.0), (0.02, 0.0), (-0.02, 0.0), (0.0, 0.02), (0.0, -0.02))  # m on the board, of other starts
TURNED = "half a turn looks the same: take an odd and an even number of squares, or a ChArUco board"


@dataclass(frozen=True)
class Seen:
    """One board in one image."""

    fit: Fit  #: Pose ``T_camera_board`` and covariance
    pixels: Float64  #: (N, 2) rims or corners, image as it was taken
    at: Float64 | None  #: (N, 2) places of corners on the board, metres; None: rims lie on an edge


def seen_by_tof(burst: TofBurst, board: Board, camera: Camera) -> Seen:
    """Find a board in a ToF burst with a believed lens; :class:`QualityError` names why there is none."""
    burst = replace(burst, info=replace(burst.info, camera=camera))
    if board.pattern is None:
        sight = tof_sight(burst)
        fit = detect(sight, board, camera).fit
        height = (sight.rims - fit.T[:3, 3]) @ fit.T[:3, 2]
        return Seen(fit, camera.project(sight.rims[np.abs(height) < NEAR_PLANE])[0], None)
    phasor, depth = tof_depth(burst)
    # Not the piece in the middle: dark squares part it.
    bright = np.isfinite(depth) & (range_sigma(burst) < MAX_SIGMA)
    sight = Sight(np.zeros((0, 3)), camera.unproject(depth)[bright], sigma=0.003, bias_sigma=0.020)
    return seen_in_image(np.sqrt(np.abs(phasor[-1])), board, camera, sight)


def seen_in_image(image: NDArray[Any], board: Board, camera: Camera, beside: Sight) -> Seen:
    """Find a printed board in a grey image (H, W); ``beside`` holds what surfaces are known."""
    if board.pattern is None:
        raise QualityError(
            f"board {board.name!r} has nothing printed on it", hint="an image tells corners, not cut-outs"
        )
    pixels, at = corners_in(image, board.pattern)
    T = printed_pose(pixels, at, board, camera)
    sight = replace(
        _about(beside, board, T, NEAR_PLANE),
        rims=camera.rays_at(pixels),
        at=at,
        edge_sigma=CORNER_SIGMA * float(T[2, 3]) / np.sqrt(camera.fx * camera.fy),
    )
    fit = refine(Model(board), sight, T)
    left = float(np.median(np.abs(on_front(fit.T, board, sight.rims) - at)))
    least = LEAST_SIGMA / CORNER_SIGMA * sight.edge_sigma
    sight = replace(sight, edge_sigma=max(1.4826 * left, least), common_sigma=least)
    return Seen(refine(Model(board), sight, fit.T, SCALES[-1:]), pixels, at)


def _about(sight: Sight, board: Board, T: Float64, near: float) -> Sight:
    """Keep what lies within ``near`` metres of a board that stands at ``T_camera_board``."""
    low, high = board.outline.min(axis=0) - near, board.outline.max(axis=0) + near

    def kept(points: Float64) -> Float64:
        xyz = (points - T[:3, 3]) @ T[:3, :3]
        beside = ((xyz[:, :2] > low) & (xyz[:, :2] < high)).all(axis=1)
        out: Float64 = points[beside & (np.abs(xyz[:, 2] - board.thickness) < near)]
        return out

    return replace(sight, rims=kept(sight.rims), surface=kept(sight.surface))


def seen_by_stereo(frame: StereoFrame, board: Board, start: Float64 | None) -> Fit:
    """Find a board in an organised cloud.

    One without cut-outs is held by its outline and plane, which half a turn may leave as they are. It needs a ``start`` (4, 4), good to
    2 cm and 4 degrees. :class:`QualityError` names why there is none.
    """
    sight = stereo_sight(frame)
    if board.holes or board.pattern is None:
        return detect(sight, board, frame.info.camera).fit
    if start is None:
        raise refused(BoardRefusal.NO_HOLES, board, "the other camera does not say where it is")
    share = 0.0
    for x, y in NUDGES:  # a side that lies beside a rim of another thing may hold a fit there
        share, fit = _by_outline(sight, board, start @ transform(np.eye(3), [x, y, 0.0]), frame.info.camera)
        if share >= OUTLINE:
            return fit
    detail = f"{100 * share:.0f} % of its outline in sight has rims beside it"
    raise refused(BoardRefusal.WRONG_BOARD, board, detail)


def _by_outline(sight: Sight, board: Board, start: Float64, camera: Camera) -> tuple[float, Fit]:
    """Fit a plate from a start (4, 4); before the fit the share of the outline in sight that is found."""
    model = Model(replace(board, holes=()))
    for near in (2 * NEAR_PLANE, NEAR_PLANE / 2):
        own = _about(sight, board, start, near)
        if len(own.rims) < MIN_RIMS:
            raise refused(BoardRefusal.NO_PLANE, board, f"{len(own.rims)} rims about its outline")
        fit = refine(model, own, start)
        start = fit.T
    at, right = sampled(board.outline, SAMPLES)
    share = share_found(board, fit.T, at, -right, on_front(fit.T, board, own.rims), camera)
    return share if np.isfinite(share) else 0.0, fit


def must_be_unique(board: Board) -> None:
    """Refuse a board whose pose half a turn leaves open (:class:`QualityError`)."""
    if board.pattern is not None and board.pattern.half_turn:
        raise QualityError(f"board {board.name!r}: {BoardRefusal.AMBIGUOUS}", hint=TURNED)
