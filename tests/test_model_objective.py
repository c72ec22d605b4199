"""What a training step adds up: which losses of which maps, over which pixels, times which weights."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: N812

from tests.test_model_networks import TINY_COMPACT, frame
from tofcapture_model.config import Losses, preset
from tofcapture_model.frame import Estimate, Target
from tofcapture_model.geometry.maps import unit, unproject
from tofcapture_model.losses import (
    angle_loss,
    cosine_loss,
    error_map_loss,
    laplace_loss,
    masked_mean,
    objective,
    reweighted_smooth_l1,
)
from tofcapture_model.losses.chamfer import robust_chamfer
from tofcapture_model.networks import build_model, training_loss

SHAPE = (12, 16)
K = torch.tensor([[20.0, 20.0, 7.5, 5.5]] * 2)
OURS = Losses(
    reweight=False,
    uncertainty="laplace",
    normals="angle",
    **(
        UNLIKE := {
            "delta": 0.01,
            "jitter": 0.004,
            "depth": 2.0,
            "error": 3.0,
            "normal": 5.0,
            "chamfer": 0.7,
            "context": 0.25,
        }
    ),
)
PAPERS = Losses(**UNLIKE)


def example():
    """An estimate whose maps before and after refinement are unlike, a target with pixels that are good, context and neither."""
    g = torch.Generator().manual_seed(0)
    truth = 0.5 + 0.1 * torch.rand(2, 1, *SHAPE, generator=g)
    kind = torch.randint(3, truth.shape, generator=g)
    first, fine = (truth + 0.004 + 0.01 * torch.randn(truth.shape, generator=g) for _ in range(2))
    error = 0.002 + 0.02 * torch.rand(truth.shape, generator=g)
    normals = [unit(torch.randn(2, 3, *SHAPE, generator=g)) for _ in range(3)]
    return Estimate(fine, normals[0], error, first, normals[1]), Target(
        truth, normals[2], kind == 0, kind == 1
    )


@pytest.mark.parametrize("weights", [OURS, PAPERS], ids=["ours", "paper's"])
@pytest.mark.parametrize(
    ("stage", "refined", "parts"),
    [
        ("depth", False, {"depth", "error", "chamfer"}),
        ("normal", False, {"normal"}),
        ("refine", True, {"depth", "normal"}),
        ("joint", True, {"depth", "error", "chamfer", "normal"}),
    ],
)
def test_every_part_is_its_loss_of_the_stage_s_maps_times_its_weight(weights, stage, refined, parts):
    """Before refinement in the first two stages, after it in the others; over good pixels and, with its weight, context; Chamfer in mm^2 over good ones."""
    estimate, target = example()
    depth = estimate.depth if refined else estimate.initial_depth
    normals = estimate.normals if refined else estimate.initial_normals
    truth, error = target.depth, estimate.error
    weight = target.good + weights.context * target.context
    lambda_error = error if weights.reweight else truth
    uncertainty, angles = (laplace_loss, angle_loss) if weights is OURS else (error_map_loss, cosine_loss)
    clouds = unproject(depth, K), unproject(truth, K), target.good, target.good, weights.jitter
    expected = {
        "depth": weights.depth * reweighted_smooth_l1(depth, truth, lambda_error, weight, weights.delta),
        "error": weights.error * uncertainty(error, depth, truth, weight, weights.delta),
        "chamfer": weights.chamfer * (1e3**2 * robust_chamfer(*clouds).loss).mean(),
        "normal": weights.normal * angles(normals, target.normals, weight),
    }
    found = objective(weights, stage, estimate, target, K)
    assert found.parts.keys() == parts
    for name in parts:
        torch.testing.assert_close(found.parts[name], expected[name])
    torch.testing.assert_close(found.total, sum(expected[name] for name in parts))
    assert found.winners.sum() == (len(truth) if "chamfer" in parts else 0)


def test_a_part_without_weight_costs_nothing():
    """Chamfer is not even computed, which would take the longest."""
    estimate, target = example()
    assert "chamfer" not in objective(Losses(chamfer=0.0), "joint", estimate, target, K).parts


def test_masked_means_weigh_pixels():
    """A pixel of weight 1/4 counts a quarter in the sum and in the count; one of weight 0 may be NaN."""
    values, weight = torch.tensor([1.0, 3.0, float("nan")]), torch.tensor([1.0, 0.25, 0.0])
    assert masked_mean(values, weight).item() == pytest.approx((1 + 0.25 * 3) / (1 + 0.25))


def test_an_image_counts_by_the_inverse_of_its_sensor_s_error_and_a_wrap_not_at_all():
    """A camera that is ten times worse pulls no harder; a pixel that was unwrapped wrongly pulls at nothing."""
    config = preset("compact")
    model = build_model(replace(config, network=TINY_COMPACT, stages=config.stages))
    data = frame(12, 16, batch=1)
    data = data._replace(depth=torch.full_like(data.depth, 0.8), cues=torch.zeros_like(data.cues))
    there = torch.ones(1, 1, 24, 32, dtype=torch.bool)
    normals = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, 24, 32)
    truth = Target(there.float(), normals, there, ~there)
    losses = replace(config.losses, normal=0.0, error=0.0)

    def pull(shift):
        seen = truth._replace(depth=F.interpolate(data.depth, scale_factor=2, mode="nearest") + shift)
        return float(training_loss(model, losses, "joint", model(data), seen, data).total.detach())

    assert pull(0.05) == pytest.approx(pull(0.2), rel=0.2)
    assert pull(0.002) < 0.5 * pull(0.05)
    assert pull(2.0) == 0
    # below delta the loss is a parabola, which the share makes a line
    assert pull(0.004) == pytest.approx(pull(0.0011) * (4 / 1.1), rel=0.2)
    losses = replace(losses, reweight=True)  # lambda, as in the paper, is the only weight then
    assert pull(0.2) == pytest.approx(4.3 * pull(0.05), rel=0.1)
