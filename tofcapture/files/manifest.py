"""``manifest.json``: which scenes a dataset holds, their splits, the digest of every shard."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tofcapture.errors import DataError, FormatError
from tofcapture.files.layout import SPLITS
from tofcapture.files.seal import write_text

FORMAT, VERSION = "tofcapture-manifest", 1
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
    table = {
        "format": FORMAT,
        "version": VERSION,
        "scenes": {name: asdict(entry) for name, entry in manifest.scenes.items()},
        "config": dict(manifest.config),
        "versions": dict(manifest.versions),
    }
    path = manifest_path(dataset)
    write_text(path, json.dumps(table, indent=1, sort_keys=True) + "\n")
    return path


def load_manifest(dataset: Path) -> Manifest:
    """Read ``DATASET/manifest.json``.

    Raises
    ------
    DataError
        When it is missing or not JSON.
    FormatError
        When it is of another format or version, or an entry is incomplete.
    """
    path = manifest_path(dataset)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as err:
        raise DataError(
            f"{path}: cannot read the dataset's manifest: {err}",
            hint="tofcapture build-dataset RECORDING --out DIR",
        ) from err
    except ValueError as err:
        raise DataError(f"{path}: not JSON: {err}", hint="run build-dataset again") from err
    return _parse(table, path)


def _parse(table: Any, path: Path) -> Manifest:
    if not isinstance(table, dict) or (table.get("format"), table.get("version")) != (FORMAT, VERSION):
        raise FormatError(f"{path}: expected {FORMAT} version {VERSION}")
    try:
        scenes = {str(name): SceneEntry(**entry) for name, entry in table["scenes"].items()}
        return Manifest(scenes, table["config"], table["versions"])
    except (KeyError, TypeError, AttributeError) as err:
        raise FormatError(f"{path}: a part is missing or unknown: {err}") from err
    except FormatError as err:
        raise FormatError(f"{path}: {err.message}") from err
