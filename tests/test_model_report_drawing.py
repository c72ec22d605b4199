"""What the report draws with: PNG encoders, colour scales, masks, clouds seen from the side, the choice of views."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from tofcapture.files.manifest import Manifest, SceneEntry
from tofcapture.poses import look_at
from tofcapture_model.report.clouds import BACKGROUND, render, shaded_palette, side_view
from tofcapture_model.report.examples import choose
from tofcapture_model.report.panels import mask_indices, nice_limit
from tofcapture_model.report.pictures import NO_VALUE, Scale, indexed_png, palette, rgb_png


@given(hnp.arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_png_keeps_every_pixel(indices, seed):
    """Both encoders agree with an independent decoder."""
    from matplotlib.image import imread

    rng = np.random.default_rng(seed)
    colours = rng.integers(0, 256, (256, 3)).astype(np.uint8)
    image = rng.integers(0, 256, (*indices.shape, 3)).astype(np.uint8)
    assert np.array_equal(decoded(imread, indexed_png(indices, colours)), colours[indices])
    assert np.array_equal(decoded(imread, rgb_png(image)), image)


def decoded(imread, png):
    """Colours of a PNG."""
    import io

    return np.rint(255 * imread(io.BytesIO(png), format="png")[..., :3]).astype(np.uint8)


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e3), st.sampled_from([1.0, 2.0]))
@settings(max_examples=30, deadline=None)
def test_scale_spans_its_colours(low, span, power):
    """The ends have the first and the last colour, beyond them nothing changes, NaN is grey."""
    scale = Scale("viridis", low, low + span, "mm", power)
    values = np.array([[low, low + span, low - 1, low + span + 1, np.nan]])
    assert scale.indices(values).tolist() == [[0, NO_VALUE - 1, 0, NO_VALUE - 1, NO_VALUE]]
    assert len(scale.ticks) == 5
    assert palette("viridis").shape == (256, 3)


def test_limits_are_round():
    """An error scale ends at a round number that covers what was asked."""
    assert nice_limit(np.array([1.0, -7.0, np.nan]), 100) == 10
    assert nice_limit(np.full(3, np.nan), 95) == 10
    assert nice_limit(np.array([1e6]), 95) == 1000


def test_mask_colour_is_that_of_the_first_bit():
    """Good pixels are 0; of several bits the first one decides."""
    assert mask_indices(np.array([[0, 1, 2, 4, 8, 16, 24, 17]], np.uint8)).tolist() == [
        [0, 1, 2, 3, 4, 5, 4, 1]
    ]


def test_views_are_taken_evenly():
    """The choice covers the split and does not depend on anything but names and counts."""
    entry = SceneEntry("shards/a.h5", "0", 4, "test")
    manifest = Manifest({"b": entry, "a": entry, "c": SceneEntry("shards/c.h5", "0", 4, "train")})
    assert choose(manifest, "test", 4) == [("a", 0), ("a", 2), ("b", 0), ("b", 2)]
    assert len(choose(manifest, "test", 99)) == 8
    assert choose(manifest, "val", 3) == []


def test_near_points_hide_far_ones():
    """Of two points on a line of sight the nearer one is drawn, whatever their order."""
    eye = side_view(look_at([0.5, 0, 0.5], [0, 0, 0]), np.array([0.0, 0.0, 0.7]))
    forward = eye[:3, 2]
    points = np.array([0.0, 0.0, 0.7]) + np.array([[0.05], [-0.05]]) * forward
    normals = np.stack([-forward, -forward])
    one = render(points, normals, np.array([0.0, 1.0]), eye, 1e-3)
    two = render(points[::-1], normals, np.array([1.0, 0.0]), eye, 1e-3)
    assert np.array_equal(one, two)
    colour = shaded_palette("RdBu_r")[one[180, 240]].astype(int)
    assert colour[0] > colour[2]  # the near one is red
    assert tuple(shaded_palette("RdBu_r")[one[0, 0]]) == BACKGROUND
