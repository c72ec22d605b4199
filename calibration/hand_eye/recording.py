"""Pairs for hand-eye from a calibration recording, without any target detector.

The scene stands still while the arm moves, so registering the stereo cloud of a view into that of another is the motion of the
camera. One view's stereo frame serves as the target: what the scene is does not matter, only that it is rigid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibration.registration.backends import FINE, register
from calibration.registration.clouds import Cloud, stereo_cloud
from calibration.registration.gate import Refusal, check_registration
from calibration.registration.pairs import calibration_views
from calibration.registration.rims import REPEAT, rim_cloud, stereo_rims
from tofcapture.errors import QualityError
from tofcapture.pool import Pool
from tofcapture.poses import Float64, invert

SURFACE_POINTS = 40_000  # of the moving cloud; the fixed one stays dense
STAGES = (0.040, *FINE)  # m; arm poses and the rig's last calibration start it within centimetres


@dataclass(frozen=True)
class _Seen:
    hand: Float64
    camera: Float64  # believed T_base_stereo
    cloud: Cloud
    rims: Float64


def recording_pairs(
    recording: Path, progress: Callable[[str, int, int], None] = lambda _stage, _done, _total: None
) -> tuple[Float64, Float64]:
    """Hand poses, and the pose of the first view's stereo frame in every view's stereo camera.

    Parameters
    ----------
    recording
        Folder with ``views/calibration/view-*.h5``.
    progress
        Called with a stage, steps done and steps in all.

    Returns
    -------
    hand
        (N, 4, 4) T_base_flange of the views that registered.
    target
        (N, 4, 4) T_stereo_target.

    Raises
    ------
    DataError
        No or unreadable views.
    QualityError
        Fewer than three views register.
    """
    paths = calibration_views(recording)
    fixed, hand, target, refused = _seen(paths[0]), [], [], []
    with Pool(1, pinned=True) as pool:
        for i, path in enumerate(paths):
            progress("registering", i, len(paths))
            view = fixed if i == 0 else _seen(path)
            guess = invert(fixed.camera) @ view.camera
            source = _source(view)
            result = pool.call(register, "open3d", source, fixed.cloud, guess, STAGES)
            refusal = check_registration(result, source, fixed.cloud, guess)
            if refusal in (None, Refusal.POOR_FIT):  # what one view sees and the other does not is no misfit
                hand.append(view.hand)
                target.append(invert(result.T_target_source))
            else:
                refused.append(f"{path.stem} {refusal}")
    if len(hand) < 3:
        raise QualityError(
            f"{recording}: expected at least 3 views that register, got {len(hand)}: {', '.join(refused)}",
            hint="record board views that overlap, or correct the rig the recording started from",
        )
    return np.stack(hand), np.stack(target)


def _seen(path: Path) -> _Seen:
    from tofcapture.files.view import read_view

    view = read_view(path)
    held = rim_cloud(stereo_rims(view.stereo.points), np.zeros(3))
    cloud = held + stereo_cloud(view.stereo)
    hand = view.arm_before.T_base_flange
    return _Seen(hand, hand @ view.rig.T_flange_stereo, cloud, held.points)


def _source(view: _Seen) -> Float64:
    surface = view.cloud.points[len(view.rims) :]
    thin = surface[:: max(1, len(surface) // SURFACE_POINTS)]
    return np.concatenate([np.repeat(view.rims[:: max(1, len(view.rims) // 2000)], REPEAT, axis=0), thin])
