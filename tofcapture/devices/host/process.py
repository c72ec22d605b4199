"""The parent's side: start a driver's process, call it within deadlines, notice its silence, kill it.

Messages are pickles; both ends are this program.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from multiprocessing.connection import Pipe
from typing import Any

from tofcapture.devices.faults import ArmFault, HostLost
from tofcapture.errors import DeviceError

BEAT = 0.2  # s between signs of life, both ways
SILENCE = 4.0  # s without a sign of life, after which a child is taken for dead
START = 30.0  # s for Python and the driver's module to load
_LAST_WORDS = 400  # characters of what the library printed, for the error message


class Host:
    """One child process with one driver in it; ``name`` says in messages what the device is: ``arm``.

    ``order`` holds ``target``, ``table`` and ``context`` of the driver. ``guard`` are the seconds without a sign of the
    parent after which the child ends itself, even if its library hangs; ``overdue`` is what a missed deadline means.
    """

    def __init__(self, name: str, order: Mapping[str, Any], guard: float, overdue: type[ArmFault]) -> None:
        self._name, self._overdue = name, overdue
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  lives as long as the child
        self._end, other = Pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tofcapture.devices.host", str(other.fileno())],
            pass_fds=[other.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            process_group=0,  # Ctrl-C is the parent's business
        )
        other.close()
        self._pending: dict[int, Future[Any]] = {}
        self._numbers = itertools.count(1)
        self._sending = threading.Lock()
        self._quiet = True  # a call runs that may hold Python's lock for its whole deadline
        self._heard = time.monotonic()
        self.lost: DeviceError | None = None
        self.opening = True  # the driver has not said that it is open
        hello: Future[Any] = Future()
        self._pending[0] = hello
        self._end.send({**order, "path": sys.path, "guard": guard})
        self._thread = threading.Thread(target=self._run, name=f"host {name}", daemon=True)
        self._thread.start()
        try:
            self._wait(hello, "start", START)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid

    def call(self, verb: str, args: tuple[Any, ...], deadline: float, *, quiet: bool = False) -> Any:
        """Call a method of the driver; after ``deadline`` seconds the child is killed.

        With ``quiet`` the call may hold Python's lock, so that signs of life do not count while it runs.

        Raises :class:`HostLost`: the child died, fell silent, or took longer; :class:`TofError`: what the
        driver raised.
        """
        if self.lost is not None:
            raise self.lost
        future: Future[Any] = Future()
        number = next(self._numbers)
        self._pending[number] = future
        self._quiet, self._heard = quiet, time.monotonic()
        try:
            self._post((number, verb, args))
        except OSError:
            self.kill(self._gone())
        try:
            return self._wait(future, verb, deadline)
        finally:
            self._pending.pop(number, None)
            if quiet:
                self._quiet, self._heard = False, time.monotonic()

    def _post(self, message: Any) -> None:
        with self._sending:
            self._end.send(message)

    def _wait(self, future: Future[Any], verb: str, deadline: float) -> Any:
        try:
            return future.result(deadline)
        except TimeoutError:
            self.kill(
                self._overdue(f"{self._name}: {verb} took more than {deadline:.0f} s{self._last_words()}")
            )
        return future.result(1.0)

    def _run(self) -> None:
        """Take answers, give and watch for signs of life."""
        spoke = 0.0
        while self.lost is None:
            try:
                if self._end.poll(BEAT / 2):
                    self._take(*self._end.recv())
                if time.monotonic() - spoke > BEAT:
                    spoke = time.monotonic()
                    self._post(None)
            except (EOFError, OSError):
                self.kill(self._gone())
                return
            if not self._quiet and time.monotonic() - self._heard > SILENCE:
                self.kill(HostLost(f"{self._name}: the driver's process fell silent{self._last_words()}"))

    def _take(self, kind: str, number: int, value: Any) -> None:
        self._heard = time.monotonic()
        future = self._pending.get(number)
        if kind == "fault":
            self.kill(value)
        elif kind in {"done", "error"} and future is not None and not future.done():
            if number == 0:
                self._quiet = False
            if kind == "done":
                future.set_result(value)
            else:
                future.set_exception(value)

    def _gone(self) -> HostLost:
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = None
        return HostLost(f"{self._name}: the driver's process ended, exit status {code}{self._last_words()}")

    def _last_words(self) -> str:
        """The end of what the library printed."""
        size = os.fstat(self._log.fileno()).st_size
        text = os.pread(self._log.fileno(), _LAST_WORDS, max(0, size - _LAST_WORDS))
        words = " ".join(text.decode("utf-8", "replace").split())
        return f"; it last said: {words}" if words else ""

    def kill(self, why: DeviceError) -> None:
        """Kill the child, if it lives; whoever waits for it gets ``why``."""
        if self.lost is None:
            self.lost = why
        self._process.kill()
        self._process.wait()
        for future in list(self._pending.values()):
            if not future.done():
                future.set_exception(self.lost)

    def close(self) -> None:
        """Let the child end by itself, kill it after a second."""
        if self.lost is None:
            self.lost = DeviceError(f"{self._name} is closed")
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                self._post((0, "exit", ()))
                self._process.wait(1.0)
        self.kill(DeviceError(f"{self._name} is closed"))
        self._thread.join(2 * BEAT + 1.0)
        self._end.close()
        self._log.close()
