"""Recipes: a suite's file, and the scenes that come of it."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.sim.scene import Caster, SceneObject
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64

SUITES = ("tof100", "indoor", "multipath", "noise")

Poses = Callable[[Caster, np.random.Generator, int], Sequence[Float64]]
"""``(scene ready for rays, generator, wanted) -> T_world_tof (4, 4) of each view``."""


@dataclass(frozen=True)
class Recipe:
    """A suite.

    Attributes
    ----------
    name
        One of :data:`SUITES`.
    table
        What its TOML file says.
    """

    name: str
    table: Mapping[str, Any]

    @property
    def version(self) -> int:
        """Raised with every change that changes scenes."""
        return int(self.table["version"])

    @property
    def sim(self) -> Mapping[str, Any]:
        """Overrides of the simulator's constants, as in a station's ``[sim]``."""
        return dict(self.table.get("sim", {}))

    @property
    def build(self) -> Mapping[str, Any]:
        """Overrides of the ground truth's constants."""
        return dict(self.table.get("build", {}))


@dataclass(frozen=True)
class Scene:
    """One scene of a suite, and how it is looked at.

    Attributes
    ----------
    name
        Of the shard.
    objects
        Everything that stands there, world frame.
    identities
        Name of each target object; two scenes that share one belong to the same split.
    poses
        Where the ToF camera stands; ``None``: wherever the arm's plan says.
    plan_name
        Seeds the arm's plan: scenes of the same plan name are seen from the same poses.
    sim
        Overrides of the simulator's constants for this scene alone.
    facts
        What else the views' provenance says: kind, materials, angle, exposure ...
    """

    name: str
    objects: tuple[SceneObject, ...]
    identities: tuple[str, ...]
    poses: Poses | None
    plan_name: str
    sim: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)


def load_recipe(name: str) -> Recipe:
    """Read one of the packaged recipes.

    Raises
    ------
    ConfigError
        No such suite.
    """
    if name not in SUITES:
        raise ConfigError(f"suite: expected one of {', '.join(SUITES)}, got {name!r}")
    path = Path(__file__).with_name("recipes") / f"{name}.toml"
    return Recipe(name, tomllib.loads(path.read_text(encoding="utf-8")))


def make_scene(
    recipe: Recipe, index: int, seed: int, meshes: Sequence[Path] = (), mesh_unit: str = "mm"
) -> Scene:
    """Scene number ``index`` of a suite: a function of recipe, seed, index and meshes alone.

    Parameters
    ----------
    recipe
        The suite.
    index
        From 0; more scenes never change the ones before.
    seed
        Of the whole dataset.
    meshes, mesh_unit
        Files for the scenes of kind ``mesh`` (tof100), and their unit.
    """
    from tofcapture.suites import corners, rooms, tabletop

    if recipe.name == "indoor":
        return rooms.make(recipe, index, seed)
    if recipe.name == "multipath":
        return corners.make(recipe, index, seed)
    if recipe.name == "noise":
        return tabletop.make_level(recipe, index, seed)
    return tabletop.make(recipe, index, seed, meshes, mesh_unit)


def digest(*parts: object) -> str:
    """Short digest of JSON types."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:16]
