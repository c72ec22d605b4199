"""``manifest.json``: which scenes a dataset holds, their splits, the digest of every shard.

It carries its own digest, so that a changed character anywhere in it is found. The text is a function of the table (sorted
keys, one indent): what is read is compared with what would be written, byte for byte.

Scenes are split by a hash of their objects, so that no object is in two splits.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tofcapture.errors import DataError, FormatError
from tofcapture.files.disk import what_is
from tofcapture.files.hdf import dumps
from tofcapture.files.layout import SPLITS
from tofcapture.files.seal import write_text

FORMAT, VERSION = "tofcapture-manifest", 1
KEY = "sha256"
_AGAIN = "run build-dataset again, or restore it from a copy"
COMBINATIONS = ("random",)  # every number is another combination of objects


def signed_text(table: Mapping[str, Any]) -> str:
    """Write a table as JSON with the SHA-256 of its text without that entry under ``sha256``."""
    body = {name: value for name, value in table.items() if name != KEY}
    digest = hashlib.sha256(_pretty(body).encode()).hexdigest()
    return _pretty({**body, KEY: digest})


def _pretty(table: Mapping[str, Any]) -> str:
    return json.dumps(json.loads(dumps(table)), indent=1, sort_keys=True) + "\n"


def load_signed(path: Path, what: str, kind: tuple[str, int], hint: str) -> dict[str, Any]:
    """Read a file of :func:`signed_text`, without its digest, of a kind (``format``, ``version``).

    :class:`DataError` when it cannot be read, is not JSON, or any byte of it was changed; :class:`FormatError` when it is of
    another kind. Messages call it ``what``.
    """
    try:
        data = path.read_bytes()
    except OSError as err:
        raise DataError(f"{path}: cannot read the {what}: {err}", hint) from err
    try:
        table = json.loads(data.decode())
    except (ValueError, RecursionError) as err:
        raise DataError(f"{path}: not JSON: {err}", hint) from err
    if not isinstance(table, dict):
        raise DataError(f"{path}: not a JSON object but {type(table).__name__}", hint)
    if (table.get("format"), table.get("version")) != kind:
        raise FormatError(f"{path}: expected {kind[0]} version {kind[1]}", hint)
    if signed_text(table).encode() != data:
        raise DataError(f"{path}: its sha256 is not that of its text: changed after it was written", hint)
    del table[KEY]
    return table


def object_of(scene: str) -> str:
    """Return the object of a scene: its name up to a trailing ``-<digits>``; ``random-1`` is its own."""
    stem = re.sub(r"-\d+$", "", scene)
    return scene if stem in COMBINATIONS else stem


@dataclass(frozen=True)
class SceneEntry:
    """One scene of a dataset: its shard (relative to the dataset's folder), that one's SHA-256 and views, its split."""

    path: str
    sha256: str
    views: int
    split: str

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise FormatError(f"expected a split of {', '.join(SPLITS)}, got {self.split!r}")
        if not (isinstance(self.path, str) and isinstance(self.sha256, str) and type(self.views) is int):
            raise FormatError(f"expected path and sha256 as text, views as a number, got {self}")
        if Path(self.path).is_absolute() or ".." in Path(self.path).parts:
            raise FormatError(f"expected a path inside the dataset, got {self.path!r}")


@dataclass(frozen=True)
class Manifest:
    """Scenes of a dataset by name, how they were built, with which versions."""

    scenes: Mapping[str, SceneEntry]
    config: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    def split(self, name: str) -> dict[str, SceneEntry]:
        """Return the scenes of one split, by name, sorted."""
        return {k: e for k, e in sorted(self.scenes.items()) if e.split == name}


def manifest_path(dataset: str | Path) -> Path:
    """Return where the manifest of a dataset lies."""
    return Path(dataset) / "manifest.json"


def write_manifest(dataset: Path, manifest: Manifest) -> Path:
    """Write ``DATASET/manifest.json`` atomically; same content, same bytes."""
    path = manifest_path(dataset)
    table = {
        "format": FORMAT,
        "version": VERSION,
        "scenes": {name: asdict(entry) for name, entry in manifest.scenes.items()},
        "config": dict(manifest.config),
        "versions": dict(manifest.versions),
    }
    write_text(path, signed_text(table))
    return path


def load_manifest(dataset: str | Path) -> Manifest:
    """Read ``DATASET/manifest.json``.

    :class:`DataError` when it is missing, not JSON, or changed after it was written; :class:`FormatError` when it is of another
    version, or an entry is incomplete.
    """
    path = manifest_path(dataset)
    if not path.is_file():
        raise DataError(
            f"{dataset}: expected a dataset (a folder with manifest.json), got {what_is(Path(dataset))}",
            hint="tofcapture build-dataset RECORDING --out DIR",
        )
    table = load_signed(path, "dataset's manifest", (FORMAT, VERSION), _AGAIN)
    known = {"format", "version", "scenes", "config", "versions"}
    if table.keys() != known:
        raise FormatError(f"{path}: expected the parts {sorted(known)}, got {sorted(table)}", hint=_AGAIN)
    try:
        scenes = {str(name): SceneEntry(**entry) for name, entry in table["scenes"].items()}
        return Manifest(scenes, table["config"], table["versions"])
    except (KeyError, TypeError, AttributeError) as err:
        raise FormatError(f"{path}: a part is missing or unknown: {err}") from err
    except FormatError as err:
        raise FormatError(f"{path}: {err.message}") from err


SALT = "tofcapture-split-1"
TRAIN, VAL = 0.8, 0.9  # upper bounds of the hash in [0, 1)
TINY = 10  # groups


def _position(name: str, salt: str = SALT) -> float:
    """Position of an object in [0, 1), from its name alone."""
    return int.from_bytes(hashlib.sha256(f"{salt}/{name}".encode()).digest()[:8], "big") / 2**64


def assign_splits(
    scenes: Iterable[str], objects: Mapping[str, Iterable[str]] | None = None
) -> dict[str, str]:
    """Assign every scene to ``train`` (80 %), ``val`` (10 %) or ``test`` (10 %).

    Scenes that share an object, directly or through others, are a group and share a split; scenes of one name up to their
    number (``mug``, ``mug-2``) share that. A group's split depends on one of its objects alone, the first by another hash: adding
    scenes moves nobody, unless they bring an object before the first, or tie groups of two splits together. Two more exceptions,
    both a function of the groups only: with fewer than ten of them the one with the largest hash is the test set and all others
    train, since chance would leave splits empty; with ten or more, an empty test set takes the group with the largest
    hash. A dataset of one group trains.

    Returns the split of each scene; ``objects`` names those in a scene, where they are known.
    """
    known = objects or {}
    things = {scene: {object_of(scene), *map(str, known.get(scene, ()))} for scene in sorted(scenes)}
    leader = _leaders(things.values())
    group = {scene: leader[object_of(scene)] for scene in things}
    groups = sorted(set(group.values()), key=lambda g: (_position(g), g))
    if len(groups) < TINY:
        split = dict.fromkeys(groups, "train")
    else:
        split = {g: _split_at(_position(g)) for g in groups}
    if len(groups) > 1 and "test" not in split.values():
        split[groups[-1]] = "test"
    return {scene: split[g] for scene, g in group.items()}


def _leaders(together: Iterable[Iterable[str]]) -> dict[str, str]:
    """Join the sets that share a name; by name, the first of its joined set by a hash that says nothing of the split."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        parent.setdefault(name, name)
        while parent[name] != name:
            parent[name] = parent[parent[name]]
            name = parent[name]
        return name

    for names in together:
        first, *rest = sorted(names)
        for other in (first, *rest):
            a, b = sorted((root(first), root(other)), key=lambda n: (_position(n, f"{SALT}-leader"), n))
            parent[b] = a
    return {name: root(name) for name in parent}


def _split_at(position: float) -> str:
    return "train" if position < TRAIN else "val" if position < VAL else "test"
