"""The one simulated world that arm, ToF camera, stereo camera and operator of a simulated station share.

Everything random is drawn from a hash of the world's seed, the scene and the commanded pose: the same view taken again gives
the same arrays, whatever was taken before it.

It fails on demand, for tests of recovery: ``[sim.faults]`` of a station file says which move, burst or point map goes wrong
(docs/simulator.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tofcapture.devices.registry import check_keys
from tofcapture.devices.sim import VERSION, hashed_generator
from tofcapture.devices.sim.config import TABLES, Constants, load_world, read_constants
from tofcapture.devices.sim.light import Light, exact_view, light_at_pixels
from tofcapture.devices.sim.scene import Caster, SceneObject, merge
from tofcapture.devices.sim.scenes import mesh_files, scene_objects
from tofcapture.devices.sim.sensor import expose
from tofcapture.devices.sim.stereo import point_map
from tofcapture.devices.sim.transport import Lamp, Transport
from tofcapture.errors import DeviceError
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth, View
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64, invert, rotation_exp, transform, transform_points
from tofcapture.rig import RangeError, Rig

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext
import time
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from tofcapture.errors import ConfigError, MotionRefused


@dataclass(frozen=True)
class FaultPlan:
    """Hold what goes wrong when; see the module's head."""

    arm_refuses: tuple[int, ...] = ()
    tof_drops: tuple[int, ...] = ()
    stereo_empty: tuple[int, ...] = ()
    stereo_fails: tuple[int, ...] = ()
    moves: tuple[int, ...] = ()
    shift: float = 0.001
    slow: float = 0.0
    until: float = np.inf


def read_faults(table: Mapping[str, Any]) -> FaultPlan:
    """Read ``[sim.faults]``; :class:`ConfigError` on unknown keys, and anything but lists of burst numbers or numbers."""
    known = {f.name: f.default for f in fields(FaultPlan)}
    check_keys(table, known, "[sim.faults]")
    values: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(known[key], tuple):
            good, expected = (
                isinstance(value, list) and all(type(k) is int and k >= 0 for k in value),
                "a list of burst numbers",
            )
        else:
            good, expected = type(value) in (int, float) and value >= 0, "a number from 0 on"
        if not good:
            raise ConfigError(f"[sim.faults] {key}: expected {expected}, got {value!r}")
        values[key] = tuple(value) if isinstance(value, list) else float(value)
    return FaultPlan(**values)


class Faults:
    """The faults of one open station; ``sleep`` is how slow devices wait."""

    def __init__(self, plan: FaultPlan, sleep: Callable[[float], None] = time.sleep) -> None:
        self._plan, self._sleep = plan, sleep
        self._bursts = 0
        self._refused: set[int] = set()
        self.offset: Float64 = np.eye(
            4
        )  # how far the flange has moved from where it was sent, in its own frame

    def _strikes(self, when: tuple[int, ...], burst: int) -> bool:
        return burst in when and burst < self._plan.until

    def before_move(self) -> None:
        """Refuse a move as planned, once before each listed burst; raises :class:`MotionRefused`."""
        self.offset = np.eye(4)
        if self._strikes(self._plan.arm_refuses, self._bursts) and self._bursts not in self._refused:
            self._refused.add(self._bursts)
            raise MotionRefused(f"fault on demand: the arm refuses to move before burst {self._bursts}")

    def before_burst(self) -> None:
        """Lose the burst that the ToF camera is about to take, as planned; raises :class:`DeviceError`."""
        burst, self._bursts = self._bursts, self._bursts + 1
        self._wait(burst)
        if self._strikes(self._plan.tof_drops, burst):
            raise DeviceError(f"fault on demand: the ToF camera lost burst {burst}")

    def before_points(self) -> bool:
        """Move the arm or raise :class:`DeviceError`, as planned; tells whether the point map is to be empty."""
        burst = self._bursts - 1
        self._wait(burst)
        if self._strikes(self._plan.stereo_fails, burst):
            raise DeviceError(f"fault on demand: the stereo camera does not answer after burst {burst}")
        if self._strikes(self._plan.moves, burst):
            self.offset = transform(np.eye(3), [self._plan.shift, 0.0, 0.0])
        return self._strikes(self._plan.stereo_empty, burst)

    def _wait(self, burst: int) -> None:
        if self._plan.slow and burst < self._plan.until:
            self._sleep(self._plan.slow)


def _generator(*parts: object) -> np.random.Generator:
    return hashed_generator("|".join(repr(p) for p in parts).encode())


def factory_calibration(constants: Constants, seed: int) -> tuple[RangeError, ...]:
    """Make the range errors that the maker's calibration knows: the true ones, slightly wrong."""
    rng = _generator("factory", seed)
    wrong = constants.factory
    out = []
    for e in constants.sensor.range_errors:
        h = 1 + wrong["harmonics_error"] * rng.standard_normal((len(e.harmonics), 2))
        slope = 1 + wrong["slope_error"] * rng.standard_normal(2)
        offset = e.offset + wrong["offset_error"] * float(rng.standard_normal())
        harmonics = tuple(
            (m, a * float(x), b * float(y)) for (m, a, b), (x, y) in zip(e.harmonics, h, strict=True)
        )
        radius, kelvin = e.per_pixel_radius * float(slope[0]), e.per_kelvin * float(slope[1])
        out.append(replace(e, offset=offset, harmonics=harmonics, per_pixel_radius=radius, per_kelvin=kelvin))
    return tuple(out)


class SimWorld:
    """A scene, a pose, and what the devices of one station measure there.

    ``constants`` describe the devices, ``scenes`` are ``(name, seed) -> objects`` in the base frame, ``faults`` go wrong on
    demand. ``seed`` seeds everything random, the makers' calibrations and the bracket's drawing error included.
    """

    def __init__(
        self, constants: Constants, seed: int, scenes: Callable[[str, int], Sequence[SceneObject]],
        faults: FaultPlan | None = None,
    ) -> None:  # fmt: skip
        self.constants, self.seed = constants, seed
        self._scenes, self._scene = scenes, ""
        self._pose: tuple[Float64, bytes] | None = None
        self._built: tuple[str, Caster, Transport | None] | None = None
        self._lit: tuple[object, Light] | None = None
        self.faults = Faults(faults or FaultPlan())
        megahertz = "/".join(f"{f / 1e6:g}" for f in frequencies(constants.sensor.modulation_hz))
        self.tof_info = TofInfo(
            model=f"simulated {constants.tof.width}x{constants.tof.height} {megahertz} MHz",
            serial=f"sim-tof-{seed}",
            camera=constants.tof,
            illuminator=constants.illuminator,
            modulation_hz=constants.sensor.modulation_hz,
            phase_rad=constants.sensor.phase_rad,
            exposure=constants.sensor.exposure,
            saturation=constants.sensor.full_scale,
            range_errors=factory_calibration(constants, seed),
            offset=constants.sensor.offset,
            reach=constants.sensor.reach,
        )
        self.stereo_info = StereoInfo("simulated 1280x1024 stereo", f"sim-stereo-{seed}", constants.stereo)

    @cached_property
    def true_rig(self) -> Rig:
        """Say where the cameras truly are, with the true range errors."""
        rig = self.constants.rig
        T_tof_stereo = transform(rotation_exp(rig["stereo_rotation"]), rig["stereo_position"])
        T_flange_tof = transform(rotation_exp(rig["tof_rotation"]), rig["tof_position"])
        c = self.constants
        return Rig(c.tof, c.stereo, T_tof_stereo, T_flange_tof, c.illuminator, c.sensor.range_errors)

    def nominal_rig(self) -> Rig:
        """Say what the bracket's drawing and the maker's calibration say: wrong by degrees and millimetres."""
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
        """Tell the world where the flange truly is (4, 4); noise is drawn from seed, scene and ``key`` of the commanded pose."""
        self._pose = (T_base_flange, key)

    def _here(self) -> tuple[Float64, bytes]:
        if self._pose is None:
            hint = "open the arm before the cameras capture"
            raise DeviceError("the simulated arm has not been opened", hint)
        if not self._scene:
            raise DeviceError("no scene stands on the simulated table", "call operator.place(scene) first")
        T_base_flange, key = self._pose
        return T_base_flange @ self.faults.offset, key

    def _rng(self, device: str) -> np.random.Generator:
        return _generator(device, self.seed, self._scene, self._here()[1])

    def caster(self) -> tuple[Caster, Transport | None]:
        """Return the present scene, ready for rays, and the light between its surfaces."""
        if self._built is None or self._built[0] != self._scene:
            caster = Caster(merge(self._scenes(self._scene, self.seed)))
            render, hz = self.constants.render, frequencies(self.tof_info.modulation_hz)
            transport = Transport(caster, hz, render.patches, render.patch_rays) if render.multipath else None
            self._built = (self._scene, caster, transport)
        return self._built[1], self._built[2]

    def light(self) -> Light:
        """Compute what reaches the ToF pixels at the present pose."""
        T_base_flange, key = self._here()
        name = (self._scene, key, T_base_flange.tobytes())
        if self._lit is None or self._lit[0] != name:
            caster, transport = self.caster()
            c, hz = self.constants, frequencies(self.tof_info.modulation_hz)
            T_base_tof = T_base_flange @ self.true_rig.T_flange_tof
            lamp = Lamp(transform_points(T_base_tof, c.illuminator), T_base_tof[:3, 2], **c.lamp)
            fineness = c.render.subpixels, c.render.rays
            self._lit = (name, light_at_pixels(caster, c.tof, T_base_tof, lamp, hz, transport, *fineness))
        return self._lit[1]

    def tof(self, frames: int, clock: Callable[[], int]) -> TofBurst:
        """Take a ToF burst; ``clock`` gives int ns."""
        start = clock()
        light = self.light()
        sensor, rng = self.constants.sensor, self._rng("tof")
        raw, celsius = expose(light, sensor, self.tof_info, frames, rng, self.seed)
        times = start + (np.arange(frames) * 1e9 / 30).astype(np.int64)
        return TofBurst(raw=raw, time_ns=times, celsius=celsius, info=self.tof_info)

    def stereo(self, clock: Callable[[], int]) -> StereoFrame:
        """Take a stereo point map; ``clock`` gives int ns."""
        c, pose = self.constants, self._here()[0] @ self.true_rig.T_flange_stereo
        points = point_map(self.caster()[0], c.stereo, pose, c.stereo_model, self._rng("stereo"))
        return StereoFrame(points=points, time_ns=clock(), info=self.stereo_info)

    def truth(self) -> Truth:
        """Say what is exactly true of the present view."""
        T_base_tof = self._here()[0] @ self.true_rig.T_flange_tof
        depth, normals, target = exact_view(self.caster()[0], self.constants.tof.scaled(2), T_base_tof)
        return Truth(depth, normals, target, self.true_rig.T_tof_stereo, self.true_rig.T_flange_tof)


def shared_world(context: StationContext) -> SimWorld:
    """Return the world that all simulated drivers of one station share; made by the first that asks.

    The station file's ``[sim]`` table holds ``seed``, optionally ``meshes`` (a folder) with ``mesh_unit``, ``board`` (a
    board's TOML file that stands in for the packaged one), ``faults`` on demand, and overrides of constants.toml.
    """
    if "sim" not in context.shared:
        table = dict(context.config.get("sim", {}))
        check_keys(table, {"seed", "meshes", "mesh_unit", "board", "faults", *TABLES}, "[sim]")
        folder, unit = table.get("meshes"), str(table.get("mesh_unit", "m"))
        board = context.folder / table["board"] if "board" in table else None
        paths = {} if folder is None else {p.stem: p for p in mesh_files(context.folder / folder)}
        world = SimWorld(
            read_constants(table, "station file"),
            int(table.get("seed", 0)),
            lambda name, seed: scene_objects(name, seed, paths, unit, board),
            read_faults(table.get("faults", {})),
        )
        context.shared["sim"], context.shared["rig"] = world, world.nominal_rig()
    found: SimWorld = context.shared["sim"]
    return found


def simulate(path: str | Path, *, ideal: bool = False, frames: int = 10) -> View:
    """Render one view of a world file.

    ``ideal`` switches every sensor imperfection and quantisation off; raw is float64 then. ``frames`` are those of the burst.
    """
    path = Path(path)
    file = load_world(path)
    constants = file.constants.idealised() if ideal else file.constants
    world = SimWorld(constants, file.seed, lambda _name, _seed: file.objects)
    T_world_flange = file.T_world_tof @ invert(world.true_rig.T_flange_tof)
    world.place(path.stem)
    world.set_pose(T_world_flange, b"world file")
    clock = iter(range(0, 10**13, 10**9)).__next__
    arm = ArmState(np.full(6, np.nan), T_world_flange, 0)
    provenance = {"made_by": "tofcapture simulate", "simulator": VERSION, "world": path.name}
    return View(
        scene=path.stem,
        index=0,
        tof=world.tof(frames, clock),
        stereo=world.stereo(clock),
        arm_before=arm,
        arm_after=arm,
        rig=world.true_rig if ideal else world.nominal_rig(),
        provenance={**provenance, "ideal": ideal, "seed": file.seed},
        truth=world.truth(),
    )
