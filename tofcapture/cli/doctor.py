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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

from tofcapture import __version__
from tofcapture.cli.kit import Command, Outcome
from tofcapture.cli.probe import Finding, attempt, probe
from tofcapture.cli.setup import bundled_path, describe_weights, station_path
from tofcapture.errors import ConfigError, TofError

Examination = Callable[[], Iterator[Finding]]
Versions = Callable[[str], str | None]

_PROBED = {"open3d", "open3d-cpu", "libusb-package", "ur-rtde", "nxlib", "opencv-python-headless"}
_OPENCV = [
    f"opencv-{kind}" for kind in ("python", "python-headless", "contrib-python", "contrib-python-headless")
]
_NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "sshfs", "fuse.sshfs", "9p", "afs", "ceph", "glusterfs"}
_VIEW = 24_000_000  # bytes, of a full-size view
_SLOW_VIEW, _SLOW_COMMIT = 3.0, 0.1  # s; a view takes some seconds in all, a commit is done ten times for it
_SHARED = 256e6  # bytes; a point map and a burst on their way between processes, and room
_BEGINNING = 1_700_000_000  # s; earlier, the clock was never set
_TIME_ERROR, _UNSYNCHRONISED = 5, 0x40  # adjtimex(2)


def installed_version(name: str) -> str | None:
    """Version of an installed package; ``None`` when it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def check_python(installed: Versions = installed_version) -> Iterator[Finding]:
    """Python, the package as it runs and as it is installed, its program, SQLite."""
    old = sys.version_info < (3, 11)
    yield _graded("python", "FAIL", platform.python_version(), "install Python 3.11 or newer" if old else "")
    found = installed("tofcapture")
    if found is None:
        yield Finding("tofcapture", "FAIL", f"{__version__} runs, but is not installed", "pip install .")
    elif found != __version__:
        yield Finding("tofcapture", "FAIL", f"{__version__} runs, {found} is installed", "install again")
    else:
        yield Finding("tofcapture", "PASS", __version__)
    program = shutil.which("tofcapture")
    advice = "" if program else "activate its environment"
    yield _graded("program", "WARN", program or "tofcapture is not on the PATH", advice)
    # Upserts came with 3.24; the journal needs them.
    old = sqlite3.sqlite_version_info < (3, 24)
    yield _graded("sqlite", "FAIL", sqlite3.sqlite_version, "use a newer Python build" if old else "")


def check_libraries(installed: Versions = installed_version) -> Iterator[Finding]:
    """Every library that the package asks for, with the extra that brings it."""
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
            yield Finding(name, verdict, "not installed", advice)
        elif least and _numbers(found) < _numbers(least[1]):
            yield Finding(name, verdict, f"{found}, older than {least[1]}", advice)
        else:
            yield Finding(name, "PASS", found)


def _numbers(text: str) -> list[int]:
    parts = text.partition("+")[0].split(".")[:3]
    return [int("".join(filter(str.isdigit, part)) or 0) for part in parts]


def check_wheels(installed: Versions = installed_version) -> Iterator[Finding]:
    """Wheels that spoil each other: two of OpenCV, a torchvision of another torch."""
    wheels = [n for n in _OPENCV if installed(n)]
    if len(wheels) > 1:
        advice = f"pip uninstall -y {' '.join(wheels)} && pip install opencv-python-headless"
        yield Finding("opencv", "WARN", f"{' and '.join(wheels)} are both installed", advice)
    elif wheels:
        yield Finding("opencv", "PASS", f"{wheels[0]} {installed(wheels[0])}")
    else:
        yield Finding("opencv", "WARN", "not installed", "pip install 'tofcapture[capture]'")
    torch, vision = installed("torch"), installed("torchvision")
    if torch and vision:
        # Else: "operator torchvision::nms does not exist". torch 2.N goes with torchvision 0.(N + 15).
        same_build = torch.partition("+")[2] == vision.partition("+")[2]
        fits = same_build and int(vision.split(".")[1]) == int(torch.split(".")[1]) + 15
        found = f"{vision}, {'matches' if fits else 'does not belong to'} torch {torch}"
        advice = "" if fits else "pip uninstall torchvision: it is not needed"
        yield _graded("torchvision", "WARN", found, advice)


def check_weights() -> Iterator[Finding]:
    """The trained network that predict, evaluate and demo take when none is named."""
    path = bundled_path()
    if path is None:
        yield Finding("weights", "WARN", "no trained network is bundled", "name one with --weights")
    else:
        yield attempt("weights", lambda: f"bundled: {describe_weights(path)}", "WARN")


def check_folder(folder: Path, mounts: Path = Path("/proc/self/mounts")) -> Iterator[Finding]:
    """Space, permission and kind of the disk where recordings would go."""
    free = shutil.disk_usage(folder).free / 1e9
    # A scene of 25 views takes 0.3 to 0.6 GB.
    advice = "" if free > 5 else "a scene takes 0.5 GB: free some"
    yield _graded("disk", "WARN" if free > 1 else "FAIL", f"{free:.1f} GB free in {folder}", advice)
    if not os.access(folder, os.W_OK):
        yield Finding("folder", "WARN", f"{folder} cannot be written", "change to a folder of yours")
        return
    yield Finding("folder", "PASS", f"{folder} can be written")
    kind = _file_system(folder, mounts)
    if kind in _NETWORK:
        advice = "record on a local disk: the journal's locks do not hold over a network"
        yield Finding("file system", "FAIL", f"{kind}: a network's", advice)
    elif kind in {"tmpfs", "ramfs"}:
        yield Finding("file system", "WARN", f"{kind}: gone after a restart", "record on a disk")
    elif kind:
        yield Finding("file system", "PASS", kind)
    inodes = os.statvfs(folder)
    if inodes.f_files and inodes.f_favail < 10_000:
        yield Finding("inodes", "WARN", f"{inodes.f_favail} left", "remove small files: df -i shows where")


def _file_system(folder: Path, mounts: Path) -> str:
    """Kind of the file system that holds a folder; empty when unknown."""
    here, best, kind = folder.resolve(), -1, ""
    for line in mounts.read_text(encoding="utf-8").splitlines() if mounts.exists() else ():
        _, at, name, *_ = line.split(" ")
        mount = Path(at.replace("\\040", " "))
        if here.is_relative_to(mount) and len(mount.parts) >= best:
            best, kind = len(mount.parts), name
    return kind


def check_disk_speed(folder: Path, clock: Callable[[], float] = time.monotonic) -> Iterator[Finding]:
    """Write a view and some commits, all of it to the disk."""
    if not os.access(folder, os.W_OK):
        return
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
        yield Finding("disk speed", "FAIL", f"{folder}: {err}", "look at the system's log; is it full?")
        return
    view, commit = seconds[0], sorted(seconds[1:])[2]
    found = f"a view in {view:.2f} s, a commit in {1e3 * commit:.1f} ms, both synced"
    slow = view > _SLOW_VIEW or commit > _SLOW_COMMIT
    advice = "each view waits for this: take another disk, or end what else writes to it" if slow else ""
    yield _graded("disk speed", "WARN", found, advice)


def read_clocks() -> tuple[float, float]:
    """Read monotonic and wall seconds, of the pair least apart of five."""
    pairs = []
    for _ in range(5):
        a, wall, b = time.monotonic(), time.time(), time.monotonic()
        pairs.append((b - a, (a + b) / 2, wall))
    return min(pairs)[1:]


def check_clock(clocks: Callable[[], tuple[float, float]] = read_clocks) -> Iterator[Finding]:
    """Time of day: set, running as fast as the monotonic clock, synchronised."""
    first = clocks()
    if first[1] < _BEGINNING:
        today = time.strftime("%Y-%m-%d", time.gmtime(first[1]))
        yield Finding("clock", "FAIL", today, "set the clock: timedatectl set-ntp true")
        return
    time.sleep(0.3)
    last = clocks()
    drift = (last[1] - first[1]) - (last[0] - first[0])
    advice = "" if abs(drift) < 2e-3 else "something sets the clock by jumps; let one time service do it"
    found = f"wall and monotonic clock differ by {1e3 * drift:+.2f} ms over 0.3 s"
    yield _graded("clock", "WARN", found, advice)
    if sys.platform != "linux":
        return
    timex = ctypes.create_string_buffer(512)  # modes = 0: read only
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        state = -1
    status = int.from_bytes(timex.raw[40:44], sys.byteorder)
    if state < 0:
        yield Finding("time service", "WARN", "the kernel does not say", "timedatectl shows more")
    elif state == _TIME_ERROR or status & _UNSYNCHRONISED:
        advice = "timedatectl set-ntp true, or start chrony: file times and UTC stamps depend on it"
        yield Finding("time service", "WARN", "the clock is not synchronised", advice)
    else:
        yield Finding("time service", "PASS", "the clock is synchronised")


def check_memory() -> Iterator[Finding]:
    """Shared memory: processes hand arrays over in it, and containers give 64 MB."""
    shared = Path("/dev/shm")  # noqa: S108  where the kernel keeps it
    if shared.is_dir():
        free = shutil.disk_usage(shared).free
        advice = "" if free >= _SHARED else "give the container --shm-size=1g, or free /dev/shm"
        yield _graded("shared memory", "WARN", f"{free / 1e6:.0f} MB free", advice)


def check_ports(dev: Path = Path("/dev")) -> Iterator[Finding]:
    """Serial ports, and whether this user may open them."""
    named = sorted((dev / "serial" / "by-id").glob("*"))
    ports = named or sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    if not ports:
        yield Finding("serial ports", "PASS", "none; only a serial ToF module needs one")
    for port in ports:
        if os.access(port, os.R_OK | os.W_OK):
            yield Finding(f"port {port.name}", "PASS", "can be opened")
            continue
        try:
            group = grp.getgrgid(port.stat().st_gid).gr_name
            advice = f"sudo usermod -aG {group} $USER, then log in again"
        except (KeyError, OSError):
            advice = f"ask the owner of {port}"
        yield Finding(f"port {port.name}", "WARN", "is not ours to open", advice)


def check_daemon() -> Iterator[Finding]:
    """The daemon's folder: ours alone, its socket's path short enough; and whether one runs."""
    from tofcapture.record.daemon.client import ask
    from tofcapture.record.daemon.settings import state_folder

    state, what = state_folder(None), "daemon folder"
    near = next(p for p in (state.root, *state.root.parents) if p.exists())
    info, yours = near.stat(), "set TOFCAPTURE_STATE to a folder of yours"
    if not state.socket_fits:
        advice = "set TOFCAPTURE_STATE to a shorter folder"
        yield Finding(what, "WARN", f"{state.socket} is too long for a socket", advice)
    elif near == state.root and info.st_uid != os.getuid():
        yield Finding(what, "WARN", f"{near} belongs to another user", yours)
    elif near == state.root and info.st_mode & 0o077:
        yield Finding(what, "WARN", f"others can look into {near}", f"chmod 700 {near}")
    elif not os.access(near, os.W_OK):
        yield Finding(what, "WARN", f"{state.root} cannot be made", yours)
    else:
        yield Finding(what, "PASS", str(state.root))
        try:
            found = ask("GET", "/v1/state", state=state.root)
            runs = f"one runs: {found['phase']}, recordings in {found['root']}"
        except TofError:
            runs = "none runs"
        yield Finding("daemon", "PASS", runs)


def _graded(what: str, verdict: str, found: str, advice: str) -> Finding:
    """A finding that is bad where there is advice."""
    return Finding(what, verdict if advice else "PASS", found, advice)


def examine(examination: Examination) -> list[Finding]:
    """Carry out an examination; one that breaks is itself a FAIL."""
    try:
        return list(examination())
    except Exception as err:
        hint = err.hint if isinstance(err, TofError) else ""
        name = getattr(examination, "__name__", "check")
        found = f"{type(err).__name__}: {err}"
        return [Finding(name, "FAIL", found, hint or "this is a fault of the doctor")]


def examinations(folder: Path, station: str, opening: str) -> tuple[list[Examination], ...]:
    """List what is looked at: quick, then in other processes, then alone, when nothing else runs."""
    # A UR arm's handshake may take seconds at each of its stages.
    patience = 180.0 if opening else 90.0
    names = ("open3d", "ur-rtde", "nxlib", "drivers", "commands")
    probes: list[Examination] = [lambda n=n: iter(probe(n)) for n in names]  # type: ignore[misc]
    probes.append(lambda: iter(probe("station", station, opening, timeout=patience)))
    quick: list[Examination] = [check_python, check_libraries, check_wheels, check_weights]
    alone: list[Examination] = [lambda: check_folder(folder), lambda: check_disk_speed(folder)]
    return quick, probes, [*alone, check_clock, check_memory, check_ports, check_daemon]


def _configure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--station", type=Path, metavar="TOML", help="look at its devices too, without opening them")
    add("--open", action="store_true", help="open the station's devices as well; nothing moves")
    add("--folder", type=Path, default=Path(), help="where recordings would go (default: here)")


def _run(args: argparse.Namespace) -> Outcome:
    folder = args.folder.absolute()
    if not folder.is_dir():
        raise ConfigError(f"{folder}: expected a folder", hint="make it, or name another with --folder")
    station = str(station_path(args.station)[0] or "")
    quick, probes, alone = examinations(folder, station, "open" if args.open else "")
    with ThreadPoolExecutor(max_workers=len(probes)) as pool:
        probed = list(pool.map(examine, probes))
    groups = [*map(examine, quick), *probed, *map(examine, alone)]
    return _outcome([finding for group in groups for finding in group])


def _outcome(findings: Sequence[Finding]) -> Outcome:
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
