"""The ToF camera's electronics: from light to 12-bit taps, one imperfection after the other.

Every effect has its own switch; :func:`ideal` turns all of them off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.sim.light import Light
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import Complex128, frequencies, radius_px
from tofcapture.poses import Float64
from tofcapture.rig import RangeError


@dataclass(frozen=True)
class Sensor:
    """Constants of the sensor; docs/simulator.md explains where they come from.

    Attributes
    ----------
    signal
        Raw units that a white surface (albedo 1) facing the camera at 1 m adds to each tap in the nominal exposure.
    contrast
        (F,) demodulation contrast A / B of each frequency, ascending.
    exposure, nominal_exposure
        Seconds; the signal scales with their ratio.
    ambient
        Raw units added to each tap, not modulated.
    electrons_per_unit
        Photo-electrons per raw unit.
    read_noise
        Electrons, standard deviation, per tap.
    full_scale
        Largest raw value; taps clip there.
    range_errors
        True systematic error of each frequency (offset, wiggling, radius, temperature).
    harmonics
        ``(m, a_m)``: the correlation waveform is ``cos x + sum a_m cos m x``; a square wave on a square wave has 1/9, 1/25.
    pixel_offset
        Standard deviation of the fixed range offset of each pixel, metres.
    scattering, scattering_radius
        Share of the light that the lens scatters, and the scale of its halo as a share of the image width.
    celsius, celsius_drift
        Mean temperature and standard deviation of its frame-to-frame wander.
    quantise
        Round to whole raw units and clip at ``full_scale``; otherwise raw is float64.
    shot_noise
        Draw Poisson numbers of electrons.
    """

    signal: float = 280.0
    contrast: tuple[float, ...] = (0.85, 0.6)
    exposure: float = 400e-6
    nominal_exposure: float = 400e-6
    ambient: float = 20.0
    electrons_per_unit: float = 16.0
    read_noise: float = 20.0
    full_scale: float = 4095.0
    range_errors: tuple[RangeError, ...] = ()
    harmonics: tuple[tuple[int, float], ...] = ()
    pixel_offset: float = 0.0005
    scattering: float = 0.004
    scattering_radius: float = 0.15
    celsius: float = 45.0
    celsius_drift: float = 0.3
    quantise: bool = True
    shot_noise: bool = True


def ideal(sensor: Sensor) -> Sensor:
    """Return the same sensor with every imperfection off; taps are exact and float64."""
    return replace(
        sensor,
        ambient=0.0,
        read_noise=0.0,
        range_errors=(),
        harmonics=(),
        pixel_offset=0.0,
        scattering=0.0,
        celsius_drift=0.0,
        quantise=False,
        shot_noise=False,
    )


def scatter(image: NDArray[Any], share: float, radius: float) -> NDArray[Any]:
    """Lens scattering: ``z + share (z * h)`` with a broad Lorentzian halo h of unit sum (method.md 4.4).

    Parameters
    ----------
    image
        (..., H, W) real or complex.
    share
        Scattered energy.
    radius
        Half width of the halo as a share of the image width.
    """
    if share == 0:
        return image
    H, W = image.shape[-2:]
    v, u = np.mgrid[-H + 1 : H, -W + 1 : W]
    halo = 1 / (1 + (np.hypot(u, v) / (radius * W)) ** 2) ** 1.5
    shape = (3 * H - 2, 3 * W - 2)
    spectrum = np.fft.fft2(halo / halo.sum(), shape)
    spread = np.fft.ifft2(np.fft.fft2(image, shape) * spectrum)[..., H - 1 : 2 * H - 1, W - 1 : 2 * W - 1]
    out: NDArray[Any] = image + share * (spread if np.iscomplexobj(image) else spread.real)
    return out


def expose(
    light: Light, sensor: Sensor, info: TofInfo, frames: int, rng: np.random.Generator, serial: int
) -> tuple[NDArray[Any], Float64]:
    """Take a static burst.

    Parameters
    ----------
    light
        What reaches the pixels.
    sensor
        The electronics.
    info
        Channels and intrinsics of the camera.
    frames
        Frames in the burst.
    rng
        Noise of this burst.
    serial
        Seeds what is fixed in this one camera: the offset of each pixel.

    Returns
    -------
    raw
        (frames, K, H, W) uint16, or float64 when the sensor does not quantise.
    celsius
        (frames,) temperature.
    """
    celsius = sensor.celsius + sensor.celsius_drift * rng.standard_normal(frames)
    gain = sensor.signal * sensor.exposure / sensor.nominal_exposure
    phasor = scatter(light.phasor, sensor.scattering, sensor.scattering_radius) * gain
    steady = scatter(light.steady, sensor.scattering, sensor.scattering_radius) * gain
    phasor = phasor * np.asarray(sensor.contrast)[:, None, None]
    fixed = np.random.default_rng([serial, 1]).standard_normal(info.camera.shape) * sensor.pixel_offset
    taps = np.stack([_taps(phasor, steady + sensor.ambient, sensor, info, fixed, float(t)) for t in celsius])
    electrons = taps * sensor.electrons_per_unit
    if sensor.shot_noise:
        electrons = rng.poisson(np.maximum(electrons, 0)).astype(np.float64)
    if sensor.read_noise:
        electrons = electrons + sensor.read_noise * rng.standard_normal(electrons.shape)
    raw = electrons / sensor.electrons_per_unit
    if sensor.quantise:
        return np.clip(np.rint(raw), 0, sensor.full_scale).astype(np.uint16), celsius
    return raw, celsius


def _taps(
    phasor: Complex128, mean: Float64, sensor: Sensor, info: TofInfo, fixed: Float64, celsius: float
) -> Float64:
    """Noise-free taps (K, H, W) of one frame."""
    hz = frequencies(info.modulation_hz)
    amplitude, phase = np.abs(phasor), np.mod(np.angle(phasor), 2 * np.pi)
    radius = radius_px(info.camera)
    by_hz = {e.modulation_hz: e for e in sensor.range_errors}
    late = []
    for i, f in enumerate(hz):
        error = fixed + (by_hz[f].at(phase[i], radius, celsius) if f in by_hz else 0.0)
        late.append(phase[i] + 4 * np.pi * f / 299_792_458.0 * error)
    out = []
    for f, theta in zip(info.modulation_hz, info.phase_rad, strict=True):
        i = hz.index(f)
        x = late[i] + theta
        wave = np.cos(x)
        for m, a in sensor.harmonics:
            wave = wave + a * np.cos(m * x)
        out.append(mean + amplitude[i] * wave)
    return np.stack(out)
