"""What the physics of light says about the depth error of a frame, before anything is learned.

Three maps in metres, computed from whole frames (crops do not show the rest of the scene): one diffuse bounce, the halo of the
lens, and the two frequencies' disagreement. Networks read them and learn how far to believe them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture.rig import SPEED_OF_LIGHT
from tofcapture_model.geometry import plane_normals, rays, side_window_planes

SIGNAL = 0.04  # of saturation: amplitude of a white patch that faces the sensor at 1 m; networks correct it by a factor
STEP = 6  # pixels per patch
_GRAZING = 0.15  # cosine below which the direct light of a patch says nothing
_FAINT = 1e-3  # of saturation; below it an amplitude is noise


def cues(phasor: Tensor, depth: Tensor, valid: Tensor, gap: Tensor, intrinsics: Tensor, hz: float) -> Tensor:
    """Stack the three maps.

    Parameters
    ----------
    phasor
        (B, 4, H, W) I and Q of the low, then of the high frequency, units of saturation.
    depth, valid, gap
        (B, 1, H, W) decoded depth and its weight; range of the low minus range of the high frequency; metres.
    intrinsics
        (B, 4).
    hz
        High modulation frequency.

    Returns
    -------
    (B, 3, H, W) metres: error by one bounce, error by the halo if all light were in it, gap averaged over a wide window
    """
    high = phasor[:, 2:]
    amplitude = high.square().sum(1, keepdim=True).sqrt()
    bounce = bounce_error(depth, valid, amplitude, intrinsics, hz)
    broad = _blur(gap.clamp(-0.3, 0.3) * valid, 8) / _blur(valid, 8).clamp_min(1e-3)
    return torch.cat([bounce, halo_error(high, hz), broad], dim=1)


def _blur(image: Tensor, radius: int) -> Tensor:
    """Box mean twice; the border counts what is there."""
    for _ in range(2):
        image = F.avg_pool2d(image, 2 * radius + 1, 1, radius, count_include_pad=False)
    return image


def halo_error(phasor: Tensor, hz: float, shrink: int = 6) -> Tensor:
    """Depth error if the lens scattered all light of the image once over each pixel, to first order.

    A halo adds ``kappa (z * h)`` to the phasor z; the error of a small share kappa is kappa times this map.

    Parameters
    ----------
    phasor
        (B, 2, H, W) I and Q.
    hz
        Modulation frequency.
    shrink
        Pixels per cell of the blurred image; the halo is blurred over some ten cells.

    Returns
    -------
    (B, 1, H, W) metres, within +-1
    """
    cells = F.avg_pool2d(phasor, shrink, ceil_mode=True, count_include_pad=False)
    halo = F.interpolate(_blur(cells, 5), size=phasor.shape[-2:], mode="bilinear", align_corners=False)
    across = halo[:, 1:] * phasor[:, :1] - halo[:, :1] * phasor[:, 1:]
    k = 4 * math.pi * hz / SPEED_OF_LIGHT
    return (across / phasor.square().sum(1, keepdim=True).clamp_min(_FAINT**2) / k).clamp(-1, 1)


def bounce_error(
    depth: Tensor, valid: Tensor, amplitude: Tensor, intrinsics: Tensor, hz: float, step: int = STEP
) -> Tensor:
    """Estimate the depth error of one diffuse bounce (after Fuchs 2010 and Jimenez 2014, whom the paper names).

    Every visible patch q lights every visible patch p. What p gets from the sensor and what it gets over q are reflected by
    the same albedo, so that only geometry, the measured amplitude of q and one constant of the sensor remain::

        z_ind / z_dir (p) = d_p^2 / cos_p  sum_q  A_q / signal  cos_pq cos_qp / (pi r^2)  dS_q  e^{i k (d_q + r - d_p) / 2}

    Occlusion between patches and what lies out of sight are not in it.

    Parameters
    ----------
    depth, valid, amplitude
        (B, 1, H, W) decoded depth in metres, its weight, amplitude in units of saturation.
    intrinsics
        (B, 4).
    hz
        Modulation frequency.
    step
        Pixels per patch; time goes with its inverse fourth power.

    Returns
    -------
    (B, 1, H, W) metres, positive where things look too far away
    """
    planes, _ = side_window_planes(depth, valid + 1e-3, 2)
    normals = plane_normals(planes, intrinsics)
    smooth = (1 / planes[:, :1].clamp_min(0.1)) * valid + depth * (1 - valid)
    points = smooth * rays(intrinsics, *depth.shape[-2:])
    light = F.avg_pool2d(amplitude, 3, 1, 1, count_include_pad=False)
    area = (
        smooth.square() / (intrinsics[:, 0] * intrinsics[:, 1])[:, None, None, None]
    )  # facing; / cos of the ray below
    coarse = torch.cat([points, normals, light * valid, area], dim=1)[
        :, :, step // 2 :: step, step // 2 :: step
    ]
    b, _, h, w = coarse.shape
    found = torch.stack([_exchange(item.flatten(1), hz, step) for item in coarse])
    return F.interpolate(
        found.reshape(b, 1, h, w), size=depth.shape[-2:], mode="bilinear", align_corners=False
    )


def _exchange(patches: Tensor, hz: float, step: int) -> Tensor:
    """Depth error (N,) of patches (8, N): points, normals, amplitude, facing area of a pixel."""
    p, n, light, area = patches[:3].T, patches[3:6].T, patches[6], patches[7]
    distance = p.norm(dim=1)
    facing = -(p * n).sum(1) / distance
    surface = area * step**2 / facing.clamp_min(_GRAZING)
    dot = p @ p.T
    square = p.square().sum(1)
    r2 = (square[:, None] + square[None] - 2 * dot).clamp_min(0) + surface[None]  # a patch is no point
    cross = n @ p.T  # n_i . p_j
    own = (n * p).sum(1)
    receive = (cross - own[:, None]).clamp_min(0)  # n_p . (q - p)
    emit = (cross.T - own[None]).clamp_min(0)  # n_q . (p - q)
    weight = receive * emit / (math.pi * r2.square()) * (light * surface / SIGNAL)[None]
    extra = (distance[None] + r2.sqrt() - distance[:, None]) / 2  # half the path, as ranges are
    k = 4 * math.pi * hz / SPEED_OF_LIGHT
    direct = facing.clamp_min(_GRAZING) / square
    sine, cosine = (weight * torch.sin(k * extra)).sum(1), (weight * torch.cos(k * extra)).sum(1)
    return torch.atan2(sine, direct + cosine.clamp_min(0)) / k
