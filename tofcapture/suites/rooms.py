"""Make the indoor suite: office, corridor and lab of boxes and cylinders, seen at 1 to 4 m from anywhere in the room.

World frame: z up, floor at z = 0, the room's centre at x = y = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices.sim.scene import Caster, SceneObject, unit_rays
from tofcapture.devices.sim.scenes import generator
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.errors import ConfigError
from tofcapture.meshes import Mesh, cuboid, cylinder, join, shift
from tofcapture.poses import Float64, look_at, rotation_exp, transform
from tofcapture.suites.scene import Poses, Recipe, Scene

_WALL, _HEIGHT = 0.1, 2.6  # m
_SMALL = ("bottle", "bowl", "box", "cone", "cup", "gear", "lathe", "mug", "stack", "wedge")
_PROBE = Camera(24, 18, 19.06186, 20.07526, 11.68406, 10.14767)  # the ToF camera's view, coarsely
_TRIES = 300
_SHELL = 6  # the first objects of a room: floor, ceiling, four walls
_BODY = 0.25  # m; nothing comes nearer to the camera


@dataclass
class Room:
    """A room being furnished: inner width and depth (2,), metres, what stands in it, and families used, for the provenance."""

    size: Float64
    rng: np.random.Generator
    objects: list[SceneObject] = field(default_factory=list)
    things: list[str] = field(default_factory=list)

    def put(
        self, name: str, mesh: Mesh, at: Sequence[float], turn: float = 0.0, albedo: float | None = None
    ) -> None:
        """Stand a mesh at a point, turned about the vertical; the albedo is drawn when not given."""
        value = float(self.rng.uniform(0.2, 0.8)) if albedo is None else albedo
        T = transform(rotation_exp([0, 0, turn]), np.asarray(at, dtype=np.float64))
        self.objects.append(SceneObject(mesh[0], mesh[1], value, T, target=True, name=name))

    def uniform(self, low: float, high: float) -> float:
        """Draw a number."""
        return float(self.rng.uniform(low, high))

    def on(self, at: Sequence[float], spread: Sequence[float], count: int) -> None:
        """Put procedural objects on a surface about a point."""
        for _ in range(count):
            family = _SMALL[int(self.rng.integers(len(_SMALL)))]
            dx, dy = (self.uniform(-s, s) for s in spread)
            mesh, place = FAMILIES[family](self.rng), [at[0] + dx, at[1] + dy, at[2]]
            self.put(family, mesh, place, self.uniform(-np.pi, np.pi))
            self.things.append(family)


def make(recipe: Recipe, index: int, seed: int) -> Scene:
    """Make a scene of the indoor suite; see ``recipes/indoor.toml``."""
    pattern: list[str] = recipe.table["pattern"]
    kind = pattern[index % len(pattern)]
    name = f"r{index:03d}-{kind}"
    room = _KINDS[kind](generator(name, seed, "suite room"))
    return Scene(
        name=name,
        objects=tuple(room.objects),
        identities=(name,),
        poses=_poses(room.size, recipe.table),
        plan_name=name,
        facts={"kind": kind, "size": np.round(room.size, 3).tolist(), "things": room.things},
    )


def _shell(size: Float64, rng: np.random.Generator) -> Room:
    """Build floor, ceiling and four walls."""
    room = Room(size, rng)
    (w, d), t = size, _WALL
    room.put("floor", cuboid(w + 2 * t, d + 2 * t, t), [0, 0, -t], albedo=room.uniform(0.15, 0.5))
    room.put("ceiling", cuboid(w + 2 * t, d + 2 * t, t), [0, 0, _HEIGHT], albedo=room.uniform(0.6, 0.85))
    walls = room.uniform(0.4, 0.8)
    for side in (-1, 1):
        room.put("wall", cuboid(t, d, _HEIGHT), [side * (w + t) / 2, 0, 0], albedo=walls)
        room.put("wall", cuboid(w, t, _HEIGHT), [0, side * (d + t) / 2, 0], albedo=walls)
    return room


def table_mesh(w: float, d: float, h: float, leg: float = 0.05) -> Mesh:
    """Build a top and four legs."""
    x, y = w / 2 - leg, d / 2 - leg
    legs = [shift(cuboid(leg, leg, h - 0.03), sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1)]
    return join(shift(cuboid(w, d, 0.03), z=h - 0.03), *legs)


def chair_mesh() -> Mesh:
    """Build seat, back, four legs."""
    return join(table_mesh(0.44, 0.44, 0.46, 0.035), shift(cuboid(0.04, 0.40, 0.40), x=0.2, z=0.5))


def shelf_mesh(w: float, d: float, h: float, boards: int) -> Mesh:
    """Build two sides, a back, and boards; open to -y."""
    sides = [shift(cuboid(0.02, d, h), s * (w / 2 - 0.01)) for s in (-1, 1)]
    levels = [shift(cuboid(w - 0.04, d, 0.02), z=z) for z in np.linspace(0.05, h - 0.02, boards)]
    return join(*sides, shift(cuboid(w, 0.01, h), y=d / 2 - 0.005), *levels)


def _shelf(room: Room, x: float, y: float, turn: float) -> None:
    """Put up a shelf with things on two of its boards."""
    h = room.uniform(1.4, 2.1)
    room.put("shelf", shelf_mesh(0.9, 0.32, h, 5), [x, y, 0], turn)
    for level in room.rng.choice(4, 2, replace=False):
        z = float(np.linspace(0.05, h - 0.02, 5)[level]) + 0.02
        room.on([x, y, z], [0.1, 0.02], 1)


def _desk(room: Room, x: float, y: float) -> None:
    """Put up a desk with a screen, things on it, and a chair."""
    w, d = room.uniform(1.2, 1.6), room.uniform(0.6, 0.8)
    room.put("desk", table_mesh(w, d, 0.73), [x, y, 0])
    screen = join(shift(cuboid(0.55, 0.03, 0.33), z=0.10), cuboid(0.22, 0.18, 0.02), cuboid(0.05, 0.04, 0.2))
    aside = room.uniform(-0.3, 0.3)
    room.put("screen", screen, [x + aside, y + 0.15, 0.73], room.uniform(-0.4, 0.4), albedo=0.12)
    room.on([x, y - 0.12, 0.73], [w / 2 - 0.15, 0.1], int(room.rng.integers(2, 5)))
    place = [x + room.uniform(-0.3, 0.3), y - d / 2 - room.uniform(0.2, 0.5), 0]
    room.put("chair", chair_mesh(), place, room.uniform(-np.pi, np.pi))


def office(rng: np.random.Generator) -> Room:
    """Furnish with desks, shelves, a cupboard, a bin, boxes."""
    room = _shell(rng.uniform([3.4, 3.4], [4.8, 4.8]), rng)
    w, d = room.size
    _desk(room, room.uniform(-0.3, 0.3) * w, d / 2 - 0.5)
    if rng.random() < 0.7:
        _desk(room, room.uniform(-0.25, 0.25) * w, -0.1)
    for side in (-1, 1):
        _shelf(room, side * (w / 2 - 0.2), room.uniform(-0.35, 0.1) * d, -side * np.pi / 2)
    cupboard = cuboid(0.8, 0.42, room.uniform(0.7, 1.9))
    room.put("cupboard", cupboard, [room.uniform(-0.3, 0.3) * w, -d / 2 + 0.25, 0])
    room.put("bin", cylinder(0.14, 0.34), [room.uniform(-0.4, 0.4) * w, room.uniform(-0.1, 0.3) * d, 0])
    _boxes(room, 2)
    return room


def corridor(rng: np.random.Generator) -> Room:
    """Furnish long and narrow: door frames, cabinets, a bench, a pipe."""
    room = _shell(rng.uniform([1.6, 4.0], [2.3, 5.0]), rng)
    w, d = room.size
    for wall in (-1, 1):
        for y in rng.uniform(-0.42, 0.42, 2) * d:
            posts = [shift(cuboid(0.06, 0.08, 2.05), y=s * 0.46) for s in (-1, 1)]
            frame = join(*posts, shift(cuboid(0.06, 1.0, 0.08), z=2.05))
            room.put("door frame", frame, [wall * (w / 2 - 0.03), float(y), 0])
    side = float(rng.choice([-1.0, 1.0]))
    cabinet = cuboid(0.35, 0.9, room.uniform(0.9, 1.8))
    room.put("cabinet", cabinet, [side * (w / 2 - 0.18), room.uniform(-0.3, 0.3) * d, 0])
    room.put("bench", table_mesh(0.36, 1.1, 0.45), [-side * (w / 2 - 0.2), room.uniform(-0.3, 0.3) * d, 0])
    room.put("pipe", cylinder(0.05, _HEIGHT), [side * (w / 2 - 0.08), -side * 0.4 * d, 0])
    room.put("extinguisher", cylinder(0.08, 0.5), [-side * (w / 2 - 0.12), 0.35 * d, 0.4])
    _boxes(room, 2)
    return room


def lab(rng: np.random.Generator) -> Room:
    """Furnish with benches along the walls with instruments, a column, stools, a gas bottle."""
    room = _shell(rng.uniform([3.2, 3.4], [4.6, 4.8]), rng)
    w, d = room.size
    for side in (-1, 1):
        x = side * (w / 2 - 0.4)
        room.put("bench", join(shift(cuboid(0.76, 2.2, 0.04), z=0.86), cuboid(0.6, 2.0, 0.86)), [x, 0, 0])
        for y in (-0.7, 0.1):
            size = rng.uniform([0.25, 0.25, 0.15], [0.45, 0.5, 0.45])
            place = [x, y + room.uniform(-0.1, 0.1), 0.9]
            room.put("instrument", cuboid(*size), place, room.uniform(-0.3, 0.3))
        room.on([x, 0.75, 0.9], [0.15, 0.15], 2)
    column = join(cylinder(0.12, 0.5), shift(cylinder(0.07, 0.6), z=0.5), shift(cuboid(0.7, 0.1, 0.1), z=1.0))
    room.put("column", column, [room.uniform(-0.3, 0.3), 0.25 * d, 0], room.uniform(-np.pi, np.pi))
    room.put("stool", join(cylinder(0.03, 0.6), shift(cylinder(0.17, 0.04), z=0.6), cylinder(0.2, 0.03)),
             [room.uniform(-0.5, 0.5), -0.2 * d, 0])  # fmt: skip
    room.put("gas bottle", cylinder(0.115, 1.3), [room.uniform(-0.3, 0.3) * w, d / 2 - 0.14, 0])
    _shelf(room, room.uniform(-0.2, 0.2) * w, -d / 2 + 0.2, np.pi)
    _boxes(room, 1)
    return room


def _boxes(room: Room, count: int) -> None:
    for _ in range(count):
        size = room.rng.uniform([0.25, 0.25, 0.2], [0.5, 0.45, 0.5])
        x, y = room.rng.uniform(-0.4, 0.4, 2) * room.size
        room.put("box", cuboid(*size), [float(x), float(y), 0], room.uniform(-np.pi, np.pi))


_KINDS: Mapping[str, Callable[[np.random.Generator], Room]] = {f.__name__: f for f in (office, corridor, lab)}


def _poses(size: Float64, table: Mapping[str, Any]) -> Poses:
    """Stand anywhere in the room, looking anywhere, where the distances seen suit the recipe."""

    def choose(caster: Caster, rng: np.random.Generator, views: int) -> list[Float64]:
        out: list[Float64] = []
        for _ in range(_TRIES * views):
            if len(out) == views:
                return out
            T = _guess(size, rng)
            if _suits(caster, T, table):
                out.append(T)
        if not out:
            raise ConfigError("no view of this room suits the recipe", hint="another --seed")
        return out

    return choose


def _guess(size: Float64, rng: np.random.Generator) -> Float64:
    eye = np.append(rng.uniform(-0.45, 0.45, 2) * size, rng.uniform(0.9, 1.9))
    turn, pitch = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(-50.0, 8.0))
    ahead = np.array([np.cos(pitch) * np.cos(turn), np.cos(pitch) * np.sin(turn), np.sin(pitch)])
    return look_at(eye, eye + ahead, roll=float(rng.normal(0.0, np.radians(8.0))))


def _suits(caster: Caster, T: Float64, table: Mapping[str, Any]) -> bool:
    """Tell whether nothing is at the camera's body, and distances and furniture in view are as the recipe wants them."""
    eye = T[:3, 3]
    if (caster.cast(eye, np.concatenate([np.eye(3), -np.eye(3)])).distance < _BODY).any():
        return False
    hits = caster.cast(eye, unit_rays(_PROBE, T))
    if not hits.found.all():
        return False
    if (caster.geometry.owner[hits.triangle] >= _SHELL).mean() < table["furniture"]:
        return False
    low, mid, high = np.percentile(hits.distance, [2, 50, 98])
    (near, far), (least, most) = table["distances"], table["median"]
    return bool(near < low and high < far and least < mid < most)
