"""How fast raw frames become depth, confidence and flags, and how often each way to unwrap fails in the dark.

    python benchmarks/decode.py [--seconds 4]

One core, CPU time: 8 x 180 x 240 uint16 with the range errors, lamp offset and temperature of a real sensor. Beside the decoder
stands a plain numpy script (float32 where numpy keeps it, ``arctan2``, no flags), measured in turns in the same run. The second table counts wrong wraps on frames of a synthetic room.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tofcapture.camera import Camera
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import (
    Decoder,
    ambiguity,
    frequencies,
    radial_to_range,
    radius_px,
    taps,
    unwrap,
    unwrap_spatial,
)
from tofcapture.rig import RangeError

CAMERA = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
LIGHT = np.array([0.007, 0.0, 0.0])
ERRORS = (
    RangeError(20e6, -0.01428, -0.0063),
    RangeError(100e6, -0.7427, -0.016, ((2, -0.006, 0.0012), (4, -0.0007, 0.0002)), 1.54e-4, -1.8e-4),
)
INFO = TofInfo("benchmark", "0", CAMERA, LIGHT, range_errors=ERRORS)
LOW, HIGH = (ambiguity(f) for f in frequencies(INFO.modulation_hz))
CELSIUS = 48.5


def room() -> np.ndarray:
    """(H, W) distances along the rays: a tilted floor, a back wall, three boxes, one of them a wrap before the wall."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = np.minimum(3.2 + 0.002 * u, 90 / (v + 12.0) + 0.6)
    for top, left, size, distance in ((60, 30, 40, 0.9), (90, 110, 50, 1.4), (40, 180, 35, 1.75)):
        box = (v >= top) & (v < top + size) & (u >= left) & (u < left + size)
        depth = np.where(box, distance + 0.001 * (u - left), depth)
    return CAMERA.depth_to_radial(depth)


def frame(rng: np.random.Generator, errors: tuple[RangeError, ...] = ERRORS) -> np.ndarray:
    """(8, H, W) uint16 of the room, white surfaces, shot and read noise."""
    radial = room()
    range_ = radial_to_range(radial, CAMERA, LIGHT)
    amplitude = 300 / radial**2
    by_hz = {e.modulation_hz: e for e in errors}
    z = []
    for f, contrast in zip((20e6, 100e6), (0.85, 0.6), strict=True):
        phase = 2 * np.pi * range_ / ambiguity(f)
        error = by_hz.get(f, RangeError(f)).at(phase, radius_px(CAMERA), CELSIUS)
        z.append(contrast * amplitude * np.exp(1j * (phase + 2 * np.pi * error / ambiguity(f))))
    mean = np.broadcast_to(amplitude + 20, (2, *CAMERA.shape))
    clean = taps(np.stack(z), mean, INFO.modulation_hz, INFO.phase_rad)
    raw = rng.poisson(16 * np.maximum(clean, 0)) / 16 + 1.25 * rng.standard_normal(clean.shape)
    return np.clip(np.rint(raw), 0, 4095).astype(np.uint16)


def peer(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A plain numpy script of the published steps (method.md 0.4): no flags but saturation, one step of correction."""
    c = raw.astype(np.float32)
    u, v = np.meshgrid(np.arange(240, dtype=np.float32), np.arange(180, dtype=np.float32))
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    radius = np.hypot(u - CAMERA.cx, v - CAMERA.cy)
    low, high = (np.mod(np.arctan2(c[i + 3] - c[i + 1], c[i] - c[i + 2]), 2 * np.pi) for i in (0, 4))
    d20 = LOW * low / (2 * np.pi)
    d20 = d20 + 0.01428 + 0.0063 * d20
    d100 = HIGH * high / (2 * np.pi) + 0.7427 - 1.54e-4 * radius + 1.8e-4 * (CELSIUS - 45)
    phase = 2 * np.pi * d100 / HIGH
    d100 = d100 + 0.016 * d100 + 0.006 * np.cos(2 * phase) - 0.0012 * np.sin(2 * phase)
    d100 = np.mod(d100 + 0.0007 * np.cos(4 * phase) - 0.0002 * np.sin(4 * phase), HIGH)
    far = d100 + HIGH * np.mod(np.round((d20 - d100) / HIGH), 5)
    length = np.sqrt(x**2 + y**2 + 1)
    z = 2 * far / (length + np.sqrt((0.007 / far - x) ** 2 + y**2 + 1))
    z[(raw >= 4095).any(axis=0)] = np.nan
    return z, np.hypot(c[4] - c[6], c[7] - c[5]) / 2


def rates(ways: dict[str, Callable[[], object]], seconds: float) -> dict[str, tuple[float, float]]:
    """Calls per second of CPU of each way: undisturbed (fastest twentieth of the calls) and median; ways take turns."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(10):
        for name, way in ways.items():
            begin = time.process_time()
            while (start := time.process_time()) - begin < seconds / 10:
                way()
                times[name].append(time.process_time() - start)
    return {name: (1 / float(np.quantile(t, 0.05)), 1 / float(np.median(t))) for name, t in times.items()}


def wrong_wraps(amplitude: float, rng: np.random.Generator, frames: int = 4) -> list[float]:
    """Share of pixels in a wrong wrap: rounding, with neighbours, at so many tap sigmas."""
    truth = radial_to_range(room(), CAMERA, LIGHT)
    counts = np.zeros(2)
    for _ in range(frames):
        z = np.stack(
            [a * amplitude * np.exp(2j * np.pi * truth / R) for a, R in ((0.85 / 0.6, LOW), (1.0, HIGH))]
        )
        # A phasor of four taps has their noise over the root of two in each part.
        z += (rng.standard_normal(z.shape) + 1j * rng.standard_normal(z.shape)) / np.sqrt(2)
        low, high = (
            np.mod(np.angle(p), 2 * np.pi) * R / (2 * np.pi) for p, R in zip(z, (LOW, HIGH), strict=True)
        )
        found = (
            unwrap(low, high, HIGH, LOW),
            unwrap_spatial(low, high, np.abs(z), HIGH, LOW, 1.0),
        )
        counts += [(np.abs(way - truth) > HIGH / 2).mean() for way in found]
    return [float(c) for c in counts / frames]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="of CPU per way")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    raw, decoder = frame(rng), Decoder(INFO)
    with np.errstate(all="ignore"):
        found, plain = decoder(raw, CELSIUS), peer(raw)[0]
        speed = rates(
            {
                "Decoder: depth, confidence, flags": lambda: decoder(raw, CELSIUS),
                "plain numpy script": lambda: peer(raw),
            },
            args.seconds,
        )
    truth = CAMERA.radial_to_depth(room())
    print(
        f"8 x 180 x 240 uint16, frames/s of one core\n{'':34} {'undisturbed':>12} {'median':>8} {'decoder is faster':>18}"
    )
    base = speed["Decoder: depth, confidence, flags"][0]
    for name, (fast, median) in speed.items():
        print(f"{name:34} {fast:12.0f} {median:8.0f} {base / fast:17.1f}x")
    for name, depth in (("decoder", found.depth), ("plain script", plain)):
        error = 1e3 * np.abs(depth - truth)
        print(f"{name} - scene: median {np.nanmedian(error):.2f} mm (noise of one frame included)")
    print(f"\nwrong wraps, %\n{'amplitude / tap sigma':>22} {'rounding':>9} {'neighbours':>11}")
    for amplitude in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0):
        row = [100 * share for share in wrong_wraps(amplitude, rng)]
        print(f"{amplitude:22.1f} {row[0]:9.3f} {row[1]:11.3f}")


if __name__ == "__main__":
    main()
