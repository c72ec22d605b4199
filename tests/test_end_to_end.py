"""The whole way once, on a station with small cameras: record, align, build, train, evaluate, predict, report, check."""

import json
import os
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from tests.stations import HALF_SIZE_CAMERAS
from tofcapture.cli import main
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim.drivers import SimArm, SimTof
from tofcapture.devices.sim.world import shared_world
from tofcapture.devices.station import open_station, read_station
from tofcapture.testing import check_tof

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
    assert answer["predict"]["median_sensor_depth"] > 0
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


OTHER_CAMERAS = {
    # three frequencies of three phases, one of four, I and Q of two: as sold, but for the number of pixels of the last two
    "adtf3175": (320, 240, 208.5, 3),
    "arducam-b0410": (160, 120, 127.0, 1),
    "ti-opt8241": (224, 172, 147.5, 2),
}


def _station(folder, preset):
    W, H, f, _ = OTHER_CAMERAS[preset]
    tof = f'preset = "{preset}"\nwidth = {W}\nheight = {H}\nfx = {f}\nfy = {f}\ncx = {(W - 1) / 2}\ncy = {(H - 1) / 2}\n'
    embedded = files("tofcapture.devices").joinpath("station.toml").read_text(encoding="utf-8")
    small = SMALL_CAMERAS.split("[sim.tof]")[0] + SMALL_CAMERAS[SMALL_CAMERAS.index("[sim.render]") :]
    path = folder / "station.toml"
    path.write_text(f"{embedded.replace('seed = 0', 'seed = 5')}{small}\n[sim.tof]\n{tof}")
    return path


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("preset", OTHER_CAMERAS)
def test_the_whole_way_of_another_camera(preset, tmp_path, capsys):
    """One, two and three frequencies, three sizes: conformance, record, align, build, check, train, evaluate, predict, export, view, figures."""
    pytest.importorskip("torch")
    station = _station(tmp_path, preset)
    W, H, _, F = OTHER_CAMERAS[preset]
    with open_station(station) as opened:
        info = opened.tof.describe()
    assert (info.camera.width, info.camera.height, len(set(info.modulation_hz))) == (W, H, F)
    check_tof(_tof_of(station))
    rec, data, model = tmp_path / "rec", tmp_path / "data", tmp_path / "model"
    view, weights = rec / "views/steps/view-000.h5", ("--weights", model)
    record = ("record", "--frames", 3, "--out", rec, "--station", station)
    lines = {
        "board": (*record, "--calibration", "--views", 6),
        "stack": (*record, "--scene", "stack", "--views", 2),
        "steps": (*record, "--scene", "steps", "--views", 2),
        "align": ("align", rec, "--method", "joint"),
        "build": ("build-dataset", rec, "--out", data),
        "check recording": ("check", rec),
        "check": ("check", data),
        "train": ("train", data, "--out", model, "--preset", "demo", "--epochs", 1),
        "evaluate": ("evaluate", data, *weights, "--out", tmp_path / "results.json"),
        "predict": ("predict", view, *weights, "--out", tmp_path / "torch"),
        "export": ("export", *weights, "--size", H, W),
        "onnx": ("predict", view, *weights, "--out", tmp_path / "onnx", "--backend", "onnx"),
        "view": ("view", view, "--png", tmp_path / "view.png"),
        "shard": ("view", data / "shards/steps.h5", "--png", tmp_path / "shard.png"),
        "evidence": ("view", rec / "evidence.json", "--png", tmp_path / "evidence.png"),
        "ply": ("export-dataset", data, "--format", "ply", "--out", tmp_path / "ply"),
        # A long unambiguous range holds wrong wraps far away, which 0.125 mm in 16 bits do not reach.
        "png16": ("export-dataset", data, "--format", "png16", "--unit", 0.001, "--out", tmp_path / "png"),
        "mcap": ("export-dataset", data, "--format", "mcap", "--out", tmp_path / "mcap"),
        "report": (
            "report",
            "--dataset",
            data,
            "--results",
            tmp_path / "results.json",
            *weights,
            "--out",
            tmp_path / "report.html",
        ),
        **{
            kind: ("figure", kind, source, "--out", tmp_path / f"{kind}.png")
            for kind, source in (
                ("acquisition", rec),
                ("preprocessing", rec),
                ("depth", data),
                ("normals", data),
            )
        },
    }
    answer = {}
    for name, words in lines.items():
        code = main([str(w) for w in words] + ["--json"])
        said = capsys.readouterr().out
        assert code == 0, (name, said)
        answer[name] = json.loads(said)
    assert answer["align"]["rotation_error_deg"] < 0.1
    assert answer["align"]["translation_error_mm"] < 1
    assert answer["build"]["gt"]["median_error_mm"] < 0.3
    assert answer["check"].get("problems", []) == answer["check recording"].get("problems", []) == []
    depth = json.loads((tmp_path / "results.json").read_text())["methods"]["sensor"]["depth"]["pixel"]
    assert 0 < depth["mae"] < 0.03
    ours, theirs = (np.load(next((tmp_path / b).rglob("depth.npy"))) for b in ("torch", "onnx"))
    assert ours.shape[-2:] == (2 * H, 2 * W)
    assert (np.abs(ours - theirs) < 1e-3).mean() > 0.999
    pictures = ("view", "shard", "evidence", "acquisition", "preprocessing", "depth", "normals")
    assert all((tmp_path / f"{name}.png").stat().st_size > 5000 for name in pictures)


def _tof_of(station):
    """Make the ToF camera of a station again and again, a scene before it."""
    context = StationContext(read_station(station), station.parent)
    shared_world(context).place("box")
    with SimArm({}, context):
        pass
    return lambda: SimTof({}, context)


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_the_commands_of_the_readme_work_as_printed(tmp_path):
    """What a reader copies from the page runs in its order in an empty folder, and ends with the network on the test split."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    script = "set -e\n" + text.split("```sh\n")[1].split("```")[0]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script],
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["split"] == "test"
    network, sensor = (results["methods"][name]["depth"]["pixel"]["mae"] for name in ("model", "sensor"))
    assert network < sensor
