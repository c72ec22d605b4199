"""From what was captured to ground truth: the clouds of one view, step by step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.files.view import read_view
from tofcapture.frames import View
from tofcapture.ops.crop import crop_depth, find_crop
from tofcapture.ops.denoise import denoise
from tofcapture.ops.phase import Decoder
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.colours import GROUND_TRUTH, SENSOR
from tofcapture.viz.figures.clouds import splat, stage_for
from tofcapture.viz.figures.recording import pick_view
from tofcapture.viz.figures.table import Cell, Column, draw_table

FAR = 2.0  # m; what lies beyond is no object
RADIUS = 0.35  # m around what the camera looks at, along the table
REMOVED = (213, 94, 0)  # vermilion
_SPARSE = 4  # pixels of the stereo grid between points that vote for the table
_ASPECT = 1.0
_WIDTH = 480  # pixels of a cloud's picture
_AROUND = 2.5  # radii of the object that are shown around it before it is cropped


@dataclass(frozen=True)
class Steps:
    """Clouds (N, 3) of one view in the ToF frame, metres.

    Attributes
    ----------
    tof
        Everything that the sensor decoded.
    captured, aligned, cropped, denoised
        Stereo with the rig that the view was taken with, with the calibrated one, what the crop keeps, and of that what
        denoising keeps.
    removed
        What denoising takes out.
    before, after
        Median of the distance in depth between both clouds at the sensor's pixels, metres.
    """

    tof: Float64
    captured: Float64
    aligned: Float64
    cropped: Float64
    denoised: Float64
    removed: Float64
    before: float
    after: float


def draw_preprocessing(figure: Any, path: Path, scene: str | None, view: int | None, rig: Path | None) -> str:
    """Draw the steps of one view.

    Parameters
    ----------
    figure
        Of matplotlib.
    path
        View file, or a recording.
    scene, view
        Which of a recording's; ``None``: the first.
    rig
        ``rig.toml``; ``None``: the one of the recording that the view lies in.

    Returns
    -------
    What is on it, in words.

    Raises
    ------
    DataError
        There is no such view, no calibrated rig, nothing is left of the view, or the rig is of other cameras.
    """
    chosen = pick_view(path, scene, view)
    used = rig or chosen.resolve().parents[2] / "rig.toml"
    if not used.exists():
        raise DataError(
            f"{chosen}: no calibrated rig: {used} does not exist",
            hint="tofcapture align RECORDING, or --rig rig.toml",
        )
    found = read_view(chosen)
    calibrated = load_rig(used)
    steps = preprocess(found, calibrated)
    T = found.arm_before.T_base_flange @ calibrated.T_flange_tof
    name = f"{found.scene} {found.index}"
    draw_table(figure, f"Pre-processing of {name}", [""], _columns(steps, T), _ASPECT)
    words = (
        f"{name}: clouds {1e3 * steps.before:.2f} mm apart before, {1e3 * steps.after:.2f} mm after alignment"
    )
    return f"{words}; {len(steps.denoised)} points kept, {len(steps.removed)} removed as noise"


def preprocess(view: View, rig: Rig) -> Steps:
    """Align, crop and denoise a view.

    Parameters
    ----------
    view
        As it was captured.
    rig
        Calibrated constants.

    Raises
    ------
    DataError
        The rig is of other cameras, or nothing is left.
    """
    for name, found, expected in (
        ("ToF", view.tof.info.camera.shape, rig.tof.shape),
        ("stereo", view.stereo.info.camera.shape, rig.stereo.shape),
    ):
        if found != expected:
            raise DataError(
                f"{view.scene} {view.index}: expected {name} images of {expected} as the rig says, got {found}",
                hint="is it the rig of another station?",
            )
    tof, depth = _decoded(view, rig), view.stereo.points[..., 2]
    keep = denoise(np.ascontiguousarray(depth), rig.stereo)
    clean = np.where(keep, depth, np.float32(np.nan))
    sparse = clean[::_SPARSE, ::_SPARSE, None] * rig.stereo.rays[::_SPARSE, ::_SPARSE]
    up = (view.arm_before.T_base_flange @ rig.T_flange_tof)[2, :3]
    crop = find_crop(
        transform_points(rig.T_tof_stereo, sparse), up, np.random.default_rng(view.index), RADIUS, FAR
    )
    cropped = crop_depth(crop, np.asarray(depth), rig.stereo, rig.T_tof_stereo)
    there = np.isfinite(cropped)
    if not (there & keep).any():
        raise DataError(
            f"{view.scene} {view.index}: no stereo point is left of the object", hint="check the rig"
        )
    points = rig.stereo.unproject(cropped)
    everything = rig.stereo.unproject(depth)
    return Steps(
        tof.reshape(-1, 3),
        captured := _placed(everything, view.rig.T_tof_stereo),
        aligned := _placed(everything, rig.T_tof_stereo),
        _placed(points, rig.T_tof_stereo),
        _placed(points[there & keep][None], rig.T_tof_stereo),
        _placed(points[there & ~keep][None], rig.T_tof_stereo),
        gap(captured, tof[..., 2], rig),
        gap(aligned, tof[..., 2], rig),
    )


def _decoded(view: View, rig: Rig) -> Float64:
    """(H, W, 3) points of the burst with the rig's constants."""
    info = view.tof.info
    errors = rig.range_errors or info.range_errors
    info = replace(info, camera=rig.tof, illuminator=rig.illuminator, range_errors=errors)
    depth = Decoder(info).burst(view.tof.raw, float(np.mean(view.tof.celsius))).depth
    return rig.tof.unproject(np.where(depth < FAR, depth, np.nan))


def _placed(points: NDArray[Any], T_tof_stereo: Float64) -> Float64:
    found = transform_points(T_tof_stereo, points).reshape(-1, 3)
    return found[(found[:, 2] > 0) & (found[:, 2] < FAR)]


def gap(stereo: Float64, depth: NDArray[np.floating], rig: Rig) -> float:
    """Median of |ToF - stereo| over the sensor's pixels, metres; NaN where no pixel has both.

    Parameters
    ----------
    stereo
        (N, 3) points in the ToF frame.
    depth
        (H, W) of the sensor.
    rig
        Whose ToF camera it is.
    """
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
    centre = np.median(steps.denoised, axis=0)
    reach = _AROUND * np.percentile(np.linalg.norm(steps.denoised - centre, axis=1), 95)
    about = steps.aligned[np.linalg.norm(steps.aligned - centre, axis=1) < reach]
    whole, near = (stage_for(p, T_base_tof, _ASPECT) for p in (about, steps.denoised))
    both = "orange: ToF; blue: stereo"

    def cell(stage: Any, note: str, *clouds: Any) -> list[Cell]:
        return [Cell(splat(clouds, stage, _WIDTH, 4), note=note)]

    tof = (steps.tof, SENSOR)
    kept, gone = (steps.denoised, GROUND_TRUTH), (steps.removed, REMOVED)
    shares = f"{len(steps.removed)} of {len(steps.cropped)} points"
    return [
        Column(
            "captured, as mounted",
            cell(whole, f"median gap {1e3 * steps.before:.1f} mm", tof, (steps.captured, GROUND_TRUTH)),
            both,
        ),
        Column(
            "aligned",
            cell(whole, f"median gap {1e3 * steps.after:.1f} mm", tof, (steps.aligned, GROUND_TRUTH)),
            both,
        ),
        Column(
            "cropped", cell(near, f"red: {shares}", kept, gone), "blue: stereo;\nred: noise to be removed"
        ),
        Column("denoised", cell(near, f"{len(steps.denoised)} points", kept), "blue: ground truth"),
    ]
