"""The multipath suite: concave corners whose angle and albedo are known, free in space before a dark wall."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from tofcapture.devices.sim.scene import Caster, SceneObject
from tofcapture.devices.sim.scenes import generator
from tofcapture.devices.sim.shapes import ball
from tofcapture.meshes import Mesh, cuboid
from tofcapture.poses import Float64, look_at, transform
from tofcapture.suites.recipe import Poses, Recipe, Scene

_THICK = 0.006  # m


def make(recipe: Recipe, index: int, seed: int) -> Scene:
    """Scene of the multipath suite; see ``recipes/multipath.toml``."""
    table = recipe.table
    grid = list(product(table["shapes"], table["angles"], table["albedos"]))
    grid = [(shape, angle if shape != "box" else 90, albedo) for shape, angle, albedo in grid]
    grid = list(dict.fromkeys(grid))
    turn = np.random.default_rng(seed).permutation(len(grid))
    shape, angle, albedo = grid[int(turn[index % len(grid)])]
    name = f"m{index:03d}-{shape}{angle}-a{round(100 * albedo)}"
    rng = generator(name, seed, "suite corner")
    size = float(rng.uniform(*table["size"]))
    objects = [*_planes(shape, float(np.radians(angle)), albedo, size), _backdrop()]
    return Scene(
        name=name,
        objects=tuple(objects),
        identities=(name,),
        poses=_poses(float(np.radians(angle)), size, table["distances"]),
        plan_name=name,
        facts={"kind": shape, "angle_deg": angle, "albedo": albedo, "size": round(size, 4)},
    )


def _plane(name: str, mesh: Mesh, albedo: float, T: Float64) -> SceneObject:
    return SceneObject(mesh[0], mesh[1], albedo, T, target=True, name=name)


def _slab(turn: float, size: float) -> tuple[Mesh, Float64]:
    """Upright plane from the crease (the z axis) outwards at angle ``turn`` about it; its inner face lies on that angle."""
    mesh = cuboid(size, _THICK, size)
    out = 1.0 if turn > 0 else -1.0
    vertices = mesh[0] + np.array([size / 2, out * _THICK / 2, 0.0])
    c, s = np.cos(turn), np.sin(turn)
    return (vertices, mesh[1]), transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), [0, 0, 0])


def _planes(shape: str, angle: float, albedo: float, size: float) -> list[SceneObject]:
    """Two planes about the x axis; a floor for a corner; lid and sphere besides for a box."""
    out = [_plane("plane", *_with(albedo, _slab(side * angle / 2, size))) for side in (-1, 1)]
    floor = cuboid(2 * size, 2 * size, _THICK)
    below = transform(np.eye(3), [0, 0, -_THICK])
    if shape in {"corner", "box"}:
        out.append(_plane("floor", floor, albedo, below))
    if shape == "box":
        out.append(_plane("lid", floor, albedo, transform(np.eye(3), [0, 0, size])))
        sphere = ball(0.14 * size)
        out.append(_plane("sphere", sphere, albedo, transform(np.eye(3), [0.5 * size, 0.05 * size, 0.0])))
    return out


def _with(albedo: float, slab: tuple[Mesh, Float64]) -> tuple[Mesh, float, Float64]:
    return slab[0], albedo, slab[1]


def _backdrop() -> SceneObject:
    """A dark wall behind, too far to send light back."""
    mesh = cuboid(0.1, 6.0, 6.0)
    T = transform(np.eye(3), [-2.5, 0.0, -3.0])
    return SceneObject(mesh[0], mesh[1], 0.03, T, target=False, name="backdrop")


def _poses(angle: float, size: float, distances: Sequence[float]) -> Poses:
    """Looks into the opening from all sides of it, and from above the floor."""

    def choose(caster: Caster, rng: np.random.Generator, views: int) -> list[Float64]:
        del caster
        out = []
        for _ in range(views):
            azimuth = rng.uniform(-0.32, 0.32) * angle
            elevation = rng.uniform(np.radians(2), np.radians(24))
            distance = rng.uniform(distances[0], distances[1])
            aim = np.array([rng.uniform(0.0, 0.3) * size, rng.uniform(-0.1, 0.1) * size, 0.4 * size])
            away = [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation),
            ]
            out.append(look_at(aim + distance * np.array(away), aim, roll=rng.uniform(-np.pi, np.pi)))
        return out

    return choose
