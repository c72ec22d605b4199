"""The driver ``tof_serial``: a ToF module on a serial link."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import (
    ReopenedCamera,
    described,
    read_description,
    tof_info,
    write_description,
)
from tofcapture.devices.registry import check_keys
from tofcapture.devices.tof_serial.clock import Anchor, burst_times
from tofcapture.devices.tof_serial.messages import Info
from tofcapture.devices.tof_serial.packet import values
from tofcapture.devices.tof_serial.port import Port
from tofcapture.devices.tof_serial.session import FirmwareError, LinkLostError, Session
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo
from tofcapture.rig import camera_table

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_SETTINGS = ("port", "baud", "firmware", "description")
_DESCRIPTION = (
    "model", "serial", "camera", "illuminator", "modulation_hz", "phase_rad", "exposure", "saturation", "range_errors",
    "offset", "reach", "noise",
)  # fmt: skip
_BAUD = 921_600
_SMALLEST, _LARGEST = 512, 16384  # bytes of a chunk


class SerialTof(ReopenedCamera, TofCamera):
    """A module that speaks docs/serial-protocol.md.

    Parameters
    ----------
    table
        ``port`` (device or pyserial URL), ``baud``, ``firmware`` ("1.0": accept no other), ``description`` (file that
        keeps what the module said of itself), and anything of TofInfo to override it.
    context
        The station; relative paths start at its folder.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        check_keys(table, (*_SETTINGS, *_DESCRIPTION), "[tof]")
        if not isinstance(table.get("port"), str):
            raise ConfigError(f"[tof] port: expected a device or URL, got {table.get('port')!r}")
        self._table, self._url = dict(table), str(table["port"])
        self._where = f"[tof] {self._url}"
        self._baud = int(table.get("baud", _BAUD))
        self._file = Path(context.folder) / str(table.get("description", "tof-description.toml"))
        self._port = Port(self._url, self._baud)
        self._session = Session()
        self._module: Info | None = None
        self._first: Anchor | None = None
        # Numbers a burst for as long as the module remembers it, also across restarts of this process.
        self._burst = int.from_bytes(os.urandom(4), "little")

    def describe(self) -> TofInfo:
        """Say what this camera is, from ``station.toml`` and the description file; opens nothing.

        Raises ConfigError when the module was never opened and ``station.toml`` does not say everything.
        """
        return self._described(_said_by(self._module) if self._module else read_description(self._file))

    def _described(self, said: Mapping[str, Any] | None) -> TofInfo:
        plain = {"range_errors": [], "offset": True, "reach": None, "noise": None}
        known = {"illuminator": [0.0, 0.0, 0.0], **plain, **(said or {})}
        table = described(known, self._table, _DESCRIPTION, self._where)
        return tof_info(table, self._where, "docs/serial-protocol.md, station.toml")

    def probe(self) -> str:
        """Look whether the port is there, and ours; a URL cannot be looked at."""
        path = Path(self._url)
        if "://" in self._url:
            return ""
        if not path.exists():
            raise LinkLostError(f"{self._url} is not there", hint="plug it in; ls /dev/serial/by-id")
        if not os.access(path, os.R_OK | os.W_OK):
            raise LinkLostError(
                f"{self._url} is not ours to use",
                hint=f"ls -l {path} shows its group: sudo usermod -aG GROUP $USER, then log in again",
            )
        return f"{self._url} is there"

    def capture(self, frames: int) -> TofBurst:
        """Expose a burst into the module's memory, then upload it.

        Returns the burst with the host's monotonic time of each frame's start of exposure, from the synchronised
        clock.

        Raises :class:`ConfigError`: more frames than the module's memory holds; :class:`LinkLostError`,
        :class:`ModuleSilentError`, :class:`LinkTooBadError`, :class:`ModuleResetError`,
        :class:`FirmwareError`, :class:`ModuleRefusedError`, :class:`ClockError`: see ``tof_serial.session``;
        the next call starts from scratch.
        """
        with self.opened():
            module = self._module
            assert module is not None
            if not 1 <= frames <= module.frames:
                raise ConfigError(
                    f"frames: expected 1 to {module.frames}, which the module holds, got {frames}"
                )
            return self._take(module, frames)

    def connect(self, stack: ExitStack) -> None:
        """Open the port, greet the module, see that it is the described one, and compare clocks."""
        chunk = 1 << max(0, self._baud // 100).bit_length() - 1
        session = self._session = Session(largest_chunk=min(_LARGEST, max(_SMALLEST, chunk)))
        port = stack.enter_context(self._port)
        module = port.run(session.hello())
        _check_firmware(module, self._table.get("firmware"))
        known, said = read_description(self._file), _said_by(module)
        _check_same(module, self._described(said if known is None else known), self._where)
        write_description(self._file, said)
        self._first = port.run(session.sync())
        self._module = module

    def _take(self, module: Info, frames: int) -> TofBurst:
        port, session = self._port, self._session
        assert self._first is not None
        self._burst = self._burst % 0xFFFFFFFF + 1
        before = port.run(session.sync())
        port.run(session.expose(self._burst, frames, module.period_us))
        anchors = [self._first, before, port.run(session.sync())]
        shape = (len(module.hz), module.height, module.width)
        raw = np.empty((frames, *shape), dtype=np.uint16)
        metas = []
        for i in range(frames):
            meta, data = port.run(session.frame(self._burst, i, module.frame_bytes))
            raw[i] = values(data, shape, module.bits)
            metas.append(meta)
        port.run(session.release())
        return TofBurst(
            raw=raw,
            time_ns=burst_times(anchors, [meta.clock_us for meta in metas], module.period_us),
            celsius=np.array([meta.celsius for meta in metas]),
            info=self.describe(),
        )


def _said_by(info: Info) -> dict[str, Any]:
    """Turn INFO into the table of a TofInfo; without ``camera`` where the module does not know its intrinsics."""
    table: dict[str, Any] = {
        "model": info.model,
        "serial": info.serial,
        "size": [info.width, info.height],
        "illuminator": [um * 1e-6 for um in info.illuminator_um],
        "modulation_hz": [float(hz) for hz in info.hz],
        "phase_rad": [turn * 2 * np.pi / 65536 for turn in info.phase],
        "exposure": info.exposure_us * 1e-6,
        "saturation": float(2**info.bits - 1),
        "range_errors": [],
    }
    if all(info.intrinsics[:2]):
        fx, fy, cx, cy = (v / 65536 for v in info.intrinsics)
        table["camera"] = camera_table(Camera(info.width, info.height, fx, fy, cx, cy))
    return table


def _check_same(info: Info, described_as: TofInfo, where: str) -> None:
    """Refuse a module with another serial number, image size or number of phase images than the described one."""
    pairs = {
        "serial": (described_as.serial, info.serial),
        "image size": (described_as.camera.shape, (info.height, info.width)),
        "phase images": (len(described_as.modulation_hz), len(info.hz)),
    }
    for what, (expected, got) in pairs.items():
        if expected != got:
            raise DeviceError(
                f"{where}: {what}: expected {expected}, the module says {got}",
                hint="another module is plugged in; name its port, or delete the description file",
            )


def _check_firmware(info: Info, wanted: str | None) -> None:
    """Refuse firmware other than the station's ``firmware = "major.minor"``."""
    found = f"{info.firmware[0]}.{info.firmware[1]}"
    if wanted is not None and wanted != found:
        raise FirmwareError(
            f"the module's firmware: expected {wanted}, got {found}",
            hint="flash that version, or change firmware in [tof] and begin a new recording",
        )
