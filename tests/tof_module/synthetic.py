"""What the simulated module sees: a tilted, rippled wall, and noise; the same for the same seed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.tof_serial.messages import Info
from tofcapture.devices.tof_serial.packet import whiten
from tofcapture.rig import SPEED_OF_LIGHT

Source = Callable[[int, int], tuple[NDArray[np.uint16], float]]
"""(burst, frame) -> raw (K, H, W) uint16 and degrees Celsius."""


def simulated_info(width: int = 240, height: int = 180, boot: int = 1, **changes: object) -> Info:
    """Describe a module like the one of the reference capture: 20 and 100 MHz, four phases each, 12 bits, 30 Hz."""
    values: dict[str, object] = {
        "firmware": (1, 0),
        "boot": boot,
        "width": width,
        "height": height,
        "bits": 12,
        "frames": 16,
        "chunk": 16384,
        "exposure_us": 400,
        "period_us": 33_333,
        "intrinsics": (
            round(0.794 * width * 65536),
            round(1.115 * height * 65536),
            round((width - 1) / 2 * 65536),
            round((height - 1) / 2 * 65536),
        ),
        "illuminator_um": (7000, 0, 0),
        "hz": (20_000_000,) * 4 + (100_000_000,) * 4,
        "phase": (0, 16384, 32768, 49152) * 2,
        "model": "simulated module",
        "serial": "sim-0001",
    }
    return Info(**(values | changes))  # type: ignore[arg-type]


def synthetic(info: Info, seed: int) -> Source:
    """Make a source of frames: ``C_k = B + A cos(4 pi f r / c + theta_k)`` of a wall about 0.8 m away."""
    v, u = np.mgrid[0 : info.height, 0 : info.width]
    r = 0.8 + 0.2 * u / info.width + 0.02 * np.sin(12 * v / info.height)
    phase = 4 * np.pi * r / SPEED_OF_LIGHT
    theta = np.asarray(info.phase) * 2 * np.pi / 65536
    wave = np.cos(np.asarray(info.hz)[:, None, None] * phase + theta[:, None, None])
    clean = 900 + 350 * wave / r**2

    def frame(burst: int, index: int) -> tuple[NDArray[np.uint16], float]:
        rng = np.random.default_rng([seed, burst, index])
        noisy = clean + 4 * rng.standard_normal(clean.shape)
        return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16), round(45 + 0.1 * index, 2)

    return frame


def whitened(data: bytes, offset: int = 0) -> bytes:
    """Whiten a copy of bytes that begin at ``offset`` of their frame."""
    out = np.frombuffer(data, dtype=np.uint8).copy()
    whiten(out, offset)
    return out.tobytes()
