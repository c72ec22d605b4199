"""The physical cues: interreflection and halo."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch")

from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.geometry.maps import rays, thin_intrinsics
from tofcapture_model.geometry.multipath import (
    SIGNAL,
    cues,
    exchange_error,
    halo_error,
    light,
    patches,
    surface,
)

K = torch.tensor([[90.0, 90.0, 59.5, 44.5]])
SHAPE = (90, 120)
HZ = 1e8


def corner(opening_deg):
    """Depth of two planes that meet in a vertical edge 0.8 m away, opening towards the camera, and white amplitude."""
    r = rays(K, *SHAPE)
    half = math.radians(opening_deg) / 2
    out = []
    for side in (1.0, -1.0):
        n = torch.tensor([-side * math.cos(half), 0.0, -math.sin(half)])
        out.append(n[2] * 0.8 / (n[None, :, None, None] * r).sum(1, keepdim=True))
    left, right = (torch.where(d > 0, d, torch.inf) for d in out)
    depth = torch.minimum(left, right).clamp_max(2.0)
    radial = depth * r.norm(dim=1, keepdim=True)
    return depth, 0.5 * SIGNAL * math.sin(half) / radial.square()


def test_a_corner_looks_deeper_and_a_wall_does_not():
    """In a concave right angle light takes the long way round: the edge seems farther off, more so than in an open one."""
    errors = []
    for opening in (90, 130):
        depth, amplitude = corner(opening)
        found = exchange_error(surface(depth, torch.ones_like(depth), amplitude, K), K, HZ)
        errors.append(found[..., 40:50, 45:75].mean().item())
    assert 0.002 < errors[1] < errors[0] < 0.1
    wall = torch.full((1, 1, *SHAPE), 0.8)
    flat = exchange_error(
        surface(wall, torch.ones_like(wall), torch.full_like(wall, 0.5 * SIGNAL / 0.64), K), K, HZ
    )
    assert flat.abs().max() < 0.1 * errors[1]


def test_a_facing_wall_is_as_white_as_it_is_and_patches_as_large_as_they_are():
    """The albedo is that of the wall all over the image; larger patches of a corner send as much light as smaller ones."""
    z, r = 0.8, rays(K, *SHAPE)
    distance = z * r.norm(dim=1, keepdim=True)
    amplitude = 0.5 * SIGNAL * (z / distance) / distance.square()
    wall = torch.full((1, 1, *SHAPE), z)
    maps = surface(wall, torch.ones_like(wall), amplitude, K)
    torch.testing.assert_close(maps[:, 4], torch.full_like(maps[:, 4], 0.5), rtol=0.02, atol=0)
    _, density = patches(thin_intrinsics(K, 10), 9, 12, 3)
    torch.testing.assert_close(density, torch.full_like(density, 9.0**2))
    depth, amplitude = corner(90)
    maps = surface(depth, torch.ones_like(depth), amplitude, K)
    coarse, fine = (exchange_error(maps, K, HZ, step=s)[..., 40:50, 45:75].mean() for s in (15, 10))
    assert coarse == pytest.approx(fine.item(), rel=0.15)


def test_dark_scenes_have_no_bounce():
    """Interreflection falls with the albedo of the other patches."""
    depth, amplitude = corner(90)
    bright, dark = (
        exchange_error(surface(depth, torch.ones_like(depth), a, K), K, HZ).mean().item()
        for a in (amplitude, amplitude / 10)
    )
    assert dark < 0.15 * bright


def test_the_halo_of_a_bright_foreground_draws_a_dark_background_nearer():
    """To first order the error of a halo's share kappa is kappa times the map."""
    k = 4 * math.pi * HZ / SPEED_OF_LIGHT
    radial = torch.full((1, 1, *SHAPE), 1.0)
    radial[..., :60] = 0.7
    amplitude = torch.where(radial < 0.9, 0.5, 0.05)
    phasor = torch.cat([amplitude * torch.cos(k * radial), amplitude * torch.sin(k * radial)], dim=1)
    error = halo_error(phasor, HZ)
    assert error[..., 70:80].max() < 0
    assert error[..., 40:50].abs().max() < error[..., 70:80].abs().max()
    even = torch.cat([torch.ones(1, 1, *SHAPE), torch.zeros(1, 1, *SHAPE)], dim=1)
    assert halo_error(even, HZ).abs().max() < 1e-6


def test_cues_are_five_finite_maps_even_of_noise():
    """Whatever a frame holds, the maps are finite."""
    g = torch.Generator().manual_seed(0)
    depth = 0.1 + 3 * torch.rand(1, 1, *SHAPE, generator=g)
    valid = (torch.rand(1, 1, *SHAPE, generator=g) > 0.5).float()
    noise = torch.randn(1, 4, *SHAPE, generator=g) * 1e-3
    found = cues(noise, depth, valid, 10 * torch.randn(1, 1, *SHAPE, generator=g), K, (2e7, HZ))
    assert found.shape == (1, 5, *SHAPE)
    assert torch.isfinite(found).all()


def test_a_black_room_is_not_taken_for_a_strong_lamp():
    """With all but a twentieth of the image black, the lamp is found within a factor of two, not eight times too weak."""
    depth = torch.full((1, 1, *SHAPE), 0.8)
    amplitude = SIGNAL / (depth * rays(K, *SHAPE).norm(dim=1, keepdim=True)).square()
    room = torch.full_like(depth, 0.05)
    room[..., : SHAPE[1] // 20] = 0.8
    phasor = torch.cat([amplitude * room, torch.zeros_like(depth)] * 2, dim=1)
    found = light(phasor, depth, torch.ones_like(depth), K)
    assert 0.5 < found[0, 0] / SIGNAL < 2
