"""What a network makes of cameras, light and scenes that it was not trained on: a row for each shift, the worst first.

    python benchmarks/shifts.py FOLDER [--weights RUN] [--scenes 24] [--views 2] [--meshes DIR] [--only ROW ...]
    python benchmarks/shifts.py FOLDER --scenes 4 --views 2        # a small one

Datasets are made by what stands behind `tofcapture simulate-dataset`, with the overrides of ``[sim]`` that a row names, and answered
by the public ``Predictor``. Rows that differ in the electronics alone expose the same rendered light, so that a second network is
scored in minutes. What is rendered is kept: name another folder for other meshes or views, or after the simulator changed. Each scene
has a calibration of its own. Every number is over the pixels of objects, 4 mm above the table and more; in the rows ``wall`` over all,
in ``empty table`` over the table.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.cli.kit import progress
from tofcapture.devices.sim import hashed_generator, sensor
from tofcapture.devices.sim.config import Constants, read_constants
from tofcapture.devices.sim.light import Light, light_at_pixels
from tofcapture.devices.sim.scene import Caster, merge
from tofcapture.devices.sim.scenes import TABLE_CENTRE, generator, solid
from tofcapture.devices.sim.sensor import expose
from tofcapture.devices.sim.transport import Lamp, Transport
from tofcapture.devices.sim.world import SimWorld
from tofcapture.devices.station import read_station
from tofcapture.errors import DataError
from tofcapture.files.manifest import manifest_path
from tofcapture.files.seal import replacing, sha256_of, write_text
from tofcapture.files.shard import ShardReader
from tofcapture.frames import StereoFrame, TofInfo
from tofcapture.meshes import cuboid
from tofcapture.ops import phase
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64, look_at, transform_points
from tofcapture.suites import capture
from tofcapture.suites.capture import layered
from tofcapture.suites.make import DatasetSpec, make_one, paths
from tofcapture.suites.run import simulate_dataset
from tofcapture.suites.scene import Poses, Recipe, Scene
from tofcapture.suites.tabletop import table_meshes
from tofcapture_model.data import batched, make_frame, make_target
from tofcapture_model.data.raw_input import from_arrays
from tofcapture_model.evaluation.objects import Support, Tally, classes, tally
from tofcapture_model.frame import Target
from tofcapture_model.geometry.maps import intrinsics_of
from tofcapture_model.inference.predict import Predictor
from tofcapture_model.networks import baselines
from tofcapture_model.networks.baselines import sensor_estimate
from tofcapture_model.networks.checkpoint import find_model

Sim = Mapping[str, Mapping[str, Any]]
Raw = NDArray[Any]
SEED, CAMERA_SEED, CALIBRATION_SEED = 990_001, 770_001, 880_001  # far from those of any data
CAMERAS = 12
KINDS = (
    "mesh", "object", "concave", "mesh", "combination", "mesh", "dark", "mesh", "bright", "mesh", "corner", "object",
)  # fmt: skip
PI = np.pi
PAPER_HZ = (20e6, 100e6)
_QUARTERS, _THIRDS = (0.0, PI / 2, PI, 3 * PI / 2), (0.0, 2 * PI / 3, 4 * PI / 3)


def _tof(width: int = 240, height: int = 180, degrees: float = 0.0, *lens: float) -> dict[str, Any]:
    """Make a ``[tof]`` of another size or field of view than the default's, in the middle of the image."""
    focal = float(width / 2 / np.tan(np.radians(degrees) / 2)) if degrees else 195.0 * width / 240
    centre = {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
    return {"width": width, "height": height, "fx": focal, "fy": focal, "distortion": list(lens), **centre}


def _channels(*mhz: float, phases: Sequence[float] = _QUARTERS) -> Sim:
    """Make the ``[sensor]`` of a camera of other frequencies: contrast falls with them, wiggling with their period."""
    ascending = sorted(mhz)
    errors = [
        {
            "modulation_hz": f * 1e6,
            "offset": 0.01 * (-1) ** i,
            "harmonics": [[4, 0.018 * 20 / f, 0.010 * 20 / f]],
            "per_pixel_radius": 1.54e-4,
            "per_kelvin": -1.8e-4,
            "reference_celsius": 45.0,
        }
        for i, f in enumerate(ascending)
    ]
    return {
        "sensor": {
            "modulation_hz": [f * 1e6 for f in mhz for _ in phases],
            "phase_rad": [*phases] * len(mhz),
            "contrast": [max(0.35, 0.85 - 0.25 * (f - 20) / 80) for f in ascending],
            "range_error": errors,
        }
    }


@dataclass(frozen=True)
class Stand:
    """A dataset: what the camera's optics are, and what it looks at (``table``, ``far``, ``wall`` or ``empty``)."""

    sim: Sim = field(default_factory=dict)
    scene: str = "table"


@dataclass(frozen=True)
class Row:
    """One shift: the stand and the light that its views are taken in, the electronics, and what happens to taps or calibration."""

    stand: str = "base"
    light: str = ""  #: Of :data:`LIGHTS`.
    sim: Sim = field(default_factory=dict)
    spoil: Callable[[Raw, TofInfo, np.random.Generator], NDArray[np.bool_]] | None = None
    plain: bool = False  #: Handed over as an array without a rig.
    pixels: str = "object"  #: Or ``support``, or ``good``: all with ground truth.


_WIDE = {"half_angle": 1.0}
STANDS: dict[str, Stand] = {
    "base": Stand(),
    "160x120": Stand({"tof": _tof(160, 120)}),
    "640x480": Stand({"tof": _tof(640, 480)}),
    "fov40": Stand({"tof": _tof(240, 180, 40)}),
    "fov95": Stand({"tof": _tof(240, 180, 95), "lamp": _WIDE}),
    # with k1 alone an image so wide would fold at its corners
    "k1-": Stand({"tof": _tof(240, 180, 0, -0.3, 0.1, 0.0, 0.0, 0.0), "lamp": _WIDE}),
    "k1+": Stand({"tof": _tof(240, 180, 0, 0.3, 0.0, 0.0, 0.0, 0.0), "lamp": _WIDE}),
    "far": Stand(scene="far"),
    "wall": Stand(scene="wall"),
    "empty": Stand(scene="empty"),
}
LIGHTS: dict[str, Sim] = {"lamp": {"tof": {"illuminator": [0.06, 0.0, 0.0]}}, "black": {}, "white": {}}
"""Light of stand ``base`` besides its own: a lamp elsewhere, and surroundings of another albedo."""
TINTS = {"black": 0.05, "white": 0.9}


def _dark(raw: Raw, _info: TofInfo, _rng: np.random.Generator) -> NDArray[np.bool_]:
    return np.ones(raw.shape[1:], dtype=bool)


def _saturated(raw: Raw, info: TofInfo, _rng: np.random.Generator) -> NDArray[np.bool_]:
    return np.asarray(info.saturated(raw).any(axis=0))


def _stuck(raw: Raw, info: TofInfo, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Have one tap of each 50th pixel say the same whatever comes."""
    hit = rng.random(raw.shape[1:]) < 0.02
    rows, cols = np.nonzero(hit)
    raw[rng.integers(0, len(raw), len(rows)), rows, cols] = rng.integers(0, int(info.saturation), len(rows))
    return hit


def _dead(raw: Raw, _info: TofInfo, rng: np.random.Generator) -> NDArray[np.bool_]:
    hit = rng.random(raw.shape[1:]) < 0.02
    raw[:, hit] = 0
    return hit


def _sensor(**values: Any) -> Sim:
    return {"sensor": values}


ROWS: dict[str, Row] = {
    "as trained": Row(),
    "contrast ratio -10 %": Row(sim=_sensor(contrast=[0.85, 0.54])),
    "contrast ratio +10 %": Row(sim=_sensor(contrast=[0.85, 0.66])),
    "brightness x 0.25": Row(sim=_sensor(signal=[70.0])),
    "brightness x 4": Row(sim=_sensor(signal=[1120.0])),
    "50/100 MHz": Row(sim=_channels(50, 100)),
    "60/80 MHz": Row(sim=_channels(60, 80)),
    "40/70 MHz": Row(sim=_channels(40, 70)),
    "198/189/54 MHz": Row(sim=_channels(198, 189, 54, phases=_THIRDS)),
    "60 MHz alone": Row(sim=_channels(60)),
    "160 x 120": Row("160x120"),
    "640 x 480": Row("640x480"),
    "view of 40 deg": Row("fov40"),
    "view of 95 deg": Row("fov95"),
    "lens k1 = -0.3": Row("k1-"),
    "lens k1 = +0.3": Row("k1+"),
    "lamp 60 mm off": Row(light="lamp", sim=LIGHTS["lamp"]),
    "square waves, uncalibrated": Row(sim=_sensor(harmonics=[[3, 1 / 9], [5, 1 / 25]])),
    "no rig": Row(plain=True),
    "ambient x 10": Row(sim=_sensor(ambient=200.0)),
    "2.5 m away": Row("far"),
    "wall": Row("wall", pixels="good"),
    "bright wall": Row("wall", sim=_sensor(signal=[560.0]), pixels="good"),
    "empty table": Row("empty", pixels="support"),
    "black room": Row(light="black"),
    "white room": Row(light="white"),
}
PIXELS: dict[str, Row] = {
    "saturated pixels": Row(sim=_sensor(signal=[5600.0]), spoil=_saturated, pixels="good"),
    "dark pixels": Row(sim=_sensor(signal=[5.6]), spoil=_dark),
    "stuck pixels": Row(spoil=_stuck, pixels="good"),
    "dead pixels": Row(spoil=_dead, pixels="good"),
}
"""Rows of single pixels that measure badly: within one sigma, or marked as not measured."""
HZ = sorted(
    {
        f
        for row in {**ROWS, **PIXELS}.values()
        for f in row.sim.get("sensor", {}).get("modulation_hz", PAPER_HZ)
    }
)


@dataclass(frozen=True)
class ShiftSpec(DatasetSpec):
    """A dataset of the same scenes as the others, seen as a stand says."""

    stand: str = "base"

    def recipe(self) -> Recipe:
        """Load the recipe; far views keep ground truth."""
        recipe = super().recipe()
        return (
            replace(recipe, table={**recipe.table, "build": {"far": 4.0}}) if self.stand == "far" else recipe
        )

    def scene(self, index: int) -> Scene:
        """Make scene ``index`` as the stand wants it."""
        scene, what = super().scene(index), STANDS[self.stand].scene
        things = [o for o in scene.objects if o.target]
        others = [o for o in scene.objects if not o.target]
        if what == "empty":
            bare = tuple(o for o in others if o.name != "sheet")
            return replace(scene, objects=bare, identities=(scene.name,))
        if what == "far":
            table = next(o for o in others if o.name == "table")
            ground = solid(
                "ground", cuboid(8, 8, 0.1), table.albedo, [*TABLE_CENTRE[:2], TABLE_CENTRE[2] - 0.1]
            )
            return replace(scene, objects=(*things, ground), poses=_from_afar(2.5))
        if what == "wall":
            albedo = float(generator(scene.name, self.seed, "shift wall").uniform(0.3, 0.9))
            slab = solid("wall", cuboid(0.1, 6, 6), albedo, [2.0, 0, -3.0], target=True)
            return replace(scene, objects=(slab,), identities=(scene.name,), poses=_before_wall)
        return scene


def _from_afar(distance: float) -> Poses:
    def choose(_caster: Caster, rng: np.random.Generator, views: int) -> list[Float64]:
        out = []
        for _ in range(views):
            up, around = rng.uniform(np.radians(35), np.radians(75)), rng.uniform(-PI, PI)
            away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
            out.append(look_at(TABLE_CENTRE + distance * away, TABLE_CENTRE, roll=rng.uniform(-PI, PI)))
        return out

    return choose


def _before_wall(_caster: Caster, rng: np.random.Generator, views: int) -> list[Float64]:
    return [
        look_at(np.array([2.0 - rng.uniform(0.5, 1.4), 0, 0]), np.array([2.0, *rng.uniform(-0.3, 0.3, 2)]))
        for _ in range(views)
    ]


class _World(SimWorld):
    """Keeps the light of every view, at all frequencies that rows ask for; what two stands have in common is made once a scene."""

    keep: Path  # of light
    stand = "base"
    common: dict[Any, Any] = {}  # noqa: RUF012  of one scene
    taken = 0  # views of it

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        key = (STANDS[self.stand].scene, key)
        if key not in self.common:
            self.common[key] = make()
        return self.common[key]

    def _hz(self, variant: str = "") -> tuple[float, ...]:
        return tuple(HZ) if self.stand == "base" and variant not in TINTS else PAPER_HZ

    def caster(self) -> tuple[Caster, Transport | None]:
        """Return the scene, ready for rays, and the light between its surfaces."""
        return self._tinted("")

    def _tinted(self, variant: str) -> tuple[Caster, Transport]:
        tint, hz, render = TINTS.get(variant), self._hz(variant), self.constants.render

        def make() -> tuple[Caster, Transport]:
            things = self._scenes(self._scene, self.seed)
            if tint is not None:
                things = [o if o.target else replace(o, albedo=tint) for o in things]
            caster = Caster(merge(things))
            return caster, Transport(caster, hz, render.patches, render.patch_rays)

        found: tuple[Caster, Transport] = self._once((tint, hz), make)
        return found

    def light(self) -> Light:
        """Compute what reaches the pixels of every variant, and keep it."""
        T_base_flange, key = self._here()
        name = (self._scene, key, T_base_flange.tobytes())
        if self._lit is None or self._lit[0] != name:
            T = T_base_flange @ self.true_rig.T_flange_tof
            found = {v: self._rendered(T, v) for v in ("", *(LIGHTS if self.stand == "base" else ()))}
            type(self).taken += 1
            self._lit = (name, at_frequencies(found[""], self._hz(), self.constants))
        return self._lit[1]

    def _rendered(self, T: Float64, variant: str) -> Light:
        c, hz, (caster, transport) = self.constants, self._hz(variant), self._tinted(variant)
        place = LIGHTS.get(variant, {}).get("tof", {}).get("illuminator", c.illuminator)
        lamp = Lamp(transform_points(T, np.asarray(place)), T[:3, 2], **c.lamp)
        light = light_at_pixels(caster, c.tof, T, lamp, hz, transport, c.render.subpixels, c.render.rays)
        path = light_path(self.keep, self._scene, self.taken, variant)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partly, partly.open("wb") as file:
            np.savez(file, phasor=light.phasor.astype(np.complex64), steady=light.steady, hz=hz)
        return light

    def stereo(self, clock: Callable[[], int]) -> StereoFrame:
        """Take the point map, once a pose."""
        frame: StereoFrame = self._once(("stereo", self._here()[1]), partial(super().stereo, clock))
        return frame


def light_path(dataset: Path, scene: str, view: int, variant: str) -> Path:
    """Name the file that keeps the light of a view."""
    return dataset / "light" / f"{scene}-{view}{variant and '-'}{variant}.npz"


def at_frequencies(light: Light, hz: Sequence[float], constants: Constants) -> Light:
    """Take the frequencies that a camera has."""
    return Light(
        light.phasor[[list(hz).index(f) for f in frequencies(constants.sensor.modulation_hz)]], light.steady
    )


def station_sim() -> Sim:
    """Overrides of the constants by the embedded station, which every simulated dataset begins with."""
    return {k: v for k, v in read_station(None)["sim"].items() if isinstance(v, Mapping)}


def render(args: argparse.Namespace) -> None:
    """Simulate every dataset that is not there, scene by scene."""
    meshes = table_meshes(args.meshes, "mm", SEED)[0] if args.meshes else ()
    same: dict[str, Any] = {
        "suite": "tof100",
        "views": args.views,
        "frames": 1,
        "meshes": meshes,
        "kinds": KINDS,
    }
    wanted = {row.stand for row in chosen(args).values()}
    specs = {
        name: ShiftSpec(seed=SEED, scenes=args.scenes, sim=stand.sim, stand=name, **same)
        for name, stand in STANDS.items()
        if name in wanted
    }
    own = capture.SimWorld, capture.plan_views
    capture.SimWorld, capture.plan_views = _World, _plan_once(capture.plan_views)  # type: ignore[misc]
    try:
        with progress() as report:
            for index in range(args.scenes):
                _World.common.clear()
                for k, (name, spec) in enumerate(specs.items()):
                    report("scenes", index * len(specs) + k, args.scenes * len(specs), name)
                    _make(spec, args.folder / name, index)
    finally:
        capture.SimWorld, capture.plan_views = own  # type: ignore[misc]
    if args.cameras:
        drawn = DatasetSpec(seed=CAMERA_SEED, scenes=max(args.scenes, CAMERAS), cameras=CAMERAS, **same)
        with progress() as report:
            for index in range(drawn.scenes):
                report("cameras", index, drawn.scenes)
                if not _there(drawn, args.folder / "cameras", index):
                    make_one(drawn, args.folder / "cameras", index)
        if not manifest_path(args.folder / "cameras").is_file():  # for `tofcapture evaluate`
            simulate_dataset(drawn, args.folder / "cameras", 1, split="test")


def _there(spec: DatasetSpec, out: Path, index: int) -> bool:
    return paths(out, spec.scene(index).name)[2].is_file()


def _make(spec: ShiftSpec, out: Path, index: int) -> None:
    if not _there(spec, out, index):
        _World.keep, _World.stand, _World.taken = out, spec.stand, 0
        shutil.rmtree(
            out / "simulation" / f"{spec.scene(index).name}.work", ignore_errors=True
        )  # light in order
        make_one(spec, out, index)


def _plan_once(plan: Callable[..., Any]) -> Callable[..., Any]:
    """Look from the same places whatever the optics, in the order of the views' numbers: light is kept by them."""

    def planned(*given: Any) -> Any:
        if "plan" not in _World.common:
            found = plan(*given)
            _World.common["plan"] = replace(found, views=tuple(sorted(found.views, key=lambda v: v.index)))
        return _World.common["plan"]

    return planned


def exposed(folder: Path, row: Row, scene: str, view: int, number: int) -> tuple[Raw, TofInfo]:
    """Expose the light of a view by a row's electronics: taps (K, H, W), and what the camera says of itself."""
    constants = read_constants(layered(station_sim(), STANDS[row.stand].sim, row.sim), "shift")
    info = SimWorld(constants, CALIBRATION_SEED + number, lambda _name, _seed: ()).tof_info
    with np.load(light_path(folder / row.stand, scene, view, row.light)) as kept:
        light = at_frequencies(Light(kept["phasor"].astype(complex), kept["steady"]), kept["hz"], constants)
    rng = hashed_generator(f"shift|{scene}|{view}".encode())
    return expose(light, constants.sensor, info, 1, rng, CALIBRATION_SEED + number)[0][0], info


def chosen(args: argparse.Namespace) -> dict[str, Row]:
    """Rows that are wanted."""
    rows = {**ROWS, **PIXELS}
    unknown = set(args.only) - {*rows, "cameras"}
    if unknown:
        raise SystemExit(f"--only: no row {', '.join(sorted(unknown))}; rows: cameras, {', '.join(rows)}")
    return {name: row for name, row in rows.items() if not args.only or name in args.only}


Measured = dict[str, Any]
"""``scene``, ``view``, ``camera``, tallies of ``sensor`` and ``network``, ``unmeasured``: pixels that the network says were not measured."""


def sensors(raw: Raw, info: TofInfo, row: Row) -> tuple[torch.Tensor, torch.Tensor]:
    """Answer as the sensor does: depth and normals."""
    camera = info.camera
    if row.plain:
        data = from_arrays({"raw": raw}, Path("array"), frame=0)
        info, camera = data.info, data.camera
    depth, normals, _ = sensor_estimate(batched(make_frame(raw.astype(float), info, camera)))
    return depth, normals


def measure(
    predictor: Predictor,
    shard: ShardReader,
    view: int,
    raw: Raw,
    info: TofInfo,
    row: Row,
    known: dict[str, Any],
) -> Measured:
    """Answer one view, by the sensor, unless ``known`` has what that leads to, and by the network."""
    bad = (
        row.spoil(raw, info, hashed_generator(f"spoil|{shard.scene}|{view}".encode())) if row.spoil else None
    )
    found = predictor(raw) if row.plain else predictor(raw, info)
    gt, T = shard.ground_truth(view, 2), shard.T_base_tof(view)
    target = Target(*(x[None] for x in make_target(gt.depth, gt.normals, gt.mask)))
    plane = Support(torch.from_numpy(T[2, :3].copy()), float(TABLE_CENTRE[2] - T[2, 3]), 0.0)
    mask = {**classes(target, intrinsics_of(info.camera)[None], plane), "good": target.good}[row.pixels]
    if bad is not None:
        mask = mask & torch.from_numpy(bad.repeat(2, 0).repeat(2, 1))[None, None]
    key = f"{shard.scene}|{view}"
    if key not in known:
        known[key] = asdict(tally(*sensors(raw, info, row), None, target, mask))

    def image(x: NDArray[Any]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(x)).float()[None]

    error = None if found.error is None else image(found.error)[None]
    ours = image(found.depth)[None], image(found.normals.transpose(2, 0, 1)), error
    measured = torch.from_numpy(found.measured)[None, None]
    return {
        "scene": shard.scene,
        "view": view,
        "camera": info.serial,
        "sensor": known[key],
        "network": asdict(tally(*ours, target, mask)),
        "trusted": asdict(tally(*ours, target, mask & measured)),
        "farthest": float(np.nanmax(found.depth)),
    }


def score(args: argparse.Namespace) -> dict[str, list[Measured]]:
    """Measure every row on every view; what the sensor makes of them is kept for the next network."""
    predictor, out = Predictor(args.weights), {}
    rows = chosen(args) | ({"cameras": Row("cameras")} if args.cameras else {})
    with progress() as report, torch.inference_mode():
        for k, (name, row) in enumerate(rows.items()):
            report("rows", k, len(rows), name)
            kept = args.folder / "sensor" / f"{_digest(row)}.json"
            known: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8")) if kept.is_file() else {}
            out[name] = []
            for path in sorted((args.folder / row.stand / "shards").glob("*.h5")):
                with ShardReader(path) as shard:
                    number = zlib.crc32(shard.scene.encode()) % 1000  # of its calibration
                    for view in range(min(shard.views, args.views)):
                        if name == "cameras":
                            raw, info = shard.raw(view, 0), replace(shard.info, camera=shard.camera)
                        else:
                            raw, info = exposed(args.folder, row, shard.scene, view, number)
                        try:
                            out[name].append(measure(predictor, shard, view, raw, info, row, known))
                        except DataError as err:  # nothing measures there, as `predict` would say
                            print(f"{name}, {shard.scene}, view {view}: refused: {err.message}")
            kept.parent.mkdir(exist_ok=True)
            write_text(kept, json.dumps(known))
    return {name: found for name, found in out.items() if any(r["network"]["pixels"] for r in found)}


def _digest(row: Row) -> str:
    """Digest what the sensor's answer depends on besides the light: the row, the electronics and the decoder."""
    told = repr(replace(row, spoil=None)) + getattr(row.spoil, "__name__", "")
    sources = [Path(str(sensor.__file__)), Path(str(baselines.__file__))]
    sources += sorted(Path(str(phase.__file__)).parent.glob("*.py"))
    code = [path.read_bytes() for path in sources]
    return hashlib.sha256(b"".join([told.encode(), *code])).hexdigest()[:16]


def _pooled(rows: Sequence[Measured], who: str) -> Tally:
    return sum((Tally(**r[who]) for r in rows), Tally())


def ratios(rows: Sequence[Measured]) -> dict[str, float]:
    """What a network leaves of the sensor's errors, pooled over pixels, and the share within one sigma."""
    theirs, ours = _pooled(rows, "sensor").row(), _pooled(rows, "network").row()
    named = {k: ours[k] / theirs[k] for k in ("mae", "rmse", "angle")}
    return {
        **named,
        "sensor_mm": 1e3 * theirs["mae"],
        "network_mm": 1e3 * ours["mae"],
        "within": ours.get("within_sigma", np.nan),
    }


def grouped(rows: Sequence[Measured], key: str) -> dict[Any, list[Measured]]:
    """Rows by camera or scene; groups without a pixel are left out."""
    out: dict[Any, list[Measured]] = {}
    for r in rows:
        if r["network"]["pixels"]:
            out.setdefault((r["scene"], r["view"]) if key == "view" else r[key], []).append(r)
    return out


_HEAD = f"{'shift':28} {'sensor':>8} {'network':>8} {'MAE':>6} {'RMSE':>6} {'normals':>8} {'by view':>8} {'worst':>6} {'1 sigma':>8}"


def line(name: str, rows: Sequence[Measured]) -> str:
    """One row: errors in mm, their ratios over pixels, median and worst ratio of a view, share within one sigma."""
    r = ratios(rows)
    each = [ratios(group)["mae"] for group in grouped(rows, "view").values()]
    return (
        f"{name:28} {r['sensor_mm']:8.2f} {r['network_mm']:8.2f} {r['mae']:6.2f} {r['rmse']:6.2f} {r['angle']:8.2f}"
        f" {np.median(each):8.2f} {max(each):6.2f} {100 * r['within']:7.1f}%"
    )


def table(found: Mapping[str, Sequence[Measured]]) -> str:
    """Every row, the worst ratio of the MAE first; drawn cameras; bad pixels."""
    shifts = sorted((n for n in found if n in ROWS), key=lambda n: -ratios(found[n])["mae"])
    out = ["mm on object pixels; network over sensor", _HEAD, *(line(name, found[name]) for name in shifts)]
    if "cameras" in found:
        by = grouped(found["cameras"], "camera")
        worst = sorted(by, key=lambda c: -ratios(by[c])["mae"])
        out += [
            "",
            _HEAD.replace("shift ", "camera", 1),
            *(line(str(c), by[c]) for c in worst),
            line("all cameras", found["cameras"]),
        ]
        for key in ("view", "scene"):
            out.append(_spread(key, [ratios(g) for g in grouped(found["cameras"], key).values()]))
    for name in (n for n in found if n in PIXELS):
        everything, trusted = _pooled(found[name], "network"), _pooled(found[name], "trusted")
        cover = trusted.row().get("within_sigma", float("nan"))
        marked = 1 - trusted.pixels / max(everything.wanted, 1)
        out.append(
            f"{name:28} {everything.wanted:8.0f} pixels, error {1e3 * everything.row()['mae']:7.2f} mm, "
            f"marked as not measured {marked:6.1%}, of the others within one sigma {cover:6.1%}"
        )
    farthest = max(r["farthest"] for rows in found.values() for r in rows)
    return "\n".join([*out, f"farthest depth of any answer: {farthest:.1f} m"])


def _spread(key: str, each: Sequence[Mapping[str, float]]) -> str:
    said = []
    for name in ("mae", "rmse", "angle"):
        values = [r[name] for r in each]
        said.append(
            f"{name} median {np.median(values):.2f}, 90 % {np.quantile(values, 0.9):.2f}, worst {max(values):.2f}"
        )
    return f"ratios by {'object' if key == 'scene' else key} ({len(each)}): {'; '.join(said)}"


def main() -> None:
    """Render what is missing, score a network, print and keep the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("folder", type=Path, help="of the datasets and scores; completed")
    add("--weights", type=Path, help="checkpoint or run (default: bundled)")
    add("--scenes", type=int, default=24)
    add("--views", type=int, default=2)
    add(
        "--meshes",
        type=Path,
        help="meshes, in mm, that the network has not seen (default: procedural objects alone)",
    )
    add(
        "--only",
        nargs="+",
        default=[],
        metavar="ROW",
        help="these rows; the drawn cameras are called cameras",
    )
    add("--score-only", action="store_true", help="what is rendered already")
    add("--threads", type=int, default=0, help="of PyTorch (default: as many as it takes)")
    args = parser.parse_args()
    args.cameras = not args.only or "cameras" in args.only
    if args.threads:
        torch.set_num_threads(args.threads)
    begun = time.monotonic()
    if not args.score_only:
        render(args)
    rendered = time.monotonic()
    found = score(args)
    digest = sha256_of(find_model(args.weights))[:12]
    write_text(args.folder / f"scores-{digest}.json", json.dumps(found))
    print(table(found))
    print(
        f"rendered in {rendered - begun:.0f} s, scored in {time.monotonic() - rendered:.0f} s, weights {digest}"
    )


if __name__ == "__main__":
    main()
