"""What the doctor looks at in the machine: disk, clock, memory, serial ports, the daemon's folder."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tofcapture.cli.doctor_probe import Finding, group_advice
from tofcapture.errors import TofError

_VIEW = 24_000_000  # bytes, of a full-size view
_SLOW_VIEW, _SLOW_COMMIT = 3.0, 0.1  # s; a view takes some seconds in all, a commit is done ten times for it
_NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "sshfs", "fuse.sshfs", "9p", "afs", "ceph", "glusterfs"}
_SHARED = 256e6  # bytes; a point map and a burst on their way between processes, and room
_BEGINNING = 1_700_000_000  # s; earlier, the clock was never set
_TIME_ERROR, _UNSYNCHRONISED = 5, 0x40  # adjtimex(2)


def check_disk(folder: Path) -> list[Finding]:
    """Space, permission, kind and speed of the disk where recordings would go."""
    usage = shutil.disk_usage(folder).free / 1e9
    # A scene of 25 views takes 0.3 to 0.6 GB.
    verdict = "PASS" if usage > 5 else "WARN" if usage > 1 else "FAIL"
    advice = "" if verdict == "PASS" else "a scene takes 0.5 GB: free some"
    out = [Finding("disk", verdict, f"{usage:.1f} GB free in {folder}", advice)]
    if not os.access(folder, os.W_OK):
        return [
            *out,
            Finding("folder", "WARN", f"{folder} cannot be written", "change to a folder of yours"),
        ]
    return [
        *out,
        Finding("folder", "PASS", f"{folder} can be written"),
        *_kind(folder),
        *_inodes(folder),
        *_speed(folder),
    ]


def filesystem(folder: Path) -> str:
    """Kind of the file system that holds a folder; empty when unknown."""
    try:
        lines = Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    here, best, kind = folder.resolve(), -1, ""
    for line in lines:
        _, at, name, *_ = line.split(" ")
        mount = Path(at.replace("\\040", " "))
        if (here == mount or mount in here.parents) and len(mount.parts) >= best:
            best, kind = len(mount.parts), name
    return kind


def _kind(folder: Path) -> list[Finding]:
    kind = filesystem(folder)
    if kind in _NETWORK:
        advice = "record on a local disk: the journal's locks do not hold over a network"
        return [Finding("file system", "FAIL", f"{kind}: a network's", advice)]
    if kind in {"tmpfs", "ramfs"}:
        return [Finding("file system", "WARN", f"{kind}: gone after a restart", "record on a disk")]
    return [Finding("file system", "PASS", kind)] if kind else []


def _inodes(folder: Path) -> list[Finding]:
    found = os.statvfs(folder)
    if found.f_files and found.f_favail < 10_000:
        return [Finding("inodes", "WARN", f"{found.f_favail} left", "remove small files: df -i shows where")]
    return []


def _speed(folder: Path) -> list[Finding]:
    """Write a view and some commits, all of it to the disk."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            start = time.monotonic()
            file.write(os.urandom(1_000_000) * (_VIEW // 1_000_000))
            file.flush()
            os.fsync(file.fileno())
            view = time.monotonic() - start
            commits = []
            for _ in range(5):
                start = time.monotonic()
                file.write(b"x" * 4096)
                file.flush()
                os.fsync(file.fileno())
                commits.append(time.monotonic() - start)
    except OSError as err:
        return [Finding("disk speed", "FAIL", f"{folder}: {err}", "look at the system's log; is it full?")]
    commit = sorted(commits)[2]
    slow = view > _SLOW_VIEW or commit > _SLOW_COMMIT
    found = f"a view in {view:.2f} s, a commit in {1e3 * commit:.1f} ms, both synced"
    advice = "each view waits for this: take another disk, or end what else writes to it" if slow else ""
    return [Finding("disk speed", "WARN" if slow else "PASS", found, advice)]


def check_clock() -> list[Finding]:
    """Time of day set, synchronised, and running as fast as the monotonic clock."""
    if time.time() < _BEGINNING:
        return [
            Finding("clock", "FAIL", time.strftime("%Y-%m-%d"), "set the clock: timedatectl set-ntp true")
        ]
    first = _clocks()
    time.sleep(0.3)
    last = _clocks()
    drift = (last[1] - first[1]) - (last[0] - first[0])
    steady = abs(drift) < 2e-3
    out = [
        Finding(
            "clock",
            "PASS" if steady else "WARN",
            f"wall and monotonic clock differ by {1e3 * drift:+.2f} ms over 0.3 s",
            "" if steady else "something sets the clock by jumps; let one time service do it",
        )
    ]
    return [*out, *_synchronised()]


def _clocks() -> tuple[float, float]:
    """Monotonic and wall seconds, of the pair least apart of five."""
    pairs = []
    for _ in range(5):
        a, wall, b = time.monotonic(), time.time(), time.monotonic()
        pairs.append((b - a, (a + b) / 2, wall))
    return min(pairs)[1:]


def _synchronised() -> list[Finding]:
    """Ask the kernel, which every time service tells."""
    if sys.platform != "linux":
        return []
    timex = ctypes.create_string_buffer(512)  # modes = 0: read only
    try:
        state = ctypes.CDLL(None, use_errno=True).adjtimex(timex)
    except (OSError, AttributeError):
        state = -1
    status = int.from_bytes(timex.raw[40:44], sys.byteorder)
    if state < 0:
        return [Finding("time service", "WARN", "the kernel does not say", "timedatectl shows more")]
    if state == _TIME_ERROR or status & _UNSYNCHRONISED:
        advice = "timedatectl set-ntp true, or start chrony: file times and UTC stamps depend on it"
        return [Finding("time service", "WARN", "the clock is not synchronised", advice)]
    return [Finding("time service", "PASS", "the clock is synchronised")]


def check_memory() -> list[Finding]:
    """Shared memory: processes hand arrays over in it, and containers give 64 MB."""
    shared = Path("/dev/shm")  # noqa: S108  where the kernel keeps it
    if not shared.is_dir():
        return []
    free = shutil.disk_usage(shared).free
    if free < _SHARED:
        advice = "give the container --shm-size=1g, or free /dev/shm"
        return [Finding("shared memory", "WARN", f"{free / 1e6:.0f} MB free", advice)]
    return [Finding("shared memory", "PASS", f"{free / 1e6:.0f} MB free")]


def check_ports(dev: Path = Path("/dev")) -> list[Finding]:
    """Serial ports, and whether this user may open them."""
    named = sorted((dev / "serial" / "by-id").glob("*"))
    ports = named or sorted([*dev.glob("ttyUSB*"), *dev.glob("ttyACM*")])
    if not ports:
        return [Finding("serial ports", "PASS", "none; only a serial ToF module needs one")]
    out = []
    for port in ports:
        ours = os.access(port, os.R_OK | os.W_OK)
        found = "can be opened" if ours else "is not ours to open"
        out.append(
            Finding(
                f"port {port.name}",
                "PASS" if ours else "WARN",
                found,
                "" if ours else group_advice(port),
            )
        )
    return out


def check_daemon() -> list[Finding]:
    """The daemon's folder: ours alone, its socket's path short enough; and whether one runs."""
    from tofcapture.record.daemon.client import ask
    from tofcapture.record.daemon.settings import state_folder

    state = state_folder(None)
    if not state.socket_fits:
        advice = "set TOFCAPTURE_STATE to a shorter folder"
        return [Finding("daemon folder", "WARN", f"{state.socket} is too long for a socket", advice)]
    near = next(p for p in (state.root, *state.root.parents) if p.exists())
    if near == state.root:
        info = near.stat()
        if info.st_uid != os.getuid():
            advice = "set TOFCAPTURE_STATE to a folder of yours"
            return [Finding("daemon folder", "WARN", f"{near} belongs to another user", advice)]
        if info.st_mode & 0o077:
            return [Finding("daemon folder", "WARN", f"others can look into {near}", f"chmod 700 {near}")]
    elif not os.access(near, os.W_OK):
        advice = "set TOFCAPTURE_STATE to a folder of yours"
        return [Finding("daemon folder", "WARN", f"{state.root} cannot be made", advice)]
    try:
        found = ask("GET", "/v1/state", state=state.root)
        runs = f"one runs: {found['phase']}, recordings in {found['root']}"
    except TofError:
        runs = "none runs"
    return [Finding("daemon folder", "PASS", str(state.root)), Finding("daemon", "PASS", runs)]
