"""A camera of other size, frequencies and phases: what reads it, and that fine-tuning to it helps."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tests.stations import HALF_SIZE_STEREO
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.devices.station import DEFAULT
from tofcapture.errors import ConfigError
from tofcapture.files.manifest import load_manifest, write_manifest
from tofcapture.files.shard import ShardReader
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import taps
from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.config import Config, Network, Stage, preset
from tofcapture_model.data import batched, make_frame
from tofcapture_model.evaluation.evaluate import evaluate
from tofcapture_model.frame import eight_taps
from tofcapture_model.networks import build_model
from tofcapture_model.networks.checkpoint import find_model
from tofcapture_model.training.train import train

HZ = (15e6,) * 3 + (75e6,) * 3
PHASES = tuple(2 * np.pi * k / 3 for k in range(3)) * 2
SECOND = (Path(__file__).parents[1] / "examples" / "second_sensor.toml").read_text()


def wall(distance=0.9):
    """A frame of a wall at one range from the camera, by three phases at 15 and at 75 MHz."""
    camera = Camera(160, 120, 132.0, 132.0, 79.3, 60.2)
    info = TofInfo("second", "0", camera, np.zeros(3), HZ, PHASES)
    turns = 4 * np.pi * distance / SPEED_OF_LIGHT * np.array([15e6, 75e6])
    phasor = np.broadcast_to(500 * np.exp(1j * turns)[:, None, None], (2, *camera.shape))
    raw = np.rint(taps(phasor, np.full(phasor.shape, 800.0), HZ, PHASES)).astype(np.uint16)
    return make_frame(raw, info, camera), distance / camera.ray_lengths


def small(kind, **network):
    """An untrained network."""
    stage = "depth" if kind == "guo2018" else "joint"
    config = Config(network=Network(kind=kind, width=4, levels=2, **network), stages=(Stage(stage, 1),))
    return build_model(config).eval()


def test_six_channels_are_decoded_and_read_by_compact():
    """The frame has the wall's depth; compact, which reads phasors, answers at twice the size."""
    frame, depth = wall()
    assert frame.raw.shape[0] == 6
    np.testing.assert_allclose(frame.depth[0], depth, atol=2e-3)
    with torch.no_grad():
        found = small("compact", refine_iterations=0)(batched(frame))
    assert found.depth.shape == (1, 1, 240, 320)
    assert torch.isfinite(found.depth).all()


@pytest.mark.parametrize("kind", ["paper", "guo2018"])
def test_networks_of_eight_raw_channels_read_six(kind):
    """They get the eight that the camera's phasors would have made, and answer at twice the size."""
    frame = batched(wall()[0])
    raw, demodulation = eight_taps(frame)
    assert raw.shape[1] == 8
    torch.testing.assert_close(
        torch.einsum("bpc,bchw->bphw", demodulation, raw), frame.phasor, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(raw[:, :4].mean(1), frame.raw.mean(1))
    with torch.no_grad():
        assert small(kind)(frame).depth.shape[-1] == 320


def test_eight_taps_are_those_of_the_papers_camera():
    """Phases a quarter apart, the lowest frequency first: what its sensor gives is what its phasors make."""
    depth = 0.7
    camera = Camera(40, 30, 33.0, 33.0, 19.5, 14.5)
    info = TofInfo("paper", "0", camera, np.zeros(3))
    turns = 4 * np.pi * depth / SPEED_OF_LIGHT * np.array([20e6, 100e6])
    phasor = np.broadcast_to(500 * np.exp(1j * turns)[:, None, None], (2, *camera.shape))
    raw = taps(phasor, np.full(phasor.shape, 800.0), info.modulation_hz, info.phase_rad)
    frame = batched(make_frame(raw, info, camera))
    assert eight_taps(frame)[0] is frame.raw
    made, told = eight_taps(frame._replace(raw=frame.raw.mean(1, keepdim=True)))
    torch.testing.assert_close(made, frame.raw, atol=1e-6, rtol=0)
    torch.testing.assert_close(told, frame.demodulation[:, :4], atol=1e-6, rtol=0)


def stand_in(folder):
    """The bundled weights, or where there are none a network of the same size that has seen other scenes by another camera."""
    try:
        return find_model(None)
    except ConfigError:
        config = preset("fine-tune")
        quick = replace(config.training, crop=(80, 96), validate_every=0)
        data = make_dataset(folder / "first", scale=2, views=4, splits=("train", "train"))
        return train(
            replace(config, training=quick, stages=(Stage("joint", 15, 2e-3),)), data, folder / "run"
        ).path


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_fine_tuning_to_a_second_sensor_beats_the_weights_it_started_from(tmp_path):
    """Four scenes of another camera, one of them held out: depth and normals of that one are better after a few minutes."""
    (tmp_path / "station.toml").write_text(DEFAULT.read_text() + SECOND + HALF_SIZE_STEREO)
    dataset = tmp_path / "dataset"
    simulate = [
        "simulate-dataset",
        "--scenes",
        "4",
        "--views",
        "5",
        "--frames",
        "2",
        "--jobs",
        "1",
        "--seed",
        "3",
    ]
    kinds = ["--kinds", "object", "combination", "concave", "combination"]
    assert main([*simulate, *kinds, "--station", str(tmp_path / "station.toml"), "--out", str(dataset)]) == 0
    manifest = load_manifest(dataset)
    held_out = max(manifest.scenes)
    scenes = {
        name: replace(entry, split="test" if name == held_out else "train")
        for name, entry in manifest.scenes.items()
    }
    write_manifest(dataset, replace(manifest, scenes=scenes))
    with ShardReader(dataset / scenes[held_out].path) as shard:
        assert shard.raw(0, 0).shape == (6, 120, 160)
        assert shard.info.modulation_hz == HZ
    weights = stand_in(tmp_path)
    command = [
        "train",
        str(dataset),
        "--out",
        str(tmp_path / "tuned"),
        "--from",
        str(weights),
        "--epochs",
        "15",
    ]
    assert main(command) == 0
    before, after = (
        evaluate(dataset, path, tmp_path / "results.json")["methods"]["model"]
        for path in (weights, tmp_path / "tuned")
    )
    assert after["depth"]["pixel"]["mae"] < before["depth"]["pixel"]["mae"]
    assert after["depth"]["pixel"]["median"] < before["depth"]["pixel"]["median"]
