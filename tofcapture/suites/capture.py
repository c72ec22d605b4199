"""The views of one scene of a suite, as sealed view files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.devices.clearance import stage_of
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim import VERSION
from tofcapture.devices.sim.arm import SimArm, SimClock, shared_clock
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scenes import generator
from tofcapture.devices.sim.world import SimWorld
from tofcapture.devices.station import read_station
from tofcapture.files.seal import sealed_digest
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import invert
from tofcapture.record.plan import object_sampling, plan_views
from tofcapture.suites.recipe import Scene


@dataclass(frozen=True)
class Job:
    """One scene to capture.

    Attributes
    ----------
    scene
        What stands there.
    seed
        Of the dataset: one camera, one bracket, one arm for all of its scenes.
    views, frames
        Views of the scene, ToF frames of each burst.
    sim
        Overrides of the simulator's constants for the whole dataset.
    provenance
        Stored in every view.
    """

    scene: Scene
    seed: int
    views: int
    frames: int
    sim: Mapping[str, Any]
    provenance: Mapping[str, Any]


def layered(*tables: Mapping[str, Any]) -> dict[str, Any]:
    """Tables of tables, the later ones laid over the earlier ones."""
    out: dict[str, Any] = {}
    for table in tables:
        for name, values in table.items():
            out[name] = {**out.get(name, {}), **values}
    return out


def station_sim() -> dict[str, Any]:
    """Constants of the embedded simulated station: the lamp lights the image and little beside it."""
    return {k: v for k, v in read_station(None)["sim"].items() if isinstance(v, Mapping)}


def make_world(job: Job) -> SimWorld:
    """World of a scene: devices of the dataset, constants of the scene."""
    where = f"scene {job.scene.name}"
    constants = read_constants(layered(station_sim(), job.sim, job.scene.sim), where)
    world = SimWorld(constants, job.seed, lambda _name, _seed: job.scene.objects)
    world.place(job.scene.name)
    return world


def take_views(job: Job, recording: Path) -> Counter[str]:
    """Take every view of a scene that is not there yet.

    Parameters
    ----------
    job
        What to take.
    recording
        Folder to write ``views/<scene>/view-007.h5`` into; whole views in it are kept.

    Returns
    -------
    CPU seconds by stage (``scene``, ``poses``, ``light``, ``tof``, ``stereo``, ``truth``, ``write``), and ``views`` taken.
    """
    spent: Counter[str] = Counter()
    clock = _Stopwatch(spent)
    world = make_world(job)
    world.caster()
    clock.lap("scene")
    for index, before, now in _stations(job, world):
        clock.lap("poses")
        path = view_path(recording, job.scene.name, index)
        if path.is_file():
            sealed_digest(path)
            continue
        write_view(path, _view(job, world, index, before, now, clock))
        clock.lap("write")
        spent["views"] += 1
    return spent


def _view(job: Job, world: SimWorld, index: int, before: ArmState, now: SimClock, clock: _Stopwatch) -> View:
    world.light()
    clock.lap("light")
    tof = world.tof(job.frames, now)
    clock.lap("tof")
    stereo = world.stereo(now)
    clock.lap("stereo")
    truth = world.truth()
    clock.lap("truth")
    after = ArmState(before.joints, before.T_base_flange, now())
    rig = world.nominal_rig()
    return View(job.scene.name, index, tof, stereo, before, after, rig, _provenance(job), truth)


def _provenance(job: Job) -> dict[str, Any]:
    """No time of day: the same recipe gives the same bytes."""
    return {
        "made_by": "tofcapture simulate-dataset",
        "simulator": VERSION,
        "tofcapture": __version__,
        "numpy": np.__version__,
        "seed": job.seed,
        "simulated": True,
        "objects": list(job.scene.identities),
        "scene": dict(job.scene.facts),
        **job.provenance,
    }


def _stations(job: Job, world: SimWorld) -> Iterator[tuple[int, ArmState, SimClock]]:
    """Bring the rig to every view: number, arm state, clock."""
    yield from _by_arm(job, world) if job.scene.poses is None else _free(job, world)


def _by_arm(job: Job, world: SimWorld) -> Iterator[tuple[int, ArmState, SimClock]]:
    """Views that the embedded station's arm reaches, planned as for a real scene."""
    config = read_station(None)
    model = arm_model(config["arm"]["model"])
    context = StationContext(config=config, folder=Path(), shared={"sim": world})
    stage = stage_of(config)
    rng = generator(job.scene.plan_name, job.seed, "suite plan")
    plan = plan_views(model, world.nominal_rig(), stage, stage.target, object_sampling(), job.views, rng)
    with SimArm({"model": config["arm"]["model"]}, context) as arm:
        for planned in plan.views:
            yield planned.index, arm.move_to(planned.joints), shared_clock(context)


def _free(job: Job, world: SimWorld) -> Iterator[tuple[int, ArmState, SimClock]]:
    """Views from anywhere: the "flange" stands where the ToF camera needs it, joints are not known."""
    assert job.scene.poses is not None
    rng = generator(job.scene.plan_name, job.seed, "suite poses")
    from_tof = invert(world.true_rig.T_flange_tof)
    for index, T_world_tof in enumerate(job.scene.poses(world.caster()[0], rng, job.views)):
        T = T_world_tof @ from_tof
        world.set_pose(T, f"{index}".encode() + np.round(T, 9).tobytes())
        clock = SimClock()
        yield index, ArmState(np.full(6, np.nan), T, clock()), clock


class _Stopwatch:
    """Counts CPU seconds of this process by stage."""

    def __init__(self, spent: Counter[str]) -> None:
        self._spent, self._last = spent, time.process_time()

    def lap(self, stage: str) -> None:
        """Book what passed since the last lap."""
        now = time.process_time()
        self._spent[stage] += now - self._last  # type: ignore[assignment]
        self._last = now
