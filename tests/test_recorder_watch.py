"""Who looks on while the recorder works: steps are journaled first, stopping rolls back, a full disk is a state."""

import errno
import os
import shutil
import sqlite3
from dataclasses import replace

import numpy as np
import pytest

from tests.test_recorder import VIEWS, Bench, _arrays, _few_candidates, _record, rows, whole
from tofcapture.devices.contract import check_tof_info
from tofcapture.devices.faults import ProtectiveStop
from tofcapture.devices.kinematics import HOME
from tofcapture.errors import BusyError, ConfigError, DataError, DeviceError
from tofcapture.frames import ArmInfo
from tofcapture.record import recorder, resources
from tofcapture.record.journal import Journal, journal_path
from tofcapture.record.observer import STEPS, Observer, Stopped
from tofcapture.record.recorder import record
from tofcapture.record.resources import DiskFull, FolderGone, hold_arm

__all__ = ["_few_candidates", "whole"]  # fixtures


class Witness(Observer):
    """Notes what it is told, and what the journal says at that moment; stops at the n-th step."""

    def __init__(self, out, stop_at=10**9):
        self.out, self.stop_at, self.told, self.journaled = out, stop_at, [], []

    def planned(self, plan, kept, repaired):
        self.told.append(("planned", len(plan.views), sorted(kept), len(repaired)))

    def before_view(self, index):
        self.told.append(("view", index))

    def step(self, index, step):
        db = sqlite3.connect(journal_path(self.out))
        self.journaled.append(db.execute('SELECT step FROM views WHERE "index" = ?', [index]).fetchone()[0])
        db.close()
        self.told.append((step, index))
        if sum(len(t) == 2 and t[0] in STEPS for t in self.told) == self.stop_at:
            raise Stopped("enough")

    def sealed(self, view, sha256):
        self.told.append(("sealed", view.index))

    def failed(self, index, reason):
        self.told.append(("given up", index))


def test_every_step_is_journaled_before_it_begins(tmp_path):
    """Each view: told that it begins, four steps in order, each in the journal already, then sealed; nothing is left begun."""
    witness = Witness(tmp_path)
    _record(tmp_path, observer=witness)
    assert witness.told[0] == ("planned", VIEWS, [], 0)
    words = [word for word, _ in witness.told[1:]]
    assert words == ["view", *STEPS, "sealed"] * VIEWS
    assert witness.journaled == list(STEPS) * VIEWS
    assert {row.step for row in rows(tmp_path)} == {""}


@pytest.mark.parametrize("stop_at", [1, 6, 7, 16])
def test_stopped_in_a_step(tmp_path, whole, stop_at):
    """Stopped ahead of any step, the view in hand is rolled back and the next run ends as if never stopped."""
    with pytest.raises(Stopped):
        _record(tmp_path / "r", observer=Witness(tmp_path / "r", stop_at))
    assert len(list((tmp_path / "r").rglob("*.h5"))) == (stop_at - 1) // 4
    assert not list((tmp_path / "r").rglob("*.partial"))
    result = _record(tmp_path / "r")
    assert any(STEPS[(stop_at - 1) % 4] in line for line in result.repaired)
    assert _arrays(tmp_path / "r") == whole


def test_a_stopped_arm_is_no_failed_view(tmp_path):
    """An arm that refuses because it was told to stop ends the run, and no view is given up for it."""
    bench = Bench()

    class Stopping(Observer):
        def step(self, index, step):
            if bench.steps.count("tof"):
                raise Stopped("told to")

    def refuse(step):
        if step == "tof":
            raise DeviceError("stopped")

    bench.before = refuse
    with pytest.raises(Stopped):
        _record(tmp_path, bench, observer=Stopping())
    assert {row.state for row in rows(tmp_path)} == {"planned"}


@pytest.mark.parametrize("number", range(1, 44, 6))
def test_disk_full_at_any_write(tmp_path, whole, monkeypatch, number):
    """Full from any write on, the run ends as ``DiskFull``, no view fails for it, and with room again all is as if never full."""
    count = iter(range(1, 10_000))

    def full(real, error):
        def write(*args, **more):
            if next(count) >= number:
                raise error
            return real(*args, **more)

        return write

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full(os.fsync, OSError(errno.ENOSPC, "No space left on device")))
        patch.setattr(
            Journal, "_set", full(Journal._set, sqlite3.OperationalError("database or disk is full"))
        )
        patch.setattr(
            recorder, "write_view", full(recorder.write_view, RuntimeError("No space left on device"))
        )
        with pytest.raises(DiskFull):
            _record(tmp_path / "r")
    assert not list((tmp_path / "r").rglob("*.h5.partial"))
    assert not _record(tmp_path / "r").failed
    assert not list((tmp_path / "r" / "views").rglob("*.partial"))
    assert _arrays(tmp_path / "r") == whole


def test_the_disk_fills_between_views(tmp_path, monkeypatch):
    """Room is looked for before every view, not only at the start."""
    real, calls = resources.shutil.disk_usage, []

    def usage(path):
        calls.append(path)
        found = real(path)
        return found if len(calls) < 3 else found._replace(free=10**6)

    monkeypatch.setattr(resources.shutil, "disk_usage", usage)
    with pytest.raises(DiskFull):
        _record(tmp_path)
    assert len(list(tmp_path.rglob("*.h5"))) == 2


def test_what_is_set_aside_stays(tmp_path):
    """A second damaged file of the same view does not take the place of the first."""
    _record(tmp_path)
    view = tmp_path / "views" / "mug" / "view-001.h5"
    for content in (b"first", b"second"):
        view.unlink()
        view.write_bytes(content)
        for path in tmp_path.glob("journal.sqlite*"):
            path.unlink()
        assert _record(tmp_path).recorded == (1,)
    kept = sorted(path.read_bytes() for path in view.parent.glob("*.damaged*"))
    assert kept == [b"first", b"second"]


def test_what_cannot_be_read_is_not_damaged(tmp_path):
    """A view that cannot be read just now is named, and stays under its name."""
    _record(tmp_path)
    view = tmp_path / "views" / "mug" / "view-001.h5"
    view.unlink()
    view.mkdir()  # root reads everything but this
    for path in tmp_path.glob("journal.sqlite*"):
        path.unlink()
    with pytest.raises(DataError, match="cannot be read"):
        _record(tmp_path)
    assert view.is_dir()
    assert not list(view.parent.glob("*.damaged*"))


def test_a_real_arm_has_one_master(tmp_path, monkeypatch):
    """Two recorders of two recordings do not move one real arm; of simulated ones there are plenty, and people may carry two rigs."""

    class Real:
        simulated = by_hand = False

        def describe(self):
            return ArmInfo("ur10e", f"serial {os.getpid()} {tmp_path}")

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with hold_arm(Real()), pytest.raises(BusyError, match="ur10e"), hold_arm(Real()):
        pass
    with hold_arm(Real()):
        pass
    for kind in ("simulated", "by_hand"):
        monkeypatch.setattr(Real, kind, True)
        with hold_arm(Real()), hold_arm(Real()):
            pass
        monkeypatch.undo()


def _moved(folder):
    folder.rename(folder.with_name("elsewhere"))


def _emptied(folder):
    """As unmounting leaves it: the folder is there, another one, and empty."""
    _moved(folder)
    folder.mkdir()


@pytest.mark.parametrize(
    ("go", "which", "step"),
    [
        (_emptied, "disk", "moving"),
        (_emptied, "disk", "sealing"),
        (_moved, "disk/r", "sealing"),
        (_emptied, "disk/r", "sealing"),
        (shutil.rmtree, "disk/r", "tof"),
        (_moved, "disk/r/views", "moving"),
        (shutil.rmtree, "disk/r/views/mug", "sealing"),
    ],
)
def test_a_folder_that_goes_ends_the_run(tmp_path, go, which, step):
    """Moved, unmounted or deleted while recording: the run ends with the reason, and nothing is written anywhere else."""

    class Taking(Observer):
        seen = 0

        def sealed(self, view, sha256):
            self.seen += 1

        def step(self, index, name):
            if self.seen == 1 and name == step:
                go(tmp_path / which)

    (tmp_path / "disk").mkdir()
    out = tmp_path / "disk" / "r"
    with pytest.raises(FolderGone, match="moved, deleted or unmounted") as told:
        _record(out, observer=Taking())
    assert which in told.value.message
    assert not (tmp_path / which).exists() or not list((tmp_path / which).iterdir())
    away = (tmp_path / which).with_name("elsewhere")
    if away.exists():
        assert len(list(away.rglob("view-*.h5"))) == 1
        shutil.rmtree(tmp_path / which, ignore_errors=True)
        away.rename(tmp_path / which)
        assert len(_record(out).recorded) == VIEWS - 1


def test_a_folder_that_goes_within_the_sealing(tmp_path, monkeypatch):
    """Gone between the first and the last write of a view: the view does not count as sealed."""
    real = recorder.write_view

    def write(path, view):
        if list(path.parent.glob("view-*.h5")):
            _emptied(tmp_path / "r")
            path.parent.mkdir(parents=True)
        return real(path, view)

    with monkeypatch.context() as patch:
        patch.setattr(recorder, "write_view", write)
        with pytest.raises(FolderGone):
            _record(tmp_path / "r")
    assert sorted(row.state for row in rows(tmp_path / "elsewhere")) == [*["planned"] * (VIEWS - 1), "sealed"]


@pytest.mark.parametrize("fault", [ProtectiveStop("it hit something"), DeviceError("no answer")])
def test_a_broken_device_at_the_last_view_is_no_fault_of_the_scene(tmp_path, fault):
    """The last view has no other after it that would show the devices to work: the run ends in an error, and is gone on with."""
    bench = Bench()

    def fail(step):
        if step == "tof" and bench.steps.count("tof") >= VIEWS:
            raise fault

    bench.before = fail
    with pytest.raises(type(fault)):
        _record(tmp_path, bench)
    assert len(_record(tmp_path).recorded) == 1


def test_a_view_that_fails_in_two_runs_is_given_up(tmp_path):
    """A pose at which a camera fails in a station that was opened anew is that pose's own fault."""

    def fail(step):
        if step == "tof" and bench.steps.count("tof") >= first:
            raise DeviceError("no answer")

    bench, first = Bench(fail), VIEWS
    with pytest.raises(DeviceError):
        _record(tmp_path, bench)
    bench, first = Bench(fail), 0
    assert len(_record(tmp_path, bench).failed) == 1


def _change(station, role, **change):
    """A station one of whose cameras hands over something else."""
    device = getattr(station, role)
    real = device.capture

    def capture(*args):
        got = real(*args)
        return replace(got, **{name: how(getattr(got, name)) for name, how in change.items()})

    device.capture = capture
    return station


def _some(points, value):
    points[:2] = value
    return points


UNITS = [
    ("stereo", {"points": lambda p: p * 1000}, "metres", "millimetres"),
    ("stereo", {"points": lambda p: p / 1000}, "metres", "twice"),
    ("stereo", {"points": lambda p: _some(p, 0)}, "zero never means missing", "0 for none"),
    ("stereo", {"points": lambda p: _some(p, np.inf)}, "infinity", "inf for none"),
    ("stereo", {"points": lambda p: _some(p, -1)}, "in front", "negative"),
    ("stereo", {"points": lambda p: _some(p, 1e4)}, "beyond", "large number"),
    ("stereo", {"points": lambda p: p.astype(np.float64)}, "float32", "conversion"),
    ("tof", {"celsius": lambda c: c + 273.15}, "Celsius", "kelvin"),
    ("tof", {"time_ns": lambda t: t + 1_700_000_000 * 10**9}, "monotonic", "time of day"),
    ("tof", {"time_ns": lambda t: t.astype(np.float64)}, "int64", "seconds"),
    ("tof", {"raw": lambda r: r.astype(np.float32)}, "as the sensor gave it", "conversion"),
]


@pytest.mark.parametrize(("role", "change", "clause", "cause"), UNITS, ids=[row[2] + row[3] for row in UNITS])
def test_a_drivers_wrong_units_are_refused_at_the_first_view(tmp_path, role, change, clause, cause):
    """What the conformance suite knows, the recorder holds the first view against: by name, with the likely cause."""
    with pytest.raises(ConfigError, match=rf"\[{role}\].*{clause}") as told:
        record(_change(Bench().station(), role, **change), "mug", tmp_path, views=2, frames=2)
    assert cause in told.value.hint
    assert not list(tmp_path.rglob("view-*.h5"))


@pytest.mark.parametrize(
    ("change", "clause"),
    [
        ({"phase_rad": (0.0, 90.0, 180.0, 270.0) * 2}, "radians"),
        ({"exposure": 400.0}, "seconds"),
        ({"illuminator": np.array([0.0, 15.0, 0.0])}, "metres"),
    ],
)
def test_a_description_in_other_units_is_refused(change, clause):
    """Degrees, microseconds, millimetres."""
    with pytest.raises(ConfigError, match=clause):
        check_tof_info(replace(Bench().station().tof.describe(), **change))


@pytest.mark.parametrize(
    ("change", "clause"),
    [
        ({"joints": np.degrees(HOME)}, "radians"),
        ({"time_ns": 1.5}, "whole number"),
        ({"joints": HOME[:5]}, "6"),
    ],
)
def test_an_arm_in_other_units_is_refused(tmp_path, change, clause):
    """Degrees, seconds as floats, five joints."""
    station = Bench().station()
    real = station.arm.move_to
    station.arm.move_to = lambda joints: replace(real(joints), **change)
    with pytest.raises(ConfigError, match=clause):
        record(station, "mug", tmp_path, views=2, frames=2)
