"""What compact reads of a frame and steps towards: channels, candidates, plane fits, cues; their order, units and signs."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")
from torch.nn import functional as F  # noqa: N812

from tests.test_model_geometry import CAMERA, plane
from tests.test_model_multipath import HZ, SHAPE, K, corner
from tests.test_model_networks import TINY_COMPACT, frame, joint
from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.data import with_cues
from tofcapture_model.evaluation.metrics import angles_deg
from tofcapture_model.frame import Frame
from tofcapture_model.geometry import multipath
from tofcapture_model.geometry.maps import (
    doubled_parts,
    local_planes,
    rays,
    scale_intrinsics,
    side_window_planes,
    unit,
)
from tofcapture_model.geometry.multipath import STEP, cues, exchange_error, halo_error, surface
from tofcapture_model.networks.heads import (
    CORRECTIONS,
    CUE_SCALE,
    FIT_RADII,
    CompactInputs,
    CompactNormals,
    Raw2Depth,
    zeroed_conv,
)

RATIO, CUES, SMOOTH = 2, slice(8, 13), 16
"""Channels: log ratio of the amplitudes, cues, first smoothed depth."""


def doubled(image):
    """Bilinear x2 by torch."""
    return F.interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)


def slanted(data):
    """Depth of a slanted plane at twice a frame's resolution, and its normal."""
    normal = unit(torch.tensor([0.5, 0.3, -1.0]).reshape(1, 3, 1, 1))
    h, w = data.depth.shape[-2:]
    r = rays(scale_intrinsics(data.intrinsics, 2), 2 * h, 2 * w)
    return normal[:, 2:] * 0.8 / (normal * r).sum(1, keepdim=True), normal


def test_the_ratio_of_amplitudes_is_that_of_the_high_to_the_low_frequency():
    """As a natural logarithm, whatever the two amplitudes' own channels are."""
    data = frame(batch=1)
    low, high = (z.norm(dim=1, keepdim=True) for z in data.phasor.chunk(2, dim=1))
    found = CompactInputs((2,))(data).image[:, RATIO : RATIO + 1]
    bright = (low > 0.05) & (high > 0.05)  # far above the floor of an amplitude
    assert bright.sum() > 1000
    usual = (data.light[:, 0] / data.light[:, 1]).log()  # how much brighter the low one is everywhere
    torch.testing.assert_close(found[bright], (high / low).log()[bright] + usual, atol=5e-3, rtol=0)


def test_candidates_are_the_smoothed_depths_and_the_depth_without_each_cue_s_error():
    """Channels say how far off they are: a smoothed depth minus the decoded one in 2 cm, a cue in centimetres of its usual share."""
    data, windows = frame(batch=1), (1, 2)
    found = CompactInputs(windows)(data)
    smooth, corrected = found.candidates.split([len(windows), CORRECTIONS], dim=1)
    for k, window in enumerate(windows):
        inverse = side_window_planes(data.depth, data.valid + 1e-3, window)[0][:, :1]
        torch.testing.assert_close(smooth[:, k : k + 1], 1 / inverse)
    apart = (smooth - data.depth) / 0.02
    torch.testing.assert_close(found.image[:, SMOOTH : SMOOTH + len(windows)], apart.clamp(-2, 2))
    expected = data.cues * torch.tensor(CUE_SCALE).reshape(1, -1, 1, 1)
    torch.testing.assert_close(data.depth - corrected, expected[:, :CORRECTIONS], atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(found.image[:, CUES], (100 * expected).clamp(-2, 2))


@pytest.mark.parametrize("gate", range(len(TINY_COMPACT.windows) + CORRECTIONS))
def test_a_gate_of_one_goes_to_its_candidate(gate):
    """All the way, there and no further."""
    data = frame(batch=1)
    features = CompactInputs(TINY_COMPACT.windows)(data)
    features = features._replace(reach=torch.full_like(data.depth, 1e3))
    candidates = len(TINY_COMPACT.windows) + CORRECTIONS
    network = replace(TINY_COMPACT, max_residual=0.0)
    head = Raw2Depth(zeroed_conv(3, candidates + 37), network, candidates=candidates)
    with torch.no_grad():
        head.net.bias[gate] = 1.0
    found = head(torch.zeros(1, 3, 36, 44), features, data)
    expected = doubled(features.candidates[:, gate : gate + 1])
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_a_gate_of_one_gives_the_normals_of_the_depth():
    """Whatever the normals were to start from."""
    data = frame(batch=1)
    depth, normal = slanted(data)
    data = data._replace(depth=F.avg_pool2d(depth, 2))
    features = CompactInputs((2,))(data)
    wrong = features._replace(normals=unit(features.normals + torch.tensor([0.2, 0, 0]).reshape(1, 3, 1, 1)))
    for k in range(len(FIT_RADII)):
        head = CompactNormals(1)
        with torch.no_grad():
            head.net[-1].bias[12 + 4 * k : 16 + 4 * k] = 1.0
            found = head(torch.zeros(1, 1, 36, 44), wrong, depth, data)[..., 12:-12, 12:-12]
        assert angles_deg(found.flatten(2), normal.expand_as(found).flatten(2)).max() < 0.3


def test_planes_are_fitted_to_the_mean_of_a_pixel_s_four():
    """Whichever of the four is which."""
    data, head = frame(batch=1), CompactNormals(1)
    torch.nn.init.normal_(head.net[-1].weight, std=0.1)
    depth = 0.8 + 0.01 * torch.rand(1, 1, 72, 88, generator=torch.Generator().manual_seed(0))
    swapped = F.pixel_shuffle(F.pixel_unshuffle(depth, 2)[:, [3, 2, 1, 0]], 2)
    features = CompactInputs((2,))(data)
    shared = torch.zeros(1, 1, 36, 44)
    one, other = (head(shared, features, d, data) for d in (depth, swapped))
    torch.testing.assert_close(one, other)
    assert not torch.allclose(one, head(shared, features, depth + 0.1 * depth.flip(-1), data))


def test_doubled_parts_interleave_to_bilinear():
    """Sub-pixels in the order of ``pixel_shuffle``."""
    image = torch.rand(1, 3, 5, 6, generator=torch.Generator().manual_seed(0))
    found = F.pixel_shuffle(doubled_parts(image).flatten(1, 2), 2)
    torch.testing.assert_close(found, doubled(image))


@pytest.mark.parametrize("step", [0.0, 0.1])
@pytest.mark.parametrize("tilts", [(0.5, -0.4), (-0.2, 0.6)])
def test_side_windows_are_exact_on_slopes(tilts, step):
    """Each window says the depth of the pixel, not of its own middle: a slanted plane stays what it is, with a step in it, too."""
    depth, _ = plane(CAMERA, *tilts)
    right = torch.arange(CAMERA.width) >= CAMERA.width // 2
    depth = depth + step * right
    found, variance = side_window_planes(depth, torch.ones_like(depth), 3)
    inner = (..., slice(8, -8), slice(8, -8))
    assert (1 / found[:, :1] - depth)[inner].abs().max() < 1e-4
    if not step:
        assert variance[inner].max() < 1e-12


def test_a_fit_tells_the_noise_it_left():
    """Residuals have the noise's variance but for the three parameters that were fitted."""
    depth, _ = plane(CAMERA, 0.5, -0.4)
    sigma, radius = 0.01, 4
    g = torch.Generator().manual_seed(0)
    noisy = 1 / (1 / depth + sigma * torch.randn(depth.shape, generator=g, dtype=torch.float64))
    found = local_planes(noisy, torch.ones_like(depth), radius)[1][..., 6:-6, 6:-6].mean().item()
    pixels = (2 * radius + 1) ** 2
    assert found == pytest.approx(sigma**2 * (pixels - 3) / pixels, rel=0.05)


def test_cues_come_in_their_order():
    """What is seen, the same with the scene continued, the halo of the high frequency, the gap over a wide window."""
    depth, amplitude = corner(90)
    valid, nothing = torch.ones_like(depth), torch.zeros_like(depth)
    high = amplitude * torch.cat([(30 * depth).cos(), (30 * depth).sin()], dim=1)
    low = torch.cat([amplitude, nothing], dim=1)
    found = cues(torch.cat([low, high], dim=1), depth, valid, nothing + 0.02, K, (HZ / 5, HZ))
    maps = surface(depth, valid, amplitude, K)
    expected = [
        exchange_error(maps, K, HZ),
        exchange_error(maps, K, HZ, step=2 * STEP, margin=3),
        halo_error(high, HZ),
        nothing + 0.02,
    ]
    expected.append(exchange_error(maps, K, HZ / 5, step=2 * STEP, margin=3) - expected[1])
    torch.testing.assert_close(found, torch.cat(expected, dim=1))
    assert all((found[:, i] - found[:, j]).abs().max() > 1e-3 for i in range(5) for j in range(i))


def test_the_halo_s_error_is_that_of_a_little_of_all_light_added():
    """A small thing before an even wall: a thousandth of the wall's light, added to its phasor, moves it by a thousandth of the map."""
    k, share = 4 * math.pi * HZ / SPEED_OF_LIGHT, 1e-3
    radial = torch.full(SHAPE, 1.0)
    radial[42:48, 57:63] = 0.95
    light = 0.1 * torch.polar(torch.ones(SHAPE), k * radial)
    moved = torch.angle(1 + share * light[0, 0] / light) / k / share
    found = halo_error(torch.stack([light.real, light.imag])[None], HZ)[0, 0]
    torch.testing.assert_close(found[42:48, 57:63], moved[42:48, 57:63], rtol=0.05, atol=0)


def test_holes_do_not_count_in_the_mean_gap():
    """Neither by their gap nor as zeros."""
    valid = torch.ones(1, 1, *SHAPE)
    valid[..., ::3] = 0
    gap = torch.where(valid > 0, 0.02, 0.3)
    found = cues(torch.full((1, 4, *SHAPE), 0.1), torch.full_like(valid, 0.8), valid, gap, K, (HZ / 5, HZ))
    torch.testing.assert_close(found[:, 3:4], torch.full_like(valid, 0.02))


def test_patches_lie_where_their_pixels_are():
    """A symmetric corner, seen by a camera that is symmetric but for half a patch, has a symmetric error."""
    depth, amplitude = corner(90)
    found = exchange_error(surface(depth, torch.ones_like(depth), amplitude, K), K, HZ)
    torch.testing.assert_close(found, found.flip(-1), rtol=0.1, atol=5e-4)


def test_a_margin_shows_more_of_the_scene_and_leaves_the_rest_where_it_is():
    """Walls that go on beyond the image send more light into the corner; a single wall stays without error."""
    depth, amplitude = corner(130)
    maps = surface(depth, torch.ones_like(depth), amplitude, K)
    seen, beyond = (exchange_error(maps, K, HZ, margin=around) for around in (0, 2))
    h, w = SHAPE
    middle = (..., slice(h // 3, -h // 3), slice(w // 3, -w // 3))
    assert (beyond >= seen - 1e-4)[middle].all()
    assert (beyond - seen)[middle].max() < 0.5 * seen.max()


def test_the_bounces_that_are_left_out_add_little(monkeypatch):
    """In a right angle of white walls all that follow change the error by less than a hundredth."""
    depth, amplitude = corner(90)
    maps = surface(depth, torch.ones_like(depth), 1.7 * amplitude, K)
    some = exchange_error(maps, K, HZ)
    monkeypatch.setattr(multipath, "BOUNCES", 12)
    every = exchange_error(maps, K, HZ)
    assert (every - some).abs().max() < 0.01 * every.abs().max()


def test_what_a_network_reads_knows_neither_lamp_nor_gain_nor_contrast():
    """A camera of a quarter of the light, or of a tenth less contrast at its high frequency, gives the very same picture."""
    depth, amplitude = corner(90)
    low, high = (
        size * amplitude * torch.cat([(k * depth).cos(), (k * depth).sin()], dim=1)
        for size, k in ((1.4, 6), (1, 30))
    )
    valid, nothing = torch.ones_like(depth), torch.zeros_like(depth)

    def seen(*gains):
        phasor = torch.cat([low * gains[0], high * gains[1]], dim=1)
        pixels = valid.shape[-2:]
        frame = Frame(
            torch.zeros(1, 8, *pixels), phasor, depth, valid, nothing, nothing + 0.01, nothing,
            torch.tensor([[20e6, 100e6]]), K.float(), torch.zeros(1, 4, 8), torch.zeros(1, 2), torch.zeros(1, 5),
        )  # fmt: skip
        frame = with_cues(Frame(*(x.float() for x in frame)), (20e6, 100e6))
        return CompactInputs((2, 4))(frame).image

    for gains in ((0.25, 0.25), (1.0, 0.9)):
        torch.testing.assert_close(seen(*gains), seen(1.0, 1.0), atol=2e-3, rtol=0)
    assert (seen(1.0, 1.0)[..., :40, :] - seen(1.0, 1.0)[..., 40:80, :]).abs().max() > 0.1


def test_what_is_unlike_all_that_was_learned_from_is_the_sensor_s_smoothed_and_unsure():
    """A strange patch falls back there and nowhere else; what was learned from before stays familiar."""
    torch.manual_seed(0)
    model, data = joint(TINY_COMPACT).eval(), frame(batch=1)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("net.bias"):
                parameter.add_(0.3)
        free = model(data)
        model.inputs.remember([model.inputs(frame(batch=1, seed=k)).image for k in range(8)])
        known = model(data)
        strange = data._replace(cues=data.cues.clone())
        strange.cues[..., :12, :12] = 0.1  # ten times what there was
        model.inputs.remember([model.inputs(frame(batch=1, seed=9)).image])
        found = model(strange)
        features = model.inputs(strange)
    assert (
        (known.depth - free.depth).abs() < 1e-5
    ).float().mean() > 0.95  # numbers at random have their tails
    smooth = features.candidates[:, :1] - data.depth
    patch, far = (..., slice(8, 16), slice(8, 16)), (..., slice(48, 60), slice(48, 60))
    apart = (found.depth - doubled(data.depth + smooth))[patch].abs()
    assert apart.max() < 0.5 * smooth.abs().max() + 1e-3
    assert (found.error - known.error)[patch].min() > 0.005
    assert ((found.depth - known.depth)[far].abs() < 1e-5).float().mean() > 0.95
