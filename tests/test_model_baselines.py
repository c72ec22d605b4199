"""The published baselines: sizes, what they answer untrained, where their gradients go."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from tests.test_model_networks import frame
from tofcapture.errors import ConfigError
from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.config import BASELINES, Config, Losses, Stage, loads_config, preset
from tofcapture_model.frame import Target
from tofcapture_model.geometry.maps import metres_per_radian, rays, turn
from tofcapture_model.networks import build_model, select_stage, training_loss
from tofcapture_model.networks.baselines import Baseline, decode, lf2, upsample_depth
from tofcapture_model.networks.baselines.coarse_fine import CoarseFine
from tofcapture_model.networks.baselines.guo2018 import MRM


def target(data):
    """Ground truth 5 mm behind the decoded depth."""
    depth = upsample_depth(data.depth) + 0.005
    normals = torch.zeros(len(depth), 3, *depth.shape[-2:])
    normals[:, 2] = -1
    good = torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) > 0.3
    return Target(depth, normals, good, ~good)


def count(model):
    """Number of parameters."""
    return sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("su2018", 12_028_225),
        ("guo2018", 11_018_648),
        ("paper", 0),
    ],
)
def test_presets_have_the_published_sizes(name, parameters):
    """Su 2018 and Guo 2018 have the parameters of their releases; the paper's depth network is a U-Net of base 64."""
    model = build_model(preset(name))
    if name != "paper":
        assert count(model) == parameters
        return
    heads = {part: count(getattr(model, part)) for part in ("raw2depth", "error_map", "raw2normal")}
    # a U-Net of 10 -> 1 channels has 31,035,777; a further output costs 65, a further input 576
    assert heads["raw2depth"] == 31_035_777 + 65 * 36
    assert heads["error_map"] == 31_035_777 + 65 * 3 + 576 * 4
    assert heads["raw2normal"] == 31_035_777 + 65 * 11


def test_coarse_fine_has_the_published_size():
    """144,386 parameters for the five features of three frequencies; two frequencies have three features."""
    assert count(CoarseFine(5)) == 144_386
    assert count(build_model(preset("coarse-fine"))) == count(CoarseFine(3))


@pytest.mark.parametrize("kind", BASELINES)
def test_baselines_answer_and_all_their_parameters_learn(kind):
    """Depth at twice the size, unit normals; the own loss reaches every parameter from the good pixels alone."""
    config = preset(kind)
    model = build_model(replace(config, network=replace(config.network, width=4)))
    data = frame(36, 44)
    learning = select_stage(model, "depth")
    assert len(learning) == len(list(model.parameters()))
    if isinstance(model, MRM):  # the last layer starts at zero, which stops the gradient of all before it
        torch.nn.init.normal_(model.head[-1].weight, std=1e-3)
    found = model(data, "depth")
    assert found.depth.shape == (2, 1, 72, 88)
    torch.testing.assert_close(found.normals.norm(dim=1), torch.ones(2, 72, 88))
    truth = target(data)
    loss = training_loss(model, Losses(), "depth", found, truth, data)
    loss.total.backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in learning)
    assert sum(float(p.grad.abs().sum()) for p in learning) > 0
    elsewhere = truth._replace(depth=torch.where(truth.good, truth.depth, 7.0))
    assert training_loss(model, Losses(), "depth", found, elsewhere, data).total == loss.total


@pytest.mark.parametrize("kind", ["guo2018"])
def test_an_untrained_kernel_network_is_the_sensor(kind):
    """The kernels start as the identity: decoding the mixed channels gives the frame's own depth."""
    data = coherent(frame())
    found = build_model(preset(kind))(data)
    torch.testing.assert_close(found.depth, upsample_depth(data.depth), atol=1e-4, rtol=0)


def coherent(data):
    """Make the phasors those of the raw channels."""
    return data._replace(phasor=torch.einsum("bpc,bchw->bphw", data.demodulation, data.raw))


def turned(phasor, angle):
    """Phasors (B, 2, H, W) turned by an angle, radians."""
    i, q = phasor.unbind(1)
    c, s = torch.as_tensor(angle).cos(), torch.as_tensor(angle).sin()
    return torch.stack([i * c - q * s, i * s + q * c], 1)


def measured(data, low, high):
    """Make phasors (B, 2, H, W), and depth and gap what the decoder makes of them alone, without calibration."""
    metres = [metres_per_radian(data, which) for which in (0, 1)]
    first, second = (
        torch.atan2(z[:, 1:], z[:, :1]).remainder(2 * math.pi) * m
        for z, m in zip((low, high), metres, strict=True)
    )
    wrap, full = (2 * math.pi * m for m in reversed(metres))
    gap = first - second
    gap = gap - wrap * (gap / wrap).round()
    lean = data.modulation.square() / data.modulation.square().sum(1, keepdim=True)
    range_ = (first - lean[:, 1].reshape(-1, 1, 1, 1) * gap).remainder(full)
    length = rays(data.intrinsics, *data.depth.shape[-2:]).norm(dim=1, keepdim=True)
    return data._replace(phasor=torch.cat([low, high], 1), depth=range_ / length, gap=gap)


def wall(data, depth, noise, seed=0):
    """Phasors of amplitude 0.1 of a wall, with noise of this standard deviation in I and in Q."""
    length = rays(data.intrinsics, *data.depth.shape[-2:]).norm(dim=1)
    phases = [depth * length / metres_per_radian(data, which)[:, 0] for which in (0, 1)]
    clean = [0.1 * torch.stack([phase.cos(), phase.sin()], 1) for phase in phases]
    g = torch.Generator().manual_seed(seed)
    return [z + noise * torch.randn(z.shape, generator=g) for z in clean]


def test_turning_both_phasors_moves_the_depth_along_its_ray():
    """A turn of 0.1 rad at 100 MHz is 23.86 mm of range, less in z at the border; at 20 MHz it is a fifth of the turn."""
    data = frame()
    angle = 0.1
    low, high = turned(data.phasor[:, :2], angle / 5), turned(data.phasor[:, 2:], angle)
    torch.testing.assert_close(
        turn(high, data.phasor[:, 2:]), torch.full_like(data.depth, angle), atol=1e-4, rtol=0
    )
    length = rays(data.intrinsics, 36, 44).norm(dim=1, keepdim=True)
    depth, gap = decode(data, low, high)
    moved = (depth - data.depth) * length
    expected = angle * SPEED_OF_LIGHT / (4 * math.pi * 100e6)
    torch.testing.assert_close(moved, torch.full_like(moved, expected), atol=1e-5, rtol=0)
    torch.testing.assert_close(gap, data.gap, atol=1e-5, rtol=0)


def test_decoding_again_is_decoding():
    """Whatever the phasors were and are: depth and gap are those of the new phasors alone, and those of the frame where none is new."""
    data, after = (
        measured(frame(), *wall(frame(), 2.0, 0.05)),
        measured(frame(), *wall(frame(), 5.0, 0.05, 1)),
    )
    depth, gap = decode(data, *after.phasor.chunk(2, dim=1))
    length = rays(data.intrinsics, 36, 44).norm(dim=1, keepdim=True)
    full = 2 * math.pi * metres_per_radian(data, 0)
    apart = (depth - after.depth) * length / full
    assert (apart - apart.round()).abs().max() < 1e-5  # in ranges of the low frequency
    torch.testing.assert_close(gap, after.gap, atol=1e-4, rtol=0)
    assert torch.equal(decode(data, *data.phasor.chunk(2, dim=1))[0], data.depth)


def test_a_hole_keeps_its_wraps():
    """Its gap says nothing of the depth that was filled in."""
    data = frame()
    data = data._replace(valid=torch.zeros_like(data.valid), gap=torch.full_like(data.gap, 0.76))
    assert torch.equal(decode(data, *data.phasor.chunk(2, dim=1))[0], data.depth)


def test_a_dark_pixel_has_a_finite_gradient():
    """atan2 at zero would give NaN, which one dark pixel would spread over all weights."""
    data = frame(batch=1)
    phasor = torch.zeros_like(data.phasor).requires_grad_()
    decode(data, *phasor.chunk(2, dim=1))[0].sum().backward()
    assert torch.isfinite(phasor.grad).all()


def test_the_kernel_network_decodes_both_frequencies():
    """All 64 entries of the mixing matrix move the depth."""
    data = coherent(frame(batch=1))
    model = build_model(preset("guo2018"))
    kernels = torch.eye(8).reshape(1, 8, 8, 1, 1).repeat(1, 1, 1, 36, 44).requires_grad_()
    model.kernels = lambda _: kernels
    model.estimate_depth(data).sum().backward()
    assert (kernels.grad.abs().sum((0, 3, 4)) > 1e-3).all()


def test_the_kernel_network_can_correct_a_wrap():
    """The low frequency says 1 m too much, so the wrap is wrong; a mixing that turns it back moves the depth by 1.5 m."""
    data = frame(batch=1)
    low, high = wall(data, 0.9, 0.003)
    error = 1 / metres_per_radian(data, 0).squeeze()
    right, data = measured(data, low, high), measured(data, turned(low, error), high)
    assert (data.depth - right.depth).min() > 1.0
    rows = torch.zeros(4, 8)
    for row, (plus, minus) in enumerate(((0, 2), (3, 1), (4, 6), (7, 5))):
        rows[row, plus], rows[row, minus] = 0.5, -0.5
    data = data._replace(raw=0.5 + 2 * torch.einsum("pc,bphw->bchw", rows, data.phasor))
    back = torch.eye(4)
    back[:2, :2] = turned(torch.eye(2)[None, :, :, None], -error)[0, :, :, 0]
    mixing = torch.eye(8) + 2 * rows.T @ (back - torch.eye(4)) @ rows
    model = build_model(preset("guo2018"))
    model.kernels = lambda _: mixing.T.reshape(1, 8, 8, 1, 1).expand(1, 8, 8, 36, 44)
    torch.testing.assert_close(model.estimate_depth(data), right.depth, atol=1e-3, rtol=0)


def test_the_classical_filter_quietens_a_noisy_plane_and_gives_up_what_flies():
    """LF2 on a plane with phase noise: the error halves; a dark frame is not measured."""
    g = torch.Generator().manual_seed(0)
    data = frame(batch=1)
    noise = 0.05 * torch.randn(1, 1, 36, 44, generator=g)
    high = 0.1 * torch.cat([noise.cos(), noise.sin()], 1)
    length = rays(data.intrinsics, 36, 44).norm(dim=1, keepdim=True)
    depth = 0.8 + noise * SPEED_OF_LIGHT / (4 * math.pi * 100e6) / length
    data = data._replace(depth=depth, phasor=torch.cat([high, high], 1))
    found, normals, measured = lf2.estimate(data)
    assert measured.all()
    assert (found - 0.8).abs().mean() < 0.5 * (upsample_depth(depth) - 0.8).abs().mean()
    assert normals.shape == (1, 3, 72, 88)
    assert not lf2.estimate(data._replace(phasor=1e-5 * data.phasor))[2].any()


def test_the_classical_filter_mends_wraps():
    """Of a noisy wall some pixels alone are decoded a wrap off, below zero too: filtered phasors put nearly all of them right."""
    data = frame(h=90, w=110, batch=1)
    data = data._replace(intrinsics=data.intrinsics * 2.5)
    data = measured(data, *wall(data, 0.9, 0.025))
    wrong = (data.depth - 0.9).abs() > 0.5
    assert wrong.sum() > 50
    assert (data.depth > 5).any()
    found, _, _ = lf2.estimate(data)
    assert ((found - 0.9).abs() > 0.5).float().mean() < 0.1 * wrong.float().mean()


def test_a_hole_keeps_its_filling_through_the_filter():
    """Its phasor is that of a saturated or a dark pixel, and turns to its neighbours' for nothing."""
    data = frame(batch=1)
    data = measured(data, *wall(data, 0.9, 0.0))
    data.phasor[:, 2:, 18, 22] = turned(data.phasor[:, 2:], 1.0)[..., 18, 22]
    data.valid[..., 18, 22] = 0
    found, _, kept = lf2.estimate(data)
    torch.testing.assert_close(found, torch.full_like(found, 0.9), atol=1e-2, rtol=0)
    assert not kept[..., 36:38, 44:46].any()


def test_frequencies_that_disagree_are_given_up():
    """A gap of 0.5 m is a residual of 0.41 rad: too much at a large amplitude (0.35 rad), noise at a small one (up to 0.61 rad)."""
    data = frame(batch=1)
    low, high = wall(data, 0.9, 0.0)
    error = 0.5 / float(metres_per_radian(data, 0))
    for amplitude, keeps in ((0.4, False), (0.02, True)):
        data = measured(data, *(amplitude / 0.1 * z for z in (turned(low, error), high)))
        torch.testing.assert_close(data.gap, torch.full_like(data.gap, 0.5), atol=1e-4, rtol=0)
        assert lf2.estimate(data)[2].all() == keeps
        assert lf2.estimate(data)[2].any() == keeps
    agreeing = measured(data, *(4 * z for z in (low, high)))
    assert lf2.estimate(agreeing)[2].all()


@pytest.mark.parametrize(
    ("below", "above", "flies"),
    [(0.06, 0.06, False), (0.11, 0.04, True), (0.06, 0.11, True), (0.11, 0.02, False), (0.04, 0.11, False)],
)
def test_one_step_of_an_edge_is_a_large_one(below, above, flies):
    """More than 50 mm to the nearest neighbour, 30 mm to the farthest, and one of both above 100 mm."""
    depth = torch.full((1, 1, 5, 5), 1.0)
    depth[..., :2, :], depth[..., 3:, :] = 1 - below, 1 + above
    amplitude = torch.linspace(0.1, 0.3, 5).expand(1, 1, 5, 5)
    assert bool(lf2.flying(depth, amplitude)[..., 2, 2]) == flies


def test_a_phase_unlike_its_neighbours_is_an_edge():
    """At either frequency, whatever depth and amplitude are."""
    data = frame(batch=1)
    data = measured(data, *wall(data, 0.9, 0.0))
    odd = data.phasor.clone()
    odd[:, :2, 18, 22] = turned(odd[:, :2], 2.0)[:, :, 18, 22]
    kept = lf2.estimate(data._replace(phasor=odd))[2]
    assert not kept[..., 36:38, 44:46].any()
    assert kept.sum() == kept.numel() - 4


def test_a_baseline_has_one_stage():
    """Normals and refinement are no stages of a network that answers with depth."""
    with pytest.raises(ConfigError, match="depth only"):
        Config(network=preset("guo2018").network, stages=(Stage("joint", 1),))
    with pytest.raises(ConfigError, match="kind"):
        loads_config('[network]\nkind = "resnet"')


def test_the_protocol_wants_both_answers():
    """A baseline without depth or loss is none."""
    with pytest.raises(NotImplementedError):
        Baseline()(frame())
    with pytest.raises(NotImplementedError):
        Baseline().loss(None, None, None)
