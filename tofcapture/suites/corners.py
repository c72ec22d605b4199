"""Make the multipath suite: concave corners whose angle and albedo are known, free in space before a dark wall."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from tofcapture.devices.sim.scene import Caster, SceneObject
from tofcapture.devices.sim.scenes import generator, solid
from tofcapture.devices.sim.shapes import ball
from tofcapture.meshes import Mesh, cuboid, shift
from tofcapture.poses import Float64, look_at, transform
from tofcapture.suites.scene import Poses, Recipe, Scene

_THICK = 0.006  # m


def make(recipe: Recipe, index: int, seed: int) -> Scene:
    """Make a scene of the multipath suite; see ``recipes/multipath.toml``."""
    table = recipe.table
    grid = list(product(table["shapes"], table["angles"], table["albedos"]))
    grid = [(shape, angle if shape != "box" else 90, albedo) for shape, angle, albedo in grid]
    grid = list(dict.fromkeys(grid))
    turn = np.random.default_rng(seed).permutation(len(grid))
    shape, angle, albedo = grid[int(turn[index % len(grid)])]
    name = f"m{index:03d}-{shape}{angle}-a{round(100 * albedo)}"
    rng = generator(name, seed, "suite corner")
    size = float(rng.uniform(*table["size"]))
    wall = solid("backdrop", cuboid(0.1, 6.0, 6.0), 0.03, [-2.5, 0.0, -3.0])  # too far to send light back
    objects = [*_planes(shape, float(np.radians(angle)), albedo, size), wall]
    return Scene(
        name=name,
        objects=tuple(objects),
        identities=(name,),
        poses=_poses(float(np.radians(angle)), size, table["distances"]),
        plan_name=name,
        facts={"kind": shape, "angle_deg": angle, "albedo": albedo, "size": round(size, 4)},
    )


def _planes(shape: str, angle: float, albedo: float, size: float) -> list[SceneObject]:
    """Stand two planes about the x axis; a floor for a corner; lid and sphere besides for a box."""

    def place(name: str, mesh: Mesh, T: Float64) -> SceneObject:
        return SceneObject(*mesh, albedo, T, target=True, name=name)

    out = []
    for side in (
        -1,
        1,
    ):  # upright, from the crease (the z axis) outwards, with the inner face on half the angle
        slab = shift(cuboid(size, _THICK, size), size / 2, side * _THICK / 2)
        c, s = np.cos(side * angle / 2), np.sin(side * angle / 2)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        out.append(place("plane", slab, transform(turn, [0, 0, 0])))
    floor = cuboid(2 * size, 2 * size, _THICK)
    if shape in {"corner", "box"}:
        out.append(place("floor", floor, transform(np.eye(3), [0, 0, -_THICK])))
    if shape == "box":
        out.append(place("lid", floor, transform(np.eye(3), [0, 0, size])))
        out.append(place("sphere", ball(0.14 * size), transform(np.eye(3), [0.5 * size, 0.05 * size, 0.0])))
    return out


def _poses(angle: float, size: float, distances: Sequence[float]) -> Poses:
    """Look into the opening from all sides of it, and from above the floor."""

    def choose(caster: Caster, rng: np.random.Generator, views: int) -> list[Float64]:
        del caster
        out = []
        for _ in range(views):
            azimuth = rng.uniform(-0.32, 0.32) * angle
            elevation = rng.uniform(np.radians(2), np.radians(24))
            distance = rng.uniform(distances[0], distances[1])
            aim = np.array([rng.uniform(0.0, 0.3) * size, rng.uniform(-0.1, 0.1) * size, 0.4 * size])
            level = np.cos(elevation)
            away = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
            out.append(look_at(aim + distance * away, aim, roll=rng.uniform(-np.pi, np.pi)))
        return out

    return choose
