"""ToF phase: conventions, ranges, unwrapping, noise, and the way back from range to taps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.frames import PAPER_MODULATION_HZ as HZ
from tofcapture.frames import PAPER_PHASE_RAD as PHASES
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import (
    ambiguity,
    frequencies,
    mean_phasors,
    phasors,
    radial_to_range,
    radius_px,
    taps,
    wrapped_range,
)
from tofcapture.ops.phase.reference import correct_range, decode, decode_phasors, range_to_radial
from tofcapture.rig import RangeError

CAMERA = Camera(12, 9, 10.0, 10.5, 5.7, 4.1)
ILLUMINATOR = np.array([0.007, 0.0, 0.0])
INFO = TofInfo("", "", CAMERA, ILLUMINATOR)


def encode(radial, camera=CAMERA, illuminator=ILLUMINATOR, amplitude=500.0, offset=1000.0):
    range_ = radial_to_range(radial, camera, illuminator)
    phasor = np.stack([amplitude * np.exp(2j * np.pi * range_ / ambiguity(f)) for f in frequencies(HZ)])
    return taps(phasor, np.full(phasor.shape, offset), HZ, PHASES)


def test_the_sign_convention_of_the_taps():
    """C_k = B + A cos(phi + k pi/2) with phi = 1 decodes to 1; the other sign to 2 pi - 1."""
    k = np.arange(4) * np.pi / 2
    for sign, expected in ((1, 1.0), (-1, 2 * np.pi - 1.0)):
        raw = (1000 + 500 * np.cos(1.0 + sign * k))[:, None, None]
        phi = np.angle(phasors(raw, HZ[:4], PHASES[:4]))[0, 0, 0] % (2 * np.pi)
        assert phi == pytest.approx(expected, abs=1e-12)
        assert np.arctan2(raw[3] - raw[1], raw[0] - raw[2])[0, 0] % (2 * np.pi) == pytest.approx(expected)


def test_unambiguous_ranges():
    """The ranges are c / 2f."""
    assert ambiguity(20e6) == pytest.approx(7.49481145, abs=1e-9)
    assert ambiguity(100e6) == pytest.approx(1.49896229, abs=1e-9)


@pytest.mark.parametrize(("distance", "k"), [(0.5, 0), (2.0, 1), (3.5, 2), (5.0, 3), (6.5, 4)])
def test_unwrapping_counts(distance, k):
    """Distances 0.5 to 6.5 m are in wraps 0 to 4 of 100 MHz."""
    found = decode(
        encode(np.full(CAMERA.shape, distance), illuminator=np.zeros(3)),
        replace(INFO, illuminator=np.zeros(3)),
    )
    wraps = (found.ranges[1] - distance % ambiguity(100e6)) / ambiguity(100e6)
    np.testing.assert_allclose(wraps, k, atol=1e-9)


def test_phase_noise_follows_its_formula():
    """sigma_phi = sqrt(2 (B + s_r^2) ) / 2A: 0.0469 rad for A 500, B 1000, s_r 10 (the taps' variance is B + s_r^2)."""
    rng = np.random.default_rng(0)
    n = 200_000
    raw = 1000 + 500 * np.cos(1.0 + np.array(PHASES[:4]))[:, None, None] * np.ones((4, 1, n))
    noisy = rng.poisson(raw) + 10 * rng.standard_normal(raw.shape)
    z = phasors(noisy, HZ[:4], PHASES[:4])[0, 0]
    assert np.std(np.angle(z * np.exp(-1j))) == pytest.approx(0.0469, rel=0.02)


def test_wrap_failures_at_a_given_phase_noise():
    """With 0.2 rad of noise on both frequencies 0.21 % of the unwraps fail (240,000 draws)."""
    rng = np.random.default_rng(1)
    camera, d = Camera(600, 400, 500.0, 500.0, 300.0, 200.0), 3.5
    phase = [2 * np.pi * d / ambiguity(f) + 0.2 * rng.standard_normal(camera.shape) for f in (20e6, 100e6)]
    info = replace(INFO, camera=camera, illuminator=np.zeros(3))
    wrong = np.abs(decode_phasors(np.exp(1j * np.array(phase)), info).radial - d) > 0.75
    assert 100 * wrong.mean() == pytest.approx(0.21, abs=0.05)


@given(st.floats(0.1, 7.0), st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_decode_inverts_encode(distance, seed):
    """Whatever the distance below 7 m and the order of the channels, decoding gives the distance along the ray back."""
    order = np.random.default_rng(seed).permutation(8)
    hz, phases = [HZ[i] for i in order], [PHASES[i] for i in order]
    radial = np.full(CAMERA.shape, distance)
    found = decode(encode(radial)[order], replace(INFO, modulation_hz=tuple(hz), phase_rad=tuple(phases)))
    np.testing.assert_allclose(found.radial, radial, atol=1e-9)
    np.testing.assert_allclose(found.amplitude[-1], 500.0, rtol=1e-9)


def test_decode_survives_the_wrap_of_the_high_frequency():
    """Noise that puts the two frequencies on both sides of a wrap costs millimetres, not wraps."""
    rng = np.random.default_rng(2)
    radial = np.full(CAMERA.shape, ambiguity(100e6))
    raw = encode(radial, illuminator=np.zeros(3)) + 5 * rng.standard_normal((8, *CAMERA.shape))
    found = decode(raw, replace(INFO, illuminator=np.zeros(3)))
    assert np.abs(found.radial - radial).max() < 0.02


@given(st.floats(0.05, 5.0), st.floats(-0.04, 0.04), st.floats(-0.04, 0.04))
@settings(max_examples=30)
def test_range_and_radial_are_inverse(distance, x, y):
    """The ellipsoid formula inverts half the path for any light source."""
    light = np.array([x, y, 0.003])
    radial = np.full(CAMERA.shape, distance)
    np.testing.assert_allclose(
        range_to_radial(radial_to_range(radial, CAMERA, light), CAMERA, light), radial, atol=1e-9
    )


def test_range_errors_are_taken_off():
    """A wiggle of 6 mm, an offset and a radial term leave less than 0.1 mm."""
    errors = [
        RangeError(20e6, offset=-0.014, harmonics=((4, 0.018, 0.010),), per_pixel_radius=1e-4),
        RangeError(
            100e6, offset=-0.7427, harmonics=((2, -0.006, 0.0012),), per_pixel_radius=1e-4, per_kelvin=-1.8e-4
        ),
    ]
    radial = np.linspace(0.4, 1.4, CAMERA.width * CAMERA.height).reshape(CAMERA.shape)
    true = radial_to_range(radial, CAMERA, ILLUMINATOR)
    phasor = []
    for e in errors:
        R = ambiguity(e.modulation_hz)
        measured = true + e.at(2 * np.pi * true / R, radius_px(CAMERA), 50.0)
        phasor.append(100 * np.exp(2j * np.pi * measured / R))
    found = decode_phasors(np.stack(phasor), replace(INFO, range_errors=tuple(errors)), 50.0)
    assert np.abs(found.radial - radial).max() < 1e-4


def test_correct_range_without_error_only_wraps():
    """No error, no change."""
    range_ = np.full(CAMERA.shape, 0.8)
    np.testing.assert_allclose(correct_range(range_, RangeError(100e6), CAMERA, 45.0), range_)


def test_bursts_are_averaged_as_phasors():
    """Across a wrap, the mean phasor is right where the mean phase would be half a period off."""
    k = np.array(PHASES[:4])
    raw = np.stack([(1000 + 500 * np.cos(phi + k))[:, None, None] for phi in (0.1, -0.1)])
    mean = mean_phasors(raw, HZ[:4], PHASES[:4])
    assert np.cos(2 * np.pi * wrapped_range(mean, 20e6) / ambiguity(20e6))[0, 0, 0] == pytest.approx(1.0)


def test_saturated_and_dark_pixels_are_nan():
    """A saturated pixel and one without amplitude have no distance."""
    raw = encode(np.full(CAMERA.shape, 1.0))
    raw[:, 0, 0] = 500
    raw[3, 1, 1] = 4095
    found = decode(raw, INFO)
    assert np.isnan(found.radial[[0, 1], [0, 1]]).all()
    assert np.isfinite(found.radial).sum() == found.radial.size - 2


def test_channels_that_do_not_determine_a_phasor_are_refused():
    """Two phases are not enough, and the number of channels must match."""
    with pytest.raises(DataError, match="do not determine"):
        phasors(np.zeros((3, 1, 1)), (20e6,) * 3, (0.0, np.pi, 0.0))
    with pytest.raises(DataError, match="channels"):
        phasors(np.zeros((7, 1, 1)), HZ, PHASES)
