"""``tofcapture doctor``: see whether everything is here that capturing, building and training need.

What may hang or crash (vendor libraries, open3d, third-party drivers, devices) is looked at in processes of their own
(``cli.probe``), all at the same time; this process imports none of it.
"""

from __future__ import annotations

import argparse
import ctypes
import grp
import os
import platform
import re
import shutil
import sqlite3
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import requires
from pathlib import Path

from tofcapture import __version__
from tofcapture.cli.kit import Command, Outcome, progress
from tofcapture.cli.probe import PROBES, Finding, attempt, graded, installed_version, probe
from tofcapture.cli.setup import bundled_path, describe_weights, station_path
from tofcapture.errors import ConfigError, TofError

Examination = Callable[[], Iterator[Finding]]
Versions = Callable[[str], str | None]

_PROBED = {"open3d", "open3d-cpu", "libusb-package", "ur-rtde", "nxlib", "opencv-python-headless"}
_OPENCV = [f"opencv-{k}" for k in ("python", "python-headless", "contrib-python", "contrib-python-headless")]
_NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "sshfs", "fuse.sshfs", "9p", "afs", "ceph", "glusterfs"}
_VIEW = 24_000_000  # bytes, of a full-size view
_SLOW_VIEW, _SLOW_COMMIT = 3.0, 0.1  # s; a view takes some seconds in all, a commit is done ten times for it
_SHARED = 256e6  # bytes; a point map and a burst on their way between processes, and room
_BEGINNING = 1_700_000_000  # s; earlier, the clock was never set
_TIME_ERROR, _UNSYNCHRONISED = 5, 0x40  # adjtimex(2)


def check_python(installed: Versions = installed_version) -> Iterator[Finding]:
    """Look at Python, the package as it runs and as it is installed, its program, SQLite."""
    advice = "install Python 3.11 or newer" if sys.version_info < (3, 11) else ""
    yield graded("python", platform.python_version(), advice, "FAIL")
    found = installed("tofcapture")
    if found is None:
        yield graded("tofcapture", f"{__version__} runs, but is not installed", "pip install .", "FAIL")
    elif found != __version__:
        yield graded("tofcapture", f"{__version__} runs, {found} is installed", "install again", "FAIL")
    else:
        yield graded("tofcapture", __version__)
    program = shutil.which("tofcapture")
    advice = "" if program else "activate its environment"
    yield graded("program", program or "tofcapture is not on the PATH", advice)
    # Upserts came with 3.24; the journal needs them.
    advice = "use a newer Python build" if sqlite3.sqlite_version_info < (3, 24) else ""
    yield graded("sqlite", sqlite3.sqlite_version, advice, "FAIL")


def check_libraries(installed: Versions = installed_version) -> Iterator[Finding]:
    """Look for every library that the package asks for, and name the extra that brings it."""
    seen = set(_PROBED)
    for line in requires("tofcapture") or () if installed_version("tofcapture") else ():
        name = re.match(r"[\w.-]+", line)[0]  # type: ignore[index]
        least = re.search(r">=([\d.]+)", line)
        extra = re.search(r"extra == '(\w+)'", line)
        if name in seen or (extra and extra[1] == "all"):
            continue
        seen.add(name)
        verdict = "WARN" if extra else "FAIL"
        advice = f"pip install 'tofcapture[{extra[1]}]'" if extra else "pip install tofcapture"
        found = installed(name)
        if found is None:
            yield graded(name, "not installed", advice, verdict)
        elif least and _numbers(found) < _numbers(least[1]):
            yield graded(name, f"{found}, older than {least[1]}", advice, verdict)
        else:
            yield graded(name, found)


def _numbers(text: str) -> list[int]:
    parts = text.partition("+")[0].split(".")[:3]
    return [int("".join(filter(str.isdigit, part)) or 0) for part in parts]


def check_wheels(installed: Versions = installed_version) -> Iterator[Finding]:
    """Find wheels that spoil each other: two of OpenCV, a torchvision of another torch."""
    wheels = [n for n in _OPENCV if installed(n)]
    if len(wheels) > 1:
        advice = f"pip uninstall -y {' '.join(wheels)} && pip install opencv-python-headless"
        yield graded("opencv", f"{' and '.join(wheels)} are both installed", advice)
    elif wheels:
        yield graded("opencv", f"{wheels[0]} {installed(wheels[0])}")
    else:
        yield graded("opencv", "not installed", "pip install 'tofcapture[capture]'")
    torch, vision = installed("torch"), installed("torchvision")
    if torch and vision:
        # Else: "operator torchvision::nms does not exist". torch 2.N goes with torchvision 0.(N + 15).
        same_build = torch.partition("+")[2] == vision.partition("+")[2]
        fits = same_build and int(vision.split(".")[1]) == int(torch.split(".")[1]) + 15
        found = f"{vision}, {'matches' if fits else 'does not belong to'} torch {torch}"
        yield graded("torchvision", found, "" if fits else "pip uninstall torchvision: it is not needed")


def check_weights() -> Iterator[Finding]:
    """Look at the trained network that predict, evaluate and demo take when none is named."""
    if path := bundled_path():
        yield attempt("weights", lambda: f"bundled: {describe_weights(path)}", "WARN")
    else:
        yield graded("weights", "no trained network is bundled", "name one with --weights")


def check_folder(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> Iterator[Finding]:
    """Look at space, permission and kind of the disk where recordings would go."""
    free = shutil.disk_usage(folder).free / 1e9
    # A scene of 25 views takes 0.3 to 0.6 GB.
    advice = "" if free > 5 else "a scene takes 0.5 GB: free some"
    yield graded("disk", f"{free:.1f} GB free in {folder}", advice, "WARN" if free > 1 else "FAIL")
    if not os.access(folder, os.W_OK):
        yield graded("folder", f"{folder} cannot be written", "change to a folder of yours")
        return
    yield graded("folder", f"{folder} can be written")
    kind = _file_system(folder, mounts)
    if kind in _NETWORK:
        advice = "record on a local disk: the journal's locks do not hold over a network"
        yield graded("file system", f"{kind}: a network's", advice, "FAIL")
    elif kind in {"tmpfs", "ramfs"}:
        yield graded("file system", f"{kind}: gone after a restart", "record on a disk")
    elif kind:
        yield graded("file system", kind)
    inodes = os.statvfs(folder)
    if inodes.f_files and inodes.f_favail < 10_000:
        yield graded("inodes", f"{inodes.f_favail} left", "remove small files: df -i shows where")
    yield from check_disk_speed(folder)


def _file_system(folder: Path, mounts: Path) -> str:
    """Find the kind of the file system that holds a folder; empty when unknown."""
    here, best, kind = folder.resolve(), -1, ""
    for line in mounts.read_text(encoding="utf-8").splitlines() if mounts.exists() else ():
        _, at, name, *_ = line.split(" ")
        mount = Path(at.replace("\\040", " "))
        if here.is_relative_to(mount) and len(mount.parts) >= best:
            best, kind = len(mount.parts), name
    return kind


def check_disk_speed(folder: Path, clock: Callable[[], float] = time.monotonic) -> Iterator[Finding]:
    """Write a view and some commits, all of it to the disk."""
    seconds = []
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            for data in (os.urandom(1_000_000) * (_VIEW // 1_000_000), *[b"x" * 4096] * 5):
                start = clock()
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
                seconds.append(clock() - start)
    except OSError as err:
        yield graded("disk speed", f"{folder}: {err}", "look at the system's log; is it full?", "FAIL")
        return
    view, commit = seconds[0], sorted(seconds[1:])[2]
    found = f"a view in {view:.2f} s, a commit in {1e3 * commit:.1f} ms, both synced"
    slow = view > _SLOW_VIEW or commit > _SLOW_COMMIT
    advice = "each view waits for this: take another disk, or end what else writes to it"
    yield graded("disk speed", found, advice if slow else "")


def read_clocks() -> tuple[float, float]:
    """Read monotonic and wall seconds, of the pair least apart of five."""
    pairs = [(time.monotonic(), time.time(), time.monotonic()) for _ in range(5)]
    before, wall, after = min(pairs, key=lambda p: p[2] - p[0])
    return (before + after) / 2, wall


def check_clock(clocks: Callable[[], tuple[float, float]] = read_clocks) -> Iterator[Finding]:
    """Look at the time of day: set, running as fast as the monotonic clock, synchronised."""
    first = clocks()
    if first[1] < _BEGINNING:
        today = time.strftime("%Y-%m-%d", time.gmtime(first[1]))
        yield graded("clock", today, "set the clock: timedatectl set-ntp true", "FAIL")
        return
    time.sleep(0.3)
    last = clocks()
    drift = (last[1] - first[1]) - (last[0] - first[0])
    advice = "" if abs(drift) < 2e-3 else "something sets the clock by jumps; let one time service do it"
    yield graded("clock", f"wall and monotonic clock differ by {1e3 * drift:+.2f} ms over 0.3 s", advice)
    if sys.platform != "linux":
        return
    timex = ctypes.create_string_buffer(512)  # modes = 0: read only
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        state = -1
    status = int.from_bytes(timex.raw[40:44], sys.byteorder)
    if state < 0:
        yield graded("time service", "the kernel does not say", "timedatectl shows more")
    elif state == _TIME_ERROR or status & _UNSYNCHRONISED:
        advice = "timedatectl set-ntp true, or start chrony: file times and UTC stamps depend on it"
        yield graded("time service", "the clock is not synchronised", advice)
    else:
        yield graded("time service", "the clock is synchronised")


def check_memory() -> Iterator[Finding]:
    """Look at shared memory: processes hand arrays over in it, and containers give 64 MB."""
    shared = Path("/dev/shm")  # noqa: S108  where the kernel keeps it
    if shared.is_dir():
        free = shutil.disk_usage(shared).free
        advice = "" if free >= _SHARED else "give the container --shm-size=1g, or free /dev/shm"
        yield graded("shared memory", f"{free / 1e6:.0f} MB free", advice)


def check_locale() -> Iterator[Finding]:
    """Look at how names of files and what is printed are encoded."""
    names, out = sys.getfilesystemencoding(), sys.stdout.encoding
    advice = "" if names == "utf-8" else "set LC_ALL=C.UTF-8: names of files beyond ASCII are shown escaped"
    yield graded("locale", f"file names in {names}, output in {out}", advice)


def check_ports(dev: Path = Path("/dev")) -> Iterator[Finding]:
    """Look for serial ports, and whether this user may open them."""
    named = sorted((dev / "serial" / "by-id").glob("*"))
    ports = named or sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    if not ports:
        yield graded("serial ports", "none; only a serial ToF module needs one")
    for port in ports:
        if os.access(port, os.R_OK | os.W_OK):
            yield graded(f"port {port.name}", "can be opened")
            continue
        try:
            group = grp.getgrgid(port.stat().st_gid).gr_name
            advice = f"sudo usermod -aG {group} $USER, then log in again"
        except (KeyError, OSError):
            advice = f"ask the owner of {port}"
        yield graded(f"port {port.name}", "is not ours to open", advice)


def check_daemon() -> Iterator[Finding]:
    """Look at the daemon's folder: ours alone, its socket's path short enough; and whether one runs."""
    from tofcapture.record.daemon.client import ask
    from tofcapture.record.daemon.settings import state_folder

    state = state_folder(None)
    near = next(p for p in (state.root, *state.root.parents) if p.exists())
    info, found, advice = near.stat(), str(state.root), "set TOFCAPTURE_STATE to a folder of yours"
    if not state.socket_fits:
        found = f"{state.socket} is too long for a socket"
        advice = "set TOFCAPTURE_STATE to a shorter folder"
    elif near == state.root and info.st_uid != os.getuid():
        found = f"{near} belongs to another user"
    elif near == state.root and info.st_mode & 0o077:
        found, advice = f"others can look into {near}", f"chmod 700 {near}"
    elif not os.access(near, os.W_OK):
        found = f"{state.root} cannot be made"
    else:
        advice = ""
    yield graded("daemon folder", found, advice)
    if not advice:
        try:
            known = ask("GET", "/v1/state", state=state.root)
            yield graded("daemon", f"one runs: {known['phase']}, recordings in {known['root']}")
        except TofError:
            yield graded("daemon", "none runs")


def examine(examination: Examination) -> list[Finding]:
    """Carry out an examination; one that breaks is itself a FAIL."""
    try:
        return list(examination())
    except Exception as err:
        advice = getattr(err, "hint", "") or "this is a fault of the doctor"
        name = getattr(examination, "__name__", "check")
        return [Finding(name, "FAIL", f"{type(err).__name__}: {err}", advice)]


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--station", type=Path, metavar="STATION.toml", help="look at its devices too, without opening them")
    add("--open", action="store_true", help="open its devices too: takes control of the arm; nothing moves")
    add("--folder", type=Path, default=Path(), metavar="DIR", help="where recordings would go (default: .)")


def _run(args: argparse.Namespace) -> Outcome:
    folder = args.folder.absolute()
    if not folder.is_dir():
        raise ConfigError(f"{folder}: expected a folder", hint="make it, or name another with --folder")
    station = str(station_path(args.station)[0] or "")
    if args.open and station:
        words = (
            "connects to every device, and starts a program of its own on the arm's controller; nothing moves"
        )
        print(f"tofcapture doctor --open takes control of {station}: it {words}", file=sys.stderr, flush=True)
    quick: tuple[Examination, ...] = (check_python, check_libraries, check_wheels, check_weights)
    # The disk's speed and the clocks are measured when nothing else runs.
    alone: tuple[Examination, ...] = (
        check_clock,
        check_memory,
        check_locale,
        check_ports,
        check_daemon,
    )
    with ThreadPoolExecutor(max_workers=len(PROBES)) as pool, progress() as report:
        there = {"station": (station, "open" if args.open else "")}
        looked, probed = pool.map(lambda name: probe(name, *there.get(name, ())), PROBES), []
        for done, name in enumerate(PROBES):
            report("looked at", done, len(PROBES), f"{name} comes next")
            probed.append(next(looked))
    disk = examine(lambda: check_folder(folder))
    groups = [*map(examine, quick), *probed, disk, *map(examine, alone)]
    findings = [finding for group in groups for finding in group]
    width = max(len(f.what) for f in findings)
    lines = []
    for f in findings:
        lines.append(f"{f.verdict}  {f.what:{width}}  {f.found}")
        lines += [f"      {'':{width}}  try: {f.advice}"] if f.advice else []
    verdicts = [f.verdict for f in findings]
    lines.append(", ".join(f"{verdicts.count(v)} {v}" for v in ("FAIL", "WARN", "PASS")))
    ok = "FAIL" not in verdicts
    return Outcome({"ok": ok, "findings": [asdict(f) for f in findings]}, "\n".join(lines), 0 if ok else 1)


COMMAND = Command(
    help="check libraries, devices, disk and permissions, and say what to do",
    example="tofcapture doctor",
    configure=_configure,
    run=_run,
)
