"""``manifest.json``: which scenes a dataset holds, their splits, the digest of every shard."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tofcapture.errors import DataError, FormatError
from tofcapture.files.layout import SPLITS
from tofcapture.files.seal import write_text
from tofcapture.files.signed import KEY, parse_json, parse_signed, signed_text

FORMAT, VERSION = "tofcapture-manifest", 2
UNSIGNED = (
    1  # version that did not carry its own digest; readers still take it, `tofcapture migrate` signs it
)
_AGAIN = "run build-dataset again, or restore it from a copy"
COMBINATIONS = ("random",)  # every number is another combination of objects


def object_of(scene: str) -> str:
    """Object of a scene: its name up to a trailing ``-<digits>`` (``mug``, ``mug-2`` are one; ``random-1`` is its own)."""
    stem = re.sub(r"-\d+$", "", scene)
    return scene if stem in COMBINATIONS else stem


@dataclass(frozen=True)
class SceneEntry:
    """One scene of a dataset.

    Attributes
    ----------
    path
        Of the shard, relative to the dataset folder.
    sha256
        Of the shard's bytes.
    views
        Number of views in it.
    split
        ``train``, ``val`` or ``test``.
    """

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
        """Scenes of one split, by name, sorted."""
        return {k: e for k, e in sorted(self.scenes.items()) if e.split == name}


def manifest_path(dataset: Path) -> Path:
    """Where the manifest of a dataset lies."""
    return Path(dataset) / "manifest.json"


def write_manifest(dataset: Path, manifest: Manifest) -> Path:
    """Write ``DATASET/manifest.json`` atomically; same content, same bytes."""
    path = manifest_path(dataset)
    write_text(path, manifest_text(manifest))
    return path


def manifest_text(manifest: Manifest) -> str:
    """Text of ``manifest.json``, which carries its own SHA-256."""
    table = {
        "format": FORMAT,
        "version": VERSION,
        "scenes": {name: asdict(entry) for name, entry in manifest.scenes.items()},
        "config": dict(manifest.config),
        "versions": dict(manifest.versions),
    }
    return signed_text(table)


def load_manifest(dataset: Path) -> Manifest:
    """Read ``DATASET/manifest.json``.

    Raises
    ------
    DataError
        When it is missing, not JSON, or changed after it was written.
    FormatError
        When it is of another format or version, or an entry is incomplete.
    """
    path = manifest_path(dataset)
    try:
        data = path.read_bytes()
    except OSError as err:
        raise DataError(
            f"{path}: cannot read the dataset's manifest: {err}",
            hint="tofcapture build-dataset RECORDING --out DIR",
        ) from err
    table = parse_json(data, str(path), _AGAIN)
    if table.get("format") != FORMAT or table.get("version") not in (VERSION, UNSIGNED):
        raise FormatError(f"{path}: expected {FORMAT} version {VERSION}", hint=_AGAIN)
    if table["version"] == VERSION:
        parse_signed(data, str(path), _AGAIN)
    return _parse(table, path)


def _parse(table: dict[str, Any], path: Path) -> Manifest:
    known = {"format", "version", "scenes", "config", "versions"} | (
        {KEY} if table["version"] == VERSION else set()
    )
    if table.keys() != known:
        raise FormatError(f"{path}: expected the parts {sorted(known)}, got {sorted(table)}", hint=_AGAIN)
    try:
        scenes = {str(name): SceneEntry(**entry) for name, entry in table["scenes"].items()}
        return Manifest(scenes, table["config"], table["versions"])
    except (KeyError, TypeError, AttributeError) as err:
        raise FormatError(f"{path}: a part is missing or unknown: {err}") from err
    except FormatError as err:
        raise FormatError(f"{path}: {err.message}") from err
