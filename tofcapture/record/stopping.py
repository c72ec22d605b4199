"""Stops recorders from outside: whatever moves an arm listens, and ``tofcapture stop`` tells all of this user's to stop.

A datagram socket in Linux's abstract namespace is the channel. It needs no folder, database, TCP port, event loop, nor, once it
is bound, a free descriptor. Its name holds user and process, and goes when they go. A process that does not answer is killed:
driver hosts then notice that their parent is gone, and stop what they drive.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import secrets
import signal
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.record.observer import Stopped

PREFIX = "tofcapture-stop"  # of the sockets' names
GRACE = 3.0  # s that a process may take to stop its arm, until it is killed
_KILLED = 2.0  # s until a killed process is gone
_ROOT = 0
_CREDENTIALS = struct.Struct("3i")  # process, user, group; the kernel fills it in

Action = Callable[[], object]


class Stop:
    """What an order to stop does to one run; once heard it holds."""

    def __init__(self, what: str, *actions: Action) -> None:
        self.what = what  # is stopped, in words
        self._actions, self._heard = actions, False

    def hear(self) -> None:
        """Stop everything; raises what an action raises, when all were tried."""
        self._heard = True
        with contextlib.ExitStack() as stack:
            for action in reversed(self._actions):
                stack.callback(action)

    def check(self) -> None:
        """Raise :class:`Stopped` when the order was heard."""
        if self._heard:
            raise Stopped(f"{self.what}: stopped by the operator", hint="run the same again to go on")


@contextmanager
def stoppable(what: str, *actions: Action) -> Iterator[Stop]:
    """Listen for orders to stop while inside; ``actions`` run in a thread of their own."""
    stop = Stop(what, *actions)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        # The random end: nobody can take the name before us.
        link.bind(f"\0{PREFIX}.{os.getuid()}.{os.getpid()}.{secrets.token_hex(6)}")
        thread = threading.Thread(target=_listen, args=(link, stop), daemon=True)
        thread.start()
        try:
            yield stop
        finally:
            link.shutdown(socket.SHUT_RD)
            thread.join(GRACE)


def _listen(link: socket.socket, stop: Stop) -> None:
    """Follow the orders of this user and of root until the socket is shut."""
    while True:
        order, more, _, sender = link.recvmsg(16, socket.CMSG_SPACE(_CREDENTIALS.size))
        if not order:
            return
        users = [_CREDENTIALS.unpack(data)[1] for _, kind, data in more if kind == socket.SCM_CREDENTIALS]
        if users not in ([os.getuid()], [_ROOT]):
            continue
        _answer(link, sender, stop.what, None)
        try:
            stop.hear()
            _answer(link, sender, stop.what, "")
        except Exception as err:
            _answer(link, sender, stop.what, f"{type(err).__name__}: {err}")


def _answer(link: socket.socket, sender: Any, what: str, error: str | None) -> None:
    with contextlib.suppress(OSError):
        text = json.dumps({"what": what, "error": error}).encode()
        link.sendto(text, socket.MSG_DONTWAIT, sender)


@dataclass
class Told:
    """Hold what came of telling one process to stop; ``problem`` is empty when it has stopped, ``how`` says more."""

    pid: int
    what: str
    problem: str = "it did not answer"
    how: str = "stopped"

    def __str__(self) -> str:
        return f"{self.what} (process {self.pid}): {self.problem or self.how}"


@dataclass(frozen=True)
class _Channel:
    address: bytes
    user: int
    pid: int
    inode: int

    def held(self) -> bool:
        """Ask the kernel whether the process of that name has this very socket open."""
        for link in Path(f"/proc/{self.pid}/fd").glob("*"):
            with contextlib.suppress(OSError):
                if str(link.readlink()) == f"socket:[{self.inode}]":
                    return True
        return False

    def foreign(self) -> bool:
        """Tell whether it is another user's, by whom this process is not heard."""
        return os.getuid() not in (_ROOT, self.user)


def _channels() -> list[_Channel]:
    """List every open channel of this machine, the oldest process first."""
    found = []
    for line in Path("/proc/net/unix").read_text(encoding="utf-8", errors="replace").splitlines():
        fields = line.split()
        name = fields[7].split(".") if len(fields) == 8 else []
        if len(name) == 4 and name[0] == f"@{PREFIX}" and name[1].isdecimal() and name[2].isdecimal():
            address = b"\0" + fields[7][1:].encode()
            found.append(_Channel(address, int(name[1]), int(name[2]), int(fields[6])))
    return sorted(found, key=lambda channel: channel.pid)


def stop_all() -> list[Told]:
    """Stop everything of this user that listens (root: of everybody), and say what came of each.

    What belongs to others, or holds an arm without having been stopped, is told as not stopped.
    """
    channels = _channels()
    mine = {c.address: (c, Told(c.pid, "a recorder")) for c in channels if not c.foreign()}
    _tell(mine)
    for channel, one in mine.values():
        if one.problem:
            _kill(channel, one)
    told = [one for _, one in mine.values()]
    told += [Told(c.pid, f"a recorder of {_user(c.user)}", "not yours") for c in channels if c.foreign()]
    held = _holders_of_arms() - {one.pid for one in told}
    told += [Told(pid, "what holds an arm", "it does not listen, and was not stopped") for pid in held]
    return list({(one.pid, str(one)): one for one in told}.values())


def _tell(mine: dict[bytes, tuple[_Channel, Told]]) -> None:
    """Send the order to all, then hear them out, :data:`GRACE` seconds at most."""
    end, unsent, unheard = time.monotonic() + GRACE, set(mine), set(mine)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind("")  # the kernel finds a free name for the answers
        while unheard and (left := end - time.monotonic()) > 0:
            for address in sorted(unsent):
                if (gone := _send(link, address)) is None:
                    continue  # its queue is full: again, below
                unsent.discard(address)
                if gone:
                    unheard.discard(address)
                    mine[address][1].problem, mine[address][1].how = "", "it has ended"
            link.settimeout(min(left, 0.02) if unsent else left)
            with contextlib.suppress(TimeoutError):
                text, sender = link.recvfrom(65536)
                if sender in mine and _heard(json.loads(text), mine[sender][1]):
                    unheard.discard(sender)


def _send(link: socket.socket, address: bytes) -> bool | None:
    """Send the order; true when nobody is there any more, ``None`` when it does not fit in just now."""
    try:
        link.sendto(b"stop", socket.MSG_DONTWAIT, address)
    except BlockingIOError:
        return None
    except OSError:
        return True
    return False


def _heard(answer: dict[str, Any], one: Told) -> bool:
    """Take in an answer: the first says who it is, the second, for which this is true, what came of the order."""
    one.what, error = answer["what"], answer["error"]
    if error is not None:
        one.problem = error and f"it could not stop: {error}"
    return error is not None


def _kill(channel: _Channel, one: Told) -> None:
    """End a process that did not stop, when it is surely that one; one that is gone already has."""
    if surely := channel.held():
        with contextlib.suppress(OSError):
            os.kill(channel.pid, signal.SIGKILL)
    end = time.monotonic() + _KILLED
    while (there := channel.held() if surely else channel in _channels()) and time.monotonic() < end:
        time.sleep(0.02)
    if not there:
        one.problem, one.how = "", f"{one.problem}; it was killed" if surely else "it has ended"


def _holders_of_arms() -> set[int]:
    """Find the processes that hold a real arm (``record.resources.hold_arm``); 0 where the kernel does not say which."""
    arms = [path.stat() for path in Path(tempfile.gettempdir()).glob("tofcapture-arm-*.lock")]
    names = {f"{os.major(s.st_dev):02x}:{os.minor(s.st_dev):02x}:{s.st_ino}" for s in arms}
    locks = [line.split() for line in Path("/proc/locks").read_text(encoding="utf-8").splitlines()]
    return {max(0, int(lock[-4])) for lock in locks if lock[-3] in names}


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"
