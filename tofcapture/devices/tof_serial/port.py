"""Runs scripts on a real port: anything that pyserial opens, ``/dev/tty...`` or a URL such as ``socket://127.0.0.1:7000``."""

from __future__ import annotations

import io
import os
import select
import time
from types import TracebackType
from typing import Any, Self

from tofcapture.devices.tof_serial.packet import Parser
from tofcapture.devices.tof_serial.session import Ask, Heard, LinkLostError, Script, T
from tofcapture.errors import ConfigError

_SLICE = 0.02  # s; the longest that one read of a port without descriptor may block
_READ = 65536


class Port:
    """A port (device or pyserial URL) and the parser of what comes from it; may be opened again and again."""

    def __init__(self, url: str, baud: int) -> None:
        self.url, self.baud = url, baud
        self._parser = Parser()
        self._serial: Any = None

    def __enter__(self) -> Self:
        try:
            import serial
        except ImportError as err:
            raise ConfigError("the driver tof_serial needs pyserial", hint="pip install pyserial") from err
        # Another process on the same port would take every other byte.
        options: dict[str, Any] = {} if "://" in self.url else {"exclusive": True}
        try:
            port = serial.serial_for_url(
                self.url, baudrate=self.baud, timeout=_SLICE, write_timeout=2.0, do_not_open=True, **options
            )
            if "://" not in self.url:
                port.dtr = False  # many boards reset on a rising DTR
            port.open()
        except (OSError, ValueError) as err:
            raise LinkLostError(
                f"{self.url}: cannot open the port: {err}",
                hint="ls /dev/serial/by-id; is the user in the group dialout; does another program hold it?",
            ) from err
        self._serial, self._parser = port, Parser()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the port; again does nothing."""
        port, self._serial = self._serial, None
        if port is not None:
            try:
                port.close()
            except OSError:
                return  # a port that is gone is closed

    def run(self, script: Script[T]) -> T:
        """Run a script to its end and return its result; raises LinkLostError when the port is gone."""
        try:
            ask = next(script)
            while True:
                ask = script.send(self._obey(ask))
        except StopIteration as end:
            result: T = end.value
            return result
        except OSError as err:  # pyserial's SerialException is one
            self.close()
            raise LinkLostError(
                f"{self.url}: the link is gone: {err}", hint="check cable and power; the view is taken again"
            ) from err

    def _obey(self, ask: Ask) -> Heard:
        if self._serial is None:
            raise OSError("the port is closed")
        if ask.send:
            self._serial.write(ask.send)
        while (left := ask.until - time.monotonic_ns()) > 0:
            data = self._read(left * 1e-9)
            packets = self._parser.feed(data) if data else []
            if packets:
                return Heard(time.monotonic_ns(), tuple(packets))
        return Heard(time.monotonic_ns())

    def _read(self, seconds: float) -> bytes:
        """Read whatever is there, at the latest after so many seconds. Alone, pyserial reads a socket byte by byte."""
        try:
            descriptor = self._serial.fileno()
        except (AttributeError, io.UnsupportedOperation):
            return bytes(self._serial.read(max(1, self._serial.in_waiting)))
        if not select.select([descriptor], [], [], seconds)[0]:
            return b""
        data = os.read(descriptor, _READ)
        if not data:
            raise OSError("the device is ready to read but has no data")
        return data
