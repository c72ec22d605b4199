"""Tell what share of an object both cameras see: expected of a pose before anything moves, and measured of a view.

Nobody knows the object before it is looked at. Upright cans stand for it, closed and open ones, as high as the target is twice
above the table: one at the target, more around it, as far as the keep-out lets things stand. A point of a can counts by the
pixels that it fills of the ToF image. It is covered when both eyes of the stereo camera see it, from less aside than stereo can
measure, less what lies at a rim, where no ground truth is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices.clearance import COLUMN, WRIST, Workcell, body_of, segment_gap
from tofcapture.devices.kinematics import ArmModel, forward
from tofcapture.ops.crop import SAMPLE, crop_depth, find_crop
from tofcapture.ops.project import STEEPEST
from tofcapture.poses import Float64, invert_all
from tofcapture.rig import Rig

Bools = NDArray[np.bool_]

_AROUND = 5  # cans about the one at the target; what stands off the middle counts as much as it
_SPREAD = 0.55  # of the keep-out's radius: how far off they stand
_SLIM = 0.5  # of a can's height: its radius
_LOWEST = 0.03  # m; lower things are as good as flat
_SIDES, _RINGS = 12, 2  # points of a can's wall
_STEEPEST = np.cos(np.radians(78.0))  # what stereo sees from more aside it loses
_RIM = 1.8  # pixels of the ToF image along its outline that a thing loses: marked edges
_CHUNK = 400  # poses at a time
_CLEAR = 0.004  # m above the table: the nearest of the points in a pixel is none of the table's
_TOF_CLEAR = 0.02  # m above the table that no light from several ways makes a ToF camera err
_FEWEST = 100  # pixels of a thing of which a share is told


@dataclass(frozen=True)
class Cans:
    """Surface points of objects that stand for what nobody knows yet, base frame, metres."""

    points: Float64  #: (N, 3)
    normals: Float64  #: (N, 3) unit, outward of what is solid.
    areas: Float64  #: (N,)
    open: Bools  #: (N,) within an open can: seen through its mouth alone.
    middle: Float64  #: (N, 2) axis of the can.
    top: float  #: Height of the cans' mouths.
    radius: float

    @property
    def width(self) -> float:
        """What a can looks wide."""
        return 2 * self.radius


def stand_ins(workcell: Workcell) -> Cans:
    """Put cans where a station's objects stand."""
    height = max(2 * float(workcell.target[2] - workcell.table), _LOWEST)
    radius = _SLIM * height
    turn = 2 * np.pi * (np.arange(_SIDES) + 0.5) / _SIDES
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(_SIDES)])
    levels = (np.arange(_RINGS) + 0.5) / _RINGS
    wall = np.concatenate([radius * out + [0, 0, height * level] for level in levels])
    rings = np.sqrt((np.arange(2) + 0.5) / 2)
    disc = np.concatenate([radius * r * out[::2] for r in rings])
    sides, flat = np.tile(out, (_RINGS, 1)), np.tile([0.0, 0.0, 1.0], (len(disc), 1))
    side, top = 2 * np.pi * radius * height / len(wall), np.pi * radius**2 / len(disc)
    # Outside and lid of a closed can and of an open one: of lid and hollow each counts half.
    points = np.concatenate([wall, disc + np.array([0.0, 0.0, height]), wall, disc])
    normals = np.concatenate([sides, flat, -sides, flat])
    areas = np.repeat([side, top / 2, side / 2, top / 2], [len(wall), len(disc)] * 2)
    hollow = np.repeat([False, True], len(wall) + len(disc))
    about = 2 * np.pi * np.arange(_AROUND) / _AROUND
    around = _SPREAD * workcell.keep_out_radius * np.column_stack([np.cos(about), np.sin(about)])
    places = workcell.target[:2] + np.concatenate([np.zeros((1, 2)), around])
    weights = np.append(1.0, np.full(_AROUND, 1 / _AROUND))
    foot = np.column_stack([places, np.full(len(places), workcell.table)])
    return Cans(
        points=(foot[:, None] + points).reshape(-1, 3),
        normals=np.tile(normals, (len(places), 1)),
        areas=(weights[:, None] * areas).reshape(-1),
        open=np.tile(hollow, len(places)),
        middle=np.repeat(places, len(points), axis=0),
        top=workcell.table + height,
        radius=radius,
    )


def eyes(rig: Rig, workcell: Workcell) -> Float64:
    """Find the three eyes (3, 3) in the flange's frame: the ToF camera's, the stereo camera's left and right one.

    The right eye stands as far beyond the middle of the housing as the left one before it.
    """
    right = np.array([2 * float(workcell.stereo_box[:, 0].mean()), 0.0, 0.0, 1.0])
    mount = rig.T_flange_stereo
    return np.stack([rig.T_flange_tof[:3, 3], mount[:3, 3], (mount @ right)[:3]])


def expected(rig: Rig, workcell: Workcell, T_base_flange: Float64) -> Float64:
    """Tell what share (C,) of the cans' pixels in the ToF image has good ground truth, from flange poses (C, 4, 4)."""
    cans = stand_ins(workcell)
    parts = range(0, len(T_base_flange), _CHUNK)
    found = [_expected(cans, rig, workcell, T_base_flange[i : i + _CHUNK]) for i in parts]
    return np.concatenate(found) if found else np.zeros(0)


def _expected(cans: Cans, rig: Rig, workcell: Workcell, T_base_flange: Float64) -> Float64:
    places = T_base_flange[:, None, :3, :3] @ eyes(rig, workcell)[:, :, None]
    places = places[..., 0] + T_base_flange[:, None, :3, 3]  # (C, 3, 3)
    sights = [_seen(cans, places[:, k]) for k in range(3)]
    in_tof, _, depth = _pixels(rig.tof, T_base_flange @ rig.T_flange_tof, cans.points)
    in_left, column, away = _pixels(rig.stereo, T_base_flange @ rig.T_flange_stereo, cans.points)
    baseline = 2 * float(workcell.stereo_box[:, 0].mean())
    in_right = column - rig.stereo.fx * baseline / np.maximum(away, 1e-6) > -0.5
    pixels = cans.areas * np.clip(sights[0], 0.0, None) * in_tof / np.maximum(depth, 1e-6) ** 2
    covered = (sights[1] > _STEEPEST) & (sights[2] > 0) & in_left & in_right
    total = pixels.sum(axis=1)
    share = (pixels * covered).sum(axis=1) / np.maximum(total, 1e-12)
    distance = (pixels * depth).sum(axis=1) / np.maximum(total, 1e-12)
    rim = np.exp(-4 * _RIM * distance / (rig.tof.fx * cans.width))
    out: Float64 = np.where(total > 0, np.round(share * rim, 6), 0.0)
    return out


def _seen(cans: Cans, eye: Float64) -> Float64:
    """Find cosines (C, N) of the angles under which eyes (C, 3) see the points; 0 where they do not."""
    points, normals = cans.points, cans.normals
    away = (eye**2).sum(axis=1)[:, None] - 2 * eye @ points.T + (points**2).sum(axis=1)
    cosine = (eye @ normals.T - (points * normals).sum(axis=1)) / np.sqrt(np.maximum(away, 1e-12))
    # Where the way from an open can's inside crosses the plane of its mouth.
    part = (cans.top - points[:, 2]) / np.maximum(eye[:, 2, None] - points[:, 2], 1e-6)
    x, y = (points[:, k] + (eye[:, k, None] - points[:, k]) * part - cans.middle[:, k] for k in (0, 1))
    through = x**2 + y**2 < cans.radius**2
    out: Float64 = np.where(through | ~cans.open, np.maximum(cosine, 0.0), 0.0)
    return out


def _pixels(camera: Camera, T_base_camera: Float64, points: Float64) -> tuple[Bools, Float64, Float64]:
    """Tell which points (C, N) lie in a camera's image, their columns, and their depths."""
    back = invert_all(T_base_camera)
    local = back[:, :3, :3] @ points.T + back[:, :3, 3:]
    pixels, depth = camera.project(np.moveaxis(local, 1, 2))
    u, v = pixels[..., 0], pixels[..., 1]
    inside = (depth > 0) & (u > -0.5) & (u < camera.width - 0.5) & (v > -0.5) & (v < camera.height - 0.5)
    return inside, u, depth


def blocked(model: ArmModel, rig: Rig, workcell: Workcell, joints: Float64) -> Bools:
    """Tell at which joint angles (N, J) the arm, or what its base stands on, is between an eye and the target."""
    body = body_of(model, rig, workcell, joints)
    T_base_flange = forward(model, joints)
    places = T_base_flange[:, None, :3, :3] @ eyes(rig, workcell)[:, :, None]
    start = places[..., 0] + T_base_flange[:, None, :3, 3]
    sights = np.stack([start, np.broadcast_to(workcell.target, start.shape)], axis=-2)  # (N, 3, 2, 3)
    stand = np.array([[0.0, 0.0, workcell.table], [0.0, 0.0, 0.0]])
    pieces = range(body.arm.shape[1] - WRIST)
    gaps = [segment_gap(body.arm[:, None, i], sights) - body.radii[0][i] for i in pieces]
    gaps.append(segment_gap(stand, sights) - COLUMN)
    out: Bools = np.any(np.concatenate(gaps, axis=1) < 0, axis=1)
    return out


def covered(depth: NDArray[np.float32], points: Float64, camera: Camera, T_base_tof: Float64) -> float:
    """Tell what share of the object's pixels in the ToF image has good ground truth.

    The object is what stands on the table: of ``points`` (N, 3) of the stereo camera, ToF frame, or of the decoded ``depth``
    (H, W), metres, where there are none. A pixel is good with points in it and all around it, and without a step. NaN where
    there is no table, or too little on it.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    some = points[:: max(1, len(points) // SAMPLE)]
    crop = find_crop(some, T_base_tof[2, :3], np.random.default_rng(0))
    if not np.isfinite(crop.offset):
        return float("nan")
    seen = camera.nearest(points)
    there = np.isfinite(seen)

    def stands(image: NDArray[np.float32], clear: float) -> Bools:
        above = replace(crop, clearance=max(crop.clearance, clear))
        out: Bools = np.isfinite(crop_depth(above, image, camera))
        return out

    thing, hidden = stands(seen, _CLEAR), ~there & stands(depth, _TOF_CLEAR)
    if thing.sum() + hidden.sum() < _FEWEST:
        return float("nan")
    around = minimum_filter(there.view(np.uint8), 3) > 0
    beside = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=bool)
    near, far = minimum_filter(seen, footprint=beside), maximum_filter(seen, footprint=beside)
    # Steps as small as those between the pixels of 2x, on which the truth is judged.
    good = thing & around & (np.maximum(far - seen, seen - near) < STEEPEST / (2 * camera.fx) * seen)
    return float(good.sum() / (thing.sum() + hidden.sum()))
