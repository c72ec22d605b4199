"""The recorder's process as the daemon sees it: orders in, lines out, and how long it has been silent."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Any

WORKER = (sys.executable, "-m", "tofcapture.record.daemon.worker")
_LINE = 4 * 1024 * 1024  # bytes; a plan of thousands of views fits


class Child:
    """A started recorder."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self._heard = time.monotonic()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def silence(self) -> float:
        """Seconds since the last line."""
        return time.monotonic() - self._heard

    def order(self, verb: str) -> None:
        """Give an order; one that has ended already hears nothing, which is right."""
        self._send({"do": verb})

    def _send(self, message: Mapping[str, Any]) -> None:
        pipe = self._process.stdin
        if pipe is not None and not pipe.is_closing():
            with contextlib.suppress(OSError):
                pipe.write(json.dumps(message).encode() + b"\n")

    async def lines(self) -> AsyncIterator[dict[str, Any]]:
        """What it tells, until it ends; signs of life are counted, not passed on."""
        pipe = self._process.stdout
        if pipe is None:
            return
        async for line in pipe:
            self._heard = time.monotonic()
            try:
                message = json.loads(line)
            except ValueError:
                continue  # the last line of a killed process
            if message.get("kind") != "alive":
                yield message

    def kill(self) -> None:
        """End it now; driver hosts notice that their parent is gone and stop what they drive."""
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()

    async def end(self, patience: float) -> int:
        """Wait until it has ended; killed when patience runs out."""
        try:
            async with asyncio.timeout(patience):
                return await self._process.wait()
        except TimeoutError:
            self.kill()
            return await self._process.wait()


async def start(job: Mapping[str, Any], command: Sequence[str] = WORKER) -> Child:
    """Start a recorder on a job; it is in a session of its own, so that Ctrl-C at a terminal reaches the daemon alone."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
        limit=_LINE,
        # Numerical libraries that spin on every core would take them from the daemon.
        env={"OMP_WAIT_POLICY": "PASSIVE", **os.environ},
    )
    child = Child(process)
    child._send(job)  # noqa: SLF001  the first line is the job
    return child
