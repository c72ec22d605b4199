"""A real arm that nobody allowed to move."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from tofcapture.devices import Arm
from tofcapture.errors import MotionRefused
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.poses import Float64


class StillArm:
    """Everything that an arm does but move.

    Parameters
    ----------
    arm
        The open arm behind it.
    """

    simulated = False

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def describe(self) -> ArmInfo:
        """Say what this arm is."""
        return self._arm.describe()

    def state(self) -> ArmState:
        """Measure the joints now."""
        return self._arm.state()

    def move_to(self, joints: Float64) -> ArmState:
        """Refuse.

        Raises
        ------
        MotionRefused
            Always.
        """
        del joints
        raise MotionRefused(
            f"the arm {self.describe().model} is real and motion was not allowed in this run",
            hint="look at --dry-run, clear the workspace, then add --allow-motion",
        )

    def stop(self) -> None:
        """Stop moving now."""
        self._arm.stop()
