"""One scene of a simulated dataset: views, shard, note, and away with the views.

::

    OUT/simulation/<scene>.work/   views and the shard in the making; gone when the shard is in place
    OUT/simulation/<scene>.json    what was made, by which recipe, in how many seconds
    OUT/shards/<scene>.h5
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tofcapture import __version__
from tofcapture.devices.sim import VERSION, hashed_generator
from tofcapture.devices.sim.draw import draw_camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import digest_path, sealed_digest, write_text
from tofcapture.suites import corners, rooms, tabletop
from tofcapture.suites.capture import Job, layered, take_views
from tofcapture.suites.scene import Recipe, Scene, load_recipe

_RIGS_APART = 1_000_003


def make_scene(
    recipe: Recipe, index: int, seed: int, meshes: Sequence[Path] = (), mesh_unit: str = "mm"
) -> Scene:
    """Make scene ``index``, from 0, of a suite: more scenes never change the ones before.

    It is a function of recipe, seed of the dataset, index and, in scenes of kind ``mesh`` (tof100), of mesh files.
    """
    if recipe.name == "indoor":
        return rooms.make(recipe, index, seed)
    if recipe.name == "multipath":
        return corners.make(recipe, index, seed)
    if recipe.name == "noise":
        return tabletop.make_level(recipe, index, seed)
    return tabletop.make(recipe, index, seed, meshes, mesh_unit)


@dataclass(frozen=True)
class DatasetSpec:
    """A dataset to simulate: everything that its bytes depend on, but for versions."""

    suite: str  #: The recipe.
    seed: int
    scenes: int
    views: int = 25  #: Of each scene.
    frames: int = 10  #: ToF frames of each view.
    meshes: tuple[Path, ...] = ()  #: Files for the scenes of kind ``mesh``.
    mesh_unit: str = "mm"
    sim: Mapping[str, Any] = field(
        default_factory=dict
    )  #: Overrides of constants, as in a station's ``[sim]``.
    #: Rigs that the scenes take turns with. One is the station's; several are whole cameras drawn for each, so that a network
    #: learns cameras and not one of them: :func:`tofcapture.devices.sim.draw.draw_camera`.
    cameras: int = 1
    kinds: tuple[str, ...] = ()  #: Kinds of scenes, in turns, instead of the recipe's pattern (tof100).

    def recipe(self) -> Recipe:
        """Load the suite's recipe with the kinds that are wanted; :class:`ConfigError` when it has no such kind."""
        recipe = load_recipe(self.suite)
        if not self.kinds:
            return recipe
        known = recipe.table.get("kind", {})
        if self.suite != "tof100" or not set(self.kinds) <= set(known):
            raise ConfigError(
                f"--kinds: expected some of {', '.join(known)} for the suite tof100, got {' '.join(self.kinds)} for {self.suite}"
            )
        return replace(recipe, table={**recipe.table, "pattern": list(self.kinds)})

    def scene(self, index: int) -> Scene:
        """Make scene ``index``."""
        return make_scene(self.recipe(), index, self.seed, self.meshes, self.mesh_unit)

    def rig_seed(self, index: int) -> int:
        """Choose the seed of the rig that takes scene ``index``: the dataset's and a multiple of a large prime."""
        return self.seed + _RIGS_APART * (index % self.cameras)

    def constants(self, index: int) -> dict[str, Any]:
        """Lay the recipe's, the drawn camera's and the user's constants over each other, for scene ``index``."""
        drawn: Mapping[str, Any] = {}
        if self.cameras > 1:
            rng = hashed_generator(f"camera {self.rig_seed(index)}".encode())
            drawn = draw_camera(rng, self.sim.get("tof", {}).get("preset"))
        return layered(self.recipe().sim, drawn, self.sim)

    def task(self, index: int) -> str:
        """Digest everything that scene ``index`` depends on."""
        table = {**asdict(self), "scenes": index, "meshes": [p.name for p in self.meshes]}
        parts = (table, self.recipe().table, __version__, VERSION)
        return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Made:
    """One finished scene, as ``simulation/<scene>.json`` says."""

    scene: str
    sha256: str  #: Of the shard.
    views: int
    task: str  #: :meth:`DatasetSpec.task` that it came from.
    objects: list[str]  #: Identities of its objects.
    facts: dict[str, Any]  #: What the recipe says of it.
    cpu: dict[str, float]  #: Seconds by stage of the process that made it; ``build`` is the shard's.
    seconds: float  #: Wall clock.
    bytes: int  #: Of the shard.
    config: dict[str, Any]  #: Of the builder, as are the versions.
    versions: dict[str, str]


def paths(out: Path, scene: str) -> tuple[Path, Path, Path]:
    """Name work folder, note and shard of a scene."""
    folder = out / "simulation"
    return folder / f"{scene}.work", folder / f"{scene}.json", out / "shards" / f"{scene}.h5"


def finished(spec: DatasetSpec, out: Path, index: int, scene: str) -> Made | None:
    """Read the note of a scene whose shard is in place, and whole; :class:`ConfigError` when it is of another spec."""
    _, note, shard = paths(out, scene)
    try:
        made = Made(**json.loads(note.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    if made.task != spec.task(index):
        raise ConfigError(
            f"{out}: {scene} was made with other options, or by another version",
            hint="name another folder, or remove this one",
        )
    try:
        return made if sealed_digest(shard) == made.sha256 else None
    except DataError:
        return None


def make_one(spec: DatasetSpec, out: Path, index: int) -> Made:
    """Simulate one scene, build its shard, put it in place, note it, and remove the views."""
    from tofcapture.dataset.build import build_dataset
    from tofcapture.dataset.sample import SampleConfig
    from tofcapture.files.manifest import load_manifest

    start, recipe, task = time.monotonic(), spec.recipe(), spec.task(index)
    scene = spec.scene(index)
    work, note, shard = paths(out, scene.name)
    _make_room(work, task)
    provenance = {"suite": spec.suite, "recipe": recipe.version, "index": index, "task": task}
    job = Job(scene, spec.rig_seed(index), spec.views, spec.frames, spec.constants(index), provenance)
    cpu = take_views(job, work / "recording")
    begun = time.process_time()
    config = SampleConfig(**recipe.build)
    result = build_dataset([work / "recording"], work / "dataset", true_rig=True, config=config, jobs=1)
    for failure in result.failures.values():
        raise failure
    cpu["build"] = time.process_time() - begun  # type: ignore[assignment]
    built = load_manifest(work / "dataset")
    made = Made(
        scene=scene.name,
        sha256=_move(work / "dataset" / "shards" / shard.name, shard),
        views=built.scenes[scene.name].views,
        task=task,
        objects=list(scene.identities),
        facts=dict(scene.facts),
        cpu={k: round(float(v), 3) for k, v in cpu.items()},
        seconds=round(time.monotonic() - start, 3),
        bytes=shard.stat().st_size,
        config=dict(built.config),
        versions=dict(built.versions),
    )
    write_text(note, json.dumps(asdict(made), indent=1, sort_keys=True) + "\n")
    shutil.rmtree(work)
    return made


def _make_room(work: Path, task: str) -> None:
    """Keep a work folder of the same task; one of another task goes."""
    name = work / "task"
    if work.exists() and not (name.is_file() and name.read_text(encoding="ascii") == task):
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    write_text(name, task)


def _move(built: Path, shard: Path) -> str:
    """Put a sealed shard and its digest in place; returns the digest, verified."""
    shard.parent.mkdir(parents=True, exist_ok=True)
    digest_path(built).replace(digest_path(shard))
    built.replace(shard)
    return sealed_digest(shard)
