"""The driver contract, as checks that any driver can be put through; docs/drivers.md has its clauses.

Plain functions without a test framework. ``make`` makes a new, unopened device as its factory would; ``prepare`` is called
with every open device before it is used. A :class:`ContractError` names the clause that is broken. In a test::

    from tofcapture.testing import check_tof

    def test_my_camera_keeps_the_contract():
        check_tof(lambda: MyTof({"port": "/dev/ttyUSB0"}, context))
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofcapture.devices.contract import check_burst, check_points, check_state, check_tof_info
from tofcapture.devices.kinematics import ArmModel, pose_error
from tofcapture.devices.registry import lacking
from tofcapture.errors import ConfigError, MotionRefused, MotionStopped, TofError
from tofcapture.frames import ArmInfo, ArmState, StereoInfo, TofInfo, Truth
from tofcapture.poses import Float64

Make = Callable[[], Any]
Prepare = Callable[[Any], None]

_NEAR = np.radians(0.1)  # rad; a settled arm is this close to its goal
_NUDGE = 0.02  # rad
_IO = ("socket.connect", "socket.bind", "subprocess.Popen", "os.posix_spawn", "os.fork", "pty.spawn")


class ContractError(AssertionError):
    """A driver breaks the contract; the message is the clause and what was seen."""


class _Watched(threading.local):
    """I/O that this thread does, while it is watched."""

    seen: list[str] | None = None


_watched = _Watched()


def check_arm(
    make: Make,
    prepare: Prepare = lambda _: None,
    goal: ArrayLike | None = None,
    kinematics: ArmModel | None = None,
) -> None:
    """Put an arm through the contract.

    It moves: by 0.02 rad in its first joint, or to ``goal`` (J,) rad, reachable from where it stands, and back. ``kinematics``
    are those of the station's ``[arm.kinematics]``, for a driver that brings none.
    """
    arm = _made(make, "arm")
    _check_describe(arm, ArmInfo)
    _refuses(arm.state, TofError, "state() of an arm that is not open raises a TofError")
    if arm.by_hand:
        _check_by_hand(arm, prepare)
        return
    model = _kinematics(arm) if kinematics is None else kinematics
    with arm as opened:
        prepare(opened)
        _require(opened is arm, "__enter__ returns the device")
        before = _check_state(arm)
        wrong = pose_error(model, before.joints, before.T_base_flange)
        _require(not wrong, "the kinematics lead from the measured joints to the measured pose", wrong)
        there = (
            before.joints + _NUDGE * (np.arange(len(before.joints)) == 0)
            if goal is None
            else np.asarray(goal, dtype=np.float64)
        )
        arm.check_move(before.joints, there)
        _check_moves(arm, before.joints, there)
        _check_refusals(arm)
        _check_stop(arm, there, before.joints)
    arm.stop()
    _refuses(arm.state, TofError, "state() of a closed arm raises a TofError")
    with make() as again:
        prepare(again)
        _check_state(again)


def check_tof(make: Make, prepare: Prepare = lambda _: None, frames: int = 2) -> None:
    """Put a ToF camera through the contract, with bursts of ``frames`` frames."""
    camera = _made(make, "tof")
    info = _check_describe(camera, TofInfo)
    _keeps(check_tof_info, info)
    _only_named_errors(
        lambda: camera.capture(1), "capture() of a camera that is not open raises TofErrors only"
    )
    last = None
    for _ in range(2):
        with camera as opened:
            prepare(opened)
            _require(opened is camera, "__enter__ returns the device")
            for _ in range(2):
                burst = camera.capture(frames)
                _check_burst(burst, info, frames)
                first = int(burst.time_ns[0])
                _require(last is None or first > last, "the frames of a later burst are later")
                last = int(burst.time_ns[-1])
            _only_named_errors(partial(camera.capture, -1), "capture(-1) raises TofErrors only")
        # A device that was closed can be opened again; a new one starts no earlier.
        camera = make()


def check_stereo(make: Make, prepare: Prepare = lambda _: None) -> None:
    """Put a stereo camera through the contract."""
    camera = _made(make, "stereo")
    info = _check_describe(camera, StereoInfo)
    _only_named_errors(camera.capture, "capture() of a camera that is not open raises TofErrors only")
    last = None
    for _ in range(2):
        with camera as opened:
            prepare(opened)
            _require(opened is camera, "__enter__ returns the device")
            for _ in range(2):
                frame = camera.capture()
                _check_frame(frame, info)
                _require(last is None or frame.time_ns > last, "a later point map is later")
                last = frame.time_ns
        camera = make()


def check_operator(make: Make, scene: str = "mug") -> None:
    """Put an operator through the contract, with a scene that it can place."""
    operator = _made(make, "operator")
    operator.place(scene)
    operator.place(scene)
    try:
        truth = operator.truth()
    except TofError:
        return  # knows the truth only of a pose, and there is none yet
    _require(truth is None or isinstance(truth, Truth), "truth() returns a Truth or None", type(truth))


def _require(holds: object, clause: str, seen: object = "") -> None:
    """Raise the clause, and what was seen, unless it holds."""
    if not holds:
        raise ContractError(f"{clause}; got {seen!r}" if seen != "" else clause)


def _refuses(action: Callable[[], Any], kind: type[TofError], clause: str) -> None:
    try:
        action()
    except kind:
        return
    except Exception as err:
        raise ContractError(f"{clause}; it raised {type(err).__name__}: {err}") from err
    raise ContractError(clause)


def _only_named_errors(action: Callable[[], Any], clause: str) -> None:
    """Do it; anything but success or a TofError breaks the clause."""
    try:
        action()
    except TofError:
        return
    except Exception as err:
        raise ContractError(f"{clause}; it raised {type(err).__name__}: {err}") from err


def _note_io(event: str, args: tuple[Any, ...]) -> None:
    if _watched.seen is None:
        return
    device_file = event == "open" and isinstance(args[0], str) and args[0].startswith("/dev/")
    if event in _IO or (device_file and args[0] not in {"/dev/null", "/dev/urandom"}):
        _watched.seen.append(f"{event} {args[0]}")


@cache
def _install() -> None:
    """Add the audit hook, once: hooks cannot be removed."""
    sys.addaudithook(_note_io)


@contextmanager
def _watching(clause: str) -> Iterator[None]:
    """Notice I/O of this thread: connections, child processes, device files."""
    _install()
    seen = _watched.seen = []
    try:
        yield
    finally:
        _watched.seen = None
    _require(not seen, clause, seen)


def _made(make: Make, role: str) -> Any:
    """Construct and describe, without I/O; all of the role's protocol must be there."""
    with _watching("the constructor and describe() do no I/O"):
        device = make()
        missing = lacking(role, device)
        _require(not missing, f"the device has all of the protocol of its role, {role}", missing)
        if role != "operator":
            device.describe()
    return device


def _check_describe(device: Any, kind: type) -> Any:
    """Describe twice; return what it said."""
    first, second = device.describe(), device.describe()
    _require(isinstance(first, kind), f"describe() returns a {kind.__name__}", first)
    _require(first.model and isinstance(first.serial, str), "describe() names the model", first)
    _require(repr(first) == repr(second), "describe() says the same each time")
    return first


def _check_state(arm: Any) -> ArmState:
    first, second = arm.state(), arm.state()
    for state in (first, second):
        _keeps(check_state, state)
    _require(second.time_ns > first.time_ns, "the time of a later state is later")
    checked: ArmState = second
    return checked


def _check_moves(arm: Any, home: Float64, goal: Float64) -> None:
    for target in (goal, goal, home):
        state = arm.move_to(target)
        off = float(np.abs(state.joints - target).max())
        _require(off < _NEAR, "move_to returns the measured state, settled at the goal", off)
        now = arm.state()
        _require(np.abs(now.joints - state.joints).max() < _NEAR, "after move_to the arm stays where it is")


def _check_by_hand(arm: Any, prepare: Prepare) -> None:
    """A rig that a person carries: it refuses to move by itself, and stands still while it is checked."""
    with arm:
        prepare(arm)
        first = arm.await_view(0)
        _keeps(check_state, first)
        again = arm.await_view(0)
        _require(
            again.time_ns > first.time_ns, "await_view() of the same view again, standing still, returns"
        )
        _check_state(arm)
        _refuses(
            partial(arm.move_to, np.zeros(6)), MotionRefused, "move_to of a rig moved by hand is refused"
        )
        arm.stop()
        stopped = "after stop() await_view raises MotionStopped until resume()"
        for _ in range(2):
            _refuses(partial(arm.await_view, 0), MotionStopped, stopped)
        arm.resume()
        arm.await_view(0)
    arm.stop()
    _refuses(arm.state, TofError, "state() of a closed arm raises a TofError")


def _kinematics(arm: Any) -> ArmModel:
    clause = "kinematics() gives the arm's geometry before opening (dh_model, urdf_model), or the station has [arm.kinematics]"
    try:
        model: ArmModel = arm.kinematics()
    except TofError as err:
        raise ContractError(f"{clause}; it raised {err.message}") from err
    _require(isinstance(model, ArmModel), clause, model)
    return model


def _check_stop(arm: Any, goal: Float64, home: Float64) -> None:
    """A stop holds until somebody resumes, as often as it comes."""
    for _ in range(2):
        arm.stop()
        arm.stop()
        before = _check_state(arm).joints
        for _ in range(2):
            clause = "after stop() move_to raises MotionRefused, each time, until resume()"
            _refuses(partial(arm.move_to, goal), MotionRefused, clause)
        _require(np.abs(arm.state().joints - before).max() < _NEAR, "after stop() nothing moves")
        arm.resume()
        _check_moves(arm, home, goal)


def _check_refusals(arm: Any) -> None:
    before = arm.state().joints
    count = len(before)
    bad = {
        "NaN": np.full(count, np.nan),
        "infinite angles": np.full(count, np.inf),
        "an angle too few": np.zeros(count - 1),
        "an angle of 100 rad": np.full(count, 100.0),
    }
    for what, joints in bad.items():
        clause = f"move_to refuses {what} by MotionRefused"
        _refuses(partial(arm.move_to, joints), MotionRefused, clause)
    after = arm.state().joints
    _require(np.abs(after - before).max() < _NEAR, "a refused motion moves nothing")


def _check_burst(burst: Any, info: TofInfo, frames: int) -> None:
    _keeps(check_burst, burst, info)
    _require(len(burst.raw) == frames, "raw has as many frames as were asked for", len(burst.raw))
    kinds = (np.uint16, np.int16)
    _require(burst.raw.dtype in kinds, "raw is uint16 or int16, as the sensor gave it", burst.raw.dtype)
    _require((np.diff(burst.time_ns) > 0).all(), "the times of a burst increase")


def _check_frame(frame: Any, info: StereoInfo) -> None:
    _keeps(check_points, frame, info)
    _require(np.isfinite(frame.points).any(), "the point map of a scene is not empty")


def _keeps(check: Callable[..., None], *arguments: Any) -> None:
    """Hold something against the rules that the recorder applies too."""
    try:
        check(*arguments)
    except ConfigError as err:
        raise ContractError(f"{err.message} ({err.hint})") from err
