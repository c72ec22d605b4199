"""The fast decoder against its float64 oracle, its flags, and the ways to unwrap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.frames import PAPER_MODULATION_HZ as HZ
from tofcapture.frames import PAPER_PHASE_RAD as PHASES
from tofcapture.frames import TOF_FLAG_DOCS, TofFlag, TofInfo
from tofcapture.ops.phase import (
    Decoder,
    TapNoise,
    ambiguity,
    flying_pixels,
    frequencies,
    phasors,
    radial_to_range,
    radius_px,
    taps,
)
from tofcapture.ops.phase.reference import decode
from tofcapture.rig import RangeError

CAMERA = Camera(60, 45, 47.6, 50.2, 29.2, 25.4)
LIGHT = np.array([0.007, -0.002, 0.001])
# The constants of a real sensor of this kind, without the linear term that makes a wrap's edge jump.
ERRORS = (
    RangeError(20e6, -0.01428, harmonics=((4, 0.018, 0.01),)),
    RangeError(100e6, -0.7427, 0.0, ((2, -0.006, 0.0012), (4, -0.0007, 0.0002)), 1.54e-4, -1.8e-4),
)
LOW, HIGH = (ambiguity(f) for f in frequencies(HZ))


def info_with(errors=(), order=range(8), **kwargs):
    hz, phases = tuple(HZ[i] for i in order), tuple(PHASES[i] for i in order)
    return TofInfo("", "", CAMERA, LIGHT, hz, phases, range_errors=errors, **kwargs)


def expose(radial, errors=(), celsius=45.0, amplitude=(400.0, 300.0), mean=900.0):
    """Noise-free taps of distances along the rays."""
    range_ = radial_to_range(radial, CAMERA, LIGHT)
    by_hz = {e.modulation_hz: e for e in errors}
    phasor = []
    for f, a in zip(frequencies(HZ), amplitude, strict=True):
        R = ambiguity(f)
        error = by_hz.get(f, RangeError(f)).at(2 * np.pi * range_ / R, radius_px(CAMERA), celsius)
        phasor.append(a * np.exp(2j * np.pi * (range_ + error) / R))
    return taps(np.stack(phasor), np.full((2, *CAMERA.shape), mean), HZ, PHASES)


def noisy(clean, rng, frames=None):
    shape = clean.shape if frames is None else (frames, *clean.shape)
    electrons = rng.poisson(np.maximum(np.broadcast_to(clean, shape), 0) * 16) + 20 * rng.standard_normal(
        shape
    )
    return np.clip(np.rint(electrons / 16), 0, 4095).astype(np.uint16)


def oracle(raw, info, celsius=45.0):
    out = decode(raw, info, celsius)
    return CAMERA.radial_to_depth(out.radial), out


@given(st.integers(0, 2**32 - 1), st.floats(20.0, 70.0), st.booleans())
@settings(max_examples=15)
def test_the_fast_decoder_is_the_oracle_to_a_hundredth_of_a_millimetre(seed, celsius, corrected):
    """Any distance in range, any temperature, any order of channels, with and without range errors."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(8)
    info = info_with(ERRORS if corrected else (), order)
    radial = rng.uniform(0.2, 7.2, CAMERA.shape)
    raw = noisy(expose(radial, info.range_errors, celsius), rng)[order]
    found = Decoder(info)(raw, celsius)
    expected, slow = oracle(raw, info, celsius)
    difference = np.abs(found.depth - expected)
    assert np.nanmax(difference) < 1e-5
    np.testing.assert_array_equal(np.isnan(found.depth), np.isnan(expected))
    np.testing.assert_allclose(found.confidence, slow.amplitude[-1], rtol=1e-6)


def test_signals_are_the_oracle_s_phasors_and_ranges():
    """I and Q of both frequencies, and their unwrapped ranges, where the reference has them; NaN where there is no light."""
    rng = np.random.default_rng(5)
    info = info_with(ERRORS)
    raw = noisy(expose(rng.uniform(0.2, 7.2, CAMERA.shape), ERRORS), rng)
    raw[:, 0, 0] = 500
    maps, signals = Decoder(info).signals(raw, 45.0)
    np.testing.assert_array_equal(maps.depth, Decoder(info)(raw, 45.0).depth)
    phasor = phasors(raw, info.modulation_hz, info.phase_rad)
    np.testing.assert_allclose(signals.phasor, np.stack([phasor.real, phasor.imag], 1), atol=1e-3)
    _, slow = oracle(raw, info)
    assert np.isnan(signals.ranges[:, 0, 0]).all()
    lit = np.isfinite(signals.gap)
    # The low frequency's table is coarser than the high one's.
    assert np.abs(signals.ranges - slow.ranges)[:, lit].max() < 1e-4
    np.testing.assert_array_equal(signals.gap, signals.ranges[0] - signals.ranges[1])


def test_decoded_depth_is_the_scene():
    """Errors, lamp and all: from exact taps comes the exact depth."""
    radial = np.random.default_rng(0).uniform(0.3, 7.0, CAMERA.shape)
    found = Decoder(info_with(ERRORS))(expose(radial, ERRORS, 38.0), 38.0)
    np.testing.assert_allclose(found.depth, CAMERA.radial_to_depth(radial), atol=1e-5)
    assert found.depth.dtype == found.confidence.dtype == np.float32
    assert found.flags.dtype == np.uint8


def test_uneven_phases_and_small_cameras():
    """Five phases at odd angles take the general way to I and Q."""
    hz = (20e6,) * 5 + (100e6,) * 5
    phases = (0.0, 1.3, 2.5, 3.7, 5.1) * 2
    info = TofInfo("", "", CAMERA, LIGHT, hz, phases)
    radial = np.random.default_rng(1).uniform(0.3, 7.0, CAMERA.shape)
    range_ = radial_to_range(radial, CAMERA, LIGHT)
    z = np.stack([200 * np.exp(2j * np.pi * range_ / ambiguity(f)) for f in frequencies(hz)])
    raw = taps(z, np.full(z.shape, 500.0), hz, phases)
    np.testing.assert_allclose(Decoder(info)(raw).depth, CAMERA.radial_to_depth(radial), atol=1e-5)


def test_a_burst_is_averaged_as_phasors_and_saturated_in_any_frame():
    """The burst's answer is the oracle's of the mean phasor; one clipped tap of one frame costs the pixel."""
    rng = np.random.default_rng(2)
    info = info_with(ERRORS)
    raw = noisy(expose(rng.uniform(0.4, 2.0, CAMERA.shape), ERRORS), rng, frames=6)
    raw[3, 5, 7, 9] = 4095
    found = Decoder(info).burst(raw, 45.0)
    expected, _ = oracle(raw.mean(axis=0), info)
    assert np.isnan(found.depth[7, 9])
    assert found.flags[7, 9] & TofFlag.SATURATED
    expected[7, 9] = np.nan
    np.testing.assert_allclose(found.depth, expected, atol=1e-5)
    assert ((found.flags & TofFlag.SATURATED) > 0).sum() == 1


def test_dark_and_saturated_pixels_have_no_depth():
    """No amplitude, or a clipped tap: NaN and a flag; nothing is warned of."""
    raw = expose(np.full(CAMERA.shape, 1.0))
    raw[:, 0, 0] = 500.0
    raw[2, 1, 1] = 4095.0
    found = Decoder(info_with(ERRORS))(raw)
    assert np.isnan(found.depth[[0, 1], [0, 1]]).all()
    assert np.isfinite(found.depth).sum() == found.depth.size - 2
    assert found.flags[0, 0] & TofFlag.LOW_CONFIDENCE
    assert found.flags[1, 1] & TofFlag.SATURATED
    limited = Decoder(info_with(), min_amplitude=350.0)(expose(np.full(CAMERA.shape, 1.0)))
    assert np.isnan(limited.depth).all()


def test_low_confidence_is_an_uncertainty_of_two_centimetres():
    """At the amplitude where the flag comes and goes, the noise of depth is 20 mm; burst means may be darker."""
    noise, mean, rng = TapNoise(), 60.0, np.random.default_rng(3)
    sigma = np.sqrt(mean / 16 + 1.25**2)
    edge = HIGH * sigma / (2 * np.pi * np.sqrt(2) * 0.020)
    for amplitude, flagged in ((1.3 * edge, 0.1), (0.7 * edge, 0.9)):
        clean = expose(np.full(CAMERA.shape, 1.0), amplitude=(amplitude, amplitude), mean=mean)
        share = (Decoder(info_with(), noise)(noisy(clean, rng)).flags & TofFlag.LOW_CONFIDENCE > 0).mean()
        assert share < flagged if flagged < 0.5 else share > flagged
    clean = expose(np.full(CAMERA.shape, 1.0), amplitude=(edge, edge), mean=mean)
    depth = Decoder(info_with(), noise)(noisy(clean, rng)).depth
    truth = CAMERA.radial_to_depth(np.full(CAMERA.shape, 1.0))
    assert np.std((depth - truth) * CAMERA.ray_lengths) == pytest.approx(0.020, rel=0.15)
    burst = Decoder(info_with(), noise).burst(noisy(clean, rng, frames=9), 45.0)
    assert (burst.flags & TofFlag.LOW_CONFIDENCE == 0).all()


def test_mixed_pixels_fly():
    """Along a step, pixels that see half of each side are flagged, unmixed ones and a steep plane are not."""
    near, far, column = 0.8, 1.2, 30
    z = []
    for f in frequencies(HZ):
        each = [
            w
            / d**2
            * np.exp(2j * np.pi * radial_to_range(np.full(CAMERA.shape, d), CAMERA, LIGHT) / ambiguity(f))
            for w, d in ((1.0, near), (1.0, far))
        ]
        share = np.where(np.arange(CAMERA.width) < column, 1.0, 0.0)
        share[column] = 0.4
        z.append(300 * (share * each[0] + (1 - share) * each[1]))
    raw = taps(np.stack(z), np.full((2, *CAMERA.shape), 900.0), HZ, PHASES)
    flags = Decoder(info_with())(raw).flags
    flying = (flags & TofFlag.FLYING) > 0
    assert flying[:, column].all()
    assert flying.sum() == CAMERA.height
    steep = 1 / (1 + np.tan(np.radians(70)) * (CAMERA.rays[..., 0] - CAMERA.rays[..., 0].min()))
    assert not flying_pixels(steep, CAMERA).any()


def test_disagreement_of_the_frequencies_is_ambiguous():
    """Half a metre between the two ranges is more than a quarter of a wrap; a quarter of a metre is not."""
    for shift, flagged in ((0.5, True), (0.25, False)):
        raw = expose(np.full(CAMERA.shape, 1.0), (RangeError(20e6, offset=shift),))
        assert ((Decoder(info_with())(raw).flags & TofFlag.AMBIGUOUS > 0) == flagged).all()


def test_frames_of_another_shape_are_refused():
    """And every flag is explained."""
    with pytest.raises(DataError, match="expected raw of shape"):
        Decoder(info_with())(np.zeros((8, 3, 3), np.uint16))
    assert set(TOF_FLAG_DOCS) == set(TofFlag)


def dark_scene(rng, amplitude, depth=None):
    """Taps of a floor and a box before a far wall, at an amplitude of so many tap sigmas, and the wraps of 100 MHz."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    if depth is None:
        depth = np.where((u > 15) & (u < 40) & (v > 10), 1.1 + 0.004 * v, 2.6 + 0.01 * u)
    sigma = 2.0
    raw = expose(depth, amplitude=(1.4 * amplitude * sigma, amplitude * sigma), mean=30.0)
    return raw + sigma * rng.standard_normal(raw.shape), depth


NOISE = TapNoise(np.inf, 2.0)


def wrong(depth, radial):
    return float((np.abs(depth - CAMERA.radial_to_depth(radial)) > HIGH / 2).mean())


@pytest.mark.parametrize("amplitude", [1.0, 1.5, 2.0])
def test_neighbours_decide_dark_wraps(amplitude):
    """With support from the window under a third of the wrong wraps remains, and nothing changes where light is enough."""
    raw, radial = dark_scene(np.random.default_rng(6), amplitude)
    together, alone = Decoder(info_with(), NOISE)(raw).depth, oracle(raw, info_with())[0]
    assert wrong(together, radial) < 0.3 * wrong(alone, radial)
    raw, _ = dark_scene(np.random.default_rng(7), 60.0)
    np.testing.assert_allclose(Decoder(info_with(), NOISE)(raw).depth, oracle(raw, info_with())[0], atol=1e-5)


def test_a_wall_one_wrap_behind_keeps_its_wrap():
    """The high frequency cannot tell the two apart; a pixel with light enough is not outvoted."""
    u = np.arange(CAMERA.width)[None] + np.zeros((CAMERA.height, 1))
    raw, radial = dark_scene(np.random.default_rng(8), 40.0, np.where(u < 30, 1.0, 1.0 + HIGH))
    assert wrong(Decoder(info_with(), NOISE)(raw).depth, radial) == 0
