"""The driver replay: a recording recorded again from its own files is the same recording."""

import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.devices import registry
from tofcapture.devices.kinematics import HOME, MODELS, forward
from tofcapture.devices.registry import StationContext, make_device
from tofcapture.devices.replay import Replay, write_station
from tofcapture.devices.station import Station, open_station, read_station
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.files.view import open_view, view_path
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.poses import transform
from tofcapture.record import plan as plans
from tofcapture.record.plan import object_sampling
from tofcapture.record.recorder import record
from tofcapture.rig import Rig
from tofcapture.testing import check_arm, check_operator

TOF, STEREO = Camera(8, 6, 7.0, 7.0, 3.5, 2.5), Camera(10, 8, 9.0, 9.0, 4.5, 3.5)
RIG = Rig(TOF, STEREO, transform(np.eye(3), [-0.05, 0.08, 0.0]), transform(np.eye(3), [0.0, -0.035, 0.08]))
VIEWS, FRAMES = 3, 2


class Bench:
    """All devices in one, with measured joints a little off the goal and noise that is never the same again."""

    simulated, by_hand, fixed = True, False, False

    def __init__(self):
        self.rng, self.joints, self.now = np.random.default_rng(), HOME.copy(), 0
        self.tof_info = TofInfo("tof", "T7", TOF, np.array([0.01, 0, 0]))
        self.stereo_info = StereoInfo("stereo", "S7", STEREO)

    def _clock(self):
        self.now += 1_000_000
        return self.now

    def state(self):
        return ArmState(self.joints.copy(), forward(MODELS["ur5e"], self.joints), self._clock())

    def move_to(self, joints):
        self.joints = joints + 1e-5 * self.rng.standard_normal(6)
        return self.state()

    def stop(self):
        pass

    def place(self, scene):
        pass

    def truth(self):
        shape = (2 * TOF.height, 2 * TOF.width)
        depth = self.rng.uniform(0.4, 1, shape).astype(np.float32)
        normals = np.zeros((*shape, 3), np.float32)
        return Truth(depth, normals, depth > 0.5, np.eye(4), np.eye(4))


class Role:
    """One device of the bench."""

    simulated = True

    def __init__(self, bench, info, capture=None):
        self._bench, self._info, self.capture = bench, info, capture

    def describe(self):
        return self._info

    def __getattr__(self, name):
        return getattr(self._bench, name)

    def kinematics(self):
        return MODELS["ur5e"]

    def check_move(self, start, goal):
        pass


def bench_station():
    bench = Bench()

    def tof(frames):
        raw = bench.rng.integers(0, 4096, (frames, 8, *TOF.shape)).astype(np.uint16)
        times = np.array([bench._clock() for _ in range(frames)])
        return TofBurst(raw, times, bench.rng.uniform(40, 50, frames), bench.tof_info)

    def stereo():
        points = bench.rng.uniform(0.4, 1.0, (*STEREO.shape, 3)).astype(np.float32)
        points[0, 0] = np.nan
        return StereoFrame(points, bench._clock(), bench.stereo_info)

    config = read_station(None, seed=3)
    config["arm"]["model"] = "ur5e"
    return Station(
        Role(bench, ArmInfo("ur5e", "R7")), Role(bench, bench.tof_info, tof), Role(bench, bench.stereo_info, stereo),
        Role(bench, None), RIG, config,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Record two scenes on the bench."""
    folder = tmp_path_factory.mktemp("replay") / "recording"
    with pytest.MonkeyPatch.context() as patch:
        few_candidates(patch)
        for scene in ("mug", "box"):
            record(bench_station(), scene, folder, views=VIEWS, frames=FRAMES)
    return folder


def few_candidates(patch):
    sampling = object_sampling()
    patch.setattr(
        plans,
        "object_sampling",
        lambda: type(sampling)(sampling.axis, directions=40, distances=(0.5, 0.8)),
    )


def arrays(view):
    out = {"raw": view.tof.raw, "times": view.tof.time_ns, "celsius": view.tof.celsius, "points": view.stereo.points,
           "stereo_time": view.stereo.time_ns}  # fmt: skip
    for when in ("arm_before", "arm_after"):
        state = getattr(view, when)
        out |= {f"{when}_{k}": getattr(state, k) for k in ("joints", "T_base_flange", "time_ns")}
    out |= {f"truth_{k}": getattr(view.truth, k) for k in Truth.__dataclass_fields__}
    return out


def test_registered_for_every_role():
    """The registry finds replay for arm, both cameras and the operator."""
    assert registry.load_driver("replay").keys() == set(registry.ROLES)


@pytest.mark.parametrize("order", ["joints", "file"])
def test_recording_again_gives_the_same_arrays(recording, tmp_path, monkeypatch, order):
    """Recording on the replay station reproduces every array of every view, and describes the same devices."""
    few_candidates(monkeypatch)
    station = write_station(recording, tmp_path / "station", order)
    again = tmp_path / "again"
    for scene in ("mug", "box") if order == "joints" else ("mug",):
        with open_station(station) as replayed:
            assert replayed.simulated
            assert replayed.describe()["arm"] == {"model": "ur5e", "serial": "R7"}
            result = record(replayed, scene, again, views=VIEWS, frames=FRAMES)
        assert len(result.recorded) == VIEWS
        served = []
        for index in result.recorded:
            view = open_view(view_path(again, scene, index))
            same = [
                n
                for n in range(VIEWS)
                if np.array_equal(open_view(view_path(recording, scene, n)).tof.raw, view.tof.raw)
            ]
            served += same
            if order == "joints":
                assert same == [index]
            before = arrays(open_view(view_path(recording, scene, same[0])))
            for name, array in arrays(view).items():
                np.testing.assert_array_equal(array, before[name], err_msg=name)
        assert sorted(served) == list(range(VIEWS))


@contextmanager
def opened(recording, order="joints"):
    arm, tof, stereo, operator = devices(recording, order)
    with arm, tof, stereo:
        yield arm, tof, stereo, operator


def devices(recording, order="joints"):
    config = {"arm": {"driver": "replay", "recording": str(recording), "order": order}}
    config |= {role: {"driver": "replay"} for role in ("tof", "stereo", "operator")}
    context = StationContext(config, recording)
    return [make_device(role, context) for role in registry.ROLES]


def test_between_views_there_is_nothing(recording):
    """Away from recorded poses the arm says where it was sent, and the cameras have nothing to serve."""
    with opened(recording) as (arm, tof, stereo, operator):
        assert (arm.state().joints == HOME).all()
        operator.place("mug")
        arm.move_to(HOME)
        for look in (lambda: tof.capture(1), stereo.capture, operator.truth):
            with pytest.raises(DeviceError, match="no recorded view"):
                look()
        with pytest.raises(MotionRefused, match="6 finite"):
            arm.move_to(HOME * np.nan)
        arm.stop()


def test_frames_and_scenes_that_were_not_recorded(recording):
    """Fewer frames are the first ones; more frames, or another scene, were not recorded."""
    with opened(recording) as (arm, tof, _, operator):
        view = open_view(view_path(recording, "box", 1))
        operator.place("box")
        arm.move_to(view.arm_before.joints)
        np.testing.assert_array_equal(tof.capture(1).raw, view.tof.raw[:1])
        for frames in (0, FRAMES + 1):
            with pytest.raises(DeviceError, match="expected 1 to 2 frames"):
                tof.capture(frames)
        with pytest.raises(DeviceError, match="no scene 'vase'"):
            operator.place("vase")


def test_state_after_the_exposures(recording):
    """Before the exposures the arm is where it was before them, afterwards where it was after them; placing again changes nothing."""
    with opened(recording) as (arm, tof, stereo, operator):
        view = open_view(view_path(recording, "mug", 2))
        operator.place("mug")
        assert arm.move_to(view.arm_before.joints).time_ns == view.arm_before.time_ns
        tof.capture(FRAMES)
        stereo.capture()
        operator.place("mug")
        assert arm.state().time_ns == view.arm_after.time_ns


def test_by_number_it_ends(recording):
    """In the order of files, an uncaptured view is not passed over, and after the last there is none."""
    with opened(recording, "file") as (arm, tof, _, operator):
        operator.place("mug")
        for index in range(VIEWS):
            for _ in range(2):
                arm.move_to(HOME)
            np.testing.assert_array_equal(
                tof.capture(FRAMES).raw, open_view(view_path(recording, "mug", index)).tof.raw
            )
        with pytest.raises(DeviceError, match="no view after 2"):
            arm.move_to(HOME)


def test_damaged_view_is_a_device_error(recording, tmp_path):
    """A view that cannot be read is a device that fails, so that the recorder goes on."""
    replay = Replay(tmp_path, "file")
    path = view_path(tmp_path, "mug", 0)
    path.parent.mkdir(parents=True)
    path.write_bytes(b"nothing")
    replay.place("mug")
    with pytest.raises(DeviceError, match="view-000"):
        replay.go(HOME)


def test_wrong_tables(recording, tmp_path):
    """No recording, two recordings, an unknown order or setting, and an empty folder are refused."""

    def context(**tables):
        return StationContext(
            {role: {"driver": "replay", **table} for role, table in tables.items()}, tmp_path
        )

    for wrong in (context(arm={}), context(arm={"recording": "a"}, tof={"recording": "b"}),
                  context(arm={"recording": "a", "order": "shuffled"}), context(arm={"recording": "a"})):  # fmt: skip
        with pytest.raises(ConfigError, match=r"replay|expected a recording"):
            make_device("arm", wrong).__enter__()
    with pytest.raises(ConfigError, match="does not know speed"):
        make_device("arm", context(arm={"recording": "a", "speed": 2}))
    with pytest.raises(ConfigError, match=r"station\.toml"):
        write_station(tmp_path, tmp_path / "station")


def test_command_writes_the_station(recording, tmp_path):
    """The module's command writes a station and its rig."""
    command = [sys.executable, "-m", "tofcapture.devices.replay", str(recording), str(tmp_path / "s")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert read_station(tmp_path / "s" / "station.toml")["sim"]["seed"] == 3
    assert done.stdout.strip().endswith("station.toml")


def test_keeps_the_contract(recording):
    """Arm and operator pass the conformance suite; the cameras give recorded times, which do not go on."""
    check_arm(lambda: devices(recording)[0])
    check_operator(lambda: devices(recording)[3], "box")
