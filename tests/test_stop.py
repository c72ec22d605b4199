"""A stop holds from the moment it is heard until somebody resumes, at every layer, whenever it comes."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests import until
from tests.emulated import CAMERAS, station_file
from tests.stopping import LAYERS, faults_of, sweep
from tofcapture.devices import Arm
from tofcapture.devices.faults import StopLatch
from tofcapture.devices.host import hosted
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.registry import StationContext
from tofcapture.devices.station import StationArm, open_station
from tofcapture.errors import MotionRefused, MotionStopped
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.record import recorder
from tofcapture.record.observer import Observer, Stopped
from tofcapture.record.plan import plan_scene
from tofcapture.record.recorder import record

ARM = "tests.misbehaving:Arm17"
CONTEXT = StationContext({}, Path())
AROUND = (-0.05, -0.005, 0.0, 0.01, 0.03, 0.1)  # s around the start of a move


@given(st.lists(st.sampled_from(["stop", "resume", "token"]), max_size=12))
def test_the_latch_forgets_no_stop(events):
    """A move goes on only if no stop came since its token, whatever was said after; without a token there is none to begin."""
    latch, tokens, stopped = StopLatch(), [], False
    for event in events:
        if event == "stop":
            latch.stop()
            stopped, tokens = True, [(token, True) for token, _ in tokens]
        elif event == "resume":
            latch.resume(latch.token)
            stopped = False
        else:
            tokens.append((latch.token, False))
    for token, broken in tokens:
        assert latch.stopped(token) or not broken
    assert latch.stopped(latch.token) is stopped


def test_a_resume_lifts_no_later_stop():
    """A stop between the operator's word and its effect holds."""
    latch = StopLatch()
    latch.stop()
    word = latch.token
    latch.stop()
    latch.resume(word)
    assert latch.stopped(latch.token)


class _Deaf(Arm):
    """Moves for 5 s, and forgets at the start of a move that it was told to stop."""

    simulated = True

    def __init__(self):
        self.told, self.began, self.started = threading.Event(), threading.Event(), 0

    def describe(self):
        return ArmInfo("ur10e", "deaf")

    def state(self):
        return ArmState(HOME, forward(MODELS["ur10e"], HOME), 1)

    def move_to(self, joints):
        self.started += 1
        self.began.set()
        time.sleep(0.05)
        self.told.clear()
        if self.told.wait(5):
            raise MotionRefused("vendor code 9")
        return self.state()

    def stop(self):
        self.told.set()


def test_a_driver_that_forgets_is_told_again():
    """The station stops an arm whose driver clears the stop as it begins, and lets it begin no other move until resume()."""
    deaf = _Deaf()
    arm = StationArm(deaf, MODELS["ur10e"], allowed=True)
    threading.Thread(target=lambda: (deaf.began.wait(), arm.stop())).start()
    began = time.monotonic()
    with pytest.raises(MotionRefused):
        arm.move_to(HOME)
    assert time.monotonic() - began < 2
    for _ in range(2):
        with pytest.raises(MotionStopped, match="on request"):
            arm.move_to(HOME)
    assert deaf.started == 1
    arm.resume()
    arm.stop()
    with pytest.raises(MotionStopped):
        arm.move_to(HOME)


def test_a_host_begins_no_move_that_was_asked_for_before_a_stop(tmp_path):
    """In the child: stop, resume and stop again while a move runs; the arm's own driver forgets stops, its host does not."""
    moving = tmp_path / "moving"
    with hosted("arm", ARM)({"seconds": 1000.0, "moving": str(moving)}, CONTEXT) as arm:
        for _ in range(2):
            results = []

            def move(results=results):
                try:
                    arm.move_to(np.ones(6))
                except MotionRefused as err:
                    results.append(err)

            threads = [threading.Thread(target=move) for _ in range(2)]
            for thread in threads:
                thread.start()
            until(moving.exists)
            arm.stop()
            for thread in threads:
                thread.join()
            assert len(results) == 2  # the one that ran, and the one that waited for it
            moving.unlink()
            with pytest.raises(MotionStopped):
                arm.move_to(np.ones(6))
            arm.resume()
        arm.stop()
        assert arm.state().joints.tolist() == [0.0] * 6
        with pytest.raises(MotionStopped):
            arm.move_to(np.ones(6))
        assert not moving.exists()


def test_a_stop_while_the_host_starts_holds():
    """Nothing moves after opening if somebody said stop during it; opening anew lifts it."""
    arm = hosted("arm", ARM)({}, CONTEXT)
    opened = threading.Thread(target=arm.__enter__)
    opened.start()
    until(lambda: arm.pid is not None or not opened.is_alive())
    arm.stop()
    opened.join()
    with pytest.raises(MotionStopped):
        arm.move_to(np.ones(6))
    arm.__exit__(None, None, None)
    with arm:
        assert arm.move_to(np.ones(6)).joints.tolist() == [1.0] * 6


class _StopAt(Observer):
    """Stops the arm at the n-th thing that happens, and keeps what had moved until then."""

    def __init__(self, arm, when, moves):
        self.arm, self.left, self.moves, self.begun = arm, when, moves, None

    def _note(self):
        if self.left == 0:
            self.arm.stop()
            self.begun = len(self.moves)
        self.left -= 1

    def before_view(self, index):
        self._note()

    def step(self, index, step):
        assert step != "failed"
        self._note()

    def sealed(self, view, sha256):
        self._note()


SMALL = (
    CAMERAS
    + """
[arm]
driver = "sim"
[plan]
table = -0.50
target = [0.70, 0.0, -0.44]
board = [0.70, 0.0, -0.22]
board_normal = [-0.258819, 0.0, 0.965926]
[sim.faults]
stereo_empty = [0]
"""
)


@pytest.mark.parametrize(("scene", "moments"), [("mug", range(20)), ("calibration", (0, 1, 4, 7))])
def test_no_move_begins_after_a_stop_in_a_recording(tmp_path, monkeypatch, scene, moments):
    """Wherever in a run the stop comes, retakes and the time between views included: the run ends as stopped, not as failed, no further
    move is begun, and after a resume the same command records what is missing."""
    file = tmp_path / "station.toml"
    file.write_text(SMALL)
    with open_station(file) as station:
        plan = plan_scene(station, scene, 2)
        monkeypatch.setattr(recorder, "plan_scene", lambda *_: plan)
        moves, ended = [], set()
        go = station.arm._arm.move_to
        monkeypatch.setattr(station.arm._arm, "move_to", lambda q: moves.append(q) or go(q))
        for when in moments:
            watch, out = _StopAt(station.arm, when, moves), tmp_path / str(when)
            try:
                record(station, scene, out, 2, 1, observer=watch)
                ended.add("recorded")
            except Stopped:
                ended.add("stopped")
            if watch.begun is None:
                break  # there were not so many moments
            assert len(moves) == watch.begun
            with pytest.raises(MotionStopped):
                station.arm.move_to(HOME)
            station.arm.resume()
        assert ended == {"recorded", "stopped"} if scene == "mug" else {"stopped"}
        result = record(station, scene, tmp_path / "1", 2, 1)
        assert result.failed == ()
        assert len(result.recorded) + len(result.kept) == 2


needs_library = pytest.mark.skipif(
    not __import__("importlib.util").util.find_spec("rtde_control"),
    reason="the ur_rtde library is not installed",
)


@needs_library
@pytest.mark.parametrize(("layer", "delays"), [("host", AROUND), ("recorder", AROUND[2:5])])
def test_stops_around_the_start_of_a_move(emulator, tmp_path, layer, delays):
    """With the real library on the emulated arm: at rest within 0.3 s of every stop, and the next move is refused."""
    trials = sweep(layer, emulator.host, station_file(tmp_path, emulator), delays)
    assert len(trials) == len(delays)
    assert faults_of(trials) == []


@needs_library
@pytest.mark.slow
@pytest.mark.parametrize("layer", LAYERS)
def test_stops_at_every_layer(emulator, tmp_path, layer):
    """The whole sweep, in steps of 5 ms; for the daemon, whose trials are jobs of their own, of 25 ms."""
    delays = [ms / 1e3 for ms in range(-50, 151, 25 if layer == "daemon" else 5)]
    trials = sweep(layer, emulator.host, station_file(tmp_path, emulator), delays)
    assert len(trials) == len(delays)
    assert faults_of(trials) == []
