"""Numbers of the tables: each metric by its definition, each column by its metric, pooling and unit, each region by its cue."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: N812

from tests.test_model_metrics import DEPTH, GT, MASK, score
from tests.test_model_networks import frame
from tofcapture_model.config import Losses
from tofcapture_model.evaluation.metrics import (
    ANGLE_TERMS,
    DARK,
    DEPTH_TERMS,
    STRONG_MPI,
    Uncertainty,
    regions,
)
from tofcapture_model.evaluation.suite import _free, _learned
from tofcapture_model.evaluation.tables import SUITES, cells
from tofcapture_model.frame import Target
from tofcapture_model.networks.baselines.coarse_fine import CoarseFine

ONES = np.ones((1, 1, 4))


def test_the_median_of_images_is_the_mean_of_their_medians():
    """And not of their means."""
    found = score(DEPTH, GT, MASK)["depth"]["image"]["median"]
    each = [np.median(abs(d - g)[m]) for d, g, m in zip(DEPTH, GT, MASK, strict=True)]
    assert found == pytest.approx(np.mean(each), abs=2e-5)


def test_ratios_count_to_either_side_of_powers():
    """A depth is within 1.25, its square and its cube, too far and too near alike."""
    t = 1.25
    for power, shares in ((0.9, (1, 1, 1)), (1.5, (0, 1, 1)), (2.5, (0, 0, 1)), (3.5, (0, 0, 0))):
        for ratio in (t**power, t**-power):
            found = score(ONES * ratio, ONES, ONES > 0)["depth"]["pixel"]
            assert tuple(found[f"delta_{k}"] for k in (1, 2, 3)) == shares


@pytest.mark.parametrize("key", [k for k in DEPTH_TERMS if k.startswith("within")])
def test_shares_of_depth_end_at_their_millimetres(key):
    """A tenth below counts, a tenth above does not."""
    limit = float(key.removeprefix("within_").removesuffix("mm")) / 1000
    off = limit * np.array([[[0.9, -0.9, 1.1, -1.1]]])
    assert score(ONES + off, ONES, ONES > 0)["depth"]["pixel"][key] == 0.5


def tilted(degrees):
    """(1, 3, 1, N) normals at these angles from (0, 0, -1)."""
    a = np.radians(degrees)
    return np.stack([np.sin(a), 0 * a, -np.cos(a)])[None, :, None]


@pytest.mark.parametrize("key", [k for k in ANGLE_TERMS if k.startswith("within")])
def test_shares_of_angles_end_at_their_degrees(key):
    """A tenth below counts, a tenth above does not."""
    limit = float(key.removeprefix("within_").removesuffix("deg"))
    found = score(ONES, ONES, ONES > 0, normals=tilted(limit * np.array([0.9, 0.5, 1.1, 1.5])))
    assert found["normal"]["pixel"][key] == 0.5


def test_the_rms_angle_is_the_root_of_the_mean_square():
    """In degrees."""
    degrees = np.array([0.0, 6, 21, 25])
    found = score(ONES, ONES, ONES > 0, normals=tilted(degrees))["normal"]
    for pool in ("pixel", "image"):
        assert found[pool]["rmse_deg"] == pytest.approx(math.sqrt(np.mean(degrees**2)), rel=1e-4)


def test_regions_are_where_their_cue_says():
    """Dark where the amplitude is small, multipath where the first cue is large, of either sign; good pixels only."""
    data = frame(batch=1)
    left = (torch.arange(44) < 22).expand(1, 1, 36, 44)
    top = (torch.arange(36) < 18)[:, None].expand(1, 1, 36, 44)
    sign = torch.where(left, 1.0, -1.0)
    cue = torch.full((1, 4, 36, 44), 9.0)
    cue[:, :1] = STRONG_MPI * sign * torch.where(top, 1.1, 0.9)
    data = data._replace(confidence=DARK * torch.where(left, 0.9, 1.1), cues=cue)
    good = (torch.arange(88) % 3 > 0).expand(1, 1, 72, 88)
    normals = torch.tensor([0.0, 0, -1]).reshape(1, 3, 1, 1).expand(1, 3, 72, 88)
    found = regions(data, Target(torch.full((1, 1, 72, 88), 0.8), normals, good, ~good))
    left, top = (F.interpolate(x.float(), scale_factor=2) > 0 for x in (left, top))
    for name, where in (("dark", left), ("bright", ~left), ("mpi", top), ("no-mpi", ~top), ("all", good)):
        assert torch.equal(found[name], where & good), name


def test_the_table_under_an_object_makes_its_rim_an_edge():
    """Context is known ground truth: a step to it is one, though it is never evaluated."""
    data = frame(batch=1)
    good = (torch.arange(88) < 40).expand(1, 1, 72, 88)
    normals = torch.tensor([0.0, 0, -1]).reshape(1, 3, 1, 1).expand(1, 3, 72, 88)
    found = regions(data, Target(torch.where(good, 0.8, 0.9), normals, good, ~good))
    assert found["edge"][..., 38:40].all()
    assert not found["edge"][..., :30].any()
    assert not found["edge"][..., 40:].any()


def test_the_area_under_sparsification_is_in_units_of_the_mean_error():
    """Errors 1 to 20, the largest trusted most: the mean over all shares left of the difference to the best order, over the mean error."""
    error = np.arange(1.0, 21)
    worst, best = ([np.mean(order[:k]) for k in range(20, 0, -1)] for order in (error[::-1], error))
    found = Uncertainty()
    found.add(torch.tensor(error), -torch.tensor(error))
    assert found.row()["ause"] == pytest.approx(np.mean(np.subtract(worst, best)) / error.mean(), rel=1e-4)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_coverage_of_a_sigma_is_the_share_of_errors_within_it(share):
    """Not within twice or half of it."""
    error = torch.arange(1.0, 21)
    found = Uncertainty()
    found.add(error, torch.full_like(error, 20 * share))
    assert found.row()["coverage_1sigma"] == share


@pytest.mark.parametrize("method", ["sensor", "lf2", "coarse-fine"])
def test_without_an_error_map_the_darker_pixel_is_the_less_certain(method):
    """Only the order has a meaning, which is why nothing is told of its coverage."""
    data = frame(batch=1)
    ask = _learned(CoarseFine(), Losses()) if method == "coarse-fine" else _free(method)
    found = ask(data)
    sigma, amplitude = found.sigma[..., ::2, ::2].flatten(), data.confidence.flatten()
    assert torch.equal(sigma.argsort(descending=True), amplitude.argsort())
    assert not found.scaled


METRICS = {
    "ABS %": ("depth", "abs", 100),
    "SQ mm": ("depth", "sq", 1000),
    "RMSE mm": ("depth", "rmse", 1000),
    "MAE mm": ("depth", "mae", 1000),
    "bias mm": ("depth", "bias", 1000),
    "coverage %": ("depth", "coverage", 100),
    "normal MAE rad": ("normal", "paper_normal_mae", 1),
    "above 20 deg %": ("normal", "paper_bad20_pct", 1),
    "normals deg": ("normal", "mean_deg", 1),
    "precision mm": ("extra", "precision", 1000),
    "within 1 sigma %": ("extra", "coverage_1sigma", 100),
    "AUSE": ("extra", "ause", 1),
    "minutes": ("budget", "minutes", 1),
    "steps": ("budget", "steps", 1),
}
"""Part and key of the results, and what turns metres and shares into the unit of the column."""
REGIONS = ("edge", "interior", "mpi", "no-mpi", "dark", "bright")


def results_of_unlike_numbers():
    """Results in which no two numbers are equal, and these numbers by region, part, pooling and key."""
    numbers = {}

    def number(*path):
        numbers[path] = (-1) ** len(numbers) * (3.0 + len(numbers))
        return numbers[path]

    def measured(region):
        keys = {
            part: [key for one, key, _ in METRICS.values() if one == part] for part in ("depth", "normal")
        }
        return {
            part: {
                pool: {key: number(region, part, pool, key) for key in keys[part]}
                for pool in ("pixel", "image")
            }
            for part in keys
        }

    row = measured("") | {"regions": {region: measured(region) for region in REGIONS}}
    for part in ("extra", "budget"):
        keys = [key for one, key, _ in METRICS.values() if one == part]
        row[part] = {key: number("", part, "", key) for key in keys}
    return {"methods": {"sensor": row}}, numbers


@pytest.mark.parametrize("suite", SUITES)
def test_a_column_is_the_number_that_its_words_say_in_their_unit(suite):
    """Of that region, pooled over pixels but in the suite of indoor scenes, which averages images."""
    results, numbers = results_of_unlike_numbers()
    pool = "image" if suite == "indoor" else "pixel"
    ((_, texts),) = cells(results, SUITES[suite])
    for column, (text, _) in zip(SUITES[suite].columns, texts, strict=True):
        region, _, words = column.words.rpartition(": ")
        part, key, factor = METRICS[words]
        whole = numbers[region, part, pool if part in ("depth", "normal") else "", key]
        assert float(text) == pytest.approx(factor * whole, abs=1e-9), column.words


def test_the_suites_hold_the_paper_s_columns_and_their_regions():
    """The six numbers of table II first; three columns for each region, in its order."""
    paper = ["ABS %", "SQ mm", "RMSE mm", "MAE mm", "normal MAE rad", "above 20 deg %"]
    for suite in ("main", "ablation", "inputs", "indoor"):
        assert [c.words for c in SUITES[suite].columns][:6] == paper
    for suite, pair in (("mpi", ("mpi", "no-mpi")), ("noise", ("dark", "bright"))):
        named = [c.words.rpartition(": ")[0] for c in SUITES[suite].columns if ": " in c.words]
        assert named == [pair[0]] * 3 + [pair[1]] * 3
