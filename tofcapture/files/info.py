"""Descriptions of cameras as JSON tables; floats keep every bit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import FormatError, TofError
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.rig import camera_from, camera_table, range_error_from, range_error_table


def dumps(value: Any) -> str:
    """Write JSON with sorted keys; numpy scalars and arrays become plain numbers, floats keep every bit."""
    return json.dumps(value, sort_keys=True, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"expected JSON types, got {type(value).__name__}")


def tof_table(info: TofInfo) -> dict[str, Any]:
    """Describe a ToF camera as JSON types."""
    return {
        "model": info.model,
        "serial": info.serial,
        "camera": camera_table(info.camera),
        "illuminator": [float(x) for x in info.illuminator],
        "modulation_hz": [float(f) for f in info.modulation_hz],
        "phase_rad": [float(p) for p in info.phase_rad],
        "exposure": float(info.exposure),
        "saturation": float(info.saturation),
        "range_errors": [range_error_table(e) for e in info.range_errors],
    }


def tof_from(table: Mapping[str, Any], where: str) -> TofInfo:
    """Read what :func:`tof_table` wrote; :class:`FormatError` when something is missing or impossible."""
    try:
        return TofInfo(
            model=str(table["model"]),
            serial=str(table["serial"]),
            camera=camera_from(table["camera"], where),
            illuminator=np.asarray(table["illuminator"], dtype=np.float64),
            modulation_hz=tuple(float(f) for f in table["modulation_hz"]),
            phase_rad=tuple(float(p) for p in table["phase_rad"]),
            exposure=float(table["exposure"]),
            saturation=float(table["saturation"]),
            range_errors=tuple(range_error_from(e) for e in table["range_errors"]),
        )
    except (KeyError, TypeError, ValueError, TofError) as err:
        raise FormatError(f"{where}: tof_info does not describe a ToF camera: {err!r}") from err


def stereo_table(info: StereoInfo) -> dict[str, Any]:
    """Describe a stereo camera as JSON types."""
    return {"model": info.model, "serial": info.serial, "camera": camera_table(info.camera)}


def stereo_from(table: Mapping[str, Any], where: str) -> StereoInfo:
    """Read what :func:`stereo_table` wrote; :class:`FormatError` when something is missing or impossible."""
    try:
        return StereoInfo(str(table["model"]), str(table["serial"]), camera_from(table["camera"], where))
    except (KeyError, TypeError, ValueError, TofError) as err:
        raise FormatError(f"{where}: stereo_info does not describe a stereo camera: {err!r}") from err
