"""Metrics: definitions, units, poolings."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tofcapture_model.evaluation.metrics import Score, angles_deg


def score(depth, gt, mask, normals=None, gt_normals=None, measured=None, scale=1.0):
    """Score numpy maps (B, H, W)."""
    up = np.broadcast_to(np.array([0.0, 0, -1])[None, :, None, None], (*depth.shape[:1], 3, *depth.shape[1:]))
    out = Score()
    as_map = [torch.tensor(np.asarray(x) * scale, dtype=torch.float32)[:, None] for x in (depth, gt)]
    n, gn = (
        torch.tensor(np.array(up if x is None else x), dtype=torch.float32) for x in (normals, gt_normals)
    )
    m = torch.tensor(mask)[:, None]
    out.add(as_map[0], n, as_map[1], gn, m, m if measured is None else torch.tensor(measured)[:, None])
    return out.table()


RNG = np.random.default_rng(0)
GT = RNG.uniform(0.4, 1.4, (2, 20, 30))
DEPTH = GT + RNG.normal(0, 0.01, GT.shape)
MASK = RNG.random(GT.shape) > [[[0.2]], [[0.9]]]


def test_depth_columns_are_their_definitions():
    """ABS, SQ, RMSE, RMSE of logarithms, MAE, median, within and delta agree with numpy over the mask."""
    found = score(DEPTH, GT, MASK)["depth"]["pixel"]
    e, g = (DEPTH - GT)[MASK], GT[MASK]
    expected = {
        "abs": (abs(e) / g).mean(),
        "sq": (e**2 / g).mean(),
        "rmse": math.sqrt((e**2).mean()),
        "rmse_log": math.sqrt(np.mean((np.log10(DEPTH[MASK]) - np.log10(g)) ** 2)) * math.log(10),
        "mae": abs(e).mean(),
        "bias": e.mean(),
        "within_10mm": (abs(e) < 0.01).mean(),
        "delta_1": 1.0,
    }
    for key, value in expected.items():
        assert found[key] == pytest.approx(value, rel=1e-3), key
    assert found["median"] == pytest.approx(np.median(abs(e)), abs=1e-4)
    assert found["pixels"] == MASK.sum()


def test_units_scale_as_they_should():
    """In millimetres MAE and SQ are 1000 times those in metres, and ABS is the same."""
    metres, millimetres = (score(DEPTH, GT, MASK, scale=k)["depth"]["pixel"] for k in (1.0, 1000.0))
    for key, factor in (("mae", 1000), ("rmse", 1000), ("sq", 1000), ("abs", 1)):
        assert millimetres[key] == pytest.approx(factor * metres[key], rel=1e-4)


def test_poolings_differ_on_unequal_masks():
    """``pixel`` weighs pixels, ``image`` images: they are the means one would write down."""
    found = score(DEPTH, GT, MASK)["depth"]
    each = [abs(d - g)[m].mean() for d, g, m in zip(DEPTH, GT, MASK, strict=True)]
    assert found["image"]["mae"] == pytest.approx(np.mean(each), rel=1e-4)
    assert abs(found["image"]["mae"] - found["pixel"]["mae"]) > 1e-6
    assert found["image"]["images"] == 2


def test_scores_add_over_batches():
    """Two images at once and one after the other give the same table."""
    together = score(DEPTH, GT, MASK)["depth"]["pixel"]["rmse"]
    apart = Score()
    up = torch.tensor([0.0, 0, -1]).reshape(1, 3, 1, 1).expand(1, 3, 20, 30)
    for *maps, m in zip(DEPTH, GT, MASK, strict=True):
        d, g = (torch.tensor(x, dtype=torch.float32)[None, None] for x in maps)
        apart.add(d, up, g, up, torch.tensor(m)[None, None], torch.tensor(m)[None, None])
    assert apart.table()["depth"]["pixel"]["rmse"] == pytest.approx(together, rel=1e-6)


def test_normal_columns_count_angles():
    """Angles of 0, 10 and 60 degrees: mean, thresholds, and the paper's two numbers."""
    tilts = np.radians([0.0, 10.0, 60.0])
    normals = np.stack([np.sin(tilts), np.zeros(3), -np.cos(tilts)])[None, :, None, :]
    ones = np.ones((1, 1, 3))
    table = score(ones, ones, ones.astype(bool), normals=7 * normals)["normal"]["pixel"]
    assert table["mean_deg"] == pytest.approx(70 / 3, abs=1e-3)
    assert table["median_deg"] == pytest.approx(10, abs=0.02)
    assert table["within_11.25deg"] == pytest.approx(2 / 3)
    assert table["paper_bad20_pct"] == pytest.approx(100 / 3)
    assert table["paper_normal_mae"] == pytest.approx(math.radians(70 / 3), abs=1e-5)
    assert table["one_minus_cos"] == pytest.approx((1 - np.cos(tilts)).mean(), rel=1e-5)
    assert table["comp_mae"] == pytest.approx((np.sin(tilts) + 1 - np.cos(tilts)).mean() / 3, rel=1e-5)


def test_small_angles_are_exact():
    """A thousandth of a degree is not lost, as it would be in the arc cosine of a float32 dot product."""
    tilt = math.radians(1e-3)
    a = torch.tensor([[math.sin(tilt)], [0.0], [-math.cos(tilt)]])
    assert angles_deg(a, torch.tensor([[0.0], [0.0], [-1.0]])).item() == pytest.approx(1e-3, rel=1e-3)


def test_coverage_counts_what_the_method_measured_itself():
    """Filled pixels are scored, but not covered."""
    measured = MASK & (RNG.random(MASK.shape) > 0.5)
    found = score(DEPTH, GT, MASK, measured=measured)["depth"]["pixel"]
    assert found["coverage"] == pytest.approx(measured.sum() / MASK.sum())
    assert found["pixels"] == MASK.sum()


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_what_has_no_answer_is_refused_and_counted(wrong):
    """A depth or a normal that is not finite, and a normal of length zero, change no mean: they cost coverage and are told."""
    lost = MASK & (RNG.random(MASK.shape) < 0.3)
    up = np.broadcast_to(np.array([0.1, 0, -1])[None, :, None, None], (2, 3, 20, 30))
    rest = score(DEPTH, GT, MASK & ~lost, normals=up)
    bad_normals = np.where(lost[:, None] & (np.arange(3) == 1)[None, :, None, None], wrong, up)
    for depth, normals in (
        (np.where(lost, wrong, DEPTH), up),
        (DEPTH, bad_normals),
        (DEPTH, np.where(lost[:, None], 0, up)),
    ):
        found = score(depth, GT, MASK, normals=normals)
        for part in ("depth", "normal"):
            row, same = found[part]["pixel"], rest[part]["pixel"]
            assert row["refused"] == lost.sum()
            assert row["coverage"] == pytest.approx(1 - lost.sum() / MASK.sum())
            for key in same.keys() - {"refused", "coverage"}:
                assert row[key] == pytest.approx(same[key], rel=1e-9, abs=1e-12), key


def test_no_answer_at_all_is_no_number():
    """A method that diverged covers nothing."""
    assert score(np.full_like(DEPTH, np.nan), GT, MASK)["depth"]["pixel"] == {
        "pixels": 0,
        "coverage": 0.0,
        "refused": MASK.sum(),
    }


def test_a_depth_behind_the_camera_is_never_within_a_ratio():
    """Its ratio is below every threshold; its logarithm is that of a millimetre."""
    found = score(-GT, GT, MASK)["depth"]["pixel"]
    assert [found[f"delta_{k}"] for k in (1, 2, 3)] == [0, 0, 0]
    assert found["rmse_log"] == pytest.approx(math.sqrt((np.log(GT[MASK] / 1e-3) ** 2).mean()), rel=1e-5)


def test_nothing_to_measure_is_said_and_not_invented():
    """An empty mask gives a table with zero pixels and no numbers."""
    assert score(DEPTH, GT, MASK & False)["depth"]["pixel"] == {"pixels": 0}
