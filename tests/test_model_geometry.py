"""Rays, plane fits, normals and propagation on the grid; the refinement."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")
from torch import nn

from tofcapture.camera import Camera
from tofcapture_model.evaluation.metrics import angles_deg
from tofcapture_model.geometry.maps import (
    depth_to_normals,
    local_planes,
    propagate_depth,
    rays,
    scale_intrinsics,
    shifted,
    side_window_planes,
    unit,
    unproject,
)
from tofcapture_model.networks.heads import Refinement

CAMERA = Camera(60, 48, 190.6, 200.8, 29.2, 22.7)


def intrinsics(camera, dtype=torch.float64):
    return torch.tensor([[camera.fx, camera.fy, camera.cx, camera.cy]], dtype=dtype)


def plane(camera, tilt_x, tilt_y, distance=0.8, dtype=torch.float64):
    """Depth and camera-facing normal of a plane that passes through (0, 0, distance)."""
    normal = torch.tensor([np.tan(tilt_x), np.tan(tilt_y), -1.0], dtype=dtype)
    normal = normal / normal.norm()
    slope = (normal[None, :, None, None] * rays(intrinsics(camera, dtype), *camera.shape)).sum(
        1, keepdim=True
    )
    return normal[2] * distance / slope, normal


def angle(a, b):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b, dim=1).norm(dim=1), (a * b).sum(1)))


def test_rays_agree_with_the_numpy_camera():
    """Torch and numpy unproject to the same points."""
    depth = np.random.default_rng(0).uniform(0.3, 1.5, CAMERA.shape)
    ours = unproject(torch.from_numpy(depth)[None, None], intrinsics(CAMERA))[0].permute(1, 2, 0)
    np.testing.assert_allclose(ours.numpy(), CAMERA.unproject(depth), atol=1e-12)


def test_doubled_intrinsics_average_to_the_coarse_pixel():
    """The four fine rays of a coarse pixel average to its ray, and the camera's own rule agrees."""
    fine = scale_intrinsics(intrinsics(CAMERA), 2)
    double = CAMERA.scaled(2)
    assert fine[0].tolist() == pytest.approx([double.fx, double.fy, double.cx, double.cy])
    mean = torch.nn.functional.avg_pool2d(rays(fine, *double.shape), 2)
    torch.testing.assert_close(mean, rays(intrinsics(CAMERA), *CAMERA.shape), atol=1e-12, rtol=0)


@settings(max_examples=15)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_normals_of_a_plane_are_exact(tilt_x, tilt_y):
    """Inverse depth is linear on a plane, so the fit is exact at any tilt, also at the border."""
    depth, normal = plane(CAMERA, tilt_x, tilt_y, distance=3.0)
    if depth.min() <= 0:
        return
    found = depth_to_normals(depth, torch.ones_like(depth), intrinsics(CAMERA), radius=4)
    assert torch.deg2rad(angle(found, normal[None, :, None, None].expand_as(found))).max() < 1e-6
    assert ((found * rays(intrinsics(CAMERA), *CAMERA.shape)).sum(1) < 0).all()


def test_normals_keep_their_accuracy_in_float32():
    """Moments are taken about the mean inverse depth, so float32 costs less than 0.01 degrees."""
    depth, normal = plane(CAMERA, 0.6, -0.4, dtype=torch.float32)
    found = depth_to_normals(depth, torch.ones_like(depth), intrinsics(CAMERA, torch.float32))
    assert angle(found, normal[None, :, None, None].expand_as(found)).max() < 0.01


def test_noise_of_a_facing_plane_gives_the_known_angle():
    """3 mm at 1 m, 9 x 9 window, fx 400: 3.8 degrees on average (method.md 9.7)."""
    camera = Camera(160, 120, 400, 400, 79.5, 59.5)
    noisy = 1 + 0.003 * torch.randn(
        1, 1, *camera.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    found = depth_to_normals(noisy, torch.ones_like(noisy), intrinsics(camera))[:, :, 6:-6, 6:-6]
    facing = torch.tensor([0.0, 0, -1], dtype=torch.float64)[None, :, None, None].expand_as(found)
    assert angle(found, facing).mean().item() == pytest.approx(3.8, abs=0.4)


def test_holes_take_no_part_in_the_fit():
    """A filled hole with weight zero does not move the plane."""
    depth, _ = plane(CAMERA, 0.3, 0.2)
    valid = torch.ones_like(depth)
    spoiled = depth.clone()
    spoiled[..., 20:24, 20:24], valid[..., 20:24, 20:24] = 5.0, 0.0
    torch.testing.assert_close(
        local_planes(spoiled, valid, 4)[0],
        local_planes(depth, torch.ones_like(depth), 4)[0],
        atol=1e-6,
        rtol=0,
    )


def test_side_windows_do_not_mix_the_two_sides_of_a_step():
    """Near a 10 cm step the side-window fit stays on its own side, the centred one does not."""
    depth = torch.full((1, 1, 48, 60), 0.8, dtype=torch.float64)
    depth[..., 30:] = 0.9
    sided = 1 / side_window_planes(depth, torch.ones_like(depth), 3)[0][:, :1]
    centred = 1 / local_planes(depth, torch.ones_like(depth), 3)[0][:, :1]
    assert (sided - depth).abs().max() < 1e-4
    assert (centred - depth).abs().max() > 1e-2


def test_shifted_repeats_the_border():
    """A shift beyond the image reads the border pixel."""
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    assert shifted(image, 1, 0)[0, 0, 2].tolist() == image[0, 0, 2].tolist()
    assert shifted(image, 0, -2)[0, 0, 0].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_propagation_reproduces_a_plane(sign):
    """With the true normals, of either sign, every neighbour votes for the very depth that is there."""
    depth, normal = plane(CAMERA, 0.5, -0.7)
    normals = sign * normal[None, :, None, None].expand(1, 3, *CAMERA.shape)
    moved = propagate_depth(depth, normals, intrinsics(CAMERA), torch.ones_like(depth))
    assert (moved - depth).abs().max() < 1e-7


def test_propagation_answers_each_image_of_a_batch_by_itself():
    """Two images together give what each gives alone."""
    (a, n), (b, m) = (plane(CAMERA, *slopes) for slopes in ((0.5, -0.7), (-0.2, 0.1)))
    generator = torch.Generator().manual_seed(0)
    depth = torch.cat([a, b]) + 0.002 * torch.randn((2, *a.shape[1:]), generator=generator).to(a)
    normals = torch.stack([n, m])[..., None, None].expand(2, 3, *CAMERA.shape)
    both = propagate_depth(depth, normals, intrinsics(CAMERA).expand(2, -1), torch.ones_like(depth))
    for k in range(2):
        one = (x[k : k + 1] for x in (depth, normals))
        alone = propagate_depth(*one, intrinsics(CAMERA), torch.ones_like(a))
        torch.testing.assert_close(both[k : k + 1], alone)


def test_propagation_denoises_and_respects_jumps():
    """Noise falls by the square root of the voters, and a 5 cm step stays where it is."""
    generator = torch.Generator().manual_seed(1)
    truth = torch.full((1, 1, 48, 60), 0.8, dtype=torch.float64)
    truth[..., 30:] = 0.85
    noisy = truth + 0.001 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    facing = torch.tensor([0.0, 0, -1], dtype=torch.float64)[None, :, None, None].expand(1, 3, 48, 60)
    moved = propagate_depth(noisy, facing, intrinsics(CAMERA), torch.ones_like(truth))
    assert (moved - truth).std() < 0.35 * (noisy - truth).std()
    assert (moved - truth).abs().max() < 0.003


def test_untrained_refinement_takes_what_the_geometry_says_and_can_learn():
    """Gains start at one: normals are those of the depth, whatever they were; depth is smoother; without gains nothing changes."""
    refinement = Refinement(2, 1)
    depth, normal = plane(CAMERA, 0.2, 0.1, dtype=torch.float32)
    noisy = depth + 0.002 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    normals = unit(
        normal[None, :, None, None]
        + 0.1 * torch.randn(1, 3, *CAMERA.shape, generator=torch.Generator().manual_seed(2))
    )
    out, turned = refinement(noisy, normals, torch.full_like(depth, 0.003), intrinsics(CAMERA, torch.float32))
    truth = normal[None, :, None, None].expand_as(turned)
    assert (
        angles_deg(turned.flatten(2), truth.flatten(2)).mean()
        < 0.3 * angles_deg(normals.flatten(2), truth.flatten(2)).mean()
    )
    assert (out - depth).std() < 0.6 * (noisy - depth).std()
    (out - depth).square().mean().backward()
    assert (refinement.depth_gain.grad != 0).all()
    nn.init.zeros_(refinement.depth_gain)
    nn.init.zeros_(refinement.normal_gain)
    out, turned = refinement(noisy, normals, torch.full_like(depth, 0.003), intrinsics(CAMERA, torch.float32))
    assert torch.equal(out, noisy)
    torch.testing.assert_close(turned, normals)
