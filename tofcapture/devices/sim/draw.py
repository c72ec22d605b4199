"""Draw whole ToF cameras, so that a network learns cameras and not one of them: what ``simulate-dataset --cameras N`` simulates.

Half of them have the channels of a camera of cameras.toml, the others frequencies of their own. Everything else is drawn for each:
size, field of view, lens, lamp, contrast, light, noise, scattering, true range errors and how much of these the maker knows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tofcapture.channels import SPEED_OF_LIGHT, frequencies, unambiguous
from tofcapture.devices.sim.config import presets, read_constants

_NAMED = 0.5  # share of cameras with the channels of one that exists
_PAPER = 0.3  # of these with the paper's
_SIZES = {(240, 180): 0.4, (224, 172): 0.2, (160, 120): 0.2, (320, 240): 0.2}
_FIELD = (40.0, 95.0)  # degrees across
_STEEPEST = 0.6  # least slope of a lens's radius, so that no image folds
_REACH = 3.0  # m that a drawn set of frequencies tells apart, at least
_SQUARE = {3: 1 / 4, 4: 1 / 9}  # rad of wiggling by square waves, by the number of phases: Kahlmann, Lindner


def draw_camera(rng: np.random.Generator, preset: str | None = None) -> dict[str, dict[str, Any]]:
    """Draw a camera: tables ``tof``, ``lamp``, ``sensor`` and ``factory``, to be laid over constants.toml.

    With a ``preset`` of cameras.toml it has that camera's channels, image and lens.
    """
    channels = _named(rng, preset) if preset or rng.random() < _NAMED else _own(rng)
    hz = frequencies(channels["modulation_hz"])
    phases = len(channels["phase_rad"]) // len(hz)
    full_scale = float(channels.pop("full_scale", 2.0 ** rng.choice([11, 12, 12, 12, 14]) - 1))
    unit = full_scale / 4095
    signal = np.exp(rng.uniform(np.log(70), np.log(1100))) * unit
    sensor = {
        **channels,
        "full_scale": full_scale,
        "signal": [float(signal * np.exp(rng.normal(0, 0.1))) for _ in hz],
        "contrast": _contrast(hz, rng),
        "ambient": float(np.exp(rng.uniform(np.log(4), np.log(300))) * unit),
        "electrons_per_unit": float(np.exp(rng.uniform(np.log(5), np.log(40))) / unit),
        "read_noise": float(np.exp(rng.uniform(np.log(8), np.log(60)))),
        "scattering": float(np.exp(rng.uniform(np.log(5e-4), np.log(0.015)))),
        "scattering_radius": float(rng.uniform(0.08, 0.25)),
        "pixel_offset": float(rng.uniform(2e-4, 1e-3)),
        "range_error": [_range_error(f, phases, rng) for f in hz],
    }
    known = float(np.exp(rng.uniform(np.log(0.03), np.log(0.6))))
    factory = {
        "offset_error": float(np.exp(rng.uniform(np.log(2e-4), np.log(3e-3)))),
        "harmonics_error": known if rng.random() < 0.9 else 1.0,
        "slope_error": float(rng.uniform(0.02, 0.2)),
    }
    optics = _optics(rng)
    if preset:
        optics["tof"] = {"preset": preset, "illuminator": optics["tof"]["illuminator"]}
        del optics["lamp"]
    return {**optics, "sensor": sensor, "factory": factory}


def _named(rng: np.random.Generator, preset: str | None) -> dict[str, Any]:
    """Take the channels of a camera that exists; of the paper's more often than of each other."""
    name = preset or ("paper" if rng.random() < _PAPER else str(rng.choice(presets())))
    sensor = read_constants({"tof": {"preset": name}}, name).sensor
    return {
        "modulation_hz": list(sensor.modulation_hz),
        "phase_rad": list(sensor.phase_rad),
        "offset": sensor.offset,
        "full_scale": sensor.full_scale,
    }


def _own(rng: np.random.Generator) -> dict[str, Any]:
    """Draw one to three frequencies that tell some metres apart, of three or four phases."""
    while True:
        count = int(rng.choice([1, 2, 2, 2, 3]))
        each = np.sort(np.exp(rng.uniform(np.log(10e6), np.log(45e6 if count == 1 else 200e6), count)))
        if (each[1:] > 1.1 * each[:-1]).all() and unambiguous(tuple(each), 1.0) >= _REACH:
            break
    phases = int(rng.choice([3, 4, 4]))
    turn = [2 * np.pi * k / phases for k in range(phases)]
    return {
        "modulation_hz": [float(f) for f in each for _ in turn],
        "phase_rad": turn * count,
        "offset": True,
    }


def _contrast(hz: tuple[float, ...], rng: np.random.Generator) -> list[float]:
    """Let contrast fall as a low pass of 60 to 250 MHz does, and differ a little from that."""
    best, corner = rng.uniform(0.75, 0.95), np.exp(rng.uniform(np.log(60e6), np.log(250e6)))
    return [
        float(np.clip(best / np.hypot(1, f / corner) * np.exp(rng.normal(0, 0.06)), 0.1, 0.98)) for f in hz
    ]


def _range_error(hz: float, phases: int, rng: np.random.Generator) -> dict[str, Any]:
    """Draw true errors: an offset, wiggling between a sine's and a square wave's, a slope over the image, warmth."""
    metres = SPEED_OF_LIGHT / (4 * np.pi * hz)
    size, turn = rng.uniform(0, _SQUARE.get(phases, 1 / 9)), rng.uniform(0, 2 * np.pi)
    slight = rng.normal(0, 0.004, 2)
    return {
        "modulation_hz": hz,
        "offset": float(rng.normal(0, 0.03)),
        "harmonics": [
            [phases, float(metres * size * np.cos(turn)), float(metres * size * np.sin(turn))],
            [2, float(metres * slight[0]), float(metres * slight[1])],
        ],
        "per_pixel_radius": float(rng.normal(0, 1.5e-4)),
        "per_kelvin": float(rng.normal(0, 2e-4)),
        "reference_celsius": 45.0,
    }


def _optics(rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Draw image, lens, and a lamp beside it that lights the image more or less."""
    sizes = list(_SIZES)
    width, height = sizes[int(rng.choice(len(sizes), p=list(_SIZES.values())))]
    across = np.radians(rng.uniform(*_FIELD))
    fx = width / 2 / np.tan(across / 2)
    corner = np.hypot(width, height) / 2 / fx
    distortion: list[float] = []
    if rng.random() < 0.4:  # r (1 + k r^2) must not fold within the image, nor bend it beyond use
        limit = (1 - _STEEPEST) / (3 * corner**2)
        distortion = [float(rng.uniform(max(-0.35, -limit), min(0.35, limit))), 0.0, 0.0, 0.0, 0.0]
    beside, turn = rng.uniform(0.005, 0.06), rng.uniform(0, 2 * np.pi)
    tof = {
        "width": width,
        "height": height,
        "fx": float(fx),
        "fy": float(fx * np.exp(rng.normal(0, 0.02))),
        "cx": float((width - 1) / 2 + rng.normal(0, 0.015) * width),
        "cy": float((height - 1) / 2 + rng.normal(0, 0.015) * height),
        "distortion": distortion,
        "illuminator": [float(beside * np.cos(turn)), float(beside * np.sin(turn)), 0.0],
    }
    lamp = {
        "half_angle": float(np.arctan(corner) * rng.uniform(0.8, 1.3)),
        "edge": float(rng.uniform(0.1, 0.4)),
    }
    return {"tof": tof, "lamp": lamp}
