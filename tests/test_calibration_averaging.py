"""Averages of rotations and of rigid transforms: axioms and oracles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.alignment.averages import (
    average_transforms,
    mean_rotation,
    median_point,
    median_rotation,
)
from tofcapture import poses

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)


def rotations(rng, count, spread=0.3):
    """Rotations scattered about a random one."""
    centre = poses.rotation_exp(rng.normal(0, 1, 3))
    return np.stack([poses.rotation_exp(rng.normal(0, spread, 3)) @ centre for _ in range(count)])


def apart(A, B):
    return poses.rotation_angle(A @ B.T)


@pytest.mark.parametrize("mean", [mean_rotation, median_rotation])
@given(seed=seeds, count=st.integers(1, 6))
@few
def test_mean_of_equal_rotations_is_that_rotation(mean, seed, count):
    """A mean of identical rotations is that rotation."""
    R = rotations(np.random.default_rng(seed), 1)
    assert apart(mean(np.repeat(R, count, axis=0)), R[0]) < 1e-9


@pytest.mark.parametrize("mean", [mean_rotation, median_rotation])
@given(seed=seeds)
@few
def test_mean_is_equivariant_and_blind_to_order(mean, seed):
    """Turning all inputs from the left and from the right turns the mean; their order does not matter."""
    rng = np.random.default_rng(seed)
    R = rotations(rng, 5)
    A, B = poses.rotation_exp(rng.normal(0, 1, 3)), poses.rotation_exp(rng.normal(0, 1, 3))
    assert apart(mean(A @ R @ B), A @ mean(R) @ B) < 1e-6
    assert apart(mean(rng.permutation(R)), mean(R)) < 1e-6


def test_mean_of_two_rotations_is_half_way():
    """Two rotations about one axis average to the middle angle, near pi too."""
    R = [poses.rotation_exp([0, 0, a]) for a in (3.0, 3.4)]
    np.testing.assert_allclose(mean_rotation(R), poses.rotation_exp([0, 0, 3.2]), atol=1e-12)


def test_median_rotation_ignores_a_minority():
    """Two gross outliers of nine move the chordal mean by degrees and the median by less than the noise."""
    rng = np.random.default_rng(3)
    R = np.stack([poses.rotation_exp(rng.normal(0, 0.001, 3)) for _ in range(9)])
    R[:2] = poses.rotation_exp([0.5, 0, 0])
    assert apart(mean_rotation(R), np.eye(3)) > np.radians(5)
    assert apart(median_rotation(R), np.eye(3)) < 0.002


def test_median_point_of_collinear_points_is_their_median():
    """On a line the geometric median is the median."""
    points = np.outer([0.0, 1.0, 2.0, 50.0, 100.0], [1.0, 2.0, -1.0])
    np.testing.assert_allclose(median_point(points), [2.0, 4.0, -2.0], atol=1e-6)


def turned_about(point, phi):
    """Rotation about a point that stays where it is."""
    R = poses.rotation_exp(phi)
    return poses.transform(R, point - R @ point)


@given(seed=seeds)
@few
def test_averaging_about_the_working_point_keeps_rotation_noise_out_of_it(seed):
    """With pure rotation noise about c the mean maps c exactly; averaged about the origin it would not."""
    rng = np.random.default_rng(seed)
    true = poses.transform(poses.rotation_exp(rng.normal(0, 1, 3)), rng.normal(0, 0.1, 3))
    c = np.array([0.05, -0.02, 0.8])
    T = [true @ turned_about(c, rng.normal(0, 0.02, 3)) for _ in range(6)]
    expected = poses.transform_points(true, c)
    np.testing.assert_allclose(poses.transform_points(average_transforms(T, c).T, c), expected, atol=1e-12)


def test_averaging_about_the_origin_leaks_rotation_noise():
    """Averaged about the camera instead, the same rotations move the working point: by their square, half a millimetre here."""
    c = np.array([0.0, 0.0, 0.8])
    T = [turned_about(c, [a, 0, 0]) for a in (0.1, 0.12, 0.04)]
    about_origin, about_c = average_transforms(T, [0, 0, 0]).T, average_transforms(T, c).T
    assert apart(about_c[:3, :3], about_origin[:3, :3]) < 1e-12
    assert np.linalg.norm(poses.transform_points(about_c, c) - c) < 1e-12
    assert np.linalg.norm(poses.transform_points(about_origin, c) - c) > 4e-4


@given(seed=seeds)
@few
def test_average_transforms_is_left_equivariant(seed):
    """Seen from another frame the average is the same motion."""
    rng = np.random.default_rng(seed)
    T = np.stack([poses.exp(rng.normal(0, 0.01, 6)) for _ in range(5)])
    A = poses.exp(rng.normal(0, 1, 6))
    c = rng.normal(0, 1, 3)
    np.testing.assert_allclose(average_transforms(A @ T, c).T, A @ average_transforms(T, c).T, atol=1e-9)


@pytest.mark.parametrize(
    "wrong", [[0.05, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0.1, 0]], ids=["translation", "rotation"]
)
def test_outlier_is_rejected_and_named(wrong):
    """A pair off by 5 cm, or by 6 degrees about the working point, is the one that is not kept."""
    rng = np.random.default_rng(5)
    c = np.array([0, 0, 0.8])
    T = [poses.exp(rng.normal(0, 1e-4, 6)) for _ in range(8)]
    T[3] = turned_about(c, wrong[3:]) @ poses.transform(np.eye(3), wrong[:3])
    average = average_transforms(T, c)
    assert np.flatnonzero(~average.kept).tolist() == [3]
    assert poses.rotation_angle(average.T) < 3e-4
    assert max(average.rotation_from_mean[3], average.translation_from_mean[3]) > 0.04


def test_agreement_is_never_an_outlier():
    """Inputs that agree to a tenth of the floor are all kept, whatever their ratios."""
    T = [poses.transform(np.eye(3), [x, 0, 0]) for x in (0, 0, 0, 0, 5e-5)]
    assert average_transforms(T, [0, 0, 0.8]).kept.all()


def test_spread_and_standard_error_of_known_noise():
    """Spread is the deviation of one input, the standard error that over root N."""
    rng = np.random.default_rng(0)
    T = [poses.transform(np.eye(3), rng.normal(0, 1e-3, 3)) for _ in range(400)]
    average = average_transforms(T, [0, 0, 0.8])
    assert average.spread[1] == pytest.approx(1e-3 * np.sqrt(3), rel=0.1)
    assert average.standard_error[1] == pytest.approx(average.spread[1] / 20, rel=0.05)
    assert average.spread[0] == pytest.approx(0, abs=1e-9)
