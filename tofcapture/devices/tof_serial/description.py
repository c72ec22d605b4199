"""A module's description: what it says of itself, what its contact file says, and what ``station.toml`` overrides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices.tof_serial.errors import FirmwareError
from tofcapture.devices.tof_serial.messages import Info
from tofcapture.errors import ConfigError, DeviceError, FormatError
from tofcapture.files.info import tof_from
from tofcapture.frames import TofInfo
from tofcapture.rig import camera_table

OVERRIDES = (
    "model", "serial", "camera", "illuminator", "modulation_hz", "phase_rad", "exposure", "saturation", "range_errors",
)  # fmt: skip


def said_by(info: Info) -> dict[str, Any]:
    """Table of a TofInfo (see ``files.info.tof_table``) from INFO; without ``camera`` where the module does not know it."""
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


def described(said: Mapping[str, Any] | None, table: Mapping[str, Any], where: str) -> TofInfo:
    """Lay ``station.toml``'s ``[tof]`` over what the module said.

    Parameters
    ----------
    said
        From :func:`said_by` or the contact file; ``None`` before the first contact.
    table
        The station's ``[tof]``.
    where
        For messages.

    Raises
    ------
    ConfigError
        Something is missing or impossible.
    """
    base = {"illuminator": [0.0, 0.0, 0.0], "range_errors": [], **(said or {})}
    merged = {**base, **{k: table[k] for k in OVERRIDES if k in table}}
    missing = [k for k in OVERRIDES if k not in merged]
    if missing:
        raise ConfigError(
            f"{where}: expected {', '.join(missing)}, which the module has not said",
            hint="open the module once, or write them into [tof] (intrinsics: [tof.camera])",
        )
    try:
        info = tof_from(merged, where)
    except FormatError as err:
        raise ConfigError(err.message, hint="see docs/serial-protocol.md, station.toml") from err
    if len(info.phase_rad) != len(info.modulation_hz):
        raise ConfigError(f"{where}: expected one phase_rad for each modulation_hz")
    return info


def check_same(info: Info, described_as: TofInfo, where: str) -> None:
    """Refuse a module that is not the described one.

    Raises
    ------
    DeviceError
        Another serial number, image size or number of phase images.
    """
    pairs = {
        "serial": (described_as.serial, info.serial),
        "image size": (described_as.camera.shape, (info.height, info.width)),
        "phase images": (len(described_as.modulation_hz), len(info.hz)),
    }
    for what, (expected, got) in pairs.items():
        if expected != got:
            raise DeviceError(
                f"{where}: {what}: expected {expected}, the module says {got}",
                hint="another module is plugged in; name its port, or delete the contact file",
            )


def check_firmware(info: Info, wanted: str | None) -> None:
    """Refuse firmware other than the station's ``firmware = "major.minor"``.

    Raises
    ------
    FirmwareError
        Another version.
    """
    found = f"{info.firmware[0]}.{info.firmware[1]}"
    if wanted is not None and wanted != found:
        raise FirmwareError(
            f"the module's firmware: expected {wanted}, got {found}",
            hint="flash that version, or change firmware in [tof] and begin a new recording",
        )
