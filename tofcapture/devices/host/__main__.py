"""The child process: one driver, its calls in the main thread, the way to the parent in two others.

Run as ``python -m tofcapture.devices.host DESCRIPTOR``. It ends at once when the parent's end closes. While the driver's
library holds Python's lock, no Python thread notices that. A timer in C, which every sign of life from the parent sets
anew, ends the process then.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import queue
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

from tofcapture.devices.faults import StopLatch
from tofcapture.devices.host.process import BEAT
from tofcapture.devices.registry import make_target
from tofcapture.errors import DeviceError, TofError


class Child:
    """The child's work. ``end`` is its end of the connection."""

    def __init__(self, end: Connection) -> None:
        self._end = end
        self._sending = threading.Lock()
        self._calls: queue.SimpleQueue[tuple[int, str, tuple[Any, ...], object]] = queue.SimpleQueue()
        self._device: Any = None
        self._latch = StopLatch()
        self._moving = 0  # the number of the move that runs
        self._heard = time.monotonic()
        self._guard = 60.0

    def run(self) -> None:
        """Make the driver, then do calls until the parent says exit or is gone."""
        faulthandler.dump_traceback_later(self._guard, exit=True)
        order = self._end.recv()
        sys.path[:] = order["path"]
        self._guard = order["guard"]
        try:
            self._device = make_target(order["target"], order["table"], order["context"])
        except BaseException as err:
            self._send("error", 0, _as_error(err))
            return
        for target in (self._listen, self._beat):
            threading.Thread(target=target, daemon=True).start()
        self._send("done", 0, None)
        while True:
            number, verb, args, token = self._calls.get()
            if verb == "exit":
                return
            self._call(number, verb, args, token)

    def _call(self, number: int, verb: str, args: tuple[Any, ...], token: object) -> None:
        # Before the check: a stop that comes after it sees that something moves
        self._moving = number if verb == "move_to" else 0
        try:
            if self._moving:
                self._latch.check(token)
            result = getattr(self._device, verb)(*args)
            self._send("done", number, None if verb == "__enter__" else result)
        except BaseException as err:
            self._send("error", number, _as_error(err))
        finally:
            self._moving = 0

    def _listen(self) -> None:
        """Take messages; ``stop`` reaches a driver in the middle of a move by ``interrupt``, past the queue of calls.

        A move that was asked for before a stop is not begun after it.
        """
        while True:
            try:
                message = self._end.recv()
            except (EOFError, OSError):
                os._exit(0)
            self._heard = time.monotonic()
            faulthandler.dump_traceback_later(self._guard, exit=True)
            if message is None:
                continue
            if message[1] == "stop":
                self._latch.stop()
                threading.Thread(target=self._interrupt, args=(self._moving,), daemon=True).start()
            elif message[1] == "resume":
                self._latch.resume(self._latch.token)
            self._calls.put((*message, self._latch.token))

    def _interrupt(self, move: int) -> None:
        """Tell the driver again until its move is over: it may only just be beginning it."""
        while move and self._moving == move:
            self._device.interrupt()
            time.sleep(0.02)

    def _beat(self) -> None:
        """Give signs of life, and let the driver look after itself."""
        failed = False
        while True:
            time.sleep(BEAT / 2)
            self._send("beat", 0, None)
            if failed:
                continue
            try:
                self._device.watch(time.monotonic() - self._heard)
            except BaseException as err:
                failed = True
                self._send("fault", 0, _as_error(err))

    def _send(self, kind: str, number: int, value: Any) -> None:
        with self._sending:
            try:
                self._end.send((kind, number, value))
            except OSError:
                os._exit(0)
            except Exception as err:
                wrong = DeviceError(f"the driver's answer cannot be sent: {type(err).__name__}: {err}")
                self._end.send(("error", number, wrong))


def _as_error(err: BaseException) -> TofError:
    """Errors of ours as they are, all others as a :class:`DeviceError` that names them."""
    if isinstance(err, TofError):
        return err
    return DeviceError(f"{type(err).__name__}: {err}")


def main() -> None:
    """Run the child; no exit handler runs, for vendors' ones crash."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child = Child(Connection(int(sys.argv[1])))
    with contextlib.suppress(EOFError, OSError):
        child.run()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
