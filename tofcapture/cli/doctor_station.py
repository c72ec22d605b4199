"""What the doctor looks at in a station; runs in the doctor's other process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tofcapture.cli.doctor_probe import Finding
from tofcapture.errors import TofError


def look_at_station(path: str, opening: str = "") -> list[Finding]:
    """A station: its file, its drivers, and whether its devices answer; with ``opening`` they are opened too."""
    from tofcapture.devices.clearance import stage_of
    from tofcapture.devices.registry import ROLES, StationContext
    from tofcapture.devices.station import open_station, read_station

    file = Path(path) if path else None
    try:
        config = read_station(file)
        stage_of(config)
    except TofError as err:
        return [Finding("station", "FAIL", err.message, err.hint)]
    folder = (file or Path()).resolve().parent
    out = [Finding("station", "PASS", f"{path or 'the simulated one'} is read")]
    context = StationContext(config=config, folder=folder)
    for role in ROLES:
        out += _look_at_device(role, context)
    out += _look_at_rig(context)
    if opening and not any(f.verdict == "FAIL" for f in out):
        try:
            with open_station(file) as station:
                joints = ", ".join(f"{q:.2f}" for q in station.arm.state().joints)
                out.append(Finding("devices", "PASS", f"all open; the arm stands at {joints} rad"))
        except TofError as err:
            out.append(Finding("devices", "FAIL", err.message, err.hint))
    return out


def _look_at_device(role: str, context: Any) -> list[Finding]:
    """One device: made, described, and asked whether it is there where that disturbs nothing."""
    from tofcapture.devices.registry import make_device

    try:
        device = make_device(role, context)
    except TofError as err:
        return [Finding(role, "FAIL", err.message, err.hint)]
    said = f"driver {context.config[role]['driver']}"
    out = []
    if role != "operator":
        try:
            info = device.describe()
            said = f"{said}: {info.model} {info.serial}".rstrip()
        except TofError as err:
            out.append(Finding(role, "WARN", err.message, err.hint))
    try:
        there = device.probe()
    except TofError as err:
        return [*out, Finding(role, "FAIL", f"{said}: {err.message}", err.hint)]
    if there or not out:
        out.append(Finding(role, "PASS", f"{said}; {there}" if there else said))
    return out


def _look_at_rig(context: Any) -> list[Finding]:
    """The rig that the station names, unless a driver knows it."""
    from tofcapture.rig import load_rig

    path = context.config.get("rig", {}).get("path")
    if path:
        try:
            load_rig(context.folder / str(path))
        except TofError as err:
            return [Finding("rig", "FAIL", err.message, err.hint)]
        return [Finding("rig", "PASS", str(path))]
    if "rig" in context.shared:
        return []
    advice = 'add [rig] path = "rig.toml", the bracket\'s drawing for a start; see docs/formats.md'
    return [Finding("rig", "FAIL", "the station names none", advice)]
