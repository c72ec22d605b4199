"""Augmentations: what they do to taps, and that decoding agrees with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tofcapture.camera import Camera
from tofcapture.frames import PAPER_MODULATION_HZ as HZ
from tofcapture.frames import PAPER_PHASE_RAD as PHASES
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import ambiguity, frequencies, phasors, radial_to_range, taps
from tofcapture.rig import SPEED_OF_LIGHT, RangeError
from tofcapture_model.data import batched, frame_decoder, make_frame
from tofcapture_model.data.augment import BurstNoise, redraw_calibration, redraw_frame, redraw_noise

CAMERA = Camera(24, 18, 20.0, 21.0, 11.2, 9.1)
LIGHT = np.array([0.03, 0.01, 0.0])
ERRORS = (
    RangeError(20e6, 0.01),
    RangeError(100e6, -0.2, harmonics=((2, 0.004, 0.001),), per_pixel_radius=2e-4),
)
AMBIENT = 20.0


def scene(camera):
    """A tilted, wavy surface."""
    x, y = camera.rays[..., 0], camera.rays[..., 1]
    return 1.0 + 0.2 * x - 0.1 * y + 0.02 * np.sin(9 * x)


def clean_taps(amplitude=200.0):
    range_ = radial_to_range(CAMERA.depth_to_radial(scene(CAMERA)), CAMERA, LIGHT)
    z = np.stack([amplitude * np.exp(2j * np.pi * range_ / ambiguity(f)) for f in frequencies(HZ)])
    return taps(z, np.full(z.shape, 1.5 * amplitude + AMBIENT), HZ, PHASES)


def test_redrawn_noise_is_that_of_one_frame():
    """From the mean of a burst, taps vary like a frame of it: mean and variance, tap by tap."""
    rng = np.random.default_rng(0)
    clean = np.broadcast_to(clean_taps()[:, :6, :6], (4000, 8, 6, 6))
    burst = rng.poisson(clean[:4] * 16) / 16 + 1.25 * rng.standard_normal((4, 8, 6, 6))
    generator = torch.Generator().manual_seed(1)
    # Every draw from another burst would be slow in the test: add a burst's own noise by hand instead.
    means = clean + rng.standard_normal(clean.shape) * np.sqrt((clean / 16 + 1.25**2) / 4)
    out = redraw_noise(torch.from_numpy(means), generator, BurstNoise(4, 16.0, 1.25, 4095.0)).numpy()
    np.testing.assert_allclose(out.mean(0), clean[0], atol=0.35)
    expected = clean[0] / 16 + 1.25**2 + 1 / 12
    assert np.median(out.var(0) / expected) == pytest.approx(1, abs=0.02)
    assert (np.rint(out) == out).all()
    one = redraw_noise(torch.from_numpy(burst.mean(0)), generator, BurstNoise(4, 16.0, 1.25, 4095.0))
    assert one.shape == (8, 6, 6)


@pytest.mark.parametrize("full_scale", [4095.0, 16383.0])
def test_a_redrawn_frame_is_decoded_like_a_frame_of_the_burst(full_scale):
    """Depth, gap, confidence and phasors scatter about the same means by as much as those of decoded single frames."""
    rng, clean = np.random.default_rng(3), clean_taps()
    info = TofInfo("", "", CAMERA, LIGHT, range_errors=ERRORS, saturation=full_scale)
    burst = rng.poisson(np.broadcast_to(clean, (400, *clean.shape)) * 16) / 16
    burst = np.rint(burst + 1.25 * rng.standard_normal(burst.shape))
    decoder = frame_decoder(info, CAMERA)
    real = [make_frame(raw, info, CAMERA, decoder=decoder) for raw in burst]
    mean = batched(make_frame(burst.mean(0), info, CAMERA, decoder=decoder))
    generator = torch.Generator().manual_seed(4)
    mean = mean._replace(noise=torch.tensor([BurstNoise(400, 16.0, 1.25, full_scale)]))
    drawn = [redraw_frame(mean, generator) for _ in range(400)]
    for field in ("depth", "gap", "confidence", "phasor"):
        a = torch.stack([getattr(f, field) for f in real])
        b = torch.stack([getattr(f, field)[0] for f in drawn])
        assert (b.std(0) / a.std(0)).median().item() == pytest.approx(1, abs=0.02), field
        assert ((b.mean(0) - a.mean(0)).abs() / a.std(0)).max() < 0.4, field
    assert drawn[0].depth.dtype == torch.float32
    assert drawn[0].cues is mean.cues


def test_another_calibration_is_what_the_decoder_would_have_made_of_it():
    """The drawn error is an offset and two harmonics; a decoder that is told of them gives the same depth and gap."""
    offsets, raw = {20e6: 0.01, 100e6: -0.2}, clean_taps()
    info = TofInfo("", "", CAMERA, LIGHT, range_errors=tuple(RangeError(*e) for e in offsets.items()))
    frame = batched(make_frame(raw, info, CAMERA))
    moved = redraw_calibration(frame, torch.Generator().manual_seed(5), 0.001)
    gap = (moved.gap - frame.gap)[0, 0].numpy()
    depth = (moved.depth - frame.depth)[0, 0].numpy()
    # fused: high + lean (low - high)
    high = depth * np.linalg.norm(CAMERA.rays, axis=-1) - 20**2 / (20**2 + 100**2) * gap
    told = []
    for hz, by, z in zip(offsets, (high + gap, high), phasors(raw, HZ, PHASES), strict=True):
        # the decoder's phase is turned by the offset
        phase = np.angle(z) - 4 * np.pi * hz * offsets[hz] / SPEED_OF_LIGHT
        waves = [f(m * phase).ravel() for m in (2, 4) for f in (np.cos, np.sin)]
        constant, a, b, c, d = np.linalg.lstsq(np.stack([np.ones(by.size), *waves], 1), by.ravel())[0]
        told.append(RangeError(hz, offsets[hz] - constant, harmonics=((2, -a, -b), (4, -c, -d))))
    other = make_frame(raw, replace(info, range_errors=tuple(told)), CAMERA)
    assert np.abs(depth).max() > 2.5e-4
    np.testing.assert_allclose(moved.depth[0], other.depth, atol=4e-6)
    np.testing.assert_allclose(moved.gap[0], other.gap, atol=3e-5)
    assert moved.raw is frame.raw
    assert moved.phasor is frame.phasor


def test_calibrations_scatter_as_asked_and_each_frame_has_its_own():
    """Range varies by sqrt(3) times the asked phase at every pixel; frames of a batch differ; holes keep their filling."""
    info = TofInfo("", "", CAMERA, LIGHT, range_errors=ERRORS)
    one = batched(make_frame(clean_taps(), info, CAMERA))
    frame = type(one)(*(x.expand(600, *x.shape[1:]) for x in one))
    frame = frame._replace(valid=frame.valid.clone())
    frame.valid[..., :2, :] = 0
    moved = redraw_calibration(frame, torch.Generator().manual_seed(6), 0.01)
    metres = SPEED_OF_LIGHT / (4 * np.pi * 20e6)
    low = moved.gap - frame.gap
    assert low.std(0).median() == pytest.approx(0.01 * 3**0.5 * metres * (1 + 0.2**2) ** 0.5, rel=0.05)
    assert (moved.depth - frame.depth)[..., :2, :].abs().max() == 0
    wide, others = [3], [0, 1, 2, 4]
    torch.testing.assert_close((moved.cues - frame.cues)[:, wide], low, atol=1e-6, rtol=0)
    assert torch.equal(moved.cues[:, others], frame.cues[:, others])


def test_saturated_taps_stay_saturated():
    """What was clipped is unknown and stays clipped."""
    raw = torch.tensor([4095.0, 3000.0, 100.0]).reshape(3, 1, 1)
    drawn = redraw_noise(raw, torch.Generator().manual_seed(0), BurstNoise(10, 16.0, 1.25, 4095.0)).flatten()
    assert drawn[0] == 4095
    assert drawn[1] == pytest.approx(3000, abs=60)
