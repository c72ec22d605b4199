"""The whole way once, on a station with small cameras: record, align, build, train, evaluate, predict, report, check."""

import json
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tests.stations import HALF_SIZE_CAMERAS
from tofcapture.cli import main

SMALL_CAMERAS = (
    HALF_SIZE_CAMERAS
    + """[sim.render]
patches = 400
patch_rays = 64
rays = 16
subpixels = 3
"""
)


@pytest.fixture(scope="module")
def way(tmp_path_factory):
    """Run every stage once; what each command answered, and the folder."""
    folder = tmp_path_factory.mktemp("way")
    embedded = files("tofcapture.devices").joinpath("station.toml").read_text(encoding="utf-8")
    (folder / "station.toml").write_text(embedded.replace("seed = 0", "seed = 5") + SMALL_CAMERAS)
    rec, data, model = folder / "rec", folder / "data", folder / "model"
    station = ("--station", folder / "station.toml")
    lines = {
        "board": ("record", "--calibration", "--views", 5, "--frames", 3, "--out", rec, *station),
        "stack": ("record", "--scene", "stack", "--views", 2, "--frames", 3, "--out", rec, *station),
        "steps": ("record", "--scene", "steps", "--views", 2, "--frames", 3, "--out", rec, *station),
        "align": ("align", rec),
        "build": ("build-dataset", rec, "--out", data),
        "check": ("check", data),
        "train": ("train", data, "--out", model, "--preset", "demo", "--epochs", 2),
        "evaluate": ("evaluate", data, "--weights", model, "--out", folder / "results.json"),
        "predict": (
            "predict",
            rec / "views/steps/view-000.h5",
            "--weights",
            model,
            "--out",
            folder / "prediction",
        ),
        "report": (
            *("report", "--dataset", data, "--results", folder / "results.json", "--weights", model),
            *("--evidence", rec / "evidence.json", "--out", folder / "report.html"),
        ),
        "again": ("record", "--scene", "steps", "--views", 2, "--frames", 3, "--out", rec, *station),
        "rebuild": ("build-dataset", rec, "--out", data),
    }
    return folder, lines


def test_the_whole_way(way, capsys):
    """Every stage succeeds on the files of the one before it, and its numbers make sense."""
    folder, lines = way
    answer = {}
    for name, words in lines.items():
        code = main([str(w) for w in words] + ["--json"])
        said = capsys.readouterr().out
        assert code == 0, (name, said)
        answer[name] = json.loads(said)
    assert answer["align"]["rotation_error_deg"] < 0.5
    assert answer["align"]["translation_error_mm"] < 5
    assert answer["build"]["gt"]["median_error_mm"] < 2
    assert answer["check"].get("problems", []) == []
    assert answer["again"]["recorded"] == []
    assert sorted(answer["rebuild"]["skipped"]) == ["stack", "steps"]
    results = json.loads((folder / "results.json").read_text())
    for method in ("sensor", "model"):
        assert 0 < results["methods"][method]["depth"]["pixel"]["mae"] < 0.2
        assert 0 < results["methods"][method]["normal"]["pixel"]["mean_deg"] < 60
    assert answer["predict"]["inference_ms"] > 0
    depth = np.load(next(Path(folder / "prediction").rglob("depth.npy")))
    assert depth.shape[-2:] == (180, 240)
    assert np.isfinite(depth).all()
    _run_readme_example(folder / "data/shards/steps.h5", capsys)
    html = (folder / "report.html").read_text()
    assert "<script" not in html
    row = re.search(r"MAE \(mean absolute error\), mm</td>(.*?)</tr>", html)[1]
    depths = [results["methods"][method]["depth"] for method in results["methods"]]
    said = [f"{1e3 * depth[pool]['mae']:.2f}" for pool in ("pixel", "image") for depth in depths]
    assert re.findall(r">([\d.]+)</td>", row) == said


def _run_readme_example(shard, capsys):
    """The README's reading example runs as it stands, on a shard of this dataset."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    code = (
        text.split("```python\n")[1].split("```")[0].replace("demo-out/dataset/shards/bottle.h5", str(shard))
    )
    exec(compile(code, "README.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out.startswith("steps (8, 90, 120)")
