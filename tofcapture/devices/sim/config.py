"""The simulator's TOML: constants of the devices, and whole worlds that anyone can write; docs/simulator.md lists the keys.

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from tofcapture.camera import Camera
from tofcapture.channels import parse_reach
from tofcapture.devices.registry import check_keys
from tofcapture.devices.sim import sensor as sensors
from tofcapture.devices.sim import stereo as stereos
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.sensor import Sensor
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.devices.sim.stereo import StereoModel
from tofcapture.errors import ConfigError
from tofcapture.meshes import metres_per, read_mesh
from tofcapture.poses import Float64, check_transform
from tofcapture.rig import range_error_from

TABLES = ("tof", "lamp", "sensor", "factory", "stereo", "stereo_model", "rig", "render")
_OBJECT_KEYS = {"mesh", "mesh_unit", "family", "family_seed", "albedo", "T_world_object", "target", "name"}
_T = TypeVar("_T")


@dataclass(frozen=True)
class Render:
    """Tell how finely the light is computed; see constants.toml."""

    multipath: bool = True
    subpixels: int = 4
    rays: int = 48
    patches: int = 2500
    patch_rays: int = 256


@dataclass(frozen=True)
class Constants:
    """Everything about the simulated devices that is not the scene."""

    tof: Camera
    illuminator: Float64
    lamp: Mapping[str, float]
    sensor: Sensor
    factory: Mapping[str, float]
    stereo: Camera
    stereo_model: StereoModel
    rig: Mapping[str, Any]
    render: Render

    def idealised(self) -> Constants:
        """Return the same devices without any imperfection: geometry, albedo and multipath stay."""
        return replace(
            self,
            sensor=sensors.ideal(self.sensor),
            stereo_model=stereos.ideal(self.stereo_model),
            factory=dict.fromkeys(self.factory, 0.0),
            render=replace(self.render, rays=max(self.render.rays, 128)),
        )


@dataclass(frozen=True)
class WorldFile:
    """A world as its file describes it: devices, scene, and where the ToF camera stands."""

    constants: Constants
    objects: tuple[SceneObject, ...]
    T_world_tof: Float64
    seed: int


def read_constants(overrides: Mapping[str, Any], where: str) -> Constants:
    """Read the simulator's constants: constants.toml with ``overrides`` (tables of the same names) laid over it.

    :class:`ConfigError` names a key that constants.toml does not know, or a value that cannot be.
    """
    defaults = _with_preset(_shipped("constants.toml"), overrides, where)

    def table(name: str) -> dict[str, Any]:
        given = overrides.get(name, {})
        check_keys(given, {*defaults[name], *(["preset"] if name == "tof" else [])}, f"{where}: [{name}]")
        return {**defaults[name], **{k: v for k, v in given.items() if k != "preset"}}

    def made(kind: Callable[..., _T], name: str, values: Mapping[str, Any]) -> _T:
        try:
            return kind(**values)
        except (TypeError, ValueError) as err:
            raise ConfigError(f"{where}: [{name}]: {err}") from err

    tof, sensor = table("tof"), table("sensor")
    illuminator = np.asarray(tof.pop("illuminator"), dtype=np.float64)
    if illuminator.shape != (3,):
        raise ConfigError(f"{where}: [tof] illuminator: expected 3 numbers, got {illuminator.tolist()}")
    sensor["range_errors"] = tuple(range_error_from(e) for e in sensor.pop("range_error"))
    for key in ("modulation_hz", "phase_rad", "contrast", "signal"):
        sensor[key] = tuple(float(x) for x in np.atleast_1d(sensor[key]))
    sensor["reach"] = parse_reach(tof.pop("reach") or None, f"{where}: [tof]")
    sensor["harmonics"] = tuple((int(m), float(a)) for m, a in sensor["harmonics"])
    electronics = made(Sensor, "sensor", sensor)
    sensors.check_sensor(electronics, f"{where}: [sensor]")
    camera = made(Camera, "tof", tof)
    return Constants(
        tof=camera,
        illuminator=illuminator,
        lamp=table("lamp"),
        sensor=sensors.with_phase_table(electronics, camera),
        factory=table("factory"),
        stereo=made(Camera, "stereo", table("stereo")),
        stereo_model=made(StereoModel, "stereo_model", table("stereo_model")),
        rig=table("rig"),
        render=made(Render, "render", table("render")),
    )


def presets() -> tuple[str, ...]:
    """Name the cameras of cameras.toml."""
    return tuple(_shipped("cameras.toml"))


def _shipped(name: str) -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))


def _with_preset(defaults: dict[str, Any], overrides: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Lay the camera of cameras.toml that ``[tof] preset`` names over the defaults; :class:`ConfigError` when there is none."""
    name = overrides.get("tof", {}).get("preset", "paper")
    known = _shipped("cameras.toml")
    if name not in known:
        raise ConfigError(
            f"{where}: [tof] preset: no camera {name!r}", hint=f"cameras: {', '.join(sorted(known))}"
        )
    said = known[name]
    tof, sensor = dict(defaults["tof"]), dict(defaults["sensor"])
    if "size" in said:
        width, height = said["size"]
        focal = width / 2 / np.tan(np.radians(said["across"]) / 2)
        tof |= {
            "width": width,
            "height": height,
            "fx": focal,
            "fy": focal,
            "cx": (width - 1) / 2,
            "cy": (height - 1) / 2,
        }
    if "mhz" in said:
        each = list(zip(said["mhz"], said.get("phases", [[0, 90, 180, 270]] * len(said["mhz"])), strict=True))
        sensor["modulation_hz"] = [round(mhz * 1e6) for mhz, phases in each for _ in phases]
        sensor["phase_rad"] = [float(np.radians(p)) for _, phases in each for p in phases]
        sensor |= {"contrast": np.resize(sensor["contrast"], len(each)).tolist(), "range_error": []}
    sensor |= {k: said[k] for k in ("contrast", "offset", "full_scale", "phase_table") if k in said}
    return {**defaults, "tof": tof, "sensor": sensor}


def load_world(path: Path) -> WorldFile:
    """Read a world file; :class:`ConfigError` names the place of an unknown key, a missing mesh, a pose that is not rigid."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: cannot read the world: {err}") from err
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    check_keys(table, {"units", "seed", "camera", "object", *TABLES}, f"{path}: a world")
    units = str(table.get("units", ""))
    scale = metres_per(units, f"{path}: units")
    if "illuminator" in table.get("tof", {}):
        table["tof"]["illuminator"] = [scale * float(x) for x in table["tof"]["illuminator"]]
    objects = tuple(
        _object(o, path.parent, units, f"{path}: [[object]] {i}")
        for i, o in enumerate(table.get("object", []))
    )
    if not objects:
        raise ConfigError(f"{path}: the world is empty", hint="add an [[object]] with a mesh or a family")
    pose = table.get("camera", {}).get("T_world_tof", np.eye(4))
    return WorldFile(
        constants=read_constants(table, str(path)),
        objects=objects,
        T_world_tof=_in_metres(pose, scale, f"{path}: [camera] T_world_tof"),
        seed=int(table.get("seed", 0)),
    )


def _object(table: Mapping[str, Any], folder: Path, units: str, where: str) -> SceneObject:
    check_keys(table, _OBJECT_KEYS, where)
    if ("mesh" in table) == ("family" in table):
        raise ConfigError(f"{where}: expected either mesh or family")
    if "mesh" in table:
        vertices, triangles = read_mesh(folder / table["mesh"], str(table.get("mesh_unit", units)))
    else:
        family = table["family"]
        if family not in FAMILIES:
            raise ConfigError(
                f"{where}: no family {family!r}", hint=f"families: {', '.join(sorted(FAMILIES))}"
            )
        vertices, triangles = FAMILIES[family](np.random.default_rng(int(table.get("family_seed", 0))))
    pose, scale = table.get("T_world_object", np.eye(4)), metres_per(units, where)
    return SceneObject(
        vertices=vertices,
        triangles=triangles,
        albedo=float(table.get("albedo", 0.5)),
        T_world_object=_in_metres(pose, scale, f"{where}: T_world_object"),
        target=bool(table.get("target", True)),
        name=str(table.get("name", table.get("mesh", table.get("family")))),
    )


def _in_metres(T: Any, scale: float, where: str) -> Float64:
    out = np.array(T, dtype=np.float64)
    if out.shape == (4, 4):
        out[:3, 3] *= scale
    return check_transform(out, where)
