"""The recorder: every view once, whole or not at all, the same arrays however often it is killed."""

import json
import os
import sqlite3
from contextlib import closing

import numpy as np
import pytest

from tests import answers
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.station import Station, read_station
from tofcapture.errors import BusyError, ConfigError, DataError, DeviceError, MotionRefused
from tofcapture.files.view import open_view, view_path
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.poses import transform
from tofcapture.record import plan as plans
from tofcapture.record import recorder, resources
from tofcapture.record.journal import Journal, journal_path
from tofcapture.record.plan import object_sampling
from tofcapture.record.recorder import record
from tofcapture.record.resources import hold_file
from tofcapture.rig import Rig, dumps_rig

TOF, STEREO = Camera(8, 6, 7.0, 7.0, 3.5, 2.5), Camera(10, 8, 9.0, 9.0, 4.5, 3.5)
RIG = Rig(TOF, STEREO, transform(np.eye(3), [-0.05, 0.08, 0.0]), transform(np.eye(3), [0.0, -0.035, 0.08]))
VIEWS, FRAMES = 4, 2


class Bench:
    """Arm, cameras and operator in one: noise depends on the pose only; ``before`` is called ahead of every step."""

    simulated = True

    def __init__(self, before=lambda step: None, serial="A"):
        self.before, self.serial = before, serial
        self.joints, self.drift, self.steps = HOME.copy(), 0.0, []

    def _step(self, name):
        self.steps.append(name)
        self.before(name)

    def _rng(self, name):
        return np.random.default_rng([len(name), *np.abs(np.round(self.joints, 6) * 1e6).astype(np.int64)])

    def station(self):
        config = read_station(None)
        return Station(
            _Role(self, "arm"),
            _Role(self, "tof"),
            _Role(self, "stereo"),
            _Role(self, "operator"),
            RIG,
            config,
        )


class _Role:
    simulated = True
    by_hand = fixed = False
    can_turn = False

    def __init__(self, bench, role):
        self.bench, self.role = bench, role

    def describe(self):
        if self.role == "arm":
            return ArmInfo("ur10e", "fake")
        if self.role == "tof":
            return TofInfo("fake", self.bench.serial, TOF, np.zeros(3))
        return StereoInfo("fake", self.bench.serial, STEREO)

    def state(self):
        self.bench._step("state")
        T = forward(MODELS["ur10e"], self.bench.joints)
        T[0, 3] += self.bench.drift
        return ArmState(self.bench.joints.copy(), T, 1)

    def kinematics(self):
        return MODELS["ur10e"]

    def check_move(self, start, goal):
        pass

    def move_to(self, joints):
        self.bench._step("move")
        self.bench.joints = np.array(joints)
        return self.state()

    def stop(self):
        self.bench._step("stop")

    def capture(self, frames=None):
        self.bench._step(self.role)
        rng = self.bench._rng(self.role)
        if self.role == "tof":
            raw = rng.integers(0, 4096, (frames, 8, *TOF.shape)).astype(np.uint16)
            return TofBurst(raw, np.arange(frames), np.full(frames, 40.0), self.describe())
        return StereoFrame(rng.uniform(0.4, 1.0, (*STEREO.shape, 3)).astype(np.float32), 2, self.describe())

    def place(self, scene):
        self.bench._step(f"place {scene}")

    def truth(self):
        return None


@pytest.fixture(autouse=True)
def _few_candidates(monkeypatch):
    """Plan from few candidates: these tests are about recording."""
    sampling = object_sampling()
    few = type(sampling)(sampling.axis, directions=40, distances=(0.5, 0.8))
    monkeypatch.setattr(plans, "object_sampling", lambda: few)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Arrays of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        _few_candidates.__wrapped__(patch)
        _record(out)
    return _arrays(out)


def _record(out, bench=None, scene="mug", views=VIEWS, frames=FRAMES, **options):
    return record((bench or Bench()).station(), scene, out, views=views, frames=frames, **options)


def rows(out, scene=None):
    """What the journal says of each view."""
    with closing(Journal(out)) as journal:
        return journal.rows(scene)


def _arrays(out, scene="mug"):
    """Bytes of every array of every view."""
    found = {}
    for path in sorted((out / "views" / scene).glob("*.h5")):
        view = open_view(path)
        found[path.name] = (
            view.tof.raw.tobytes(),
            view.stereo.points.tobytes(),
            view.arm_before.joints.tobytes(),
        )
    return found


def test_records_every_view_in_order(tmp_path):
    """Each view: move, arm state, ToF before stereo, arm state; the journal, the station and the files agree."""
    bench, told = Bench(), []
    result = _record(tmp_path / "r", bench, progress=lambda done, total: told.append((done, total)))
    assert result.recorded == tuple(range(VIEWS))
    assert result.kept == result.failed == ()
    assert told == [(i, VIEWS) for i in range(VIEWS + 1)]
    assert bench.steps[0] == "place mug"
    assert "".join(s[0] for s in bench.steps[1:]).count("tss") == VIEWS
    assert (tmp_path / "r" / "station.toml").is_file()
    found = rows(tmp_path / "r", "mug")
    assert [row.state for row in found] == ["sealed"] * VIEWS
    for row in found:
        view = open_view(view_path(tmp_path / "r", "mug", row.index))
        assert (view.scene, view.index) == ("mug", row.index)
        assert view.provenance["pose"] == row.pose
        assert view.tof.raw.shape == (FRAMES, 8, 6, 8)


def test_second_run_records_nothing(tmp_path):
    """Run again, nothing moves and no file is touched."""
    _record(tmp_path)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "views").rglob("*")}
    bench = Bench()
    result = _record(tmp_path, bench)
    assert result.recorded == ()
    assert result.kept == tuple(range(VIEWS))
    assert bench.steps == []
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "views").rglob("*")} == before


def test_a_recording_can_be_extended(tmp_path):
    """Asking for more views takes only the new ones, and two scenes share a recording."""
    _record(tmp_path, views=2)
    result = _record(tmp_path, views=4)
    assert (result.kept, result.recorded) == ((0, 1), (2, 3))
    assert _record(tmp_path, scene="cup", views=2).recorded == (0, 1)


@pytest.mark.parametrize("step", range(1, 26, 3))
def test_killed_anywhere_and_run_again(tmp_path, whole, step):
    """Killed without a chance to clean up, at any step of a device, then run again: the arrays of a run never killed."""
    count = iter(range(1, 1000))

    def die(_):
        if next(count) == step:
            os._exit(9)

    child = os.fork()
    if child == 0:
        _record(tmp_path / "killed", Bench(die))
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) in {0, 9}
    result = _record(tmp_path / "killed")
    assert sorted({*result.recorded, *result.kept}) == list(range(VIEWS))
    assert _arrays(tmp_path / "killed") == whole


@pytest.mark.parametrize("where", ["write_view", "seal"])
@pytest.mark.parametrize("after", [False, True])
def test_killed_around_sealing(tmp_path, whole, monkeypatch, where, after):
    """Killed between writing the file and its row, on either side of each: the second view is there exactly once."""
    owner, name = (recorder, "write_view") if where == "write_view" else (Journal, "seal")
    real, count = getattr(owner, name), iter(range(1000))

    def dying(*args):
        fatal = next(count) == 1
        if fatal and not after:
            raise KeyboardInterrupt
        out = real(*args)
        if fatal:
            raise KeyboardInterrupt
        return out

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, dying)
        with pytest.raises(KeyboardInterrupt):
            _record(tmp_path / "killed")
    result = _record(tmp_path / "killed")
    adopted = sum("adopted" in line for line in result.repaired)
    assert adopted == ((where, after) in {("write_view", True), ("seal", False)})
    assert _arrays(tmp_path / "killed") == whole


def test_files_are_the_truth(tmp_path):
    """Without its journal a recording is adopted whole; leftovers go; lost files are taken again; damaged ones set aside."""
    _record(tmp_path)
    whole = _arrays(tmp_path)
    for path in tmp_path.glob("journal.sqlite*"):
        path.unlink()
    folder = tmp_path / "views" / "mug"
    (folder / "view-009.h5.partial").write_bytes(b"half")
    damaged = folder / "view-002.h5"
    damaged.chmod(0o644)
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    result = _record(tmp_path)
    assert sorted(
        " ".join(result.repaired).count(word) for word in ("adopted", "set aside", "never finished")
    ) == [1, 1, 3]
    assert (result.kept, result.recorded) == ((0, 1, 3), (2,))
    assert (folder / "view-002.h5.damaged").is_file()
    assert not list(folder.glob("*.partial"))
    (folder / "view-001.h5").unlink()
    result = _record(tmp_path)
    assert result.recorded == (1,)
    assert "its file is gone" in result.repaired[0]
    assert _arrays(tmp_path) == whole


def test_other_cameras_are_refused(tmp_path):
    """A recording is not continued with another camera, another number of frames, or other poses."""
    _record(tmp_path)
    with pytest.raises(ConfigError, match="serial = 'A', got 'B'"):
        _record(tmp_path, Bench(serial="B"))
    with pytest.raises(ConfigError, match="frames"):
        _record(tmp_path, frames=FRAMES + 1)
    db = sqlite3.connect(journal_path(tmp_path))
    db.execute("""UPDATE views SET pose = 'other' WHERE "index" = 2""")
    db.commit()
    db.close()
    with pytest.raises(ConfigError, match="view 2 of 'mug'"):
        _record(tmp_path)


def test_only_one_recorder(tmp_path):
    """A second recorder of the same recording is told to wait, and who holds it."""
    tmp_path.mkdir(exist_ok=True)
    with hold_file(tmp_path / ".lock", "", ""), pytest.raises(BusyError, match=str(os.getpid())):
        _record(tmp_path)
    assert _record(tmp_path).recorded == tuple(range(VIEWS))


def test_motion_during_exposure_is_retaken(tmp_path):
    """A view during which the arm moved 0.3 mm is taken again; 0.1 mm passes."""
    bench = Bench()
    drifts = iter([0.3e-3])

    def drift(step):
        if step == "move":
            bench.drift = 0.0
        if step == "stereo":
            bench.drift = next(drifts, 0.1e-3)

    bench.before = drift
    assert _record(tmp_path, bench, views=2).recorded == (0, 1)
    assert sorted(row.attempts for row in rows(tmp_path)) == [1, 2]


def test_a_view_that_never_works_is_given_up(tmp_path):
    """Three failures give one view up with its reason, the others are taken, and the next run tries it again."""
    bench = Bench()
    failures = iter(range(3))

    def fail(step):
        if step == "tof" and next(failures, None) is not None:
            raise DeviceError("the sensor is silent")

    bench.before = fail
    result = _record(tmp_path, bench)
    assert len(result.failed) == 1
    assert "the sensor is silent" in result.reasons[0]
    assert len(result.recorded) == VIEWS - 1
    with closing(Journal(tmp_path)) as journal:
        noted = {row.index: row.reason for row in journal.rows() if row.state == "failed"}
    assert noted == {result.failed[0]: "the sensor is silent"}
    assert _record(tmp_path).recorded == result.failed


def test_a_dead_device_ends_the_run(tmp_path):
    """Two views given up in a row end the run: that is no bad pose."""

    def fail(step):
        if step == "stereo":
            raise DeviceError("the camera is unplugged")

    bench = Bench(fail)
    with pytest.raises(DeviceError, match="unplugged"):
        _record(tmp_path, bench)
    assert bench.steps.count("stereo") == 6


def test_refused_motion_is_not_repeated(tmp_path):
    """A pose that the arm refuses is given up at once, the others are taken."""
    refused = iter([True])

    def refuse(step):
        if step == "move" and next(refused, False):
            raise MotionRefused("protective stop")

    bench = Bench(refuse)
    result = _record(tmp_path, bench)
    assert len(result.failed) == 1
    assert len(result.recorded) == VIEWS - 1


def test_full_disk_and_wrong_arguments_are_refused(tmp_path, monkeypatch):
    """Too little disk, no views and unsafe names are refused before anything moves."""
    bench = Bench()
    with pytest.raises(ConfigError, match="views"):
        _record(tmp_path, bench, views=0)
    with pytest.raises(ConfigError, match="frames"):
        _record(tmp_path, bench, frames=0)
    with pytest.raises(ConfigError, match="scene"):
        _record(tmp_path, bench, scene="../up")
    monkeypatch.setattr(resources.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1e6})())
    with pytest.raises(ConfigError, match="free disk"):
        _record(tmp_path, bench)
    assert bench.steps == []


def test_room_for_the_views_that_are_left_is_enough(tmp_path, monkeypatch):
    """A disk that holds the whole recording and no view more fills up while it is made, and nobody complains."""

    def usage(_):
        taken = len(list(tmp_path.glob("views/*/view-*.h5")))
        return type("Usage", (), {"free": (VIEWS - taken) * 40e6 + 0.5e9})()

    monkeypatch.setattr(resources.shutil, "disk_usage", usage)
    _record(tmp_path)
    assert len(list(tmp_path.glob("views/*/view-*.h5"))) == VIEWS


def test_foreign_journal_is_refused(tmp_path):
    """A journal that is no database is named, not overwritten."""
    journal_path(tmp_path).write_bytes(b"not a database" * 100)
    with pytest.raises(DataError, match=r"journal\.sqlite"):
        _record(tmp_path)


def _small_station(tmp_path):
    """The simulated station with small cameras and no light between surfaces."""
    file = tmp_path / "station.toml"
    text = read_station.__globals__["DEFAULT"].read_text(encoding="utf-8")
    file.write_text(
        text
        + "[sim.tof]\nwidth = 24\nheight = 18\nfx = 19.0\nfy = 20.0\ncx = 11.5\ncy = 8.5\n"
        + "[sim.stereo]\nwidth = 32\nheight = 24\nfx = 28.0\nfy = 28.0\ncx = 15.5\ncy = 11.5\n"
        + "[sim.render]\nmultipath = false\nsubpixels = 1\n"
    )
    return file


def test_command_records_the_simulated_station(tmp_path, capsys):
    """``tofcapture record`` on the simulated station: records, resumes, says so, and repeats its arrays elsewhere."""
    station = _small_station(tmp_path)
    words = ["record", "--calibration", "--views", "2", "--frames", "2", "--station", str(station), "--json"]
    assert main([*words, "--out", str(tmp_path / "a")]) == 0
    said = capsys.readouterr()
    first = json.loads(said.out)
    assert first["recorded"] == [0, 1]
    assert "1 board views" in said.err
    assert "2 board views" in said.err
    assert main([*words, "--out", str(tmp_path / "a")]) == 0
    assert json.loads(capsys.readouterr().out)["kept"] == [0, 1]
    assert main([*words, "--out", str(tmp_path / "b")]) == 0
    capsys.readouterr()
    assert _arrays(tmp_path / "a", "calibration") == _arrays(tmp_path / "b", "calibration")
    view = open_view(view_path(tmp_path / "a", "calibration", 0))
    assert view.truth is not None
    told = {
        "quality": view.provenance["quality"],
        "times": view.tof.time_ns,
    }
    states = [view.arm_before.time_ns, view.arm_after.time_ns, view.stereo.time_ns]
    answers.hold("record", {**told, "states": states, "rig": dumps_rig(view.rig).splitlines()}, off=0.03)
    assert np.isfinite(view.truth.depth).mean() > 0.9


def test_command_dry_run_and_refusals(tmp_path, capsys, monkeypatch):
    """``--dry-run`` prints the plan and writes nothing; a real arm needs ``--allow-motion``; no scene is a usage error."""
    out = tmp_path / "r"
    assert main(["record", "--scene", "mug", "--views", "3", "--out", str(out), "--dry-run"]) == 0
    assert "3 of 3 views" in capsys.readouterr().out
    assert not out.exists()
    monkeypatch.setattr("tofcapture.devices.sim.drivers.SimArm.simulated", False)
    assert main(["record", "--scene", "mug", "--out", str(out)]) == 4
    assert "--allow-motion" in capsys.readouterr().err
    assert main(["record", "--out", str(out)]) == 2


def test_check_knows_the_journal(tmp_path):
    """``check`` finds nothing wrong with a fresh recording, and a view that the journal promises but is gone."""
    from tofcapture.files.check import check

    _record(tmp_path)
    assert list(check(tmp_path)) == []
    view_path(tmp_path, "mug", 1).unlink()
    assert any("journal" in problem.message for problem in check(tmp_path))
