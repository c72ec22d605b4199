"""Procedural objects: closed, outward, resting on the table, of sensible size, different and repeatable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.devices.sim.shapes import FAMILIES, ball
from tofcapture.errors import ConfigError
from tofcapture.meshes import (
    circle,
    cuboid,
    extrude,
    join,
    rectangle,
    revolve,
    settle,
    shift,
    signed_area,
    triangulate,
    tube,
    volume,
)


def assert_closed(mesh):
    """Each edge belongs to two triangles, in opposite directions; every vertex is used."""
    vertices, triangles = mesh
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    n = len(vertices)
    there, back = edges @ [n, 1], edges @ [1, n]
    assert len(np.unique(there)) == len(there)
    assert (np.sort(there) == np.sort(back)).all()
    assert len(np.unique(triangles)) == n


@pytest.mark.parametrize("family", sorted(FAMILIES))
@pytest.mark.parametrize("seed", range(6))
def test_family(family, seed):
    """Every object is watertight, wound outwards, rests on z = 0, is centred, and 4 to 30 cm large; no triangle is degenerate."""
    mesh = FAMILIES[family](np.random.default_rng(seed))
    vertices, triangles = mesh
    assert vertices.dtype == np.float64
    assert triangles.dtype == np.int64
    assert_closed(mesh)
    assert volume(mesh) > 0
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert abs(low[2]) < 1e-12
    assert np.abs(low + high)[:2].max() < 1e-9
    assert 0.04 <= (high - low).max() <= (0.5 if family == "board" else 0.30)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-14


@pytest.mark.parametrize("family", sorted(FAMILIES.keys() - {"board"}))
def test_seeds_differ_and_repeat(family):
    """The same seed gives the same object, another seed another one."""
    make = FAMILIES[family]
    first, again, other = (make(np.random.default_rng(s)) for s in (1, 1, 2))
    assert first[0].tobytes() == again[0].tobytes()
    assert first[0].shape != other[0].shape or not np.allclose(first[0], other[0])


def test_enough_families():
    """There are at least twelve families beside the board."""
    assert len(FAMILIES) >= 13


def test_curved_surfaces_are_smooth():
    """A sphere has over 1500 triangles and its volume is the formula's to half a percent."""
    mesh = ball(0.05)
    assert len(mesh[1]) > 1500
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.05**3, rel=5e-3)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), corners=st.integers(3, 40), holes=st.integers(0, 9), flip=st.booleans())
def test_triangulation_covers_the_polygon(seed, corners, holes, flip):
    """Triangles of a star-shaped polygon with holes sum to its area, all counter-clockwise, P + 2 H - 2 of them."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(corners) / corners
    outer = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(3, 6, (corners, 1))
    grid = [(x, y) for x in (-0.5, 0.0, 0.5) for y in (-0.5, 0.0, 0.5)]
    inner = [circle(rng.uniform(0.05, 0.22), grid[i], int(rng.integers(3, 12))) for i in range(holes)]
    if flip:
        outer, inner = outer[::-1], [h[::-1] for h in inner]
    points, triangles, rings = triangulate(outer, inner)
    areas = np.array([signed_area(points[t]) for t in triangles])
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(
        abs(signed_area(outer)) - sum(abs(signed_area(h)) for h in inner), rel=1e-9
    )
    assert len(triangles) == len(points) + 2 * holes - 2
    assert signed_area(points[rings[0]]) > 0
    assert all(signed_area(points[r]) < 0 for r in rings[1:])


def test_corners_on_a_line():
    """A staircase, whose inner corners all lie on one line, is triangulated without a degenerate triangle."""
    outline = [[0, 0], [4, 0]] + [p for i in range(4, 0, -1) for p in ([i, 5 - i], [i - 1, 5 - i])]
    points, triangles, _ = triangulate(np.array(outline, dtype=float))
    assert min(signed_area(points[t]) for t in triangles) > 0.1


def test_crossing_outlines_are_refused():
    """A bow tie and a hole across the outline raise instead of yielding nonsense."""
    with pytest.raises(ConfigError, match="crosses"):
        triangulate(np.array([[0, 0], [2, 2], [2, 0], [0, 2.0]]))
    with pytest.raises(ConfigError, match="hole"):
        triangulate(rectangle(1, 1), [rectangle(3, 3)])


def test_builders_have_exact_volumes():
    """Prism, box, drilled plate and cone have the volumes of their formulas."""
    assert volume(cuboid(0.1, 0.2, 0.3)) == pytest.approx(0.006)
    drilled = extrude(rectangle(2, 1), 0.5, [rectangle(0.5, 0.5)])
    assert volume(drilled) == pytest.approx(0.5 * (2 - 0.25))
    frustum = revolve([[0, 0], [1, 0], [0.5, 1], [0, 1]], segments=720)
    assert volume(frustum) == pytest.approx(np.pi / 3 * (1 + 0.5 + 0.25), rel=1e-4)
    bar = tube(np.linspace([0, 0, 0], [0, 0, 2], 4), 0.1, (0, 1, 0), segments=720)
    assert volume(bar) == pytest.approx(np.pi * 0.01 * 2, rel=1e-4)
    for mesh in (drilled, frustum, bar):
        assert_closed(mesh)


def test_join_keeps_components_and_settle_rests():
    """Joined parts stay closed and keep their volumes; settling centres them on the table."""
    both = join(cuboid(1, 1, 1), shift(cuboid(2, 1, 1), x=5, z=3))
    assert_closed(both)
    assert volume(both) == pytest.approx(3)
    vertices = settle(both)[0]
    assert vertices[:, 2].min() == 0
    assert vertices[:, 0].min() == pytest.approx(-vertices[:, 0].max())


def test_profile_must_close():
    """A profile that does not end on the axis is refused."""
    with pytest.raises(ConfigError, match="axis"):
        revolve([[0, 0], [1, 0], [1, 1]])
