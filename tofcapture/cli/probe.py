"""What the doctor looks at in processes of their own, because it may hang, crash or take long.

``python -m tofcapture.cli.probe NAME [ARGUMENT]`` is such a process; it prints findings as one JSON list.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command
from tofcapture.errors import TofError


@dataclass(frozen=True)
class Finding:
    """One line of the doctor: what was looked at, PASS, WARN or FAIL, what was found, and what to do."""

    what: str
    verdict: str
    found: str
    advice: str = ""


def attempt(what: str, action: Callable[[], str], verdict: str = "FAIL", said: str = "") -> Finding:
    """Do something that says what it found; an error becomes a finding in its own words."""
    try:
        return Finding(what, "PASS", action())
    except TofError as err:
        return Finding(what, verdict, said + err.message, err.hint)


def probe(name: str, *arguments: str, timeout: float = 60.0) -> list[Finding]:
    """Look at something in a process of its own; one that hangs or crashes is a FAIL.

    Parameters
    ----------
    name, arguments
        One of :data:`PROBES`, and what it takes.
    timeout
        Seconds until it is killed.
    """
    command = [sys.executable, "-m", "tofcapture.cli.probe", name, *arguments]
    pipe = subprocess.PIPE
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=pipe,
            stderr=pipe,
            text=True,
            timeout=timeout,
            check=False,
        )
    except subprocess.TimeoutExpired:
        advice = "install it again; is this machine overloaded, or a device's network address dead?"
        return [Finding(name, "FAIL", f"no answer within {timeout:g} s", advice)]
    try:
        return [Finding(**found) for found in json.loads(done.stdout)]
    except (ValueError, TypeError):
        said = _end(done.returncode, done.stderr)
        return [Finding(name, "FAIL", said, f"{' '.join(command)} shows more")]


def _end(code: int, stderr: str) -> str:
    """How a probe ended that said nothing."""
    if code < 0:
        return f"crashed with {signal.Signals(-code).name if -code in set(signal.Signals) else f'signal {-code}'}"
    last = next((line for line in reversed(stderr.splitlines()) if line.strip()), "")
    return f"ended with {code}: {last}"


def _version(*names: str) -> str | None:
    for name in names:
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return None


def _import(name: str, modules: tuple[str, ...], advice: str) -> Finding:
    """Import modules; missing is a warning, broken a failure."""
    if (found := _version(name)) is None:
        return Finding(name, "WARN", "not installed", advice)
    try:
        for module in modules:
            importlib.import_module(module)
    except Exception as err:
        return Finding(name, "FAIL", f"{found}, does not load: {type(err).__name__}: {err}", advice)
    return Finding(name, "PASS", f"{found}, loads")


def probe_open3d() -> Iterator[Finding]:
    """Load open3d; a missing libusb is its usual trouble."""
    from tofcapture.libraries import load_open3d

    verdict = "FAIL" if _version("open3d", "open3d-cpu") else "WARN"
    yield attempt("open3d", lambda: f"{load_open3d().__version__}, loads", verdict)


def probe_ur_rtde() -> Iterator[Finding]:
    """Load the Universal Robots client."""
    modules = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client")
    yield _import("ur-rtde", modules, "pip install 'tofcapture[hardware]', for arms of Universal Robots")


def probe_nxlib() -> Iterator[Finding]:
    """Load the Ensenso client, and the SDK behind it."""
    found = _import("nxlib", ("nxlib",), "pip install 'tofcapture[hardware]', for Ensenso cameras")
    yield found
    if found.verdict == "PASS":
        yield attempt("Ensenso SDK", _load_ensenso, "WARN")


def _load_ensenso() -> str:
    from tofcapture.devices.ensenso import library

    with library(None):
        return "loads"


def probe_drivers() -> Iterator[Finding]:
    """Import every device driver."""
    from tofcapture.devices.registry import found_drivers, load_driver

    drivers = found_drivers()
    for name, entry in drivers.items():
        try:
            yield Finding(f"driver {name}", "PASS", ", ".join(sorted(load_driver(name))))
        except TofError as err:
            advice = f"repair or uninstall what provides {entry.value}"
            yield Finding(f"driver {name}", "WARN", err.message, advice)
    if not drivers:
        yield Finding("drivers", "FAIL", "none is installed", "install the package: pip install tofcapture")


def probe_commands() -> Iterator[Finding]:
    """Import every command; only one package may provide it."""
    entries = sorted(entry_points(group="tofcapture.commands"), key=lambda e: e.name)
    names, whole = [e.name for e in entries], True
    for entry in entries:
        try:
            broken = "" if isinstance(entry.load(), Command) else f"{entry.value} is no command"
        except Exception as err:
            broken = f"{type(err).__name__}: {err}"
        if broken or names.count(entry.name) > 1:
            whole = False
            found = broken or f"{names.count(entry.name)} packages provide it"
            advice = f"install again, or uninstall, what provides {entry.value}"
            yield Finding(f"command {entry.name}", "FAIL" if broken else "WARN", found, advice)
    if whole:
        yield Finding("commands", "PASS", f"{len(names)}, all import")


def probe_station(path: str, opening: str = "") -> Iterator[Finding]:
    """Read a station's file, make its drivers, ask whether its devices are there; with ``opening`` open them too."""
    from tofcapture.devices.clearance import stage_of
    from tofcapture.devices.registry import ROLES, StationContext
    from tofcapture.devices.station import open_station, read_station

    file = Path(path) if path else None
    context = StationContext(config={}, folder=(file or Path()).resolve().parent)

    def read() -> str:
        nonlocal context
        context = replace(context, config=read_station(file))
        stage_of(context.config)
        return f"{path or 'the simulated one'} is read"

    def open_all() -> str:
        with open_station(file) as station:
            joints = ", ".join(f"{q:.2f}" for q in station.arm.state().joints)
            return f"all open; the arm stands at {joints} rad"

    found = [attempt("station", read)]
    if found[0].verdict == "PASS":
        found += [finding for role in ROLES for finding in _probe_device(role, context)]
        found += _probe_rig(context)
    if opening and all(f.verdict != "FAIL" for f in found):
        found.append(attempt("devices", open_all))
    yield from found


def _probe_device(role: str, context: Any) -> Iterator[Finding]:
    """Make and describe a device, and ask whether it is there where that disturbs nothing."""
    from tofcapture.devices.registry import make_device

    try:
        device = make_device(role, context)
    except TofError as err:
        yield Finding(role, "FAIL", err.message, err.hint)
        return
    said = f"driver {context.config[role]['driver']}"
    described = True
    if role != "operator":
        try:
            info = device.describe()
            said = f"{said}: {info.model} {info.serial}".rstrip()
        except TofError as err:
            described = False
            yield Finding(role, "WARN", err.message, err.hint)
    found = attempt(role, device.probe, said=f"{said}: ")
    if found.verdict == "PASS":
        found = replace(found, found=f"{said}; {found.found}" if found.found else said)
    if found.verdict != "PASS" or described or found.found != said:
        yield found


def _probe_rig(context: Any) -> Iterator[Finding]:
    """Read the rig that the station names, unless a driver knows it."""
    from tofcapture.rig import load_rig

    if path := context.config.get("rig", {}).get("path"):
        yield attempt("rig", lambda: str(load_rig(context.folder / str(path)) and path))
    elif "rig" not in context.shared:
        advice = 'add [rig] path = "rig.toml", the bracket\'s drawing for a start; see docs/formats.md'
        yield Finding("rig", "FAIL", "the station names none", advice)


PROBES: dict[str, Callable[..., Iterator[Finding]]] = {
    "open3d": probe_open3d,
    "ur-rtde": probe_ur_rtde,
    "nxlib": probe_nxlib,
    "drivers": probe_drivers,
    "commands": probe_commands,
    "station": probe_station,
}


def main() -> None:
    """Make one probe, print what it found."""
    # What libraries print must not get into the answer, and what they do at exit must not spoil it.
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        found = PROBES[sys.argv[1]](*sys.argv[2:])
        print(json.dumps([asdict(f) for f in found]), file=out, flush=True)
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    os._exit(0)


if __name__ == "__main__":
    main()
