"""The robust Chamfer loss against a k-d tree, and what its seven candidates do and do not supervise."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

torch = pytest.importorskip("torch")

from tofcapture_model.chamfer import candidate_shifts, robust_chamfer, search_radius
from tofcapture_model.geometry import unproject

K = torch.tensor([[60.0, 60.0, 23.5, 17.5]])
SHAPE = (36, 48)


def surface(seed=0):
    """A bumpy depth map, and a mask with holes."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    depth = 0.8 + 0.05 * np.sin(u / 7) * np.cos(v / 5) + rng.normal(0, 0.002, SHAPE)
    mask = rng.random(SHAPE) > 0.1
    return torch.tensor(depth, dtype=torch.float32)[None, None], torch.tensor(mask)[None, None]


def oracle(p, q, p_mask, q_mask, shift):
    """Mean squared nearest-neighbour distance both ways with a k-d tree."""
    a = p[0].permute(1, 2, 0)[p_mask[0, 0]].double().numpy() + shift
    b = q[0].permute(1, 2, 0)[q_mask[0, 0]].double().numpy()
    return (cKDTree(b).query(a)[0] ** 2).mean() + (cKDTree(a).query(b)[0] ** 2).mean()


def test_grid_search_agrees_with_a_kd_tree_for_all_candidates():
    """The windowed search finds the same seven distances as an exact search in space."""
    (dp, mp), (dq, mq) = surface(0), surface(1)
    p, q = unproject(dp + 0.004, K), unproject(dq, K)
    found = robust_chamfer(p, q, mp, mq, radius=6)
    for k, shift in enumerate(candidate_shifts().numpy()):
        assert found.candidates[0, k].item() == pytest.approx(oracle(p, q, mp, mq, shift), rel=1e-4)
    assert found.loss.item() == pytest.approx(found.candidates.min().item(), rel=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_bias_of_exactly_one_jitter_costs_nothing(axis, sign):
    """The minimum over seven copies forgives 10 mm along an axis entirely: eq. 1 has to supervise absolute depth."""
    depth, mask = surface()
    q = unproject(depth, K)
    p = q.clone()
    p[:, axis] += sign * 0.010
    found = robust_chamfer(p, q, mask, mask, radius=4)
    assert found.loss.item() < 1e-12
    assert found.winner.item() == 1 + 2 * axis + (sign > 0)


@pytest.mark.parametrize("bias", [0.005, -0.005])
def test_half_a_jitter_costs_its_square_twice(bias):
    """A z bias of 5 mm of a facing plane costs 25 mm^2 per point in each direction, to either side."""
    depth = torch.full((1, 1, *SHAPE), 0.8)
    mask = torch.ones_like(depth, dtype=torch.bool)
    q = unproject(depth, K)
    p = q + torch.tensor([0.0, 0.0, bias])[None, :, None, None]
    loss = robust_chamfer(p, q, mask, mask, radius=3).loss.item()
    assert loss == pytest.approx(2 * 25e-6, rel=1e-3)


def test_lengths_scale_squared():
    """Scaling all lengths, the jitter included, by k scales the loss by k^2."""
    (dp, mask), (dq, _) = surface(0), surface(1)
    p, q = unproject(dp + 0.003, K), unproject(dq, K)
    one = robust_chamfer(p, q, mask, mask, radius=4).loss.item()
    assert robust_chamfer(3 * p, 3 * q, mask, mask, radius=4, jitter=0.03).loss.item() == pytest.approx(
        9 * one, rel=1e-4
    )


def test_gradient_moves_only_masked_points_and_agrees_with_differences():
    """Points outside the mask get no gradient; one inside gets the finite difference."""
    depth, mask = surface()
    q = unproject(surface(1)[0], K)
    moving = (depth + 0.002).requires_grad_()
    robust_chamfer(unproject(moving, K), q, mask, mask, radius=4).loss.sum().backward()
    assert (moving.grad[~mask] == 0).all()
    at = tuple(mask.nonzero()[400].tolist())
    step = torch.zeros_like(depth)
    step[at] = 2e-4
    above, below = (
        robust_chamfer(unproject(moving.detach() + s, K), q, mask, mask, radius=4).loss for s in (step, -step)
    )
    assert moving.grad[at].item() == pytest.approx(((above - below) / 4e-4).item(), rel=0.05)


def test_items_without_points_cost_nothing():
    """An empty mask gives zero and no NaN."""
    depth, mask = surface()
    moving = depth.clone().requires_grad_()
    loss = robust_chamfer(unproject(moving, K), unproject(depth, K), mask & False, mask, radius=2).loss
    loss.sum().backward()
    assert loss.item() == 0
    assert torch.isfinite(moving.grad).all()


def test_search_radius_covers_the_jitter():
    """10 mm at 1 m are 4 pixels at f' = 400."""
    assert search_radius(400, 1.0) == 5
