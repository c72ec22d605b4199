"""Registration by depth edges and rims, which hold what surfaces let slide."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.backends import register
from calibration.clouds import Cloud
from calibration.projective.edges import match_edges, stereo_edges, tof_edges
from calibration.projective.grid import surface_grid
from calibration.projective.organised import OrganisedCloud
from calibration.projective_icp import register_projective
from tests.balls import GRID, STEREO, TOF, TRUE, errors, guess, stereo_points, tof_points
from tofcapture import poses
from tofcapture.errors import DataError


def plates(camera, T_scene_camera):
    """Depth image of a square plate 0.8 m away before a parallel wall at 1.2 m, both exact."""
    o, d = T_scene_camera[:3, 3], poses.rotate_vectors(T_scene_camera, camera.rays)
    at = o + d * ((0.8 - o[2]) / d[..., 2])[..., None]
    turned = at[..., :2] @ np.array([[0.96, -0.28], [0.28, 0.96]])
    on_plate = (np.abs(turned) < 0.15).all(axis=-1)
    return camera.unproject(np.where(on_plate, (0.8 - o[2]) / d[..., 2], (1.2 - o[2]) / d[..., 2]))


def test_edges_hold_what_parallel_planes_do_not():
    """A plate before a parallel wall slides on its surfaces alone; the edges bring it back to 0.3 mm from 2 mm and 0.3 degrees."""
    stereo, points = plates(STEREO, poses.invert(TRUE)), plates(TOF, np.eye(4))
    grid = surface_grid(stereo, STEREO)
    start = TRUE @ poses.transform(poses.rotation_exp([0, 0, 0.005]), [0.0015, -0.0015, 0])
    loose = register_projective(points.reshape(-1, 3), grid, start, 0.002, ())
    held = register_projective(points, grid, start, 0.002, (), stereo_edges(stereo, STEREO, grid))
    assert errors(held.T_target_source)[1] < 0.3 < errors(loose.T_target_source)[1]
    assert errors(held.T_target_source)[0] < 0.1
    assert held.condition < loose.condition


def test_edges_between_the_rays_cost_nothing():
    """At the truth every matched edge of exact data lies between its rays or within a stereo pixel of them."""
    stereo, points = plates(STEREO, poses.invert(TRUE)), plates(TOF, np.eye(4))
    found = stereo_edges(stereo, STEREO, surface_grid(stereo, STEREO))
    match, weights = match_edges(tof_edges(points), found, TRUE, 0.001)
    assert len(match.rays) > 150
    assert np.abs(match.distance).max() < 0.001
    assert (match.distance == 0).mean() > 0.8
    np.testing.assert_array_equal(weights == 0, match.distance == 0)


def test_edges_need_an_image():
    """Points that have lost their pixels have no neighbours: edges with them are a data error."""
    edges = stereo_edges(stereo_points(), STEREO, GRID)
    with pytest.raises(DataError, match="image"):
        register_projective(tof_points(), GRID, TRUE, 0.002, edges=edges)


def test_backend_takes_the_image_of_an_organised_cloud():
    """The full grid in place of the cloud, and points repeated to weigh more, answer the same registration."""
    points, cloud = tof_points(np.random.default_rng(11), 0.002), GRID.cloud()
    z = stereo_points(3e-4)[..., 2]
    organised = OrganisedCloud(cloud.points[::8], cloud.normals[::8], z, STEREO)
    result = register("projective", points, organised, guess(11, 1.0, 0.01))
    rotation, translation = errors(result.T_target_source)
    assert rotation < 0.1
    assert translation < 0.6


def outline(step=0.002):
    """Edge of the square plate and its outward normals in the plate's plane, ToF frame."""
    s = np.arange(-0.15, 0.15, step)
    one = np.full(len(s), 0.15)
    sides = [(s, one, 0, 1), (s, -one, 0, -1), (one, s, 1, 0), (-one, s, -1, 0)]
    back = np.array([[0.96, 0.28], [-0.28, 0.96]])
    points = np.concatenate([np.column_stack([x, y]) @ back for x, y, _, _ in sides])
    normals = np.concatenate([np.tile([a, b] @ back, (len(s), 1)) for _, _, a, b in sides])
    flat = np.zeros((len(points), 1))
    return np.hstack([points, flat + 0.8]), np.hstack([normals, flat])


def test_rims_tell_an_offset_of_the_ranges():
    """Ranges that are all 6 mm too long move a plate with rims by less than 0.5 mm where there is the stereo image, else by millimetres."""
    depth = plates(STEREO, poses.invert(TRUE))[..., 2]
    edge, normals = outline()
    front = plates(TOF, np.eye(4)).reshape(-1, 3)
    front = front[front[:, 2] < 0.9]
    front *= 1 + 0.006 / np.linalg.norm(front, axis=1, keepdims=True)
    source = np.concatenate([np.repeat(edge, 40, axis=0), front])
    rim = poses.transform_points(TRUE, edge)
    across = np.cross(np.cross(normals, edge), edge)
    across = poses.rotate_vectors(TRUE, across / np.linalg.norm(across, axis=1, keepdims=True))
    plate = STEREO.unproject(depth)[::4, ::4].reshape(-1, 3)
    plane = poses.rotate_vectors(TRUE, np.tile([0.0, 0.0, -1.0], (len(plate), 1)))
    points, n = np.concatenate([rim, plate]), np.concatenate([across, plane])
    told = register("projective", source, OrganisedCloud(points, n, depth, STEREO), TRUE)
    untold = register("projective", source, Cloud(points, n), TRUE)
    assert errors(told.T_target_source)[1] < 0.5
    assert errors(untold.T_target_source)[1] > 2
    assert told.rmse < untold.rmse
