"""Cues: what the physics of light says about the depth error of a frame, before anything is learned.

They are computed from whole frames, as crops do not show the rest of the scene. Networks learn how far to believe them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture_model.frame import Frame
from tofcapture_model.geometry.maps import (
    pixel_slopes,
    plane_normals,
    rays,
    side_window_planes,
    thin_intrinsics,
)

SIGNAL = 0.04  # of a white surface that faces the sensor at 1 m: what every camera's light is scaled to
STEP = 10  # pixels per patch
BOUNCES = 3  # the fourth adds less than the first lacks in knowledge
_WHITEST = 0.9  # albedo
_FAR = 3.0  # m
_GRAZING = 0.15  # cosine below which the direct light of a patch says nothing
_FAINT = 1e-3  # below it an amplitude is noise
_TINY = 1e-12
_BRIGHT = 0.98  # quantile of brightness that a few mirrors do not reach
_PALE, _PALENESS = 0.9, 0.5  # quantile of brightness that is taken for pale, and its albedo on average


def light(phasor: Tensor, depth: Tensor, valid: Tensor, intrinsics: Tensor) -> Tensor:
    """Estimate from a frame what its camera's lamp, gain and contrast are: (B, 2), of the lowest and the highest frequency.

    It is the amplitude by which a white surface would answer that faces the sensor at 1 m, in the unit of ``phasor``. The brightest
    tenth of a frame, by the inverse square of its range, is taken for pale; the frequencies are compared by their median. Nobody
    needs to know the camera, and no network can tell a weaker lamp or less contrast from another one.

    ``phasor`` (B, 4, H, W), ``depth`` and ``valid`` (B, 1, H, W) are those of whole frames.
    """
    low, high = (z.square().sum(1)[:, ::3, ::3].flatten(1).sqrt() for z in phasor.chunk(2, dim=1))
    ray = rays(intrinsics, *depth.shape[-2:]).square().sum(1)
    square = (ray * depth[:, 0].square())[:, ::3, ::3].flatten(1)
    seen = (valid[:, 0, ::3, ::3].flatten(1) > 0) & (low > 0) & (high > 0)
    white = _quantile(high * square, seen, _PALE) / _PALENESS
    # in a black room nine tenths are black; nothing is whiter than white
    white = torch.maximum(white, _quantile(high * square, seen, _BRIGHT) / _WHITEST)
    ratio = _quantile((low.clamp_min(_TINY) / high.clamp_min(_TINY)).log(), seen, 0.5).exp()
    found = torch.stack([white * ratio, white], dim=1)
    return torch.where(found > 0, found, torch.full_like(found, SIGNAL)).clamp(1e-4, 1e2)


def _quantile(values: Tensor, among: Tensor, share: float) -> Tensor:
    """Find a quantile of some of the values (B, N) of each row, without a look at how many they are; 0 of none."""
    ordered = torch.where(among, values, torch.full_like(values, torch.inf)).sort(dim=1).values
    count = among.sum(1, keepdim=True)
    found = ordered.gather(1, (share * (count - 1).clamp_min(0)).long())
    return torch.where(count > 0, found, torch.zeros_like(found))[:, 0]


def usual_phasor(frame: Frame) -> Tensor:
    """Scale the phasor (B, 4, H, W) of each frequency to a lamp whose white surface at 1 m answers with :data:`SIGNAL`."""
    scale = (SIGNAL / frame.light).repeat_interleave(2, dim=1)
    return frame.phasor * scale[:, :, None, None]


def cues(
    phasor: Tensor, depth: Tensor, valid: Tensor, gap: Tensor, intrinsics: Tensor, hz: tuple[float, float]
) -> Tensor:
    """Stack five maps of what physics expects.

    Returns (B, 5, H, W) metres: error by interreflection of what is seen; the same with the scene continued
    beyond the image; error by the halo if all light were in it; gap averaged over a wide window; gap that the second error makes
    with that of the lowest frequency.

    Parameters
    ----------
    phasor
        (B, 4, H, W) I and Q of the lowest, then of the highest frequency, as of :func:`usual_phasor`.
    depth, valid, gap
        (B, 1, H, W) decoded depth and its weight; range of the low minus range of the high frequency; metres.
    intrinsics, hz
        (B, 4 or 12), and the lowest and the highest modulation frequency.
    """
    lowest, highest = hz
    high = phasor[:, 2:]
    amplitude = high.square().sum(1, keepdim=True).sqrt()
    maps = surface(depth, valid, amplitude, intrinsics)
    seen = exchange_error(maps, intrinsics, highest)
    beyond = exchange_error(maps, intrinsics, highest, step=2 * STEP, margin=3)
    wide = _broad(gap.clamp(-0.3, 0.3), valid)
    apart = torch.zeros_like(seen)
    if lowest < highest:
        apart = exchange_error(maps, intrinsics, lowest, step=2 * STEP, margin=3) - beyond
    return torch.cat([seen, beyond, halo_error(high, highest), wide, apart], dim=1)


def _broad(image: Tensor, valid: Tensor, shrink: int = 4) -> Tensor:
    """Mean over some 30 pixels of what is valid, on cells of ``shrink`` pixels."""
    cells = F.avg_pool2d(
        torch.cat([image * valid, valid], dim=1), shrink, ceil_mode=True, count_include_pad=False
    )
    total, weight = _blur(cells, 2).chunk(2, dim=1)
    mean = total / weight.clamp_min(1e-3)
    return F.interpolate(mean, size=image.shape[-2:], mode="bilinear", align_corners=False)


def _blur(image: Tensor, radius: int) -> Tensor:
    """Box mean twice; the border counts what is there."""
    for _ in range(2):
        image = F.avg_pool2d(image, 2 * radius + 1, 1, radius, count_include_pad=False)
    return image


def halo_error(phasor: Tensor, hz: float, shrink: int = 6) -> Tensor:
    """Return the depth error (B, 1, H, W), within +-1 m, if the lens scattered all light of the image once over each pixel.

    A halo adds ``kappa (z * h)`` to the phasor z (B, 2, H, W); the error of a small share kappa is kappa times this map.
    ``shrink`` is pixels per cell of the blurred image; the halo is blurred over some ten cells.
    """
    cells = F.avg_pool2d(phasor, shrink, ceil_mode=True, count_include_pad=False)
    halo = F.interpolate(_blur(cells, 5), size=phasor.shape[-2:], mode="bilinear", align_corners=False)
    across = halo[:, 1:] * phasor[:, :1] - halo[:, :1] * phasor[:, 1:]
    k = 4 * math.pi * hz / SPEED_OF_LIGHT
    return (across / phasor.square().sum(1, keepdim=True).clamp_min(_FAINT**2) / k).clamp(-1, 1)


def surface(depth: Tensor, valid: Tensor, amplitude: Tensor, intrinsics: Tensor) -> Tensor:
    """Fit every pixel's tangent plane and albedo (B, 5, H, W): unit normal, ``n . p`` in metres, albedo by the amplitude."""
    planes, _ = side_window_planes(depth, valid + 1e-3, 2)
    ray = rays(intrinsics, *depth.shape[-2:])
    normals = plane_normals(planes, intrinsics, ray)
    smooth = (1 / planes[:, :1].clamp_min(0.1)) * valid + depth * (1 - valid)
    slope = (normals * ray).sum(1, keepdim=True)  # negative
    square = ray.square().sum(1, keepdim=True)
    light = F.avg_pool2d(amplitude, 3, 1, 1, count_include_pad=False) * valid
    direct = (-slope / square.sqrt()).clamp_min(_GRAZING) / (square * smooth.square())
    albedo = (light / SIGNAL / direct).clamp_max(_WHITEST)
    return torch.cat([normals, slope * smooth, albedo], dim=1)


def exchange_error(
    surfaces: Tensor, intrinsics: Tensor, hz: float, step: int = STEP, margin: int = 0
) -> Tensor:
    """Estimate the depth error of diffuse interreflection (after Fuchs 2010 and Jimenez 2014, whom the paper names).

    The visible patches are a closed world of Lambertian surfaces: radiosity ``x = rho (E + K x)`` with the irradiance
    ``E_p = cos_p / d_p^2 e^{i k d_p / 2}`` and ``K_pq = cos_pq cos_qp / (pi r^2) dS_q e^{i k r / 2}``. Albedos come from the
    amplitudes and one constant of the sensor. The error is the angle of ``1 + (K x)_p / E_p``, in which the patch's own albedo
    cancels. Occlusion between patches and what lies out of sight are not in it.

    ``surfaces`` (B, 5, H, W) are those of :func:`surface`. A patch has ``step`` pixels; time goes with their inverse fourth power.
    ``margin`` patches are added beyond each border, on its planes: the table does not end where the image does.

    Returns (B, 1, H, W) metres, positive where things look too far away.
    """
    size = surfaces.shape[-2:]
    maps = surfaces[:, :, step // 2 :: step, step // 2 :: step]
    h, w = maps.shape[-2:]
    around = F.pad(maps, (margin, margin, margin, margin), mode="replicate")
    r, density = patches(thin_intrinsics(intrinsics, step), h, w, margin)
    found = torch.stack(
        [
            _exchange(m.flatten(1), q.flatten(1), d.flatten(), hz)
            for m, q, d in zip(around, r, density, strict=True)
        ]
    )
    inner = found.reshape(-1, 1, *around.shape[-2:])[..., margin : margin + h, margin : margin + w]
    return F.interpolate(inner, size=size, mode="bilinear", align_corners=False)


def patches(grid: Tensor, height: int, width: int, margin: int) -> tuple[Tensor, Tensor]:
    """Return rays (B, 3, H, W) of a grid with ``margin`` more pixels at each border, and pixels per unit of z = 1 (B, H, W).

    A lens is known inside its image only, and many fold outside: beyond the border it goes on straight.
    """
    r = rays(grid, height, width)
    x, y = r[:, :2].unbind(1)
    ux, uy, vx, vy = (d.expand_as(x) for d in pixel_slopes(grid, x, y))
    density = ux * vy - uy * vx
    border = torch.stack([x, y, density, vy / density, -uy / density, -vx / density, ux / density], dim=1)
    x, y, density, xu, xv, yu, yv = F.pad(border, (margin,) * 4, mode="replicate").unbind(1)
    rows, columns = (torch.arange(-margin, n + margin, device=x.device) for n in (height, width))
    beyond_v, beyond_u = rows - rows.clamp(0, height - 1), columns - columns.clamp(0, width - 1)
    x = x + xu * beyond_u + xv * beyond_v[:, None]
    y = y + yu * beyond_u + yv * beyond_v[:, None]
    return torch.stack([x, y, torch.ones_like(x)], dim=1), density


def _exchange(maps: Tensor, r: Tensor, density: Tensor, hz: float) -> Tensor:
    """Depth error (N,) of patches (5, N) as :func:`surface` has them; rays (3, N); patches per unit of the plane z = 1 (N,)."""
    n = maps[:3].T
    slope = (maps[:3] * r).sum(0).clamp_max(-_GRAZING / 2)
    z = (maps[3] / slope).clamp(0.1, _FAR)
    p = (r * z).T
    k = 4 * math.pi * hz / SPEED_OF_LIGHT  # phase per metre of range, which is half a path
    distance = p.norm(dim=1)
    facing = (-(p * n).sum(1) / distance).clamp_min(_GRAZING)
    # a patch's solid angle is (z / d)^3 / density
    surface = z.pow(3) / distance / density / facing
    transfer = _transfer(p, n, surface, k)
    direct = torch.polar(facing / distance.square(), k * distance / 2)
    albedo, radiosity = maps[4], maps[4] * direct
    for _ in range(BOUNCES):
        indirect = transfer @ radiosity
        radiosity = albedo * (direct + indirect)
    return torch.angle(1 + indirect / direct) / k


def _transfer(p: Tensor, n: Tensor, surface: Tensor, k: float) -> Tensor:
    """Irradiance phasor at patch i per radiosity of patch j, complex (N, N): cos cos / (pi r^2) dS_j e^(i k r / 2)."""
    square = p.square().sum(1)
    r2 = (square[:, None] + square[None] - 2 * p @ p.T).clamp_min(0) + surface[None]  # a patch is no point
    own = (n * p).sum(1)
    towards = (n @ p.T - own[:, None]).clamp_min(0)  # n_i . (p_j - p_i)
    weight = towards * towards.T / (math.pi * r2.square()) * surface[None]
    return torch.polar(weight, k / 2 * r2.sqrt())
