"""The scripts of examples/ run, on small data."""

import importlib
import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_files_shard import write
from tofcapture.cli import main
from tofcapture.devices.station import DEFAULT

STATION = (
    DEFAULT.read_text()
    + """
[sim.tof]
width = 96
height = 72
fx = 76.2
fy = 80.3
cx = 46.7
cy = 40.5
[sim.stereo]
width = 320
height = 256
fx = 288.8
fy = 288.8
cx = 159.5
cy = 127.5
[sim.render]
multipath = false
subpixels = 1
"""
)
EXAMPLES = Path(__file__).parents[1] / "examples"


def run(script, *words):
    """Output of one script."""
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, EXAMPLES / script, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env=env,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_script_is_tested_and_listed():
    """No script is forgotten here or in the README."""
    listed, tested = (EXAMPLES / "README.md").read_text(), Path(__file__).read_text()
    for script in EXAMPLES.glob("*.py"):
        assert script.name in listed
        assert f'"{script.name}"' in tested


@pytest.mark.parametrize("script", ["read_shard.py", "decode_raw.py"])
def test_reading_examples(script, shard):
    """Both print metres or millimetres of the shard's views."""
    assert "m" in run(script, shard)


def test_register_clouds(board_view):
    """Registration of a simulated board view ends at some millimetres."""
    assert "RMSE" in run("register_clouds.py", board_view)


@pytest.mark.slow
def test_custom_sensor(tmp_path):
    """A sensor of other size is simulated and trained on."""
    assert "64 x 48" in run("custom_sensor.py", tmp_path / "own")


NOTEBOOK = EXAMPLES / "whole_way.ipynb"


def cells():
    """Code of the notebook, cell by cell."""
    notebook = json.loads(NOTEBOOK.read_text())
    return ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]


@pytest.mark.parametrize("script", ["own_camera.py", pytest.param("own_arm.py", marks=pytest.mark.slow)])
def test_own_drivers(script):
    """The templates of drivers keep the contract, in at most sixty lines."""
    assert "keeps the contract" in run(script)
    assert len((EXAMPLES / script).read_text().splitlines()) <= 60


def test_the_notebook_is_one():
    """It is listed, valid, holds no outputs, and every public name that it calls is there."""
    assert NOTEBOOK.name in (EXAMPLES / "README.md").read_text()
    notebook = json.loads(NOTEBOOK.read_text())
    if importlib.util.find_spec("nbformat"):
        importlib.import_module("nbformat").validate(notebook)
    assert not any(c.get("outputs") for c in notebook["cells"])
    text = "\n".join(cells())
    for package, name in re.findall(r"\b(tofcapture|calibration|tofcapture_model)\.(\w+)\(", text):
        assert name in importlib.import_module(package).__all__


@pytest.mark.slow
def test_the_notebook_runs_on_the_demos_recording(tmp_path):
    """Cell after cell, on the demo's views in small numbers, training for seconds; the picture is there."""
    to = ["--frames", "2", "--out", str(tmp_path / "demo-out/recording")]
    for what in (
        ["--calibration", "--views", "6"],
        *(["--scene", s, "--views", "2"] for s in ("bottle", "mug")),
    ):
        assert main(["record", *what, *to]) == 0
    code = "\n\n".join(cells())
    assert "minutes=1," in code
    script = tmp_path / "notebook.py"
    script.write_text(code.replace("minutes=1,", "minutes=0.1,"))
    env = {**os.environ, "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "notebook-out/whole-way.png").stat().st_size > 10_000


@pytest.fixture
def shard(tmp_path):
    """A small shard."""
    path = tmp_path / "mug.h5"
    write(path)
    return path


@pytest.fixture
def board_view(tmp_path):
    """A view of something with relief, by small simulated cameras."""
    station = tmp_path / "station.toml"
    station.write_text(STATION)
    line = ["record", "--scene", "steps", "--views", "1", "--frames", "4", "--station", str(station)]
    assert main([*line, "--out", str(tmp_path / "rec")]) == 0
    return tmp_path / "rec" / "views" / "steps" / "view-000.h5"
