"""The same dataset whoever builds it, and whatever dies on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from multiprocessing import active_children

import numpy as np
import pytest

from tests.test_dataset_build import simulate, true_rig
from tofcapture.cli import main
from tofcapture.dataset.build import build_dataset
from tofcapture.errors import ConfigError
from tofcapture.files import shard as shards
from tofcapture.files.check import check
from tofcapture.files.seal import sha256_of
from tofcapture.files.view import view_path, write_view
from tofcapture.rig import dumps_rig

SCENES = ("box", "gear", "mug", "sphere", "steps")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Five scenes: two processes get two each, the views of the smallest are spread."""
    root = tmp_path_factory.mktemp("recording")
    for number, scene in enumerate(SCENES):
        view = simulate(scene, 1)
        for index in range(3 if number == 0 else 2):
            burst = replace(view.tof, raw=view.tof.raw + np.uint16(index))  # no view is another's copy
            write_view(view_path(root, scene, index), replace(view, index=index, tof=burst))
    (root / "rig.toml").write_text(dumps_rig(true_rig(view)))
    return root


@pytest.fixture(scope="module")
def calm(recording, tmp_path_factory):
    """Dataset of one process that nothing disturbed."""
    out = tmp_path_factory.mktemp("calm") / "dataset"
    return build_dataset([recording], out, jobs=1)


def assert_same(out, calm):
    """Shards, their digests and the manifest are equal byte by byte, and nothing else lies about."""
    for scene in SCENES:
        for suffix in (".h5", ".sha256"):
            path = f"shards/{scene}{suffix}"
            assert sha256_of(out / path) == sha256_of(calm.dataset / path), path
    assert (out / "manifest.json").read_bytes() == (calm.dataset / "manifest.json").read_bytes()
    assert not [p for p in out.rglob("*") if p.name.startswith(".") or p.suffix == ".partial"]
    assert check(out) == []


def test_workers_killed_in_the_middle_cost_nothing_but_a_retry(recording, calm, tmp_path):
    """SIGKILL of every worker that is at work when the first scene is done: the dataset is the same, nothing failed."""
    killed = []

    def kill(scene, done, views):
        if not killed:
            killed.extend(active_children())
            for child in killed:
                os.kill(child.pid, signal.SIGKILL)

    result = build_dataset([recording], tmp_path / "out", jobs=2, progress=kill)
    assert len(killed) == 2
    assert not result.failures
    assert_same(tmp_path / "out", calm)


def test_handles_that_somebody_holds_do_not_change_the_bytes(recording, calm, tmp_path, monkeypatch):
    """A profiler that keeps datasets open (Dask's does, for moments) does not move what HDF5 allocates."""
    held, create = [], shards.create

    def keeping(*args):
        held.append(create(*args))
        return held[-1]

    monkeypatch.setattr(shards, "create", keeping)
    build_dataset([recording], tmp_path / "out", jobs=1)
    assert held
    assert_same(tmp_path / "out", calm)


def test_parts_of_a_batch_make_the_whole(recording, calm, tmp_path):
    """Three calls of --part I/3 in any order: the last to be done writes the manifest, and --finish changes nothing."""
    out = tmp_path / "out"
    for index in (2, 3, 1):
        result = build_dataset([recording], out, jobs=1, part=(index, 3))
        assert bool(result.missing) == (index != 1)
        assert (out / "manifest.json").exists() == (index == 1)
    assert result.scenes == calm.scenes
    assert result.gt == calm.gt
    assert_same(out, calm)
    again = build_dataset([recording], out, finish=True)
    assert set(again.skipped) == set(SCENES)
    assert_same(out, calm)


def test_what_is_not_there_is_not_finished(recording, tmp_path):
    """--finish before all parts are done names the missing scenes, writes no manifest and exits with 5."""
    command = [
        sys.executable,
        "-m",
        "tofcapture",
        "build-dataset",
        str(recording),
        "--out",
        str(tmp_path),
        "--json",
    ]
    part = subprocess.run(
        [*command, "--jobs", "1", "--part", "1/5"], capture_output=True, text=True, check=True
    )
    assert json.loads(part.stdout)["missing"] == list(SCENES[1:])
    assert 0 < json.loads(part.stdout)["peak_memory_bytes"] < 2 * 2**30  # of a process that only builds
    done = subprocess.run([*command, "--finish"], capture_output=True, text=True, check=False)
    assert done.returncode == 5
    assert json.loads(done.stdout)["missing"] == list(SCENES[1:])
    assert not (tmp_path / "manifest.json").exists()


@pytest.mark.parametrize("text", ["0/3", "4/3", "2", "a/b", "-1/3", "1/0"])
def test_a_part_that_is_none_is_refused(recording, tmp_path, capsys, text):
    """I/N with 1 <= I <= N, nothing else."""
    assert main(["build-dataset", str(recording), "--out", str(tmp_path / "x"), f"--part={text}"]) == 3
    assert "--part: expected I/N" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_an_engine_that_is_not_there_says_so(recording, tmp_path, monkeypatch):
    """Dask without its package, without a scheduler, a scheduler without Dask, an unknown engine."""
    for options in ({"engine": "dask"}, {"scheduler": "tcp://127.0.0.1:9"}, {"engine": "slurm"}):
        with pytest.raises(ConfigError, match=r"--scheduler|--engine"):
            build_dataset([recording], tmp_path / "out", **options)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="distributed") as caught:
        build_dataset([recording], tmp_path / "out", engine="dask", scheduler="tcp://127.0.0.1:9")
    assert "tofcapture[cluster]" in caught.value.hint


DASK = """
import os, signal, sys, threading, time
from pathlib import Path

if __name__ == "__main__":
    from distributed import Client, LocalCluster
    from tofcapture.dataset.build import build_dataset
    from tofcapture.dataset.sample import SampleConfig
    recording, out, kill = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[4] == "kill"
    config = SampleConfig(truth=sys.argv[3])
    with LocalCluster(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None) as cluster:
        def murder():
            while not list(out.glob("shards/.work-*")):  # a shard is in the making
                time.sleep(0.005)
            pid = int(next(iter(out.glob("shards/.work-*"))).name.rsplit("-", 2)[1])
            os.kill(pid, signal.SIGKILL)
            print("killed", flush=True)
        if kill:
            threading.Thread(target=murder, daemon=True).start()
        result = build_dataset([recording], out, config=config, engine="dask", scheduler=cluster.scheduler_address)
        assert not result.failures, result.failures
"""


def built_by_dask(recording, out, truth="single", kill=""):
    """Have two Dask workers on the loopback interface build a dataset; returns what the process said."""
    script = out.parent / "script.py"
    script.write_text(DASK)
    done = subprocess.run(
        [sys.executable, str(script), str(recording), str(out), truth, kill],
        capture_output=True,
        text=True,
        check=False,
        timeout=250,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("kill", ["", "kill"])
def test_dask_makes_the_same(recording, calm, tmp_path, kill):
    """Also when a worker is killed in the middle of a shard."""
    pytest.importorskip("distributed")
    said = built_by_dask(recording, tmp_path / "out", kill=kill)
    assert ("killed" in said) == bool(kill)
    assert_same(tmp_path / "out", calm)
