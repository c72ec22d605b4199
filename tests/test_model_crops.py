"""Crops and mirrored frames: the same world seen through another window, and where crops are taken."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.test_model_baselines import target
from tests.test_model_networks import frame
from tofcapture_model.data import crop, crop_about_object, mirror
from tofcapture_model.frame import Frame, Target
from tofcapture_model.geometry.maps import scale_intrinsics, unproject

H, W = 36, 44


@pytest.fixture
def item():
    """A frame and its target without batch axes; the principal point is not in the middle, and the focal lengths differ."""
    data = frame(H, W, batch=1)
    truth = target(data)
    data = data._replace(intrinsics=torch.tensor([[40.0, 41.0, 20.3, 16.9]]))
    return Frame(*(x[0] for x in data)), Target(*(x[0] for x in truth))


def clouds(data, truth):
    """Points of the sensor's depth and of the ground truth."""
    k = data.intrinsics[None]
    return unproject(data.depth[None], k), unproject(truth.depth[None], scale_intrinsics(k, 2))


def test_a_crop_is_a_part_of_both_clouds(item):
    """The principal point moves with the window, at either resolution."""
    top, left, height, width = 3, 7, 20, 24
    coarse, fine = clouds(*item)
    cut = crop(*item, top, left, (height, width))
    found = clouds(*cut)
    torch.testing.assert_close(found[0], coarse[..., top : top + height, left : left + width])
    torch.testing.assert_close(
        found[1], fine[..., 2 * top : 2 * (top + height), 2 * left : 2 * (left + width)]
    )
    assert torch.equal(
        cut[1].good, item[1].good[..., 2 * top : 2 * (top + height), 2 * left : 2 * (left + width)]
    )


@pytest.mark.parametrize(("axis", "component"), [(-1, 0), (-2, 1)])
def test_a_mirrored_frame_shows_the_mirrored_clouds(item, axis, component):
    """Every point has its x (or y) turned round, to the pixel."""
    for before, after in zip(clouds(*item), clouds(*mirror(*item, axis)), strict=True):
        expected = before.flip(axis)
        expected[:, component] *= -1
        torch.testing.assert_close(after, expected)


def test_crops_are_taken_about_the_object():
    """An object that covers half a percent of the image is in at least 95 % of the crops, and not always in their middle."""
    data = frame(90, 120, batch=1)
    truth = target(data)
    good = torch.zeros_like(truth.good)
    good[..., 40:56, 24:40] = True
    data, truth = Frame(*(x[0] for x in data)), Target(*(x[0] for x in truth._replace(good=good)))
    seen = [crop_about_object(data, truth, (32, 32), np.random.default_rng(i))[1].good for i in range(200)]
    assert np.mean([bool(x.any()) for x in seen]) >= 0.95
    rows = [float(x[0].nonzero()[:, 0].float().mean()) for x in seen if x.any()]
    assert np.std(rows) > 8
