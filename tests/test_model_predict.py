"""Predicting: what it starts from, the bundled weights, half precision, and answers to arrays that cannot be right."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import tofcapture_model
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.cli.setup import bundled_path
from tofcapture.errors import ConfigError, DataError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.ops.phase import taps
from tofcapture.rig import SPEED_OF_LIGHT, Rig, dumps_rig
from tofcapture_model.config import preset
from tofcapture_model.data import batched, frame_decoder, make_frame, with_cues
from tofcapture_model.data.raw_input import NOMINAL_CAMERA, NOMINAL_RANGE_ERRORS, read_input
from tofcapture_model.frame import frame_to
from tofcapture_model.geometry.decoder import TorchDecoder
from tofcapture_model.inference import predict as predicting
from tofcapture_model.inference.predict import predict, predict_raw, recorded
from tofcapture_model.networks import build_model, checkpoint
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint, save_model

ORDER = ("right", "blocks swapped", "interleaved", "reversed", "low reversed", "pairs")
CHANNELS = (
    (0, 1, 2, 3, 4, 5, 6, 7),
    (4, 5, 6, 7, 0, 1, 2, 3),
    (0, 4, 1, 5, 2, 6, 3, 7),
    (0, 3, 2, 1, 4, 7, 6, 5),
    (0, 3, 2, 1, 4, 5, 6, 7),
    (0, 2, 1, 3, 4, 6, 5, 7),
)


def table_top(camera, seed=0, shift=0.0):
    """(8, H, W) uint16 counts of a slanted table with a block on it, ranges at 100 MHz off by ``shift``; and its depth."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[-1 : 1 : camera.height * 1j, -1 : 1 : camera.width * 1j]
    depth = 0.7 + 0.15 * v - 0.12 * ((np.abs(u) < 0.4) & (np.abs(v) < 0.3))
    radial = depth * camera.ray_lengths
    strength = 400 * (0.4 + 0.2 * np.sign(np.sin(9 * u))) / radial**2
    hz = (20e6, 100e6)
    ranges = (radial, radial + shift)
    phasor = np.stack(
        [strength * np.exp(4j * np.pi * f * r / SPEED_OF_LIGHT) for f, r in zip(hz, ranges, strict=True)]
    )
    clean = taps(phasor, 1.3 * np.abs(phasor) + 60, PAPER_MODULATION_HZ, PAPER_PHASE_RAD)
    return np.clip(np.rint(rng.normal(clean, 5)), 0, 4095).astype(np.uint16), depth


def test_without_a_rig_the_two_frequencies_say_whose_range_errors_to_take(tmp_path):
    """An array of the known sensor (0.74 m of offset at 100 MHz) is decoded with its range errors, one without errors without."""
    known = NOMINAL_RANGE_ERRORS[1].offset - NOMINAL_RANGE_ERRORS[0].offset
    for offset, words in ((0.0, "no range errors"), (known, "known sensor")):
        counts, depth = table_top(NOMINAL_CAMERA, shift=offset)
        data = read_input(saved(tmp_path / "raw.npy", counts))
        assert words in data.assumed
        frame = make_frame(counts, data.info, data.camera)
        assert np.median(np.abs(frame.depth[0].numpy() - depth)) < 0.03


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """An untrained small network in half precision: it answers as the sensor does."""
    config = replace(preset("demo"), network=replace(preset("demo").network, width=4, levels=2))
    folder = tmp_path_factory.mktemp("package") / "weights"
    torch.manual_seed(0)
    return save_model(
        folder / "model.safetensors", build_model(config), config, {"steps": 0}, precision="float16"
    )


@pytest.fixture
def bundled(weights, monkeypatch):
    """The same as if it came with the installation."""
    monkeypatch.setattr(checkpoint, "files", lambda _: weights.parents[1])
    return weights


def saved(path, array):
    np.save(path, array)
    return path


def test_half_precision_is_half_the_file_and_computes_in_single(weights, tmp_path):
    """Weights come back as float32, rounded to 11 bits; what float16 cannot hold is refused."""
    model, config, provenance = load_checkpoint(weights)
    assert provenance == {"steps": 0}
    assert {p.dtype for p in model.parameters()} == {torch.float32}
    whole = save_model(tmp_path / "model.safetensors", model, config, provenance)
    half, full = (sum(t.nbytes for t in checkpoint.read_tensors(p)[0].values()) for p in (weights, whole))
    assert full == 2 * half
    for a, b in zip(
        load_checkpoint(whole)[0].state_dict().values(), model.state_dict().values(), strict=True
    ):
        assert torch.equal(a, b)
    with torch.no_grad():
        next(model.parameters()).fill_(1e5)
    with pytest.raises(DataError, match="65504"):
        save_model(tmp_path / "large.safetensors", model, config, {}, precision="float16")
    assert not (tmp_path / "large.safetensors").exists()


def test_an_array_and_nothing_else_is_enough(bundled, tmp_path, capsys):
    """Without --weights the bundled network answers; an untrained one gives the sensor's depth; the mean of a burst is quieter."""
    burst = np.stack([table_top(NOMINAL_CAMERA, seed)[0] for seed in range(4)])
    depth = np.kron(table_top(NOMINAL_CAMERA)[1], np.ones((2, 2)))
    path, errors = saved(tmp_path / "raw.npy", burst), []
    for flag in (["--benchmark"], ["--average"]):
        assert main(["predict", str(path), "--out", str(tmp_path / "out"), *flag, "--json"]) == 0
        answer = json.loads(capsys.readouterr().out)
        assert answer["weights"] == str(bundled)
        assert answer["shape"] == [360, 480]
        times = answer["inference_ms"], answer["decode_ms"]
        assert min(times) > 0 if flag == ["--benchmark"] else times == (None, None)
        errors.append(np.abs(np.load(tmp_path / "out/depth.npy") - depth).mean())
    assert errors[1] < errors[0] < 0.01
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {
        "cloud.ply",
        "depth.png",
        "normals.png",
        "picture.png",
        "sensor.npy",
    }


def test_no_bundled_weights_is_an_error_that_names_the_option(tmp_path, monkeypatch):
    """An installation without weights says what to do."""
    monkeypatch.setattr(checkpoint, "files", lambda _: tmp_path)
    with pytest.raises(ConfigError, match="no weights are bundled") as error:
        find_model(None)
    assert "--weights" in error.value.hint


@pytest.mark.parametrize("size", [(67, 51), (160, 120)])
def test_a_camera_of_another_size_is_named_by_its_rig(size, weights, tmp_path):
    """Odd sizes too: the answer is twice as large and lies on the rig's rays; without the rig the shape is refused."""
    width, height = size
    camera = Camera(width, height, width * 0.8, width * 0.8, (width - 1) / 2, (height - 1) / 2)
    raw, depth = table_top(camera)
    path = saved(tmp_path / "raw.npy", raw)
    with pytest.raises(DataError, match="expected numbers of shape") as error:
        predict(path, tmp_path / "out", weights=weights)
    assert "--rig" in error.value.hint
    rig = tmp_path / "rig.toml"
    rig.write_text(dumps_rig(Rig(camera, Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))))
    result = predict(path, tmp_path / "out", weights=weights, rig=rig)
    assert result["shape"] == [2 * height, 2 * width]
    found = np.load(tmp_path / "out/depth.npy")
    assert np.median(np.abs(found - np.kron(depth, np.ones((2, 2))))) < 0.01


def test_tables_are_built_before_the_clock_starts(weights, tmp_path, monkeypatch):
    """No frame is decoded with tables of its own: what is timed is what a running camera pays."""
    real, given = predicting.make_frame, []

    def watched(raw, info, camera, celsius, decoder):
        given.append(decoder)
        return real(raw, info, camera, celsius, decoder)

    monkeypatch.setattr(predicting, "make_frame", watched)
    data = read_input(saved(tmp_path / "raw.npy", table_top(NOMINAL_CAMERA)[0]))
    predict_raw(data, 0, weights, timed=True)
    assert len(given) == predicting.WARM + predicting.RUNS
    assert len({id(d) for d in given}) == 1


@pytest.mark.parametrize("order", range(len(ORDER)), ids=ORDER)
def test_channels_in_another_order_are_refused(order, tmp_path):
    """Wrong orders are told from right ones by physics alone, and the message says which command finds the right one."""
    path = saved(tmp_path / "raw.npy", table_top(NOMINAL_CAMERA)[0][list(CHANNELS[order])])
    if order == 0:
        assert read_input(path).raw.shape == (1, 8, 180, 240)
        return
    with pytest.raises(DataError, match="expected channels: 20 MHz at 0, 90, 180, 270 deg") as error:
        read_input(path)
    assert "calibrate phase-order" in error.value.hint
    assert "--frame" not in error.value.hint  # there is but one


NOT_COUNTS = {
    "scaled to 1": (lambda raw: raw / 4095, "values up to 0", "multiply"),
    "16 bits": (lambda raw: raw * 60.0, "saturates at 4095, got values up to", "--saturation"),
    "8 bits": (lambda raw: (raw / 16).astype(np.uint8), "uint8", "uint16"),
    "not finite": (lambda raw: np.where(raw > 300, np.nan, raw), "finite", ""),
    "no light": (lambda raw: np.full_like(raw, 70), "no modulated light", ""),
    "channels last": (lambda raw: np.moveaxis(raw, 0, -1), "expected numbers of shape", "moveaxis"),
    "transposed": (lambda raw: raw.swapaxes(1, 2), "expected numbers of shape", "swapaxes"),
    "no frames": (lambda raw: raw[None][:0], "expected numbers of shape", ""),
    "text": (lambda raw: raw.astype(str), "expected numbers of shape", ""),
}


@pytest.mark.parametrize("case", sorted(NOT_COUNTS))
def test_arrays_that_are_no_counts_are_refused(case, tmp_path):
    """Wrong units and layouts are named with what would put them right."""
    change, words, hint = NOT_COUNTS[case]
    path = saved(tmp_path / "raw.npy", change(table_top(NOMINAL_CAMERA)[0]))
    with pytest.raises(DataError, match=words) as error:
        read_input(path)
    assert hint in error.value.hint


def test_files_of_another_kind_are_refused(tmp_path):
    """Folders, other formats, and a rig for a file that carries its own."""
    (tmp_path / "raw.txt").write_text("1 2 3")
    for path, words in ((tmp_path, "a folder"), (tmp_path / "raw.txt", "cannot read the file")):
        with pytest.raises(DataError, match=words) as error:
            read_input(path)
        assert ".npy" in error.value.hint
    (tmp_path / "view.h5").touch()
    with pytest.raises(ConfigError, match=r"--rig .*expected an array"):
        read_input(tmp_path / "view.h5", rig=tmp_path / "rig.toml")


@pytest.mark.skipif(bundled_path() is None, reason="no weights are bundled in this tree")
def test_what_is_bundled_loads_and_answers(tmp_path):
    """The file in the package fits the code: finite depth, unit normals, positive errors, whatever their values."""
    path = saved(tmp_path / "raw.npy", table_top(NOMINAL_CAMERA)[0])
    predict(path, tmp_path / "out")
    depth, normals, error = (np.load(tmp_path / f"out/{n}.npy") for n in ("depth", "normals", "error"))
    assert np.isfinite(depth).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-4)
    assert (error > 0).all()
    assert find_model(None) == bundled_path()
    assert (find_model(None).parent / "MODEL_CARD.md").is_file()


@pytest.mark.skipif(bundled_path() is None, reason="no weights are bundled in this tree")
def test_half_the_mantissa_changes_less_than_noise_does(tmp_path, monkeypatch):
    """Trained in bfloat16 it answers in bfloat16 where the processor has it: tenths of its own sigma, never NaN, float32 out."""
    data = read_input(saved(tmp_path / "raw.npy", table_top(NOMINAL_CAMERA)[0]))
    monkeypatch.setattr(predicting, "WARM", 0)
    monkeypatch.setattr(predicting, "RUNS", 1)
    answers = []
    for able in (False, True):
        monkeypatch.setattr(predicting, "has_bfloat16", lambda _kind, able=able: able)
        answers.append(predict_raw(data, 0, None))
    single, half = answers
    assert half.depth.dtype == half.normals.dtype == half.error.dtype == np.float32
    moved = np.abs(half.depth - single.depth)
    assert 0 < moved.mean() < 0.1 * single.error.mean()
    turned = np.degrees(np.arccos(np.clip((half.normals * single.normals).sum(-1), -1, 1)))
    assert turned.mean() < 0.5
    np.testing.assert_allclose(np.median(half.error / single.error), 1, atol=0.02)


def test_a_folder_of_arrays_is_predicted_one_by_one(weights, tmp_path, capsys):
    """Each has a folder of its own; one that cannot be read is named and stops no other; the network is loaded once."""
    for k in range(2):
        saved(tmp_path / f"frame-{k}.npy", table_top(NOMINAL_CAMERA, k)[0])
    np.savez(tmp_path / "other.npz", raw=table_top(NOMINAL_CAMERA, 2)[0])
    (tmp_path / "notes.txt").write_text("of no use here")
    line = ["predict", str(tmp_path), "--weights", str(weights), "--out", str(tmp_path / "out")]
    assert main(line) == 0
    said = capsys.readouterr()
    assert "3 predictions" in said.out
    assert said.err.count("\n") <= 2
    alone = predict(tmp_path / "frame-1.npy", tmp_path / "alone", weights=weights)
    np.testing.assert_array_equal(
        np.load(tmp_path / "out/frame-1/depth.npy"), np.load(alone["files"]["depth.npy"])
    )
    saved(tmp_path / "frame-1.npy", np.zeros((3, 4)))
    assert main([*line, "--json"]) == 5
    answer = json.loads(capsys.readouterr().out)
    assert answer["predictions"].keys() == {"frame-0", "other"}
    assert "expected numbers of shape" in answer["failed"]["frame-1"]["message"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="expected views, shards or arrays, found none"):
        predict(tmp_path / "empty", tmp_path / "out", weights=weights)


def test_a_network_is_called_with_arrays_and_paths(weights, tmp_path):
    """``load_model`` is all that one needs; each form gives the same answer, with the sensor's own depth beside it."""
    raw, depth = table_top(NOMINAL_CAMERA)
    model = tofcapture_model.load_model(weights)
    found = [
        model(raw),
        model(raw[None]),
        model(str(saved(tmp_path / "raw.npy", raw))),
        model(raw[None], frame=None),
    ]
    for other in found[1:]:
        np.testing.assert_array_equal(other.depth, found[0].depth)
    assert found[0].sensor.shape == raw.shape[1:]
    assert np.nanmedian(np.abs(found[0].sensor - depth)) < 0.01
    assert "compact" in repr(model)
    with pytest.raises(DataError, match="expected numbers of shape"):
        model(raw[:3])


def test_what_a_network_has_not_seen_is_named(tmp_path, capsys):
    """Other frequencies, another size, another field of view, a darker frame; nothing where all is as in training, or not known."""
    raw, _ = table_top(NOMINAL_CAMERA)
    config = replace(preset("demo"), network=replace(preset("demo").network, width=4, levels=2))
    usual = {
        "rows": [180, 180], "columns": [240, 240], "field_of_view_deg": [60.0, 70.0],
        "brightness": [0.01, 0.3], "modulation_hz": [[20e6, 100e6]],
    }  # fmt: skip
    path = saved(tmp_path / "raw.npy", raw)
    for change, word in (
        ({}, ""),
        ({"rows": [480, 480]}, "180 rows instead of 480 to 480"),
        ({"field_of_view_deg": [20.0, 30.0]}, "degrees of view instead of 20 to 30"),
        ({"brightness": [0.5, 0.9]}, "of saturation in brightness instead of 0.5 to 0.9"),
        ({"modulation_hz": [[60e6], [20e6, 80e6]]}, "20/100 MHz instead of 60 or 20/80"),
    ):
        weights = save_model(
            tmp_path / "m.safetensors", build_model(config), config, {"seen": usual | change}
        )
        assert main(["predict", str(path), "--weights", str(weights), "--out", str(tmp_path / "out")]) == 0
        said = capsys.readouterr().err
        assert (word in said) if word else "learned" not in said
    weights = save_model(tmp_path / "m.safetensors", build_model(config), config, {})
    assert tofcapture_model.load_model(weights)(raw).outside == ""


class Hosts(TorchDispatchMode):
    """Note every operation that touches a tensor of the host, or that hands a value to Python."""

    def __init__(self):
        super().__init__()
        self.seen, self.operations = [], 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        found = function(*args, **(kwargs or {}))
        tensors = [x for x in tree_leaves((args, kwargs, found)) if isinstance(x, torch.Tensor)]
        self.operations += 1
        if any(x.device.type == "cpu" for x in tensors) or "_local_scalar" in function.__name__:
            self.seen.append(str(function))
        return found


def test_a_prediction_neither_copies_from_the_host_nor_looks_at_a_value(monkeypatch):
    """What a CUDA graph may hold, from taps to depth: seen on the meta device, where a GPU's tensors would be; ``recorded`` relies on it."""
    there = torch.device("meta")
    model = build_model(preset("compact")).eval().to(there)
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no meta device
    info = TofInfo("t", "", NOMINAL_CAMERA, np.array([0.007, 0, 0]), range_errors=NOMINAL_RANGE_ERRORS)
    with torch.inference_mode():
        decoder = TorchDecoder(info, NOMINAL_CAMERA, there)
        taps = decoder.taps(np.zeros((8, 180, 240), np.uint16), 40.0)
        with Hosts() as hosts:
            found = model(with_cues(decoder(taps), (20e6, 100e6)))
    assert found.depth.shape == (1, 1, 360, 480)
    assert hosts.operations > 500
    assert hosts.seen == []


@pytest.mark.gpu
def test_a_recorded_prediction_is_the_prediction(weights, tmp_path):
    """On a GPU the graph answers for a second frame as kernels launched one by one do, and as the processor does."""
    arrays = [saved(tmp_path / f"{k}.npy", table_top(NOMINAL_CAMERA, seed=k)[0]) for k in (0, 1)]
    model, _, _ = load_checkpoint(weights)
    model = model.to("cuda")
    frames = []
    for path in arrays:
        data = read_input(path)
        decoder = frame_decoder(data.info, data.camera)
        frame = make_frame(data.raw[0], data.info, data.camera, decoder=decoder)
        frames.append(frame_to(batched(frame), torch.device("cuda")))

    def ask(frame):
        found = model(frame)
        return found.depth, found.normals, found.error

    with torch.inference_mode():
        launch = recorded(ask, frames[0])
        for frame in frames:
            for one, other in zip(launch(frame), ask(frame), strict=True):
                torch.testing.assert_close(one, other)
    on_gpu, here = (predict_raw(read_input(arrays[0]), 0, weights, device) for device in ("cuda", "cpu"))
    assert np.abs(on_gpu.depth - here.depth).mean() < 1e-3
