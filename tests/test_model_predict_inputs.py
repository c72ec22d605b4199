"""What predict starts from and what it says of it: what was measured, counts of other units, saturated shots, files, lenses."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tests.test_model_predict import saved, table_top
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.errors import ConfigError, DataError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.ops.phase import taps
from tofcapture.rig import SPEED_OF_LIGHT, Rig, dumps_rig
from tofcapture_model.config import Config, Network, Stage, preset
from tofcapture_model.data.raw_input import NOMINAL_CAMERA, NOMINAL_RANGE_ERRORS, RawInput, read_input, taken
from tofcapture_model.inference import predict as predicting
from tofcapture_model.inference.predict import Predictor, predict, predict_raw
from tofcapture_model.networks import build_model, checkpoint
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint, save_model

ROOT = Path(__file__).parents[1]
SMALL = Camera(48, 36, 38.0, 38.0, 23.5, 17.5)


def save_network(folder, config):
    """An untrained network of a configuration."""
    torch.manual_seed(0)
    return save_model(folder / "model.safetensors", build_model(config), config, {})


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A small network that answers as the sensor does."""
    base = preset("demo")
    config = replace(base, network=replace(base.network, width=4, levels=2))
    return save_network(tmp_path_factory.mktemp("package") / "weights", config)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """The rig of a small camera."""
    path = tmp_path_factory.mktemp("rig") / "rig.toml"
    path.write_text(dumps_rig(Rig(SMALL, Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))))
    return path


@pytest.fixture(autouse=True)
def _fast(monkeypatch):
    """Time is not what these tests look at."""
    monkeypatch.setattr(predicting, "WARM", 0)
    monkeypatch.setattr(predicting, "RUNS", 1)


def wall(camera, depth=0.8):
    """(8, H, W) noiseless taps of a wall that faces the camera, along the rays of its lens."""
    ranges = depth * camera.ray_lengths
    z = 400 * np.exp(4j * np.pi * np.array([20e6, 100e6])[:, None, None] * ranges / SPEED_OF_LIGHT)
    return np.rint(taps(z, np.full(z.shape, 600.0), PAPER_MODULATION_HZ, PAPER_PHASE_RAD)).astype(np.uint16)


def burst_of(camera, frames=4):
    """(F, 8, H, W) uint16 counts of a table."""
    return np.stack([table_top(camera, seed)[0] for seed in range(frames)])


@pytest.mark.parametrize(
    ("value", "words"), [(0, "no light"), (4095, "at or beyond it"), (700, "no modulated light")]
)
def test_a_frame_that_measured_nothing_is_refused(value, words, weights, rig, tmp_path):
    """Dark, overexposed, covered: the frame that is used is looked at, not its burst's mean; the others still answer."""
    burst = burst_of(SMALL)
    burst[3] = value
    path = saved(tmp_path / "burst.npy", burst)
    with pytest.raises(DataError, match=f"frame 3.*{words}") as caught:
        predict(path, tmp_path / "out", weights=weights, rig=rig, frame=3)
    assert "--frame" in caught.value.hint or value == 700
    assert predict(path, tmp_path / "out", weights=weights, rig=rig, frame=2)["measured"] == 1


@pytest.mark.parametrize(("value", "words"), [(0, "no light"), (4095, "100% of them are saturated")])
def test_a_frame_of_a_file_that_measured_nothing_is_refused(value, words, weights, tmp_path):
    """As of a view or a shard, which is not looked at when it is read."""
    shard = next(make_dataset(tmp_path, views=1, frames=2, scale=4).glob("shards/*.h5"))
    data = read_input(shard)
    data.raw[1] = value
    words = rf"{shard.name}, frame 1: expected pixels that measure.*{words}"
    with pytest.raises(DataError, match=words) as caught:
        predict_raw(data, 1, weights)
    assert "--frame" in caught.value.hint
    assert predict_raw(data, 0, weights).measured.any()


def test_taps_that_are_no_numbers_do_not_reach_the_network(weights):
    """One NaN in float raw data would be a NaN everywhere."""
    raw = burst_of(SMALL).astype(np.float32)
    raw[1, 2, 3, 4] = np.nan
    data = RawInput(raw, np.full(4, np.nan), TofInfo("t", "", SMALL, np.zeros(3)), SMALL, "v.h5")
    with pytest.raises(DataError, match=r"v.h5, frame 1: expected finite numbers, got 1"):
        predict_raw(data, 1, weights)
    assert np.isfinite(predict_raw(data, 0, weights).depth).all()


def test_it_says_what_was_measured_and_what_was_filled(weights, rig, tmp_path, capsys):
    """As a share in JSON, in words, and as an image of the output's size beside the depth."""
    raw = burst_of(SMALL, 1)[0]
    raw[:, :9, :12] = 4095
    path = saved(tmp_path / "raw.npy", raw)
    words = [
        "predict",
        str(path),
        "--rig",
        str(rig),
        "--weights",
        str(weights),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    share = 1 - 9 * 12 / (36 * 48)
    assert (answer["measured"], answer["filled"]) == (share, round(1 - share, 4))
    measured = np.load(tmp_path / "out/measured.npy")
    assert measured.dtype == bool
    assert measured.shape == np.load(tmp_path / "out/depth.npy").shape
    assert not measured[:18, :24].any()
    assert measured[18:].all()
    assert measured[:, 24:].all()
    assert answer["files"]["measured.npy"] == str(tmp_path / "out/measured.npy")
    assert "measured.npy" in (tmp_path / "out/units.txt").read_text()
    assert np.load(tmp_path / "out/trust.npy").shape == (36, 48)
    assert answer["trusted"] == 1.0  # weights that have seen nothing know of no stranger
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "93.8% of the pixels were measured" in said
    assert "unlike what the network learned from" not in said


def test_counts_beyond_saturation_are_refused_until_it_is_said(weights, rig, tmp_path):
    """14 bits are no 12; with --saturation they decode, and to the same depth, since a network reads shares of it."""
    raw = burst_of(SMALL, 1)[0]
    path = saved(tmp_path / "raw.npy", raw * np.uint16(4))
    with pytest.raises(DataError, match="saturates at 4095, got values up to") as caught:
        read_input(path, rig=rig)
    assert "--saturation" in caught.value.hint
    for name, array, saturation in (("14", raw * np.uint16(4), 4 * 4095), ("12", raw, 4095)):
        given = saved(tmp_path / f"{name}.npy", array)
        predict(given, tmp_path / name, weights=weights, rig=rig, saturation=saturation)
    depths = [np.load(tmp_path / name / "depth.npy") for name in ("12", "14")]
    np.testing.assert_allclose(*depths, atol=1e-4)


def test_counts_of_fewer_bits_are_doubted_and_a_dark_frame_is_not_refused(weights, rig, tmp_path, capsys):
    """Low counts may be a dark scene: a line on stderr says what they may be else; with --saturation there is none."""
    raw = burst_of(SMALL, 1)[0]
    for array in (raw // 4, raw * (255 / 4095)):
        path = saved(tmp_path / "raw.npy", array)
        words = ["predict", str(path), "--rig", str(rig), "--weights", str(weights), "--json"]
        words += ["--out", str(tmp_path / "out")]
        assert main(words) == 0
        said = capsys.readouterr()
        assert "no count exceeds" in said.err
        assert "--saturation" in json.loads(said.out)["warning"]
        assert main([*words, "--saturation", "1023"]) == 0
        assert capsys.readouterr().err == ""
    assert read_input(saved(tmp_path / "raw.npy", raw), rig=rig).warning == ""


def test_saturation_is_for_arrays(tmp_path):
    """A view carries its own."""
    (tmp_path / "view.h5").touch()
    with pytest.raises(ConfigError, match=r"--saturation 1023.*expected an array"):
        read_input(tmp_path / "view.h5", saturation=1023)


def test_the_mean_does_not_hide_taps_that_saturate_in_some_shots(weights, rig, tmp_path):
    """Saturated in one frame of four is not measured in the mean, as Decoder.burst has it, and biases no depth."""
    burst = burst_of(SMALL)
    burst[1, 2, 10:14, 20:25] = 4095
    path = saved(tmp_path / "burst.npy", burst)
    found = predict(path, tmp_path / "out", weights=weights, rig=rig, frame=None)
    measured = np.load(tmp_path / "out/measured.npy")
    assert not measured[20:28, 40:50].any()
    assert measured.sum() == measured.size - 4 * 20
    assert found["filled"] > 0
    mean, _ = taken(burst, None, TofInfo("", "", SMALL, np.zeros(3)), np.zeros(4))
    others = np.ones(burst.shape[1:], bool)
    others[2, 10:14, 20:25] = False
    np.testing.assert_array_equal(mean[others], burst.mean(axis=0)[others])
    assert (mean[~others] == 4095).all()


@pytest.mark.parametrize("kind", ["su2018", "guo2018", "coarse-fine"])
def test_a_network_without_expected_error_writes_none(kind, weights, rig, tmp_path, capsys):
    """No error.npy, not even an earlier one, no property in the PLY, null in JSON, and the reason in words."""
    config = Config(
        network=Network(kind=kind, width=4 if kind == "su2018" else 64), stages=(Stage("depth", 1),)
    )
    published = save_network(tmp_path / kind, config)
    path, out = saved(tmp_path / "raw.npy", burst_of(SMALL, 1)[0]), tmp_path / "out"
    predict(path, out, weights=weights, rig=rig)
    assert (out / "error.npy").exists()
    words = ["predict", str(path), "--rig", str(rig), "--weights", str(published), "--out", str(out)]
    assert main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["median_expected_error"] is None
    assert "error.npy" not in answer["files"]
    assert not (out / "error.npy").exists()
    header, body = (out / "cloud.ply").read_bytes().split(b"end_header\n")
    assert b"expected_error" not in header
    assert len(body) == 4 * 36 * 48 * 6 * 4
    assert main(words) == 0
    assert f"no expected error: {kind} predicts none" in capsys.readouterr().out


def test_npz_and_capitals_are_read(rig, tmp_path):
    """One array, or the one that is called raw; by its content, whatever it is called."""
    raw = burst_of(SMALL, 1)[0]
    np.savez(tmp_path / "one.npz", anything=raw)
    np.savez_compressed(tmp_path / "named.npz", other=np.zeros(3), raw=raw)
    np.savez(tmp_path / "other.npz", taps=raw, depth=raw[0], K=np.eye(3))
    (tmp_path / "zip.npy").write_bytes((tmp_path / "one.npz").read_bytes())
    saved(tmp_path / "x.npy", raw).rename(tmp_path / "RAW.NPY")
    for name in ("one.npz", "named.npz", "other.npz", "zip.npy", "RAW.NPY"):
        np.testing.assert_array_equal(read_input(tmp_path / name, rig=rig).raw[0], raw)


def _cut(path, raw):
    np.savez(path, raw=raw)
    path.write_bytes(path.read_bytes()[:5000])


DAMAGED = {
    "scalar.npy": (lambda p, raw: np.save(p, np.float32(3)), "expected numbers of shape"),
    "two.npz": (
        lambda p, raw: np.savez(p, a=raw, b=raw),
        "expected one array, or one that is called raw, got a, b",
    ),
    "others.h5": (
        lambda p, raw: h5py.File(p, "w").create_dataset("raw", data=raw).file.close(),
        "HDF5 of another program",
    ),
    "none.npz": (lambda p, raw: np.savez(p), "got none"),
    "cut.npz": (_cut, "cannot read the array"),
}


@pytest.mark.parametrize("name", sorted(DAMAGED))
def test_files_without_the_array_are_data_errors(name, tmp_path, capsys):
    """Named with what was found, exit code 5."""
    make, words = DAMAGED[name]
    make(tmp_path / name, burst_of(SMALL, 1)[0])
    assert main(["predict", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 5
    assert words in capsys.readouterr().err


def test_out_that_is_a_file_is_refused_before_anything_is_computed(weights, rig, tmp_path, capsys):
    """Exit code 3, also for a folder within a file; the file stays."""
    path = saved(tmp_path / "raw.npy", burst_of(SMALL, 1)[0])
    file = tmp_path / "file"
    file.write_text("mine")
    for out in (file, file / "below"):
        words = ["predict", str(path), "--rig", str(rig), "--weights", str(weights), "--out", str(out)]
        assert main(words) == 3
        assert "expected a folder" in capsys.readouterr().err
    assert file.read_text() == "mine"


def test_a_lens_is_brought_by_the_rig(weights, tmp_path):
    """The rays of the rig's lens are those of the answer: a wall is flat through it."""
    lens = replace(SMALL, distortion=(-0.1, 0.02, 0.0, 0.0, 0.0))
    path = tmp_path / "rig.toml"
    path.write_text(dumps_rig(Rig(lens, Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))))
    raw = saved(tmp_path / "raw.npy", wall(lens))
    predict(raw, tmp_path / "out", weights=weights, rig=path)
    depth, normals = (np.load(tmp_path / "out" / f"{name}.npy") for name in ("depth", "normals"))
    np.testing.assert_allclose(depth, 0.8, atol=5e-4)  # whole counts
    assert np.degrees(np.arccos(-normals[..., 2].clip(-1, 1))).max() < 0.1


def test_a_predictor_loads_once_and_times_nothing(weights, monkeypatch):
    """Frame after frame the answers are those of predict_raw, in arrays of their own; tables are built once a camera."""
    loads, builds = [], []
    real_load, real_decoder = predicting.load_checkpoint, predicting.frame_decoder
    monkeypatch.setattr(predicting, "load_checkpoint", lambda w: loads.append(w) or real_load(w))
    monkeypatch.setattr(predicting, "frame_decoder", lambda *a: builds.append(a) or real_decoder(*a))
    burst, info = burst_of(SMALL, 3), TofInfo("t", "", SMALL, np.zeros(3))
    predictor = Predictor(weights)
    found = [predictor(raw, info) for raw in burst]
    assert (len(loads), len(builds)) == (1, 1)
    assert np.isnan([found[0].inference_ms, found[0].decode_ms]).all()
    data = RawInput(burst, np.full(3, np.nan), info, SMALL)
    for k, one in enumerate(found):
        other = predict_raw(data, k, weights)
        for name in ("depth", "normals", "error", "measured"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    second = replace(SMALL, width=40, cx=19.5)
    assert predictor(burst[0, :, :, :40], replace(info, camera=second)).depth.shape == (72, 80)
    with pytest.raises(DataError, match=r"raw frame: expected pixels that measure"):
        predictor(np.zeros_like(burst[0]), info)


def test_a_prediction_asks_the_network_once(weights, monkeypatch):
    """Only the command runs it again and again for its time."""
    calls = []
    real = predicting.make_frame
    monkeypatch.setattr(predicting, "make_frame", lambda *a: calls.append(a) or real(*a))
    monkeypatch.setattr(predicting, "RUNS", 4)
    data = RawInput(burst_of(SMALL, 1), np.full(1, np.nan), TofInfo("t", "", SMALL, np.zeros(3)), SMALL)
    predict_raw(data, 0, weights)
    assert len(calls) == 1
    assert predict_raw(data, 0, weights, timed=True).inference_ms > 0
    assert len(calls) == 5


def test_bundled_is_a_name_where_a_path_is_asked_for(weights, tmp_path, monkeypatch):
    """Unless a file or a folder of that name lies here."""
    monkeypatch.setattr(checkpoint, "files", lambda _: weights.parents[1])
    monkeypatch.chdir(tmp_path)
    assert find_model(Path("bundled")) == find_model(None) == weights
    assert load_checkpoint(Path("bundled"))[1] == load_checkpoint(weights)[1]
    (tmp_path / "bundled").mkdir()
    assert find_model(Path("bundled")) == Path("bundled/model.safetensors")


def test_the_lines_of_the_page_answer_frame_after_frame(weights, tmp_path, monkeypatch, capsys):
    """The example of "bring your own camera", on a burst of two frames."""
    page = (ROOT / "docs/howto/own-camera.md").read_text()
    code = next(c for c in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "load_model" in c)
    monkeypatch.setattr(checkpoint, "files", lambda _: weights.parents[1])
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "frames.npy", burst_of(NOMINAL_CAMERA, 2))
    exec(compile(code, "own-camera.md", "exec"), {})  # noqa: S102
    assert capsys.readouterr().out.count("measured 100%") == 2


def test_a_gpus_predictor_records_once_for_each_camera(weights, monkeypatch):
    """What it does there, on the processor: decoding and cues are part of what is recorded, and the answers are the same."""
    shapes = []
    info = TofInfo("t", "", SMALL, np.array([0.007, 0.0, 0.0]), range_errors=NOMINAL_RANGE_ERRORS)
    second = replace(info, camera=replace(SMALL, width=40, cx=19.5))
    burst = burst_of(SMALL, 2)
    burst[1, :, 10:20, 10:20] = 4095
    here = [Predictor(weights)(raw, info, celsius=30.0) for raw in burst]
    monkeypatch.setattr(predicting, "recorded", lambda ask, like: shapes.append(tuple(like.raw.shape)) or ask)
    monkeypatch.setattr(Predictor, "_on_gpu", True)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    there = Predictor(weights)
    for raw, expected in zip(burst, here, strict=True):
        found = there(raw, info, celsius=30.0)
        np.testing.assert_array_equal(found.measured, expected.measured)
        np.testing.assert_allclose(
            found.depth[expected.measured], expected.depth[expected.measured], atol=2e-4
        )
        turned = (found.normals * expected.normals).sum(-1)[expected.measured]
        assert (turned > 0.99).mean() > 0.98  # holes take another of several nearest pixels
    there(burst[0, :, :, :40], second)
    there(burst[1], replace(info))
    assert shapes == [(8, 36, 48), (8, 36, 40)]
    with pytest.raises(DataError, match="expected pixels that measure"):
        there(np.zeros_like(burst[0, :, :, :40]), second)
