"""What a network has learned from, and which scenes of an evaluation are therefore not new to it.

Splits keep objects apart inside a dataset; a network may have been trained on another one. A checkpoint remembers the shards and the
names of the objects of its ``train`` splits, those of the weights that it started from included.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tofcapture.errors import TofError
from tofcapture.files.manifest import COMBINATIONS, SceneEntry, load_manifest, object_of
from tofcapture.files.shard import ShardReader

DIGITS = 12  # of a shard's SHA-256 that are enough to recognise it
_SHOWN = 5
# simulate-dataset numbers the objects that it makes up: s003-bowl of another seed is another bowl
_NUMBERED = re.compile(rf"[a-z]\d{{3}}-|({'|'.join(COMBINATIONS)})-\d+$")

Learned = Mapping[str, Sequence[str]]


def learned_from(datasets: Sequence[Path], before: Learned | None = None) -> dict[str, list[str]]:
    """What a checkpoint remembers of the scenes that it was trained on.

    Parameters
    ----------
    datasets
        Whose ``train`` splits are learned from.
    before
        What the weights knew that training started from.

    Returns
    -------
    ``objects``: names, sorted; ``shards``: the first twelve digits of their SHA-256, sorted
    """
    objects, shards = set((before or {}).get("objects", ())), set((before or {}).get("shards", ()))
    for dataset in datasets:
        for name, entry in load_manifest(dataset).split("train").items():
            objects |= _objects(Path(dataset), name, entry)
            shards.add(entry.sha256[:DIGITS])
    return {"objects": sorted(objects), "shards": sorted(shards)}


def not_new(provenance: Mapping[str, Any], dataset: Path, split: str) -> dict[str, str] | None:
    """Scenes of a split that a network has learned from, and why we think so.

    Parameters
    ----------
    provenance
        Of its checkpoint.
    dataset, split
        What it is evaluated on.

    Returns
    -------
    ``the same shard`` or ``object NAME`` by scene; ``None`` where the checkpoint does not tell what it was trained on
    """
    if "learned" not in provenance:
        return None
    objects, shards = set(provenance["learned"]["objects"]), set(provenance["learned"]["shards"])
    found: dict[str, str] = {}
    for name, entry in load_manifest(dataset).split(split).items():
        if entry.sha256[:DIGITS] in shards:
            found[name] = "the same shard"
        elif both := objects & _objects(Path(dataset), name, entry):
            found[name] = f"object {', '.join(sorted(both))}"
    return found


def _objects(dataset: Path, name: str, entry: SceneEntry) -> set[str]:
    """Names that mean the same object in every dataset: as the shard says, else that of the scene."""
    try:
        with ShardReader(dataset / entry.path, entry.sha256) as shard:
            said = shard.provenance.get("objects")
    except (OSError, TofError):  # training from a packed cache may go without the shards
        said = None
    names = [object_of(name)] if said is None else map(str, said)
    return {thing for thing in names if not _NUMBERED.match(thing)}


def origin(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Provenance for results and pages: all but the long lists of what was learned from."""
    return {key: value for key, value in provenance.items() if key != "learned"}


def sentence(who: str, found: Mapping[str, str] | None, scenes: int) -> str:
    """Say it to people; nothing where all scenes are new."""
    if found is None:
        return f"{who}: its checkpoint does not tell what it was trained on; whether these scenes are new to it is not known"
    if not found:
        return ""
    some = "; ".join(f"{scene} ({why})" for scene, why in sorted(found.items())[:_SHOWN])
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return f"{who}: {len(found)} of {scenes} scenes are not new to it: {some}{more}"
