"""What goes wrong on demand.

A fault is put in by a line of JSON to the control port, or by a call in a test: ``{"do": "protective_stop", "share": 0.5}``
comes when half of the next move is done. ``{"do": "lift"}`` takes everything out again, as an operator would.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# Where the controller can fall silent: after accepting RTDE, at each RTDE package, at the dashboard, at the script.
STAGES = (
    "connect", "V", "v", "O", "I", "S", "U", "banner", "dashboard", "script", "ready", "done",
)  # fmt: skip
TIMED = ("protective_stop", "emergency_stop", "script_death", "drop", "freeze", "nan")


class Faults:
    """Present and coming faults.

    Attributes
    ----------
    speed
        Speed slider, 0 to 1.
    haste
        How many times faster than the clock the arm moves: for whole plans.
    delay
        Seconds by which every answer is late.
    frozen
        Data packages stop; the connections stay open.
    spoiled
        Joint angles are reported as NaN.
    denies
        Every pose is outside the safety limits.
    lacking
        Outputs that this controller does not have, as older ones do not.
    """

    def __init__(self) -> None:
        self.on_drop: Callable[[], None] = lambda: None
        self._clear()

    def _clear(self) -> None:
        self.speed, self.delay, self.haste = 1.0, 0.0, 1.0
        self.frozen = self.spoiled = self.denies = False
        self.lacking: frozenset[str] = frozenset()
        self._silent: dict[str, int] = {}  # stage -> how many times it still answers
        self._coming: dict[str, float] = {}  # fault -> part of the move at which it comes; negative: now

    def silent(self, stage: str) -> bool:
        """Tell whether the controller keeps quiet at this stage; counts how often it was asked."""
        if stage not in self._silent:
            return False
        self._silent[stage] -= 1
        return self._silent[stage] < 0

    def due(self, share: float | None) -> list[str]:
        """Take out the faults whose time has come; ``share`` of the move is done, ``None`` when nothing moves."""
        names = [n for n, at in self._coming.items() if at < 0 or (share is not None and share >= at)]
        for name in names:
            del self._coming[name]
        return names

    def drop_links(self) -> None:
        """Cut every RTDE connection."""
        self.on_drop()

    def freeze(self) -> None:
        """Send no more data, and keep the connections open."""
        self.frozen = True

    def spoil(self) -> None:
        """Report joints that are no numbers."""
        self.spoiled = True

    def apply(self, order: dict[str, Any]) -> str:
        """Put a fault in, or take all out.

        Returns
        -------
        str
            Empty, or what is wrong with the order.
        """
        what = order.get("do")
        if what == "lift":
            self._clear()
        elif what == "mute" and order.get("stage") in STAGES:
            self._silent[order["stage"]] = int(order.get("skip", 0))
        elif what == "slow":
            self.speed, self.delay = float(order.get("speed", 1.0)), float(order.get("delay", 0.0))
        elif what == "lack":
            self.lacking = frozenset(map(str, order["names"]))
        elif what == "deny":
            self.denies = True
        elif what == "haste":
            self.haste = float(order["factor"])
        elif what in TIMED:
            self._coming[what] = float(order.get("share", -1.0))
        else:
            return f"expected do = lift, mute with a stage of {STAGES}, slow, haste, lack, deny or one of {TIMED}, got {order}"
        return ""
