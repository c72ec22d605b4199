"""An emulator in a process of its own, for tests."""

from __future__ import annotations

import itertools
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tests import PATIENCE, until
from tofcapture.errors import DeviceError

_ROOT = Path(__file__).parents[2]
_used = itertools.count(2)


def _address() -> str:
    """A loopback address by this process's number: Linux has sixteen million."""
    pid = os.getpid()
    return f"127.{100 + pid // 250 % 100}.{pid % 250}.{next(_used) % 250}"


class Emulator:
    """Runs an emulator while the ``with`` block lasts.

    Parameters
    ----------
    host
        Loopback address; empty for one that no other process of this kind uses.
    model
        ``ur10e`` or ``ur5e``.
    """

    def __init__(self, host: str = "", model: str = "ur10e") -> None:
        self.host = host or _address()
        self._model = model
        self._process: subprocess.Popen[str] | None = None
        self._control: socket.socket | None = None

    def __enter__(self) -> Self:
        command = [sys.executable, "-m", "tests.ur_emulator", "--host", self.host, "--model", self._model]
        # It ends when its standard input closes: also when this process is killed.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0, cwd=_ROOT
        )
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self.__exit__(None, None, None)
            raise DeviceError(f"the emulator on {self.host} did not start", hint="is the address taken?")
        self._control = socket.create_connection((self.host, json.loads(line)["control"]), timeout=PATIENCE)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            self._process.kill()
            self._process.communicate()

    def order(self, do: str, **more: Any) -> dict[str, Any]:
        """Send an order to the control port.

        Returns
        -------
        dict
            The robot's status: ``joints``, ``velocity``, ``moving``, ``runtime``, ``safety``.

        Raises
        ------
        DeviceError
            The order makes no sense.
        """
        assert self._control is not None
        self._control.sendall(json.dumps({"do": do, **more}).encode() + b"\n")
        answer = b""
        while not answer.endswith(b"\n"):
            answer += self._control.recv(65536)
        status: dict[str, Any] = json.loads(answer)
        if not status["ok"]:
            raise DeviceError(f"emulator: {status['error']}")
        return status

    def calm(self) -> dict[str, Any]:
        """Lift all faults and wait until the arm is at rest; the robot's status then."""
        self.order("lift")
        return self.rest()

    def rest(self) -> dict[str, Any]:
        """Wait until the arm is at rest; the robot's status then."""
        until(lambda: not self.order("status")["moving"])
        return self.order("status")
