"""Pinhole cameras: pixel centres are integers, depth is z, radial is along the ray."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError

CAMERA = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_project_undoes_unproject(seed):
    """A depth image unprojects to points that project back to their own pixel centres."""
    depth = np.random.default_rng(seed).uniform(0.2, 3.0, CAMERA.shape)
    pixels, z = CAMERA.project(CAMERA.unproject(depth))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    np.testing.assert_allclose(pixels[..., 0], u, atol=1e-9)
    np.testing.assert_allclose(pixels[..., 1], v, atol=1e-9)
    np.testing.assert_allclose(z, depth)


@pytest.mark.parametrize("s", [2, 4])
def test_scaled_intrinsics_keep_the_view(s):
    """The mean of the s x s rays of a scaled pixel is the ray of the pixel: c' = s (c + 0.5) - 0.5."""
    fine = CAMERA.scaled(s).rays.reshape(CAMERA.height, s, CAMERA.width, s, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(fine, CAMERA.rays, atol=1e-12)


def test_radial_and_depth_are_inverse():
    """radial = depth * |ray|."""
    depth = np.full(CAMERA.shape, 0.8)
    radial = CAMERA.depth_to_radial(depth)
    assert (radial >= depth).all()
    np.testing.assert_allclose(radial, np.linalg.norm(CAMERA.unproject(depth), axis=-1))
    np.testing.assert_allclose(CAMERA.radial_to_depth(radial), depth)


def test_points_behind_the_camera_have_no_pixel():
    """Projection gives NaN at and behind the camera plane."""
    pixels, _ = CAMERA.project(np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], [CAMERA.cx, CAMERA.cy])


def test_wrong_shapes_and_intrinsics_are_refused():
    """Depth of another size and non-positive focal lengths say so."""
    with pytest.raises(ConfigError, match=r"\(180, 240\)"):
        CAMERA.unproject(np.zeros((240, 180)))
    with pytest.raises(ConfigError, match="focal"):
        Camera(10, 10, 0.0, 1.0, 5, 5)
