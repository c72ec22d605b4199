"""The doctor's findings, and what it looks at in another process: libraries that may hang, crash or take long.

``python -m tofcapture.cli.doctor_probe NAME [ARGUMENT]`` is that other process; it prints findings as one JSON list.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

from tofcapture.errors import TofError


@dataclass(frozen=True)
class Finding:
    """One line of the doctor: what was looked at, PASS, WARN or FAIL, what was found, and what to do."""

    what: str
    verdict: str
    found: str
    advice: str = ""


def probe(name: str, *arguments: str, timeout: float = 60.0, severity: str = "FAIL") -> list[Finding]:
    """Look at something in a process of its own.

    Parameters
    ----------
    name
        One of :data:`PROBES`.
    arguments
        Of that probe.
    timeout
        Seconds until it is killed.
    severity
        Verdict when it hangs or crashes.
    """
    command = [sys.executable, "-m", "tofcapture.cli.doctor_probe", name, *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return [
            Finding(
                name,
                severity,
                f"no answer within {timeout:g} s",
                "install it again; is this machine overloaded, or a device's network address dead?",
            )
        ]
    try:
        return [Finding(**found) for found in json.loads(done.stdout)]
    except (ValueError, TypeError):
        return [
            Finding(name, severity, _end(done.returncode, done.stderr), f"{' '.join(command)} shows more")
        ]


def _end(code: int, stderr: str) -> str:
    """How a probe ended that said nothing."""
    if code < 0:
        try:
            return f"crashed with {signal.Signals(-code).name}"
        except ValueError:
            return f"crashed with signal {-code}"
    last = next((line for line in reversed(stderr.splitlines()) if line.strip()), "")
    return f"ended with {code}: {last}"


def _import(name: str, modules: tuple[str, ...], advice: str) -> list[Finding]:
    """Import modules; missing is a warning, broken a failure."""
    import importlib
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version(name)
    except PackageNotFoundError:
        return [Finding(name, "WARN", "not installed", advice)]
    try:
        for module in modules:
            importlib.import_module(module)
    except Exception as err:
        return [Finding(name, "FAIL", f"{found}, does not load: {type(err).__name__}: {err}", advice)]
    return [Finding(name, "PASS", f"{found}, loads")]


def look_at_open3d() -> list[Finding]:
    """open3d: does it load? A missing libusb is its usual trouble."""
    from importlib.metadata import PackageNotFoundError, version

    from tofcapture.o3d import load_open3d

    try:
        return [Finding("open3d", "PASS", f"{load_open3d().__version__}, loads")]
    except TofError as err:
        for name in ("open3d", "open3d-cpu"):
            try:
                version(name)
            except PackageNotFoundError:
                continue
            return [Finding("open3d", "FAIL", err.message, err.hint)]
        return [Finding("open3d", "WARN", err.message, err.hint)]


def look_at_ur_rtde() -> list[Finding]:
    """The Universal Robots client."""
    modules = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client")
    return _import("ur-rtde", modules, "pip install 'tofcapture[hardware]', for arms of Universal Robots")


def look_at_nxlib() -> list[Finding]:
    """The Ensenso client, and the SDK behind it."""
    found = _import("nxlib", ("nxlib",), "pip install 'tofcapture[hardware]', for Ensenso cameras")
    if found[0].verdict != "PASS":
        return found
    from tofcapture.devices.ensenso import library

    try:
        with library(None):
            return [*found, Finding("Ensenso SDK", "PASS", "loads")]
    except TofError as err:
        return [*found, Finding("Ensenso SDK", "WARN", err.message, err.hint)]


def look_at_drivers() -> list[Finding]:
    """Device drivers: which there are, which do not import."""
    from tofcapture.devices.registry import found_drivers, load_driver

    out = []
    for name, entry in found_drivers().items():
        try:
            out.append(Finding(f"driver {name}", "PASS", ", ".join(sorted(load_driver(name)))))
        except TofError as err:
            advice = f"repair or uninstall what provides {entry.value}"
            out.append(Finding(f"driver {name}", "WARN", err.message, advice))
    return out or [
        Finding("drivers", "FAIL", "none is installed", "install the package: pip install tofcapture")
    ]


def look_at_commands() -> list[Finding]:
    """Commands: each imports, and only one package provides it."""
    from importlib.metadata import entry_points

    from tofcapture.command import Command

    out, names = [], [e.name for e in entry_points(group="tofcapture.commands")]
    for entry in sorted(entry_points(group="tofcapture.commands"), key=lambda e: e.name):
        try:
            whole = isinstance(entry.load(), Command)
            broken = "" if whole else f"{entry.value} is no command"
        except Exception as err:
            broken = f"{type(err).__name__}: {err}"
        if broken or names.count(entry.name) > 1:
            found = broken or f"{names.count(entry.name)} packages provide it"
            advice = f"install again, or uninstall, what provides {entry.value}"
            out.append(Finding(f"command {entry.name}", "FAIL" if broken else "WARN", found, advice))
    return out or [Finding("commands", "PASS", f"{len(names)}, all import")]


def group_advice(port: Path) -> str:
    """How to get at a device file."""
    import grp

    try:
        group = grp.getgrgid(port.stat().st_gid).gr_name
    except (KeyError, OSError):
        return f"ask the owner of {port}"
    return f"sudo usermod -aG {group} $USER, then log in again"


def look_at_station(path: str, opening: str = "") -> list[Finding]:
    """A station's file, drivers, rig and devices."""
    from tofcapture.cli import doctor_station

    return doctor_station.look_at_station(path, opening)


PROBES: dict[str, Callable[..., list[Finding]]] = {
    "open3d": look_at_open3d,
    "ur-rtde": look_at_ur_rtde,
    "nxlib": look_at_nxlib,
    "drivers": look_at_drivers,
    "commands": look_at_commands,
    "station": look_at_station,
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
