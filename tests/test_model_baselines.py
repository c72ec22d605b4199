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
from tofcapture_model.baselines import lf2
from tofcapture_model.baselines.coarse_fine import CoarseFine
from tofcapture_model.baselines.guo2018 import MRM, demodulation
from tofcapture_model.baselines.protocol import Baseline
from tofcapture_model.baselines.sensor import upsample_depth
from tofcapture_model.config import BASELINES, Config, Losses, Stage, loads_config, preset
from tofcapture_model.frame import Target
from tofcapture_model.geometry import rays, turn, turned_depth
from tofcapture_model.zoo import build_model, select_stage, training_loss


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
    """Make the phasors those of the raw channels: four phases for each of two frequencies."""
    c = data.raw
    iq = [c[:, 0] - c[:, 2], c[:, 3] - c[:, 1], c[:, 4] - c[:, 6], c[:, 7] - c[:, 5]]
    return data._replace(phasor=torch.stack(iq, 1) / 2)


def test_demodulation_is_recovered_from_a_frame():
    """No order of channels is assumed: the matrix that made the phasors is found again."""
    data = coherent(frame())
    matrix = demodulation(data)
    found = torch.einsum("bpc,bchw->bphw", matrix, data.raw)
    torch.testing.assert_close(found, data.phasor, atol=1e-5, rtol=0)
    assert matrix[0, 0].tolist() == pytest.approx([0.5, 0, -0.5, 0, 0, 0, 0, 0], abs=1e-4)


def test_turning_a_phasor_moves_the_depth_along_its_ray():
    """A turn of 0.1 rad at 100 MHz is 23.86 mm of range, less in z at the border."""
    data = frame()
    angle = 0.1
    i, q = data.phasor[:, 2:].unbind(1)
    turned = torch.stack(
        [i * math.cos(angle) - q * math.sin(angle), i * math.sin(angle) + q * math.cos(angle)], 1
    )
    torch.testing.assert_close(
        turn(turned, data.phasor[:, 2:]), torch.full_like(data.depth, angle), atol=1e-4, rtol=0
    )
    length = rays(data.intrinsics, 36, 44).norm(dim=1, keepdim=True)
    moved = (turned_depth(data, turned) - data.depth) * length
    expected = angle * SPEED_OF_LIGHT / (4 * math.pi * 100e6)
    torch.testing.assert_close(moved, torch.full_like(moved, expected), atol=1e-5, rtol=0)


def test_a_dark_pixel_has_a_finite_gradient():
    """atan2 at zero would give NaN, which one dark pixel would spread over all weights."""
    data = frame(batch=1)
    high = torch.zeros_like(data.phasor[:, 2:]).requires_grad_()
    turned_depth(data, high).sum().backward()
    assert torch.isfinite(high.grad).all()


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
