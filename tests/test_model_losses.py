"""Eq. 1 and eq. 3: values, scale, masks, and who gets a gradient."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from tofcapture_model.losses import (
    DELTA,
    EPSILON,
    MIN_ERROR,
    angle_loss,
    cosine_loss,
    error_map_loss,
    reweighted_smooth_l1,
    reweighting,
)


def maps(seed=0, shape=(2, 1, 12, 16)):
    """Depth, ground truth, error and mask with errors on both sides of delta."""
    g = torch.Generator().manual_seed(seed)
    gt = 0.5 + torch.rand(shape, generator=g)
    depth = gt + 0.03 * torch.randn(shape, generator=g)
    return depth, gt, 0.02 * torch.rand(shape, generator=g), torch.rand(shape, generator=g) > 0.3


def test_eq_1_is_lambda_times_torch_smooth_l1_over_delta():
    """The paper's two branches are ``lambda smooth_l1(beta = delta) / delta``."""
    depth, gt, error, mask = maps()
    theirs = torch.nn.functional.smooth_l1_loss(depth, gt, beta=0.02, reduction="none") / 0.02
    expected = (reweighting(gt, error, mask) * theirs)[mask].mean()
    torch.testing.assert_close(reweighted_smooth_l1(depth, gt, error, mask), expected)


def test_lambda_is_the_paper_s_up_to_its_mean():
    """Lambda is proportional to d / (e + epsilon) above a millimetre, flat below, and 1 on average."""
    _, gt, _, mask = maps()
    error = torch.where(torch.arange(16) % 2 == 0, 0.0, 0.004).expand_as(gt)
    weight = reweighting(gt, error, mask)
    assert weight[mask].mean().item() == pytest.approx(1, abs=1e-5)
    ratio = weight / (gt / (error.clamp_min(1e-3) + 1e-6))
    assert ratio.std() / ratio.mean() < 1e-5


def test_the_error_map_gets_no_gradient_from_eq_1_and_the_depth_none_from_it():
    """The error is detached in eq. 1, and the depth in the error's own loss."""
    depth, gt, error, mask = maps()
    depth.requires_grad_()
    error.requires_grad_()
    reweighted_smooth_l1(depth, gt, error, mask).backward()
    assert error.grad is None
    assert depth.grad.abs().sum() > 0
    depth.grad = None
    error_map_loss(error, depth, gt, mask).backward()
    assert depth.grad is None
    assert error.grad.abs().sum() > 0


def test_masked_pixels_get_no_gradient_not_even_from_nan():
    """Ground truth outside the mask may be anything, NaN included."""
    depth, gt, error, mask = maps()
    gt[~mask] = float("nan")
    depth.requires_grad_()
    loss = reweighted_smooth_l1(depth, gt, error, mask)
    loss.backward()
    assert torch.isfinite(loss)
    assert (depth.grad[~mask] == 0).all()
    assert torch.isfinite(depth.grad).all()


@pytest.mark.parametrize("k", [1000.0, 0.1])
def test_eq_1_does_not_depend_on_the_unit_of_length(k):
    """Scaling all lengths by k, delta and epsilon included, leaves the loss unchanged where no error is below the clamp."""
    depth, gt, error, mask = maps()
    error = error + 2 * MIN_ERROR * max(1, 1 / k)
    scaled = k * (error + EPSILON) - EPSILON
    assert min(error.min(), scaled.min()) > MIN_ERROR
    one = reweighted_smooth_l1(depth, gt, error, mask)
    other = reweighted_smooth_l1(k * depth, k * gt, scaled, mask, delta=k * DELTA)
    torch.testing.assert_close(other, one, rtol=1e-4, atol=0)


def test_eq_3_knows_angles_and_forgets_lengths():
    """1 - cos: 0 for parallel, 1 for perpendicular, 2 for opposite vectors of any length; the mask decides which count."""
    gt = torch.tensor([0.0, 0, -2]).reshape(1, 3, 1, 1).expand(1, 3, 1, 3)
    normals = torch.tensor([[0.0, 0, -5], [3, 0, 0], [0, 0, 0.1]]).T.reshape(1, 3, 1, 3)
    for i, expected in enumerate((0.0, 1.0, 2.0)):
        mask = (torch.arange(3) == i).reshape(1, 1, 1, 3)
        assert cosine_loss(normals, gt, mask).item() == pytest.approx(expected, abs=1e-6)


def test_the_angle_loss_is_an_angle_whose_pull_does_not_fade():
    """Near zero it is the angle in radians and its gradient is one per radian; opposite vectors cost 2."""
    gt = torch.tensor([0.0, 0, -1]).reshape(1, 3, 1, 1)
    mask = torch.ones(1, 1, 1, 1)
    for degrees in (1.0, 5.0, 20.0):
        angle = torch.tensor(degrees).deg2rad().requires_grad_()
        normals = torch.stack([angle.sin(), angle * 0, -angle.cos()]).reshape(1, 3, 1, 1)
        loss = angle_loss(normals, gt, mask)
        assert loss.item() == pytest.approx(2 * torch.sin(angle / 2).item(), abs=2e-3)
        loss.backward()
        assert angle.grad.item() == pytest.approx(1.0, abs=0.03)
    assert angle_loss(-gt, gt, mask).item() == pytest.approx(2.0, abs=2e-3)
    perfect = gt.clone().requires_grad_()
    angle_loss(perfect, gt, mask).backward()
    assert torch.isfinite(perfect.grad).all()


def test_an_empty_mask_costs_exactly_nothing():
    """No pixel, no loss, no NaN."""
    depth, gt, error, mask = maps()
    assert reweighted_smooth_l1(depth, gt, error, mask & False).item() == 0
