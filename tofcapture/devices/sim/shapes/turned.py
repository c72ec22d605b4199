"""Families of turned and freely curved bodies: sphere, lathe, bottle, cup, bowl, mug, cone, blob, dumbbell."""

from __future__ import annotations

import numpy as np

from tofcapture.devices.sim.shapes.mesh import Mesh, join, revolve, settle, shift, tube
from tofcapture.poses import Float64


def sphere(rng: np.random.Generator) -> Mesh:
    """Ball of 8 to 20 cm."""
    return ball(rng.uniform(0.08, 0.20) / 2)


def ball(radius: float, rings: int = 48, segments: int = 72) -> Mesh:
    """Sphere of a given radius, metres, on z = 0."""
    return settle(revolve(_half_circle(radius, rings), segments))


def _half_circle(radius: float, steps: int) -> Float64:
    """Profile of a sphere, from pole to pole."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, steps + 1)
    profile = radius * np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    profile[[0, -1], 0] = 0.0
    return profile


def _smooth(heights: Float64, radii: Float64, steps: int) -> Float64:
    """(steps, 2) profile through control radii, cubic Hermite with Catmull-Rom slopes."""
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
    """Turned solid with a random smooth profile, such as a chess piece or a vase without an opening."""
    height = rng.uniform(0.14, 0.28)
    heights = np.linspace(0, height, 7)
    return settle(_solid(_smooth(heights, rng.uniform(0.03, 0.09, 7), 60)))


def bottle(rng: np.random.Generator) -> Mesh:
    """Bottle: body, shoulder, neck, cap."""
    height, body = rng.uniform(0.18, 0.29), rng.uniform(0.032, 0.05)
    neck, cap = rng.uniform(0.010, 0.016), rng.uniform(0.016, 0.020)
    shoulder = rng.uniform(0.5, 0.65)
    blend = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 16))
    curve = np.stack([body + (neck - body) * blend, height * np.linspace(shoulder, 0.82, 16)], axis=1)
    foot = [[body - 0.004, 0], [body - 0.001, 0.002], [body, 0.005]]
    top = [[neck, 0.9 * height], [cap, 0.9 * height + 0.001], [cap, height - 0.001], [cap - 0.002, height]]
    return settle(_solid(np.concatenate([foot, curve, top])))


def cone(rng: np.random.Generator) -> Mesh:
    """Truncated cone or cylinder."""
    low = rng.uniform(0.05, 0.12)
    high = low * rng.uniform(0.2, 1.0)
    return settle(_solid(np.array([[low, 0.0], [high, rng.uniform(0.08, 0.24)]])))


def cup(rng: np.random.Generator) -> Mesh:
    """Tumbler with a wall, open at the top."""
    return settle(_vessel(rng.uniform(0.09, 0.16), rng.uniform(0.03, 0.045), rng.uniform(0.046, 0.065)))


def _vessel(height: float, foot: float, rim: float) -> Mesh:
    """Straight-walled open vessel, 3.5 mm thick."""
    z = np.linspace(0, height, 24)
    return _hollow(np.stack([foot + (rim - foot) * z / height, z], axis=1), wall=0.0035, floor=0.006)


def bowl(rng: np.random.Generator) -> Mesh:
    """Round bowl on a foot."""
    radius, depth = rng.uniform(0.07, 0.14), rng.uniform(0.05, 0.09)
    foot = 0.4 * radius
    angle = np.linspace(0, np.pi / 2, 28)
    curve = np.stack([foot + (radius - foot) * np.sin(angle), 0.008 + depth * (1 - np.cos(angle))], axis=1)
    return settle(_hollow(np.concatenate([[[foot, 0.0]], curve]), wall=0.004, floor=0.012))


def mug(rng: np.random.Generator) -> Mesh:
    """Mug with a handle."""
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
    """Organic lump: a sphere whose radius is swayed by smooth random waves, with a flattened underside."""
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
    """Two balls on a bar, standing on one of them."""
    radius, length = rng.uniform(0.03, 0.05), rng.uniform(0.12, 0.19)
    path = np.linspace([0, 0, radius], [0, 0, radius + length], 5)
    other = shift(ball(radius * rng.uniform(0.6, 1.0)), z=length)
    return settle(join(ball(radius), tube(path, radius * rng.uniform(0.25, 0.5), (0, 1, 0)), other))
