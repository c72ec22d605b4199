"""The person at the terminal, who puts scenes on the table when asked."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TextIO

from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import Truth

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext


class ConsoleOperator:
    """Asks on stderr, waits for Enter on stdin.

    Parameters
    ----------
    table
        Empty.
    context
        The station; not needed.
    ask, answer
        Where to ask and to listen; the terminal unless a test says otherwise.
    """

    def __init__(
        self,
        table: Mapping[str, Any],
        context: StationContext,
        ask: TextIO | None = None,
        answer: TextIO | None = None,
    ) -> None:
        del context
        if table:
            raise ConfigError(f"[operator] console takes no settings, got {', '.join(sorted(table))}")
        self._ask, self._answer = ask, answer
        self._placed: str | None = None

    def place(self, scene: str) -> None:
        """Ask for a scene and wait until it stands; asks once for each change.

        Raises
        ------
        DeviceError
            Nobody can answer: the input is not a terminal, or has ended.
        """
        if scene == self._placed:
            return
        self._wait(f"Put {scene!r} on the table", scene)
        self._placed = scene

    def _wait(self, wish: str, scene: str) -> None:
        """Ask, and return when Enter was pressed."""
        ask, answer = self._ask or sys.stderr, self._answer or sys.stdin
        if self._answer is None and not answer.isatty():
            raise DeviceError(f"nobody is at the console to place {scene!r}", hint="run it in a terminal")
        print(f"{wish}, step out of the arm's reach, press Enter.", file=ask, flush=True)
        if not answer.readline():
            raise DeviceError(f"the console's input ended before {scene!r} was placed")

    def turn(self, scene: str, angle: float) -> None:
        """Ask for the scene to be turned about the vertical, and wait until it is.

        Parameters
        ----------
        scene
            Its name.
        angle
            From how it stood first, counter-clockwise seen from above, radians.

        Raises
        ------
        DeviceError
            Nobody can answer.
        """
        self._wait(
            f"Turn {scene!r} to {math.degrees(angle):.0f} deg, counter-clockwise from how it stood first",
            scene,
        )

    def truth(self) -> Truth | None:
        """Nobody knows the real world exactly."""
        return None


DRIVERS = {"operator": ConsoleOperator}
