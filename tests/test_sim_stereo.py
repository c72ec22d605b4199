"""The simulated stereo camera: holes where geometry says so, noise as stated."""

from dataclasses import replace

import numpy as np
import pytest

from tests.test_sim_light import wall
from tofcapture.camera import Camera
from tofcapture.devices.sim.scene import Caster, merge
from tofcapture.devices.sim.stereo import StereoModel, ideal, point_map

CAMERA = Camera(320, 256, 290.0, 290.0, 159.5, 127.5)
MODEL = StereoModel()


def measure(objects, model, seed=0):
    return point_map(Caster(merge(objects)), CAMERA, np.eye(4), model, np.random.default_rng(seed))


def test_ideal_points_lie_on_the_surface():
    """Without noise the point map of a wall is the wall, on the pixel rays."""
    points = measure([wall(1.0)], ideal(MODEL))
    seen = np.isfinite(points[..., 2])
    assert seen.mean() > 0.8
    np.testing.assert_allclose(points[seen], CAMERA.rays[seen], atol=2e-6)


def test_hole_beside_a_near_object_has_the_width_of_the_parallax():
    """A near square hides a strip of the wall from the right eye: baseline (1/near - 1/far) focal lengths wide."""
    objects = [wall(0.6, size=0.1), wall(1.0)]
    points = measure(objects, ideal(MODEL))
    row = points[128, :, 2]
    left_edge = int(np.argmax(row < 0.8))
    hole = np.isnan(row[:left_edge]).sum() - np.isnan(row[: int(CAMERA.fx * MODEL.baseline / 1.0)]).sum()
    expected = CAMERA.fx * MODEL.baseline * (1 / 0.6 - 1 / 1.0)
    assert hole == pytest.approx(expected, abs=2.5)


def test_depth_noise_is_the_disparity_noise():
    """sigma_z = z^2 / (f b) sigma_d, correlated over neighbours."""
    model = replace(ideal(MODEL), disparity_noise=0.05)
    error = measure([wall(1.5)], model)[..., 2] - 1.5
    inside = error[40:-40, 80:-40]
    assert inside.std() == pytest.approx(1.5**2 / (290.0 * 0.1) * 0.05, rel=0.05)
    neighbours = np.corrcoef(inside[:, :-1].ravel(), inside[:, 1:].ravel())[0, 1]
    assert neighbours > 0.8


def test_grazing_dark_and_far_surfaces_are_lost():
    """Surfaces seen at a grazing angle, too dark or too far give NaN."""
    assert np.isnan(measure([wall(1.0, tilt=(0, np.radians(83), 0))], MODEL)[128, 160, 2])
    assert np.isnan(measure([wall(1.0, albedo=0.01)], MODEL)).all()
    assert np.isnan(measure([wall(3.5, size=9)], MODEL)).all()


def test_outliers_stand_beside_edges_only():
    """Wrong matches lie between the two surfaces and nowhere else."""
    model = replace(ideal(MODEL), edge_outliers=0.5)
    clean, dirty = (
        measure([wall(0.6, size=0.1), wall(1.0)], ideal(MODEL)),
        measure([wall(0.6, size=0.1), wall(1.0)], model),
    )
    wrong = np.abs(dirty[..., 2] - clean[..., 2]) > 1e-4
    assert 50 < wrong.sum() < 0.05 * wrong.size
    assert (dirty[wrong][:, 2] > 0.599).all()
    assert (dirty[wrong][:, 2] < 1.001).all()
