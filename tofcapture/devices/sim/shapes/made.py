"""Families of cut and built bodies: box, stack, steps, plate, gear, tool, bracket, letters, wedge, board."""

from __future__ import annotations

import numpy as np

from tofcapture.devices.sim.shapes.mesh import (
    Mesh,
    circle,
    cuboid,
    extrude,
    join,
    move,
    rectangle,
    settle,
    shift,
)
from tofcapture.poses import Float64, rotation_exp, transform

BOARD_SIZE = (0.5, 0.4, 0.010)  # m


def box(rng: np.random.Generator) -> Mesh:
    """Carton of random proportions."""
    return cuboid(*rng.uniform([0.08, 0.06, 0.05], [0.24, 0.18, 0.24]))


def stack(rng: np.random.Generator) -> Mesh:
    """Two to four boxes or discs on top of each other, each smaller and turned."""
    size, height, parts = rng.uniform(0.14, 0.24), 0.0, []
    for _ in range(int(rng.integers(2, 5))):
        thick = rng.uniform(0.03, 0.07)
        part = (
            cuboid(size, size * rng.uniform(0.6, 1.0), thick)
            if rng.random() < 0.6
            else extrude(circle(size / 2, segments=72), thick)
        )
        T = transform(rotation_exp([0, 0, rng.uniform(0, np.pi)]), [0, 0, height])
        parts.append(move(part, T))
        height, size = height + thick, size * rng.uniform(0.55, 0.85)
    return settle(join(*parts))


def steps(rng: np.random.Generator) -> Mesh:
    """Staircase of three to six steps."""
    n, run, rise = int(rng.integers(3, 7)), rng.uniform(0.03, 0.045), rng.uniform(0.015, 0.035)
    corners = [[0.0, 0.0], [n * run, 0.0]]
    for i in range(n, 0, -1):
        corners += [[i * run, (n - i + 1) * rise], [(i - 1) * run, (n - i + 1) * rise]]
    return settle(move(extrude(np.array(corners), rng.uniform(0.10, 0.22)), _upright()))


def _upright() -> Float64:
    """Turn the extrusion direction from z to -y, so that the outline's y points up."""
    return transform(rotation_exp([np.pi / 2, 0, 0]), [0, 0, 0])


def plate(rng: np.random.Generator) -> Mesh:
    """Plate with round and square holes on a grid, some left out."""
    nx, ny, pitch = int(rng.integers(3, 5)), int(rng.integers(2, 4)), rng.uniform(0.05, 0.07)
    holes = []
    for i in range(nx):
        for j in range(ny):
            centre = ((i - (nx - 1) / 2) * pitch, (j - (ny - 1) / 2) * pitch)
            size = rng.uniform(0.2, 0.38) * pitch
            if rng.random() < 0.75:
                holes.append(
                    circle(size, centre, 36)
                    if rng.random() < 0.6
                    else rectangle(2 * size, 1.6 * size) + centre
                )
    return settle(extrude(rectangle(nx * pitch, ny * pitch), rng.uniform(0.008, 0.03), holes))


def gear(rng: np.random.Generator) -> Mesh:
    """Spur gear with a bore and lightening holes."""
    teeth, radius = int(rng.integers(10, 24)), rng.uniform(0.06, 0.14)
    depth = 2.2 * radius / teeth
    angle = 2 * np.pi * (np.arange(teeth)[:, None] + np.array([-0.25, -0.12, 0.12, 0.25])).ravel() / teeth
    r = np.tile([radius - depth, radius, radius, radius - depth], teeth)
    bore = rng.uniform(0.15, 0.25) * radius
    n = int(rng.integers(0, 6))
    spokes = [
        circle(0.17 * radius, (0.55 * radius * np.cos(a), 0.55 * radius * np.sin(a)), 36)
        for a in 2 * np.pi * np.arange(n) / max(n, 1)
    ]
    outline = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
    return settle(extrude(outline, rng.uniform(0.015, 0.04), [circle(bore, segments=48), *spokes]))


def tool(rng: np.random.Generator) -> Mesh:
    """Open-ended wrench with a ring at the other end, lying flat."""
    length, head, handle = rng.uniform(0.14, 0.26), rng.uniform(0.018, 0.026), rng.uniform(0.007, 0.011)
    start = np.arcsin(handle / head)
    jaw = rng.uniform(0.45, 0.6) * head
    turn = np.arcsin(jaw / head)
    left = head * _arc(np.pi - start, turn)
    right = head * _arc(-turn, -np.pi + start)
    throat = np.array([[0.1 * head, jaw], [0.1 * head, -jaw]])
    ring = np.array([-length, 0]) + head * _arc(-start, start - 2 * np.pi)[::-1]
    outline = np.concatenate([left[::-1], ring, right[::-1], throat[::-1]])
    hole = circle(0.6 * head, (-length, 0), 6 * int(rng.integers(1, 8)))
    return settle(extrude(outline, rng.uniform(0.010, 0.02), [hole]))


def _arc(start: float, stop: float) -> Float64:
    """(33, 2) points of a unit circle from one angle to another, radians."""
    angle = np.linspace(start, stop, 33)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bracket(rng: np.random.Generator) -> Mesh:
    """Angle bracket: two drilled legs and a gusset."""
    width, a, b = rng.uniform(0.09, 0.15), rng.uniform(0.10, 0.20), rng.uniform(0.10, 0.22)
    thick, bore = rng.uniform(0.006, 0.012), rng.uniform(0.008, 0.014)
    foot = extrude(rectangle(a, width), thick, [circle(bore, (0.15 * a, s * width / 4)) for s in (-1, 1)])
    leg = extrude(rectangle(b, width), thick, [circle(bore * 1.3, (0.15 * b, 0))])
    T = transform(rotation_exp([0, -np.pi / 2, 0]), [thick - a / 2, 0, b / 2])
    corner = np.array([[-a / 2 + thick / 2, thick / 2], [0.1 * a, thick / 2], [-a / 2 + thick / 2, 0.6 * b]])
    gusset = shift(move(extrude(corner, thick), _upright()), y=thick / 2)
    return settle(join(foot, move(leg, T), gusset))


def wedge(rng: np.random.Generator) -> Mesh:
    """Extruded triangle or trapezium, standing on its long side."""
    width, height = rng.uniform(0.12, 0.26), rng.uniform(0.07, 0.18)
    apex, top = rng.uniform(-0.4, 0.4) * width, rng.uniform(0.05, 0.35) * width
    outline = np.array([[-width / 2, 0], [width / 2, 0], [apex + top / 2, height], [apex - top / 2, height]])
    return settle(move(extrude(outline, rng.uniform(0.08, 0.20)), _upright()))


# Outlines on a 4 x 6 grid; the second entry is the hole, if there is one.
_LETTERS: dict[str, tuple[list[tuple[float, float]], list[tuple[float, float]]]] = {
    "T": ([(1.3, 0), (2.7, 0), (2.7, 4.8), (4, 4.8), (4, 6), (0, 6), (0, 4.8), (1.3, 4.8)], []),
    "F": ([(0, 0), (1.3, 0), (1.3, 2.4), (3.2, 2.4), (3.2, 3.6), (1.3, 3.6), (1.3, 4.8), (4, 4.8), (4, 6), (0, 6)], []),
    "L": ([(0, 0), (4, 0), (4, 1.2), (1.3, 1.2), (1.3, 6), (0, 6)], []),
    "H": (
        [(0, 0), (1.3, 0), (1.3, 2.4), (2.7, 2.4), (2.7, 0), (4, 0), (4, 6), (2.7, 6), (2.7, 3.6), (1.3, 3.6), (1.3, 6), (0, 6)],
        [],
    ),
    "A": (
        [(0, 0), (1.1, 0), (1.4, 1.3), (2.6, 1.3), (2.9, 0), (4, 0), (2.6, 6), (1.4, 6)],
        [(1.6, 2.4), (2.4, 2.4), (2, 4.4)],
    ),
    "O": ([(1, 0), (3, 0), (4, 1), (4, 5), (3, 6), (1, 6), (0, 5), (0, 1)], [(1.3, 1.3), (2.7, 1.3), (2.7, 4.7), (1.3, 4.7)]),
    "D": ([(0, 0), (2.8, 0), (4, 1.5), (4, 4.5), (2.8, 6), (0, 6)], [(1.3, 1.2), (2.4, 1.2), (2.7, 1.8), (2.7, 4.2), (2.4, 4.8), (1.3, 4.8)]),
    "N": ([(0, 0), (1.2, 0), (1.2, 3.6), (2.8, 0), (4, 0), (4, 6), (2.8, 6), (2.8, 2.4), (1.2, 6), (0, 6)], []),
    "Z": ([(0, 0), (4, 0), (4, 1.2), (1.7, 1.2), (4, 4.9), (4, 6), (0, 6), (0, 4.8), (2.3, 4.8), (0, 1.1)], []),
}  # fmt: skip


def text(rng: np.random.Generator) -> Mesh:
    """Two to four block letters standing on a bar, or lying on the table."""
    unit, thick = rng.uniform(0.010, 0.0145), rng.uniform(0.02, 0.05)
    word = rng.choice(sorted(_LETTERS), size=int(rng.integers(2, 5)))
    parts = []
    for i, name in enumerate(word):
        outline, hole = _LETTERS[str(name)]
        place = np.array([5.0 * i, 0.0])
        holes = [(np.array(hole) + place) * unit] if hole else []
        parts.append(extrude((np.array(outline) + place) * unit, thick, holes))
    if rng.random() < 0.5:
        return settle(join(*parts))
    bar = move(
        extrude(rectangle(5.0 * len(word) * unit, 2 * unit), thick * 1.4), transform(np.eye(3), [0, 0, 0])
    )
    bar = shift(bar, x=(5.0 * len(word) - 1) * unit / 2, y=-0.99 * unit, z=-0.2 * thick)
    return settle(move(join(*parts, bar), _upright()))


def board(_: np.random.Generator | None = None) -> Mesh:
    """Calibration board: 0.5 x 0.4 m, 10 mm thick, with seven cut-outs that no turn or reflection maps onto themselves."""
    x, y, thick = BOARD_SIZE
    holes = [
        circle(0.045, (-0.16, 0.11), 64),
        circle(0.030, (-0.03, 0.13), 48),
        rectangle(0.11, 0.06) + np.array((0.155, 0.115)),
        np.array([[-0.20, -0.14], [-0.09, -0.14], [-0.20, -0.03]]),
        circle(0.055, (0.03, -0.02), 64),
        rectangle(0.04, 0.12) + np.array((0.185, -0.03)),
        rectangle(0.13, 0.045) + np.array((0.09, -0.15)),
    ]
    return extrude(rectangle(x, y), thick, holes)
