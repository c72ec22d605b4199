"""Procedural objects: families of watertight meshes, each a function of a random generator.

Turned and freely curved bodies come first, then cut and built ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tofcapture.meshes import (
    Mesh,
    circle,
    cuboid,
    cylinder,
    extrude,
    join,
    move,
    rectangle,
    revolve,
    settle,
    shift,
    tube,
)
from tofcapture.poses import Float64, rotation_exp, transform

BOARD_SIZE = (0.5, 0.4, 0.010)  # m
_UPRIGHT = transform(rotation_exp([np.pi / 2, 0, 0]), [0, 0, 0])  # turns an outline's y from along to up


def sphere(rng: np.random.Generator) -> Mesh:
    """Make a ball of 8 to 20 cm."""
    return ball(rng.uniform(0.08, 0.20) / 2)


def ball(radius: float, rings: int = 48, segments: int = 72) -> Mesh:
    """Make a sphere of a given radius, metres, on z = 0."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = radius * np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    profile[[0, -1], 0] = 0.0
    return settle(revolve(profile, segments))


def _smooth(heights: Float64, radii: Float64, steps: int) -> Float64:
    """Draw a profile (steps, 2) through control radii, cubic Hermite with Catmull-Rom slopes."""
    slopes = np.gradient(radii, heights)
    z = np.linspace(heights[0], heights[-1], steps)
    k = np.clip(np.searchsorted(heights, z, side="right") - 1, 0, len(heights) - 2)
    span = heights[k + 1] - heights[k]
    t = (z - heights[k]) / span
    r = (
        (1 + 2 * t) * (1 - t) ** 2 * radii[k]
        + t * (1 - t) ** 2 * span * slopes[k]
        + t**2 * (3 - 2 * t) * radii[k + 1]
        + t**2 * (t - 1) * span * slopes[k + 1]
    )
    return np.stack([np.maximum(r, 0.003), z], axis=1)


def _solid(profile: Float64) -> Mesh:
    """Revolve an open outside profile, closed by flat discs."""
    low, high = profile[0, 1], profile[-1, 1]
    return revolve(np.concatenate([[[0, low]], profile, [[0, high]]]), segments=96)


def _hollow(outside: Float64, wall: float, floor: float) -> Mesh:
    """Revolve a vessel: the outside, a rim, and the inside ``wall`` metres further in, down to ``floor`` metres."""
    inside = outside[outside[:, 1] > outside[0, 1] + floor][::-1].copy()
    inside[:, 0] = np.maximum(inside[:, 0] - wall, 0.002)
    rim = np.array([[outside[-1, 0] - wall / 2, outside[-1, 1] + wall / 3]])
    ends = [[0, outside[0, 1]]], [[0, inside[-1, 1]]]
    return revolve(np.concatenate([ends[0], outside, rim, inside, ends[1]]), segments=96)


def lathe(rng: np.random.Generator) -> Mesh:
    """Make a turned solid with a random smooth profile, such as a chess piece or a vase without an opening."""
    height = rng.uniform(0.14, 0.28)
    heights = np.linspace(0, height, 7)
    return settle(_solid(_smooth(heights, rng.uniform(0.03, 0.09, 7), 60)))


def bottle(rng: np.random.Generator) -> Mesh:
    """Make a bottle: body, shoulder, neck, cap."""
    height, body = rng.uniform(0.18, 0.29), rng.uniform(0.032, 0.05)
    neck, cap = rng.uniform(0.010, 0.016), rng.uniform(0.016, 0.020)
    shoulder = rng.uniform(0.5, 0.65)
    blend = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 16))
    curve = np.stack([body + (neck - body) * blend, height * np.linspace(shoulder, 0.82, 16)], axis=1)
    foot = [[body - 0.004, 0], [body - 0.001, 0.002], [body, 0.005]]
    top = [[neck, 0.9 * height], [cap, 0.9 * height + 0.001], [cap, height - 0.001], [cap - 0.002, height]]
    return settle(_solid(np.concatenate([foot, curve, top])))


def cone(rng: np.random.Generator) -> Mesh:
    """Make a truncated cone or cylinder."""
    low = rng.uniform(0.05, 0.12)
    high = low * rng.uniform(0.2, 1.0)
    return settle(_solid(np.array([[low, 0.0], [high, rng.uniform(0.08, 0.24)]])))


def cup(rng: np.random.Generator) -> Mesh:
    """Make a tumbler with a wall, open at the top."""
    return settle(_vessel(rng.uniform(0.09, 0.16), rng.uniform(0.03, 0.045), rng.uniform(0.046, 0.065)))


def _vessel(height: float, foot: float, rim: float) -> Mesh:
    """Straight-walled open vessel, 3.5 mm thick."""
    z = np.linspace(0, height, 24)
    return _hollow(np.stack([foot + (rim - foot) * z / height, z], axis=1), wall=0.0035, floor=0.006)


def bowl(rng: np.random.Generator) -> Mesh:
    """Make a round bowl on a foot."""
    radius, depth = rng.uniform(0.07, 0.14), rng.uniform(0.05, 0.09)
    foot = 0.4 * radius
    angle = np.linspace(0, np.pi / 2, 28)
    curve = np.stack([foot + (radius - foot) * np.sin(angle), 0.008 + depth * (1 - np.cos(angle))], axis=1)
    return settle(_hollow(np.concatenate([[[foot, 0.0]], curve]), wall=0.004, floor=0.012))


def mug(rng: np.random.Generator) -> Mesh:
    """Make a mug with a handle."""
    height, radius = rng.uniform(0.09, 0.15), rng.uniform(0.04, 0.06)
    slope = rng.uniform(0.95, 1.1)
    body = _vessel(height, radius, radius * slope)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 40)
    rise, reach = rng.uniform(0.28, 0.34) * height, rng.uniform(0.024, 0.036)
    z = height / 2 + rise * np.sin(angle)
    # The ends sit inside the 3.5 mm wall and do not show on the inner side.
    wall = radius + radius * (slope - 1) * z / height - 0.0025
    path = np.stack([wall + reach * np.cos(angle), np.zeros(40), z], axis=1)
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    handle = tube(path @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]), rng.uniform(0.004, 0.006), (-s, c, 0))
    return settle(join(body, handle))


def blob(rng: np.random.Generator) -> Mesh:
    """Make an organic lump: a sphere whose radius is swayed by smooth random waves, with a flattened underside."""
    vertices, triangles = ball(1.0, rings=64, segments=96)
    unit = vertices - [0, 0, 1]
    wave = np.zeros(len(unit))
    for frequency, amplitude in ((1.5, 0.22), (3.0, 0.10), (6.0, 0.035)):
        for axis in rng.normal(size=(4, 3)):
            wave += amplitude / 2 * np.sin(frequency * (unit @ axis) + rng.uniform(0, 2 * np.pi))
    points = unit * (1 + wave)[:, None] * rng.uniform(0.7, 1.2, 3)
    floor = np.quantile(points[:, 2], 0.08)
    points[:, 2] = np.maximum(points[:, 2], floor + 0.03 * (points[:, 2] - floor))
    scale = rng.uniform(0.12, 0.28) / np.ptp(points, axis=0).max()
    return settle((points * scale, triangles))


def dumbbell(rng: np.random.Generator) -> Mesh:
    """Make two balls on a bar, standing on one of them."""
    radius, length = rng.uniform(0.03, 0.05), rng.uniform(0.12, 0.19)
    path = np.linspace([0, 0, radius], [0, 0, radius + length], 5)
    other = shift(ball(radius * rng.uniform(0.6, 1.0)), z=length)
    return settle(join(ball(radius), tube(path, radius * rng.uniform(0.25, 0.5), (0, 1, 0)), other))


def box(rng: np.random.Generator) -> Mesh:
    """Make a carton of random proportions."""
    return cuboid(*rng.uniform([0.08, 0.06, 0.05], [0.24, 0.18, 0.24]))


def stack(rng: np.random.Generator) -> Mesh:
    """Make two to four boxes or discs on top of each other, each smaller and turned."""
    size, height, parts = rng.uniform(0.14, 0.24), 0.0, []
    for _ in range(int(rng.integers(2, 5))):
        thick = rng.uniform(0.03, 0.07)
        part = (
            cuboid(size, size * rng.uniform(0.6, 1.0), thick)
            if rng.random() < 0.6
            else cylinder(size / 2, thick, segments=72)
        )
        T = transform(rotation_exp([0, 0, rng.uniform(0, np.pi)]), [0, 0, height])
        parts.append(move(part, T))
        height, size = height + thick, size * rng.uniform(0.55, 0.85)
    return settle(join(*parts))


def steps(rng: np.random.Generator) -> Mesh:
    """Make a staircase of three to six steps."""
    n, run, rise = int(rng.integers(3, 7)), rng.uniform(0.03, 0.045), rng.uniform(0.015, 0.035)
    corners = [[0.0, 0.0], [n * run, 0.0]]
    for i in range(n, 0, -1):
        corners += [[i * run, (n - i + 1) * rise], [(i - 1) * run, (n - i + 1) * rise]]
    return settle(move(extrude(np.array(corners), rng.uniform(0.10, 0.22)), _UPRIGHT))


def plate(rng: np.random.Generator) -> Mesh:
    """Make a plate with round and square holes on a grid, some left out."""
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
    """Make a spur gear with a bore and lightening holes."""
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
    """Make an open-ended wrench with a ring at the other end, lying flat."""
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
    """Draw points (33, 2) of a unit circle from one angle to another, radians."""
    angle = np.linspace(start, stop, 33)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bracket(rng: np.random.Generator) -> Mesh:
    """Make an angle bracket: two drilled legs and a gusset."""
    width, a, b = rng.uniform(0.09, 0.15), rng.uniform(0.10, 0.20), rng.uniform(0.10, 0.22)
    thick, bore = rng.uniform(0.006, 0.012), rng.uniform(0.008, 0.014)
    foot = extrude(rectangle(a, width), thick, [circle(bore, (0.15 * a, s * width / 4)) for s in (-1, 1)])
    leg = extrude(rectangle(b, width), thick, [circle(bore * 1.3, (0.15 * b, 0))])
    T = transform(rotation_exp([0, -np.pi / 2, 0]), [thick - a / 2, 0, b / 2])
    corner = np.array([[-a / 2 + thick / 2, thick / 2], [0.1 * a, thick / 2], [-a / 2 + thick / 2, 0.6 * b]])
    gusset = shift(move(extrude(corner, thick), _UPRIGHT), y=thick / 2)
    return settle(join(foot, move(leg, T), gusset))


def wedge(rng: np.random.Generator) -> Mesh:
    """Make an extruded triangle or trapezium, standing on its long side."""
    width, height = rng.uniform(0.12, 0.26), rng.uniform(0.07, 0.18)
    apex, top = rng.uniform(-0.4, 0.4) * width, rng.uniform(0.05, 0.35) * width
    outline = np.array([[-width / 2, 0], [width / 2, 0], [apex + top / 2, height], [apex - top / 2, height]])
    return settle(move(extrude(outline, rng.uniform(0.08, 0.20)), _UPRIGHT))


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
    """Make two to four block letters standing on a bar, or lying on the table."""
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
    bar = extrude(rectangle(5.0 * len(word) * unit, 2 * unit), thick * 1.4)
    bar = shift(bar, x=(5.0 * len(word) - 1) * unit / 2, y=-0.99 * unit, z=-0.2 * thick)
    return settle(move(join(*parts, bar), _UPRIGHT))


def board(_: np.random.Generator | None = None) -> Mesh:
    """Make the calibration board: 0.5 x 0.4 m, 10 mm thick, with seven cut-outs that no turn or reflection maps onto themselves."""
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


_FAMILIES = (
    blob, board, bottle, bowl, box, bracket, cone, cup, dumbbell, gear, lathe, mug, plate, sphere, stack, steps, text, tool, wedge,
)  # fmt: skip
FAMILIES: Mapping[str, Callable[[np.random.Generator], Mesh]] = {f.__name__: f for f in _FAMILIES}
"""Name -> generator of a mesh that rests on z = 0, centred in x and y, 4 to 30 cm large; only the calibration ``board`` is
larger, 0.5 x 0.4 m."""
