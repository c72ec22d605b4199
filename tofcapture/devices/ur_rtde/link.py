"""The ``ur_rtde`` library, used so that its faults stay bounded.

Known of version 1.6: it never recovers a lost link (it reconnects in an endless loop and uploads its script again and
again), so a lost link ends this process. Getters return old values after a loss, so the age of data is judged by the
controller's own clock. ``stopJ`` called asynchronously changes what later synchronous calls do, so it never is.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcapture.devices import faults
from tofcapture.devices.ur_rtde.wire import PLAYING, danger, halted
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

RATE = 125.0  # Hz; more costs CPU and gains nothing for an arm that stands still when it matters
_STALE = 1.0  # s without a newer sample
_BLIND = 0.3  # s without a newer sample, after which a moving arm's watchdog is not fed
_STARTED = 2.0  # s for the running script to show in the data
_REASON = 0.5  # s to wait for the cause of a refused command to show
_VARIABLES = (
    "timestamp", "actual_q", "actual_qd", "actual_TCP_pose", "robot_mode", "safety_status_bits", "runtime_state",
)  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """One reading."""

    timestamp: float  # controller's clock, s
    joints: Float64  # (6,) measured, rad
    speeds: Float64  # (6,) measured, rad/s
    pose: Float64  # (6,) of the active TCP, m and rad
    scaling: float  # speed slider, 0 to 1


class Link:
    """Both connections of the library to the controller at ``host``; with ``scaling`` it reports its speed slider.

    Raises
    ------
    ConfigError
        The library is not installed.
    NotReady, ControllerSilent
        It cannot connect, or another client has the registers.
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
        return faults.ControllerSilent(f"{self._host}: {busy[0]} is not answered")

    def trouble(self) -> faults.ArmFault | None:
        """Find what is wrong now: link, age of the data, safety, script."""
        stamp = self._receive.getTimestamp()
        now = time.monotonic()
        if stamp != self._newest:
            self._newest, self._seen = stamp, now
        if not self._receive.isConnected():
            return faults.LinkLost(f"{self._host}: the connection broke")
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

    def fresh(self) -> Sample:
        """Wait for a sample that was measured after this call: the second new one."""
        stamps = {self._receive.getTimestamp()}
        while True:
            sample = self.sample()
            stamps.add(sample.timestamp)
            if len(stamps) > 2:
                return sample
            time.sleep(0.002)

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
            f"the ur_rtde library does not load: {err}", hint="pip install 'tofcapture[hardware]'"
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
