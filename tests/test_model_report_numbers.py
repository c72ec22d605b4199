"""Numbers on the page of the report: each under its pooling, in its unit."""

from __future__ import annotations

import pytest

from tests.test_model_report import results_table
from tofcapture_model.report.scores import method_title, tables, tiles

UNITS = {"mm": 1000, "%": 100}
METRICS = {
    "MAE (mean absolute error)": "mae",
    "median absolute error": "median",
    "RMSE (root mean square)": "rmse",
    "mean signed error": "bias",
    "within 10 mm": "within_10mm",
}


def test_pools_stand_over_their_numbers():
    """Pixels first, images second, in millimetres and percent."""
    results = results_table()
    depth = results["methods"]["model"]["depth"]
    depth["image"] = {key: 1.5 * value for key, value in depth["pixel"].items()}
    table = tables(results)[0]
    heads = [words for words, methods in table.pools for _ in range(methods)]
    at = [k for k, name in enumerate(table.methods) if name == method_title("model")]
    assert [heads[k] for k in at] == ["all pixels pooled", "mean over images"]
    assert [row.words for row in table.rows] == list(METRICS)
    for row in table.rows:
        for k, pool in zip(at, ("pixel", "image"), strict=True):
            value = UNITS[row.unit] * depth[pool][METRICS[row.words]]
            assert float(row.cells[k].text) == pytest.approx(value, abs=0.005)


def test_tiles_show_what_they_say():
    """The share within 10 mm is no other share."""
    results = results_table()
    for k, method in enumerate(results["methods"].values()):
        method["depth"]["pixel"] |= {f"within_{mm}mm": (mm + k) / 100 for mm in (5, 10, 20, 50)}
    _, number, beside = next(tile for tile in tiles(results) if tile[0] == "depth within 10 mm")
    assert number == "11.0 %"
    assert beside.endswith("sensor 10.0 %")
