"""The driver contract, as checks that any driver can be put through.

Plain functions without a test framework: each takes ``make``, which makes a new device as its factory would, and raises
:class:`ContractError` with the clause that is broken. In a test::

    from tofcapture.testing import check_tof

    def test_my_camera_keeps_the_contract():
        check_tof(lambda: MyTof({"port": "/dev/ttyUSB0"}, context))

The clauses are in docs/drivers.md.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofcapture.devices.registry import lacking
from tofcapture.errors import MotionRefused, TofError
from tofcapture.frames import ArmInfo, ArmState, Truth
from tofcapture.poses import Float64, check_transform

Make = Callable[[], Any]
Prepare = Callable[[Any], None]

_NEAR = np.radians(0.1)  # rad; a settled arm is this close to its goal
_NUDGE = 0.02  # rad
_IO = ("socket.connect", "socket.bind", "subprocess.Popen", "os.posix_spawn", "os.fork", "pty.spawn")


class _Watched(threading.local):
    seen: list[str] | None = None


_watched = _Watched()
_installed = threading.Lock()
_hooks: list[object] = []


class ContractError(AssertionError):
    """A driver breaks the contract; the message is the clause and what was seen."""


def require(holds: object, clause: str, seen: object = "") -> None:
    """Raise the clause, and what was seen, unless it holds."""
    if not holds:
        raise ContractError(f"{clause}; got {seen!r}" if seen != "" else clause)


def nothing(device: Any) -> None:
    """Leave an open device as it is."""
    del device


def _hook(event: str, args: tuple[Any, ...]) -> None:
    seen = _watched.seen
    if seen is None:
        return
    device_file = event == "open" and isinstance(args[0], str) and args[0].startswith("/dev/")
    if event in _IO or (device_file and args[0] not in {"/dev/null", "/dev/urandom"}):
        seen.append(f"{event} {args[0]}")


@contextmanager
def _watching(clause: str) -> Iterator[None]:
    """Notice I/O of this thread: connections, child processes, device files."""
    with _installed:
        if not _hooks:
            sys.addaudithook(_hook)
            _hooks.append(_hook)
    seen: list[str] = []
    _watched.seen = seen
    try:
        yield
    finally:
        _watched.seen = None
    require(not seen, clause, seen)


def made(make: Make, role: str) -> Any:
    """Construct and describe, without I/O; all of the role's protocol must be there."""
    with _watching("the constructor and describe() do no I/O"):
        device = make()
        require(not (missing := lacking(role, device)), f"the device has all of a {role}'s protocol", missing)
        if role != "operator":
            device.describe()
    return device


def check_describe(device: Any, kind: type) -> Any:
    """Describe twice; return what it said."""
    first, second = device.describe(), device.describe()
    require(isinstance(first, kind), f"describe() returns a {kind.__name__}", first)
    require(first.model and isinstance(first.serial, str), "describe() names the model", first)
    require(repr(first) == repr(second), "describe() says the same each time")
    return first


def _refuses(action: Callable[[], Any], kind: type[TofError], clause: str) -> None:
    try:
        action()
    except kind:
        return
    except Exception as err:
        raise ContractError(f"{clause}; it raised {type(err).__name__}: {err}") from err
    raise ContractError(clause)


def only_named_errors(action: Callable[[], Any], clause: str) -> None:
    """Do it; anything but success or a TofError breaks the clause."""
    try:
        action()
    except TofError:
        return
    except Exception as err:
        raise ContractError(f"{clause}; it raised {type(err).__name__}: {err}") from err


def check_arm(make: Make, prepare: Prepare = nothing, goal: ArrayLike | None = None) -> None:
    """Put an arm through the contract. It moves: by 0.02 rad in its first joint, or to ``goal`` and back.

    Parameters
    ----------
    make
        Makes a new, unopened arm.
    prepare
        Is called with every open arm before it is used.
    goal
        (6,) rad, reachable from where the arm stands.

    Raises
    ------
    ContractError
        The clause that is broken.
    """
    arm = made(make, "arm")
    check_describe(arm, ArmInfo)
    _refuses(arm.state, TofError, "state() of an arm that is not open raises a TofError")
    with arm as opened:
        prepare(opened)
        require(opened is arm, "__enter__ returns the device")
        before = _check_state(arm)
        there = before.joints + np.eye(6)[0] * _NUDGE if goal is None else np.asarray(goal, dtype=np.float64)
        _check_moves(arm, before.joints, there)
        _check_refusals(arm)
        arm.stop()
        arm.stop()
        _check_state(arm)
    arm.stop()
    _refuses(arm.state, TofError, "state() of a closed arm raises a TofError")
    with make() as again:
        prepare(again)
        _check_state(again)


def _check_state(arm: Any) -> ArmState:
    first, second = arm.state(), arm.state()
    for state in (first, second):
        require(isinstance(state, ArmState), "state() returns an ArmState", state)
        require(
            np.shape(state.joints) == (6,) and np.isfinite(state.joints).all(), "joints are 6 finite angles"
        )
        check_transform(state.T_base_flange)
        require(isinstance(state.time_ns, int), "time_ns is a whole number", state.time_ns)
    require(second.time_ns > first.time_ns, "the time of a later state is later")
    checked: ArmState = second
    return checked


def _check_moves(arm: Any, home: Float64, goal: Float64) -> None:
    for target in (goal, goal, home):
        state = arm.move_to(target)
        off = float(np.abs(state.joints - target).max())
        require(off < _NEAR, "move_to returns the measured state, settled at the goal", off)
        now = arm.state()
        require(np.abs(now.joints - state.joints).max() < _NEAR, "after move_to the arm stays where it is")


def _check_refusals(arm: Any) -> None:
    before = arm.state().joints
    bad = {
        "NaN": np.full(6, np.nan),
        "infinite angles": np.full(6, np.inf),
        "five angles": np.zeros(5),
        "an angle of 100 rad": np.full(6, 100.0),
    }
    for what, joints in bad.items():
        _refuses(
            partial(arm.move_to, joints),
            MotionRefused,
            f"move_to refuses {what} by MotionRefused",
        )
    after = arm.state().joints
    require(np.abs(after - before).max() < _NEAR, "a refused motion moves nothing")


def check_operator(make: Make, scene: str = "mug") -> None:
    """Put an operator through the contract.

    Parameters
    ----------
    make
        Makes a new operator.
    scene
        A scene it can place.

    Raises
    ------
    ContractError
        The clause that is broken.
    """
    operator = made(make, "operator")
    operator.place(scene)
    operator.place(scene)
    try:
        truth = operator.truth()
    except TofError:
        return  # knows the truth only of a pose, and there is none yet
    require(truth is None or isinstance(truth, Truth), "truth() returns a Truth or None", type(truth))
