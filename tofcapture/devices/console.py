"""The person at the terminal, who puts scenes on the table when asked."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

from tofcapture.devices import Operator
from tofcapture.devices.registry import check_keys
from tofcapture.errors import DeviceError

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext


class ConsoleOperator(Operator):
    """Asks on stderr, waits for Enter on stdin, unless ``ask`` and ``answer`` are given; its ``table`` is empty."""

    person = True
    can_turn = True

    def __init__(
        self,
        table: Mapping[str, Any],
        context: StationContext,
        ask: TextIO | None = None,
        answer: TextIO | None = None,
    ) -> None:
        del context
        check_keys(table, (), "[operator] console")
        self._ask, self._answer = ask, answer
        self._placed: str | None = None

    def place(self, scene: str) -> None:
        """Ask for a scene and wait until it stands; asks once for each change.

        Raises :class:`DeviceError`: nobody can answer: the input is not a terminal, or has ended.
        """
        if scene == self._placed:
            return
        self._wait(f"Put {scene!r} on the table", scene)
        self._placed = scene

    def turn(self, scene: str, angle: float) -> None:
        """Ask for the scene to be turned, and wait until it is; see :class:`Operator`."""
        degrees = math.degrees(angle)
        self._wait(f"Turn {scene!r} to {degrees:.0f} deg, counter-clockwise from how it stood first", scene)

    def tell(self, text: str) -> None:
        """Print, and ring: who carries a rig looks elsewhere."""
        print(f"\a{text}", file=self._ask or sys.stderr, flush=True)

    def _wait(self, request: str, scene: str) -> None:
        """Ask, and return when Enter was pressed."""
        ask, answer = self._ask or sys.stderr, self._answer or sys.stdin
        if self._answer is None and not answer.isatty():
            raise DeviceError(f"nobody is at the console to place {scene!r}", hint="run it in a terminal")
        print(f"{request}, step out of the arm's reach, press Enter.", file=ask, flush=True)
        if not answer.readline():
            raise DeviceError(f"the console's input ended before {scene!r} was placed")


DRIVERS = {"operator": ConsoleOperator}
