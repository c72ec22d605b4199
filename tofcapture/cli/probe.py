"""Define what the doctor looks at in processes of their own, because it may hang, crash or take long.

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
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command
from tofcapture.errors import ConfigError, TofError

_RTDE = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client")
_UR_ARMS = "arms of Universal Robots (newer than Python 3.12: apt-get install cmake libboost-all-dev first)"


@dataclass(frozen=True)
class Finding:
    """One line of the doctor: what was looked at, PASS, WARN or FAIL, what was found, and what to do."""

    what: str
    verdict: str
    found: str
    advice: str = ""


def graded(what: str, found: str, advice: str = "", bad: str = "WARN") -> Finding:
    """Make a finding that is bad where there is advice."""
    return Finding(what, bad if advice else "PASS", found, advice)


def attempt(what: str, action: Callable[[], str], bad: str = "FAIL") -> Finding:
    """Do something that says what it found; an error becomes a finding in its own words."""
    try:
        return Finding(what, "PASS", action())
    except TofError as err:
        return Finding(what, bad, err.message, err.hint)


def installed_version(name: str) -> str | None:
    """Find the version of an installed package; ``None`` when it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def probe(name: str, *arguments: str, timeout: float = 0.0) -> list[Finding]:
    """Make one of :data:`PROBES` in a process of its own; one that hangs or crashes is a FAIL.

    It is killed after ``timeout`` seconds; 0: what it usually needs at most.
    """
    # A UR arm's handshake may take seconds at each of its stages.
    timeout = timeout or (60.0 if name != "station" else 180.0 if any(arguments[1:]) else 90.0)
    command = [sys.executable, "-m", "tofcapture.cli.probe", name, *arguments]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout, check=False
        )
        return [Finding(**found) for found in json.loads(done.stdout)]
    except subprocess.TimeoutExpired:
        advice = "install it again; is this machine overloaded, or a device's network address dead?"
        return [Finding(name, "FAIL", f"no answer within {timeout:g} s", advice)]
    except (ValueError, TypeError):
        return [Finding(name, "FAIL", _end(done), f"{' '.join(command)} shows more")]


def _end(done: subprocess.CompletedProcess[str]) -> str:
    """Say how a probe ended that said nothing."""
    signals = {-number: number.name for number in signal.Signals}
    if done.returncode < 0:
        return f"crashed with {signals.get(done.returncode, f'signal {-done.returncode}')}"
    last = next((line for line in reversed(done.stderr.splitlines()) if line.strip()), "")
    return f"ended with {done.returncode}: {last}"


def _import(name: str, modules: tuple[str, ...], extra: str, use: str) -> Finding:
    """Import modules; missing is a warning, broken a failure."""
    advice = f"pip install 'tofcapture[{extra}]', for {use}"
    if (found := installed_version(name)) is None:
        return graded(name, "not installed", advice)
    try:
        for module in modules:
            importlib.import_module(module)
    except Exception as err:
        return graded(name, f"{found}, does not load: {type(err).__name__}: {err}", advice, "FAIL")
    return graded(name, f"{found}, loads")


def probe_open3d() -> Iterator[Finding]:
    """Load open3d; a missing libusb is its usual trouble."""
    from tofcapture.libraries import load_open3d

    there = installed_version("open3d") or installed_version("open3d-cpu")
    yield attempt("open3d", lambda: f"{load_open3d().__version__}, loads", "FAIL" if there else "WARN")


def probe_kernels() -> Iterator[Finding]:
    """Look whether machine code can be kept; a user without a home folder may have no place for it."""
    from tofcapture.libraries import keeps_kernels

    kept = keeps_kernels()
    advice = "set NUMBA_CACHE_DIR to a folder of yours: each command now compiles anew, for up to a minute"
    yield graded("compiled code", "can be kept" if kept else "cannot be kept", "" if kept else advice)


def probe_nxlib() -> Iterator[Finding]:
    """Load the Ensenso client, and the SDK behind it."""
    found = _import("nxlib", ("nxlib",), "ensenso", "Ensenso cameras")
    yield found
    if found.verdict == "PASS":
        yield attempt("Ensenso SDK", _load_ensenso, "WARN")


def _load_ensenso() -> str:
    from tofcapture.devices.stereo.ensenso import library

    with library(None):
        return "loads"


def probe_drivers() -> Iterator[Finding]:
    """Import every device driver."""
    from tofcapture.devices.registry import found_drivers, load_driver

    drivers = found_drivers()
    for name, entry in drivers.items():
        try:
            yield graded(f"driver {name}", ", ".join(sorted(load_driver(name))))
        except TofError as err:
            yield graded(f"driver {name}", err.message, f"repair or uninstall what provides {entry.value}")
    if not drivers:
        yield graded("drivers", "none is installed", "install the package: pip install tofcapture", "FAIL")


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
            yield graded(f"command {entry.name}", found, advice, "FAIL" if broken else "WARN")
    if whole:
        yield graded("commands", f"{len(names)}, all import")


def probe_station(path: str, opening: str = "") -> Iterator[Finding]:
    """Read a station's file, make its drivers, ask whether its devices are there; with ``opening`` open them too."""
    from tofcapture.devices.clearance import workcell_of
    from tofcapture.devices.kinematics import pose_error
    from tofcapture.devices.registry import ROLES, StationContext
    from tofcapture.devices.station import open_station, read_station

    file = Path(path) if path else None
    try:
        config = read_station(file)
        workcell = workcell_of(config) if "plan" in config else None
    except TofError as err:
        yield Finding("station", "FAIL", err.message, err.hint)
        return
    yield graded("station", f"{path or 'the simulated one'} is read")
    context = StationContext(config=config, folder=(file or Path()).resolve().parent)
    found = [finding for role in ROLES for finding in _probe_device(role, context)]
    found += _probe_rig(context)
    found += _probe_arm(context, workcell)
    yield from found

    def open_all() -> str:
        with open_station(file) as station:
            if station.arm.by_hand:
                return "all open; the rig has no motors"
            state = station.arm.state()
            if wrong := pose_error(station.arm.kinematics(), state.joints, state.T_base_flange):
                raise ConfigError(wrong, hint="correct the kinematics: every check of a way rests on them")
            joints = ", ".join(f"{q:.2f}" for q in state.joints)
            return f"all open; the arm stands at {joints} rad, where its kinematics have it"

    if opening and all(f.verdict != "FAIL" for f in found):
        yield attempt("devices", open_all)


def _probe_device(role: str, context: Any) -> Iterator[Finding]:
    """Make and describe a device, and ask whether it is there where that disturbs nothing."""
    from tofcapture.devices.registry import make_device

    try:
        device = make_device(role, context)
    except TofError as err:
        yield Finding(role, "FAIL", err.message, err.hint)
        return
    said, warned = f"driver {context.config[role]['driver']}", False
    if role != "operator":
        try:
            info = device.describe()
            said = f"{said}: {info.model} {info.serial}".rstrip()
        except TofError as err:
            warned = True
            yield Finding(role, "WARN", err.message, err.hint)
    try:
        there = device.probe()
    except TofError as err:
        yield Finding(role, "FAIL", f"{said}: {err.message}", err.hint)
        return
    if there or not warned:
        yield graded(role, f"{said}; {there}" if there else said)


def _probe_arm(context: Any, workcell: Any) -> Iterator[Finding]:
    """See whether views can be planned for the arm: its kinematics, and a home that is clear; and what it does without."""
    from tofcapture.devices.clearance import REASONS, obstacles
    from tofcapture.devices.kinematics import check_joints
    from tofcapture.devices.registry import arm_kinematics, make_device
    from tofcapture.rig import load_rig

    try:
        arm = make_device("arm", context)
    except TofError:
        return  # that has been said
    for caution in arm.cautions():
        yield graded("arm caution", caution, "take the setting out, unless this arm cannot do otherwise")

    if arm.by_hand:
        return
    if workcell is None:
        hint = 'by hand there is none: driver = "manual"'
        yield Finding(
            "station", "FAIL", "expected a table [plan] that says where the table and the object stand", hint
        )
        return

    def home() -> str:
        model = arm_kinematics(arm, context)
        check_joints(model, workcell.home)
        path = context.config.get("rig", {}).get("path")
        rig = load_rig(context.folder / str(path)) if path else context.shared.get("rig")
        if rig is None:
            return f"{model.name}; whether home is clear is not known without a rig"
        hits = obstacles(model, rig, workcell, workcell.home)
        if met := [reason for reason, hit in zip(REASONS, hits, strict=True) if hit]:
            raise ConfigError(
                f"[plan] home is not clear: {', '.join(met)}", hint="choose another: angles in radians"
            )
        return f"{model.name}; home is clear"

    yield attempt("arm kinematics", home)


def _probe_rig(context: Any) -> Iterator[Finding]:
    """Read the rig that the station names, unless a driver knows it."""
    from tofcapture.rig import load_rig

    if path := context.config.get("rig", {}).get("path"):
        yield attempt("rig", lambda: str(load_rig(context.folder / str(path)) and path))
    elif "rig" not in context.shared:
        advice = 'add [rig] path = "rig.toml", the bracket\'s drawing for a start; see docs/formats.md'
        yield graded("rig", "the station names none", advice, "FAIL")


PROBES: dict[str, Callable[..., Iterator[Finding]]] = {
    "open3d": probe_open3d,
    "ur-rtde": lambda: iter([_import("ur-rtde", _RTDE, "ur", _UR_ARMS)]),
    "nxlib": probe_nxlib,
    "compiled code": probe_kernels,
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
