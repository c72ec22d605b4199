"""Normals by inverse-depth least squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.ops.normals import RADII, PlaneField, grazing, normals_from_depth

CAMERA = Camera(60, 50, 400.0, 405.0, 28.3, 26.1)


def plane(camera, normal, distance=1.0):
    """Depth of the plane ``normal . p = -distance`` (normal facing the camera)."""
    with np.errstate(divide="ignore"):
        depth = -distance / (camera.rays @ normal)
    return np.where((depth > 0) & (depth < 50), depth, np.nan)


def angles(found, normal):
    """Angle to the true normal without arccos, which is blind below 1e-8 rad."""
    return np.linalg.norm(np.cross(found, normal), axis=-1)


@given(st.floats(0, 2 * np.pi), st.floats(0, np.radians(80)))
@settings(max_examples=25)
def test_planes_are_exact_at_any_tilt(azimuth, tilt):
    """Without noise every method gives a plane's normal to 1e-6 rad, unit and facing the camera."""
    normal = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    depth = plane(CAMERA, normal)
    v, u = np.nonzero(np.isfinite(depth))
    for found in (
        normals_from_depth(depth, CAMERA)[v, u],
        unit(PlaneField(depth, CAMERA).at(np.stack([u, v], axis=1).astype(float))[0]),
    ):
        there = np.isfinite(found[:, 0])
        assert there.mean() > 0.99
        assert angles(found[there], normal).max() < 1e-6
        assert (found[there] @ normal > 0.999).all()


def test_noise_gives_the_predicted_angle():
    """Noise of 3 mm at 1 m, 9 x 9 windows and fx 400 give 3.8 degrees in the mean."""
    camera = Camera(200, 200, 400.0, 400.0, 99.5, 99.5)
    normal = np.array([0.0, 0.0, -1.0])
    depth = plane(camera, normal) + 0.003 * np.random.default_rng(0).standard_normal(camera.shape)
    inner = normals_from_depth(depth, camera)[10:-10, 10:-10]
    assert np.degrees(np.arcsin(angles(inner, normal))).mean() == pytest.approx(3.8, abs=0.3)


def test_missing_depth_has_no_normal_and_spoils_none():
    """NaN stays NaN; a pixel beside it keeps the plane's normal; too few neighbours give NaN."""
    normal = np.array([0.3, -0.2, -np.sqrt(1 - 0.13)])
    depth = plane(CAMERA, normal)
    depth[10:20, 10:40] = np.nan
    lonely = np.full(CAMERA.shape, np.nan)
    lonely[5, 5] = lonely[5, 6] = lonely[5, 7] = 1.0
    found = normals_from_depth(depth, CAMERA)
    assert np.isnan(found[12, 20]).all()
    assert angles(found[21, 20], normal) < 1e-6
    assert np.isnan(normals_from_depth(lonely, CAMERA)).all()
    assert np.isnan(normals_from_depth(np.full(CAMERA.shape, np.nan), CAMERA)).all()


def test_windows_shrink_at_a_crease_and_grow_on_a_plane():
    """A roof with noise: beside the ridge better than any large window, far from it better than any small one."""
    camera = Camera(160, 120, 800.0, 800.0, 79.5, 59.5)
    left, right = (np.array([s * 0.5, 0.0, -np.sqrt(0.75)]) for s in (-1.0, 1.0))
    depth = np.maximum(plane(camera, left, 0.8), plane(camera, right, 0.8))
    truth = np.where(plane(camera, left, 0.8)[..., None] >= plane(camera, right, 0.8)[..., None], left, right)
    depth = depth + 0.0002 * np.random.default_rng(3).standard_normal(camera.shape)
    v, u = np.mgrid[20:100, 20:140].reshape(2, -1)
    pixels = np.stack([u, v], axis=1).astype(float)
    field = PlaneField(depth, camera)
    ridge = np.abs(u - 79.5) < 6

    def error(radii):
        return np.degrees(np.arcsin(np.minimum(1, angles(unit(field.at(pixels, radii)[0]), truth[v, u]))))

    chosen = error((2, 4, 8, 12))
    assert chosen[ridge].mean() < 0.6 * error((12,))[ridge].mean()
    assert chosen[~ridge].mean() < 0.5 * error((2,))[~ridge].mean()


def unit(planes):
    return -planes / np.linalg.norm(planes, axis=1, keepdims=True)


def test_planes_are_those_of_numpys_windows():
    """On a noisy wave with holes the compiled fit has the normals that numpy's box sums give for the same pixels."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    depth = 0.8 + 0.01 * np.sin(u / 9) + 1e-4 * np.random.default_rng(1).standard_normal(CAMERA.shape)
    depth[12:16, 18:24] = np.nan
    v, u = np.mgrid[6 : CAMERA.height - 6, 6 : CAMERA.width - 6].reshape(2, -1)
    radius = 2  # one cell of 2 x 2 about a pixel's own: 6 x 6, of which 5 x 5 are numpy's
    found, residual = PlaneField(depth, CAMERA).at(np.stack([u, v], axis=1), (radius,))
    expected = normals_from_depth(depth, CAMERA, radius)[v, u]
    both = np.isfinite(expected[:, 0]) & np.isfinite(residual)
    assert both.mean() > 0.4
    assert np.degrees(np.arcsin(np.median(angles(unit(found[both]), expected[both])))) < 1.5
    exact = plane(CAMERA, np.array([0.3, -0.2, -np.sqrt(0.87)]))
    found, _ = PlaneField(exact, CAMERA).at(np.stack([u, v], axis=1))
    assert np.abs(np.einsum("nc,nc->n", found, CAMERA.rays[v, u]) * exact[v, u] - 1).max() < 1e-9


def test_a_bend_does_not_pull_the_surface():
    """Through a ball the plane of a large window passes below the surface; what is returned lies on it."""
    camera = Camera(160, 120, 800.0, 800.0, 79.5, 59.5)
    b = camera.rays @ [0, 0, 0.9]
    a = (camera.rays**2).sum(axis=-1)
    depth = (b - np.sqrt(b * b - a * (0.81 - 0.3**2))) / a
    v, u = np.mgrid[30:90, 40:120].reshape(2, -1)
    planes, _ = PlaneField(depth, camera).at(np.stack([u, v], axis=1), (8, 12))
    error = 1 / np.einsum("nc,nc->n", planes, camera.rays[v, u]) - depth[v, u]
    assert np.median(np.abs(error)) < 8e-6  # a plane of 26 pixels passes 80 micrometres below


def test_grazing_by_either_eye():
    """More than 75 degrees from the normal for one of the eyes is grazing; NaN is not."""
    depth, t = np.array([[1.0, 1.0, np.nan]]), np.radians(76)
    rays = np.broadcast_to([0.0, 0.0, 1.0], (1, 3, 3)).copy()
    normals = np.array([[[0.0, 0.0, -1.0], [np.sin(t), 0.0, -np.cos(t)], [np.nan] * 3]])
    out = np.empty((1, 3), dtype=bool)
    grazing(depth, normals, rays, np.zeros(3), out)
    assert out.tolist() == [[False, True, False]]
    grazing(depth, normals, rays, np.array([-8.0, 0.0, 0.0]), out)
    assert out.tolist() == [[True, True, False]]


def test_depth_of_another_shape_is_refused():
    """The camera says which shape depth must have."""
    with pytest.raises(DataError, match="expected depth of shape"):
        normals_from_depth(np.ones((3, 3)), CAMERA)


@given(st.integers(0, 50), st.floats(3.0, 10.0), st.floats(0.0, np.radians(50)))
@settings(max_examples=5, deadline=None)
def test_windows_are_large_on_noisy_floors_and_small_on_what_bends(seed, noisier, tilt):
    """On a floor, half of it many times as noisy, nearly every place has the largest window; on a ball and at creases few have."""
    camera = Camera(160, 96, 300.0, 300.0, 79.5, 47.5)
    noise = np.random.default_rng(seed).standard_normal(camera.shape)
    v, u = (x.reshape(-1) for x in np.mgrid[14:82:2, 14:146:2])

    def widest(depth):
        field, pixels = PlaneField(depth, camera), np.stack([u, v], axis=1).astype(float)
        return field.at(pixels)[1] == field.at(pixels, RADII[-1:])[1]  # told by what they leave

    floor = plane(camera, np.array([np.sin(tilt), 0.0, -np.cos(tilt)]))
    sigma = np.where(np.arange(160) < 112, 5e-4, 5e-4 * noisier) * floor**2
    assert widest(floor + sigma * noise)[u > 124].mean() > 0.8
    rays = camera.rays / camera.ray_lengths[..., None]
    along = 0.8 * rays[..., 2]
    under = 0.06**2 - 0.8**2 + along**2
    ball = np.where(under > 0, (along - np.sqrt(np.maximum(under, 0.0))) * rays[..., 2], floor)
    assert widest(ball + 2e-4 * noise)[under[v, u] > 0].mean() < 0.3
    crease = 0.8 + np.abs(np.arange(160) - 79.5) / 300.0 + 2e-4 * noise
    assert widest(crease)[np.abs(u - 79.5) < 6].mean() < 0.1
