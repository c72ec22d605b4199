"""The child process: one driver, its calls in the main thread, the way to the parent in two others.

Run as ``python -m tofcapture.devices.host DESCRIPTOR``. It ends at once when the parent's end closes. When the driver's
library holds Python's lock, no thread of Python can notice that; a timer in C ends the process then, set anew by every sign
of life from the parent.
"""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import os
import queue
import signal
import socket
import sys
import threading
import time
from typing import Any

from tofcapture.devices.host import channel
from tofcapture.errors import DeviceError, TofError

BEAT = 0.2  # s between signs of life, both ways


class Child:
    """What the child process does.

    Parameters
    ----------
    end
        Its end of the channel.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        self._sending = threading.Lock()
        self._calls: queue.SimpleQueue[tuple[int, str, tuple[Any, ...]]] = queue.SimpleQueue()
        self._device: Any = None
        self._running = False
        self._heard = time.monotonic()
        self._guard = 60.0

    def run(self) -> None:
        """Make the driver, then do calls until the parent says exit or is gone."""
        faulthandler.dump_traceback_later(self._guard, exit=True)
        order = channel.receive(self._end)
        sys.path[:] = order["path"]
        self._guard = order["guard"]
        try:
            self._device = make(order["target"], order["table"], order["context"])
        except BaseException as err:
            self._send("error", 0, as_error(err))
            return
        for target in (self._listen, self._beat):
            threading.Thread(target=target, daemon=True).start()
        self._send("done", 0, None)
        while True:
            number, verb, args = self._calls.get()
            if verb == "exit":
                return
            self._call(number, verb, args)

    def _call(self, number: int, verb: str, args: tuple[Any, ...]) -> None:
        self._running = True
        try:
            result = getattr(self._device, verb)(*args)
            self._send("done", number, None if verb == "__enter__" else result)
        except BaseException as err:
            self._send("error", number, as_error(err))
        finally:
            self._running = False

    def _listen(self) -> None:
        """Take messages; ``stop`` reaches a driver in the middle of a call when it can be interrupted."""
        while True:
            try:
                message = channel.receive(self._end)
            except (EOFError, OSError):
                os._exit(0)
            self._heard = time.monotonic()
            faulthandler.dump_traceback_later(self._guard, exit=True)
            if message is None:
                continue
            if message[1] == "stop" and self._running and hasattr(self._device, "interrupt"):
                self._device.interrupt()
            self._calls.put(message)

    def _beat(self) -> None:
        """Give signs of life, and let the driver look after itself."""
        failed = False
        while True:
            time.sleep(BEAT / 2)
            self._send("beat", 0, None)
            watch = getattr(self._device, "watch", None)
            if watch is None or failed:
                continue
            try:
                watch(time.monotonic() - self._heard)
            except BaseException as err:
                failed = True
                self._send("fault", 0, as_error(err))

    def _send(self, kind: str, number: int, value: Any) -> None:
        with self._sending:
            try:
                channel.send(self._end, (kind, number, value))
            except OSError:
                os._exit(0)
            except Exception as err:
                wrong = DeviceError(f"the driver's answer cannot be sent: {type(err).__name__}: {err}")
                channel.send(self._end, ("error", number, wrong))


def make(target: str, table: Any, context: Any) -> Any:
    """Import ``module:name`` and call it with the device's table and the station's context.

    Raises
    ------
    DeviceError
        It does not import.
    """
    module, _, name = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as err:
        raise DeviceError(f"driver {target}: {err}") from err
    return factory(table, context)


def as_error(err: BaseException) -> TofError:
    """Errors of ours as they are, all others as a :class:`DeviceError` that names them."""
    if isinstance(err, TofError):
        return err
    return DeviceError(f"{type(err).__name__}: {err}")


def main() -> None:
    """Run the child; it never runs exit handlers, for vendors' ones crash."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child = Child(socket.socket(fileno=int(sys.argv[1])))
    with contextlib.suppress(EOFError, OSError):
        child.run()
    sys.stderr.flush()
    os._exit(0)
