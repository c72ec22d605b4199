"""Define what every command shares: what a command is, progress with the time left, tables of a fixed form, results as JSON files.

Every package adds its commands through the entry-point group ``tofcapture.commands``. Each entry point names one :class:`Command`.
Its module is light to import: heavy libraries are imported inside ``run``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol


@dataclass(frozen=True)
class Outcome:
    """Hold what a command hands back."""

    #: JSON-serialisable result, printed as one object on stdout under ``--json``.
    data: dict[str, Any] = field(default_factory=dict)
    text: str = ""  #: What a person reads on stdout without ``--json``.
    exit_code: int = 0  #: 0 unless the command succeeded in finding something wrong (``check``).
    following: str = ""  #: The command that usually comes next, told after a success.


@dataclass(frozen=True)
class Command:
    """One sub-command: a line of help, a runnable example, its arguments and its function."""

    help: str
    example: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], Outcome]


PLAIN_EVERY = 10.0  # s between lines where there is no terminal


class Report(Protocol):
    """Tell how far a task is."""

    def __call__(self, what: str, done: float, total: float, text: str = "", /) -> None:
        """Show that ``done`` of ``total`` steps of ``what`` are behind us, with a word beside it."""


@contextmanager
def progress() -> Iterator[Report]:
    """Show progress on stderr for the duration of a command: bars on a terminal, now and then a line elsewhere.

    There is one bar per ``what``. The time left counts from what was done at the first call: work found done took no time.
    """
    if sys.stderr.isatty():
        yield from _bars()
    else:
        yield _lines()


def time_left(seconds: float, fresh: float, left: float) -> str:
    """Say how long ``left`` steps take when ``fresh`` ones took so many seconds."""
    if fresh <= 0:
        return "time left unknown"
    need = seconds * left / fresh
    return f"{need / 60:.0f} min left" if need > 90 else f"{need:.0f} s left"


def counted(number: int, thing: str) -> str:
    """Say how many there are of a thing: 1 view, 2 views."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def table(header: Sequence[str], rows: Sequence[Sequence[object]], indent: str = "") -> str:
    """Lay rows out under a header: the first column to the left, the others to the right."""
    cells = [[str(c) for c in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = (
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in cells
    )
    return "\n".join(f"{indent}{line}".rstrip() for line in lines)


def written(data: dict[str, Any], text: str, out: Path | None) -> Outcome:
    """Make the outcome of a command, written to ``out`` as JSON where a path was given."""
    if out is not None:
        from tofcapture.files.seal import write_text

        write_text(out, json.dumps(data, indent=1, allow_nan=False) + "\n")
        data, text = {**data, "out": str(out)}, f"{text}\n{out}"
    return Outcome(data=data, text=text)


def _lines() -> Report:
    began: dict[str, tuple[float, float]] = {}
    last = time.monotonic()

    def report(what: str, done: float, total: float, text: str = "", /) -> None:
        nonlocal last
        now = time.monotonic()
        start, before = began.setdefault(what, (now, done))
        if now - last < PLAIN_EVERY and done < total:
            return
        last = now
        left = f", {time_left(now - start, done - before, total - done)}" if done < total else ""
        print(f"{what}: {done:g} of {total:g}{left} {text}".rstrip(), file=sys.stderr, flush=True)

    return report


def _bars() -> Iterator[Report]:
    from rich import progress as rich
    from rich.console import Console

    columns = (
        *(rich.TextColumn("{task.description}"), rich.BarColumn(), rich.MofNCompleteColumn()),
        *(rich.TimeElapsedColumn(), rich.TextColumn("ETA"), rich.TimeRemainingColumn()),
        rich.TextColumn("{task.fields[text]}"),
    )
    with rich.Progress(*columns, console=Console(stderr=True)) as bar:
        tasks: dict[str, rich.TaskID] = {}

        def report(what: str, done: float, total: float, text: str = "", /) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total, text="")
            bar.update(tasks[what], completed=done, total=total, text=text)

        yield report
