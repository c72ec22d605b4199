"""Cloud pairs of a recording: the calibration views, reduced to the points that are registered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Cloud, stereo_cloud, surface_points, tof_depth
from calibration.registration.rims import REPEAT, Rims, rim_cloud, stereo_rims, tof_rims
from tofcapture.errors import DataError
from tofcapture.files.disk import what_is
from tofcapture.files.view import find_views
from tofcapture.frames import View
from tofcapture.poses import Float64
from tofcapture.rig import Rig


@dataclass(frozen=True)
class Sighting:
    """Hold what both cameras of a view saw; every method of alignment starts from it."""

    #: (F, H, W) and (H, W) of the ToF burst, as of :func:`tof_depth`
    phasor: NDArray[np.complex128]
    depth: Float64
    surface: Float64  #: (N, 3) trusted ToF points, ToF frame, metres
    rims: Rims  #: Stereo rims, stereo frame
    cloud: Cloud  #: Dense cloud of the stereo camera, stereo frame


@dataclass(frozen=True)
class Pair:
    """Hold what one calibration view contributes."""

    #: Path of the view inside the recording, and digest of the file
    name: str
    sha256: str
    #: (N, 3) ToF points, ToF frame, metres: rims, each repeated ``REPEAT`` times as no library takes
    #: weights, then surface
    source: Float64
    target: Cloud  #: Rims and dense cloud of the stereo camera with normals, stereo frame
    rig: Rig  #: The rig as it was known when the view was taken
    modulation_hz: float  #: Highest modulation frequency of the ToF camera
    truth: Float64 | None  #: (4, 4) ``T_tof_stereo`` of a simulated view, else None


def calibration_views(recording: Path) -> list[Path]:
    """Find the sealed board views of a recording, in order; :class:`DataError` when there are none."""
    recording = Path(recording)
    folder = recording / "views" / "calibration"
    found = list(find_views(recording).get(folder.name, ()))
    if not found:
        to = "RECORDING" if recording.is_file() else recording
        raise DataError(
            f"{recording}: expected a recording with views of the board in {folder}, got {what_is(recording)}",
            hint=f"tofcapture record --calibration --out {to}; of imported data: tofcapture import BOARD --scene calibration --out {to}",
        )
    return found


def sighting_of(view: View) -> Sighting:
    """Decode a view and find its surfaces and stereo rims."""
    phasor, depth = tof_depth(view.tof)
    points = surface_points(view.tof, depth)
    return Sighting(phasor, depth, points, stereo_rims(view.stereo.points), stereo_cloud(view.stereo))


def pair_of(view: View, seen: Sighting, name: str, sha256: str) -> Pair:
    """Reduce a view to its pair of clouds."""
    info = view.tof.info
    rims = np.repeat(tof_rims(seen.phasor, seen.depth, info.camera).points, REPEAT, axis=0)
    held = rim_cloud(seen.rims, view.rig.T_stereo_tof[:3, 3])
    return Pair(
        name=name,
        sha256=sha256,
        source=np.concatenate([rims, seen.surface]),
        target=held + seen.cloud,
        rig=view.rig,
        modulation_hz=max(info.modulation_hz),
        truth=None if view.truth is None else view.truth.T_tof_stereo,
    )
