"""The driver ``tof_serial``: a ToF module on a serial link as a :class:`tofcapture.devices.TofCamera`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.contact import read_contact, write_contact
from tofcapture.devices.tof_serial.assembly import values
from tofcapture.devices.tof_serial.clock import MOST_DRIFT, Anchor, drift, to_host
from tofcapture.devices.tof_serial.description import (
    OVERRIDES,
    check_firmware,
    check_same,
    described,
    said_by,
)
from tofcapture.devices.tof_serial.errors import ClockError
from tofcapture.devices.tof_serial.messages import Frame, Info
from tofcapture.devices.tof_serial.port import Port
from tofcapture.devices.tof_serial.script import MS, Timing
from tofcapture.devices.tof_serial.session import Host
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_SETTINGS = ("port", "baud", "firmware", "contact")
_BAUD = 921_600
_SMALLEST, _LARGEST = 512, 16384  # bytes of a chunk


class SerialTof:
    """A module that speaks docs/serial-protocol.md.

    After an error the link is closed, and the next :meth:`capture` opens it anew: a cable that was plugged in again, or a
    module that started again, needs nothing else.

    Parameters
    ----------
    table
        ``port`` (device or pyserial URL), ``baud``, ``firmware`` ("1.0": accept no other), ``contact`` (file that keeps what the
        module said of itself), and anything of TofInfo to override it.
    context
        The station; relative paths start at its folder.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        unknown = table.keys() - {*_SETTINGS, *OVERRIDES}
        if unknown:
            raise ConfigError(
                f"[tof] does not know {', '.join(sorted(unknown))}",
                hint=f"it knows {', '.join((*_SETTINGS, *OVERRIDES))}",
            )
        if not isinstance(table.get("port"), str):
            raise ConfigError(f"[tof] port: expected a device or URL, got {table.get('port')!r}")
        self._table, self._url = dict(table), str(table["port"])
        self._baud = int(table.get("baud", _BAUD))
        self._contact = Path(context.folder) / str(table.get("contact", "tof-contact.toml"))
        self._port: Port | None = None
        self._host = Host()
        self._module: Info | None = None
        self._first: Anchor | None = None
        # Numbers a burst for as long as the module remembers it, also across restarts of this process.
        self._burst = int.from_bytes(os.urandom(4), "little")

    def __enter__(self) -> Self:
        self._open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the link; again does nothing."""
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def describe(self) -> TofInfo:
        """Say what this camera is, from ``station.toml`` and the contact file; opens nothing.

        Raises
        ------
        ConfigError
            The module was never opened and ``station.toml`` does not say everything.
        """
        said = said_by(self._module) if self._module is not None else read_contact(self._contact)
        return described(said, self._table, f"[tof] {self._url}")

    def capture(self, frames: int) -> TofBurst:
        """Expose a burst into the module's memory, then upload it.

        Parameters
        ----------
        frames
            At least 1, at most what the module's memory holds.

        Returns
        -------
        Burst with the host's monotonic time of each frame's start of exposure, from the synchronised clock.

        Raises
        ------
        ConfigError
            More frames than the module's memory holds.
        LinkLostError, ModuleSilentError, LinkTooBadError, ModuleResetError, FirmwareError, ModuleRefusedError, ClockError
            See ``tof_serial.errors``; the next call starts from scratch.
        """
        module = self._open()
        if not 1 <= frames <= module.frames:
            raise ConfigError(f"frames: expected 1 to {module.frames}, which the module holds, got {frames}")
        try:
            return self._take(module, frames)
        except DeviceError:
            self.close()
            raise

    def _open(self) -> Info:
        if self._port is not None and self._module is not None:
            return self._module
        chunk = 1 << max(0, self._baud // 100).bit_length() - 1
        self._host = Host(Timing(), min(_LARGEST, max(_SMALLEST, chunk)))
        with ExitStack() as stack:
            port = stack.enter_context(Port(self._url, self._baud))
            module = port.run(self._host.hello())
            self._admit(module)
            self._first = port.run(self._host.sync())
            self._port, self._module = port, module
            stack.pop_all()  # opened; from now on close() closes it
        return module

    def _admit(self, module: Info) -> None:
        """Check that this is the module that was described, and remember what it says of itself."""
        where = f"[tof] {self._url}"
        check_firmware(module, self._table.get("firmware"))
        known = read_contact(self._contact)
        said = said_by(module)
        check_same(module, described(known if known is not None else said, self._table, where), where)
        write_contact(self._contact, said)

    def _take(self, module: Info, frames: int) -> TofBurst:
        port, host = self._port, self._host
        assert port is not None
        assert self._first is not None
        self._burst = self._burst % 0xFFFFFFFF + 1
        before = port.run(host.sync())
        port.run(host.expose(self._burst, frames, module.period_us))
        anchors = [self._first, before, port.run(host.sync())]
        metas, raw = self._upload(port, module, frames)
        port.run(host.release())
        return TofBurst(
            raw=raw,
            time_ns=_times(anchors, metas, module.period_us),
            celsius=np.array([meta.celsius for meta in metas]),
            info=self.describe(),
        )

    def _upload(self, port: Port, module: Info, frames: int) -> tuple[list[Frame], NDArray[np.uint16]]:
        shape = (len(module.hz), module.height, module.width)
        raw = np.empty((frames, *shape), dtype=np.uint16)
        metas = []
        for i in range(frames):
            meta, data = port.run(self._host.frame(self._burst, i, module.frame_bytes))
            raw[i] = values(data, shape, module.bits)
            metas.append(meta)
        return metas, raw


def _times(anchors: list[Anchor], metas: list[Frame], period_us: int) -> NDArray[np.int64]:
    """Host times (ns) of the exposures; refuses a clock that no crystal has, and times outside the burst."""
    rate = drift(anchors[0], anchors[-1])
    if abs(rate) > MOST_DRIFT:
        raise ClockError(
            f"the module's clock runs off by {rate * 1e6:.0f} ppm",
            hint="its clock is not a crystal's, or it jumped",
        )
    near = min(anchors[1:], key=lambda a: a.error_ns)
    times = np.array([to_host(near, rate, meta.clock_us) for meta in metas], dtype=np.int64)
    low, high = anchors[1].host_ns - anchors[1].error_ns, anchors[2].host_ns + anchors[2].error_ns
    if (np.diff(times) <= 0).any() or times[0] < low - MS or times[-1] > high + period_us * 1000:
        raise ClockError(
            "the frames' times do not lie in order within the burst", hint="the module's firmware is at fault"
        )
    return times
