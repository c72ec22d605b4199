"""``tofcapture doctor``: see whether everything is here that capturing, building and training need."""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import sqlite3
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tofcapture.command import Command, Outcome
from tofcapture.errors import TofError

_ORDER = ("FAIL", "WARN", "PASS")


@dataclass(frozen=True)
class Finding:
    """One line of the doctor: what was looked at, PASS, WARN or FAIL, what was found, and what to do."""

    what: str
    verdict: str
    found: str
    advice: str = ""


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
    return [Finding("python", "PASS" if ok else "FAIL", found, "" if ok else "install Python 3.11 or newer")]


def check_libraries() -> list[Finding]:
    """Versions of libraries: the two that everything needs, and those of the extras."""
    required = {"numpy": "1.26", "h5py": "3.10"}
    optional = {
        "scipy": ("1.11", "capture"),
        "rich": ("13", "capture"),
        "tomli-w": ("1.0", "capture"),
        "kiss-icp": ("1.2", "capture"),
        "torch": ("2.6", "model"),
        "safetensors": ("0.5", "model"),
        "matplotlib": ("3.8", "report"),
        "jinja2": ("3.1", "report"),
    }
    out = [_library(name, least, "FAIL", "pip install tofcapture") for name, least in required.items()]
    return out + [
        _library(n, least, "WARN", f"pip install 'tofcapture[{extra}]'")
        for n, (least, extra) in optional.items()
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


def check_open3d() -> list[Finding]:
    """open3d: does it load? A missing libusb is its usual trouble."""
    from tofcapture.o3d import load_open3d

    try:
        return [Finding("open3d", "PASS", str(load_open3d().__version__))]
    except TofError as err:
        missing = _installed("open3d") is None and _installed("open3d-cpu") is None
        return [Finding("open3d", "WARN" if missing else "FAIL", err.message, err.hint)]


def check_disk(folder: Path) -> list[Finding]:
    """Space and write permission where recordings would go."""
    free = shutil.disk_usage(folder).free / 1e9
    # A scene of 25 views takes 0.3 to 0.6 GB.
    verdict = "PASS" if free > 5 else "WARN" if free > 1 else "FAIL"
    out = [
        Finding(
            "disk",
            verdict,
            f"{free:.1f} GB free in {folder}",
            "" if verdict == "PASS" else "a scene takes 0.5 GB: free some",
        )
    ]
    writable = os.access(folder, os.W_OK)
    return [
        *out,
        Finding(
            "folder",
            "PASS" if writable else "WARN",
            f"{folder} {'can' if writable else 'cannot'} be written",
            "" if writable else "change to a folder of yours",
        ),
    ]


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


def check_drivers() -> list[Finding]:
    """Device drivers: which there are, which do not import."""
    from tofcapture.devices.registry import found_drivers, load_driver

    out = []
    for name, entry in found_drivers().items():
        try:
            out.append(Finding(f"driver {name}", "PASS", ", ".join(sorted(load_driver(name)))))
        except TofError as err:
            out.append(
                Finding(
                    f"driver {name}", "WARN", err.message, f"repair or uninstall what provides {entry.value}"
                )
            )
    return out or [
        Finding("drivers", "FAIL", "none is installed", "install the package: pip install tofcapture")
    ]


CHECKS: tuple[Callable[[], list[Finding]], ...] = (
    check_python,
    check_libraries,
    check_opencv,
    check_torch,
    check_open3d,
    check_sqlite,
    lambda: check_disk(Path.cwd()),
    check_drivers,
)


def examine() -> list[Finding]:
    """Make all checks; a check that breaks is itself a FAIL."""
    out: list[Finding] = []
    for check in CHECKS:
        try:
            out += check()
        except Exception as err:
            out.append(Finding(getattr(check, "__name__", "check"), "FAIL", f"{type(err).__name__}: {err}"))
    return out


def _configure(parser: argparse.ArgumentParser) -> None:
    del parser


def _run(args: argparse.Namespace) -> Outcome:
    del args
    findings = examine()
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
