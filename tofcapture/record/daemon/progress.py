"""How far the job in hand is: put together from what the recorder tells."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any


class Progress:
    """Views of one job and what is being done to them."""

    def __init__(self) -> None:
        self.job: int | None = None
        self.views: dict[int, dict[str, Any]] = {}
        self.doing: dict[str, Any] | None = None
        self.asks: str | None = None
        self.simulated: bool | None = None
        self.resting = False
        self.sealed_now = 0
        self._since = 0.0

    def begin(self, job: int) -> None:
        """Forget the job before; a job that goes on after a crash keeps its table until the new plan comes."""
        if job != self.job:
            self.views = {}
        self.job, self.doing, self.asks, self.resting = job, None, None, False
        self.sealed_now, self.simulated = 0, None

    def end(self) -> None:
        """Nothing is being done any more."""
        self.doing, self.asks, self.resting = None, None, False

    def hear(self, message: Mapping[str, Any]) -> None:
        """Take in one message of the recorder."""
        handle = getattr(self, f"_hear_{message['kind']}", None)
        if handle is not None:
            handle(message)

    def _hear_opened(self, message: Mapping[str, Any]) -> None:
        self.simulated = bool(message["simulated"])

    def _hear_planned(self, message: Mapping[str, Any]) -> None:
        before = self.views
        # What was measured of a view before the recorder was started anew still holds.
        self.views = {v["index"]: {**before.get(v["index"], {}), **v} for v in message["views"]}
        self._since = time.monotonic()

    def _hear_step(self, message: Mapping[str, Any]) -> None:
        if message["step"] != "failed":
            self.doing = {"index": message["index"], "step": message["step"]}

    def _hear_sealed(self, message: Mapping[str, Any]) -> None:
        self._view(message, state="sealed", quality=message["quality"], sha256=message["sha256"])
        self.sealed_now += 1
        self.doing = None

    def _hear_failed(self, message: Mapping[str, Any]) -> None:
        self._view(message, state="failed", reason=message["reason"])
        self.doing = None

    def _hear_ask(self, message: Mapping[str, Any]) -> None:
        self.asks = str(message["scene"])

    def _hear_answered(self, message: Mapping[str, Any]) -> None:
        del message
        self.asks = None

    def _hear_paused(self, message: Mapping[str, Any]) -> None:
        del message
        self.resting, self.doing = True, None

    def _hear_resumed(self, message: Mapping[str, Any]) -> None:
        del message
        self.resting = False

    def _view(self, message: Mapping[str, Any], **found: Any) -> None:
        self.views.setdefault(message["index"], {"index": message["index"]}).update(found)

    def counts(self) -> dict[str, Any]:
        """Views sealed, failed and planned in all; seconds left at the present pace."""
        states = [v.get("state") for v in self.views.values()]
        done, failed = states.count("sealed"), states.count("failed")
        pace = (time.monotonic() - self._since) / self.sealed_now if self.sealed_now else None
        left = len(states) - done - failed
        return {
            "sealed": done,
            "failed": failed,
            "total": len(states),
            "eta_s": round(pace * left, 1) if pace is not None and not self.resting else None,
        }

    def table(self) -> dict[str, Any]:
        """All views, JSON types."""
        return {"job": self.job, "views": [self.views[i] for i in sorted(self.views)]}
