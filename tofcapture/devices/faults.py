"""States in which an arm or a driver's process cannot go on, each a named error that says what the operator must do.

Nothing leaves such a state by itself: the device raises the same error until the station is opened anew. So does a stop on
request, which every layer that hears one keeps in a :class:`StopLatch`.
"""

from __future__ import annotations

from tofcapture.errors import DeviceError, MotionStopped


class ArmFault(DeviceError):  # noqa: N818  a state of the arm
    """The arm needs a person; the hint is the state's own ``remedy`` unless given."""

    remedy = "look at the arm before anything else, then start again"

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message, hint or self.remedy)


class ProtectiveStop(ArmFault):
    """The controller stopped the arm: it hit something, or its limits."""

    remedy = (
        "look for what it hit; on the pendant, after 5 s, acknowledge the protective stop; then start again"
    )


class EmergencyStop(ArmFault):
    """Somebody pressed an emergency stop."""

    remedy = "find out why; release the button, switch the arm on and release its brakes on the pendant; then start again"


class SafetyStop(ArmFault):
    """Safeguard stop, safety violation or fault, recovery mode."""

    remedy = (
        "read the pendant's log; clear the safeguard or restart the safety system there; then start again"
    )


class NotReady(ArmFault):
    """The controller is there, but not as it must be: power, remote control, model, serial number."""

    remedy = "power on, release the brakes and choose remote control on the pendant; then start again"


class ControllerSilent(ArmFault):
    """The controller does not answer, or stops answering half-way."""

    remedy = "check address, cable and that the controller has booted; is another program connected to it? Then start again"


class LinkLost(ArmFault):
    """The connection to the controller broke."""

    remedy = "the arm has been stopped by its watchdog; check the cable and the switch; then start again"


class StaleData(ArmFault):
    """The controller is connected, but what it says is old or no number."""

    remedy = "the arm has been stopped by its watchdog; restart the controller if it happens again; then start again"


class ProgramStopped(ArmFault):
    """The control script on the controller ended or was paused."""

    remedy = "close the message on the pendant, stop other programs, choose remote control; then start again"


class HostLost(ArmFault):
    """The process that holds the vendor's library died, hung, or fell silent; it has been killed."""

    remedy = "see the last words of the driver above; if it happens again, report them; then start again"


class NotSettled(DeviceError):  # noqa: N818  a state of the arm
    """The arm arrived but does not come to rest."""


class StopLatch:
    """A stop, from the moment it is heard until the operator resumes; for any number of threads, and in signal handlers.

    A move takes a token before it begins, and asks with it as it goes on: a stop that was heard since counts, even if a
    resume has followed.
    """

    def __init__(self) -> None:
        self._heard = self._lifted = object()

    def stop(self) -> None:
        """Hear a stop."""
        self._heard = object()

    def resume(self, token: object) -> None:
        """Lift the stops that were heard before the token was taken."""
        self._lifted = token

    @property
    def token(self) -> object:
        """What stands for all stops until now."""
        return self._heard

    def stopped(self, token: object) -> bool:
        """Tell whether a move with this token must not begin, or not go on."""
        return self._heard is not token or self._lifted is not token

    def check(self, token: object) -> None:
        """Raise MotionStopped if :meth:`stopped`."""
        if self.stopped(token):
            raise MotionStopped(
                "the motion was stopped on request",
                hint="find out why; then run again, or call resume() of the arm",
            )
