"""How fast raw frames become depth, confidence and flags, and how often each way to unwrap fails in the dark.

    python benchmarks/decode.py [--seconds 4] [--frames 4] [--points ../shared/realdata/azure_kinect_phases]

One core, CPU time: 8 x 180 x 240 uint16 with the range errors, lamp offset and temperature of a real sensor. Beside the decoder
stands a plain numpy script (float32 where numpy keeps it, ``arctan2``, no flags), measured in turns in the same run. The second
table counts wrong wraps of every camera of the simulator, against the likelihood of all vectors there are. The third breaks a
tap of every camera, at three levels of noise that no decoder is told. The last decodes real points, where their folder is.
"""

from __future__ import annotations

import argparse
import os
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from tofcapture.camera import Camera
from tofcapture.channels import unambiguous
from tofcapture.devices.sim.config import read_constants
from tofcapture.frames import TofFlag, TofInfo
from tofcapture.ops.phase import (
    Decoder,
    TapNoise,
    ambiguity,
    float32,
    frequencies,
    radial_to_range,
    radius_px,
    reference,
    taps,
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
SIGMAS = (2.0, 5.0, 20.0)  # amplitudes in standard deviations of a tap
FAR = 15.0  # m
STUCK = (0, 60, 100, 250, 500, 1000, 4000)
# The author's fit of a real Azure Kinect: frequencies, and offset and slope of their phases along a row, in turns.
KINECT_HZ = tuple(299_792_458 / 2 / R for R in (2.7980018, 0.7824560, 0.7618528))
KINECT_OFFSETS = (-0.4306281, 0.5063031, 0.5523268)
KINECT_SLOPES = (-0.0006160847, -0.0021119791, -0.0022633219)


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


def cameras() -> dict[str, tuple[TofInfo, float]]:
    """Every camera of cameras.toml, at the benchmark's size, and how far it is asked to look: 15 m, or what its set can tell."""
    out = {}
    names = tomllib.loads((files("tofcapture.devices.sim") / "cameras.toml").read_text(encoding="utf-8"))
    for name in names:
        sensor = read_constants({"tof": {"preset": name}}, name).sensor
        hz = frequencies(sensor.modulation_hz)
        far = min(unambiguous(hz), FAR)
        errors = tuple(replace(e, table="") for e in sensor.range_errors)
        channels = sensor.modulation_hz, sensor.phase_rad
        out[name] = (
            TofInfo(
                name, "", CAMERA, np.zeros(3), *channels, saturation=1e6, range_errors=() if name == "paper" else errors,
                offset=sensor.offset, reach=(0.0, far) if far < unambiguous(hz) else None,
            ),
            far,
        )  # fmt: skip
    return out


def surfaces(far: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) ranges of a floor, a wall and boxes that fill what a camera can tell apart, placed at random."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    out = far * (0.95 - 0.25 * v / CAMERA.height - 0.05 * u / CAMERA.width)
    for _ in range(12):
        top, left = rng.integers(0, CAMERA.height - 40), rng.integers(0, CAMERA.width - 50)
        box = (v >= top) & (v < top + rng.integers(25, 60)) & (u >= left) & (u < left + rng.integers(25, 70))
        out = np.where(box, rng.uniform(0.05, 0.95) * far + 2e-4 * far * (u - left), out)
    return out


def exposed(
    info: TofInfo, range_: np.ndarray, amplitude: float, rng: np.random.Generator, clock: float = 0.0
) -> np.ndarray:
    """(K, H, W) taps at so many standard deviations of a tap, of a camera whose frequencies run fast by the share ``clock``."""
    z = [
        amplitude * np.exp(2j * np.pi * range_ * (1 + clock) / ambiguity(f))
        for f in frequencies(info.modulation_hz)
    ]
    mean = np.full((len(z), *range_.shape), 2.0 * amplitude * info.offset)
    clean = taps(np.stack(z), mean, info.modulation_hz, info.phase_rad)
    return clean + rng.standard_normal(clean.shape)


def unwrapping(rng: np.random.Generator, frames: int) -> None:
    """Print how often each camera takes another wrap than the true one."""
    print(
        f"\nwrong wraps, % of pixels (decoder with neighbours / exact likelihood of each pixel alone), {frames} frames"
    )
    print(f"{'camera':20} {'MHz':>20} {'m':>6} {'wraps':>7} " + "".join(f"{f'{a:g} sigma':>16}" for a in SIGMAS)
          + f"{'same choice':>13}{'clock 0.5 %':>13}{'0.1 % off':>11}{'frames/s':>9}")  # fmt: skip
    for name, (info, far) in cameras().items():
        hz = frequencies(info.modulation_hz)
        decoder = Decoder(info, TapNoise(np.inf, 1.0))
        cells, same = [], []
        for amplitude in SIGMAS:
            counts = np.zeros(3)
            for _ in range(frames):
                range_ = surfaces(far, rng)
                raw = exposed(info, range_, amplitude, rng)
                exact, found = reference.decode(raw, info), CAMERA.depth_to_radial(decoder(raw).depth)
                with patch.object(float32, "SURE", -np.inf):  # nobody is asked
                    alone = decoder.signals(raw)[1].ranges
                # Ranges, not depths: what is behind the camera is the same choice, and no depth.
                fused = (np.tensordot(decoder.wraps.lean, r, axes=1) for r in (alone, exact.ranges))
                counts += [
                    off(found, range_, decoder),
                    off(exact.radial, range_, decoder),
                    off(*fused, decoder),
                ]
            cells.append(" / ".join(f"{100 * c / frames:.3f}" for c in counts[:2]))
            same.append(1 - counts[2] / frames)
        shares = []
        for told, clock in ((1.005, 0.005), (1.0, 0.001)):
            there = replace(info, modulation_hz=tuple(told * f for f in info.modulation_hz), reach=None)
            range_ = surfaces(far / 1.01, rng)
            one = Decoder(there, TapNoise(np.inf, 1.0))
            found = CAMERA.depth_to_radial(one(exposed(info, range_, SIGMAS[-1], rng, clock)).depth)
            shares.append(100 * off(found, range_ * (1 + clock) / told, one))
        speed = rates({"": lambda raw=raw, decoder=decoder: decoder(raw)}, 0.4)[""][0]
        print(f"{name:20} {'/'.join(f'{f / 1e6:g}' for f in hz):>20} {far:6.2f} {len(decoder.wraps.tops):7d} "
              + "".join(f"{c:>16}" for c in cells) + f"{100 * min(same):12.4f}%{shares[0]:13.3f}{shares[1]:11.3f}{speed:9.0f}")  # fmt: skip


def off(found: np.ndarray, truth: np.ndarray, decoder: Decoder) -> float:
    """Share of the pixels whose range is another wrap's: beyond half of the highest frequency's, not counting whole periods."""
    period, U = decoder.wraps.period, ambiguity(max(decoder.info.modulation_hz))
    apart = np.abs((found - truth + period / 2) % period - period / 2)
    return float((~(apart < min(U, period) / 2 - 1e-6)).mean())


def stuck(rng: np.random.Generator) -> None:
    """Print of every camera, at a quarter of the noise, at it and at five times it, the least share of rows with a stuck tap that are flagged.

    Beside it stands the largest share elsewhere; of single frames and of bursts of eight, and how well the noise was measured.
    """
    print(
        f"\nstuck tap on 20 rows at {', '.join(map(str, STUCK))}: % of pixels flagged, least in the rows and most elsewhere\n"
        f"{'camera':20} {'noise':>6} {'frame':>8} {'elsewhere':>10} {'burst':>8} {'elsewhere':>10}"
    )
    for name, (camera, far) in cameras().items():
        info = replace(camera, saturation=4095.0)
        decoder, hz = Decoder(info), frequencies(info.modulation_hz)
        for factor in (0.25, 1.0, 5.0):
            least, most = np.full(2, 1.0), np.zeros(2)
            for value in STUCK:
                range_ = surfaces(min(far, 4.0), rng)
                amplitude = np.clip(300 / (range_ + 0.5) ** 2, 6, 1200)
                light = 1.4 * amplitude + 20
                z = np.stack([amplitude * np.exp(2j * np.pi * range_ / ambiguity(f)) for f in hz])
                mean = np.broadcast_to(light * info.offset, z.shape)
                clean = taps(z, mean, info.modulation_hz, info.phase_rad)
                sigma = factor * np.sqrt(light / 16 + 1.25**2)
                raw = np.rint(clean + sigma * rng.standard_normal((8, *clean.shape)))
                raw = raw.clip(0 if info.offset else -4095, 4095).astype(np.int16)
                whole = [decoder(raw[0]).flags, decoder.burst(raw).flags]
                raw[:, rng.integers(len(clean)), 80:100] = value
                broken = [decoder(raw[0]).flags, decoder.burst(raw).flags]
                for k in range(2):
                    rows, sound = broken[k][80:100], (whole[k], np.delete(broken[k], np.s_[80:100], 0))
                    least[k] = min(least[k], (rows & (TofFlag.INCONSISTENT | TofFlag.SATURATED) > 0).mean())
                    most[k] = max(most[k], *((s & TofFlag.INCONSISTENT > 0).mean() for s in sound))
            print(
                f"{name:20} {factor:6g} {100 * least[0]:8.2f} {100 * most[0]:10.4f} {100 * least[1]:8.2f} {100 * most[1]:10.4f}"
            )


def kinect_points(folder: Path) -> None:
    """Print what nine measured points of a real camera of three frequencies unwrap to."""
    U = np.array([ambiguity(f) for f in KINECT_HZ])
    rows = np.loadtxt(folder / "nfov.csv", delimiter=",", skiprows=1)
    x, tape, phase = rows[:, 0], rows[:, 1], rows[:, 2:][:, ::-1]
    offset, slope = np.array(KINECT_OFFSETS), np.array(KINECT_SLOPES)
    wrapped = (phase / (2 * np.pi) + offset + slope * x[:, None]) % 1 * U
    camera = Camera(9, 1, 1e9, 1e9, 4.0, 0.0)
    info = TofInfo(
        "", "", camera, np.zeros(3), tuple(f for f in KINECT_HZ for _ in range(3)), (0.0, 2.1, 4.2) * 3
    )
    z = 100 * np.exp(2j * np.pi * wrapped.T / U[:, None])[:, None]
    raw = taps(z, np.full(z.shape, 300.0), info.modulation_hz, info.phase_rad)
    found = Decoder(info)(raw).depth[0]
    print(f"\nnine points of a real camera: {(np.abs(found - tape) < U.min() / 2).sum()} of {len(tape)} wraps, "
          f"{1e3 * (found - tape).min():.0f} to {1e3 * (found - tape).max():.0f} mm")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=4.0, help="of CPU per way")
    parser.add_argument("--frames", type=int, default=4, help="of each camera and amplitude")
    parser.add_argument(
        "--points",
        type=Path,
        default=Path(__file__).resolve().parents[2] / "shared/realdata/azure_kinect_phases",
        help="folder of the nine real points",
    )
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
    unwrapping(rng, args.frames)
    stuck(rng)
    if args.points.is_dir():
        kinect_points(args.points)


if __name__ == "__main__":
    main()
