"""Draw the way from what was captured to ground truth: the clouds of one view, step by step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import GROUND_TRUTH, REMOVED, SENSOR
from tofcapture.dataset.sample import SampleConfig, check_cameras, decoder_for
from tofcapture.dataset.surface import find_object
from tofcapture.errors import DataError
from tofcapture.files.view import open_view
from tofcapture.frames import View
from tofcapture.ops.crop import crop_depth
from tofcapture.ops.denoise import denoise
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.sheet import Cell, Column, draw_table
from tofcapture.viz.shots import Eye, eye_for, splat
from tofcapture.viz.sources import pick_view

_CONFIG = SampleConfig()
_AROUND = 2.5  # radii of the object that are shown around it before it is cropped
_TOF, _STEREO, _NOISE = (SENSOR, "ToF"), (GROUND_TRUTH, "stereo"), (REMOVED, "noise to be removed")


@dataclass(frozen=True)
class Steps:
    """Clouds (N, 3) of one view in the ToF frame, metres, and how far apart sensor and stereo are.

    Stereo is placed by the view's own rig and by the calibrated one; of the object, denoising keeps some points and
    removes others. ``before`` and ``after`` are medians of the distance in depth at the sensor's pixels, metres.
    """

    tof: Float64
    captured: Float64
    aligned: Float64
    kept: Float64
    removed: Float64
    before: float
    after: float


def draw_preprocessing(figure: Any, path: Path, scene: str | None, view: int | None, rig: Path | None) -> str:
    """Draw the steps of a view file, or of a recording's view; returns what is on it, in words.

    Without a ``rig`` that of the recording is used.

    Raises :class:`DataError`: there is no such view, no calibrated rig, nothing is left of the view, or the
    rig is of other cameras.
    """
    chosen = pick_view(path, scene, view)
    used = rig or chosen.resolve().parents[2] / "rig.toml"
    if not used.exists():
        raise DataError(
            f"{chosen}: no calibrated rig: {used} does not exist",
            hint="tofcapture align RECORDING, or --rig rig.toml",
        )
    found, constants = open_view(chosen), load_rig(used)
    steps = preprocess(found, constants)
    T = found.arm_before.T_base_flange @ constants.T_flange_tof
    name = f"{found.scene} {found.index}"
    draw_table(figure, f"Pre-processing of {name}", [""], _columns(steps, T), 1.0)
    gaps = f"clouds {1e3 * steps.before:.2f} mm apart before, {1e3 * steps.after:.2f} mm after alignment"
    return f"{name}: {gaps}; {len(steps.kept)} points kept, {len(steps.removed)} removed as noise"


def preprocess(view: View, rig: Rig) -> Steps:
    """Align, crop and denoise a view with a calibrated rig and the stages of the dataset.

    Raises :class:`DataError`: the rig is of other cameras, or nothing is left.
    """
    check_cameras(view, rig)
    decoded = decoder_for(view, rig).burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    tof = rig.tof.unproject(np.where(decoded.depth < _CONFIG.far, decoded.depth, np.nan))
    measured = np.ascontiguousarray(view.stereo.points[..., 2])
    clean = denoise(measured, rig.stereo)
    native = np.where(clean, measured, np.float32(np.nan))
    crop = find_object(view, native, rig, _CONFIG.reach, np.random.default_rng(view.index))
    there = np.isfinite(crop_depth(crop, measured, rig.stereo, rig.T_tof_stereo))
    if not (there & clean).any():
        raise DataError(
            f"{view.scene} {view.index}: no stereo point is left of the object", hint="check the rig"
        )
    points = rig.stereo.unproject(measured)
    captured, aligned = (_moved(points, T) for T in (view.rig.T_tof_stereo, rig.T_tof_stereo))
    return Steps(
        tof.reshape(-1, 3),
        captured,
        aligned,
        _moved(points[there & clean], rig.T_tof_stereo),
        _moved(points[there & ~clean], rig.T_tof_stereo),
        gap(captured, tof[..., 2], rig),
        gap(aligned, tof[..., 2], rig),
    )


def _moved(points: NDArray[Any], T_tof_stereo: Float64) -> Float64:
    found = transform_points(T_tof_stereo, points).reshape(-1, 3)
    return found[(found[:, 2] > 0) & (found[:, 2] < _CONFIG.far)]


def gap(stereo: Float64, depth: NDArray[np.floating], rig: Rig) -> float:
    """Median of |ToF - stereo| in depth, metres, of points (N, 3) in the ToF frame and depth (H, W); NaN without a common pixel."""
    pixels, z = rig.tof.project(stereo)
    at = np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.intp)
    height, width = depth.shape
    keep = (at[:, 0] >= 0) & (at[:, 0] < width) & (at[:, 1] >= 0) & (at[:, 1] < height) & (z > 0)
    nearest = np.full(depth.size, np.inf)
    np.minimum.at(nearest, at[keep, 1] * width + at[keep, 0], z[keep])
    apart = np.abs(depth.ravel() - nearest)
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if apart.size else float("nan")


def _columns(steps: Steps, T_base_tof: Float64) -> list[Column]:
    centre = np.median(steps.kept, axis=0)
    reach = _AROUND * np.percentile(np.linalg.norm(steps.kept - centre, axis=1), 95)
    about = steps.aligned[np.linalg.norm(steps.aligned - centre, axis=1) < reach]
    whole, near = (eye_for(p, T_base_tof, 1.0) for p in (about, steps.kept))
    tof, kept, removed = (steps.tof, SENSOR), (steps.kept, GROUND_TRUTH), (steps.removed, REMOVED)
    noise = f"{len(steps.removed)} of {len(steps.kept) + len(steps.removed)} points"

    def column(title: str, note: str, eye: Eye, clouds: Any, *key: Any) -> Column:
        return Column(title, [Cell(splat(clouds, eye, 480, 4), note=note)], key)

    gaps = [f"median gap {1e3 * metres:.1f} mm" for metres in (steps.before, steps.after)]
    captured, aligned = ([tof, (cloud, GROUND_TRUTH)] for cloud in (steps.captured, steps.aligned))
    return [
        column("captured, as mounted", gaps[0], whole, captured, _TOF, _STEREO),
        column("aligned", gaps[1], whole, aligned, _TOF, _STEREO),
        column("cropped", f"red: {noise}", near, [kept, removed], _STEREO, _NOISE),
        column("denoised", f"{len(steps.kept)} points", near, [kept], (GROUND_TRUTH, "ground truth")),
    ]
