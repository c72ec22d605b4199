"""Splits scenes by a hash of their objects, so that no object is in two splits."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

from tofcapture.files.manifest import object_of

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

    Parameters
    ----------
    scenes
        Names, in any order.
    objects
        Names of the objects in a scene, for the scenes where they are known.

    Returns
    -------
    Split by scene.
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
