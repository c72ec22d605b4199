"""A world as a TOML file that anyone can write; docs/simulator.md lists its keys.

::

    units = "m"
    [camera]
    T_world_tof = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    [[object]]
    mesh = "corner.ply"        # relative to this file; or family = "mug", family_seed = 3
    albedo = 0.8
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.sim import VERSION
from tofcapture.devices.sim.meshes import metres_per, read_mesh
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.world import TABLES, Constants, SimWorld, idealised, read_constants
from tofcapture.errors import ConfigError
from tofcapture.frames import ArmState, View
from tofcapture.poses import Float64, check_transform, invert

_OBJECT_KEYS = {"mesh", "mesh_unit", "family", "family_seed", "albedo", "T_world_object", "target", "name"}


@dataclass(frozen=True)
class WorldFile:
    """A world as its file describes it: devices, scene, and where the ToF camera stands."""

    constants: Constants
    objects: tuple[SceneObject, ...]
    T_world_tof: Float64
    seed: int


def _in_metres(T: Any, scale: float, where: str) -> Float64:
    out = np.array(T, dtype=np.float64)
    if out.shape == (4, 4):
        out[:3, 3] *= scale
    return check_transform(out, where)


def _object(table: Mapping[str, Any], index: int, folder: Path, units: str, where: str) -> SceneObject:
    from tofcapture.devices.sim.shapes import FAMILIES

    label = f"{where}: [[object]] {index}"
    unknown = table.keys() - _OBJECT_KEYS
    if unknown:
        raise ConfigError(
            f"{label}: unknown key {', '.join(sorted(unknown))}",
            hint=f"known: {', '.join(sorted(_OBJECT_KEYS))}",
        )
    if ("mesh" in table) == ("family" in table):
        raise ConfigError(f"{label}: expected either mesh or family")
    if "mesh" in table:
        vertices, triangles = read_mesh(folder / table["mesh"], str(table.get("mesh_unit", units)))
    else:
        family = table["family"]
        if family not in FAMILIES:
            raise ConfigError(
                f"{label}: no family {family!r}", hint=f"families: {', '.join(sorted(FAMILIES))}"
            )
        vertices, triangles = FAMILIES[family](np.random.default_rng(int(table.get("family_seed", 0))))
    return SceneObject(
        vertices=vertices,
        triangles=triangles,
        albedo=float(table.get("albedo", 0.5)),
        T_world_object=_in_metres(
            table.get("T_world_object", np.eye(4)), metres_per(units, where), f"{label}: T_world_object"
        ),
        target=bool(table.get("target", True)),
        name=str(table.get("name", table.get("mesh", table.get("family")))),
    )


def load_world(path: Path) -> WorldFile:
    """Read a world file.

    Raises
    ------
    ConfigError
        Not TOML, unknown keys, missing meshes, transforms that are not rigid; the message names the place.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: cannot read the world: {err}") from err
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    where = str(path)
    unknown = table.keys() - {"units", "seed", "camera", "object", *TABLES}
    if unknown:
        raise ConfigError(
            f"{where}: unknown key {', '.join(sorted(unknown))}", hint="docs/simulator.md lists the keys"
        )
    units = str(table.get("units", ""))
    scale = metres_per(units, f"{where}: units")
    if "tof" in table and "illuminator" in table["tof"]:
        table["tof"]["illuminator"] = [scale * float(x) for x in table["tof"]["illuminator"]]
    objects = tuple(_object(o, i, path.parent, units, where) for i, o in enumerate(table.get("object", [])))
    if not objects:
        raise ConfigError(f"{where}: the world is empty", hint="add an [[object]] with a mesh or a family")
    pose = table.get("camera", {}).get("T_world_tof", np.eye(4))
    return WorldFile(
        constants=read_constants(table, where),
        objects=objects,
        T_world_tof=_in_metres(pose, scale, f"{where}: [camera] T_world_tof"),
        seed=int(table.get("seed", 0)),
    )


def simulate(path: Path, *, ideal: bool, frames: int) -> View:
    """Render one view of a world file.

    Parameters
    ----------
    path
        The world file.
    ideal
        Switch every sensor imperfection and quantisation off; raw is float64 then.
    frames
        Frames in the burst.
    """
    world_file = load_world(path)
    constants = idealised(world_file.constants) if ideal else world_file.constants
    world = SimWorld(constants, world_file.seed, lambda _name, _seed: world_file.objects)
    T_world_flange = world_file.T_world_tof @ invert(world.true_rig.T_flange_tof)
    world.place(path.stem)
    world.set_pose(T_world_flange, b"world file")
    ticks = iter(range(10_000))

    def clock() -> int:
        return next(ticks) * 1_000_000_000

    arm = ArmState(np.full(6, np.nan), T_world_flange, 0)
    return View(
        scene=path.stem,
        index=0,
        tof=world.tof(frames, clock),
        stereo=world.stereo(clock),
        arm_before=arm,
        arm_after=arm,
        rig=world.true_rig if ideal else world.nominal_rig(),
        provenance={
            "made_by": "tofcapture simulate",
            "simulator": VERSION,
            "world": path.name,
            "ideal": ideal,
            "seed": world_file.seed,
        },
        truth=world.truth(),
    )
