"""Define what every command shares: what a command is, progress with the time left, tables of a fixed form, results as JSON files.

Every package adds its commands through the entry-point group ``tofcapture.commands``. Each entry point names one :class:`Command`.
Its module is light to import: heavy libraries are imported inside ``run``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, TextIO


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


QUIET = 10.0  # s between lines where there is no terminal
BEAT = 0.5  # s between looks at the clock
_SLOWER = 1.5, 5.0  # an estimate is raised where it grew by this factor and s more
_SURE, _MANY = 10.0, 10  # s or reports, before an estimate
_BAR = 20  # characters
_MARKS = 1000  # reports that an estimate looks back on


class Report(Protocol):
    """Tell how far a task is."""

    def __call__(self, what: str, done: float, total: float, text: str = "", /) -> None:
        """Show that ``done`` of ``total`` steps of ``what`` are behind us, with a word beside it."""


@contextmanager
def progress() -> Iterator[Report]:
    """Show progress on stderr: one line that is drawn anew on a terminal or in a notebook, elsewhere a line every ten seconds.

    ::

        with progress() as report:
            for i, item in enumerate(items):
                report("read", i, len(items), item.name)

    A total of 0 says that nobody knows how much there is. The time left counts from what was done at the first call: work found
    done took no time.
    """
    with _Voice() as voice:
        yield voice.report


@contextmanager
def at_work(what: str) -> Iterator[None]:
    """Say on a terminal that a command is at work, from now until it says something itself."""
    if not _is_live():
        yield
        return
    with _Voice(passing=True) as voice:
        voice.report(what, 0, 0)
        yield


class Pace:
    """Guess how long the rest of a task takes, from its latest three quarters; the guess falls unless it was far too low."""

    def __init__(self) -> None:
        self._marks: list[tuple[float, float]] = []  # time and what was done, where that changed
        self._end: float | None = None

    def left(self, now: float, done: float, total: float) -> float | None:
        """Seconds until ``total``, at the time ``now`` in seconds of any clock; ``None`` while nobody can know."""
        if not self._marks or done != self._marks[-1][1]:
            self._marks = self._marks[-_MARKS:]
            self._marks.append((now, done))
            # Loading and compiling belong to the first step: the second one starts the clock.
            marks = self._marks[1:]
            early = marks[0][0] + (now - marks[0][0]) / 4 if marks else now
            base = next((m for m in reversed(marks) if m[0] <= early), (now, done))
            fresh, took = done - base[1], now - base[0]
            if fresh > 0 and (took > _SURE or len(marks) > _MANY):
                self._believe(now, now + took * (total - done) / fresh)
        return None if self._end is None else max(self._end - now, 0.0)

    def _believe(self, now: float, end: float) -> None:
        """Follow an earlier end halfway, a much later one at once, others not at all: what is shown must not creep."""
        factor, more = _SLOWER
        if self._end is None or end > now + factor * (self._end - now) + more:
            self._end = end
        else:
            self._end = min(self._end, (self._end + end) / 2)


def _is_live() -> bool:
    """Whether stderr shows a line that is drawn over."""
    terminal = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
    return terminal or "ipykernel" in sys.modules


class _Voice:
    """The one line of stderr that says how far a task is.

    A thread keeps it alive. What others print goes above it. Inside another one, as progress inside of a command at work, it is
    the inner one that speaks.

    Parameters
    ----------
    passing
        End as soon as something else is printed.
    """

    _speaking: ClassVar[list[_Voice]] = []

    def __init__(self, *, passing: bool = False) -> None:
        self._passing, self._live, self._stream = passing, _is_live(), sys.stderr
        self._tasks: dict[str, tuple[float, Pace]] = {}
        self._now: tuple[str, float, float, str] | None = None
        self._told, self._shown, self._held = time.monotonic(), 0, False
        self._lock, self._over = threading.RLock(), threading.Event()

    def __enter__(self) -> Self:
        if outer := self._speaking[-1:]:
            outer[0].clear()
            self._stream = outer[0]._stream  # noqa: SLF001
        self._speaking.append(self)
        self._usual = sys.stdout, sys.stderr
        if self._live and len(self._speaking) == 1 and "ipykernel" not in sys.modules:
            sys.stdout, sys.stderr = (_Aside(s) if s.isatty() else s for s in self._usual)
        threading.Thread(target=self._beat, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.clear()
        self._speaking.remove(self)
        sys.stdout, sys.stderr = self._usual

    def report(self, what: str, done: float, total: float, text: str = "", /) -> None:
        """See :class:`Report`."""
        with self._lock:
            now = time.monotonic()
            began, pace = self._tasks.setdefault(what, (now, Pace()))
            if total:
                pace.left(now, done, total)
            ended = 0 < total <= done
            if ended and self._now == (what, done, total, text):
                return  # said already
            self._now = what, done, total, text
            if ended and self._live:
                self.clear()
                self._write(f"{what}: {done:g} of {total:g}, {now - began:.0f} s\n")
            elif self._live or ended or now - self._told >= QUIET:
                self._say()

    def clear(self) -> None:
        """Take the line away."""
        with self._lock:
            if self._shown:
                self._write("\r" + " " * self._shown + "\r")
                self._shown = 0

    def step_aside(self, text: str) -> None:
        """Make room for something else that is printed; a question stays until its line has ended."""
        self.clear()
        self._held = not text.endswith("\n")
        if self._passing:
            self._over.set()

    def _beat(self) -> None:
        while not self._over.wait(BEAT):
            if self._speaking[-1:] == [self] and (self._live or time.monotonic() - self._told >= QUIET):
                with self._lock:
                    self._say()

    def _say(self) -> None:
        if self._now is None or self._held or self._over.is_set():
            return
        what, done, total, text = self._now
        ended = 0 < total <= done
        if self._live and ended:
            return
        self._told = now = time.monotonic()
        began, pace = self._tasks[what]
        left = None if ended or not total else pace.left(now, done, total)
        words = [
            f"{what}: {done:g} of {total:g}" if total else what,
            *([] if ended else [f"{now - began:.0f} s"] if left is None else [_in_words(left)]),
        ]
        line = f"{', '.join(words)}  {text}".rstrip()
        if not self._live:
            self._write(line + "\n")
            return
        room = _columns(self._stream) - 1  # a full line would wrap
        if total and room > len(line) + _BAR + 1:
            full = round(_BAR * min(max(done / total, 0.0), 1.0))
            line = f"{'#' * full}{'-' * (_BAR - full)} {line}"
        line = line[:room]
        self._write("\r" + line.ljust(min(self._shown, room)))
        self._shown = len(line)

    def _write(self, text: str) -> None:
        with suppress(OSError, ValueError):  # whoever watched has gone
            self._stream.write(text)
            self._stream.flush()


class _Aside:
    """A stream of the terminal: what others write there makes the voice step aside first."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        for voice in _Voice._speaking if text else ():  # noqa: SLF001
            voice.step_aside(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _columns(stream: TextIO) -> int:
    """Width of a terminal; 80 where it does not say."""
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def _in_words(seconds: float) -> str:
    return f"{seconds / 60:.0f} min left" if seconds > 90 else f"{seconds:.0f} s left"


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
