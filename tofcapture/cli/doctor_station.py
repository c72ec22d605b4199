"""What the doctor looks at in a station; runs in the doctor's other process."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tofcapture.cli.doctor_probe import Finding, group_advice
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
    out += _look_at_rig(config, folder)
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
    table = context.config[role]
    driver, out = table["driver"], []
    said = f"driver {driver}"
    if hasattr(device, "describe"):
        try:
            info = device.describe()
            said = f"driver {driver}: {info.model} {info.serial}".rstrip()
        except TofError as err:
            out.append(Finding(role, "WARN", err.message, err.hint))
    asked = _ASK.get((role, driver))
    if asked:
        out.append(asked(role, said, table))
    return out or [Finding(role, "PASS", said)]


def _look_at_rig(config: Mapping[str, Any], folder: Path) -> list[Finding]:
    """The rig that the station names; simulated cameras know theirs."""
    from tofcapture.rig import load_rig

    path = config.get("rig", {}).get("path")
    if path:
        try:
            load_rig(folder / str(path))
        except TofError as err:
            return [Finding("rig", "FAIL", err.message, err.hint)]
        return [Finding("rig", "PASS", str(path))]
    if {config.get(role, {}).get("driver") for role in ("tof", "stereo")} & {"sim", "replay"}:
        return []
    advice = 'add [rig] path = "rig.toml", the bracket\'s drawing for a start; see docs/formats.md'
    return [Finding("rig", "FAIL", "the station names none", advice)]


def _ask_ur(role: str, said: str, table: Mapping[str, Any]) -> Finding:
    """Go through the controller's handshake; nothing is sent that moves."""
    from tofcapture.devices.ur_rtde.probe import probe as ask
    from tofcapture.devices.ur_rtde.settings import read_settings

    try:
        there = ask(read_settings({k: v for k, v in table.items() if k != "driver"}))
    except TofError as err:
        return Finding(role, "FAIL", err.message, err.hint)
    version = ".".join(map(str, there.version))
    return Finding(role, "PASS", f"{said}; PolyScope {version}, arm {there.serial or 'unknown'} is ready")


def _ask_serial(role: str, said: str, table: Mapping[str, Any]) -> Finding:
    """Look whether the port is there, and ours."""
    port = str(table.get("port", ""))
    if "://" in port or not port:
        return Finding(role, "PASS", said)
    if not Path(port).exists():
        return Finding(role, "FAIL", f"{said}: {port} is not there", "plug it in; ls /dev/serial/by-id")
    if not os.access(port, os.R_OK | os.W_OK):
        return Finding(role, "FAIL", f"{said}: {port} is not ours to use", group_advice(Path(port)))
    return Finding(role, "PASS", f"{said}; {port} is there")


_ASK: dict[tuple[str, str], Callable[[str, str, Mapping[str, Any]], Finding]] = {
    ("arm", "ur_rtde"): _ask_ur,
    ("tof", "tof_serial"): _ask_serial,
}
