"""One scene of a simulated dataset: views, shard, note, and away with the views.

::

    OUT/simulation/<scene>.work/   views and the shard in the making; gone when the shard is in place
    OUT/simulation/<scene>.json    what was made, by which recipe, in how many seconds
    OUT/shards/<scene>.h5
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from tofcapture import __version__
from tofcapture.devices.sim import VERSION
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import digest_path, sealed_digest, write_text
from tofcapture.suites.capture import Job, layered, take_views
from tofcapture.suites.recipe import Recipe, digest, load_recipe, make_scene

_RIGS_APART = 1_000_003


@dataclass(frozen=True)
class Wish:
    """What dataset is wanted: everything that its bytes depend on, but for versions.

    Attributes
    ----------
    suite, seed
        The recipe and its seed.
    scenes, views, frames
        How many: scenes, views of each, ToF frames of each view.
    meshes, mesh_unit
        Files for the scenes of kind ``mesh``.
    sim
        Overrides of the simulator's constants, as in a station's ``[sim]``.
    cameras
        Rigs that the scenes take turns with: each its own brackets, factory calibration and fixed pattern, so that a network
        cannot learn one camera by heart.
    kinds
        Kinds of scenes, in turns, instead of the recipe's pattern (tof100).
    """

    suite: str
    seed: int
    scenes: int
    views: int = 25
    frames: int = 10
    meshes: tuple[Path, ...] = ()
    mesh_unit: str = "mm"
    sim: Mapping[str, Any] = field(default_factory=dict)
    cameras: int = 1
    kinds: tuple[str, ...] = ()

    def recipe(self) -> Recipe:
        """Load the suite's recipe, with the kinds that are wanted.

        Raises
        ------
        ConfigError
            No such suite, or no such kind in it.
        """
        recipe = load_recipe(self.suite)
        if not self.kinds:
            return recipe
        known = recipe.table.get("kind", {})
        if self.suite != "tof100" or not set(self.kinds) <= set(known):
            raise ConfigError(
                f"--kinds: expected some of {', '.join(known)} for the suite tof100, got {' '.join(self.kinds)} for {self.suite}"
            )
        return replace(recipe, table={**recipe.table, "pattern": list(self.kinds)})

    def rig_seed(self, index: int) -> int:
        """Seed of the rig that takes scene ``index``; a rig's seed is the dataset's and a multiple of a large prime."""
        return self.seed + _RIGS_APART * (index % self.cameras)

    def task(self, index: int) -> str:
        """Digest of everything that scene ``index`` depends on."""
        recipe = self.recipe()
        table = {**asdict(self), "scenes": index, "meshes": [p.name for p in self.meshes]}
        return digest(table, recipe.table, __version__, VERSION)


@dataclass(frozen=True)
class Made:
    """One finished scene, as ``simulation/<scene>.json`` says.

    Attributes
    ----------
    scene, sha256, views
        Name, digest of the shard, views in it.
    task
        :meth:`Wish.task` that it came from.
    objects
        Identities of its objects.
    facts
        What the recipe says of it.
    cpu
        CPU seconds by stage, of the process that made it; ``build`` is the shard's.
    seconds
        Wall clock.
    bytes
        Of the shard.
    config, versions
        Of the builder.
    """

    scene: str
    sha256: str
    views: int
    task: str
    objects: list[str]
    facts: dict[str, Any]
    cpu: dict[str, float]
    seconds: float
    bytes: int
    config: dict[str, Any]
    versions: dict[str, str]


def paths(out: Path, scene: str) -> tuple[Path, Path, Path]:
    """Work folder, note and shard of a scene."""
    return (
        out / "simulation" / f"{scene}.work",
        out / "simulation" / f"{scene}.json",
        out / "shards" / f"{scene}.h5",
    )


def scene_name(wish: Wish, index: int) -> str:
    """Name of a scene of a dataset."""
    return make_scene(wish.recipe(), index, wish.seed, wish.meshes, wish.mesh_unit).name


def read_note(out: Path, scene: str) -> Made | None:
    """The note of a scene; ``None`` when there is none that can be read."""
    try:
        return Made(**json.loads(paths(out, scene)[1].read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def finished(wish: Wish, out: Path, index: int, scene: str) -> Made | None:
    """The note of a scene whose shard is in place, and whole.

    Raises
    ------
    ConfigError
        The scene is there, but of another wish.
    """
    made = read_note(out, scene)
    if made is None:
        return None
    if made.task != wish.task(index):
        raise ConfigError(
            f"{out}: {scene} was made with other options, or by another version",
            hint="name another folder, or remove this one",
        )
    try:
        return made if sealed_digest(paths(out, scene)[2]) == made.sha256 else None
    except DataError:
        return None


def make_one(wish: Wish, out: Path, index: int) -> Made:
    """Simulate one scene, build its shard, put it in place, note it, and remove the views."""
    from tofcapture.dataset.build import build_dataset
    from tofcapture.dataset.sample import SampleConfig
    from tofcapture.files.manifest import load_manifest

    start, recipe, task = time.monotonic(), wish.recipe(), wish.task(index)
    scene = make_scene(recipe, index, wish.seed, wish.meshes, wish.mesh_unit)
    work, note, shard = paths(out, scene.name)
    _make_room(work, task)
    provenance = {"suite": wish.suite, "recipe": recipe.version, "index": index, "task": task}
    job = Job(scene, wish.rig_seed(index), wish.views, wish.frames, layered(recipe.sim, wish.sim), provenance)
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
