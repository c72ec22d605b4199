"""Which scenes train and which test: by a hash of the object, so that no object is in two splits."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

from tofcapture.files.manifest import object_of

SALT = "tofcapture-split-1"
TRAIN, VAL = 0.8, 0.9  # upper bounds of the hash in [0, 1)
TINY = 10  # objects


def _position(name: str) -> float:
    """Position of an object in [0, 1), from its name alone."""
    return int.from_bytes(hashlib.sha256(f"{SALT}/{name}".encode()).digest()[:8], "big") / 2**64


def assign_splits(scenes: Iterable[str]) -> dict[str, str]:
    """Assign every scene to ``train`` (80 %), ``val`` (10 %) or ``test`` (10 %).

    An object's split depends on its name alone, so adding scenes moves nobody. Two exceptions, both a function of the set
    of names only: with fewer than ten objects the one with the largest hash is the test set and all others train, since
    chance would leave splits empty; with ten or more, an empty test set takes the object with the largest hash. A
    dataset of one object trains.

    Parameters
    ----------
    scenes
        Names, in any order.

    Returns
    -------
    Split by scene.
    """
    scenes = sorted(scenes)
    objects = sorted({object_of(s) for s in scenes}, key=lambda o: (_position(o), o))
    if len(objects) < TINY:
        by_object = dict.fromkeys(objects, "train")
    else:
        by_object = {o: _split_at(_position(o)) for o in objects}
    if len(objects) > 1 and "test" not in by_object.values():
        by_object[objects[-1]] = "test"
    return {scene: by_object[object_of(scene)] for scene in scenes}


def _split_at(position: float) -> str:
    return "train" if position < TRAIN else "val" if position < VAL else "test"
