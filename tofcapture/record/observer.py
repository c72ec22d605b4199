"""Define who looks on while the recorder works, and may make it wait or end."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tofcapture.errors import TofError

if TYPE_CHECKING:
    from tofcapture.frames import View
    from tofcapture.record.plan import Plan

STEPS = ("moving", "tof", "stereo", "sealing")
"""What is done for a view, in this order; the journal holds the step before the step begins."""


class Stopped(TofError):  # noqa: N818  nothing is wrong
    """Somebody asked the recorder to end; the view in hand is rolled back, the others stay."""

    exit_code = 130


class Observer:
    """Look on and let everything happen; override what you need.

    Every method is called by the recorder's own thread. ``before_view`` and ``step`` may wait, and may raise
    :class:`Stopped`.
    """

    def planned(self, plan: Plan, kept: set[int], repaired: list[str]) -> None:
        """Hear the plan, the views that are there already, and what was put right."""

    def before_view(self, index: int) -> None:
        """Wait here to pause: the arm rests and nothing is half done."""

    def step(self, index: int, step: str) -> None:
        """Hear that one of :data:`STEPS` is about to begin, or that the view has just ``"failed"``."""

    def sealed(self, view: View, sha256: str) -> None:
        """Hear that a view is on disk under its name, and in the journal."""

    def failed(self, index: int, reason: str) -> None:
        """Hear that a view was given up."""
