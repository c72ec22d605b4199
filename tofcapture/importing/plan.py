"""Decide from names and shapes what the arrays of a source are: scenes, views, frames and channels, and their ground truth."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError, PassedOver
from tofcapture.files.view import check_scene_name
from tofcapture.importing.poses import poses_of, read_poses
from tofcapture.importing.readers.vendors import decode, facts_of_layout
from tofcapture.importing.rules import in_order
from tofcapture.importing.said import Facts, Said
from tofcapture.importing.source import Piece, Role, find_pieces, natural

TRUTH = frozenset(
    [
        "depth",
        "depths",
        "gt",
        "truth",
        "ground",
        "groundtruth",
        "points",
        "cloud",
        "clouds",
        "xyz",
        "target",
        "mesh",
        "pointcloud",
        "z",
        "radial",
        "range",
    ]
)
RAW = frozenset(
    ["raw", "tof", "taps", "tap", "dcs", "phases", "phase", "frames", "correlation", "correlations", "iq"]
)
OTHER = frozenset(
    [
        "amplitude",
        "confidence",
        "flags",
        "mask",
        "ir",
        "intensity",
        "rgb",
        "color",
        "colour",
        "image",
        "ambient",
        "normals",
        "times",
        "time",
        "stamps",
    ]
)
CHANNEL = frozenset(
    ["c", "ch", "chan", "channel", "k", "tap", "taps", "phase", "p", "deg", "mhz", "hz", "dcs", "i"]
)
FRAME = frozenset(["f", "fr", "frame", "frames", "burst"])
_PLAIN = "v view views pose poses shot img image n no npy data array mm cm"
AXIS = TRUTH | RAW | CHANNEL | FRAME | frozenset(_PLAIN.split())
MOST_NAMED = 5
_FEW = 8  # arrays whose shapes are looked at before anything else
SURFACES = (".ply", ".pcd", ".stl", ".obj")
Array = NDArray[Any]
Key = tuple[int, ...]


@dataclass(frozen=True)
class Planned:
    """One view, as a source has it."""

    scene: str
    index: int
    raw: Callable[[], Array]  #: Reads (F, K, H, W).
    facts: Facts  #: What the files know of the raw arrays.
    truth: Callable[[], Array] | None  #: Reads the ground truth, in the source's own unit and shape.
    truth_facts: Facts
    pieces: tuple[Piece, ...]  #: Everything it is made of.
    time_ns: tuple[int, ...] = ()  #: Stamps of the frames, if the source has them.
    T_world_tof: Any = None  #: (4, 4) pose of the camera, if the source has it.
    T_tof_truth: Any = None  #: (4, 4) from the frame of the ground truth, if the source has it.
    joints: Any = None  #: (6,) angles of the arm, if the source has them.


@dataclass(frozen=True)
class _Named:
    """What a piece's name says."""

    piece: Piece
    role: Role
    words: tuple[str, ...]  # that are no role and no axis: a scene's name
    folders: int  # of these words, those of folders
    numbers: tuple[tuple[str, int], ...]  # (word before, number)


def plan(source: Path, said: Said) -> list[Planned]:
    """Plan the views of a source.

    Raises :class:`DataError`: nothing raw is there, sizes that do not fit, ground truth that is missing for some views; the
    message says what to write into ``import.toml``.
    """
    named = [_named(p, said) for p in find_pieces(source, said)]
    _expect_matches(named, said, source)
    if not any(n.role == "raw" for n in named):
        # Names that say nothing are raw, unless others say that they are.
        named = [replace(n, role="raw") if n.role == "" else n for n in named]
        _expect_alike([n.piece for n in named if n.role == "raw"], source)
    named = [_taken_apart(n, said) if n.role == "raw" else n for n in named]
    raw = _scenes([n for n in named if n.role == "raw"], said, source)
    if not raw:
        raise DataError(
            f"{source}: expected raw arrays, found only {_some([n.piece.name for n in named])}",
            hint="name the folder that has both: tofcapture import FOLDER"
            if source.is_file()
            else 'say which are raw: [raw] files = "..." in import.toml, or call them raw-000.npy ...',
        )
    truth = _scenes([n for n in named if n.role == "truth"], said, source)
    if said.truth.get("kind") == "none":
        truth = {}
    elif not truth:
        _tell_unnamed([n.piece.name for n in named if n.role == ""], source)
    if len(raw) == 1 and len(truth) == 1:
        truth = dict(zip(raw, truth.values(), strict=True))
    _expect_same_scenes(raw, truth, source)
    out = list[Planned]()
    for scene, found in raw.items():
        facts = found[0].piece.facts
        channels, size = len(said.channels(facts)[0]), said.size(facts)
        views = _views(found, truth.get(scene, []), said, channels, size, source)
        out += [replace(v, scene=check_scene_name(scene), index=i) for i, v in enumerate(views)]
    return _posed(out, said, source)


def _expect_matches(named: list[_Named], said: Said, source: Path) -> None:
    """Refuse a pattern of files that none has; a bag's topics are looked for by their reader."""
    for role, table in (("raw", said.raw), ("truth", said.truth)):
        free = [n for n in named if not n.piece.role]
        if "files" in table and free and not any(n.role == role for n in named):
            like = next((n for n in free if not n.role), free[0]).piece.name
            raise DataError(
                f"{source}: expected files as [{role}] files = {table['files']!r} says, got {_some([n.piece.name for n in free])}",
                hint=f'a pattern of their names: [{role}] files = "{re.sub(r"[0-9]+", "*", like)}"',
            )


def _expect_alike(pieces: list[Piece], source: Path) -> None:
    """Refuse arrays of several axes of which no name says what they are."""
    if len(pieces) < 2 or len(pieces) > _FEW:
        return
    shapes = {p.name: p.load().shape for p in pieces}
    if len({len(s) for s in shapes.values()}) > 1:
        told = ", ".join(f"{n} {s}" for n, s in shapes.items())
        one, other = (f"*{n[n.rfind(':') :]}" if ":" in n else n for n in list(shapes)[:2])
        raise DataError(
            f"{source}: expected names that say which arrays are raw and which ground truth, got {told[:300]}",
            hint=f'[raw] files = "{one}" and [truth] files = "{other}" in import.toml; or call them raw and depth',
        )


def _tell_unnamed(names: list[str], source: Path) -> None:
    """Say which arrays are not taken, where ground truth is missing: they may be it."""
    if any("disp" in n.lower() for n in names):
        raise DataError(
            f"{source}: expected depths, got disparities: {_some(names)}",
            hint="depth = fx * baseline / disparity, in metres, saved as depth-000.npy; or move them away",
        )
    if names:
        text = f"{source}: no name says what {_some(names)} are: left out"
        warnings.warn(f'{text}; [truth] files = "..." in import.toml takes them', PassedOver, stacklevel=2)


def _posed(views: list[Planned], said: Said, source: Path) -> list[Planned]:
    """Give views the poses that ``[poses] file`` has."""
    path = (source if source.is_dir() else source.parent) / str(said.poses.get("file", ""))
    if said.poses.get("file") and (path.exists() or not all(v.T_world_tof is not None for v in views)):
        stamps, poses = read_poses(path, said)
        where = str(path)
    else:
        return views
    found = poses_of([v.time_ns for v in views], stamps, poses, said, where)
    return [replace(v, T_world_tof=T) for v, T in zip(views, found, strict=True)]


def _named(piece: Piece, said: Said) -> _Named:
    place, _, array = piece.name.partition(":")
    parts = [*Path(place).with_suffix("").parts, *([array] if array else [])]
    words, numbers, roles, folders, unit = list[str](), list[tuple[str, int]](), set[str](), 0, ""
    for depth, part in enumerate(parts):
        last = ""
        for word, digits in re.findall(r"([A-Za-z]+)|(\d+)", part):
            if digits:
                numbers.append((last.lower(), int(digits)))
                continue
            last, low = word, word.lower()
            unit = low if low in {"mm", "cm"} else unit
            roles |= {r for r, known in (("truth", TRUTH), ("raw", RAW), ("other", OTHER)) if low in known}
            if low not in AXIS:
                words.append(word)
                folders += depth < len(parts) - 1
    said_role: tuple[Role, ...] = ("truth", "raw", "other")
    role: Role = piece.role or next((r for r in said_role if r in roles), "")
    kinds: tuple[tuple[Mapping[str, Any], Role], ...] = ((said.truth, "truth"), (said.raw, "raw"))
    for table, name in kinds:
        if (pattern := table.get("files")) and not piece.role:
            matches = fnmatch(piece.name, str(pattern)) or fnmatch(Path(place).name, str(pattern))
            role = name if matches else ("" if role == name else role)
    if role == "truth" and unit:
        piece = replace(piece, facts=piece.facts.over(Facts(unit=unit)))
    return _Named(piece, role, tuple(words), folders, tuple(numbers))


def _taken_apart(named: _Named, said: Said) -> _Named:
    """Read an array that holds a camera's bytes by its layout; files of bytes are read so already. Part channels in one image."""
    layout, piece = str(said.raw.get("layout", "")), named.piece
    if not layout and not said.raw.get("axes"):
        K, size = len(said.channels(piece.facts)[0]), said.size(piece.facts)
        return replace(named, piece=replace(piece, load=partial(_parted, piece.load, K, size)))
    if not layout or piece.facts.model == layout:
        return named
    shape = tuple(map(int, said.tuple_of("raw", "shape")))

    def load() -> Array:
        return decode(piece.load().tobytes(), layout, shape, str(piece.path))

    return replace(named, piece=replace(piece, load=load, facts=piece.facts.over(facts_of_layout(layout))))


def _parted(load: Callable[[], Array], K: int, size: tuple[int, int] | None) -> Array:
    """Part an image (K H, W) or (H, K W) of all channels below or beside each other into (K, H, W), where the size is said."""
    image = load()
    if image.ndim == 2 and size and image.shape == (K * size[0], size[1]):
        return image.reshape(K, *size)
    if image.ndim == 2 and size and image.shape == (size[0], K * size[1]):
        return np.moveaxis(image.reshape(size[0], K, size[1]), 1, 0)
    return image


def _scenes(named: Sequence[_Named], said: Said, source: Path) -> dict[str, list[_Named]]:
    """Sort pieces into scenes: by the words of their names that not all have in common."""
    if not named:
        return {}
    own = said.scene or re.sub(r"[^A-Za-z0-9_.-]+", "-", source.resolve().stem).strip("-.") or "scene"
    if said.scene:
        return {own: list(named)}
    common = set.intersection(*(set(n.words) for n in named))
    shared = [w for w in named[0].words[: named[0].folders] if w in common]
    out: dict[str, list[_Named]] = {}
    for n in named:
        label = "-".join(w for w in n.words if w not in common or (len(named) == 1 and n.folders))
        out.setdefault(label or (shared[0] if shared else own), []).append(n)
    return out


def _expect_same_scenes(raw: Mapping[str, Any], truth: Mapping[str, Any], source: Path) -> None:
    alone = [s for s in raw if s not in truth] if truth else []
    alone += [s for s in truth if s not in raw]
    if alone:
        raise DataError(
            f"{source}: expected raw arrays and ground truth for every scene, got only one of them for {_some(alone)}",
            hint="give pairs the same name, mug.npy and mug_depth.npy, and channels numbers, not words: low_90 is 020MHz_90; "
            'or --scene NAME, where all are one scene; or [truth] kind = "none" in import.toml',
        )


def _views(
    raw: list[_Named], truth: list[_Named], said: Said, K: int, size: tuple[int, int] | None, source: Path
) -> list[Planned]:
    """Group the pieces of a scene into views, and pair them with their ground truth."""
    groups = _grouped(raw, said, K)
    axes = str(said.raw.get("axes", "")) or raw[0].piece.facts.axes

    def read(pieces: list[Piece]) -> Array:
        """Read (N, F, K, H, W)."""
        arrays = [p.load() for p in pieces]
        sizes = {a.shape for a in arrays}
        if len(sizes) > 1:
            raise DataError(
                f"{pieces[0].path}: expected arrays of one size, got {_some(map(str, sorted(sizes)))}",
                hint='leave out what does not belong: [raw] files = "..." in import.toml',
            )
        where = str(pieces[0].path)
        if len(arrays) == 1:
            return in_order(arrays[0], K, size, axes, where)
        held = K if axes else _held(arrays[0].shape, K)
        if arrays[0].ndim > 2 and len(arrays) * (held if arrays[0].ndim == 4 else 1) == K:
            join = np.stack if arrays[0].ndim == 3 else np.concatenate
            return in_order(join(arrays, axis=1), K, size, "FKHW", where)
        if held < K:
            join = np.stack if arrays[0].ndim == 2 else np.concatenate
            return in_order(join(arrays), K, size, "", where)
        frames = [in_order(a, K, size, axes, where)[0] for a in arrays]
        return np.concatenate(frames)[None]

    if len(groups) == 1:
        return _of_one(next(iter(groups.values())), truth, read, source)
    targets = _paired(groups, truth, source)
    return [
        _planned(pieces, partial(_first, read, pieces), target, None)
        for pieces, target in zip(groups.values(), targets, strict=True)
    ]


def _first(read: Callable[[list[Piece]], Array], pieces: list[Piece]) -> Array:
    found: Array = read(pieces)[0]
    return found


def _part(load: Callable[[], Array], i: int | None) -> Array:
    found: Array = load() if i is None else load()[i]
    return found


def _of_one(
    pieces: list[Piece], truth: list[_Named], read: Callable[[list[Piece]], Array], source: Path
) -> list[Planned]:
    """Take one group apart: it is a burst, or has all views of a scene in it."""
    array = read(pieces)
    count, targets = len(array), [t.piece for t in truth]
    if len(targets) == 1 and targets[0].path.suffix.lower() in SURFACES:
        targets *= count
    elif len(targets) == 1:
        shape = targets[0].load().shape
        if len(shape) == 3 and shape[:2] == array.shape[-2:] and shape[2] == max(array.shape[:2]) > 1:
            targets = [replace(targets[0], load=partial(_views_first, targets[0].load))]  # MATLAB's order
        n = _leading(targets[0].load(), array.shape[-2:])
        if count == 1 and n == array.shape[1] > 1:  # a truth for every frame: these are views
            array = array[0][:, None]
            count = n
        if n not in (count, 1) or (n == 1 and count > 1):
            raise DataError(
                f"{source}: expected ground truth for {count} views, got {n} of {targets[0].name}",
                hint='one depth a view; [raw] axes = "NFKHW" says what the axes of the raw array are',
            )
        one = targets[0]
        parts = [partial(_part, one.load, i if n > 1 else None) for i in range(count)]
        return [_planned(pieces, partial(array.__getitem__, i), one, parts[i]) for i in range(count)]
    if count == 1 and len(targets) == array.shape[1] > 1:
        array, count = array[0][:, None], array.shape[1]
    if len(targets) not in (0, count):
        raise DataError(
            f"{source}: expected ground truth for {count} views, got {len(targets)} files",
            hint="one depth a view, numbered as the raw arrays",
        )
    return [
        _planned(pieces, partial(array.__getitem__, i), targets[i] if targets else None, None)
        for i in range(count)
    ]


def _views_first(load: Callable[[], Array]) -> Array:
    return np.moveaxis(load(), -1, 0)


def _leading(array: Array, size: tuple[int, ...]) -> int:
    """Count the views of a ground truth; several are (N, H, W) or (N, H, W, 3)."""
    several = array.ndim == 4 or array.shape[1:] == size
    several = several or (array.ndim == 3 and array.shape[-1] != 3 and array.shape[0] != 3)
    return len(array) if several else 1


def _planned(
    pieces: list[Piece], raw: Callable[[], Array], target: Piece | None, truth: Callable[[], Array] | None
) -> Planned:
    facts = Facts()
    for piece in pieces:
        facts = facts.over(piece.facts)
    stamps = tuple(
        t for t in (p.time_ns if p.time_ns is not None else stamp_in(p.name) for p in pieces) if t is not None
    )
    return Planned(
        "", 0, raw, facts,
        truth or (target.load if target else None),
        target.facts if target else Facts(),
        (*pieces, *([target] if target else [])),
        stamps if len(stamps) == len(pieces) else (),
        next((p.T for p in pieces if p.T is not None), None),
        target.T if target else None,
        next((p.joints for p in pieces if p.joints is not None), None),
    )  # fmt: skip


def stamp_in(name: str) -> int | None:
    """Read a stamp since 1970 in a name, nanoseconds: seconds with a fraction, milli-, micro- or nanoseconds."""
    found = re.search(
        r"(?<!\d)(1\d{9})(?:\.(\d+)|(\d{3}|\d{6}|\d{9}))(?!\d)", Path(name.partition(":")[0]).stem
    )
    return found and int(found[1] + (found[2] or found[3]).ljust(9, "0")[:9])


def _grouped(raw: list[_Named], said: Said, K: int) -> dict[Key, list[Piece]]:
    """Group raw pieces into views by the numbers in their names; the pieces of a group are in order: frames, then channels."""
    raw = sorted(raw, key=lambda n: natural(n.piece.name))
    first = raw[0].piece.load()
    need = 1 if said.raw.get("axes") else K // _held(first.shape, K)  # files of a frame
    if len({len(n.numbers) for n in raw}) > 1 or len(raw) == 1:
        return _in_turn(raw, need)
    columns = [[n.numbers[i] for n in raw] for i in range(len(raw[0].numbers))]
    many = {i: len({v for _, v in column}) for i, column in enumerate(columns)}
    varying = list[int]()
    for i, column in enumerate(columns):
        # A number that says what one before it says, as seconds and their fraction in a stamp do, counts once.
        told = any(len(set(zip(columns[j], column, strict=True))) == many[i] == many[j] for j in varying)
        varying += [i] if many[i] > 1 and not told else []
    if prod(many[i] for i in varying) != len(raw):
        return _in_turn(raw, need, _gaps(columns, varying))
    if first.ndim == 3 and len(raw) == K and [columns[i][0][0] in CHANNEL for i in varying] == [True]:
        need = K  # a channel's images of all views in each file
    inner = _channel_columns(varying, many, columns, need) if need > 1 else []
    if need > 1 and not inner:
        return _in_turn(raw, need)
    rest = [i for i in varying if i not in inner]
    frames = [i for i in rest if columns[i][0][0] in FRAME]
    frames = frames if len(frames) < len(rest) else []
    out: dict[Key, list[tuple[Key, Piece]]] = {}
    for n in raw:
        values = [v for _, v in n.numbers]
        key = tuple(values[i] for i in rest if i not in frames)
        out.setdefault(key, []).append((tuple(values[i] for i in (*frames, *inner)), n.piece))
    return {k: [p for _, p in sorted(found, key=lambda f: f[0])] for k, found in sorted(out.items())}


def _held(shape: tuple[int, ...], K: int) -> int:
    """Count the channels that an array has of K: one image, some of them (k, H, W), or of several frames (F, k, H, W)."""
    if len(shape) == 2:
        return 1
    k = shape[-3] if len(shape) in (3, 4) else K
    whole = K in (shape[0], shape[-1], k * shape[0] if len(shape) == 4 else k)
    return k if K % k == 0 and not whole else K


def _channel_columns(
    varying: list[int], many: Mapping[int, int], columns: list[list[tuple[str, int]]], K: int
) -> list[int]:
    """Find the numbers of a name that count the channels: by the word before them, or by how many there are."""
    called = [i for i in varying if columns[i][0][0] in CHANNEL]
    options = [called, *(varying[-n:] for n in (1, 2)), *(varying[:n] for n in (1, 2))]
    return next((o for o in options if o and prod(many[i] for i in o) == K), [])


def _gaps(columns: list[list[tuple[str, int]]], varying: list[int]) -> list[str]:
    """Name the numbers that names would have if none was missing, where few are."""
    there = set(zip(*([v for _, v in columns[i]] for i in varying), strict=True))
    if prod(len({k[i] for k in there}) for i in range(len(varying))) > 2 * len(there):
        return []
    gone = [
        k for k in product(*(sorted({k[i] for k in there}) for i in range(len(varying)))) if k not in there
    ]
    return ["-".join(map(str, k)) for k in gone]


def _in_turn(raw: list[_Named], each: int, gaps: Sequence[str] = ()) -> dict[Key, list[Piece]]:
    """Take pieces as they come; a group is known by the numbers of its first, where these tell groups apart."""
    stamps = [stamp_in(n.piece.name) for n in raw]
    if None not in stamps and len(set(stamps)) == len(stamps):  # each image has its own
        raw = [n for _, n in sorted(zip(stamps, raw, strict=True), key=lambda s: s[0] or 0)]
    if len(raw) % each:
        tall = raw[0].piece.load()
        raise DataError(
            f"{raw[0].piece.path.parent}: expected a multiple of {each} images, one a channel, got {len(raw)}"
            + (f"; there is none numbered {_some(gaps)}" if gaps else ""),
            hint="are the channels below each other in one image? [tof] width and height in import.toml part them"
            if tall.ndim == 2 and max(tall.shape) >= 2 * min(tall.shape)
            else "is a file missing, or are there other channels? [tof] modulation_mhz and phase_deg in import.toml say which",
        )
    firsts = [tuple(v for _, v in n.numbers) for n in raw[::each]]
    known = len(set(firsts)) == len(firsts)
    return {
        firsts[i] if known else (i,): [n.piece for n in raw[i * each : (i + 1) * each]]
        for i in range(len(firsts))
    }


def _paired(groups: Mapping[Key, Any], truth: list[_Named], source: Path) -> list[Piece | None]:
    """Find the ground truth of every view: by number, by stamp, else by order."""
    if not truth:
        return [None] * len(groups)
    truth = sorted(truth, key=lambda n: natural(n.piece.name))
    if len(truth) == 1 and truth[0].piece.path.suffix.lower() in SURFACES:  # one surface that all views see
        return [truth[0].piece] * len(groups)
    if len(truth) == 1 and len(groups) == len(held := truth[0].piece.load()) and held.ndim > 2:
        piece = truth[0].piece  # one file of all depths
        return [replace(piece, load=partial(_part, piece.load, i)) for i in range(len(groups))]
    if len(truth) > len(groups):
        spare = [
            n.piece.name for n in truth if tuple(v for _, v in n.numbers)[-1:] not in {k[-1:] for k in groups}
        ]
        raise DataError(
            f"{source}: expected raw arrays for each of {len(truth)} ground truths, got {len(groups)}; none for {_some(spare)}",
            hint="copy the missing raw files, or move these ground truths away",
        )
    keys = {tuple(v for _, v in n.numbers): n.piece for n in truth}
    short = {key[-1:]: piece for key, piece in keys.items()}
    for known in (keys, short):
        if len(known) == len(truth) and set(groups) <= set(known):
            return [known[k] for k in groups]
    if len(truth) == len(groups):
        keys_of_truth = [tuple(v for _, v in n.numbers) for n in truth]
        if not _is_running(groups):
            _expect_one_step(list(groups), keys_of_truth, source)
        return [n.piece for n in truth]
    missing = [".".join(map(str, k)) for k in groups if k not in short and k not in keys]
    raise DataError(
        f"{source}: expected ground truth for each of {len(groups)} views, got {len(truth)}"
        + (f"; there is none for {_some(missing)}" if missing else ""),
        hint='copy the missing files, or import without ground truth: [truth] kind = "none" in import.toml',
    )


def _is_running(groups: Mapping[Key, list[Piece]]) -> bool:
    """Whether one number counts all images of all frames; the first of a frame says nothing of its partner then."""
    names = [Path(p.name).stem for pieces in groups.values() for p in pieces]
    found = sorted(int((re.findall(r"\d+", n) or ["0"])[-1]) for n in names)
    return len(found) > len(groups) and found == list(range(found[0], found[0] + len(found)))


def _expect_one_step(raw: list[Key], truth: list[Key], source: Path) -> None:
    """Refuse pairs by order where numbers of both say that others belong together: they do not run side by side."""

    def columns(keys: list[Key]) -> list[Array]:
        table = np.array(keys, dtype=np.float64) if len({len(k) for k in keys}) == 1 else np.empty((0, 0))
        return [c for c in table.T if (np.diff(c) > 0).all()]

    def side_by_side(a: Array, b: Array) -> bool:
        step = min(np.diff(a).min(), np.diff(b).min())
        return bool(np.abs(b - a - np.median(b - a)).max() < step / 2)

    pairs = [(a, b) for a in columns(raw) for b in columns(truth)]
    if pairs and not any(side_by_side(a, b) for a, b in pairs):
        a, b = (
            sorted({k[-1:] for k in keys} - {k[-1:] for k in others})
            for keys, others in ((raw, truth), (truth, raw))
        )
        raise DataError(
            f"{source}: expected raw arrays and ground truth of the same numbers, got ones that are not in step: raw has "
            f"{_some(str(k[0]) for k in a)} alone, ground truth {_some(str(k[0]) for k in b)}",
            hint="copy the missing files, or move away what has no partner",
        )


def _some(names: Any) -> str:
    names = list(names)
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
