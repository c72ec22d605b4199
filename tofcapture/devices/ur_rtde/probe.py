"""Ask the controller who and how it is, in plain Python with deadlines, before the vendor's library is loaded.

The library's constructors hang for ever, holding Python's lock, when a controller accepts a connection and says nothing.
"""

from __future__ import annotations

import re
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TextIO

from tofcapture.devices.faults import ControllerSilent, NotReady, StaleData
from tofcapture.devices.ur_rtde import link as wire
from tofcapture.devices.ur_rtde.settings import Settings

DASHBOARD = 29999
_TIMEOUT = 2.0  # s for each answer
_ENDING = 2.0  # s in which the program of a run before ends, whose watchdog hears nothing any more
_NEEDED = ("timestamp", "actual_q", "robot_mode", "safety_status_bits", "runtime_state")
_WANTED = ("payload", "tcp_offset", "speed_scaling")


@dataclass(frozen=True)
class Controller:
    """Findings of the probe. ``None`` is what the controller does not say."""

    version: tuple[int, ...]  # of PolyScope: major, minor, bugfix, build
    serial: str  # of the arm; empty when the dashboard does not say
    tcp_offset: tuple[float, ...] | None  # (6,) m and rad from the flange
    scaling: bool  # it reports the speed slider's effect


def probe(settings: Settings) -> Controller:
    """Go through RTDE's handshake and the dashboard's questions.

    Raises :class:`ControllerSilent`: nothing listens, or an answer does not come; says which;
    :class:`NotReady`: not in remote control, not powered on, another arm, another payload, another program
    runs, a PolyScope without these interfaces; :class:`ProtectiveStop`, :class:`EmergencyStop`,
    :class:`SafetyStop`: the controller has stopped the arm; :class:`StaleData`: its clock stands still.
    """
    with _Rtde(settings.host) as rtde:
        version = rtde.version()
        if not 3 <= version[0] < 10:
            raise NotReady(
                f"{settings.host}: expected PolyScope 3 or 5, got {'.'.join(map(str, version))}",
                hint="PolyScope X has no dashboard and no script port; this driver cannot use it",
            )
        first, second = rtde.samples()
    if not second["timestamp"] > first["timestamp"]:  # type: ignore[operator]
        raise StaleData(f"{settings.host}: the controller's clock stands still at {second['timestamp']} s")
    fault = wire.danger(int(second["safety_status_bits"]), int(second["robot_mode"]))  # type: ignore[arg-type]
    if fault is not None:
        raise fault
    serial = _dashboard(settings)
    payload = second.get("payload", float("nan"))
    if abs(payload - settings.payload) > 0.05:  # type: ignore[operator]  # NaN, for any payload, compares false
        raise NotReady(
            f"expected a payload of {settings.payload} kg, the controller has {payload:.2f} kg",
            hint="set payload and centre of gravity on the pendant, or correct [arm] payload",
        )
    if second["runtime_state"] != wire.AT_REST:
        raise NotReady(
            f"{settings.host}: another program {wire.state(int(second['runtime_state']))} on the controller",  # type: ignore[arg-type]
            hint="end it first: on the pendant, or where it was started; opening would replace it",
        )
    return Controller(version, serial, second.get("tcp_offset"), "speed_scaling" in second)  # type: ignore[arg-type]


def _dashboard(settings: Settings) -> str:
    """Ask for remote control and the serial number; answers that make no sense are not held against it."""
    host = settings.host
    with _at(host, "the dashboard's banner"), socket.create_connection((host, DASHBOARD), _TIMEOUT) as link:
        lines = link.makefile("rw", encoding="utf-8", newline="\n")
        if "Dashboard" not in lines.readline():
            raise ControllerSilent(f"{host}: port {DASHBOARD} does not greet as a dashboard does")
        with _at(host, "the dashboard's answers"):
            remote = _ask(lines, "is in remote control")
            serial = _ask(lines, "get serial number")
    if remote == "false":
        raise NotReady(
            f"{host}: the controller is in local control", hint="choose remote control on the pendant"
        )
    serial = serial if re.fullmatch(r"\d+", serial) else ""
    if settings.serial and serial != settings.serial:
        raise NotReady(
            f"{host}: expected the arm with serial number {settings.serial}, got {serial or 'no answer'}",
            hint="correct [arm] host or serial",
        )
    return serial


def _ask(lines: TextIO, question: str) -> str:
    lines.write(question + "\n")
    lines.flush()
    return lines.readline().strip().lower()


@contextmanager
def _at(host: str, stage: str) -> Iterator[None]:
    """Name the stage at which a controller falls silent."""
    try:
        yield
    except TimeoutError:
        raise ControllerSilent(f"{host}: silent at {stage} for {_TIMEOUT:.0f} s") from None
    except OSError as err:
        raise ControllerSilent(f"{host}: {stage}: {err}") from err


class _Rtde:
    """A monitor's connection: reads, commands nothing, takes no inputs."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._splitter = wire.Splitter()
        self._packages: list[tuple[int, bytes]] = []

    def __enter__(self) -> Self:
        with _at(self._host, "RTDE's port 30004"):
            self._link = socket.create_connection((self._host, wire.PORT), _TIMEOUT)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._link.close()

    def _next(self, kind: int) -> bytes:
        """Payload of the next package of a kind; others are passed over."""
        end = time.monotonic() + _TIMEOUT
        while True:
            while self._packages:
                found, payload = self._packages.pop(0)
                if found == kind:
                    return payload
            left = end - time.monotonic()
            if left <= 0:
                raise TimeoutError
            self._link.settimeout(left)
            data = self._link.recv(65536)
            if not data:
                raise ConnectionError("closed by the controller")
            self._packages += self._splitter.feed(data)

    def _ask(self, kind: int, payload: bytes, stage: str) -> bytes:
        with _at(self._host, f"RTDE's {stage}"):
            self._link.sendall(wire.package(kind, payload))
            answer = self._next(kind)
        if not answer:
            raise ControllerSilent(f"{self._host}: RTDE's {stage}: empty answer")
        return answer

    def version(self) -> tuple[int, ...]:
        """Agree on protocol 2, return the controller's version."""
        if not self._ask(wire.VERSION, b"\x00\x02", "protocol version")[0]:
            raise NotReady(
                f"{self._host}: the controller does not speak RTDE version 2", hint="update PolyScope"
            )
        answer = self._ask(wire.CONTROLLER, b"", "controller version")
        if len(answer) != 16:
            raise ControllerSilent(
                f"{self._host}: RTDE's controller version: {len(answer)} bytes, expected 16"
            )
        return struct.unpack(">4I", answer)

    def _recipe(self) -> wire.Recipe:
        """Agree on outputs; those that this controller does not have are left out."""
        names = [*_NEEDED, *_WANTED]
        for _ in range(2):
            request = struct.pack(">d", 125.0) + ",".join(names).encode()
            types = wire.split_names(self._ask(wire.OUTPUTS, request, "output setup")[1:])
            found = [n for n, t in zip(names, types, strict=False) if t != "NOT_FOUND"]
            if found == names:
                return wire.Recipe(names, types)
            names = found
        raise NotReady(f"{self._host}: the controller lacks {', '.join(set(_NEEDED) - set(names))}")

    def samples(self) -> tuple[dict[str, wire.Value], dict[str, wire.Value]]:
        """Start the data, return two packages of them; a later second one while a program runs that may be about to end."""
        recipe = self._recipe()
        if not self._ask(wire.START, b"", "start")[0]:
            raise NotReady(f"{self._host}: the controller does not start its data")
        with _at(self._host, "RTDE's data"):
            first, last = (recipe.unpack(self._next(wire.DATA)[1:]) for _ in range(2))
            end = time.monotonic() + _ENDING
            while last["runtime_state"] != wire.AT_REST and time.monotonic() < end:
                last = recipe.unpack(self._next(wire.DATA)[1:])
        return first, last
