"""Killed anywhere, disk full at any write: what is sealed stays, nothing is sealed twice, the end is the undisturbed one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("aiohttp")

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "kill_anywhere.py"


def _strike(*options, seconds):
    command = [sys.executable, SCRIPT, *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


def test_two_kills_and_a_full_disk():
    """Two kills and one full disk in a recording of arrays."""
    told = _strike("--kills", "2", "--full", "1", "--views", "4", "--station", "arrays", seconds=290)
    assert told["ok"]
    assert sum(told["blows"].values()) == 3


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_daemon_recorder_and_host_are_killed_in_simulated_recordings():
    """Thirty kills and four full disks, of which each of the three processes has its share."""
    told = _strike("--kills", "30", "--full", "4", "--seed", "3", seconds=1700)
    assert {"daemon", "recorder", "host"} <= told["blows"].keys()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_night_with_faults_of_all_kinds():
    """An hour of compressed time: disks, folders, devices, databases and processes fail; no job fails for it, nothing is lost."""
    told = _strike("--hours", "1", "--seed", "5", seconds=1700)
    assert told["sealed"] == 25 * (told["jobs"] + 1)
    assert len(told["faults"]) > 8
