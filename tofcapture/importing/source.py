"""Define what a reader is, and find the arrays of a source with all of them.

A reader is a module with two functions, and stands in :data:`READERS`::

    def claims(path: Path) -> bool: ...                          # does it read this file, or this folder as a whole?
    def pieces(path: Path, said: Said) -> Iterator[Piece]: ...   # what is in it, read only when it is asked for

Readers say what lies where and what the file knows of it. What it means is decided once, for all readers, in
:mod:`tofcapture.importing.plan`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, Protocol, cast

from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.importing.said import Facts, Said
from tofcapture.poses import Float64

Role = Literal["", "raw", "truth", "other"]
READERS = ("bags", "bop", "arrays", "images", "clouds")
"""Modules of :mod:`tofcapture.importing.readers`, asked in this order; the first that claims a path reads it."""
_VIDEO = "a video loses what is measured: export frames as 16-bit PNG or .npy"
_TEXT = "np.save(name, np.loadtxt(path)), with delimiter=',' for commas"
_PYTHON = "np.save(name, array) in the program that wrote it"
UNREAD = {
    ".jpg": "JPEG loses what is measured: export 16-bit PNG, TIFF or .npy",
    ".exr": "np.save(name, cv2.imread(path, cv2.IMREAD_UNCHANGED)), with OPENCV_IO_ENABLE_OPENEXR=1",
    **dict.fromkeys((".csv", ".txt", ".asc", ".xyz"), _TEXT),
    **dict.fromkeys((".pkl", ".pickle", ".pt", ".pth", ".zarr", ".zarray"), _PYTHON),
    **dict.fromkeys((".zip", ".gz", ".7z", ".tar", ".xz", ".bz2"), "unpack it first"),
    **dict.fromkeys((".zst", ".zstd"), "unpack it first: zstd -d FILE"),
    ".dat": "call it .raw, and say --shape H,W",
    ".active": "a recorder was killed: rosbag reindex FILE, then call it .bag",
    ".avi": _VIDEO,
    ".mkv": _VIDEO,
    ".mp4": _VIDEO,
    ".parquet": "tables of LeRobot and Hugging Face hold no raw frames: export images or .npy",
}
UNREAD[".jpeg"] = UNREAD[".jpg"]
"""What to do with files of measurements that no reader reads."""


@dataclass(frozen=True)
class Piece:
    """Hold one array of a source."""

    name: str  #: Place below the source: ``mug/raw-003.npz:raw``, ``bag.mcap:/tof/image``; patterns are matched with it.
    path: Path  #: The file that it is in.
    load: Callable[[], NDArray[Any]]  #: Reads it; raises :class:`DataError` with the file's name.
    role: Role = ""  #: What it is, where the reader knows; else its name tells.
    time_ns: int | None = None  #: Its stamp.
    facts: Facts = field(default_factory=Facts)  #: What the file knows of it.
    #: (4, 4) pose of the camera in the world, of a ``raw``; (4, 4) to the ToF camera, of a ``truth``.
    T: Float64 | None = None
    joints: Float64 | None = None  #: (6,) angles of the arm that held the camera.


class Reader(Protocol):
    """Read one kind of file, or of folder."""

    def claims(self, path: Path) -> bool:
        """Tell whether this path is of its kind, by its name or its first bytes."""

    def pieces(self, path: Path, said: Said) -> Iterator[Piece]:
        """List the arrays in it; names are relative to ``path``, empty for a file's only array."""


def natural(name: str) -> list[tuple[int, str]]:
    """Order names with numbers in them by the numbers."""
    return [(int(t), "") if t.isdecimal() else (-1, t) for t in re.split(r"(\d+)", name)]


def find_pieces(source: Path, said: Said) -> list[Piece]:
    """List the arrays of a file or a folder, in the natural order of their names.

    Raises :class:`DataError`: it does not exist, or holds nothing that a reader reads.
    """
    if not source.exists():
        raise DataError(f"{source}: no such file or folder", hint="look at the path and its folder")
    readers = [cast("Reader", import_module(f"tofcapture.importing.readers.{name}")) for name in READERS]
    found, passed, empty = list[Piece](), list[Path](), list[Path]()
    for path in _paths(source, readers):
        reader = next((r for r in readers if r.claims(path)), None)
        if reader is None:
            passed.append(path)
            continue
        place = path.name if path == source else str(path.relative_to(source))
        held = list(reader.pieces(path, said))
        found += [replace(p, name=f"{place}:{p.name}" if p.name else place) for p in held]
        empty += [] if held else [path]
    if not found:
        kinds = "arrays (.npy, .npz, .mat, .h5), 16-bit images (.png, .tif), raw words (.raw, .bin) or bags"
        seen = ", ".join(
            [f"{p.name} without arrays of numbers" for p in empty] + sorted(p.name for p in passed)
        )
        raise DataError(
            f"{source}: expected {kinds}, found {seen[:200] or 'an empty folder'}",
            hint=next((UNREAD[p.suffix.lower()] for p in passed if p.suffix.lower() in UNREAD), "")
            or "save the arrays with np.save; see docs/howto/own-data.md",
        )
    if said.truth.get("kind") != "none":
        _expect_read(passed, said, source)
    return sorted(found, key=lambda p: natural(p.name))


def _expect_read(passed: list[Path], said: Said, source: Path) -> None:
    """Refuse files of measurements that no reader reads: what is imported without them would look whole."""
    poses = Path(str(said.poses.get("file", ""))).name
    left = [p for p in passed if p.suffix.lower() in UNREAD and p.name != poses]
    left = [p for p in left if re.search(r"depth|raw|truth|cloud|phase|taps|dcs", p.stem, re.IGNORECASE)]
    left = [p for p in left if UNREAD[p.suffix.lower()] != _TEXT or _is_table(p)]
    if left:
        raise DataError(
            f"{source}: expected files that can be read, got {left[0].name}"
            + (f" and {len(left) - 1} more" if len(left) > 1 else ""),
            hint=f'{UNREAD[left[0].suffix.lower()]}; or move them away; or [truth] kind = "none" in import.toml',
        )


def _is_table(path: Path) -> bool:
    """Tell whether a text is an image or a cloud: many lines of many numbers; notes, stamps and intrinsics are not."""
    with path.open(errors="replace") as file:
        rows = [re.split(r"[,;\s]+", line.strip()) for line, _ in zip(file, range(40), strict=False)]
    return len(rows) > 30 and (len(rows[-1]) > 17 or path.suffix.lower() in {".xyz", ".asc"})


def _paths(source: Path, readers: list[Reader]) -> Iterator[Path]:
    """Walk a source; a folder that a reader claims as a whole is not looked into."""
    if source.is_file() or any(r.claims(source) for r in readers):
        yield source
        return
    for path in sorted(source.iterdir(), key=lambda p: natural(p.name)):
        ours = (
            path.name in {"import.toml", "import.png"} or (path / "rig.toml").is_file()
        )  # a recording that lies inside
        circle = path.is_symlink() and source.resolve().is_relative_to(path.resolve())
        if not path.name.startswith(".") and not ours and not circle:
            yield from _paths(path, readers)
