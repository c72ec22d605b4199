"""Numbers of the published baselines: what they read, what they lower, how their depth becomes an answer."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: N812

from tests.test_model_baselines import target
from tests.test_model_inputs import slanted
from tests.test_model_networks import frame
from tofcapture_model.evaluation.metrics import angles_deg
from tofcapture_model.frame import Estimate
from tofcapture_model.networks.baselines import Baseline, lf2
from tofcapture_model.networks.baselines.coarse_fine import CoarseFine, mpi_features
from tofcapture_model.networks.baselines.guo2018 import MRM
from tofcapture_model.networks.baselines.su2018 import FAR, START, TV, ToFNet, weighted_variation


def answer(depth):
    """An estimate of which a baseline's loss sees the depth alone."""
    return Estimate(depth, None, None, depth, None)


def test_coarse_fine_reads_depth_gap_and_the_ratio_of_amplitudes():
    """Metres, metres of the low minus the high frequency, and low over high minus one, at most three."""
    data = frame(batch=1)
    data = data._replace(gap=30 * data.gap)
    low, high = (z.norm(dim=1, keepdim=True) for z in data.phasor.chunk(2, dim=1))
    depth, gap, ratio = mpi_features(data).split(1, dim=1)
    assert torch.equal(depth, data.depth)
    assert torch.equal(gap, data.gap.clamp(-1, 1))
    bright = high > 0.01
    torch.testing.assert_close(ratio[bright], (low / high).clamp(0, 3)[bright] - 1, atol=0.02, rtol=0)


def test_both_branches_of_coarse_fine_add_to_the_depth():
    """The fine one sees the depth that the coarse one has corrected; its answer is a correction of the decoded depth."""
    data, model, seen = frame(batch=1), CoarseFine(), []
    model.fine.register_forward_pre_hook(lambda _, given: seen.append(given[0][:, -1:]))
    with torch.no_grad():
        for layer, value in ((model.coarse[-1], 0.03), (model.fine[-1], -0.02)):
            layer.weight.zero_()
            layer.bias.fill_(value)
        found = model.estimate_depth(data)
    torch.testing.assert_close(seen[0], data.depth + 0.03)
    torch.testing.assert_close(found, data.depth - 0.02)


def test_the_variation_is_forgiven_where_the_amplitude_steps():
    """A step of the depth costs its height times its share of the pixels; exp(-w) of it where the stretched amplitude steps by w."""
    data = frame(batch=1)
    phasor = torch.zeros_like(data.phasor)
    phasor[:, 0] = torch.where(torch.arange(44) < 22, 0.1, 0.5)
    data = data._replace(phasor=phasor)

    def step_at(column):
        depth = torch.where(torch.arange(88) < column, 0.8, 0.9).expand(1, 1, 72, 88)
        return weighted_variation(depth, data).item()

    assert step_at(20) == pytest.approx(0.1 / 88, rel=1e-2)
    forgiven = 0.5  # doubled, a step of 1 is steps of 1/4, 1/2 and 1/4
    assert step_at(44) == pytest.approx(0.1 / 88 * math.exp(-forgiven), rel=1e-2)


def test_tofnet_lowers_the_mean_error_and_a_little_variation():
    """L1 over the good pixels and TV times the variation, both in half the range."""
    data = frame(batch=1)
    truth = target(data)
    estimate = answer(truth.depth + torch.where(truth.good, 0.1, 7.0))
    expected = 0.1 + TV * weighted_variation(estimate.depth, data)
    assert ToFNet(4).loss(estimate, truth, data).item() * FAR / 2 == pytest.approx(expected.item(), rel=1e-4)
    smooth = answer(truth.depth + 0.1)
    assert ToFNet(4).loss(smooth, truth, data).item() * FAR / 2 == pytest.approx(0.1, rel=0.01)


def test_tofnet_starts_where_the_rig_works():
    """Untrained it answers about START everywhere, which the tanh reaches from where it has a slope."""
    torch.manual_seed(0)
    found = ToFNet(8)(frame(batch=1)).depth
    assert (found - START).abs().max() < 0.1


def test_the_kernel_network_lowers_the_root_mean_square():
    """Of the good pixels: 1 and 3 cm give their root mean square, not 2 cm."""
    data = frame(batch=1)
    truth = target(data)
    off = torch.where(torch.arange(88) < 44, 0.01, 0.03).expand(1, 1, 72, 88)
    loss = MRM.loss(None, answer(truth.depth + torch.where(truth.good, off, 7.0)), truth, data).item()
    assert loss == pytest.approx(off[truth.good].square().mean().sqrt().item(), rel=1e-3)


def test_normals_of_a_baseline_are_those_of_its_depth_at_twice_the_resolution():
    """With the intrinsics of the fine grid, of a slanted plane within what the pixels of the doubled depth allow."""
    data = frame(batch=1)
    depth, normal = slanted(data)

    class Oracle(Baseline):
        def estimate_depth(self, frame):
            return F.avg_pool2d(depth, 2)

    found = Oracle()(data)
    assert torch.equal(found.depth, found.initial_depth)
    inner = found.normals[..., 12:-12, 12:-12]
    assert angles_deg(inner.flatten(2), normal.expand_as(inner).flatten(2)).max() < 2


def test_the_classical_filter_leaves_what_is_even_as_it_was():
    """Phasors without noise have no other mean: whatever the two frequencies' phases are, the depth stays, and is measured."""
    data = frame(batch=1)
    low, high = torch.zeros(1, 2, 36, 44), torch.zeros(1, 2, 36, 44)
    low[:, 0], high[:, 1] = 0.1, 0.1
    even = {"depth": torch.full_like(data.depth, 0.8), "gap": torch.zeros_like(data.gap)}
    depth, normals, measured = lf2.estimate(data._replace(phasor=torch.cat([low, high], dim=1), **even))
    torch.testing.assert_close(depth, torch.full((1, 1, 72, 88), 0.8))
    assert normals[:, 2].max() < -0.99
    assert measured.all()


def test_flying_pixels_between_two_surfaces_are_given_up_and_the_surfaces_are_not():
    """A pixel half way between a bright foreground and a dark background."""
    at = torch.arange(9)

    def row(near, between, far):
        return torch.where(at < 4, near, torch.where(at == 4, between, far)).expand(1, 1, 9, 9)

    found = lf2.flying(row(0.6, 0.75, 0.9), row(0.3, 0.2, 0.1))
    assert found[..., 4].all()
    assert not found[..., :3].any()
    assert not found[..., 6:].any()
