"""Devices: small protocols, drivers found by entry point, one station that opens them.

A driver is a plain class; it inherits nothing. Its constructor does no I/O, ``__enter__`` opens, ``__exit__`` closes,
``describe`` answers without opening, every verb is idempotent or says that it is not. Nobody names a concrete driver but
``devices.registry``.
"""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.poses import Float64


class Device(Protocol):
    """What all devices share: they open and close as context managers."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Arm(Device, Protocol):
    """A robot arm that carries the rig."""

    def describe(self) -> ArmInfo:
        """Say what this arm is, without opening it."""

    def state(self) -> ArmState:
        """Measure the joints now."""

    def move_to(self, joints: Float64) -> ArmState:
        """Move to joint angles (6,) in radians, wait until settled, return the measured state.

        Raises
        ------
        MotionRefused
            The goal is outside the limits or the arm refuses.
        """

    def stop(self) -> None:
        """Stop moving now; safe at any time."""


class TofCamera(Device, Protocol):
    """A time-of-flight camera that gives raw phase images."""

    def describe(self) -> TofInfo:
        """Say what this camera is, without opening it."""

    def capture(self, frames: int) -> TofBurst:
        """Take a burst of ``frames`` static frames."""


class StereoDevice(Device, Protocol):
    """A stereo camera that gives organised point maps."""

    def describe(self) -> StereoInfo:
        """Say what this camera is, without opening it."""

    def capture(self) -> StereoFrame:
        """Take one point map."""


class Operator(Protocol):
    """Who puts the scene on the table: a person at the console, or the simulator."""

    def place(self, scene: str) -> None:
        """Return when ``scene`` stands on the table. Idempotent."""

    def truth(self) -> Truth | None:
        """What is exactly true of the view from the present pose; ``None`` in the real world."""
