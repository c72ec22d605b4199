"""The ``ur_rtde`` library, used so that its faults stay bounded.

Known of version 1.6: it never recovers a lost link (it reconnects in an endless loop and uploads its script again and
again), so a lost link ends this process. Getters return old values after a loss, so the age of data is judged by the
controller's own clock. ``stopJ`` called asynchronously changes what later synchronous calls do, so it never is.

Below it RTDE itself, the controller's Real-Time Data Exchange protocol, version 2. Everything is big-endian. A package is
``uint16 size`` (header included), ``uint8 kind``, payload. Bits of ``safety_status_bits``: 0 normal, 1 reduced, 2 protective stop,
3 recovery, 4 safeguard, 5 system emergency stop, 6 robot emergency stop, 7 emergency stopped, 8 violation, 9 fault, 10 stopped due
to safety. This file alone gives them and the modes a meaning.
"""

from __future__ import annotations

import struct
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tofcapture.devices import faults
from tofcapture.devices.arm import limits
from tofcapture.devices.arm.limits import Sample
from tofcapture.errors import ConfigError, DeviceError

VERSION, CONTROLLER, TEXT = ord("V"), ord("v"), ord("M")
OUTPUTS, INPUTS, START, PAUSE, DATA = ord("O"), ord("I"), ord("S"), ord("P"), ord("U")

PORT = 30004
_HEADER = struct.Struct(">HB")
_LAYOUT = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip

AT_REST, PLAYING = 1, 2
_RUNNING = 7
_MODES = {
    -1: "no controller", 0: "disconnected", 1: "confirming safety", 2: "booting", 3: "power off", 4: "power on",
    5: "idle, brakes closed", 6: "backdrive", 8: "updating firmware",
}  # fmt: skip
_STATES = {0: "is stopping", 1: "stopped", 2: "runs", 3: "is pausing", 4: "is paused", 5: "is resuming"}
_STOPS: tuple[tuple[int, type[faults.ArmFault], str], ...] = (
    (1 << 5 | 1 << 6 | 1 << 7, faults.EmergencyStop, "emergency stop"),
    (1 << 8, faults.SafetyStop, "safety violation"),
    (1 << 9, faults.SafetyStop, "safety fault"),
    (1 << 2, faults.ProtectiveStop, "protective stop"),
    (1 << 4, faults.SafetyStop, "safeguard stop"),
    (1 << 3, faults.SafetyStop, "recovery mode"),
    (1 << 10, faults.SafetyStop, "stopped for safety"),
)

Value = float | tuple[float, ...]


def package(kind: int, payload: bytes = b"") -> bytes:
    """Put a header before a payload of at most 65532 bytes."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class Splitter:
    """Cuts a stream, which joins and splits packages as it likes, back into packages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Take bytes, yield (kind, payload) of every complete package; raises DeviceError when this is no RTDE."""
        self._buffer += data
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                raise DeviceError(f"RTDE: expected a package of 3 bytes or more, got size {size}")
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[_HEADER.size : size])
            del self._buffer[:size]
            yield kind, payload


class Recipe:
    """A fixed list of variables and their RTDE types, as agreed at setup; raises DeviceError for an unknown type."""

    def __init__(self, names: Sequence[str], types: Sequence[str]) -> None:
        unknown = sorted({t for t in types if t not in _LAYOUT})
        if unknown or len(names) != len(types):
            raise DeviceError(f"RTDE: expected a known type for each of {len(names)} variables, got {types}")
        self.names = tuple(names)
        self._counts = [int(_LAYOUT[t][:-1] or 1) for t in types]
        self.layout = struct.Struct(">" + "".join(_LAYOUT[t] for t in types))

    def unpack(self, data: bytes) -> dict[str, Value]:
        """Turn bytes into values by name: numbers, or tuples for vectors. Raises DeviceError for another size."""
        if len(data) != self.layout.size:
            raise DeviceError(f"RTDE: expected {self.layout.size} bytes of data, got {len(data)}")
        flat = iter(self.layout.unpack(data))
        taken = [tuple(next(flat) for _ in range(count)) for count in self._counts]
        return {n: t if len(t) > 1 else t[0] for n, t in zip(self.names, taken, strict=True)}


def split_names(payload: bytes) -> list[str]:
    """Names of a comma-separated list; empty ones, as after a trailing comma, are dropped."""
    return [name for name in payload.decode("ascii", "replace").split(",") if name]


def danger(bits: int, mode: int) -> faults.ArmFault | None:
    """Name what stands in the way of motion, by ``safety_status_bits`` and ``robot_mode``; the gravest state first."""
    for mask, kind, name in _STOPS:
        if bits & mask:
            return kind(f"the controller reports: {name}")
    if mode != _RUNNING:
        return faults.NotReady(f"the arm is not running: {_MODES.get(mode, f'mode {mode}')}")
    return None


def halted(runtime: int) -> faults.ArmFault | None:
    """Name what is wrong with the control script, by ``runtime_state``."""
    return None if runtime == PLAYING else faults.ProgramStopped(f"the control script {state(runtime)}")


def state(runtime: int) -> str:
    """Say in words what a program does, by ``runtime_state``."""
    return _STATES.get(runtime, f"is in state {runtime}")


RATE = 125.0  # Hz; more costs CPU and gains nothing for an arm that stands still when it matters
_STALE = 1.0  # s without a newer sample
_BLIND = 0.3  # s without a newer sample, after which a moving arm's watchdog is not fed
_STARTED = 2.0  # s for the running script to show in the data
_REASON = 0.5  # s to wait for the cause of a refused command to show
_VARIABLES = (
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "robot_mode", "safety_status_bits", "runtime_state",
)  # fmt: skip


class Link(limits.Link):
    """Both connections of the library to the controller at ``host``; with ``scaling`` it reports its speed slider.

    Raises :class:`ConfigError`: the library is not installed; :class:`NotReady`, :class:`ControllerSilent`:
    it cannot connect, or another client has the registers.
    """

    def __init__(self, host: str, *, scaling: bool) -> None:
        self._host, self._scaling = host, scaling
        self._lock = threading.Lock()
        self._busy: tuple[str, float] | None = None  # what runs, and until when it may
        self._newest, self._seen = -1.0, time.monotonic()
        self._receive, self._control = _connect(host, [*_VARIABLES, *(["speed_scaling"] if scaling else [])])

    def command(self, name: str, limit: float, *args: Any) -> Any:
        """Call a method of the control interface; :meth:`overdue` tells when it takes more than ``limit`` seconds."""
        with self._lock:
            self._busy = (name, time.monotonic() + limit)
            try:
                return getattr(self._control, name)(*args)
            except (RuntimeError, ValueError) as err:
                raise faults.ControllerSilent(f"{self._host}: {name}: {err}") from err
            finally:
                self._busy = None

    def kick(self) -> None:
        """Feed the watchdog, unless a command does so just now; raises faults.ArmFault when the controller refuses."""
        if not self._lock.locked() and not self.command("kickWatchdog", 3.0):
            raise self.reason("kickWatchdog")

    def kick_seeing(self) -> None:
        """Feed the watchdog of a moving arm: only while its data are new, else it shall stop."""
        if self.seeing and not self.command("kickWatchdog", 3.0):
            raise self.reason("kickWatchdog")

    def started(self) -> None:
        """Wait until the running script shows in the data, which are older than the script's start at first."""
        end = time.monotonic() + _STARTED
        while not self.playing and time.monotonic() < end:
            time.sleep(0.005)

    def overdue(self) -> faults.ArmFault | None:
        """The command that runs too long, if there is one."""
        busy = self._busy
        if busy is None or time.monotonic() < busy[1]:
            return None
        if not self._receive.isConnected():  # the library may wait for the answer all the same
            return self._lost()
        return faults.ControllerSilent(f"{self._host}: {busy[0]} is not answered")

    def _lost(self) -> faults.LinkLost:
        return faults.LinkLost(f"{self._host}: the connection broke")

    def trouble(self) -> faults.ArmFault | None:
        """Find what is wrong now: link, age of the data, safety, script."""
        stamp = self._receive.getTimestamp()
        now = time.monotonic()
        if stamp != self._newest:
            self._newest, self._seen = stamp, now
        if not self._receive.isConnected():
            return self._lost()
        if now - self._seen > _STALE:
            return faults.StaleData(f"{self._host}: no newer data for {now - self._seen:.1f} s")
        return danger(self._receive.getSafetyStatusBits(), self._receive.getRobotMode()) or halted(
            self._receive.getRuntimeState()
        )

    def reason(self, refused: str) -> faults.ArmFault:
        """Find why a command was refused: the state that shows within half a second."""
        end = time.monotonic() + _REASON
        while time.monotonic() < end:
            if (fault := self.trouble()) is not None:
                return fault
            time.sleep(0.01)
        return faults.ProgramStopped(f"{self._host}: the controller refused {refused} and gives no reason")

    def sample(self) -> Sample:
        """Read what the controller says; raises ArmFault for :meth:`trouble`, and for values that are no numbers."""
        if (fault := self.trouble()) is not None:
            raise fault
        receive = self._receive
        stamp = float(receive.getTimestamp())
        scaling = float(receive.getSpeedScaling()) if self._scaling else 1.0
        measured = receive.getActualQ(), receive.getActualQd(), receive.getActualTCPPose()
        joints, speeds, pose = (np.array(values, dtype=np.float64) for values in measured)
        if not all(a.shape == (6,) and np.isfinite(a).all() for a in (joints, speeds, pose)):
            raise faults.StaleData(f"{self._host}: the measured joints are no numbers: {joints.tolist()}")
        # A controller at rest may say 0: the slider is not at zero while a program plays.
        return Sample(stamp, joints, speeds, pose, scaling if 0.01 <= scaling <= 1 else 1.0)

    @property
    def seeing(self) -> bool:
        """The data are new, as of the last look."""
        return time.monotonic() - self._seen < _BLIND

    @property
    def playing(self) -> bool:
        """The control script runs."""
        return bool(self._receive.getRuntimeState() == PLAYING)


def _connect(host: str, variables: list[str]) -> tuple[Any, Any]:
    try:
        import rtde_control
        import rtde_receive
    except ImportError as err:
        raise ConfigError(
            f"the ur_rtde library does not load: {err}", hint="pip install 'tofcapture[ur]'"
        ) from err
    # A constructor that hangs cannot be asked where; this is what the station then finds.
    print(
        f"ur_rtde connects to {host}; a controller that falls silent now hangs it",
        file=sys.stderr,
        flush=True,
    )
    try:
        receive = rtde_receive.RTDEReceiveInterface(host, RATE, variables)
        control = rtde_control.RTDEControlInterface(host, RATE)
    except RuntimeError as err:
        raise _translated(host, str(err)) from err
    return receive, control


def _translated(host: str, text: str) -> faults.ArmFault:
    """Turn the library's sentences into states."""
    if "already in use" in text:
        return faults.NotReady(
            f"{host}: another client commands the controller: {text}",
            hint="stop the other program; disable EtherNet/IP, PROFINET and Modbus if they hold registers",
        )
    if "remote control" in text:
        return faults.NotReady(f"{host}: the controller is in local control")
    if "control script" in text:
        return faults.ProgramStopped(f"{host}: {text}")
    return faults.ControllerSilent(f"{host}: {text}")
