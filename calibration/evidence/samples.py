"""Compute the residuals of an alignment anew, point by point, from the views of a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.alignment.rounds import RangeResidual
from calibration.range_error.error import SIMPLE
from calibration.registration.clouds import stereo_cloud, surface_points, tof_depth
from calibration.registration.gate import residuals
from calibration.registration.pairs import calibration_views
from calibration.registration.rims import rim_cloud, stereo_rims, tof_rims
from tofcapture.camera import Camera
from tofcapture.frames import View
from tofcapture.poses import Float64, check_transform, invert, transform

Progress = Callable[[str, int, int], None]
MOST_VIEWS = 24  # views that are read for the page, evenly; each costs a second
MOST_POINTS = 6000  # surface points per view


@dataclass(frozen=True)
class Samples:
    """Residuals of all views at the transform that was found, range residual taken off.

    Attributes
    ----------
    camera
        ToF intrinsics.
    pixel
        (N, 2) float64, u and v of each surface point in the ToF image.
    range, amplitude
        (N,) float64: metres along the ray; raw units at the highest modulation frequency.
    residual
        (N,) float64, metres, along the stereo surface's normal; positive where ToF measures too far.
    rims
        (M,) float64, metres, ToF rims across stereo rims, signed.
    poses, outlines
        Of the board in each view: (4, 4) ``T_tof_board`` (centroid, normal of the plane) and (32, 2) metres about it.
    """

    camera: Camera
    pixel: Float64
    range: Float64
    amplitude: Float64
    residual: Float64
    rims: Float64
    poses: list[Float64]
    outlines: list[Float64]


def sample_recording(recording: Path, evidence: Mapping[str, Any], progress: Progress) -> Samples:
    """Measure the residuals of a recording's views.

    Parameters
    ----------
    recording
        Folder with ``views/calibration``.
    evidence
        For ``T_tof_stereo``, ``range_residual`` and which views were used.
    progress
        Called with a stage, steps done and steps in all.

    Raises
    ------
    DataError
        No views, or unreadable ones.
    """
    from tofcapture.files.view import read_view

    T_stereo_tof = invert(check_transform(evidence["T_tof_stereo"], "evidence: T_tof_stereo"))
    paths = calibration_views(recording)
    refused = {Path(p["view"]).name for p in evidence["pairs"] if not p["accepted"]}
    good = [p for p in paths if p.name not in refused] or paths
    some = np.unique(np.linspace(0, len(good) - 1, MOST_VIEWS).round().astype(int))
    parts: list[Samples] = []
    for i in some:
        progress("evidence page", len(parts), len(some))
        parts.append(_sample(read_view(good[i]), T_stereo_tof, evidence))
    joined = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _ARRAYS}
    poses, outlines = [T for p in parts for T in p.poses], [o for p in parts for o in p.outlines]
    return Samples(camera=parts[0].camera, **joined, poses=poses, outlines=outlines)


_ARRAYS = ("pixel", "range", "amplitude", "residual", "rims")


def residual_from(evidence: Mapping[str, Any], camera: Camera) -> RangeResidual:
    """Read the range residual that an evidence states; none where it states none."""
    table = evidence.get("range_residual")
    if table is None:
        return RangeResidual(camera, 100e6)
    found = {"offset": table["offset"], "radius": table["per_pixel_radius"]}
    for m, a, b in table["harmonics"]:
        found |= {f"cos {m}": a, f"sin {m}": b}
    coefficients = np.array([found.get(name, 0.0) for name in SIMPLE])
    return RangeResidual(camera, float(table["modulation_hz"]), coefficients)


def _sample(view: View, T_stereo_tof: Float64, evidence: Mapping[str, Any]) -> Samples:
    camera = view.tof.info.camera
    phasor, depth = tof_depth(view.tof)
    raw = surface_points(view.tof, depth)
    raw = raw[:: max(1, len(raw) // MOST_POINTS)]
    points = residual_from(evidence, camera).correct(raw)
    found = residuals(points, stereo_cloud(view.stereo), T_stereo_tof)
    kept = raw[found.source]
    pixel, _ = camera.project(kept)
    column, row = np.rint(pixel).astype(int).T
    held = rim_cloud(stereo_rims(view.stereo.points), T_stereo_tof[:3, 3])
    rims = tof_rims(phasor, depth, camera).points
    across = residuals(rims, held, T_stereo_tof).distance if len(held) and len(rims) else np.zeros(0)
    boards = [_stand_in(points)] if len(points) > 3 else []
    return Samples(
        camera,
        pixel,
        np.linalg.norm(kept, axis=1),
        np.abs(phasor[-1])[row, column],
        -found.distance,
        across,
        [pose for pose, _ in boards],
        [outline for _, outline in boards],
    )


def _stand_in(points: Float64) -> tuple[Float64, Float64]:
    """Pose and outline (32, 2) of a plane's points (N, 3): an ellipse that covers what they cover, normal towards the camera."""
    centre = points.mean(axis=0)
    _, singular, axes = np.linalg.svd(points - centre, full_matrices=False)
    x, z = axes[0], axes[2] if axes[2] @ centre < 0 else -axes[2]
    half = 2 * singular[:2] / np.sqrt(len(points))
    angle = 2 * np.pi * np.arange(32) / 32
    outline = half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), centre), outline
