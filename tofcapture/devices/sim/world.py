"""The one simulated world that arm, ToF camera, stereo camera and operator of a simulated station share.

Everything random is drawn from a hash of the world's seed, the scene and the commanded pose: the same view taken again gives
the same arrays, whatever was taken before it.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices.sim import sensor as sensors
from tofcapture.devices.sim import stereo as stereos
from tofcapture.devices.sim.faults import FaultPlan, Faults, read_faults
from tofcapture.devices.sim.light import Light, exact_view, light_at_pixels
from tofcapture.devices.sim.render import Caster, merge
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.sensor import Sensor, expose
from tofcapture.devices.sim.stereo import StereoModel, point_map
from tofcapture.devices.sim.transport import Lamp, Transport
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64, rotation_exp, transform, transform_points
from tofcapture.rig import RangeError, Rig, range_error_from

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_T = TypeVar("_T")


@dataclass(frozen=True)
class Render:
    """How finely the light is computed; see constants.toml."""

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


TABLES = ("tof", "lamp", "sensor", "factory", "stereo", "stereo_model", "rig", "render")


def default_constants() -> dict[str, Any]:
    """Tables of constants.toml."""
    return tomllib.loads(Path(__file__).with_name("constants.toml").read_text(encoding="utf-8"))


def merged(overrides: Mapping[str, Any], where: str, table: str) -> dict[str, Any]:
    """Take one table of constants.toml with overrides laid over it.

    Raises
    ------
    ConfigError
        On a key that constants.toml does not know.
    """
    base = dict(default_constants()[table])
    given = overrides.get(table, {})
    unknown = set(given) - set(base)
    if unknown:
        raise ConfigError(
            f"{where}: [{table}] does not know {', '.join(sorted(unknown))}",
            hint=f"it knows {', '.join(sorted(base))}",
        )
    return {**base, **given}


def _make(kind: Callable[..., _T], values: Mapping[str, Any], where: str) -> _T:
    try:
        return kind(**values)
    except (TypeError, ValueError) as err:
        raise ConfigError(f"{where}: {err}") from err


def read_constants(overrides: Mapping[str, Any], where: str) -> Constants:
    """Read the simulator's constants: constants.toml with ``overrides`` (tables of the same names) laid over it."""
    tof = merged(overrides, where, "tof")
    illuminator = np.asarray(tof.pop("illuminator"), dtype=np.float64)
    if illuminator.shape != (3,):
        raise ConfigError(f"{where}: [tof] illuminator: expected 3 numbers, got {illuminator.tolist()}")
    sensor = merged(overrides, where, "sensor")
    errors = tuple(range_error_from(e) for e in sensor.pop("range_error"))
    for key in ("modulation_hz", "phase_rad", "contrast"):
        sensor[key] = tuple(float(x) for x in sensor[key])
    sensor["harmonics"] = tuple((int(m), float(a)) for m, a in sensor["harmonics"])
    made = _make(lambda **v: Sensor(range_errors=errors, **v), sensor, f"{where}: [sensor]")
    sensors.check_channels(made, f"{where}: [sensor]")
    return Constants(
        tof=_make(Camera, tof, f"{where}: [tof]"),
        illuminator=illuminator,
        lamp=merged(overrides, where, "lamp"),
        sensor=made,
        factory=merged(overrides, where, "factory"),
        stereo=_make(Camera, merged(overrides, where, "stereo"), f"{where}: [stereo]"),
        stereo_model=_make(StereoModel, merged(overrides, where, "stereo_model"), f"{where}: [stereo_model]"),
        rig=merged(overrides, where, "rig"),
        render=_make(Render, merged(overrides, where, "render"), f"{where}: [render]"),
    )


def idealised(constants: Constants) -> Constants:
    """Return the same world seen without any sensor imperfection: geometry, albedo and multipath stay."""
    render = replace(constants.render, rays=max(constants.render.rays, 128))
    return replace(
        constants,
        sensor=sensors.ideal(constants.sensor),
        stereo_model=stereos.ideal(constants.stereo_model),
        factory=dict.fromkeys(constants.factory, 0.0),
        render=render,
    )


def _generator(*parts: object) -> np.random.Generator:
    digest = hashlib.sha256("|".join(repr(p) for p in parts).encode()).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype=np.uint32).tolist())


def factory_calibration(constants: Constants, seed: int) -> tuple[RangeError, ...]:
    """Range errors as the maker's calibration knows them: the true ones, slightly wrong."""
    rng = _generator("factory", seed)
    wrong = constants.factory
    out = []
    for e in constants.sensor.range_errors:
        h = 1 + wrong["harmonics_error"] * rng.standard_normal((len(e.harmonics), 2))
        slope = 1 + wrong["slope_error"] * rng.standard_normal(2)
        out.append(
            replace(
                e,
                offset=e.offset + wrong["offset_error"] * float(rng.standard_normal()),
                harmonics=tuple(
                    (m, a * float(x), b * float(y)) for (m, a, b), (x, y) in zip(e.harmonics, h, strict=True)
                ),
                per_pixel_radius=e.per_pixel_radius * float(slope[0]),
                per_kelvin=e.per_kelvin * float(slope[1]),
            )
        )
    return tuple(out)


def _model_name(constants: Constants) -> str:
    megahertz = "/".join(f"{f / 1e6:g}" for f in frequencies(constants.sensor.modulation_hz))
    return f"simulated {constants.tof.width}x{constants.tof.height} {megahertz} MHz"


class SimWorld:
    """A scene, a pose, and what the devices of one station measure there.

    Parameters
    ----------
    constants
        The devices.
    seed
        Seeds everything random, the makers' calibrations and the bracket's drawing error included.
    scenes
        ``(name, seed) -> objects`` in the base frame.
    """

    def __init__(
        self, constants: Constants, seed: int, scenes: Callable[[str, int], Sequence[SceneObject]]
    ) -> None:
        self.constants = constants
        self.seed = seed
        self._scenes = scenes
        self._scene = ""
        self._pose: tuple[Float64, bytes] | None = None
        self._built: tuple[str, Caster, Transport | None] | None = None
        self._lit: tuple[object, Light] | None = None
        self.faults = Faults(FaultPlan())
        self.tof_info = TofInfo(
            model=_model_name(constants),
            serial=f"sim-tof-{seed}",
            camera=constants.tof,
            illuminator=constants.illuminator,
            modulation_hz=constants.sensor.modulation_hz,
            phase_rad=constants.sensor.phase_rad,
            exposure=constants.sensor.exposure,
            saturation=constants.sensor.full_scale,
            range_errors=factory_calibration(constants, seed),
        )
        self.stereo_info = StereoInfo("simulated 1280x1024 stereo", f"sim-stereo-{seed}", constants.stereo)

    @cached_property
    def true_rig(self) -> Rig:
        """Where the cameras truly are, and the true range errors."""
        rig = self.constants.rig
        return Rig(
            tof=self.constants.tof,
            stereo=self.constants.stereo,
            illuminator=self.constants.illuminator,
            T_tof_stereo=transform(rotation_exp(rig["stereo_rotation"]), rig["stereo_position"]),
            T_flange_tof=transform(rotation_exp(rig["tof_rotation"]), rig["tof_position"]),
            range_errors=self.constants.sensor.range_errors,
        )

    def nominal_rig(self) -> Rig:
        """What the bracket's drawing and the maker's calibration say: the true rig, wrong by degrees and millimetres."""
        rng = _generator("drawing", self.seed)
        shift, tilt = self.constants.rig["drawing_error"], self.constants.rig["drawing_tilt_error"]

        def wrong(T: Float64) -> Float64:
            return T @ transform(rotation_exp(tilt * rng.standard_normal(3)), shift * rng.standard_normal(3))

        return replace(
            self.true_rig,
            T_tof_stereo=wrong(self.true_rig.T_tof_stereo),
            T_flange_tof=wrong(self.true_rig.T_flange_tof),
            range_errors=self.tof_info.range_errors,
        )

    def place(self, scene: str) -> None:
        """Put a scene on the table."""
        self._scene = scene

    def set_pose(self, T_base_flange: Float64, key: bytes) -> None:
        """Tell the world where the flange truly is.

        Parameters
        ----------
        T_base_flange
            (4, 4).
        key
            Names the commanded pose; the noise of a view is drawn from seed, scene and key.
        """
        self._pose = (T_base_flange, key)

    def _here(self) -> tuple[Float64, bytes]:
        if self._pose is None:
            raise DeviceError(
                "the simulated arm has not been opened", hint="open the arm before the cameras capture"
            )
        if not self._scene:
            raise DeviceError(
                "no scene stands on the simulated table", hint="call operator.place(scene) first"
            )
        T_base_flange, key = self._pose
        return T_base_flange @ self.faults.offset, key

    def _rng(self, device: str) -> np.random.Generator:
        return _generator(device, self.seed, self._scene, self._here()[1])

    def caster(self) -> tuple[Caster, Transport | None]:
        """Return the present scene, ready for rays, and the light between its surfaces."""
        if self._built is None or self._built[0] != self._scene:
            caster = Caster(merge(self._scenes(self._scene, self.seed)))
            render = self.constants.render
            transport = None
            if render.multipath:
                transport = Transport(
                    caster, frequencies(self.tof_info.modulation_hz), render.patches, render.patch_rays
                )
            self._built = (self._scene, caster, transport)
        return self._built[1], self._built[2]

    def _pose_of(self, T_flange_camera: Float64) -> Float64:
        return self._here()[0] @ T_flange_camera

    def light(self) -> Light:
        """What reaches the ToF pixels at the present pose."""
        T_base_flange, key = self._here()
        name = (self._scene, key, T_base_flange.tobytes())
        if self._lit is None or self._lit[0] != name:
            caster, transport = self.caster()
            render = self.constants.render
            T_base_tof = self._pose_of(self.true_rig.T_flange_tof)
            lamp = Lamp(
                transform_points(T_base_tof, self.constants.illuminator),
                T_base_tof[:3, 2],
                **self.constants.lamp,
            )
            light = light_at_pixels(
                caster,
                self.constants.tof,
                T_base_tof,
                lamp,
                frequencies(self.tof_info.modulation_hz),
                transport,
                subpixels=render.subpixels,
                rays=render.rays,
            )
            self._lit = (name, light)
        return self._lit[1]

    def tof(self, frames: int, clock: Callable[[], int]) -> TofBurst:
        """Take a ToF burst; ``clock`` gives int ns."""
        start = clock()
        light = self.light()
        raw, celsius = expose(
            light, self.constants.sensor, self.tof_info, frames, self._rng("tof"), self.seed
        )
        times = start + (np.arange(frames) * 1e9 / 30).astype(np.int64)
        return TofBurst(raw=raw, time_ns=times, celsius=celsius, info=self.tof_info)

    def stereo(self, clock: Callable[[], int]) -> StereoFrame:
        """Take a stereo point map; ``clock`` gives int ns."""
        points = point_map(
            self.caster()[0],
            self.constants.stereo,
            self._pose_of(self.true_rig.T_flange_stereo),
            self.constants.stereo_model,
            self._rng("stereo"),
        )
        return StereoFrame(points=points, time_ns=clock(), info=self.stereo_info)

    def truth(self) -> Truth:
        """What is exactly true of the present view."""
        T_base_tof = self._pose_of(self.true_rig.T_flange_tof)
        depth, normals, target = exact_view(self.caster()[0], self.constants.tof.scaled(2), T_base_tof)
        return Truth(depth, normals, target, self.true_rig.T_tof_stereo, self.true_rig.T_flange_tof)


def shared_world(context: StationContext) -> SimWorld:
    """Return the world that all simulated drivers of one station share; made by the first that asks.

    The station file's ``[sim]`` table holds ``seed``, optionally ``meshes`` (a folder) with ``mesh_unit``, ``faults`` on demand, and
    overrides of constants.toml.
    """
    from tofcapture.devices.sim.scenes import scene_objects

    if "sim" not in context.shared:
        table = dict(context.config.get("sim", {}))
        seed = int(table.pop("seed", 0))
        faults = read_faults(table.pop("faults", {}))
        meshes, unit = table.pop("meshes", None), str(table.pop("mesh_unit", "m"))
        unknown = table.keys() - set(TABLES)
        if unknown:
            raise ConfigError(
                f"[sim] does not know {', '.join(sorted(unknown))}",
                hint=f"it knows seed, meshes, mesh_unit, faults, {TABLES}",
            )
        folder = None if meshes is None else context.folder / meshes
        paths = (
            {}
            if folder is None
            else {p.stem: p for p in sorted(folder.iterdir()) if p.suffix in {".ply", ".obj", ".stl"}}
        )

        def scenes(name: str, scene_seed: int) -> Sequence[SceneObject]:
            return scene_objects(name, scene_seed, paths, unit)

        made = SimWorld(read_constants(table, "station file"), seed, scenes)
        made.faults = Faults(faults)
        context.shared["sim"] = made
    world: SimWorld = context.shared["sim"]
    return world
