"""Scenes of the simulated table, by name.

The world is the arm's base frame. The table top lies half a metre below the base: a UR10e then reaches three quarters of the
directions within 65 deg of vertical at 0.8 m and half of them at 1.4 m, against a quarter and an eighth at the base's height.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from tofcapture.devices.sim import hashed_generator
from tofcapture.devices.sim.scene import SceneObject
from tofcapture.devices.sim.shapes import FAMILIES, ball, board
from tofcapture.errors import ConfigError
from tofcapture.frames import CALIBRATION
from tofcapture.meshes import (
    SUFFIXES,
    Mesh,
    circle,
    cuboid,
    cylinder,
    extrude,
    move,
    read_mesh,
    rectangle,
    settle,
)
from tofcapture.ops.pattern import pattern_from
from tofcapture.poses import Float64, rotation_exp, transform

TABLE_CENTRE: Float64 = np.array([0.70, 0.0, -0.50])  # m, base frame, on the table top
BOARD_CENTRE = np.array([0.70, 0.0, -0.22])
BOARD_TILT = np.radians(-15.0)  # about base y: the board leans towards the arm
_TABLE = (1.2, 1.6, 0.04)  # m
_FLOOR = -1.2  # m, z in the base frame
_SHEET = 0.0002  # m that a printed sheet stands out of its plate
_INK = 0.06  # albedo of what is printed
_REACH = 0.33  # m; targets stay within this disc about the table's centre


def on_table(x: float, y: float) -> Float64:
    """Point (3,) at the table top, from its centre, metres."""
    out: Float64 = TABLE_CENTRE + np.array([x, y, 0.0])
    return out


def generator(name: str, seed: int, purpose: str) -> np.random.Generator:
    """Make an independent generator for one purpose of one scene."""
    return hashed_generator(f"{purpose}|{seed}|{name}".encode())


def mesh_files(folder: Path) -> list[Path]:
    """List the mesh files of a folder, sorted."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)


def scene_objects(
    name: str,
    seed: int,
    meshes: Mapping[str, Path] | None = None,
    mesh_unit: str = "m",
    board: Path | None = None,
) -> list[SceneObject]:
    """Put everything into a scene, in the base frame.

    First come the objects (``target=True``), then table, pedestal, walls and clutter.

    ``name`` is ``calibration`` for the board (the one of the TOML file ``board``, where that is given), that of one of ``meshes``, or a family of :data:`shapes.FAMILIES`, optionally
    with ``-<n>`` behind it (``mug``, ``mug-2``). Anything else is a seeded combination of one to four objects (``random-7``).
    """
    if name == CALIBRATION:
        return [*_calibration(board), *surroundings(name, seed, clutter=False)]
    rng = generator(name, seed, "objects")
    if meshes and name in meshes:
        items = [(name, read_table_mesh(meshes[name], mesh_unit))]
    else:
        items = [(family, FAMILIES[family](rng)) for family in _families(name, rng)]
    return [*arranged(items, rng), *surroundings(name, seed, clutter=True)]


def _families(name: str, rng: np.random.Generator) -> list[str]:
    """Choose the families of a scene's objects."""
    stem = re.sub(r"-\d+$", "", name)
    if stem in FAMILIES:
        return [stem]
    choice = [f for f in FAMILIES if f != "board"]
    count = int(rng.choice([1, 2, 3, 4], p=[0.2, 0.35, 0.25, 0.2]))
    return [choice[int(i)] for i in rng.choice(len(choice), size=count, replace=False)]


def read_table_mesh(path: Path, unit: str) -> Mesh:
    """Read a mesh file, resting on z = 0; its size tells whether the unit can be right."""
    mesh = settle(read_mesh(path, unit))
    size = float(np.ptp(mesh[0], axis=0).max())
    if not 0.005 < size < 1.0:
        raise ConfigError(
            f"{path}: {size:.4g} m is no size for an object on the table", hint="set mesh_unit to m, cm or mm"
        )
    return mesh


def _any_albedo(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.15, 0.9))


def arranged(
    items: Sequence[tuple[str, Mesh]],
    rng: np.random.Generator,
    albedo: Callable[[np.random.Generator], float] = _any_albedo,
) -> list[SceneObject]:
    """Stand objects on the table, turned at random, side by side; ``albedo`` draws that of each."""
    out: list[SceneObject] = []
    discs: list[tuple[Float64, float]] = []
    for name, (vertices, triangles) in items:
        radius = float(np.linalg.norm(vertices[:, :2], axis=1).max())
        place = _free_place(radius, discs, rng)
        if place is None:
            continue
        discs.append((place, radius))
        T = transform(rotation_exp([0, 0, rng.uniform(-np.pi, np.pi)]), on_table(*place))
        out.append(SceneObject(vertices, triangles, albedo(rng), T, target=True, name=name))
    return out


def _free_place(
    radius: float, discs: Sequence[tuple[Float64, float]], rng: np.random.Generator
) -> Float64 | None:
    """Find a place (2,) near the centre where a disc touches no other, the first central; None after forty tries."""
    if not discs:
        near: Float64 = rng.uniform(-0.02, 0.02, 2)
        return near
    for reach in np.linspace(0.06, _REACH - radius, 40):
        angle = rng.uniform(0, 2 * np.pi)
        place: Float64 = reach * np.array([np.cos(angle), np.sin(angle)])
        if all(np.linalg.norm(place - other) > radius + r + 0.005 for other, r in discs):
            return place
    return None


def solid(
    name: str,
    mesh: Mesh,
    albedo: float | Float64,
    at: ArrayLike,
    turn: ArrayLike = (0, 0, 0),
    *,
    target: bool = False,
) -> SceneObject:
    """Stand a mesh somewhere; ``turn`` is a rotation vector."""
    T = transform(rotation_exp(turn), np.asarray(at, dtype=np.float64))
    return SceneObject(mesh[0], mesh[1], albedo, T, target=target, name=name)


def _calibration(board_file: Path | None = None) -> list[SceneObject]:
    """Stand the board with cut-outs up, and four solids whose slopes hold a registration in the board's plane.

    The board leans towards the arm, well above the table, so that cut-outs and outline stand before a clear background;
    nothing faces its front, so hardly any light reaches it by way of other surfaces.
    """
    lean = (0, BOARD_TILT, 0)
    plate = move(board(), transform(np.eye(3), [0, 0, -0.005]))
    block = move(cuboid(0.16, 0.12, 0.10), transform(rotation_exp([0.6, 0.0, 0.0]), [0, 0, 0]))
    pyramid = cylinder(0.11, 0.16, segments=5)
    pyramid = (pyramid[0] * np.where(pyramid[0][:, 2:] > 0, [0.25, 0.25, 1], [1.0, 1.0, 1]), pyramid[1])
    roof = extrude(np.array([[-0.1, 0], [0.1, 0], [0.0, 0.1]]), 0.18)
    ridge = move(roof, transform(rotation_exp([np.pi / 2, 0, 0]), [0, 0, 0]))
    return [
        *(_plates(board_file) if board_file else [solid("board", plate, 0.7, BOARD_CENTRE, lean, target=True)]),
        *(_leg(x, y) for x, y in ((-0.06, 0.04), (0.12, 0.05), (-0.03, -0.16))),
        solid("ball", ball(0.085), 0.6, on_table(0.06, 0.36), target=True),
        solid("block", settle(block), 0.45, on_table(-0.13, 0.40), (0, 0, 0.5), target=True),
        solid("pyramid", settle(pyramid), 0.65, on_table(-0.10, -0.38), (0, 0, 0.3), target=True),
        solid("ridge", settle(ridge), 0.5, on_table(0.15, -0.38), (0, 0, 0.8), target=True),
        solid("peg", cylinder(0.05, 0.12, 48), 0.55, on_table(0.36, 0.02), target=True),
    ]  # fmt: skip


def _plates(path: Path) -> list[SceneObject]:
    """Make the board of a TOML file: a plate with its cut-outs, and what is printed on it, a sheet on its front."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        pattern = pattern_from(table["pattern"], str(path)) if "pattern" in table else None
        size = np.zeros(2) if pattern is None else pattern.size + pattern.square
        outline, thick = np.array(table.get("outline", rectangle(*size))), float(table["thickness"])
        holes = [
            np.array(h["corners"]) if "corners" in h else circle(h["radius"], tuple(h["centre"]), 64)
            for h in table.get("hole", [])
        ]
    except (OSError, KeyError, ValueError, TypeError) as err:
        raise ConfigError(f"{path}: expected a board, see docs/board.md: {err!r}") from err
    at = BOARD_CENTRE - transform(rotation_exp((0, BOARD_TILT, 0)), np.zeros(3))[:3, 2] * thick / 2
    sheet = 0.0 if pattern is None else _SHEET
    out = [solid("board", extrude(outline, thick - sheet, holes), 0.7, at, (0, BOARD_TILT, 0), target=True)]
    if pattern is not None:
        x, y = pattern.cuts()
        vertices = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), thick)], axis=-1).reshape(-1, 3)
        corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).reshape(-1)
        cells = corner[:, None] + [0, 1, len(x) + 1, len(x)]
        shade = np.where(pattern.dark(vertices[cells].mean(axis=1)[:, :2]), _INK, 0.7)
        triangles = cells[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.int64)
        out.append(
            solid("pattern", (vertices, triangles), np.repeat(shade, 2), at, (0, BOARD_TILT, 0), target=True)
        )
    return out


def _leg(x: float, y: float) -> SceneObject:
    """Put a round leg under the board's point (x, y), between cut-outs; ends 3 mm below the plate."""
    foot = on_table(x * np.cos(BOARD_TILT), y)
    height = BOARD_CENTRE[2] - TABLE_CENTRE[2] - x * np.sin(BOARD_TILT) - 0.005 - 0.003 - 0.004
    return solid("leg", cylinder(0.012, height, 24), 0.5, foot)


def surroundings(name: str, seed: int, *, clutter: bool) -> list[SceneObject]:
    """Add table, pedestal, floor, walls and boxes; where and how bright differs from scene to scene."""
    rng = generator(name, seed, "surroundings")
    x, y, z = TABLE_CENTRE
    out = [
        solid("table", cuboid(*_TABLE), rng.uniform(0.2, 0.75), [x + 0.08, y, z - _TABLE[2]]),
        solid("pedestal", cuboid(0.2, 0.2, -_FLOOR - 0.02), 0.4, [0, 0, _FLOOR]),
        solid("floor", cuboid(6, 6, 0.1), rng.uniform(0.15, 0.6), [x, y, _FLOOR - 0.1]),
    ]
    if not clutter or rng.random() < 0.85:
        albedo = rng.uniform(0.3, 0.85)
        out.append(solid("back wall", cuboid(0.1, 6, 3.2), albedo, [rng.uniform(1.9, 3.0), 0, _FLOOR]))
    for side in (-1, 1):
        if rng.random() < 0.5:
            far = side * rng.uniform(1.4, 2.6)
            out.append(solid("side wall", cuboid(6, 0.1, 3.2), rng.uniform(0.3, 0.85), [x, far, _FLOOR]))
    if clutter:
        out += [_clutter(rng) for _ in range(int(rng.integers(0, 6)))]
    return out


def _clutter(rng: np.random.Generator) -> SceneObject:
    """Add one box, at the table's far edges or on the floor behind it."""
    side = rng.choice([-1.0, 1.0])
    turn = (0.0, 0.0, rng.uniform(-np.pi, np.pi))
    if rng.random() < 0.5:
        size = rng.uniform([0.06, 0.06, 0.04], [0.2, 0.2, 0.12])
        place = on_table(rng.uniform(-0.2, 0.5), side * rng.uniform(0.55, 0.68))
    else:
        size = rng.uniform([0.2, 0.2, 0.3], [0.5, 0.5, 1.0])
        place = np.array([rng.uniform(0.3, 1.6), side * rng.uniform(1.15, 1.3), _FLOOR])
    return solid("clutter", cuboid(*size), rng.uniform(0.15, 0.9), place, turn)
