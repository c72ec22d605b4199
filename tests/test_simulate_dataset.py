"""simulate-dataset: one command from nothing to a whole dataset, the same bytes however often it is interrupted."""

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from tests import until
from tests.test_sim_world import SMALL
from tofcapture.channels import frequencies
from tofcapture.cli import main
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.draw import draw_camera
from tofcapture.errors import ConfigError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.shard import ShardReader
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import Decoder
from tofcapture.suites import capture
from tofcapture.suites.make import DatasetSpec, make_one
from tofcapture.suites.run import simulate_dataset

STEREO = {"width": 160, "height": 128, "fx": 144.4, "fy": 144.4, "cx": 79.5, "cy": 63.5}
SIM = {**SMALL, "stereo": STEREO}
STATION = "\n".join(
    [
        *(f'[{role}]\ndriver = "sim"' for role in ("tof", "stereo", "operator")),
        '[arm]\ndriver = "sim"\nmodel = "ur10e"\n[sim]\nseed = 0',
        *(f"[sim.{name}]\n" + "\n".join(f"{k} = {v}" for k, v in t.items()) for name, t in SIM.items()),
    ]
)


def spec(suite="multipath", scenes=2, frames=2):
    return DatasetSpec(suite, 0, scenes, views=2, frames=frames, sim=SIM)


def shards(out):
    return {name: entry.sha256 for name, entry in load_manifest(out).scenes.items()}


@pytest.fixture(scope="module")
def station(tmp_path_factory):
    path = tmp_path_factory.mktemp("station") / "station.toml"
    path.write_text(STATION)
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run of two multipath scenes."""
    out, told = tmp_path_factory.mktemp("whole") / "data", []
    simulate_dataset(spec(), out, jobs=1, progress=lambda *views: told.append(views))
    assert told == [(0, 4), (2, 4), (4, 4)]  # views that are done, of all
    return out


def test_four_scenes_in_one_command(tmp_path, station, capsys):
    """Shards, manifest, card; check finds nothing; time and disk of a hundred scenes are stated; again does nothing."""
    out = tmp_path / "data"
    line = ["simulate-dataset", "--scenes", "4", "--views", "2", "--frames", "2", "--jobs", "1"]
    line += ["--out", str(out), "--station", str(station), "--json"]
    assert main(line) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["scenes"], answer["views"]) == (4, 8)
    assert answer["extrapolated"]["scenes"] == 100
    assert answer["extrapolated"]["hours"] > 0
    assert {"light", "stereo", "tof", "truth", "write", "build"} <= answer["cpu_seconds_per_view"].keys()
    assert set(answer["splits"].values()) == {"train", "test"}
    assert answer["gt"]["coverage"] > 0
    assert (out / "README.md").is_file()
    assert not list((out / "simulation").glob("*.work"))
    assert main(["check", str(out)]) == 0
    before = shards(out)
    capsys.readouterr()
    assert main(line) == 0
    assert len(json.loads(capsys.readouterr().out)["kept"]) == 4
    assert shards(out) == before


def test_shards_tell_where_they_came_from(whole):
    """The note beside the shards holds recipe, objects and facts; the shard has truth and the wanted views."""
    for name in shards(whole):
        note = json.loads((whole / "simulation" / f"{name}.json").read_text())
        assert note["objects"] == [name]
        assert {"kind", "angle_deg", "albedo"} <= note["facts"].keys()
        with ShardReader(whole / "shards" / f"{name}.h5") as shard:
            assert (shard.views, shard.frames) == (2, 2)
            assert shard.truth(0) is not None


def test_scenes_take_turns_with_cameras(tmp_path):
    """Two cameras drawn whole, scene by scene; one split for all if wanted."""
    two = replace(spec(scenes=3), cameras=2, views=1)
    simulate_dataset(two, tmp_path / "data", jobs=1, split="test")
    manifest = load_manifest(tmp_path / "data")
    assert {e.split for e in manifest.scenes.values()} == {"test"}
    serials, offsets = [], []
    for index in range(3):
        entry = manifest.scenes[two.scene(index).name]
        with ShardReader(tmp_path / "data" / entry.path) as shard:
            serials.append(shard.info.serial)
            offsets.append(shard.info.range_errors[0].offset)
    assert serials[0] == serials[2] != serials[1]
    assert offsets[0] == offsets[2] != offsets[1]


def test_drawn_cameras_are_as_different_as_cameras_are():
    """One to three frequencies, three phases and four, signed taps, wide and narrow, bright and dark: each one decodes what it sees."""
    drawn = [draw_camera(np.random.default_rng(seed)) for seed in range(60)]
    constants = [read_constants(tables, f"camera {k}") for k, tables in enumerate(drawn)]
    counts = {len(frequencies(c.sensor.modulation_hz)) for c in constants}
    assert counts == {1, 2, 3}
    assert {c.sensor.offset for c in constants} == {True, False}
    fields = [np.degrees(2 * np.arctan(c.tof.width / 2 / c.tof.fx)) for c in constants]
    assert min(fields) < 50
    assert max(fields) > 85
    white = [c.sensor.signal[-1] * c.sensor.contrast[-1] / c.sensor.full_scale for c in constants]
    assert max(white) > 10 * min(white)
    for c in constants[:8]:
        s = c.sensor
        Decoder(
            TofInfo(
                "drawn", "1", c.tof, c.illuminator, s.modulation_hz, s.phase_rad,
                offset=s.offset, range_errors=s.range_errors, saturation=s.full_scale,
            )
        )  # fmt: skip


def test_a_drawn_camera_of_a_make_has_its_channels_and_its_image():
    """What differs between two cameras of one make does; what the maker says does not."""
    made = [
        read_constants(draw_camera(np.random.default_rng(seed), "real3-60-80"), "drawn") for seed in (1, 2)
    ]
    maker = read_constants({"tof": {"preset": "real3-60-80"}}, "preset")
    for one in made:
        assert one.sensor.modulation_hz == maker.sensor.modulation_hz
        assert one.tof == maker.tof
    assert made[0].sensor.contrast != made[1].sensor.contrast
    assert made[0].sensor.range_errors != made[1].sensor.range_errors


def test_interrupted_in_the_middle_of_a_scene(tmp_path, whole, monkeypatch):
    """Stopped at the second view, the next run takes the missing view only and ends with the same bytes."""
    out, written, write = tmp_path / "data", [], capture.write_view

    def stop(path, view):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(path)
        return write(path, view)

    monkeypatch.setattr(capture, "write_view", stop)
    with pytest.raises(KeyboardInterrupt):
        simulate_dataset(spec(), out, jobs=1)
    monkeypatch.setattr(capture, "write_view", write)
    result = simulate_dataset(spec(), out, jobs=1)
    assert result.made[0].cpu["views"] == 1
    assert shards(out) == shards(whole)


def test_a_damaged_or_missing_shard_is_made_again(tmp_path, whole):
    """Only that scene is simulated again, with the same bytes; other options or fewer scenes are refused."""
    out = tmp_path / "data"
    simulate_dataset(spec(), out, jobs=1)
    first, second = sorted(shards(out))
    (out / "shards" / f"{first}.h5").unlink()
    result = simulate_dataset(spec(), out, jobs=1)
    assert [m.scene for m in result.made] == [first]
    assert [m.scene for m in result.kept] == [second]
    assert shards(out) == shards(whole)
    with pytest.raises(ConfigError, match="other options"):
        simulate_dataset(spec(frames=3), out, jobs=1)
    with pytest.raises(ConfigError, match="not wanted"):
        simulate_dataset(spec(scenes=1), out, jobs=1)


def test_views_of_another_recipe_are_not_mixed_in(tmp_path, whole):
    """Views left by a run with other options go before the scene is taken."""
    out = tmp_path / "data"
    other = DatasetSpec("multipath", 0, 2, views=2, frames=1, sim=SIM)
    name = other.scene(0).name
    (out / "simulation" / f"{name}.work").mkdir(parents=True)
    (out / "simulation" / f"{name}.work" / "task").write_text(other.task(0))
    left = out / "simulation" / f"{name}.work" / "recording" / "views" / name / "view-000.h5"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"of another spec")
    assert make_one(spec(), out, 0).sha256 == shards(whole)[name]


@pytest.mark.parametrize(("change", "message"), [({"scenes": 0}, "scenes"), ({"suite": "tof1"}, "suite")])
def test_wrong_specs_are_refused(tmp_path, change, message):
    """Nothing wanted, or a suite that does not exist."""
    with pytest.raises(ConfigError, match=message):
        simulate_dataset(spec(**change), tmp_path / "data", jobs=1)


def test_a_recording_is_not_overwritten(tmp_path):
    """A folder that holds a recording is not taken for a dataset."""
    (tmp_path / "views").mkdir()
    with pytest.raises(ConfigError, match="recording"):
        simulate_dataset(spec(), tmp_path, jobs=1)


@pytest.mark.slow
def test_processes_and_sigkill_give_the_same_bytes(tmp_path, station, whole):
    """Two processes, killed after the first views with all their children, then run again: the same shards."""
    out = tmp_path / "data"
    line = [sys.executable, "-m", "tofcapture", "simulate-dataset", "--suite", "multipath", "--scenes", "2"]
    line += ["--views", "2", "--frames", "2", "--jobs", "2", "--out", str(out), "--station", str(station)]
    run = subprocess.Popen(line, start_new_session=True, stderr=subprocess.DEVNULL)
    until(lambda: list(out.glob("simulation/*.work/recording/views/*/view-*.h5")))
    os.killpg(run.pid, signal.SIGKILL)
    run.wait()
    subprocess.run(line, check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    assert shards(out) == shards(whole)
