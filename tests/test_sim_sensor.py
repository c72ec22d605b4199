"""Each imperfection of the ToF electronics against its closed form, one switch at a time."""

from dataclasses import replace

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.devices.sim.light import Light
from tofcapture.devices.sim.sensor import Sensor, check_sensor, expose, ideal, scatter
from tofcapture.errors import ConfigError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import Decoder, mean_phasors, phasors, wrapped_range
from tofcapture.rig import SPEED_OF_LIGHT, RangeError

HZ = (20e6, 100e6)
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
INFO = TofInfo("test", "0", CAMERA, np.zeros(3))
CLEAN = ideal(Sensor())


def lit(range_, strength=0.5):
    """Light of a scene at the given range (H, W) and albedo / distance^2."""
    shape = np.broadcast_to(range_, CAMERA.shape)
    phase = 4 * np.pi * np.array(HZ)[:, None, None] * shape / SPEED_OF_LIGHT
    return Light(phasor=strength * np.exp(1j * phase), steady=np.full(CAMERA.shape, strength))


def take(sensor, light=None, frames=1, seed=0, serial=0):
    return expose(light or lit(1.0), sensor, INFO, frames, np.random.default_rng(seed), serial)


def ranges(raw):
    z = mean_phasors(raw, INFO.modulation_hz, INFO.phase_rad)
    return [wrapped_range(z[i], hz) for i, hz in enumerate(HZ)]


def test_ideal_is_exact():
    """Without imperfections the taps decode to the range within a nanometre, amplitude = contrast x signal."""
    raw, _ = take(CLEAN, lit(1.234))
    for r in ranges(raw):
        np.testing.assert_allclose(r, 1.234, atol=1e-9)
    z = phasors(raw[0], INFO.modulation_hz, INFO.phase_rad)
    np.testing.assert_allclose(np.abs(z[1]), 0.5 * CLEAN.signal[0] * CLEAN.contrast[1])


def test_exposure_scales_the_signal():
    """Half the exposure gives half the taps."""
    np.testing.assert_allclose(take(replace(CLEAN, exposure=200e-6))[0] * 2, take(CLEAN)[0])


def test_ambient_adds_to_every_tap_and_not_to_the_phasor():
    """Ambient light moves B only."""
    with_, without = take(replace(CLEAN, ambient=55.0))[0], take(CLEAN)[0]
    np.testing.assert_allclose(with_ - without, 55.0)


@pytest.mark.parametrize("hz", HZ)
def test_range_error_lengthens_by_what_it_says(hz):
    """Offset, wiggling, radius and temperature terms appear in the decoded range as RangeError gives them."""
    error = RangeError(hz, 0.004, 0.0, ((2, -0.006, 0.001), (4, 0.0007, 0.0)), 1e-4, -1.8e-4)
    r = np.linspace(0.3, 1.3, CAMERA.width)
    raw, celsius = take(replace(CLEAN, range_errors=(error,), celsius=51.0), lit(r))
    phase = np.broadcast_to(4 * np.pi * hz * r / SPEED_OF_LIGHT, CAMERA.shape)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    expected = r + error.at(phase, np.hypot(u - CAMERA.cx, v - CAMERA.cy), 51.0)
    np.testing.assert_allclose(ranges(raw)[HZ.index(hz)], expected, atol=1e-9)
    assert celsius[0] == 51.0


def test_temperature_moves_the_range():
    """0.18 mm per kelvin shorter, as the real sensor."""
    error = RangeError(100e6, per_kelvin=-1.8e-4)
    cold, hot = (
        ranges(take(replace(CLEAN, range_errors=(error,), celsius=t))[0])[1].mean() for t in (45.0, 55.0)
    )
    assert hot - cold == pytest.approx(-1.8e-3, abs=1e-9)


def test_square_waves_wiggle_four_times_per_cycle():
    """A square wave on a square wave (odd harmonics 1/m^2) errs by 0.0711 rad, four cycles per turn."""
    harmonics = tuple((m, 1 / m**2) for m in range(3, 400, 2))
    r = np.linspace(0, SPEED_OF_LIGHT / (2 * 100e6), 64, endpoint=False)
    raw, _ = take(replace(CLEAN, harmonics=harmonics), lit(r))
    z = mean_phasors(raw, INFO.modulation_hz, INFO.phase_rad)[1, 0]
    error = np.angle(z * np.exp(-4j * np.pi * 100e6 * r / SPEED_OF_LIGHT))
    assert np.abs(error).max() == pytest.approx(0.0711, abs=0.003)
    spectrum = np.abs(np.fft.rfft(error))
    assert spectrum.argmax() == 4


def test_pixel_offset_is_fixed_in_the_camera():
    """The fixed pattern has the stated spread, is the same in every burst of one camera and another in the next."""
    sensor = replace(CLEAN, pixel_offset=0.002)
    a, b, c = (ranges(take(sensor, seed=s, serial=n)[0])[1] - 1.0 for s, n in ((1, 7), (2, 7), (1, 8)))
    np.testing.assert_array_equal(a, b)
    assert a.std() == pytest.approx(0.002, rel=0.05)
    assert np.abs(a - c).max() > 1e-3


def test_scattering_is_a_convolution_that_keeps_its_energy():
    """Scattered light equals the direct sum over the halo, adds the stated share in the middle of a wide image, and zero is off."""
    rng = np.random.default_rng(0)
    image = rng.standard_normal((9, 11)) + 1j * rng.standard_normal((9, 11))
    v, u = np.mgrid[-8:9, -10:11]
    halo = 1 / (1 + (np.hypot(u, v) / (0.2 * 11)) ** 2) ** 1.5
    halo /= halo.sum()
    spread = np.array(
        [[(image * halo[8 - y : 17 - y, 10 - x : 21 - x]).sum() for x in range(11)] for y in range(9)]
    )
    np.testing.assert_allclose(scatter(image, 0.3, 0.2), image + 0.3 * spread, atol=1e-12)
    assert scatter(image, 0.0, 0.2) is image
    centre = scatter(np.ones((101, 101)), 0.01, 0.02)[50, 50]
    assert centre == pytest.approx(1.01, abs=5e-4)


def test_scattering_pulls_dark_and_far_towards_bright_and_near():
    """A bright near half shortens the range measured on a dark far half."""
    r = np.where(np.arange(CAMERA.width) < 32, 0.5, 1.2)
    light = lit(r)
    bright = np.where(np.arange(CAMERA.width) < 32, 4.0, 0.05)
    light = Light(light.phasor * bright, light.steady * bright)
    far = ranges(take(replace(CLEAN, scattering=0.01), light)[0])[1][:, 40:]
    assert (far < 1.2).all()


def test_shot_and_read_noise_give_the_known_phase_noise():
    """sigma_phi = sqrt((B + s^2) / 2) / A: 0.0469 rad for A 500, B 1000, read noise 10 electrons."""
    sensor = replace(
        CLEAN, signal=1000.0, contrast=(0.5, 0.5), electrons_per_unit=1.0, read_noise=10.0, shot_noise=True
    )
    raw, _ = take(sensor, lit(1.0, 1.0), frames=4)
    z = phasors(raw, INFO.modulation_hz, INFO.phase_rad)
    expected = np.exp(4j * np.pi * np.array(HZ)[:, None, None] / SPEED_OF_LIGHT)
    sigma = np.angle(z / expected).std()
    assert sigma == pytest.approx(np.sqrt((1000 + 100) / 2) / 500, rel=0.02)


def test_shot_noise_alone_is_poisson():
    """With only shot noise on, variance of the electrons equals their mean."""
    raw, _ = take(replace(CLEAN, shot_noise=True, electrons_per_unit=3.0), frames=60)
    electrons = raw * 3.0
    ratio = electrons.var(axis=0, ddof=1).mean() / electrons.mean()
    assert ratio == pytest.approx(1.0, rel=0.01)


def test_quantisation_and_saturation():
    """Quantised taps are whole, within half a unit of the analogue ones, and clip at full scale."""
    analogue, _ = take(CLEAN)
    digital, _ = take(replace(CLEAN, quantise=True))
    assert digital.dtype == np.uint16
    assert np.abs(digital - analogue).max() <= 0.5
    bright, _ = take(replace(CLEAN, quantise=True, signal=5e4))
    assert bright.max() == 4095


def test_same_generator_same_burst():
    """A burst is a function of light, sensor and generator."""
    np.testing.assert_array_equal(take(Sensor(), frames=2, seed=3)[0], take(Sensor(), frames=2, seed=3)[0])
    assert (take(Sensor(), seed=3)[0] != take(Sensor(), seed=4)[0]).any()


def test_other_channels_decode_to_the_range():
    """15 and 75 MHz with three phases each, in any order of channels: the ideal taps give the range, and so does the decoder."""
    thirds = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)
    order = [4, 0, 2, 5, 1, 3]
    hz, phase = np.repeat((15e6, 75e6), 3)[order], np.tile(thirds, 2)[order]
    channels = {"modulation_hz": tuple(hz), "phase_rad": tuple(phase)}
    info = TofInfo("test", "0", CAMERA, np.zeros(3), **channels)
    distance = 1.7
    turn = (
        4 * np.pi * np.array([15e6, 75e6])[:, None, None] * np.full(CAMERA.shape, distance) / SPEED_OF_LIGHT
    )
    light = Light(phasor=0.5 * np.exp(1j * turn), steady=np.full(CAMERA.shape, 0.5))
    raw, _ = expose(light, replace(CLEAN, **channels), info, 1, np.random.default_rng(0), 0)
    assert raw.shape == (1, 6, *CAMERA.shape)
    depth = Decoder(info)(raw[0]).depth
    np.testing.assert_allclose(depth * CAMERA.ray_lengths, distance, atol=2e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"phase_rad": (0.0,) * 7}, "a phase for each of 8 channels"),
        ({"contrast": (0.5,)}, "contrast"),
        ({"phase_rad": (0.0,) * 8}, "do not determine a phasor"),
        ({"range_errors": (RangeError(15e6),)}, "which no channel has"),
    ],
)
def test_channels_that_no_decoder_takes_are_refused(change, message):
    """Each with the key and what it should hold."""
    with pytest.raises(ConfigError, match=message):
        check_sensor(replace(Sensor(), **change), "world")
