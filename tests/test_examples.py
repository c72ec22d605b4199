"""The scripts of examples/ run, on small data."""

import os
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
