"""Training, checkpoints, evaluation, prediction and the commands, on small analytic scenes."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests import PATIENCE
from tests.analytic import make_dataset
from tofcapture.cli import main
from tofcapture.errors import BusyError, ConfigError, DataError, FormatError
from tofcapture.files.cache import pack
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Network, Stage, preset
from tofcapture_model.data import FrameDataset, batched
from tofcapture_model.evaluation.evaluate import evaluate
from tofcapture_model.inference.predict import predict
from tofcapture_model.networks.baselines.coarse_fine import CoarseFine
from tofcapture_model.networks.checkpoint import load_checkpoint, read_tensors
from tofcapture_model.training import Group, Run
from tofcapture_model.training.train import scheduled_rate, train


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two training scenes and a test scene at half the sensor's resolution."""
    return make_dataset(tmp_path_factory.mktemp("data") / "dataset", scale=2)


@pytest.fixture(scope="module")
def tiny():
    """A demo preset that trains in no time."""
    base = preset("demo")
    return replace(
        base,
        network=replace(base.network, width=4, levels=2),
        training=replace(base.training, batch=3, crop=(48, 64)),
        stages=(Stage("joint", 2, 1e-2),),
    )


def tiny_steps(dataset, config, folder):
    """Steps of a whole run."""
    return train(config, dataset, folder / "whole").steps


@pytest.fixture(scope="module")
def trained(dataset, tiny, tmp_path_factory):
    """A run of two epochs: eight steps."""
    out = tmp_path_factory.mktemp("run")
    return out, train(tiny, dataset, out)


def test_training_lowers_the_loss(dataset, tiny, tmp_path):
    """A dozen steps on two frames: the model learns."""
    config = replace(tiny, stages=(Stage("joint", 10, 1e-2),))
    train(config, dataset, tmp_path / "run")
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["total"] < lines[0]["total"]
    assert list((tmp_path / "run" / "tensorboard").iterdir())


def test_a_stopped_run_goes_on_to_the_same_bits(dataset, tiny, trained, tmp_path):
    """Three steps, a stop in mid-epoch, and the rest give the very weights of an unbroken run."""
    out = tmp_path / "run"
    stopped = train(tiny, dataset, out, stop_after=3)
    assert (stopped.steps, stopped.finished) == (3, False)
    resumed = train(tiny, dataset, out)
    assert resumed.steps == trained[1].steps
    for a, b in zip(
        load_checkpoint(out)[0].state_dict().values(),
        load_checkpoint(trained[0])[0].state_dict().values(),
        strict=True,
    ):
        assert torch.equal(a, b)
    again = train(tiny, dataset, out)
    assert again.finished
    assert again.steps == resumed.steps


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_goes_on_to_the_same_bits(dataset, tiny, trained, tmp_path, number):
    """Ctrl-C in the first minute, in the middle of a step: the step is ended, a resume point written, and nothing is lost."""
    out, steps = tmp_path / "run", []

    def told(_what, _done, _total, text):
        if text.startswith("step"):
            steps.append(1)
            signal.raise_signal(number)

    def end(*_):
        raise KeyboardInterrupt

    usual = signal.signal(number, end)
    try:
        with pytest.raises(KeyboardInterrupt):
            train(tiny, dataset, out, report=told)
        assert signal.getsignal(number) is end
    finally:
        signal.signal(number, usual)
    assert (out / "resume.safetensors").exists()
    assert len(steps) == 1
    assert train(tiny, dataset, out).steps == trained[1].steps
    for a, b in zip(
        load_checkpoint(out)[0].state_dict().values(),
        load_checkpoint(trained[0])[0].state_dict().values(),
        strict=True,
    ):
        assert torch.equal(a, b)


def test_a_cosine_warms_up_and_falls_from_the_stage_s_rate_to_nothing():
    """A tenth of it at the start, nearly all after the warm-up, half in the middle, next to nothing at the end."""
    rates = {p: scheduled_rate(Stage("joint", 1, 0.01), "cosine", p) for p in (0.0, 0.02, 0.5, 1.0)}
    assert rates == pytest.approx({0.0: 0.001, 0.02: 0.01, 0.5: 0.005, 1.0: 1e-5}, rel=0.02)
    assert scheduled_rate(Stage("joint", 1, 0.01), "constant", 0.7) == 0.01


def test_two_runs_do_not_share_a_folder(dataset, tiny, tmp_path):
    """The second one is told who trains there, and touches nothing; a folder that cannot be written is named first."""
    out = tmp_path / "run"

    def second(*_):
        before = {p: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file()}
        with pytest.raises(BusyError, match=str(os.getpid())):
            train(tiny, dataset, out)
        assert {p: p.stat().st_mtime_ns for p in out.iterdir() if p.is_file()} == before
        told.append(1)

    told = []
    train(tiny, dataset, out, report=second)
    assert told
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="no folder"):
        train(tiny, dataset, tmp_path / "file")


def test_another_configuration_does_not_continue_a_run(dataset, tiny, trained):
    """A run folder belongs to one configuration."""
    with pytest.raises(ConfigError, match="another configuration"):
        train(replace(tiny, losses=replace(tiny.losses, delta=0.01)), dataset, trained[0])


def test_fine_tuning_starts_from_weights(dataset, tiny, trained, tmp_path):
    """The first step has the loss of the given weights; weights of another network are refused; the origin is told."""
    config = replace(tiny, training=replace(tiny.training, seed=3))
    train(config, dataset, tmp_path / "new", stop_after=1)
    train(config, dataset, tmp_path / "on", start=trained[1].path)
    first = [
        json.loads((tmp_path / name / "metrics.jsonl").read_text().splitlines()[0])["total"]
        for name in ("new", "on")
    ]
    assert first[1] < first[0]
    provenance = load_checkpoint(tmp_path / "on")[2]
    assert provenance["start_sha256"] == sha256_of(trained[1].path)
    assert provenance["learned"]["objects"] == ["scene"]
    other = replace(tiny, network=replace(tiny.network, width=5))
    with pytest.raises(ConfigError, match="expected weights of the configuration's network"):
        train(other, dataset, tmp_path / "other", start=trained[1].path)


def test_a_packed_cache_gives_the_same_weights(dataset, tiny, trained, tmp_path):
    """Training from the flat files of `tofcapture pack` takes the very same steps."""
    pack(dataset, "train", tmp_path / "cache")
    train(tiny, dataset, tmp_path / "run", cache=tmp_path / "cache")
    a, b = (load_checkpoint(out)[0].state_dict() for out in (tmp_path / "run", trained[0]))
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_drawn_noise_is_another_one_at_every_step_and_resumes_to_the_same_bits(dataset, tiny, tmp_path):
    """One item a view; a stopped and resumed run has the weights of an unbroken one, other seeds have others."""
    drawn = replace(tiny, training=replace(tiny.training, noise="drawn"))
    train(drawn, dataset, tmp_path / "one")
    train(drawn, dataset, tmp_path / "two", stop_after=1)
    train(drawn, dataset, tmp_path / "two")
    train(replace(drawn, training=replace(drawn.training, seed=1)), dataset, tmp_path / "other")
    one, two, other = (load_checkpoint(tmp_path / n)[0].state_dict() for n in ("one", "two", "other"))
    assert all(torch.equal(one[k], two[k]) for k in one)
    assert not all(torch.equal(one[k], other[k]) for k in one)
    data = FrameDataset(dataset, "train", mean=True)
    assert len(data) == 6
    assert data.averaged == 2


def test_a_loss_that_is_not_finite_stops_before_it_spoils_anything(dataset, tiny, tmp_path):
    """An absurd learning rate, or a gradient that explodes while its loss does not: a clear error, and no step."""
    config = replace(tiny, stages=(Stage("joint", 50, 1e30),))
    with pytest.raises(DataError, match="finite"):
        train(config, dataset, tmp_path / "run")


def test_a_gradient_that_is_not_finite_is_not_followed(dataset, tiny, tmp_path, monkeypatch):
    """The loss is sound, its gradient is not: the run stops before its first step, and nothing is written."""

    def steep(_model, estimate, _target, _frame):
        return (estimate.depth - estimate.depth.detach()).sum().sqrt() + 1

    monkeypatch.setattr(CoarseFine, "loss", steep)
    config = replace(preset("coarse-fine"), training=tiny.training)
    with pytest.raises(DataError, match="finite gradient, got nan at step 1"):
        train(config, dataset, tmp_path / "run")
    assert not (tmp_path / "run" / "resume.safetensors").exists()


def test_short_stages_get_a_tenth_of_a_budget(dataset, tmp_path):
    """Five epochs of 695 would be seconds; the budget is shared out whole all the same."""
    stages = (Stage("depth", 230), Stage("normal", 460), Stage("refine", 5))
    config, group = replace(preset("paper"), stages=stages), Group(0, 1, torch.device("cpu"))
    run = Run(config, None, group, dataset, tmp_path, {"manifest_sha256": ""}, 10.0, print)
    shares = [run.budget(stage) for stage in stages]
    assert sum(shares) == pytest.approx(600)
    assert shares[2] > 0.09 * 600
    assert shares[1] == pytest.approx(2 * shares[0])


def test_a_resumed_run_remembers_its_losses(dataset, tiny, tmp_path):
    """The run's card and provenance have the last that were logged, also when none was logged since."""
    out = tmp_path / "run"
    stopped = train(tiny, dataset, out, stop_after=tiny_steps(dataset, tiny, tmp_path) - 1)
    assert stopped.losses
    assert train(tiny, dataset, out).losses == stopped.losses


def test_the_paper_s_stages_run_in_order(dataset, tiny, tmp_path):
    """Depth, normal and refinement train one after the other, with the Chamfer loss, and the budget is shared."""
    paper = preset("paper")
    config = replace(
        paper,
        network=Network(width=2, levels=3, refine_iterations=1),
        training=replace(tiny.training, schedule="constant"),
        stages=(Stage("depth", 1), Stage("normal", 1), Stage("refine", 1)),
    )
    done = train(config, dataset, tmp_path / "run")
    assert done.finished
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[0]["stage"] == "depth"
    assert sum(rows[0]["winners"]) == 3
    state = json.loads(read_tensors(tmp_path / "run" / "resume.safetensors")[1]["state"])
    assert state["stage"] == 3
    last = {row["stage"]: row["seconds"] for row in rows if "seconds" in row}
    assert state["before"] >= sum(
        last.values()
    )  # the clock starts anew with each stage; the run's minutes are all of them
    assert load_checkpoint(tmp_path / "run")[2]["minutes"] == round(state["before"] / 60, 2)


def test_a_time_budget_ends_a_run(dataset, tiny, tmp_path):
    """A budget shorter than a step still takes one step and finishes."""
    done = train(tiny, dataset, tmp_path / "run", minutes=1e-6)
    assert done.finished
    assert done.steps == 1


def test_checkpoints_are_strict_and_carry_their_configuration(trained, tiny, tmp_path):
    """Weights load with their configuration; a foreign file, and weights that do not fit, are refused."""
    model, config, provenance = load_checkpoint(trained[0])
    assert config == tiny
    assert provenance["steps"] == trained[1].steps
    assert not model.training
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    with pytest.raises(FormatError, match="cannot read"):
        load_checkpoint(tmp_path / "junk.safetensors")
    with pytest.raises(FormatError, match="expected tofcapture-model"):
        load_checkpoint(trained[0] / "resume.safetensors")


def test_evaluation_writes_the_agreed_results(dataset, trained, tmp_path):
    """Both methods, both quantities, both poolings, in metres, on the test split."""
    results = evaluate(dataset, trained[0], tmp_path / "results.json", frames=0)
    assert json.loads((tmp_path / "results.json").read_text()) == results
    assert results["not_new"] == {
        "scene-2": "object scene"
    }  # scene-0, -1 and -2 are one object by their names
    assert (results["format"], results["version"], results["split"]) == ("tofcapture-results", 2, "test")
    assert (results["views"], results["frames"], results["scenes"]) == (3, 6, ["scene-2"])
    for method in ("sensor", "model"):
        table = results["methods"][method]
        assert table["depth"]["pixel"]["pixels"] == table["normal"]["pixel"]["pixels"] > 0
        assert 0 < table["depth"]["image"]["mae"] < 0.1
        assert 0 < table["normal"]["pixel"]["mean_deg"] < 90


def test_a_report_knows_the_weights_of_a_table_and_what_they_learned_from(dataset, trained, tmp_path):
    """The checkpoint that was evaluated is no other one; a test scene with a training scene's object is told."""
    report = pytest.importorskip("tofcapture_model.report", exc_type=ImportError)
    pytest.importorskip("jinja2")
    results = tmp_path / "results.json"
    evaluate(dataset, trained[0], results)
    page = report.write_report(
        dataset=dataset, results=results, evidence=None, weights=trained[0], out=tmp_path / "o.html", views=1
    ).read_text()
    assert "other weights than the table" not in page
    assert "1 of 1 scenes are not new to it: scene-2 (object scene)" in page


def test_predict_writes_every_file_from_a_shard_and_from_an_array(dataset, trained, tmp_path):
    """A shard's frame gives depth, normals, error, PLY and PNG; the same taps as .npy need a rig of their size."""
    shard = dataset / "shards" / "scene-2.h5"
    result = predict(shard, tmp_path / "out", weights=trained[0], view=1, frame=1)
    assert result["shape"] == [180, 240]
    assert result["median_sensor_depth"] > 0
    depth, normals = np.load(tmp_path / "out/depth.npy"), np.load(tmp_path / "out/normals.npy")
    assert depth.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert (tmp_path / "out/cloud.ply").stat().st_size > 28 * depth.size
    reader = FrameDataset(dataset, "test").readers["scene-2"]
    np.save(tmp_path / "raw.npy", reader.raw(1, 1))
    with pytest.raises(DataError, match="expected numbers of shape"):
        predict(tmp_path / "raw.npy", tmp_path / "npy", weights=trained[0])
    from tofcapture.rig import dumps_rig

    (tmp_path / "rig.toml").write_text(dumps_rig(reader.rig))
    predict(tmp_path / "raw.npy", tmp_path / "npy", weights=trained[0], rig=tmp_path / "rig.toml")
    np.testing.assert_allclose(np.load(tmp_path / "npy/depth.npy"), depth, atol=1e-4)
    with pytest.raises(ConfigError, match="frame of 0 to 1"):
        predict(shard, tmp_path / "out", weights=trained[0], frame=7)
    with pytest.raises(DataError, match="no such file"):
        predict(tmp_path / "nothing.npy", tmp_path / "out", weights=trained[0])


def test_the_commands_run_and_answer_in_json(dataset, trained, tmp_path, capsys):
    """evaluate and predict print one JSON object; a missing device is a configuration error."""
    assert (
        main(
            [
                "evaluate",
                str(dataset),
                "--weights",
                str(trained[0]),
                "--out",
                str(tmp_path / "r.json"),
                "--json",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["methods"].keys() == {"sensor", "model"}
    shard = str(dataset / "shards" / "scene-2.h5")
    assert (
        main(
            [
                "predict",
                shard,
                "--view",
                "1",
                "--weights",
                str(trained[0]),
                "--out",
                str(tmp_path / "p"),
                "--average",
                "--json",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["median_sensor_depth"] > 0
    assert main(["evaluate", str(dataset), "--weights", str(trained[0]), "--device", "cuda:7"]) == 3
    assert (
        main(["train", str(tmp_path / "no"), "--out", str(tmp_path / "t"), "--preset", "demo", "--seed", "1"])
        == 5
    )


def test_holes_do_not_reach_the_output(dataset, trained):
    """A frame whose middle is saturated still gives a finite answer everywhere."""
    data = FrameDataset(dataset, "test")
    raw = data.readers["scene-2"].raw(0, 0).copy()
    raw[:, 30:50, 40:60] = 4095
    from tofcapture_model.data import make_frame

    reader = data.readers["scene-2"]
    frame = make_frame(raw, reader.info, reader.camera)
    assert frame.valid[0, 35, 45] == 0
    with torch.inference_mode():
        found = load_checkpoint(trained[0])[0](batched(frame))
    assert all(torch.isfinite(x).all() for x in found)


@pytest.mark.slow
def test_two_processes_train_together(dataset, tmp_path):
    """torchrun with two CPU processes: one checkpoint, both ranks take part."""
    code = (
        "import sys; from pathlib import Path; from dataclasses import replace\n"
        "from tofcapture_model.config import preset, Stage; from tofcapture_model.training.train import train\n"
        "c = preset('demo'); c = replace(c, network=replace(c.network, width=2, levels=2), stages=(Stage('joint', 1),),"
        " training=replace(c.training, batch=2, crop=(48, 64)))\n"
        "print(train(c, Path(sys.argv[1]), Path(sys.argv[2])).steps)\n"
    )
    script = tmp_path / "go.py"
    script.write_text(code)
    base = os.environ | {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(29000 + os.getpid() % 900),
        "OMP_NUM_THREADS": "1",
    }
    ranks = [
        subprocess.Popen(
            [sys.executable, str(script), str(dataset), str(tmp_path / "run")],
            env=base | {"RANK": str(r), "LOCAL_RANK": str(r)},
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[1],
        )
        for r in range(2)
    ]
    said = [r.communicate(timeout=PATIENCE)[0] for r in ranks]
    assert [r.returncode for r in ranks] == [0, 0]
    assert {s.split()[-1] for s in said} == {"3"}
    assert (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which(os.environ.get("CXX", "g++")) is None, reason="no C++ compiler")
def test_compiled_u_nets_train_to_the_same_weights(dataset, tiny, tmp_path):
    """Names and, but for rounding, values of the weights are those of a run without; whole frames are validated eagerly."""
    for compile_ in (False, True):
        training = replace(tiny.training, compile=compile_, validate_every=1)
        config = replace(tiny, training=training, stages=(Stage("joint", 1, 1e-3),))
        train(config, dataset, tmp_path / str(compile_))
    plain, compiled = (load_checkpoint(tmp_path / name)[0].state_dict() for name in ("False", "True"))
    assert plain.keys() == compiled.keys()
    assert all(torch.allclose(plain[k], compiled[k], rtol=1e-3, atol=1e-4) for k in plain)


def test_a_network_without_u_nets_is_not_compiled(dataset, tmp_path):
    """Nothing would be compiled, and nobody would notice."""
    config = preset("coarse-fine")
    config = replace(config, training=replace(config.training, compile=True))
    with pytest.raises(ConfigError, match="U-Nets"):
        train(config, dataset, tmp_path / "run", epochs=1)
