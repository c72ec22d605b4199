"""A step of training: what is drawn for it, how far it may go; the factor of an error map that cannot be calibrated."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tests.test_model_baselines import target
from tests.test_model_networks import frame
from tofcapture_model.config import preset
from tofcapture_model.data.augment import BurstNoise
from tofcapture_model.evaluation.evaluate import ONE_SIGMA, calibrate
from tofcapture_model.networks import build_model, training_loss
from tofcapture_model.training import Group, Position
from tofcapture_model.training.train import MAX_NORM, Learner


def small(rank=0, **training):
    """A learner of a small network without Chamfer, which takes the longest."""
    config = preset("demo")
    config = replace(
        config,
        network=replace(config.network, width=2, levels=2),
        losses=replace(config.losses, chamfer=0.0),
        training=replace(config.training, **training),
    )
    torch.manual_seed(0)
    model = build_model(config)
    learner = Learner(model, config, config.stages[0], Group(rank, 1, torch.device("cpu")))
    learner.model = model
    return learner


def test_weights_that_no_gradient_reaches_are_named():
    """A layer all of whose units are below zero stops learning, and all before it: nobody would know from the loss."""
    learner, data = small(), frame(12, 16, batch=1)
    config = preset("demo")
    alive = {n for n, p in learner.model.named_parameters() if p.requires_grad}
    for p in learner.model.parameters():
        torch.nn.init.normal_(p, std=0.1)  # heads begin at zero, and what is before them without a gradient
    for dies in (False, True):
        if dies:
            learner.model.raw2normal.net[0].bias.data.fill_(-1e6)
        estimate = learner.forward(data)
        loss = training_loss(
            learner.model, replace(config.losses, chamfer=0.0), "joint", estimate, target(data), data
        )
        learner.backward(loss)
        idle = set(learner.idle())
        assert idle < alive
        assert ("raw2normal.net.0.weight" in idle) == dies


def test_weights_of_many_inputs_learn_slower():
    """By the inverse of what is summed; biases, small layers and the published networks at the full rate."""
    config = preset("compact")
    model = build_model(config)
    learner = Learner(model, config, config.stages[0], Group(0, 1, torch.device("cpu")))
    before = {n: p.detach().clone() for n, p in model.named_parameters()}
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    learner.step(1e-3)
    moved = {
        n: float((p.detach() - before[n]).abs().mean()) for n, p in model.named_parameters() if p.numel()
    }
    assert moved["backbone.down.4.2.weight"] == pytest.approx(1e-3 / 8, rel=0.01)
    assert moved["backbone.down.4.2.bias"] == pytest.approx(1e-3, rel=0.01)
    assert moved["backbone.merge.3.2.weight"] == pytest.approx(1e-3, rel=0.01)


BURST = torch.tensor([BurstNoise(4, 16.0, 1.25, 4095.0)])


def test_what_is_drawn_depends_on_the_step_and_the_process():
    """The same position draws the same, whatever came before; another step, stage or process something else."""
    data = frame(12, 16, batch=1)._replace(noise=BURST)
    places = [(0, 0, 0), (0, 1, 0), (1, 1, 0), (0, 1, 1), (0, 0, 0)]
    drawn = [
        small(rank, noise="drawn").augmented(data, Position(stage=stage, step=step)).raw.double().sum().item()
        for stage, step, rank in places
    ]
    assert drawn[0] == drawn[-1]
    assert len(set(drawn)) == len(places) - 1


@pytest.mark.parametrize("noise", ["recorded", "drawn"])
@pytest.mark.parametrize("phase_error", [0.0, 0.003])
def test_noise_is_drawn_for_means_of_bursts_and_calibration_where_asked(noise, phase_error):
    """Fresh noise changes the taps, another calibration depths and the gap's cue; each alone, both, or neither."""
    data = frame(12, 16, batch=1)._replace(noise=BURST)
    found = small(phase_error=phase_error, noise=noise).augmented(data, Position())
    assert torch.equal(found.raw, data.raw) == (noise == "recorded")
    assert torch.equal(found.cues, data.cues) == (phase_error == 0)
    assert torch.equal(found.depth, data.depth) == (noise == "recorded" and phase_error == 0)


def test_a_gradient_is_cut_to_its_norm_and_no_step_goes_further():
    """A loss a hundred thousand times too large gives a gradient of norm MAX_NORM; the norm that it had is told."""
    data, one = frame(12, 16, batch=1), small()
    truth, losses = target(data), replace(preset("demo").losses, chamfer=0.0)
    loss = training_loss(
        one.model, losses, "joint", one.forward(data), truth._replace(depth=truth.depth + 0.2), data
    )
    told = one.backward(loss._replace(total=1e5 * loss.total))
    norm = math.sqrt(sum(float(p.grad.square().sum()) for p in one.parameters))
    assert told > 10 * MAX_NORM
    assert norm == pytest.approx(MAX_NORM, rel=1e-3)


def test_without_validation_one_sigma_is_that_of_a_laplace_distribution(tmp_path):
    """Of the errors, 1 - exp(-factor) are within factor times the predicted scale."""
    model = build_model(preset("demo"))
    folder = make_dataset(tmp_path / "dataset", scale=8, views=1, frames=1, splits=("train",))
    found = calibrate(model, folder, torch.device("cpu"))
    assert 1 - math.exp(-found["factor"]) == pytest.approx(ONE_SIGMA, rel=1e-5)
    assert model.error_map.calibration.item() == pytest.approx(found["factor"])
