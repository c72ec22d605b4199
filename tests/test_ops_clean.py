"""Denoise and crop: what they keep and what they take out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.ops.crop import (
    FINEST,
    LOWEST_SMOOTH,
    SURE,
    Crop,
    crop_depth,
    dominant_plane,
    find_crop,
    refine_clearance,
)
from tofcapture.ops.denoise import SPIKE_PIXELS, SPIKE_SIGMAS, STEEPEST, SUPPORT, denoise
from tofcapture.poses import exp, transform_points

CAMERA = Camera(160, 128, 144.0, 144.0, 79.5, 63.5)

UP = np.array([0.0, 0.0, 1.0])


def rng():
    return np.random.default_rng(0)


def inside(crop, points):
    """The rule of the crop for points (..., 3), in plain numpy."""
    near = (points[..., 2] > 0) & (points[..., 2] < crop.far)
    if not np.isfinite(crop.offset):
        return near
    height, off = points @ crop.normal - crop.offset, points - crop.centre
    along = off - (off @ crop.normal)[..., None] * crop.normal
    return near & (height > crop.clearance) & (np.linalg.norm(along, axis=-1) < crop.radius)


def tilted(slope=0.5, distance=0.8):
    return distance / (1 - slope * CAMERA.rays[..., 0])


@given(st.floats(-1.5, 1.5), st.floats(0.3, 1.5))
@settings(max_examples=15)
def test_denoise_keeps_a_clean_plane(slope, distance):
    """Of a plane with a little noise at least 99.5 % stays, and no NaN is kept."""
    depth = tilted(slope, distance)
    depth = np.where((depth > 0) & (depth < 3), depth, np.nan)
    depth *= 1 + 2e-4 * rng().standard_normal(CAMERA.shape)
    depth[10, 10] = np.nan
    keep = denoise(depth, CAMERA)
    inner = np.isfinite(depth)[4:-4, 4:-4]
    assert keep[4:-4, 4:-4][inner].mean() > 0.995
    assert not keep[10, 10]


def test_denoise_removes_veils_spikes_and_speckles():
    """Points between foreground and background, and lone ones, go; both surfaces stay."""
    depth = np.full(CAMERA.shape, 1.0)
    depth[40:90, 50:110] = 0.7
    veil = np.zeros(CAMERA.shape, dtype=bool)
    veil[40:90, 49:51] = rng().random((50, 2)) < 0.3
    depth[veil] = rng().uniform(0.76, 0.94, veil.sum())
    depth[100, 20] = 1.06
    depth[60, 80] = 0.6
    holes = depth.copy()
    holes[5:15, 5:15] = np.nan
    holes[10, 10] = 1.0
    keep = denoise(holes, CAMERA)
    assert keep[veil].mean() < 0.1
    assert not keep[100, 20]
    assert not keep[60, 80]
    assert not keep[10, 10]
    assert keep[45:85, 56:104].mean() > 0.99
    assert keep[41:89, 52].mean() > 0.9
    assert keep[110:125, 20:140].mean() > 0.99


def test_denoise_is_what_numpy_says():
    """On a noisy step with holes the compiled window keeps the points that a plain numpy version of the two rules keeps."""
    depth = np.where(np.arange(CAMERA.width) < 80, 0.7, 0.72) * np.ones(CAMERA.shape)
    depth *= 1 + 3e-3 * rng().standard_normal(CAMERA.shape)
    depth[rng().random(CAMERA.shape) < 0.2] = np.nan
    z = np.pad(depth.astype(np.float32), 2, constant_values=np.nan)
    centre, inverse = z[2:-2, 2:-2], 1 / z
    support, pairs, total = (np.zeros(CAMERA.shape) for _ in range(3))
    limit = STEEPEST / 144 * centre
    for dv, du in [(0, 1), (0, 2), *((v, u) for v in (1, 2) for u in range(-2, 3))]:
        ahead, behind = ((slice(2 + s * dv, 130 + s * dv), slice(2 + s * du, 162 + s * du)) for s in (1, -1))
        near = [np.abs(z[at] - centre) <= limit * np.hypot(dv, du) for at in (ahead, behind)]
        support += near[0].astype(int) + near[1]
        pairs += near[0] & near[1]
        total += np.where(near[0] & near[1], inverse[ahead] + inverse[behind], 0)
    deviation = np.where(pairs > 0, np.abs(total / (2 * np.maximum(pairs, 1)) * centre - 1), 0)
    enough = support >= SUPPORT
    sigma = 1.4826 * np.median((deviation / centre)[enough])
    expected = enough & (deviation <= np.maximum(SPIKE_SIGMAS * sigma * centre, SPIKE_PIXELS / 144))
    assert 100 < expected.sum() < np.isfinite(depth).sum()
    assert np.isfinite(depth)[expected].all()
    assert (denoise(depth, CAMERA) == expected).mean() > 0.999  # the noise is told from every seventh point


def test_an_inclined_plate_that_fills_the_view_is_not_the_table():
    """Of a plate tilted by 20 degrees and a strip of table the strip is the table; without a strip all is kept."""
    generator = rng()
    plate = generator.uniform([-0.3, -0.3, 0], [0.3, 0.3, 0], (9000, 3))
    plate[:, 2] = 0.8 - np.tan(np.radians(20)) * plate[:, 0]
    strip = generator.uniform([0.3, -0.3, 1.0], [0.4, 0.3, 1.0], (1000, 3))
    assert find_crop(np.concatenate([plate, strip]), UP, rng()).offset == pytest.approx(-1.0, abs=1e-6)
    assert np.isnan(find_crop(plate, UP, rng()).offset)


def test_crop_of_another_camera_is_the_same_rule():
    """Depth of a camera elsewhere is kept exactly where its points are inside."""
    T = exp([0.05, -0.02, 0.01, 0.1, -0.05, 0.02])
    depth = (0.8 + 0.1 * rng().random(CAMERA.shape)).astype(np.float32)
    depth[5, 6] = np.nan
    points = transform_points(T, CAMERA.unproject(depth))
    crop = find_crop(points, UP, rng(), radius=0.2)
    flat = Crop(np.array([0.0, 0.0, -1.0]), -0.9, np.array([0, 0, 0.9]), 0.2, 0.001, 2.0)
    nothing = find_crop(points, UP, rng(), radius=1e3, far=0.85)
    bent = replace(CAMERA, distortion=(-0.1, 0.02, 0.001, 0.0, 0.0))
    assert np.isfinite(crop_depth(flat, depth, bent)).sum() == inside(flat, bent.unproject(depth)).sum() > 0
    for c in (crop, flat, nothing):
        kept = crop_depth(c, depth, CAMERA, T)
        np.testing.assert_array_equal(np.isfinite(kept), inside(c, points))
        np.testing.assert_array_equal(kept[np.isfinite(kept)], depth[np.isfinite(kept)])


def test_denoise_of_nothing_is_nothing():
    """A point map without points gives no points; another shape is refused."""
    assert not denoise(np.full(CAMERA.shape, np.nan), CAMERA).any()
    with pytest.raises(DataError, match="denoise"):
        denoise(np.ones((4, 4)), CAMERA)


@given(st.floats(0, 2 * np.pi), st.floats(0, np.radians(60)), st.integers(0, 1000))
@settings(max_examples=15)
def test_the_dominant_plane_is_found(azimuth, tilt, seed):
    """A plane with 40 % of other points is found to 0.2 degrees and 0.5 mm, whatever its tilt."""
    normal = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    generator = np.random.default_rng(seed)
    flat = generator.uniform(-0.4, 0.4, (6000, 3))
    flat -= np.outer(flat @ normal + 0.8, normal)
    flat += 0.0005 * generator.standard_normal(flat.shape)
    clutter = generator.uniform(-0.5, 0.5, (4000, 3)) + np.array([0, 0, 0.9])
    found = dominant_plane(np.concatenate([flat, clutter]), generator)
    assert found is not None
    assert np.degrees(np.arccos(min(1, found[0] @ normal))) < 0.2
    assert found[1] == pytest.approx(-0.8, abs=5e-4)


def test_crop_keeps_what_stands_on_the_table():
    """A box on the table is inside; the table, a wall far from the view's centre and NaN are not."""
    depth = np.full(CAMERA.shape, 1.0)
    depth[50:80, 60:100] = 0.9
    depth[:, :12] = 0.6
    depth[100:110, 70:90] = np.nan
    points = CAMERA.unproject(depth)
    crop = find_crop(points, UP, rng(), radius=0.25)
    kept = np.isfinite(crop_depth(crop, depth, CAMERA))
    expected = np.zeros(CAMERA.shape, dtype=bool)
    expected[50:80, 60:100] = True
    np.testing.assert_array_equal(kept, expected)
    assert crop.normal @ [0, 0, -1] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("top", [0.0, 0.05, 0.3])
def test_a_flat_top_that_fills_the_view_is_not_the_table(top):
    """A box whose top covers most of the view stands on the table below it; the floor further down is not the table."""
    depth = np.full(CAMERA.shape, 1.0)
    depth[:, 15:145] = 1.0 - top
    depth[:12] = 1.7
    points = CAMERA.unproject(depth * (1 + 2e-4 * rng().standard_normal(CAMERA.shape)))
    crop = find_crop(points, UP, rng(), radius=0.6)
    assert crop.offset == pytest.approx(-1.0, abs=1e-3)
    assert inside(crop, points)[20:, 20:140].mean() == pytest.approx(1.0 if top else 0.0, abs=1e-3)


def test_a_steep_wall_that_fills_the_view_is_not_the_table():
    """Of a large wall and a smaller level plane the level one is the table; without any level plane the wall serves."""
    generator = rng()
    wall = generator.uniform([-0.4, -0.3, 0.5], [0.4, -0.3, 1.0], (6000, 3))
    level = generator.uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 1.0], (2500, 3))
    assert find_crop(np.concatenate([wall, level]), UP, rng()).normal @ [0, 0, -1] == pytest.approx(
        1.0, abs=1e-6
    )
    assert abs(find_crop(wall, UP, rng()).normal[1]) == pytest.approx(1.0, abs=1e-6)


def test_without_a_table_everything_within_range_stays():
    """A ball in mid-air has no dominant plane: all that is near enough is kept."""
    direction = rng().standard_normal((5000, 3))
    points = 0.3 * direction / np.linalg.norm(direction, axis=1, keepdims=True) + [0, 0, 1.0]
    crop = find_crop(points, UP, rng(), far=1.2)
    assert np.isnan(crop.offset)
    np.testing.assert_array_equal(inside(crop, points), points[:, 2] < 1.2)
    assert not inside(crop, np.full((2, 3), np.nan)).any()
    assert find_crop(np.full((4, 4, 3), np.nan), UP, rng()).far == 2.0


def test_a_crop_of_a_hundred_metres_is_none():
    """Without a crop no table is looked for: what lies on a perfect one stays."""
    points = np.concatenate(
        [np.random.default_rng(0).uniform(-0.3, 0.3, (500, 2)), np.ones((500, 1))], axis=1
    )
    assert np.isfinite(find_crop(points, UP, rng(), radius=99.0).offset)
    crop = find_crop(points, UP, rng(), radius=100.0)
    assert np.isnan(crop.offset)
    assert inside(crop, points).all()


@pytest.mark.parametrize("scatter", [0.0, 0.000015, 0.00002, 0.0001, 0.0002, 0.001])
def test_smoothed_points_lower_the_crop_to_their_own_scatter(scatter):
    """Four standard deviations of the table, at least a quarter of a millimetre or twelve of them, never more than before."""
    points = np.random.default_rng(0).normal(0, 1, (4000, 3)) * [0.1, 0.1, scatter] + [0, 0, 1]
    points[:800, 2] -= 0.05  # an object
    crop = Crop(np.array([0, 0, -1.0]), -1.0, np.array([0, 0, 1.0]), 0.35, 0.0012, 2.0)
    low = refine_clearance(crop, points).clearance
    least = min(LOWEST_SMOOTH, max(FINEST, SURE * scatter))
    assert low == pytest.approx(min(0.0012, max(least, 4 * scatter)), rel=0.1)
    assert refine_clearance(crop, points[:300]) == crop  # too few to tell
    assert not np.isfinite(refine_clearance(find_crop(points, UP, rng(), 1e3), points).offset)


def test_the_same_generator_gives_the_same_crop():
    """The plane search is a function of points and generator."""
    points = CAMERA.unproject(tilted(0.1) + 0.001 * rng().standard_normal(CAMERA.shape))
    first, second = find_crop(points, UP, rng()), find_crop(points, UP, rng())
    np.testing.assert_array_equal(first.normal, second.normal)
    assert first.offset == second.offset
