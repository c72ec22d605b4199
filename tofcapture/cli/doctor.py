"""``tofcapture doctor``: see whether everything is here that capturing, building and training need.

What may hang or crash (vendor libraries, open3d, third-party drivers, devices) is looked at in processes of their own, all at the
same time; this process imports none of it.
"""

from __future__ import annotations

import argparse
import platform
import shutil
import sqlite3
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tofcapture.cli.config import station_path
from tofcapture.cli.doctor_probe import Finding, probe
from tofcapture.cli.weights import bundled_path, describe_weights
from tofcapture.command import Command, Outcome
from tofcapture.errors import ConfigError, FormatError, TofError

_ORDER = ("FAIL", "WARN", "PASS")
Check = Callable[[], list[Finding]]

REQUIRED = {"numpy": "1.26", "h5py": "3.10"}
OPTIONAL = {
    "scipy": ("1.11", "capture"),
    "numba": ("0.60", "capture"),
    "threadpoolctl": ("3.1", "capture"),
    "rich": ("13", "capture"),
    "tomli-w": ("1.0", "capture"),
    "jinja2": ("3.1", "capture"),
    "kiss-icp": ("1.2", "capture"),
    "aiohttp": ("3.10", "daemon"),
    "pyserial": ("3.5", "hardware"),
    "distributed": ("2024.1", "cluster"),
    "small-gicp": ("1.0", "gicp"),
    "torch": ("2.6", "model"),
    "safetensors": ("0.5", "model"),
    "tensorboard": ("2.18", "train"),
    "matplotlib": ("3.8", "report"),
}


def _installed(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _older(found: str, least: str) -> bool:
    def numbers(text: str) -> list[int]:
        return [
            int("".join(filter(str.isdigit, part)) or 0) for part in text.partition("+")[0].split(".")[:3]
        ]

    return numbers(found) < numbers(least)


def check_python() -> list[Finding]:
    """Python itself."""
    found = platform.python_version()
    ok = sys.version_info >= (3, 11)
    here = Finding("python", "PASS" if ok else "FAIL", found, "" if ok else "install Python 3.11 or newer")
    return [here, *_own_version()]


def _own_version() -> list[Finding]:
    """Look at the package, as it runs and as it is installed, and at its program."""
    from tofcapture import __version__

    installed = _installed("tofcapture")
    if installed is None:
        found = Finding("tofcapture", "FAIL", f"{__version__} runs, but is not installed", "pip install .")
    elif installed != __version__:
        found = Finding(
            "tofcapture", "FAIL", f"{__version__} runs, {installed} is installed", "install again"
        )
    else:
        found = Finding("tofcapture", "PASS", __version__)
    program = shutil.which("tofcapture")
    if program is None:
        return [
            found,
            Finding("program", "WARN", "tofcapture is not on the PATH", "activate its environment"),
        ]
    return [found, Finding("program", "PASS", program)]


def check_libraries() -> list[Finding]:
    """Versions of libraries: the two that everything needs, and those of the extras."""
    out = [_library(name, least, "FAIL", "pip install tofcapture") for name, least in REQUIRED.items()]
    return out + [
        _library(n, least, "WARN", f"pip install 'tofcapture[{extra}]'")
        for n, (least, extra) in OPTIONAL.items()
    ]


def _library(name: str, least: str, severity: str, advice: str) -> Finding:
    found = _installed(name)
    if found is None:
        return Finding(name, severity, "not installed", advice)
    if _older(found, least):
        return Finding(name, severity, f"{found}, older than {least}", advice)
    return Finding(name, "PASS", found)


def check_opencv() -> list[Finding]:
    """OpenCV: exactly one of its wheels, for they overwrite each other's files."""
    names = (
        "opencv-python",
        "opencv-python-headless",
        "opencv-contrib-python",
        "opencv-contrib-python-headless",
    )
    wheels = [n for n in names if _installed(n)]
    if len(wheels) > 1:
        advice = f"pip uninstall -y {' '.join(wheels)} && pip install opencv-python-headless"
        return [Finding("opencv", "WARN", f"{' and '.join(wheels)} are both installed", advice)]
    if not wheels:
        return [Finding("opencv", "WARN", "not installed", "pip install 'tofcapture[capture]'")]
    return [Finding("opencv", "PASS", f"{wheels[0]} {_installed(wheels[0])}")]


def check_torch() -> list[Finding]:
    """Torch: a torchvision of another build breaks ``import torchvision`` with ``operator torchvision::nms does not exist``."""
    torch, vision = _installed("torch"), _installed("torchvision")
    if torch is None or vision is None:
        return []
    builds = [v.partition("+")[2] for v in (torch, vision)]
    # torch 2.N goes with torchvision 0.(N + 15).
    minors = [int(v.split(".")[1]) for v in (torch, vision)]
    if builds[0] != builds[1] or minors[1] != minors[0] + 15:
        return [
            Finding(
                "torchvision",
                "WARN",
                f"{vision} does not belong to torch {torch}",
                "pip uninstall torchvision: it is not needed",
            )
        ]
    return [Finding("torchvision", "PASS", f"{vision}, matches torch {torch}")]


def check_sqlite() -> list[Finding]:
    """SQLite, for the journal: upserts came with 3.24."""
    ok = sqlite3.sqlite_version_info >= (3, 24)
    return [
        Finding(
            "sqlite",
            "PASS" if ok else "FAIL",
            sqlite3.sqlite_version,
            "" if ok else "use a newer Python build",
        )
    ]


def check_weights() -> list[Finding]:
    """The trained network that predict, evaluate and demo take when none is named."""
    path = bundled_path()
    if path is None:
        return [Finding("weights", "WARN", "no trained network is bundled", "name one with --weights")]
    try:
        found = describe_weights(path)
    except FormatError as err:
        return [Finding("weights", "WARN", err.message, err.hint)]
    text = f"bundled: {found.kind}, {found.weights / 1e6:.2f} million weights, {found.size / 1e6:.1f} MB"
    return [Finding("weights", "PASS", text)]


def machine_checks(folder: Path) -> list[Check]:
    """Checks of this machine, in this process."""
    from tofcapture.cli import doctor_machine as machine

    return [
        lambda: machine.check_disk(folder),
        machine.check_clock,
        machine.check_memory,
        machine.check_ports,
        machine.check_daemon,
    ]


CHECKS: tuple[Check, ...] = (
    check_python,
    check_libraries,
    check_opencv,
    check_torch,
    check_sqlite,
    check_weights,
)

PROBES: tuple[Check, ...] = (
    lambda: probe("open3d"),
    lambda: probe("ur-rtde"),
    lambda: probe("nxlib"),
    lambda: probe("drivers"),
    lambda: probe("commands"),
)


def examine(checks: Sequence[Check]) -> list[Finding]:
    """Make checks one after the other; one that breaks is itself a FAIL."""
    return [finding for check in checks for finding in _made(check)]


def examine_together(checks: Sequence[Check]) -> list[Finding]:
    """The same for checks that wait for other processes, all at once."""
    with ThreadPoolExecutor(max_workers=max(1, len(checks))) as pool:
        return [finding for found in pool.map(_made, checks) for finding in found]


def _made(check: Check) -> list[Finding]:
    try:
        return check()
    except Exception as err:
        hint = err.hint if isinstance(err, TofError) else ""
        name = getattr(check, "__name__", "check")
        return [
            Finding(name, "FAIL", f"{type(err).__name__}: {err}", hint or "this is a fault of the doctor")
        ]


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--station", type=Path, metavar="TOML", help="look at its devices too, without opening them"
    )
    parser.add_argument(
        "--open", action="store_true", help="open the station's devices as well; nothing moves"
    )
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="where recordings would go (default: here)"
    )


def _run(args: argparse.Namespace) -> Outcome:
    folder = args.folder.absolute()
    station = str(station_path(args.station)[0] or "")
    # A UR arm's handshake may take seconds at each of its stages.
    devices = [
        lambda: probe("station", station, "open" if args.open else "", timeout=180.0 if args.open else 90.0)
    ]
    if not folder.is_dir():
        raise ConfigError(f"{folder}: expected a folder", hint="make it, or name another with --folder")
    probed = examine_together([*PROBES, *devices])
    # The disk's speed is measured when nothing else runs.
    return _outcome([*examine(CHECKS), *probed, *examine(machine_checks(folder))])


def _outcome(findings: Iterable[Finding]) -> Outcome:
    findings = list(findings)
    width = max(len(f.what) for f in findings)
    lines = [
        f"{f.verdict}  {f.what:{width}}  {f.found}"
        + (f"\n      {'':{width}}  try: {f.advice}" if f.advice else "")
        for f in findings
    ]
    counts = {verdict: sum(f.verdict == verdict for f in findings) for verdict in _ORDER}
    lines.append(", ".join(f"{n} {verdict}" for verdict, n in counts.items()))
    ok = counts["FAIL"] == 0
    return Outcome({"ok": ok, "findings": [asdict(f) for f in findings]}, "\n".join(lines), 0 if ok else 1)


COMMAND = Command(
    help="check libraries, devices, disk and permissions, and say what to do",
    example="tofcapture doctor",
    configure=_configure,
    run=_run,
)
