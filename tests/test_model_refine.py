"""A round of refinement: what it computes, whom it trusts, where its gradients go."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from tests.test_model_geometry import CAMERA, intrinsics, plane
from tests.test_model_networks import TINY_COMPACT, frame, joint
from tofcapture_model.geometry.maps import depth_to_normals, propagate_depth, scale_intrinsics, unit
from tofcapture_model.losses import MIN_ERROR
from tofcapture_model.networks.heads import Refinement

K = intrinsics(CAMERA, torch.float32)


def noisy(seed=0):
    """Depth, normals and expected error of a slanted plane, each with noise; some errors are below the floor of eq. 1."""
    g = torch.Generator().manual_seed(seed)
    depth, normal = plane(CAMERA, 0.2, 0.1, dtype=torch.float32)
    normals = unit(normal[None, :, None, None] + 0.1 * torch.randn(1, 3, *CAMERA.shape, generator=g))
    error = MIN_ERROR * (0.2 + 9 * torch.rand(depth.shape, generator=g))
    return depth + 0.002 * torch.randn(depth.shape, generator=g), normals, error


def refinement(depth_share, normal_share):
    """One round that goes these shares of a full step, which is what untrained gains take."""
    out = Refinement(1, 1)
    with torch.no_grad():
        out.depth_gain.mul_(depth_share)
        out.normal_gain.mul_(normal_share)
    return out


@pytest.mark.parametrize(("depth_share", "normal_share"), [(1.0, 1.0), (0.75, 0.5)])
def test_a_round_goes_its_share_of_the_way_the_geometry_says(depth_share, normal_share):
    """First towards the normals of the depth, then, with these, towards the votes; all trusted by the inverse square of the expected error."""
    depth, normals, error = noisy()
    trust = error.clamp_min(MIN_ERROR) ** -2
    trust = trust / trust.max()
    turned = unit(normals + normal_share * (depth_to_normals(depth, trust, K) - normals))
    moved = depth + depth_share * (propagate_depth(depth, turned, K, trust, 1, step=2) - depth)
    found = refinement(depth_share, normal_share)(depth, normals, error, K)
    torch.testing.assert_close(found[1], turned)
    torch.testing.assert_close(found[0], moved, atol=1e-6, rtol=0)


def test_gains_learn_to_go_further_where_the_geometry_is_right():
    """From half a step the loss falls with both gains: fitted normals and votes are nearer to the truth than the noisy maps."""
    depth, normals, error = noisy()
    truth, normal = plane(CAMERA, 0.2, 0.1, dtype=torch.float32)
    halfway = refinement(0.5, 0.5)
    out, turned = halfway(depth, normals, torch.full_like(error, 0.003), K)
    ((out - truth).square().mean() + (turned - normal[None, :, None, None]).square().mean()).backward()
    assert (halfway.depth_gain.grad < 0).all()
    assert (halfway.normal_gain.grad < 0).all()


def test_neither_the_error_map_nor_the_depth_learns_from_what_it_is_measured_with():
    """Trust carries no gradient to the error, fitted normals none to the depth; the depth has one by its own votes."""
    depth, normals, error = (x.requires_grad_() for x in noisy())
    out, turned = refinement(0.5, 0.5)(depth, normals, error, K)
    both = out.sum() + turned.sum()
    assert torch.autograd.grad(both, error, allow_unused=True, retain_graph=True)[0] is None
    assert torch.autograd.grad(turned.sum(), depth, allow_unused=True, retain_graph=True)[0] is None
    assert torch.autograd.grad(out.sum(), depth)[0].abs().sum() > 0


@pytest.mark.parametrize("at", [(4, 4), (4, 5)], ids=["the doubted pixel", "its neighbour"])
def test_votes_count_by_the_confidence_of_the_voter(at):
    """A pixel 1 cm off that nobody trusts neither stays where it is nor moves its neighbours."""
    depth, trust = (torch.full((1, 1, 9, 9), x, dtype=torch.float64) for x in (0.8, 1.0))
    depth[..., 4, 4], trust[..., 4, 4] = 0.81, 1e-3
    facing = torch.tensor([0.0, 0, -1], dtype=torch.float64)[None, :, None, None].expand(1, 3, 9, 9)
    k = torch.tensor([[50.0, 50.0, 4.0, 4.0]], dtype=torch.float64)
    moved = propagate_depth(depth, facing, k, trust, radius=1)
    assert moved[0, 0][at].item() == pytest.approx(0.8, abs=0.01 * 1e-3)


def test_the_model_refines_what_it_found_at_twice_the_resolution():
    """With the intrinsics of the fine grid; the estimate before refinement is kept beside it."""
    torch.manual_seed(0)
    model = joint(TINY_COMPACT).eval()
    data = frame()
    with torch.no_grad():
        found = model(data)
        fine = scale_intrinsics(data.intrinsics, 2)
        expected = model.refinement(found.initial_depth, found.initial_normals, found.error, fine)
    assert torch.equal(found.depth, expected[0])
    assert torch.equal(found.normals, expected[1])
    assert not torch.equal(found.depth, found.initial_depth)
    assert not torch.equal(found.normals, found.initial_normals)
