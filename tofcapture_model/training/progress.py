"""Progress on stderr: a bar on a terminal, a plain line now and then elsewhere; both with the time that is left."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

PLAIN_EVERY = 10.0  # s


class Report(Protocol):
    """Tell how far a task is."""

    def __call__(self, what: str, fraction: float, text: str = "", /) -> None:
        """Show that ``what`` is done to this fraction."""


def remaining(seconds: float, done: float, fraction: float) -> str:
    """Estimate the time left, from the time spent on a part ``done`` of the whole and the fraction that is done by now."""
    if done <= 0:
        return "time left unknown"
    left = seconds * (1 - fraction) / done
    return f"{left / 60:.0f} min left" if left > 90 else f"{left:.0f} s left"


def _plain() -> Report:
    first: dict[str, tuple[float, float]] = {}  # a run that goes on does not start at zero
    last = [0.0]

    def report(what: str, fraction: float, text: str = "", /) -> None:
        now = time.monotonic()
        started, before = first.setdefault(what, (now, fraction))
        if now - last[0] >= PLAIN_EVERY or fraction >= 1:
            last[0] = now
            left = remaining(now - started, fraction - before, fraction)
            print(f"{what}: {100 * fraction:.0f} %, {left} {text}".rstrip(), file=sys.stderr)

    return report


@contextmanager
def progress() -> Iterator[Report]:
    """Open a progress display for the duration of a command."""
    if not sys.stderr.isatty():
        yield _plain()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, TaskID] = {}

        def report(what: str, fraction: float, text: str = "", /) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0, text="")
            bar.update(tasks[what], completed=fraction, text=text)

        yield report
