"""Statistics against numpy on the whole arrays; outliers that were planted; the page and the command."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import answers, pictures
from tests.test_dataset_card import make
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.dataset.stats import QUANTITIES, Tally, dataset_stats, incidence_deg, outliers
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ShardReader


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Three scenes of two views."""
    return make(tmp_path_factory.mktemp("stats") / "data")


def test_the_numbers_are_those_of_the_arrays(dataset):
    """Counts, extremes, quantiles and shares of bits are what numpy says of all arrays at once."""
    stats = dataset_stats(dataset)
    depth, masks = [], []
    for scene in ("gear-2", "mug"):
        with ShardReader(dataset / f"shards/{scene}.h5") as shard:
            for view in range(2):
                gt = shard.ground_truth(view, 1)
                depth.append(gt.depth[gt.mask == 0])
                masks.append(gt.mask)
    depth, mask = np.concatenate(depth), np.stack(masks)
    train = stats.splits["train"].table()
    found = train["quantities"]["gt_depth"]
    assert (train["scenes"], train["views"], found["count"]) == (2, 4, depth.size)
    assert (found["min"], found["max"]) == (depth.min(), depth.max())
    assert found["p50"] == pytest.approx(np.median(depth), abs=0.026)  # a bin is 25 mm wide
    assert train["mask"]["GOOD"] == (mask == 0).mean()
    assert train["mask"]["GRAZING"] == ((mask & MaskBit.GRAZING) > 0).mean()
    assert train["flags"]["SATURATED"] > 0
    assert len(stats.views) == 6
    json.dumps(stats.table(), allow_nan=False)


@settings(max_examples=30)
@given(st.lists(st.floats(-50, 200, width=32), min_size=1, max_size=60), st.floats(0, 1))
def test_quantiles_are_right_to_a_bin(values, q):
    """In parts or at once, with values beyond the range: off by a bin at most where the range holds them."""
    tally = Tally(QUANTITIES[-1])
    values = np.array(values)
    for part in np.array_split(values, 3):
        tally.add(part)
    assert tally.counts.sum() == values.size
    exact = np.quantile(values, q, method="inverted_cdf")
    if -40 <= exact <= 125:
        below = (values <= tally.quantile(q) + 165 / 400).mean()
        assert below >= q - 1e-9
    assert values.min() <= tally.quantile(q) <= values.max()


def test_angles_of_incidence():
    """A plane that faces the camera is seen at 0 degrees on the axis and at the ray's angle elsewhere."""
    camera = Camera(9, 5, 4.0, 4.0, 4.0, 2.0)
    normals = np.zeros((5, 9, 3))
    normals[..., 2] = -1
    angle = incidence_deg(normals, camera.rays)
    assert angle[2, 4] == pytest.approx(0, abs=1e-5)
    assert angle[2, 8] == pytest.approx(45)


def test_planted_outliers_are_named():
    """One dark view and one without a good pixel among many alike; too few views name only the latter."""
    rng = np.random.default_rng(0)
    views = [
        {"scene": "s", "view": i, "amplitude": 100 + rng.normal(), "good_share": 0.5 + 0.01 * rng.random()}
        for i in range(20)
    ]
    assert outliers(views) == []
    views[7]["amplitude"], views[3]["good_share"] = 20.0, 0.0
    assert {(o["view"], o["name"]) for o in outliers(views)} == {(7, "amplitude"), (3, "good_share")}
    assert [(o["view"], o["name"]) for o in outliers(views[:5])] == [(3, "good_share")]
    assert outliers([]) == []


def test_the_page_and_the_command(dataset, drawn, tmp_path, capsys):
    """The page needs nothing else and shows the very numbers of the JSON, errors in mm, as the text does."""
    page = tmp_path / "page.html"
    assert main(["stats", str(dataset), "--html", str(page), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    answers.hold(
        "stats", answer, without=("manifest_sha256",), names=[(dataset, "DATASET"), (tmp_path, "FOLDER")]
    )
    assert answer["splits"]["test"]["views"] == 2
    html = page.read_text(encoding="utf-8")
    assert "<script" not in html
    assert not re.search(r'(src|href)="(?!data:|#)', html)
    assert answer["manifest_sha256"] in html
    assert html.count('<svg class="chart"') == 6
    assert html.count("<figure><img") == 3 * 6  # a view of each scene, six pictures
    pictures.hold("stats", drawn)
    pictures.hold("stats-views", pictures.of_page(html))
    assert main(["stats", str(dataset)]) == 0
    text = capsys.readouterr().out
    for split, said in answer["splits"].items():
        for name, q in said["quantities"].items():
            unit, times = ("mm", 1e3) if name == "tof_minus_gt" else (q["unit"], 1)
            numbers = [f"{times * q[k]:.4g}" for k in ("min", "p1", "p50", "p99", "max")]
            row = [f"{name} [{unit}]", split, f"{q['count']:,}", *numbers]
            assert "".join(f"<td>{cell}</td>" for cell in row) in html
            assert " ".join(row) in " ".join(text.split())
    for kind in ("mask", "flags"):
        for name in answer["splits"]["train"][kind]:
            shares = [f"{said[kind][name]:.2%}" for said in answer["splits"].values()]
            assert f"<td>{kind} {name}</td>" + "".join(f"<td>{s}</td>" for s in shares) in html
            assert " ".join([kind, name, *shares]) in " ".join(text.split())
