"""The bundle of both cameras, the board and the arm: truth within the stated sigmas, derivatives, refusals by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibration.bundle import ARM_SIGMA, BoardFit, bundle_report, consistency, solve_bundle
from calibration.cli.hand_eye import bundle_table
from calibration.hand_eye.checks import Cause, HandEyeRefused
from tests import answers
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.errors import QualityError
from tofcapture.rig import Rig

X_TOF = poses.transform(poses.rotation_exp([0.1, -0.3, 1.2]), [0.05, 0.02, 0.09])
X_STEREO = X_TOF @ poses.transform(poses.rotation_exp([0.045, 0.012, 0.009]), [-0.05, 0.075, 0.004])
BOARD = poses.transform(poses.rotation_exp([3.0, 0.2, 0.3]), [0.7, 0.0, -0.22])
TRUTH = (X_TOF, X_STEREO, BOARD)
SIGMA = {"tof": ((0.0003, 0.0003, 0.002), 0.0015), "stereo": ((0.0002, 0.0002, 0.0003), 0.0005)}


def arms(rng, views=12, tilt=(15, 40), roll=np.pi):
    """Arm poses from which the ToF camera sees the board's front."""
    out = []
    for _ in range(views):
        angle, turn = np.radians(rng.uniform(*tilt)), rng.uniform(0, 2 * np.pi)
        way = BOARD[:3, :3] @ [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
        eye = BOARD[:3, 3] + rng.uniform(0.5, 1.0) * way
        T = poses.look_at(eye, BOARD[:3, 3] + rng.normal(0, 0.03, 3), roll=rng.uniform(-roll, roll))
        out.append(T @ poses.invert(X_TOF))
    return np.stack(out)


def fits_of(arm, rng=None):
    """Board fits of both cameras, with noise of their stated covariances and an arm that is off by its own."""
    fits = []
    for i, A in enumerate(arm):
        error = np.zeros(6) if rng is None else rng.normal(size=6) * np.repeat(ARM_SIGMA, 3)
        for camera, X in (("tof", X_TOF), ("stereo", X_STEREO)):
            sigma = np.concatenate([SIGMA[camera][0], np.repeat(SIGMA[camera][1], 3)])
            off = np.zeros(6) if rng is None else rng.normal(size=6) * sigma
            T = poses.invert(A @ poses.exp(error) @ X) @ BOARD
            T = poses.transform(poses.rotation_exp(off[3:]) @ T[:3, :3], T[:3, 3] + off[:3])
            fits.append(BoardFit(i, camera, T, np.diag(sigma**2)))
    return fits


def off(T, true):
    return np.concatenate(
        [T[:3, 3] - true[:3, 3], poses.rotation_log(T[:3, :3] @ true[:3, :3].T)],
    )


def found(bundle):
    return bundle.T_flange_tof, bundle.T_flange_stereo, bundle.T_base_board


def test_exact_views_give_the_exact_answer():
    """Without noise all three transforms come back to a nanometre."""
    arm = arms(np.random.default_rng(0))
    bundle = solve_bundle(arm, fits_of(arm))
    for T, true in zip(found(bundle), TRUTH, strict=True):
        np.testing.assert_allclose(T, true, atol=1e-9)


def test_truth_lies_within_the_stated_sigmas():
    """Over 25 draws two thirds of the 18 components are within one sigma, and the joint distance is that of chi squared."""
    inside, square, rig = [], [], []
    for seed in range(25):
        rng = np.random.default_rng([seed, 7])
        arm = arms(rng)
        bundle = solve_bundle(arm, fits_of(arm, rng))
        x = np.concatenate([off(T, true) for T, true in zip(found(bundle), TRUTH, strict=True)])
        inside.append(np.abs(x) < np.sqrt(np.diag(bundle.covariance)))
        square.append(x @ np.linalg.solve(bundle.covariance, x))
        rig.append(consistency(bundle, poses.invert(X_TOF) @ X_STEREO)["sigmas"] ** 2)
    assert 0.6 < np.mean(inside) < 0.85
    assert 9.0 < np.mean(square) < 24.0
    assert 0.5 < np.mean(rig) < 1.5


def test_a_wrong_fit_loses_its_vote():
    """A board found 3 cm off in one view is named and moves the answer by less than a standard deviation."""
    rng = np.random.default_rng(2)
    arm = arms(rng, 14)
    fits = fits_of(arm, rng)
    clean = solve_bundle(arm, fits)
    wrong = fits[8].T_camera_board @ poses.transform(np.eye(3), [0.03, 0, 0])
    spoilt = solve_bundle(arm, [*fits[:8], replace(fits[8], T_camera_board=wrong), *fits[9:]])
    assert np.flatnonzero(spoilt.outliers).tolist() == [8]
    moved = off(spoilt.T_flange_tof, clean.T_flange_tof)
    assert (np.abs(moved) < 1.5 * clean.sigma(0)).all()


def test_a_loose_camera_is_noticed():
    """A rig transform that is 3 mm and half a degree away from what the arm says does not agree."""
    rng = np.random.default_rng(3)
    arm = arms(rng)
    fits = fits_of(arm, rng)
    bundle = solve_bundle(arm, fits)
    true = poses.invert(X_TOF) @ X_STEREO
    said, sigma = consistency(bundle, true), np.sqrt(np.diag(bundle.rig_covariance()))
    assert said["agrees"]
    assert said["standard_error"]["translation_mm"] == pytest.approx(1e3 * sigma[:3])
    assert said["standard_error"]["rotation_deg"] == pytest.approx(np.degrees(sigma[3:]))
    assert not consistency(bundle, poses.exp([0.003, 0, 0, 0, 0.009, 0]) @ true)["agrees"]
    camera = Camera(4, 3, 2.0, 2.0, 1.5, 1.0)
    data = bundle_report(
        bundle, fits, Rig(camera, camera, true, X_TOF @ poses.exp([0.001, 0, 0, 0, 0, 0.01]))
    )
    one_more = [replace(f, camera="tof") if k < 2 else f for k, f in enumerate(fits)]
    half = len(fits) // 2
    counted = bundle_report(bundle, one_more, Rig(camera, camera, true, X_TOF))["fits"]
    assert counted == {"tof": half + 1, "stereo": half - 1}
    answers.hold(
        "bundle", {"data": data, "text": bundle_table({**data, "refused": ["view-003 tof: no board"]})}
    )


def test_stated_covariances_that_are_too_small_are_scaled():
    """Fits five times worse than stated widen the error bars five times, within a third."""
    rng = np.random.default_rng(4)
    arm = arms(rng, 20)
    fits = [replace(f, covariance=f.covariance / 25) for f in fits_of(arm, rng)]
    bundle = solve_bundle(arm, fits, (1e-5, 1e-5))
    assert 3 < np.sqrt(bundle.variance) < 8
    told = solve_bundle(
        arm, fits_of(arm), (1e-5, 1e-5)
    )  # of the fits as they should be, whose scatter is none
    wider = np.sqrt(np.diag(bundle.covariance) / np.diag(told.covariance))
    np.testing.assert_allclose(wider, np.sqrt(bundle.variance) / 5, rtol=0.5)


@pytest.mark.parametrize(
    ("motion", "cause"),
    [
        (lambda i: poses.transform(np.eye(3), [0.02 * i, 0.01 * i * i, 0.01]), Cause.PURE_TRANSLATION),
        (
            lambda i: poses.transform(poses.rotation_exp([0, 0, 0.2 * i]), [0.02 * i, 0.01, 0.01 * i]),
            Cause.SINGLE_AXIS,
        ),
    ],
)
def test_degenerate_motion_is_refused_by_name(motion, cause):
    """Pure translation and a single axis determine nothing."""
    start = arms(np.random.default_rng(5), 1)[0]
    arm = np.stack([start @ motion(i) for i in range(10)])
    with pytest.raises(HandEyeRefused) as caught:
        solve_bundle(arm, fits_of(arm, np.random.default_rng(6)))
    assert caught.value.cause is cause


def test_too_few_fits_are_refused():
    """Four fits of a camera are named."""
    arm = arms(np.random.default_rng(7), 6)
    fits = fits_of(arm)
    with pytest.raises(QualityError, match="of the stereo camera, got 4"):
        solve_bundle(arm, [f for f in fits if f.camera == "tof" or f.view < 4])
