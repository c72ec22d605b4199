"""Where tensors are: training and measuring away from the host, GPUs of several processes."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

torch = pytest.importorskip("torch")

from tests import PATIENCE
from tests.analytic import make_dataset
from tofcapture.errors import ConfigError
from tofcapture_model.config import Stage, preset
from tofcapture_model.evaluation.evaluate import evaluate
from tofcapture_model.training import Group, processes
from tofcapture_model.training.train import train

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two training scenes, one to validate, one to test, at a quarter of the sensor's resolution."""
    return make_dataset(tmp_path_factory.mktemp("data") / "dataset", scale=4)


@pytest.mark.slow
def test_nothing_stays_on_the_host(tmp_path):
    """Training with validation, evaluation and a suite on a device that refuses to mix its tensors with the host's."""
    dataset = make_dataset(tmp_path / "data", views=1, frames=1, scale=4)
    done = subprocess.run(
        [sys.executable, "-m", "tests.second_device", str(dataset), str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.stdout.endswith("all on one device\n"), done.stderr[-3000:]


@pytest.mark.slow
def test_the_second_device_refuses_the_host_s_tensors():
    """The check of the test above: a sum of both is an error there, too."""
    code = (
        "import torch, tests.second_device as d\n"
        "d._setup_privateuseone_for_python_backend(d.NAME)\n"
        "with d.Watched(): torch.zeros(3) + torch.zeros(3, device=d.NAME)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert "expected all tensors on one device" in done.stderr


@contextmanager
def pretended(monkeypatch, gpus, **env):
    """A machine with so many GPUs; yields what was chosen: devices made current, backends of the group."""
    chosen = {"device": [], "group": []}
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "set_device", chosen["device"].append)
    monkeypatch.setattr(torch.distributed, "init_process_group", chosen["group"].append)
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: int(os.environ["RANK"]))
    for name, value in env.items():
        monkeypatch.setenv(name, value)
    yield chosen


def test_each_process_has_a_gpu_of_its_own(monkeypatch):
    """It is made the current one, since kernels are launched there; with fewer GPUs than processes nobody starts."""
    env = {"WORLD_SIZE": "2", "RANK": "1", "LOCAL_RANK": "1"}
    with pretended(monkeypatch, 2, **env) as chosen, processes("cuda") as group:
        assert group == Group(1, 2, torch.device("cuda:1"))
    assert chosen == {"device": [1], "group": ["nccl"]}
    with (
        pretended(monkeypatch, 1, **env),
        pytest.raises(ConfigError, match="process 2 on 1"),
        processes("cuda"),
    ):
        pass


def test_the_cpu_is_taken_when_it_is_asked_for(monkeypatch):
    """Though there are GPUs."""
    with (
        pretended(monkeypatch, 1, WORLD_SIZE="2", RANK="1", LOCAL_RANK="1") as chosen,
        processes("cpu") as group,
    ):
        assert group.device == torch.device("cpu")
    assert chosen == {"device": [], "group": ["gloo"]}


def test_one_process_may_name_its_gpu(monkeypatch):
    """``--device cuda:1`` makes it the current one."""
    with pretended(monkeypatch, 2) as chosen, processes("cuda:1") as group:
        assert group == Group(0, 1, torch.device("cuda:1"))
    assert chosen["device"] == [1]


@pytest.mark.slow
def test_machines_that_share_no_folder_go_on_together(dataset, tmp_path):
    """Two processes with folders of their own, stopped and started again: the same step, the same weights as without a stop."""
    (tmp_path / "go.py").write_text(
        "import sys, json; from pathlib import Path; from dataclasses import replace\n"
        "from tofcapture_model.config import preset, Stage; from tofcapture_model.training.train import train\n"
        "c = preset('demo'); c = replace(c, network=replace(c.network, width=2, levels=2), stages=(Stage('joint', 2),),"
        " training=replace(c.training, batch=1, crop=(32, 32)))\n"
        "stop = int(sys.argv[3]) or None\n"
        "done = train(c, Path(sys.argv[1]), Path(sys.argv[2]), stop_after=stop)\n"
        "print(json.dumps([done.steps, done.finished]))\n"
    )
    port = iter(range(29000 + os.getpid() % 900, 30000))

    def both(name, stop):
        base = os.environ | {
            "WORLD_SIZE": "2",
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(next(port)),
            "OMP_NUM_THREADS": "1",
        }
        ranks = [
            subprocess.Popen(
                [
                    sys.executable,
                    str(tmp_path / "go.py"),
                    str(dataset),
                    str(tmp_path / f"{name}{r}"),
                    str(stop),
                ],
                env=base | {"RANK": str(r), "LOCAL_RANK": str(r)},
                stdout=subprocess.PIPE,
                text=True,
                cwd=ROOT,
            )
            for r in range(2)
        ]
        said = [json.loads(r.communicate(timeout=PATIENCE)[0].splitlines()[-1]) for r in ranks]
        assert [r.returncode for r in ranks] == [0, 0]
        return said

    first, second = both("stopped", 2)
    assert first == second == [2, False]
    assert not (tmp_path / "stopped1" / "resume.safetensors").exists()
    first, second = both("stopped", 0)
    assert first == second
    assert first[1]
    assert both("whole", 0)[0] == first
    from tofcapture_model.networks.checkpoint import load_checkpoint

    models = [load_checkpoint(tmp_path / f"{name}0")[0].state_dict() for name in ("stopped", "whole")]
    assert all(torch.equal(a, b) for a, b in zip(*(m.values() for m in models), strict=True))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_training_and_evaluation_on_a_gpu(dataset, tmp_path):
    """With validation, drawn noise and the Chamfer loss; the loss is that of the CPU."""
    losses = []
    for device in ("cpu", "cuda"):
        config = preset("compact")
        config = replace(
            config,
            network=replace(config.network, width=8, levels=3),
            losses=replace(config.losses, chamfer=0.01),
            training=replace(config.training, crop=(48, 64), batch=2, validate_every=1, frames=1),
            stages=(Stage("joint", 1, 1e-4),),
        )
        done = train(config, dataset, tmp_path / device, device=device)
        losses.append(done.losses["total"])
        evaluate(dataset, done.path, tmp_path / f"{device}.json", device=device)
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
