"""The robust Chamfer loss against a k-d tree, and what its seven candidates do and do not supervise."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

torch = pytest.importorskip("torch")

from tofcapture_model.geometry.maps import unproject
from tofcapture_model.losses.chamfer.neighbours import nearest
from tofcapture_model.losses.chamfer.robust import candidate_shifts, robust_chamfer

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
    found = nearest(p[0], q[0], mp[0, 0], mq[0, 0], K[0], candidate_shifts())
    truth = [oracle(p, q, mp, mq, shift) for shift in candidate_shifts().numpy()]
    for one, expected in zip(found, truth, strict=True):
        mean = one.squared[0][mp[0, 0]].mean() + one.squared[1][mq[0, 0]].mean()
        assert mean.item() == pytest.approx(expected, rel=1e-5)
    best = robust_chamfer(p, q, mp, mq, K)
    assert best.loss.item() == pytest.approx(min(truth), rel=1e-5)
    assert best.winner.item() == truth.index(min(truth))
    assert all(low <= high * (1 + 1e-5) for low, high in zip(best.candidates[0].tolist(), truth, strict=True))


def brute(p, q, p_mask, q_mask, jitter=0.01):
    """Loss and winner by comparing every point with every other."""
    a, b = p[0][:, p_mask[0, 0]].T, q[0][:, q_mask[0, 0]].T
    losses = []
    for s in candidate_shifts(jitter):
        with torch.no_grad():
            apart = ((a + s)[:, None] - b[None]).square().sum(-1)
            to_q, to_p = apart.argmin(1), apart.argmin(0)
        losses.append((a + s - b[to_q]).square().sum(1).mean() + (a[to_p] + s - b).square().sum(1).mean())
    return min(losses)


def jumbled(seed):
    """Random depths, 0.2 to 3 m, pixel by pixel: no neighbour is near on the grid."""
    g = torch.Generator().manual_seed(seed)
    return 0.2 + 2.8 * torch.rand(1, 1, *SHAPE, generator=g), torch.rand(1, 1, *SHAPE, generator=g) > 0.3


def stepped(seed):
    """A bumpy surface with a box in front of it, whose edges fly, and a mask of the box and a part of the rest."""
    depth, mask = surface(seed)
    depth[..., 10:25, 12:30] -= 0.2
    depth = torch.nn.functional.avg_pool2d(depth, 3, 1, 1, count_include_pad=False)
    mask[..., :4] = False
    return depth, mask


@pytest.mark.parametrize("pair", ["jumbled", "stepped", "apart"])
def test_values_and_gradients_are_those_of_brute_force(pair):
    """To 1e-5, on random depths, across depth steps and between surfaces that are further apart than any window."""
    make = jumbled if pair == "jumbled" else stepped
    (start, mp), (dq, mq) = make(0), make(1)
    start = start + (0.06 if pair == "apart" else 0.0)
    both = []
    for way in (lambda p, q: robust_chamfer(p, q, mp, mq, K).loss.sum(), lambda p, q: brute(p, q, mp, mq)):
        depth = start.clone().requires_grad_()
        loss = way(unproject(depth, K), unproject(dq, K))
        loss.backward()
        both.append((loss.item(), depth.grad))
    assert both[0][0] == pytest.approx(both[1][0], rel=1e-5)
    assert (both[0][1] - both[1][1]).norm() <= 1e-5 * both[1][1].norm()


def test_a_batch_is_its_items():
    """Items do not see each other."""
    (a, ma), (b, mb) = surface(0), stepped(1)
    p, q = unproject(torch.cat([a, b]) + 0.003, K.expand(2, 4)), unproject(torch.cat([b, a]), K.expand(2, 4))
    mask = torch.cat([ma, mb])
    both = robust_chamfer(p, q, mask, mask, K.expand(2, 4)).loss
    alone = [
        robust_chamfer(p[i : i + 1], q[i : i + 1], mask[i : i + 1], mask[i : i + 1], K).loss for i in range(2)
    ]
    assert torch.equal(both, torch.cat(alone))


def test_the_soft_least_lies_between_the_least_and_the_mean():
    """A small softness gives the least of the seven, a large one their mean; all candidates then are exact."""
    (dp, mask), (dq, _) = surface(0), surface(1)
    p, q = unproject(dp + 0.003, K), unproject(dq, K)
    hard = robust_chamfer(p, q, mask, mask, K).loss.item()
    tight, loose = (robust_chamfer(p, q, mask, mask, K, softness=s) for s in (1e-8, 1.0))
    assert tight.loss.item() == pytest.approx(hard, rel=1e-2)
    assert loose.loss.item() == pytest.approx(loose.candidates.mean().item(), rel=1e-3)


def test_distances_to_planes_forgive_what_slides_along_them():
    """A facing plane that moved sideways by 3 mm costs nothing to its tangent planes, but does to its points."""
    depth = torch.full((1, 1, *SHAPE), 0.8)
    mask = torch.ones_like(depth, dtype=torch.bool)
    q = unproject(depth, K)
    p = q + torch.tensor([0.003, 0.0, 0.0])[None, :, None, None]
    normals = torch.zeros_like(q)
    normals[:, 2] = -1
    assert robust_chamfer(p, q, mask, mask, K, normals=normals).loss.item() < 1e-12
    assert robust_chamfer(p, q, mask, mask, K).loss.item() > 1e-6


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_bias_of_exactly_one_jitter_costs_nothing(axis, sign):
    """The minimum over seven copies forgives 10 mm along an axis entirely: eq. 1 has to supervise absolute depth."""
    depth, mask = surface()
    q = unproject(depth, K)
    p = q.clone()
    p[:, axis] += sign * 0.010
    found = robust_chamfer(p, q, mask, mask, K)
    assert found.loss.item() < 1e-12
    assert found.winner.item() == 1 + 2 * axis + (sign > 0)


@pytest.mark.parametrize("bias", [0.005, -0.005])
def test_half_a_jitter_costs_its_square_twice(bias):
    """A z bias of 5 mm of a facing plane costs 25 mm^2 per point in each direction, to either side."""
    depth = torch.full((1, 1, *SHAPE), 0.8)
    mask = torch.ones_like(depth, dtype=torch.bool)
    q = unproject(depth, K)
    p = q + torch.tensor([0.0, 0.0, bias])[None, :, None, None]
    loss = robust_chamfer(p, q, mask, mask, K).loss.item()
    assert loss == pytest.approx(2 * 25e-6, rel=1e-3)


def test_lengths_scale_squared():
    """Scaling all lengths, the jitter included, by k scales the loss by k^2."""
    (dp, mask), (dq, _) = surface(0), surface(1)
    p, q = unproject(dp + 0.003, K), unproject(dq, K)
    one = robust_chamfer(p, q, mask, mask, K).loss.item()
    assert robust_chamfer(3 * p, 3 * q, mask, mask, K, jitter=0.03).loss.item() == pytest.approx(
        9 * one, rel=1e-4
    )


def test_gradient_moves_only_masked_points_and_agrees_with_differences():
    """Points outside the mask get no gradient; one inside gets the finite difference."""
    depth, mask = surface()
    q = unproject(surface(1)[0], K)
    moving = (depth + 0.002).requires_grad_()
    robust_chamfer(unproject(moving, K), q, mask, mask, K).loss.sum().backward()
    assert (moving.grad[~mask] == 0).all()
    at = tuple(mask.nonzero()[400].tolist())
    step = torch.zeros_like(depth)
    step[at] = 2e-4
    above, below = (
        robust_chamfer(unproject(moving.detach() + s, K), q, mask, mask, K).loss for s in (step, -step)
    )
    assert moving.grad[at].item() == pytest.approx(((above - below) / 4e-4).item(), rel=0.05)


def test_items_without_points_cost_nothing():
    """An empty mask gives zero and no NaN."""
    depth, mask = surface()
    moving = depth.clone().requires_grad_()
    loss = robust_chamfer(unproject(moving, K), unproject(depth, K), mask & False, mask, K).loss
    loss.sum().backward()
    assert loss.item() == 0
    assert torch.isfinite(moving.grad).all()
