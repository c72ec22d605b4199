"""Define what a suite is: its recipe, and the scenes that come of it."""

from __future__ import annotations

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
    """A suite: one of :data:`SUITES`, and what its TOML file says."""

    name: str
    table: Mapping[str, Any]

    @property
    def version(self) -> int:
        """Number that is raised with every change that changes scenes."""
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
    """One scene of a suite, and how it is looked at."""

    name: str  #: Of the shard.
    objects: tuple[SceneObject, ...]  #: Everything that stands there, world frame.
    #: Name of each target object; two scenes that share one belong to the same split.
    identities: tuple[str, ...]
    poses: Poses | None  #: Where the ToF camera stands; ``None``: wherever the arm's plan says.
    plan_name: str  #: Seeds the arm's plan: scenes of the same plan name are seen from the same poses.
    #: Overrides of the simulator's constants for this scene alone.
    sim: Mapping[str, Any] = field(default_factory=dict)
    #: What else the views' provenance says: kind, materials, angle, exposure ...
    facts: Mapping[str, Any] = field(default_factory=dict)


def load_recipe(name: str) -> Recipe:
    """Read one of the packaged recipes; :class:`ConfigError` when there is no such suite."""
    if name not in SUITES:
        raise ConfigError(f"suite: expected one of {', '.join(SUITES)}, got {name!r}")
    path = Path(__file__).with_name("recipes") / f"{name}.toml"
    return Recipe(name, tomllib.loads(path.read_text(encoding="utf-8")))
