"""Devices: one protocol for each role, drivers found by entry point, one station that opens them.

A driver subclasses the protocol of its role, which does what a device may leave out. Its constructor does no I/O,
``__enter__`` opens, ``__exit__`` closes, ``describe`` answers without opening. Nobody names a concrete driver but
``devices.registry``.
"""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from tofcapture.errors import DeviceError
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from tofcapture.devices.kinematics import ArmModel
    from tofcapture.rig import Rig


class Device(Protocol):
    """The part that all devices share. Every method has a default."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def probe(self) -> str:
        """Tell whether the device is there, without opening or disturbing it.

        Returns what was found, empty when the device cannot be asked.

        Raises :class:`DeviceError`: it is not there, or not ready.
        """
        return ""

    def watch(self, silence: float) -> None:
        """Look after the open device; a driver host calls this a few times a second from another thread.

        ``silence`` are the seconds since the station's process gave a sign of life.

        Raises :class:`ArmFault`: something is wrong: the host then reports this, and ends the driver.
        """
        del silence


class Arm(Device, Protocol):
    """A robot arm that carries the rig."""

    @property
    def simulated(self) -> bool:
        """Nothing moves that could hurt anyone. A real arm moves only in a run that allows it."""
        return False

    @property
    def by_hand(self) -> bool:
        """A person carries the rig: no motors, no joints (NaN), no plan; the recorder calls ``await_view``."""
        return False

    @property
    def fixed(self) -> bool:
        """The rig stands in one place, as on a tripod; only the object is turned."""
        return False

    def await_view(self, index: int) -> ArmState:
        """Return when a person has brought the rig to another view and it stands still; only where ``by_hand``.

        Raises :class:`MotionStopped`: somebody said stop, or nobody did it in time: the view is taken when
        the scene is asked for again.
        """
        raise DeviceError(f"view {index}: this arm moves by itself", hint="call move_to")

    def describe(self) -> ArmInfo:
        """Say what this arm is, without opening it."""
        ...

    def kinematics(self) -> ArmModel:
        """Give the arm's geometry, without opening it; here that of a known ``model``.

        Raises :class:`ConfigError`: it is not known: a table ``[arm.kinematics]`` of the station must give
        it.
        """
        from tofcapture.devices.kinematics import arm_model

        return arm_model(self.describe().model)

    def check_move(self, start: Float64, goal: Float64) -> None:
        """Check a straight motion in joint space, (J,) to (J,) radians, as ``move_to`` will; nothing moves.

        Plans are made, and dry runs proved, with it. An arm that takes any motion leaves it out.

        Raises :class:`MotionRefused`: ``move_to(goal)`` would refuse, were the arm at ``start``.
        """
        del start, goal

    def cautions(self) -> list[str]:
        """Say in sentences which protection is switched off; every run prints them."""
        return []

    def equip(self, rig: Rig) -> None:
        """Hear what the arm carries, once after opening; for arms that check their own way."""
        del rig

    def state(self) -> ArmState:
        """Measure the joints now."""
        ...

    def move_to(self, joints: Float64) -> ArmState:
        """Move to joint angles (J,) in radians, wait until settled, return the measured state.

        Raises :class:`MotionRefused`: the goal is outside the limits or the arm refuses.
        """
        ...

    def stop(self) -> None:
        """Stop moving now; safe at any time, before opening and after closing too.

        A stop holds: ``move_to`` raises :class:`MotionStopped` until ``resume``, or until the arm is opened again.
        """
        ...

    def interrupt(self) -> None:
        """Make a running ``move_to`` of another thread stop; a driver host calls this before a queued ``stop``."""
        return

    def resume(self) -> None:
        """Let the arm move again after a stop. Only an operator's word is a reason to call this."""
        return


class TofCamera(Device, Protocol):
    """A time-of-flight camera that gives raw phase images."""

    def describe(self) -> TofInfo:
        """Say what this camera is, without opening it."""
        ...

    def capture(self, frames: int) -> TofBurst:
        """Take a burst of ``frames`` static frames."""
        ...


class StereoDevice(Device, Protocol):
    """A stereo camera that gives organised point maps."""

    def describe(self) -> StereoInfo:
        """Say what this camera is, without opening it."""
        ...

    def capture(self) -> StereoFrame:
        """Take one point map."""
        ...


class Operator(Device, Protocol):
    """An operator puts the scene on the table: a person at the console, or the simulator."""

    @property
    def person(self) -> bool:
        """A person is asked, so that a program may ask in its own way instead."""
        return False

    @property
    def can_turn(self) -> bool:
        """``turn`` works."""
        return False

    def place(self, scene: str) -> None:
        """Return when ``scene`` stands on the table. Idempotent."""
        ...

    def turn(self, scene: str, angle: float) -> None:
        """Return when the scene is turned about the vertical, counter-clockwise seen from above, radians from how it stood first.

        Raises :class:`DeviceError`: nobody can turn it.
        """
        raise DeviceError(f"nobody can turn {scene!r} by {angle:.2f} rad", hint="record without --turns")

    def tell(self, text: str) -> None:
        """Tell a person who carries the rig what to do next; nobody need answer."""
        del text

    def truth(self) -> Truth | None:
        """Tell what is exactly true of the view from the present pose; ``None`` in the real world."""
        return None
