"""Drivers that hang, crash and hold Python's lock on demand, to test what surrounds drivers."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices import Arm, TofCamera
from tofcapture.devices.faults import ProtectiveStop
from tofcapture.errors import DeviceError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState, TofBurst, TofInfo
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_CAMERA = Camera(120, 90, 100.0, 100.0, 59.5, 44.5)
_FOREVER = 1000


def misbehave(how: str) -> None:
    """Do something that a vendor's library does on a bad day.

    Parameters
    ----------
    how
        ``hang``, ``hang holding the lock``, ``crash``, ``exit``, ``raise``, ``fault``, ``refuse``, ``print``; empty for nothing.
    """
    if how == "hang":
        time.sleep(_FOREVER)
    elif how == "hang holding the lock":
        ctypes.PyDLL(None).sleep(_FOREVER)
    elif how == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    elif how == "exit":
        os._exit(3)
    elif how == "raise":
        raise LookupError("VENDOR_STATUS_17")
    elif how == "fault":
        raise ProtectiveStop("the controller reports: protective stop")
    elif how == "refuse":
        raise DeviceError("the lens cap is on", hint="take it off")
    elif how == "print":
        print("vendor says hello")
        sys.stdout.flush()
        os._exit(4)


class Camera17(TofCamera):
    """A ToF camera that misbehaves.

    Parameters
    ----------
    table
        ``open`` and ``expose``: what :func:`misbehave` does there; ``once``: a file that is made the first time, after which
        the camera behaves.
    context
        Not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        self._table = table

    def describe(self) -> TofInfo:
        """Say what this camera is."""
        return TofInfo("misbehaving", "17", _CAMERA, np.zeros(3))

    def __enter__(self) -> Self:
        misbehave(self._table.get("open", ""))
        return self

    def capture(self, frames: int) -> TofBurst:
        """Take a burst, or not."""
        once = Path(self._table["once"]) if "once" in self._table else None
        if once is None or not once.exists():
            if once is not None:
                once.touch()
            misbehave(self._table.get("expose", ""))
        raw = np.random.default_rng(frames).integers(0, 4096, (frames, 8, 90, 120), dtype=np.uint16)
        return TofBurst(raw, np.arange(frames), np.full(frames, np.nan), self.describe())


class Arm17(Arm):
    """An arm that takes long, can be interrupted, and misbehaves.

    Parameters
    ----------
    table
        ``move``: what :func:`misbehave` does in ``move_to``; ``seconds``: how long a move takes; ``moving``: a file that
        is made when it begins.
    context
        Not needed.
    """

    simulated = True

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        self._table = table
        self._joints: Float64 = np.zeros(6)
        self._stop = threading.Event()

    def describe(self) -> ArmInfo:
        """Say what this arm is."""
        return ArmInfo("ur10e", "17")

    def state(self) -> ArmState:
        """Say where it was sent."""
        return ArmState(self._joints, np.eye(4), time.monotonic_ns())

    def move_to(self, joints: Float64) -> ArmState:
        """Take a while."""
        misbehave(self._table.get("move", ""))
        self._stop.clear()
        if "moving" in self._table:
            Path(self._table["moving"]).touch()
        if self._stop.wait(float(self._table.get("seconds", 0.0))):
            raise MotionRefused("the motion was stopped on request")
        self._joints = joints
        return self.state()

    def interrupt(self) -> None:
        """End a move of another thread."""
        self._stop.set()

    def stop(self) -> None:
        """Stop."""
