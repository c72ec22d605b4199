"""Take the views of one scene of a suite, as sealed view files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.devices.clearance import workcell_of
from tofcapture.devices.kinematics import arm_model
from tofcapture.devices.registry import StationContext
from tofcapture.devices.sim import VERSION
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.drivers import SimArm, SimClock, shared_clock
from tofcapture.devices.sim.scenes import generator
from tofcapture.devices.sim.world import SimWorld
from tofcapture.devices.station import read_station
from tofcapture.files.seal import sealed_digest
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import invert
from tofcapture.record.plan import object_sampling, plan_views
from tofcapture.suites.scene import Scene


@dataclass(frozen=True)
class Job:
    """One scene to capture."""

    scene: Scene
    seed: int  #: Of its rig: one camera, one bracket, one arm.
    views: int
    frames: int  #: Of each ToF burst.
    sim: Mapping[str, Any]  #: Overrides of the simulator's constants for the whole dataset.
    provenance: Mapping[str, Any]  #: Stored in every view.


def layered(*tables: Mapping[str, Any]) -> dict[str, Any]:
    """Lay tables of tables over each other, the later ones over the earlier ones."""
    out: dict[str, Any] = {}
    for table in tables:
        for name, values in table.items():
            out[name] = {**out.get(name, {}), **values}
    return out


def make_world(job: Job) -> SimWorld:
    """Make the world of a scene: devices of the dataset, constants of the scene.

    Under both lie those of the embedded station, whose lamp lights the image and little beside it.
    """
    station = {k: v for k, v in read_station(None)["sim"].items() if isinstance(v, Mapping)}
    constants = read_constants(layered(station, job.sim, job.scene.sim), f"scene {job.scene.name}")
    world = SimWorld(constants, job.seed, lambda _name, _seed: job.scene.objects)
    world.place(job.scene.name)
    return world


def take_views(job: Job, recording: Path) -> Counter[str]:
    """Take every view of a scene that is not there yet.

    They go into ``recording`` as ``views/<scene>/view-007.h5``; whole views in it are kept.

    Returns CPU seconds by stage (``scene``, ``poses``, ``light``, ``tof``, ``stereo``, ``truth``, ``write``),
    and ``views`` taken.
    """
    spent: Counter[str] = Counter()
    last = time.process_time()

    def lap(stage: str) -> None:
        nonlocal last
        now = time.process_time()
        spent[stage] += now - last  # type: ignore[assignment]
        last = now

    world, poses = make_world(job), _by_arm if job.scene.poses is None else _free
    world.caster()
    lap("scene")
    for index, before, now in poses(job, world):
        lap("poses")
        path = view_path(recording, job.scene.name, index)
        if path.is_file():
            sealed_digest(path)
            continue
        write_view(path, _view(job, world, index, before, now, lap))
        lap("write")
        spent["views"] += 1
    return spent


def _view(
    job: Job, world: SimWorld, index: int, before: ArmState, now: SimClock, lap: Callable[[str], None]
) -> View:
    world.light()
    lap("light")
    tof = world.tof(job.frames, now)
    lap("tof")
    stereo = world.stereo(now)
    lap("stereo")
    truth = world.truth()
    lap("truth")
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


def _by_arm(job: Job, world: SimWorld) -> Iterator[tuple[int, ArmState, SimClock]]:
    """Bring the embedded station's arm to views that are planned as for a real scene: number, arm state, clock."""
    config = read_station(None)
    model = arm_model(config["arm"]["model"])
    context = StationContext(config=config, folder=Path(), shared={"sim": world})
    workcell = workcell_of(config)
    rng = generator(job.scene.plan_name, job.seed, "suite plan")
    # Networks learn from afar and from straight above as well, where a scene's ground truth has more gaps.
    sampling = replace(object_sampling(), both=False)
    plan = plan_views(model, world.nominal_rig(), workcell, workcell.target, sampling, job.views, rng)
    with SimArm({"model": config["arm"]["model"]}, context) as arm:
        for planned in plan.views:
            yield planned.index, arm.move_to(planned.joints), shared_clock(context)


def _free(job: Job, world: SimWorld) -> Iterator[tuple[int, ArmState, SimClock]]:
    """Take views from anywhere: the "flange" stands where the ToF camera needs it, joints are not known."""
    assert job.scene.poses is not None
    rng = generator(job.scene.plan_name, job.seed, "suite poses")
    from_tof = invert(world.true_rig.T_flange_tof)
    for index, T_world_tof in enumerate(job.scene.poses(world.caster()[0], rng, job.views)):
        T = T_world_tof @ from_tof
        world.set_pose(T, f"{index}".encode() + np.round(T, 9).tobytes())
        clock = SimClock()
        yield index, ArmState(np.full(6, np.nan), T, clock()), clock
