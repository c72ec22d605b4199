"""Projecting the stereo sheet onto the ToF plane, against analytic scenes and open3d's ray caster."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.ops.project import project, triangulate
from tofcapture.poses import exp, invert, transform_points

STEREO = Camera(192, 154, 172.0, 172.0, 95.5, 76.5)
TOF = Camera(36, 27, 28.6, 30.1, 17.5, 15.2)
T = exp([-0.05, 0.075, 0.004, 0.045, 0.012, 0.009])  # T_tof_stereo


def planes(camera, T_camera_world, walls):
    """Depth of the nearest of some rectangles ``(z, x0, x1, y0, y1)`` of the world, seen by a camera."""
    eye = invert(T_camera_world)[:3, 3]
    rays = camera.rays @ T_camera_world[:3, :3]
    best = np.full(camera.shape, np.inf)
    for z, x0, x1, y0, y1 in walls:
        t = (z - eye[2]) / rays[..., 2]
        p = eye + t[..., None] * rays
        hit = (t > 0) & (p[..., 0] > x0) & (p[..., 0] < x1) & (p[..., 1] > y0) & (p[..., 1] < y1)
        best = np.where(hit & (t < best), t, best)
    return np.where(np.isfinite(best), best, np.nan)


def seen_by_both(depth, camera, baseline, T_camera_world, walls):
    """Drop what the right eye, ``baseline`` along x, does not see."""
    points = camera.unproject(depth)
    right = exp([-baseline, 0, 0, 0, 0, 0])
    p = transform_points(right, points)
    out = depth.copy()
    world = transform_points(invert(T_camera_world), points)
    eye = invert(right @ T_camera_world)[:3, 3]
    for z, x0, x1, y0, y1 in walls:
        t = (z - eye[2]) / (world[..., 2] - eye[2])
        q = eye + t[..., None] * (world - eye)
        blocked = (
            (t > 0) & (t < 0.999) & (q[..., 0] > x0) & (q[..., 0] < x1) & (q[..., 1] > y0) & (q[..., 1] < y1)
        )
        out[blocked] = np.nan
    assert p.shape == points.shape
    return out


def render(depth, scale=1, camera=TOF):
    return project(triangulate(depth, STEREO), STEREO, T, camera.scaled(scale), edge_pixels=scale)


BACK = (1.0, -9, 9, -9, 9)
FRONT = (0.7, -0.09, 0.08, -0.07, 0.1)


@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.4, 1.4))
@settings(max_examples=12)
def test_a_plane_is_exact_at_pixel_centres(a, b, distance):
    """Depth of a tilted plane comes out to 1e-9 m and its triangles' normals to 1e-6, at 1x, 2x and any other size."""
    normal = np.array([a, b, -1.0]) / np.sqrt(a * a + b * b + 1)
    depth = -distance / (STEREO.rays @ normal)
    n_tof = T[:3, :3] @ normal
    offset = -distance + n_tof @ T[:3, 3]
    for camera in (TOF, TOF.scaled(2), Camera(17, 23, 20.0, 21.0, 8.1, 11.3)):
        found = project(triangulate(depth, STEREO), STEREO, T, camera, edge_pixels=1)
        hit = np.isfinite(found.depth)
        assert hit.mean() > 0.5
        np.testing.assert_allclose(found.depth[hit], (offset / (camera.rays @ n_tof))[hit], atol=1e-9)
        assert np.abs(found.normals[hit] - n_tof).max() < 1e-6
        assert (
            hit & ~found.occluded
        ).mean() > 0.1  # rays from aside cross what the stereo camera does not see


def test_the_hit_is_where_the_stereo_camera_sees_it():
    """The pixel on the stereo grid that a hit reports is the projection of the hit into the stereo camera."""
    depth = planes(STEREO, np.eye(4), [BACK])
    found = render(depth, 2)
    hit = np.isfinite(found.depth)
    points = transform_points(invert(T), TOF.scaled(2).unproject(found.depth)[hit])
    np.testing.assert_allclose(found.pixels[hit], STEREO.project(points)[0], atol=1e-6)


@pytest.mark.parametrize("scale", [1, 2])
def test_nothing_leaks(scale):
    """A square before a wall: depth is on the one or on the other, never between, and never the wall through the square."""
    found = render(
        seen_by_both(planes(STEREO, np.eye(4), [FRONT, BACK]), STEREO, 0.1, np.eye(4), [FRONT]), scale
    )
    truth = planes(TOF.scaled(scale), T, [FRONT, BACK])
    hit = np.isfinite(found.depth)
    z = transform_points(invert(T), TOF.scaled(scale).unproject(found.depth))[..., 2][hit]
    assert (np.minimum(np.abs(z - 0.7), np.abs(z - 1.0)) < 1e-6).all()
    good = hit & ~found.occluded & ~found.edge
    np.testing.assert_allclose(found.depth[good], truth[good], atol=1e-6)
    assert good.mean() > 0.3


@pytest.mark.parametrize("scale", [1, 2])
def test_wrong_depth_is_always_marked(scale):
    """A rod that hides part of the wall from the stereo camera but not from the ToF camera: every wrong pixel has a bit."""
    walls = [(0.6, -0.02, 0.02, -9, 9), BACK]
    found = render(seen_by_both(planes(STEREO, np.eye(4), walls), STEREO, 0.1, np.eye(4), walls[:1]), scale)
    truth = planes(TOF.scaled(scale), T, walls)
    wrong = np.abs(found.depth - truth) > 1e-3  # NaN compares false
    assert (found.occluded | found.edge)[wrong].all()
    assert found.occluded.any()


def test_rays_through_unknown_space_are_occluded():
    """Behind the square's border, on the side that the right eye does not see, rays that still meet the wall are marked."""
    depth = seen_by_both(planes(STEREO, np.eye(4), [FRONT, BACK]), STEREO, 0.1, np.eye(4), [FRONT])
    camera = TOF.scaled(2)
    found = render(depth, 2)
    # Walk along each ToF ray from the camera to the hit: a point that the stereo camera sees through must be before its depth.
    hit = np.isfinite(found.depth) & ~found.occluded & ~found.edge
    for share in np.linspace(0.3, 0.97, 12):
        points = transform_points(invert(T), camera.unproject(found.depth * share)[hit])
        pixels, z = STEREO.project(points)
        u, v = np.rint(pixels).astype(int).T
        ok = (u >= 0) & (u < STEREO.width) & (v >= 0) & (v < STEREO.height)
        assert not (z[ok] > depth[v[ok], u[ok]] + 0.02).any()


def test_edges_and_holes_are_marked():
    """Pixels beside a depth edge or beside a pixel without surface carry the edge mark, inner ones do not."""
    depth = planes(STEREO, np.eye(4), [BACK])
    depth[60:90, 80:120] = np.nan
    found = render(depth)
    missing = ~np.isfinite(found.depth)
    beside = np.zeros_like(missing)
    beside[1:] |= missing[:-1]
    beside[:-1] |= missing[1:]
    assert missing[10:20, 10:25].any()
    assert found.edge[beside].all()
    assert not found.edge.all()


def test_small_holes_are_filled_and_large_ones_are_not():
    """A lost pixel in a plane costs nothing; a hole of ten does, and neither invents depth."""
    depth = planes(STEREO, np.eye(4), [BACK])
    whole = render(depth)
    depth[50, 60] = depth[70:73, 100:103] = np.nan
    np.testing.assert_allclose(render(depth).depth, whole.depth, atol=1e-9)
    depth[60:72, 90:102] = np.nan
    found = render(depth)
    assert np.isnan(found.depth).sum() > np.isnan(whole.depth).sum()


@pytest.mark.parametrize("rise", [0.05, 0.08, 0.11])
def test_a_step_that_hides_in_a_small_hole_is_marked(rise):
    """Of two walls whose border was lost, pixels with depth between them carry the edge mark; those on a wall need none."""
    camera = TOF.scaled(4)
    walls = [(1.0 - rise, -0.3, 0.0, -9, 9), BACK]
    depth = planes(STEREO, np.eye(4), walls)
    step = np.flatnonzero(np.diff(depth[0]) > 0.04)[0]
    depth[:, step : step + 3] = np.nan
    sheet = triangulate(depth, STEREO)
    found = project(sheet, STEREO, T, camera, edge_pixels=1)
    z = transform_points(invert(T), camera.unproject(found.depth))[..., 2]
    between = np.minimum(np.abs(z - 1.0), np.abs(z - (1.0 - rise))) > 1e-6  # NaN compares false
    assert sheet.doubtful[:, step : step + 3].all()
    assert sheet.doubtful.sum() == 3 * STEREO.height
    assert between.any()
    assert found.edge[between].all()
    columns = found.pixels[..., 0]
    beside = (np.abs(columns - step) < 10) & ~between & ~found.occluded
    assert not found.edge[beside & (np.abs(found.pixels[..., 1] - STEREO.height / 2) < 40)].all()


def test_a_hole_in_a_steep_plane_is_no_doubt():
    """Three lost pixels of a plane whose depth changes less across them than between neighbours at most are surface."""
    depth = 1.0 / (1 - 0.5 * STEREO.rays[..., 0])
    whole = render(depth)
    depth[50, 60:63] = np.nan
    assert not triangulate(depth, STEREO).doubtful.any()
    np.testing.assert_array_equal(render(depth).edge, whole.edge)


def test_the_back_of_a_sheet_is_no_surface():
    """A camera behind the wall sees nothing of it."""
    depth = planes(STEREO, np.eye(4), [BACK])
    behind = exp([0, 0, 0, 0, np.pi, 0]) @ exp([0, 0, -2.0, 0, 0, 0])
    sheet = triangulate(depth, STEREO)
    found = project(sheet, STEREO, behind, TOF, 1)
    assert np.isnan(found.depth).all()
    assert found.occluded.any()


def test_open3d_agrees():
    """On a bumpy sheet open3d's ray caster meets the same surface at the same depth."""
    o3d = pytest.importorskip("tofcapture.libraries").load_open3d()
    v, u = np.mgrid[0 : STEREO.height, 0 : STEREO.width]
    depth = 0.8 + 0.03 * np.sin(u / 17) * np.cos(v / 13)
    points = transform_points(T, STEREO.unproject(depth))
    index = np.arange(depth.size).reshape(depth.shape)
    a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    triangles = np.concatenate([np.stack([a, c, b], 1), np.stack([d, b, c], 1)]).astype(np.uint32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(points.reshape(-1, 3).astype(np.float32), triangles)
    camera = TOF.scaled(2)
    rays = np.concatenate([np.zeros_like(camera.rays), camera.rays], axis=-1).astype(np.float32)
    expected = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    found = project(triangulate(depth, STEREO), STEREO, T, camera, 2).depth
    both = np.isfinite(expected) & np.isfinite(found)
    assert (np.isfinite(expected) == np.isfinite(found)).mean() > 0.999
    np.testing.assert_allclose(found[both], expected[both], atol=2e-6)


def test_what_stands_beside_the_stereo_image_hides_what_is_behind_it():
    """A rod before a wall, in the ToF camera's view and outside the stereo camera's: the wall behind it is marked as hidden.

    Nothing of the rod is measured; that there are things as near as it is tells a second one, in both views.
    """
    wide = Camera(48, 36, 18.6, 20.1, 23.5, 17.2)
    rods = [(0.4, -0.02, 0.02, -0.1, 0.1), (0.4, -9, 9, -0.22, -0.19)]
    assert np.isnan(planes(STEREO, np.eye(4), rods[1:])).all()
    found = render(
        seen_by_both(planes(STEREO, np.eye(4), [*rods, BACK]), STEREO, 0.1, np.eye(4), rods), 2, wide
    )
    truth = planes(wide.scaled(2), T, [*rods, BACK])
    wrong = found.depth - truth > 1e-3
    assert wrong.any()
    assert (found.occluded | found.edge)[wrong].all()
    assert found.occluded[wrong].mean() > 0.5


def test_what_is_far_is_no_surface():
    """Points deeper than the limit, in the ToF frame, are not hit."""
    depth = planes(STEREO, np.eye(4), [FRONT, BACK])
    found = project(triangulate(depth, STEREO), STEREO, T, TOF.scaled(2), 1, far=0.85)
    assert 0 < np.nanmax(found.depth) < 0.85


def test_nothing_measured_projects_to_nothing():
    """A point map without points gives an image without depth, all of it marked."""
    found = render(np.full(STEREO.shape, np.nan))
    assert np.isnan(found.depth).all()
    assert np.isnan(found.normals).all()
    assert found.edge.all()
    with pytest.raises(DataError, match="triangulate"):
        triangulate(np.ones((3, 3)), STEREO)
