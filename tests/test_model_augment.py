"""Augmentations: what they do to taps, and that decoding agrees with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.frames import PAPER_MODULATION_HZ as HZ
from tofcapture.frames import PAPER_PHASE_RAD as PHASES
from tofcapture.frames import TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.ops.phase import Decoder, TapNoise, ambiguity, frequencies, phasors, radial_to_range, taps
from tofcapture.rig import SPEED_OF_LIGHT, RangeError
from tofcapture_model.data.augment import (
    BurstNoise,
    RawItem,
    crop,
    flip,
    redraw_calibration,
    redraw_frame,
    redraw_noise,
    scale_albedo,
)
from tofcapture_model.data.frames import batched, frame_decoder, make_frame

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


@pytest.fixture(scope="module")
def item():
    """A noise-free frame and the ground truth of its scene."""
    fine = CAMERA.scaled(2)
    depth = scene(fine)
    normals = normals_from_depth(depth, fine)
    missing = ~np.isfinite(normals).all(-1)
    depth[missing] = np.nan
    as_tensor = [np.rint(clean_taps()), depth.astype("f4"), normals.astype("f4"), missing.astype("u1")]
    k = torch.tensor([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy], dtype=torch.float64)
    return RawItem(*map(torch.from_numpy, as_tensor), k, torch.from_numpy(LIGHT))


def decoded(item):
    fx, fy, cx, cy = item.intrinsics.tolist()
    H, W = item.raw.shape[-2:]
    info = TofInfo("", "", Camera(W, H, fx, fy, cx, cy), item.illuminator.numpy(), range_errors=ERRORS)
    return torch.from_numpy(Decoder(info)(item.raw.numpy()).depth)


def same(a, b):
    return all(torch.equal(torch.nan_to_num(x, 7), torch.nan_to_num(y, 7)) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("axis", [-1, -2])
def test_decoding_a_mirrored_frame_gives_the_mirrored_depth(item, axis):
    """Lamp, lens and range error are mirrored with the world, so the depth is the same, mirrored."""
    found = decoded(flip(item, axis))
    assert torch.allclose(found, decoded(item).flip(axis), atol=2e-6)
    unlit = flip(item, axis)._replace(illuminator=item.illuminator)
    assert not torch.allclose(decoded(unlit), found, atol=1e-4)


@pytest.mark.parametrize("axis", [-1, -2])
def test_mirroring_twice_changes_nothing(item, axis):
    """Two flips are none, to the bit."""
    assert same(flip(flip(item, axis), axis)[:4], item[:4])
    assert torch.allclose(flip(flip(item, axis), axis).intrinsics, item.intrinsics)


def test_decoding_a_window_gives_the_window_of_the_depth(item):
    """The principal point moves with the crop, so nothing else does."""
    cut = crop(item, 3, 5, (10, 12))
    assert torch.allclose(decoded(cut), decoded(item)[3:13, 5:17], atol=2e-6)
    assert cut.depth.shape == cut.mask.shape == (20, 24)
    assert same([cut.depth], [item.depth[6:26, 10:34]])


@pytest.mark.parametrize(
    "change", [lambda i: flip(i, -1), lambda i: flip(i, -2), lambda i: crop(i, 2, 4, (9, 9))]
)
def test_normals_stay_unit_face_the_camera_and_fit_the_depth(item, change):
    """Against the rays of the changed camera, and against normals of the changed depth."""
    out = change(item)
    fx, fy, cx, cy = out.intrinsics.tolist()
    H, W = out.raw.shape[-2:]
    fine = Camera(W, H, fx, fy, cx, cy).scaled(2)
    normals, there = out.normals.numpy(), np.isfinite(out.depth.numpy())
    np.testing.assert_allclose(np.linalg.norm(normals[there], axis=-1), 1, atol=1e-5)
    assert (np.einsum("nc,nc->n", normals[there], fine.rays[there]) < 0).all()
    again = normals_from_depth(out.depth.numpy(), fine)
    cosine = np.einsum("hwc,hwc->hw", again, normals)
    assert np.nanmedian(cosine) > 0.9999


def test_redrawn_noise_is_that_of_one_frame():
    """From the mean of a burst, taps vary like a frame of it: mean and variance, tap by tap."""
    noise, rng = TapNoise(16.0, 1.25), np.random.default_rng(0)
    clean = np.broadcast_to(clean_taps()[:, :6, :6], (4000, 8, 6, 6))
    burst = rng.poisson(clean[:4] * 16) / 16 + 1.25 * rng.standard_normal((4, 8, 6, 6))
    generator = torch.Generator().manual_seed(1)
    # Every draw from another burst would be slow in the test: add a burst's own noise by hand instead.
    means = clean + rng.standard_normal(clean.shape) * np.sqrt((clean / 16 + 1.25**2) / 4)
    out = redraw_noise(torch.from_numpy(means), generator, averaged=4, noise=noise).numpy()
    np.testing.assert_allclose(out.mean(0), clean[0], atol=0.35)
    expected = clean[0] / 16 + 1.25**2 + 1 / 12
    assert np.median(out.var(0) / expected) == pytest.approx(1, abs=0.02)
    assert (np.rint(out) == out).all()
    one = redraw_noise(torch.from_numpy(burst.mean(0)), generator, averaged=4, noise=noise)
    assert one.shape == (8, 6, 6)


@pytest.mark.parametrize("full_scale", [4095.0, 16383.0])
def test_a_redrawn_frame_is_decoded_like_a_frame_of_the_burst(full_scale):
    """Depth, gap, confidence and phasors scatter about the same means by as much as those of decoded single frames."""
    noise, rng, clean = TapNoise(16.0, 1.25), np.random.default_rng(3), clean_taps()
    info = TofInfo("", "", CAMERA, LIGHT, range_errors=ERRORS, saturation=full_scale)
    burst = rng.poisson(np.broadcast_to(clean, (400, *clean.shape)) * 16) / 16
    burst = np.rint(burst + 1.25 * rng.standard_normal(burst.shape))
    decoder = frame_decoder(info, CAMERA)
    real = [make_frame(raw, info, CAMERA, decoder=decoder) for raw in burst]
    mean = batched(make_frame(burst.mean(0), info, CAMERA, decoder=decoder))
    generator = torch.Generator().manual_seed(4)
    drawn = [redraw_frame(mean, generator, BurstNoise(400, noise, full_scale)) for _ in range(400)]
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
    torch.testing.assert_close((moved.cues - frame.cues)[:, -1:], low, atol=1e-6, rtol=0)
    assert torch.equal(moved.cues[:, :-1], frame.cues[:, :-1])


def test_a_darker_world_has_less_signal_the_same_ambient_and_the_noise_of_its_taps():
    """Amplitude scales, phase and ambient stay, and the variance is that of the darker taps, not the scaled one."""
    rng, clean = np.random.default_rng(2), clean_taps()
    frames = rng.poisson(np.broadcast_to(clean, (300, *clean.shape)) * 16) / 16
    frames = np.clip(np.rint(frames + 1.25 * rng.standard_normal(frames.shape)), 0, 4095)
    out = scale_albedo(torch.from_numpy(frames), 0.4, AMBIENT, torch.Generator().manual_seed(3)).numpy()
    wanted = AMBIENT + 0.4 * (clean - AMBIENT)
    np.testing.assert_allclose(out.mean(0), wanted, atol=2.5)
    assert np.median(out.var(0) / (wanted / 16 + 1.25**2 + 1 / 12)) == pytest.approx(1, abs=0.04)
    ratio = phasors(out.mean(0), HZ, PHASES) / phasors(clean, HZ, PHASES)
    assert np.median(ratio.real) == pytest.approx(0.4, abs=0.002)
    assert np.median(np.abs(np.angle(ratio))) < 0.01


def test_saturated_taps_stay_and_new_ones_appear():
    """What was clipped is unknown and stays clipped; what becomes too bright is clipped."""
    raw = torch.tensor([4095.0, 3000.0, 100.0]).reshape(3, 1, 1)
    generator = torch.Generator().manual_seed(0)
    darker = scale_albedo(raw, 0.5, 0.0, generator).flatten()
    brighter = scale_albedo(raw, 1.5, 0.0, generator, averaged=10).flatten()
    assert darker[0] == brighter[0] == brighter[1] == 4095
    assert darker[1] == pytest.approx(1500, abs=60)


def test_impossible_augmentations_are_refused():
    """A single frame cannot be made brighter without too much noise; windows lie inside; there are two axes."""
    generator = torch.Generator()
    with pytest.raises(ConfigError, match="positive factors up to 1"):
        scale_albedo(torch.ones(8, 2, 2), 1.2, 0.0, generator)
    with pytest.raises(ConfigError, match="positive factors"):
        scale_albedo(torch.ones(8, 2, 2), 0.0, 0.0, generator)
    empty = RawItem(*(torch.zeros(8, 4, 4),) * 4, torch.zeros(4), torch.zeros(3))
    with pytest.raises(ConfigError, match="window inside"):
        crop(empty, 2, 0, (3, 2))
    with pytest.raises(ConfigError, match="axis"):
        flip(empty, 0)


@pytest.mark.gpu
def test_a_gpu_gives_what_the_cpu_gives(item):
    """Geometry to the bit, noise by its statistics."""
    there = RawItem(*(x.cuda() for x in item))
    assert same([x.cpu() for x in flip(there)], flip(item))
    drawn = redraw_noise(there.raw, torch.Generator("cuda").manual_seed(0)).cpu()
    assert (drawn - item.raw).std() < 10
