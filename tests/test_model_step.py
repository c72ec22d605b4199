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
from tofcapture_model.evaluation.evaluate import ONE_SIGMA, calibrate
from tofcapture_model.networks.zoo import build_model
from tofcapture_model.training import learner as module
from tofcapture_model.training.learner import MAX_NORM, Group, Learner
from tofcapture_model.training.runlog import Position


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
    return Learner(build_model(config), config, config.stages[0], Group(rank, 1, torch.device("cpu")), {})


@pytest.fixture
def drawn(monkeypatch):
    """What the augmentations were called for, and the first number that each drew."""
    calls = []
    for name in ("redraw_frame", "redraw_calibration"):

        def draw(data, generator, *_args, name=name):
            calls.append((name, torch.rand(1, generator=generator).item()))
            return data

        monkeypatch.setattr(module, name, draw)
    return calls


def test_what_is_drawn_depends_on_the_step_and_the_process(drawn):
    """The same position draws the same, whatever came before; another step, stage or process something else."""
    data = frame(12, 16, batch=1)
    places = [(0, 0, 0), (0, 1, 0), (1, 1, 0), (0, 1, 1), (0, 0, 0)]
    for stage, step, rank in places:
        small(rank).loss(data, target(data), object(), Position(stage=stage, step=step))
    numbers = [number for _, number in drawn]
    assert numbers[0] == numbers[-1]
    assert len(set(numbers)) == len(places) - 1


@pytest.mark.parametrize("burst", [None, object()])
@pytest.mark.parametrize("phase_error", [0.0, 0.003])
def test_noise_is_drawn_for_means_of_bursts_and_calibration_where_asked(drawn, burst, phase_error):
    """Each alone, both, or neither."""
    data = frame(12, 16, batch=1)
    small(phase_error=phase_error).loss(data, target(data), burst, Position())
    assert [name for name, _ in drawn] == ["redraw_frame"] * bool(burst) + ["redraw_calibration"] * bool(
        phase_error
    )


def test_a_gradient_is_cut_to_its_norm_and_no_step_goes_further():
    """A loss a thousand times too large gives a gradient of norm MAX_NORM; the norm that it had is told."""
    data, one = frame(12, 16, batch=1), small()
    truth = target(data)
    loss = one.loss(data, truth._replace(depth=truth.depth + 5), None, Position())
    told = one.gradient(loss._replace(total=1e3 * loss.total))
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
