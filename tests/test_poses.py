"""Rigid motions obey their axioms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.errors import ConfigError
from tofcapture.poses import (
    adjoint,
    check_transform,
    exp,
    invert,
    log,
    look_at,
    rotation_angle,
    rotation_exp,
    rotation_log,
    transform,
    transform_points,
)

SCALES = st.sampled_from([1e-9, 1e-7, 1e-3, 1.0, 3.0])


@given(st.integers(0, 10_000), SCALES)
@settings(max_examples=60)
def test_exp_and_log_undo_each_other(seed, scale):
    """log(exp(xi)) is xi, from tiny to large angles."""
    xi = np.random.default_rng(seed).standard_normal(6)
    xi[3:] *= scale / np.linalg.norm(xi[3:])
    np.testing.assert_allclose(log(exp(xi)), xi, atol=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_group_axioms(seed):
    """Products stay rigid, the inverse undoes, composition associates with point maps, twists change frames."""
    rng = np.random.default_rng(seed)
    A, B = (exp(rng.standard_normal(6)) for _ in range(2))
    check_transform(A @ B)
    xi = rng.standard_normal(6)
    np.testing.assert_allclose(A @ exp(xi), exp(adjoint(A) @ xi) @ A, atol=1e-9)
    np.testing.assert_allclose(invert(A) @ A, np.eye(4), atol=1e-12)
    p = rng.standard_normal((5, 3))
    np.testing.assert_allclose(
        transform_points(A @ B, p), transform_points(A, transform_points(B, p)), atol=1e-12
    )


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-7, np.pi - 1e-5, np.pi - 1e-3])
def test_log_near_half_a_turn(angle):
    """The rotation vector is right where the antisymmetric part vanishes."""
    axis = np.array([0.48, -0.6, 0.64])
    R = rotation_exp(angle * axis)
    phi = rotation_log(R)
    np.testing.assert_allclose(rotation_exp(phi), R, atol=1e-9)
    assert rotation_angle(R) == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), r"\(4, 4\)"),
        (np.diag([2.0, 1, 1, 1]), "rotation"),
        (np.diag([-1.0, 1, 1, 1]), "right-handed"),
        (np.full((4, 4), np.nan), "finite"),
        (np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0 + np.array([[0.0] * 4] * 3 + [[1, 0, 0, 0]]), "last row"),
    ],
)
def test_what_is_not_rigid_is_refused(T, message):
    """check_transform names the defect."""
    with pytest.raises(ConfigError, match=message):
        check_transform(T)


@given(st.integers(0, 1000))
@settings(max_examples=30)
def test_look_at_puts_the_target_on_the_optical_axis(seed):
    """The target is straight ahead at its distance, the image's up is the world's up."""
    rng = np.random.default_rng(seed)
    eye, target = rng.standard_normal((2, 3))
    T = check_transform(look_at(eye, target))
    p = transform_points(invert(T), target)
    np.testing.assert_allclose(p, [0, 0, np.linalg.norm(target - eye)], atol=1e-9)
    assert T[2, 1] <= 1e-9  # y of the camera points down


def test_look_at_straight_down_and_at_itself():
    """Looking along the up direction still gives a rotation; eye on target is refused."""
    check_transform(look_at([0, 0, 1], [0, 0, 0]))
    with pytest.raises(ConfigError, match="coincide"):
        look_at([1, 1, 1], [1, 1, 1])


def test_transform_assembles():
    """Rotation and translation land where they belong."""
    T = transform(rotation_exp([0, 0, np.pi / 2]), [1, 2, 3])
    np.testing.assert_allclose(transform_points(T, np.array([1.0, 0, 0])), [1, 3, 3], atol=1e-12)
