"""Exports: of which weights they are, that the backend refuses others, and that nothing beside them is touched."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from tests.test_model_predict import saved
from tests.test_model_predict_inputs import SMALL, burst_of, rig, save_network  # noqa: F401
from tofcapture.cli import main
from tofcapture.errors import ConfigError
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import dumps_config, preset
from tofcapture_model.inference import export as exporting
from tofcapture_model.inference import predict as predicting
from tofcapture_model.inference.export import export
from tofcapture_model.inference.predict import predict
from tofcapture_model.networks import checkpoint
from tofcapture_model.networks.checkpoint import load_checkpoint, save_model

pytestmark = pytest.mark.filterwarnings("ignore")
SIZE = SMALL.shape


def network(folder, kind="demo"):
    """A small network that refines nothing, so that it is soon exported."""
    base = preset(kind)
    small = replace(base.network, width=4, levels=2, refine_iterations=0) if kind == "demo" else base.network
    return save_network(folder, replace(base, network=small))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Weights and their export beside them."""
    weights = network(tmp_path_factory.mktemp("run"))
    export(weights, weights.with_suffix(".onnx"), size=SIZE)
    return weights


@pytest.fixture
def run(exported, tmp_path):
    """A copy to change, and a frame to predict from."""
    for path in (exported, exported.with_suffix(".onnx")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    saved(tmp_path / "raw.npy", burst_of(SMALL, 1)[0])
    return tmp_path


@pytest.fixture(autouse=True)
def _fast(monkeypatch):
    monkeypatch.setattr(predicting, "WARM", 0)
    monkeypatch.setattr(predicting, "RUNS", 1)


def test_an_export_carries_its_configuration_and_its_weights_digest(exported):
    """In the metadata, where it cannot be lost; no file but the export is written."""
    told = {p.key: p.value for p in onnx.load(str(exported.with_suffix(".onnx"))).metadata_props}
    assert told["weights_sha256"] == sha256_of(exported)
    assert told["config.toml"] == dumps_config(load_checkpoint(exported)[1])
    assert sorted(p.name for p in exported.parent.iterdir()) == [
        "model.onnx",
        "model.safetensors",
        "model.toml",
    ]


@pytest.mark.slow
def test_a_torch_export_carries_the_same(tmp_path):
    """As extra files of the .pt2."""
    weights = network(tmp_path)
    export(weights, tmp_path / "model.pt2", kind="torch", size=SIZE)
    told = {"weights_sha256": "", "config.toml": ""}
    torch.export.load(str(tmp_path / "model.pt2"), extra_files=told)
    assert told == {
        "weights_sha256": sha256_of(weights),
        "config.toml": dumps_config(load_checkpoint(weights)[1]),
    }


def test_the_backend_answers_for_its_weights_only(run, rig):  # noqa: F811
    """An export of weights that have changed since, or one that does not say of which it is, is refused; alone it answers."""
    asked = {"weights": run, "rig": rig, "backend": "onnx"}
    predict(run / "raw.npy", run / "a", **asked)
    model, config, _ = load_checkpoint(run)
    with torch.no_grad():
        next(model.parameters()).add_(1)
    save_model(run / "model.safetensors", model, config, {})
    with pytest.raises(ConfigError, match="one of other weights") as caught:
        predict(run / "raw.npy", run / "b", **asked)
    assert "run tofcapture export again" in caught.value.hint
    (run / "model.safetensors").unlink()
    predict(run / "raw.npy", run / "b", **asked)
    np.testing.assert_array_equal(np.load(run / "a/depth.npy"), np.load(run / "b/depth.npy"))
    made = onnx.load(str(run / "model.onnx"))
    (trust,) = (o for o in made.graph.output if o.name == "trust")
    made.graph.output.remove(trust)
    onnx.save(made, str(run / "model.onnx"))
    with pytest.raises(ConfigError, match="an export that answers trust, got an older one"):
        predict(run / "raw.npy", run / "c", **asked)
    del made.metadata_props[:]
    onnx.save(made, str(run / "model.onnx"))
    with pytest.raises(ConfigError, match="says of which weights") as caught:
        predict(run / "raw.npy", run / "c", **asked)
    assert "run tofcapture export again" in caught.value.hint


def test_the_backend_refuses_frames_of_another_size(run):
    """As it did: the size of an export is fixed."""
    with pytest.raises(ConfigError, match="exported for frames of"):
        predict(saved(run / "full.npy", burst_of(replace(SMALL, width=50), 1)[0]), run / "a", weights=run,
                rig=_rig_of(run, replace(SMALL, width=50)), backend="onnx")  # fmt: skip


def test_an_export_answers_for_cameras_of_three_frequencies(exported):
    """It reads the lowest and the highest, as the network does, however many there are between."""
    frame = exporting.example(1, SIZE)._replace(modulation=torch.tensor([[54e6, 198e6, 189e6]]))
    model, config, _ = load_checkpoint(exported)
    with torch.no_grad():
        expected = model(frame).depth
    found = exporting.ask_onnx(exporting.open_onnx(exported.with_suffix(".onnx")), frame)[0]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert config.network.kind == "compact"


def _rig_of(folder, camera):
    from tofcapture.camera import Camera
    from tofcapture.rig import Rig, dumps_rig

    path = folder / "rig.toml"
    path.write_text(dumps_rig(Rig(camera, Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))))
    return path


@pytest.fixture
def quick(monkeypatch):
    """An export that is made and checked in no time."""
    monkeypatch.setattr(exporting, "_onnx", lambda flat, path, size, told: path.write_bytes(b"made"))
    monkeypatch.setattr(exporting, "_differences", lambda *_: {"depth_2x": 0.0})


def test_an_export_touches_nothing_of_the_users(quick, tmp_path):
    """A TOML beside it stays, a checkpoint without its own is exported, nothing is left behind."""
    weights = network(tmp_path / "run")
    (tmp_path / "run/model.toml").unlink()
    (tmp_path / "out").mkdir()
    for name in ("net.toml", "partial-net.onnx"):
        (tmp_path / "out" / name).write_text("mine")
    assert main(["export", "--weights", str(weights), "--out", str(tmp_path / "out/net.onnx")]) == 0
    assert {p.name: p.read_text() for p in (tmp_path / "out").iterdir()} == {
        "net.toml": "mine",
        "partial-net.onnx": "mine",
        "net.onnx": "made",
    }


@pytest.mark.parametrize("name", ["run.toml", "model", "model.pt2", "folder.onnx", "file/model.onnx"])
def test_an_export_wants_a_name_of_its_kind(name, quick, tmp_path, capsys):
    """Exit code 3 and nothing is written, however the name is wrong."""
    weights = network(tmp_path / "run")
    (tmp_path / "folder.onnx").mkdir()
    for file in ("file", "run.toml"):
        (tmp_path / file).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert main(["export", "--weights", str(weights), "--out", str(tmp_path / name)]) == 3
    assert "--out" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "run.toml").read_text() == "mine"


def test_a_failed_export_leaves_the_one_that_was_there(quick, monkeypatch, tmp_path):
    """What is being made lies apart until it was checked."""
    weights = network(tmp_path / "run")
    (tmp_path / "run/model.onnx").write_text("earlier")

    def fails(*_):
        raise ConfigError("differs")

    monkeypatch.setattr(exporting, "_differences", fails)
    with pytest.raises(ConfigError, match="differs"):
        export(weights, tmp_path / "run/model.onnx")
    assert (tmp_path / "run/model.onnx").read_text() == "earlier"
    assert len(list((tmp_path / "run").iterdir())) == 3


def test_bundled_weights_are_exported_to_here(quick, tmp_path, monkeypatch):
    """By name as without one: the package is no place to write to."""
    weights = network(tmp_path / "package/weights")
    monkeypatch.setattr(checkpoint, "files", lambda _: tmp_path / "package")
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--weights", "bundled"]):
        assert main(["export", *words]) == 0
        (tmp_path / "model.onnx").unlink()
    assert not weights.with_suffix(".onnx").exists()


@pytest.mark.parametrize("kind", ["su2018", "guo2018", "coarse-fine"])
def test_baselines_are_exported_for_any_batch(kind, tmp_path):
    """One and three frames at once are held against torch before the export is kept."""
    told = export(network(tmp_path, kind), tmp_path / "model.onnx", size=SIZE)
    assert told["differences"]["depth_2x"] < 1e-3
    assert (tmp_path / "model.onnx").exists()
