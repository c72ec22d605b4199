"""The ToF camera's electronics: from light to 12-bit taps, one imperfection after the other.

Every effect has its own switch; :func:`ideal` turns all of them off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT, Reach, check_channels, frequencies
from tofcapture.devices.sim.light import Light
from tofcapture.errors import ConfigError, DataError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.ops.phase import Complex128
from tofcapture.poses import Float64
from tofcapture.rig import RangeError, image_places, packed_table, radius_px

_FEW = 200.0  # electrons; below, shot noise is drawn from the Poisson distribution itself


@dataclass(frozen=True)
class Sensor:
    """Constants of the sensor; docs/simulator.md explains where they come from."""

    modulation_hz: tuple[float, ...] = PAPER_MODULATION_HZ  #: (K,) of each raw channel.
    phase_rad: tuple[float, ...] = PAPER_PHASE_RAD  #: (K,) demodulation phase of each raw channel.
    #: Raw units that white, facing, at 1 m adds to a tap in the nominal exposure; one, or (F,) ascending.
    signal: tuple[float, ...] = (280.0,)
    offset: bool = True  #: Taps have one; without, they are differences of two wells, signed.
    reach: Reach | None = None  #: Ranges that the camera is to decode, metres.
    phase_table: float = (
        0.0  #: Radians; size of the phase offset of each pixel and frequency that the maker knows.
    )
    contrast: tuple[float, ...] = (0.85, 0.6)  #: (F,) A / B of each frequency, ascending.
    exposure: float = 400e-6  #: Seconds; the signal scales with its ratio to the nominal one.
    nominal_exposure: float = 400e-6
    ambient: float = 20.0  #: Raw units added to each tap, not modulated.
    electrons_per_unit: float = 16.0  #: Photo-electrons per raw unit.
    read_noise: float = 20.0  #: Electrons, standard deviation, per tap.
    full_scale: float = 4095.0  #: Largest raw value; taps clip there.
    range_errors: tuple[RangeError, ...] = ()  #: True systematic error of each frequency.
    #: ``(m, a_m)``: the correlation waveform is ``cos x + sum a_m cos m x``; square waves have 1/9, 1/25.
    harmonics: tuple[tuple[int, float], ...] = ()
    pixel_offset: float = 0.0005  #: Standard deviation of the fixed range offset of each pixel, metres.
    scattering: float = 0.004  #: Share of the light that the lens scatters.
    scattering_radius: float = 0.15  #: Scale of its halo as a share of the image width.
    celsius: float = 45.0  #: Mean temperature.
    celsius_drift: float = 0.3  #: Standard deviation of its wander from frame to frame.
    quantise: bool = True  #: Round to whole raw units and clip at ``full_scale``; otherwise raw is float64.
    shot_noise: bool = True  #: Draw Poisson numbers of electrons.


def check_sensor(sensor: Sensor, where: str) -> None:
    """Refuse channels that no decoder could take, and range errors of frequencies that the sensor does not have.

    :class:`ConfigError` names the key and what it should hold.
    """
    hz, phases = sensor.modulation_hz, sensor.phase_rad
    try:
        check_channels(hz, phases, offset=sensor.offset, reach=sensor.reach, where=where)
    except DataError as err:
        raise ConfigError(err.message, err.hint) from err
    F = len(frequencies(hz))
    if len(sensor.contrast) != F or len(sensor.signal) not in (1, F):
        raise ConfigError(
            f"{where}: expected a contrast, and one signal or as many, for each of {F} frequencies, "
            f"got {len(sensor.contrast)} and {len(sensor.signal)}"
        )
    foreign = [e.modulation_hz for e in sensor.range_errors if e.modulation_hz not in hz]
    if foreign:
        raise ConfigError(
            f"{where}: range_error of {', '.join(f'{f / 1e6:g}' for f in foreign)} MHz, which no channel has",
            hint="give [[range_error]] tables of the frequencies that modulation_hz names, or range_error = []",
        )


def with_phase_table(sensor: Sensor, camera: Camera) -> Sensor:
    """Give every frequency a phase offset of each pixel, smooth, of the size that ``phase_table`` says."""
    if not sensor.phase_table:
        return sensor
    x, y = np.moveaxis(image_places(camera), -1, 0)
    known = {e.modulation_hz: e for e in sensor.range_errors}
    errors = []
    for k, hz in enumerate(frequencies(sensor.modulation_hz)):
        turned = 0.6 * np.cos(2 * x + k) + 0.4 * np.sin(3 * y + 2 * k)
        metres = sensor.phase_table * turned * SPEED_OF_LIGHT / (4 * np.pi * hz)
        errors.append(replace(known.get(hz, RangeError(hz)), table=packed_table(metres)))
    return replace(sensor, range_errors=tuple(errors))


def ideal(sensor: Sensor) -> Sensor:
    """Return the same sensor with every imperfection off; taps are exact and float64."""
    off: dict[str, Any] = dict.fromkeys(
        ("ambient", "read_noise", "pixel_offset", "scattering", "celsius_drift"), 0.0
    )
    return replace(
        sensor, **off, range_errors=(), phase_table=0.0, harmonics=(), quantise=False, shot_noise=False
    )


@lru_cache(maxsize=4)
def _halo_spectrum(H: int, W: int, radius: float) -> tuple[Complex128, tuple[int, int]]:
    """Compute the spectrum of the halo, and the size of the transform.

    Only the image itself is kept of the convolution, so a period of ``2 H - 1`` is enough: what wraps around falls outside.
    """
    from scipy.fft import next_fast_len, rfft2

    v, u = np.mgrid[-H + 1 : H, -W + 1 : W]
    halo = 1 / (1 + (np.hypot(u, v) / (radius * W)) ** 2) ** 1.5
    shape = (next_fast_len(2 * H - 1), next_fast_len(2 * W - 1, real=True))
    return rfft2(halo / halo.sum(), shape), shape


def scatter(image: NDArray[Any], share: float, radius: float) -> NDArray[Any]:
    """Scatter an image (..., H, W), real or complex: ``z + share (z * h)`` with a Lorentzian halo h of unit sum.

    ``radius`` is the halo's half width as a share of the image width (method.md 4.4).
    """
    if share == 0:
        return image
    if np.iscomplexobj(image):
        return scatter(image.real, share, radius) + 1j * scatter(image.imag, share, radius)
    from scipy.fft import irfft2, rfft2

    H, W = image.shape[-2:]
    spectrum, shape = _halo_spectrum(H, W, radius)
    spread = irfft2(rfft2(image, shape) * spectrum, shape)[..., H - 1 : 2 * H - 1, W - 1 : 2 * W - 1]
    out: NDArray[Any] = image + share * spread
    return out


def expose(
    light: Light, sensor: Sensor, info: TofInfo, frames: int, rng: np.random.Generator, serial: int
) -> tuple[NDArray[Any], Float64]:
    """Take a static burst.

    ``light`` is what reaches the pixels, ``info`` has channels and intrinsics, ``rng`` draws the noise of this burst. ``serial``
    seeds what is fixed in this one camera: the offset of each pixel. Returns raw (frames, K, H, W), uint16, int16 of taps without an offset, or float64 when
    the sensor does not quantise, and the temperatures (frames,).
    """
    celsius = sensor.celsius + sensor.celsius_drift * rng.standard_normal(frames)
    F = len(light.phasor)
    gain = (np.resize(sensor.signal, F) * sensor.exposure / sensor.nominal_exposure)[:, None, None]
    phasor = scatter(light.phasor, sensor.scattering, sensor.scattering_radius) * gain
    steady = scatter(light.steady, sensor.scattering, sensor.scattering_radius) * gain
    phasor = phasor * np.asarray(sensor.contrast)[:, None, None]
    fixed = np.random.default_rng([serial, 1]).standard_normal(info.camera.shape) * sensor.pixel_offset
    mean = steady + sensor.ambient
    taps: NDArray[Any] = _taps(phasor, mean, sensor, info, fixed, celsius)
    if sensor.offset:
        taps = _noisy(taps, sensor, rng)
    else:
        hz = frequencies(info.modulation_hz)
        other = 2 * mean[[hz.index(f) for f in info.modulation_hz]] - taps
        taps = _noisy(taps, sensor, rng) - _noisy(other, sensor, rng)
    if not sensor.quantise:
        return taps.astype(np.float64, copy=False), celsius
    least, kind = (0, np.uint16) if sensor.offset else (-sensor.full_scale, np.int16)
    return np.clip(np.rint(taps), least, sensor.full_scale).astype(kind), celsius


def _noisy(taps: Float64, sensor: Sensor, rng: np.random.Generator) -> NDArray[Any]:
    """Add shot and read noise to taps, from one draw of normal numbers.

    The sum of a Poisson number of mean L and read noise of variance s^2 has mean L, variance V = L + s^2 and third
    cumulant L. The normal number z is bent to have all three (Cornish and Fisher): ``L + sqrt(V) z + L / (6 V) (z^2 - 1)``.
    Where few electrons arrive, the Poisson number itself is drawn.
    """
    if not (sensor.shot_noise or sensor.read_noise):
        return taps
    mean = np.maximum(taps * sensor.electrons_per_unit, 0).astype(np.float32)
    shot = mean if sensor.shot_noise else np.zeros((), np.float32)
    z = rng.standard_normal(mean.shape, dtype=np.float32)
    variance = shot + np.float32(sensor.read_noise**2)
    out = mean + np.sqrt(variance) * z
    if sensor.shot_noise:
        out += shot / (6 * np.maximum(variance, np.float32(1e-6))) * (z * z - 1)
        few = np.nonzero(mean < _FEW)
        out[few] = rng.poisson(mean[few]) + np.float32(sensor.read_noise) * z[few]
    raw: NDArray[np.float32] = out / np.float32(sensor.electrons_per_unit)
    return raw


def _taps(
    phasor: Complex128, mean: Float64, sensor: Sensor, info: TofInfo, fixed: Float64, celsius: Float64
) -> Float64:
    """Compute noise-free taps (frames, K, H, W) of a burst, of one well, about the mean taps (F, H, W).

    Temperature turns all phases of a frequency by one angle a frame, so cosines are taken once a burst.
    """
    hz = frequencies(info.modulation_hz)
    amplitude, phase = np.abs(phasor), np.mod(np.angle(phasor), 2 * np.pi)
    radius, place = radius_px(info.camera), image_places(info.camera)
    by_hz = {e.modulation_hz: e for e in sensor.range_errors}
    out = np.empty((len(celsius), len(info.modulation_hz), *mean.shape[1:]))
    for i, f in enumerate(hz):
        error = by_hz.get(f, RangeError(f))
        turn = 4 * np.pi * f / SPEED_OF_LIGHT
        wrong = error.at(phase[i], radius, error.reference_celsius, place, amplitude[i])
        late = phase[i] + turn * (fixed + wrong)
        warm = turn * error.per_kelvin * (celsius - error.reference_celsius)
        for k in np.flatnonzero(np.asarray(info.modulation_hz) == f):
            x = late + info.phase_rad[k]
            out[:, k] = mean[i] + amplitude[i] * _wave(x, warm, sensor.harmonics)
    return out


def _wave(x: Float64, warm: Float64, harmonics: tuple[tuple[int, float], ...]) -> Float64:
    """Evaluate the correlation waveform (frames, H, W) at ``x (H, W) + warm (frames,)``."""
    total = np.zeros((len(warm), *x.shape))
    for m, a in ((1, 1.0), *harmonics):
        cosine, sine = a * np.cos(m * x), a * np.sin(m * x)
        total += np.cos(m * warm)[:, None, None] * cosine - np.sin(m * warm)[:, None, None] * sine
    return total
