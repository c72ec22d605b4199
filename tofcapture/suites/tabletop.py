"""Make scenes on the arm's table: the simulated ToF-100 and the noise suite."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.scenes import (
    TABLE_CENTRE,
    arranged,
    generator,
    mesh_files,
    read_table_mesh,
    solid,
    surroundings,
)
from tofcapture.devices.sim.shapes import FAMILIES
from tofcapture.errors import ConfigError
from tofcapture.meshes import Mesh, cuboid
from tofcapture.suites.scene import Recipe, Scene

_PANEL = (0.26, 0.008, 0.22)  # m; length, thickness, height: within the cylinder that the arm keeps out of
_SHEET = 0.001  # m


def make(recipe: Recipe, index: int, seed: int, meshes: Sequence[Path], mesh_unit: str) -> Scene:
    """Make a scene of the simulated ToF-100; see ``recipes/tof100.toml``."""
    pattern: list[str] = recipe.table["pattern"]
    kind = pattern[index % len(pattern)]
    if kind == "mesh" and meshes:
        turn = index // len(pattern) * pattern.count("mesh") + pattern[: index % len(pattern)].count("mesh")
        path = meshes[turn % len(meshes)]
        name = f"{re.sub(r'[^A-Za-z0-9_.]', '_', path.stem)}-{turn // len(meshes) + 1}"
        items = [(path.stem, read_table_mesh(path, mesh_unit))]
        return _scene(recipe, name, "mesh", seed, items, [path.stem])
    return _procedural(recipe, f"s{index:03d}", "object" if kind == "mesh" else kind, seed)


def make_level(recipe: Recipe, index: int, seed: int) -> Scene:
    """Make a scene of the noise suite: a base scene at one level of exposure and ambient light."""
    levels: list[dict[str, float]] = recipe.table["level"]
    base, level = divmod(index, len(levels))
    kind = recipe.table["pattern"][base % len(recipe.table["pattern"])]
    scene = _procedural(recipe, f"n{base:03d}", kind, seed)
    chosen = levels[level]
    return replace(
        scene,
        name=f"{scene.name}-{level + 1}",
        sim={"sensor": dict(chosen)},
        facts={**scene.facts, "level": level, **chosen},
    )


def _procedural(recipe: Recipe, stem: str, kind: str, seed: int) -> Scene:
    """Put objects of seeded families up; every scene has instances of its own."""
    table = recipe.table["kind"][kind]
    rng = generator(stem, seed, "suite objects")
    choice = table.get("families") or [f for f in FAMILIES if f != "board"]
    low, high = table["count"]
    count = int(rng.integers(low, high + 1))
    families = [choice[int(i)] for i in rng.choice(len(choice), size=count, replace=False)]
    items = [(family, FAMILIES[family](rng)) for family in families]
    what = families[0] if count == 1 else kind
    return _scene(recipe, f"{stem}-{what}", kind, seed, items, [f"{stem}-{f}" for f in families])


def _scene(
    recipe: Recipe, name: str, kind: str, seed: int, items: Sequence[tuple[str, Mesh]], identities: list[str]
) -> Scene:
    table = recipe.table["kind"][kind]
    rng = generator(name, seed, "suite arrangement")
    chosen: list[str] = []
    materials = {m: recipe.table["materials"][m] for m in table.get("materials", recipe.table["materials"])}
    albedo = _material(materials, chosen)
    targets = arranged(items, rng, albedo)
    used = [o.name for o in targets]
    objects = [
        *targets,
        *_panels(int(table.get("panels", 0)), rng, albedo),
        *_sheets(int(recipe.table["sheets"]), recipe.table["materials"], rng),
        *_painted(surroundings(name, seed, clutter=True), table.get("surroundings"), rng),
    ]
    return Scene(
        name=name,
        objects=tuple(objects),
        identities=tuple(i for i in identities if any(i.endswith(u) for u in used)),
        poses=None,
        plan_name=name,
        facts={
            "kind": kind,
            "materials": chosen,
            "albedo": [round(float(np.mean(o.albedo)), 4) for o in targets],
        },
    )


def _material(
    materials: Mapping[str, Sequence[float]], chosen: list[str]
) -> Callable[[np.random.Generator], float]:
    """Return what draws a material and an albedo of it, and notes the material's name."""
    names = list(materials)

    def draw(rng: np.random.Generator) -> float:
        chosen.append(names[int(rng.integers(len(names)))])
        low, high = materials[chosen[-1]]
        return float(rng.uniform(low, high))

    return draw


def _panels(
    count: int, rng: np.random.Generator, albedo: Callable[[np.random.Generator], float]
) -> list[SceneObject]:
    """Stand panels behind the object that meet in a corner; part of the target."""
    if not count:
        return []
    facing, opening = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(80, 110))
    length, thickness, _ = _PANEL
    apex = TABLE_CENTRE + 0.14 * np.array([np.cos(facing + np.pi), np.sin(facing + np.pi), 0])
    out = []
    for side in range(count):
        turn = facing + (opening / 2 if side else -opening / 2)
        along = np.array([np.cos(turn), np.sin(turn), 0.0])
        at = apex + (length / 2 + thickness) * along
        out.append(solid("panel", cuboid(*_PANEL), albedo(rng), at, (0, 0, turn), target=True))
    return out


def _sheets(most: int, materials: Mapping[str, Any], rng: np.random.Generator) -> list[SceneObject]:
    """Lay thin cloths or papers on the table: albedo changes where depth does not."""
    albedo = _material(materials, [])
    out = []
    for k in range(int(rng.integers(0, most + 1))):
        x, y = rng.uniform(0.15, 0.6, 2)
        place = TABLE_CENTRE + np.append(rng.uniform(-0.2, 0.2, 2), 0.0)
        mesh = cuboid(float(x), float(y), _SHEET * (1 + k / 4))
        out.append(solid("sheet", mesh, albedo(rng), place, (0, 0, rng.uniform(-np.pi, np.pi))))
    return out


def _painted(
    around: Sequence[SceneObject], albedo: Sequence[float] | None, rng: np.random.Generator
) -> list[SceneObject]:
    """Give table, floor and walls one albedo of a range, where the kind of scene has one: a black or a white room."""
    if albedo is None:
        return list(around)
    low, high = albedo
    one = float(rng.uniform(low, high))
    return [replace(o, albedo=one) for o in around]


def table_meshes(folder: Path, mesh_unit: str, seed: int) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """List the meshes of a folder that fit on the table and under the arm, in a seeded order, and those that do not.

    Raises :class:`ConfigError`: no folder, or no mesh of a fitting size in it.
    """
    if not folder.is_dir():
        raise ConfigError(f"--meshes {folder}: expected a folder of PLY, OBJ or STL files")
    paths = mesh_files(folder)
    sizes: dict[Path, Any] = {}
    for path in paths:
        try:
            sizes[path] = np.ptp(read_table_mesh(path, mesh_unit)[0], axis=0)
        except ConfigError:
            continue
    fit = [p for p, size in sizes.items() if size.max() > 0.03 and size[:2].max() < 0.3 and size[2] < 0.28]
    if not fit:
        raise ConfigError(
            f"--meshes {folder}: none of {len(paths)} meshes is 3 to 30 cm large",
            hint=f"are they in {mesh_unit}? see --mesh-unit",
        )
    order = generator("meshes", seed, "suite meshes").permutation(len(fit))
    return tuple(fit[int(i)] for i in order), tuple(p for p in paths if p not in fit)
