"""Suites of tables, calibration of the uncertainty, export and its backend, on small analytic scenes."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import argparse
import importlib.util
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests import answers
from tests.analytic import make_dataset
from tests.test_model_baselines import target
from tests.test_model_networks import frame
from tofcapture.cli import main
from tofcapture.errors import ConfigError
from tofcapture.files.cache import pack
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Losses, Stage, preset, presets
from tofcapture_model.data import make_target
from tofcapture_model.evaluation.metrics import Precision, Uncertainty, regions
from tofcapture_model.evaluation.suite import averaged, read_weights
from tofcapture_model.evaluation.tables import SUITES, cells
from tofcapture_model.geometry.maps import rays, scale_intrinsics
from tofcapture_model.inference.predict import predict
from tofcapture_model.losses import error_map_loss, laplace_loss, reweighting
from tofcapture_model.networks import build_model, training_loss
from tofcapture_model.networks.checkpoint import budget, load_checkpoint
from tofcapture_model.training.card import closest_preset
from tofcapture_model.training.train import train


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A training scene, a validation scene and a test scene at a quarter of the sensor's resolution."""
    folder = tmp_path_factory.mktemp("data") / "dataset"
    return make_dataset(folder, scale=2, views=2, splits=("train", "val", "test"))


def tiny(name, seed=0):
    """A preset that trains in no time."""
    base = preset(name)
    network = replace(base.network, width=4, levels=2)
    training = replace(base.training, batch=2, crop=(48, 64), frames=1, validate_every=0, seed=seed)
    return replace(base, network=network, training=training, stages=(Stage(base.stages[0].name, 1, 1e-3),))


@pytest.fixture(scope="module")
def runs(dataset, tmp_path_factory):
    """Two runs of demo and one of coarse-fine."""
    out = tmp_path_factory.mktemp("runs")
    for name, seed in (("demo", 0), ("demo", 1), ("coarse-fine", 0)):
        config = tiny(name, seed)
        config = replace(config, training=replace(config.training, validate_every=1))
        train(config, dataset, out / f"{name}-{seed}")
    return out


def test_a_suite_writes_its_tables_and_every_number(dataset, runs, tmp_path, capsys):
    """All suites in one command: methods without parameters, two runs averaged with their spread, three kinds of tables."""
    weights = [
        f"compact={runs / 'demo-0'}",
        f"compact={runs / 'demo-1'}",
        f"coarse-fine={runs / 'coarse-fine-0'}",
    ]
    command = [
        "evaluate",
        str(dataset),
        "--suite",
        "all",
        "--weights",
        *weights,
        "--out",
        str(tmp_path / "r.json"),
    ]
    assert main([*command, "--json"]) == 0
    results = json.loads((tmp_path / "r.json").read_text())
    assert list(results["methods"]) == ["sensor", "lf2", "compact", "coarse-fine"]
    assert list(results["spread"]) == ["compact"]
    untrained = {name: results["methods"][name] for name in ("sensor", "lf2")}
    answers.hold(
        "evaluate",
        {**results, "methods": untrained},
        off=0.1,
        least=1e-4,
        without=("spread", "runs", "manifest_sha256"),
        names=[(dataset, "DATASET")],
    )
    compact = results["methods"]["compact"]
    assert 0 <= compact["extra"]["coverage_1sigma"] <= 1
    assert compact["extra"]["precision"] > 0
    assert "coverage_1sigma" not in results["methods"]["sensor"]["extra"]
    parts = [compact["regions"][r]["depth"]["pixel"]["pixels"] for r in ("edge", "interior")]
    assert sum(parts) == compact["depth"]["pixel"]["pixels"]
    text = (tmp_path / "tables.md").read_text()
    assert all(suite.title in text for suite in SUITES.values())
    assert "±" in text
    assert r"\begin{tabular}" in (tmp_path / "tables.tex").read_text()
    assert "<table>" in (tmp_path / "tables.html").read_text()
    assert json.loads(capsys.readouterr().out)["suite"] == "all"


def test_rows_have_the_paper_s_names_in_its_order_and_tell_their_budget():
    """Table III from results in any order: the paper's words, no row that it does not know, minutes and steps unmarked."""
    row = {"depth": {"pixel": {"mae": 0.002}}, "budget": {"minutes": 60.0, "steps": 1234}}
    better = {**row, "depth": {"pixel": {"mae": 0.001}}}
    results = {
        "methods": {"paper": better, "mine": row, "without-chamfer": row, "sensor": {}, "inputs-raw": row}
    }
    table = cells(results, SUITES["ablation"])
    assert [name for name, _ in table] == [
        "ToF sensor",
        "w/o multi-input",
        "w/o Chamfer loss",
        "Ours (full model)",
    ]
    assert table[-1][1][3:] == [("1.00", True), ("–", False), ("–", False), ("60.0", False), ("1234", False)]
    assert [name for name, _ in cells(results, SUITES["main"])][-1] == "mine"


def test_recipes_are_the_rows_of_the_tables():
    """Every run that benchmarks/tables.py trains has a row, every row a run; all train on equal terms but for network and loss."""
    spec = importlib.util.spec_from_file_location(
        "tables", Path(__file__).parents[1] / "benchmarks" / "tables.py"
    )
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    recipes = script.recipes()
    for suite in ("ablation", "inputs"):
        assert {*recipes[suite], "sensor"} == SUITES[suite].rows.keys()
    assert recipes["main"].keys() - {"compact"} <= SUITES["main"].rows.keys()
    args = argparse.Namespace(width=8, crop=0, rate={"paper": 5e-4}, precision="bfloat16")
    equal = {n: script.on_equal_terms(c, args, 1) for suite in recipes.values() for n, c in suite.items()}
    assert len({config.training for config in equal.values()}) == 1
    rates = {name: {stage.learning_rate for stage in config.stages} for name, config in equal.items()}
    assert rates["paper"] == rates["without-chamfer"] == {5e-4}
    assert rates["coarse-fine"] == {1e-3}


def test_a_card_tells_of_its_run(dataset, runs):
    """Preset and differences, digest and counts of the data, the budget that the checkpoint remembers, how to go on."""
    text = (runs / "demo-1" / "README.md").read_text()
    provenance = load_checkpoint(runs / "demo-1")[2]
    assert "differences from the preset `demo`" in text
    assert "| training.seed | `0` | `1` |" in text
    assert sha256_of(dataset / "manifest.json") in text
    assert "| train | 1 | 2 | 4 |" in text
    assert re.search(rf"\b{provenance['steps']} step{'s' if provenance['steps'] != 1 else ''}\b", text)
    assert not re.search(r"\b1 (step|view|scene|minute)s\b", text)
    assert f"tofcapture evaluate {dataset} --weights {runs / 'demo-1'}" in text
    assert "val MAE mm" in text
    assert provenance["minutes"] >= 0
    assert provenance["torch"] == torch.__version__
    assert budget(provenance)["steps"] == provenance["steps"]


def test_a_preset_differs_from_itself_in_nothing():
    """Each is its own closest one."""
    for name in presets():
        assert closest_preset(preset(name))[1] == {}


def test_wrong_weights_and_scenes_are_named(dataset, runs):
    """A pair without a name, a reserved name, a scene that is not there."""
    for pair in ("nothing", "=x", "sensor=x"):
        with pytest.raises(ConfigError, match="NAME=PATH"):
            read_weights([pair])
    assert main(["evaluate", str(dataset), "--suite", "main", "--scenes", "kitchen"]) == 3
    assert main(["evaluate", str(dataset), "--weights", "a=b"]) == 3


def test_runs_are_averaged_number_by_number():
    """Mean and standard deviation; what one run lacks is left out."""
    mean, spread = averaged([{"a": {"b": 1.0}, "c": 1}, {"a": {"b": 3.0}}])
    assert mean == {"a": {"b": 2.0}}
    assert spread["a"]["b"] == pytest.approx(2**0.5)


def test_a_perfect_uncertainty_has_no_area_and_a_reversed_one_has_much():
    """AUSE is zero for the right order; a sigma above every error covers all."""
    error = torch.rand(1000, generator=torch.Generator().manual_seed(0))
    good, bad = Uncertainty(), Uncertainty()
    good.add(error, error)
    bad.add(error, -error)
    assert good.row() == {"coverage_1sigma": 1.0, "ause": 0.0}
    assert bad.row(scale=False)["ause"] > 0.5
    assert Uncertainty().row() == {}


def test_precision_is_the_spread_of_a_pixel_over_the_shots():
    """A constant offset between pixels is none; one frame has none."""
    shots = Precision()
    for k in range(10):
        shots.add(torch.tensor([1.0, 2.0]) + 0.001 * (-1) ** k)
    shots.close()
    assert shots.row()["precision"] == pytest.approx(0.001 * (10 / 9) ** 0.5, rel=1e-3)
    shots.add(torch.ones(2))
    shots.close()
    assert shots.views == 1


def test_shots_without_an_answer_are_left_out():
    """A pixel that one shot lacks has no spread, and an error that is not finite no place in the order."""
    shots, nan = Precision(), torch.nan
    for row in ([1.0, 2.0, nan], [1.2, nan, 3.0]):
        shots.add(torch.tensor(row))
    shots.close()
    assert shots.row()["precision"] == pytest.approx(0.2 / 2**0.5, rel=1e-5)
    for _ in range(2):
        shots.add(torch.full((3,), nan))
    shots.close()
    assert shots.views == 1
    error = torch.rand(100, generator=torch.Generator().manual_seed(0))
    some, all_ = Uncertainty(), Uncertainty()
    some.add(error, 1 - error)
    all_.add(torch.cat([torch.tensor([nan, 0.1]), error]), torch.cat([torch.tensor([0.1, nan]), 1 - error]))
    assert all_ == some


def surface(tilt, step=0.0, masked=0, missing=0, rough=0.0):
    """A frame and its ground truth: a plane 1.2 m ahead, tilted about y; right of the middle another, ``step`` behind it.

    ``masked`` and ``missing`` pixels on either side of the step are neither good nor context, or without depth.
    """
    data = frame(90, 120, batch=1)._replace(intrinsics=torch.tensor([[190.0, 200.0, 59.5, 44.5]]))
    r = rays(scale_intrinsics(data.intrinsics, 2), 180, 240)[0].double().permute(1, 2, 0).numpy()
    normal = np.array([np.sin(np.radians(tilt)), 0, -np.cos(np.radians(tilt))])
    right = np.arange(240)[None, :] >= 120
    depth = (1.2 * normal[2] - step * right) / (r @ normal)
    if (
        rough
    ):  # m; towards the viewer and away in turns along the columns, by a tenth of a degree of slope or so
        depth = depth + rough * np.sin(np.arange(240) / 20)
    near = np.minimum(abs(np.arange(240) - 119), abs(np.arange(240) - 120))[None, :] + np.zeros((180, 1), int)
    depth = np.where(near < missing, np.nan, depth).astype(np.float32)
    mask = np.where(np.isnan(depth), 1, np.where(near < masked, 8, 0)).astype(np.uint8)
    normals = np.broadcast_to(normal, (180, 240, 3)).astype(np.float32)
    return data, type(target(data))(*(x[None] for x in make_target(depth, normals, mask)))


@pytest.mark.parametrize("tilt", [0, 50, 60, 75])
def test_a_slanted_plane_has_no_edge(tilt):
    """However much its depth changes within the band."""
    found = regions(*surface(tilt, rough=0.0005))
    assert found["all"].all()
    assert not found["edge"].any()


@pytest.mark.parametrize("step", [0.031, -0.031, 0.2])
@pytest.mark.parametrize("tilt", [0, 50, -50])
def test_a_step_of_3_cm_is_an_edge_of_5_px_on_either_side(tilt, step):
    """Seen from the front or on a slope, its rim good or masked; half of it is none."""
    band = torch.zeros(240, dtype=torch.bool)
    band[115:125] = True
    for masked in (0, 2, 3):
        data, truth = surface(tilt, step, masked)
        assert torch.equal(regions(data, truth)["edge"], truth.good & band)
    assert not regions(*surface(tilt, step=0.015))["edge"].any()


@pytest.mark.parametrize("tilt", [0, 50])
@pytest.mark.parametrize("missing", [1, 2])
def test_a_step_across_missing_ground_truth_is_an_edge(tilt, missing):
    """Up to five pixels without depth may lie between both sides; without a step they are no edge."""
    data, truth = surface(tilt, 0.05, masked=missing + 1, missing=missing)
    found = regions(data, truth)["edge"]
    assert found[0, 0, :, 115:125].equal(truth.good[0, 0, :, 115:125])
    assert not found[..., :114].any()
    assert not found[..., 126:].any()
    assert not regions(*surface(tilt, 0.0, masked=missing + 1, missing=missing))["edge"].any()


def test_a_crease_is_no_edge():
    """Two walls that meet at a right angle, seen 4 m away: neighbours are off each other's planes by less than a step."""
    data, truth = surface(45)
    left = torch.arange(240) < 120
    depth = torch.where(left, truth.depth.flip(-1), truth.depth) / 1.2 * 4
    mirrored = truth.normals * torch.tensor([-1.0, 1, 1]).reshape(1, 3, 1, 1)
    walls = truth._replace(depth=depth, normals=torch.where(left, mirrored, truth.normals))
    assert not regions(data, walls)["edge"].any()


def test_regions_split_the_good_pixels():
    """Each pair of regions covers the good pixels once; a step of 10 cm is an edge."""
    data = frame(batch=1)
    truth = target(data)._replace(depth=torch.where(torch.arange(88) < 40, 0.8, 0.9).expand(1, 1, 72, 88))
    found = regions(data, truth)
    for a, b in (("edge", "interior"), ("mpi", "no-mpi"), ("dark", "bright")):
        assert torch.equal(found[a] | found[b], truth.good)
        assert not (found[a] & found[b]).any()
    assert not found["edge"][..., :30].any()
    assert torch.equal(found["edge"][..., 38:42], truth.good[..., 38:42])


def test_the_uncertainty_is_calibrated_on_the_validation_split(dataset, runs):
    """68 % of the errors of the first validation frames lie within the predicted sigma, and the checkpoint says so."""
    from tofcapture_model.data import FrameDataset, batched

    model, _, provenance = load_checkpoint(runs / "demo-0")
    assert provenance["uncertainty"]["views"] == 2
    assert float(model.error_map.calibration) == pytest.approx(provenance["uncertainty"]["factor"])
    data, inside, total = FrameDataset(dataset, "val", frames=1), 0, 0
    for sample in data.samples:
        truth = data.target(sample)
        with torch.no_grad():
            found = model(batched(data.frame(sample)))
        error = (found.depth[0] - truth.depth).abs()[truth.good]
        inside, total = inside + int((error <= found.error[0][truth.good]).sum()), total + len(error)
    assert inside / total == pytest.approx(0.6827, abs=0.02)


def test_the_likelihood_is_best_at_the_mean_error():
    """Of all constant scales the mean absolute error has the least loss; the depth gets no gradient."""
    g = torch.Generator().manual_seed(0)
    gt = torch.ones(1, 1, 20, 20)
    depth = (gt + 0.01 * torch.randn(gt.shape, generator=g)).requires_grad_()
    mask, mean = torch.ones_like(gt, dtype=torch.bool), (depth - gt).abs().mean().detach()
    losses = [
        laplace_loss(torch.full_like(gt, float(mean) * f), depth, gt, mask).item() for f in (0.8, 1.0, 1.25)
    ]
    assert losses[1] == min(losses)
    scale = torch.full_like(gt, 0.01, requires_grad=True)
    laplace_loss(scale, depth, gt, mask).backward()
    assert depth.grad is None
    assert scale.grad is not None


def test_gradients_flow_where_the_paper_says_and_nowhere_else():
    """Eq. 1 does not reach the error map through lambda, nor the error map's loss the depth network."""
    network = replace(preset("paper").network, width=2, levels=2, refine_iterations=0)
    model = build_model(replace(preset("paper"), network=network, stages=(Stage("depth", 1),)))
    torch.nn.init.normal_(model.error_map.net.last.weight, std=0.01)
    data = frame()
    truth = target(data)
    for part, reached, spared in (("depth", "raw2depth", "error_map"), ("error", "error_map", "raw2depth")):
        model.zero_grad(set_to_none=True)
        found = training_loss(model, Losses(chamfer=0.0), "depth", model(data, "depth"), truth, data)
        found.parts[part].backward()
        norms = {
            name: sum(
                float(p.grad.abs().sum()) for p in getattr(model, name).parameters() if p.grad is not None
            )
            for name in (reached, spared)
        }
        assert norms[reached] > 0
        assert norms[spared] == 0
    error = torch.full_like(truth.depth, 0.01, requires_grad=True)
    assert not reweighting(truth.depth, error, truth.good).requires_grad
    depth = truth.depth.clone().requires_grad_()
    error_map_loss(error, depth, truth.depth, truth.good).backward()
    assert depth.grad is None


def test_bfloat16_trains_and_keeps_geometry_in_float32(dataset, tmp_path):
    """Half precision is for convolutions; the answer stays float32 and finite."""
    config = tiny("demo")
    done = train(
        replace(config, training=replace(config.training, precision="bfloat16")), dataset, tmp_path / "run"
    )
    assert np.isfinite(done.losses["total"])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["onnx", pytest.param("torch", marks=pytest.mark.slow)])
def test_an_export_answers_as_torch_does(dataset, runs, tmp_path, kind):
    """The export is checked on two batch sizes, and predict's onnx backend gives the same depth."""
    if kind == "onnx":
        pytest.importorskip("onnx")
        pytest.importorskip("onnxruntime")
    from tofcapture_model.inference.export import export

    folder = tmp_path / "run"
    folder.mkdir()
    for file in (runs / "demo-0").glob("model.*"):
        (folder / file.name).write_bytes(file.read_bytes())
    out = folder / ("model.onnx" if kind == "onnx" else "model.pt2")
    result = export(folder, out, kind=kind, size=(90, 120))
    assert result["bytes"] == out.stat().st_size > 0
    if kind == "onnx":
        shard = dataset / "shards" / "scene-2.h5"
        for backend in ("torch", "onnx"):
            predict(shard, tmp_path / backend, weights=folder, backend=backend, view=0)
        a, b = (np.load(tmp_path / k / "depth.npy") for k in ("torch", "onnx"))
        assert np.quantile(np.abs(a - b), 0.99) < 1e-4


def test_a_backend_without_its_file_says_what_to_do(dataset, runs, tmp_path):
    """The onnx backend wants an export beside the weights."""
    with pytest.raises(ConfigError, match="no such file"):
        predict(dataset / "shards" / "scene-2.h5", tmp_path, weights=runs / "demo-0", backend="onnx")


@pytest.mark.slow
def test_all_tables_by_one_script(dataset, runs, tmp_path):
    """benchmarks/tables.py trains everything with tiny budgets, writes three tables, and a second call trains nothing."""
    pack(dataset, "train", tmp_path / "packed")
    other = make_dataset(tmp_path / "other", scale=2, views=1, splits=("test",), seed=9)
    script = Path(__file__).parents[1] / "benchmarks" / "tables.py"
    small = ["--minutes", "0.001", "--width", "2", "--crop", "48", "--frames", "1", "--threads", "1"]
    data = ["--cache", str(tmp_path / "packed"), "--test", str(other), "--add", f"long={runs / 'demo-0'}"]
    command = [sys.executable, str(script), str(dataset), "--out", str(tmp_path), *small, *data]
    subprocess.run(command, check=True, timeout=560)
    weights = tmp_path / "runs" / "paper-0" / "model.safetensors"
    made = weights.stat().st_mtime_ns
    for suite in ("main", "ablation", "inputs"):
        assert (tmp_path / suite / "tables.md").exists()
        results = json.loads((tmp_path / suite / "results.json").read_text())
        assert (results["suite"], results["dataset"]) == (suite, str(other))
        assert ("long" in results["methods"]) == (suite == "main")
        assert results["methods"]["paper"]["budget"]["steps"] >= 1
    refused = subprocess.run([*command, "--suite", "inputs"], check=False, timeout=60, capture_output=True)
    assert refused.returncode == 2
    subprocess.run([*command, "--suite", "main"], check=True, timeout=560)
    assert weights.stat().st_mtime_ns == made
