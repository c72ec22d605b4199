"""Augmentations that a sensor could have seen, on raw taps, on whatever device the tensors are.

Noise and light change taps before they are decoded; flips and crops change what the camera is. Each keeps frame, ground truth,
intrinsics and light source consistent: decoding what comes out gives what decoding would have given, changed the same way.

::

    item = RawItem(raw, depth, normals, mask, intrinsics, illuminator)
    item = flip(item, axis=-1)
    item = item._replace(raw=scale_albedo(item.raw, 0.6, ambient=20.0, generator=generator))
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture.ops.phase import TapNoise
from tofcapture_model.data.frame import Frame
from tofcapture_model.geometry.intrinsics import cut_intrinsics, mirror_intrinsics, rays
from tofcapture_model.geometry.maps import metres_per_radian, turn

FULL_SCALE = 4095.0  # raw units where a 12-bit sensor saturates
_ORDERS = (0, 2, 4)  # of the phase: offset, and the wiggling of sensors with four phases


class BurstNoise(NamedTuple):
    """What it takes to draw the noise of a frame anew.

    Attributes
    ----------
    averaged
        Frames that a given one is the mean of.
    noise
        Of one tap of one frame.
    full_scale
        Raw value of saturation.
    """

    averaged: float
    noise: TapNoise
    full_scale: float


class RawItem(NamedTuple):
    """A raw frame with all that its geometry depends on; any leading batch axes, the same for all.

    Attributes
    ----------
    raw
        (..., K, H, W) taps, raw units.
    depth
        (..., 2H, 2W) ground truth, metres; NaN: not hit.
    normals
        (..., 2H, 2W, 3), unit, facing the camera; NaN: not hit.
    mask
        (..., 2H, 2W) uint8, bits of :class:`tofcapture.files.layout.MaskBit`.
    intrinsics
        (..., 4 or 9) of the (H, W) grid, see :mod:`tofcapture_model.geometry.intrinsics`.
    illuminator
        (..., 3) light source in the ToF frame, metres.
    """

    raw: Tensor
    depth: Tensor
    normals: Tensor
    mask: Tensor
    intrinsics: Tensor
    illuminator: Tensor


def flip(item: RawItem, axis: int = -1) -> RawItem:
    """Mirror left and right (axis -1) or up and down (axis -2): the world, and with it the camera and its lamp.

    The principal point and the lens, that component of the normals and of the light source change with the images; the taps' phases do not.
    """
    if axis not in (-1, -2):
        raise ConfigError(f"flip: expected the axis -1 or -2, got {axis}")
    component = -1 - axis  # x for columns, y for rows
    light, normals = item.illuminator.clone(), item.normals.clone()
    light[..., component] *= -1
    normals[..., component] *= -1
    return RawItem(
        item.raw.flip(axis),
        item.depth.flip(axis),
        normals.flip(axis - 1),
        item.mask.flip(axis),
        mirror_intrinsics(item.intrinsics, axis, item.raw.shape[axis]),
        light,
    )


def crop(item: RawItem, top: int, left: int, size: tuple[int, int]) -> RawItem:
    """Cut a window (height, width) at (top, left), pixels of the (H, W) grid; the principal point moves with it."""
    H, W = item.raw.shape[-2:]
    if not (0 <= top <= top + size[0] <= H and 0 <= left <= left + size[1] <= W and min(size) > 0):
        raise ConfigError(f"crop: expected a window inside {(H, W)}, got {size} at {(top, left)}")
    rows, cols = slice(top, top + size[0]), slice(left, left + size[1])
    fine = (..., slice(2 * rows.start, 2 * rows.stop), slice(2 * cols.start, 2 * cols.stop))
    return RawItem(
        item.raw[..., rows, cols],
        item.depth[fine],
        item.normals[(*fine, slice(None))],
        item.mask[fine],
        cut_intrinsics(item.intrinsics, top, left),
        item.illuminator,
    )


def scale_albedo(
    raw: Tensor,
    factor: Tensor | float,
    ambient: float,
    generator: torch.Generator,
    *,
    averaged: float = 1.0,
    noise: TapNoise | None = None,
    full_scale: float = FULL_SCALE,
) -> Tensor:
    """Taps as a sensor would have given them of a world whose surfaces return ``factor`` times the light.

    The signal is scaled and the ambient level kept. Of the noise that such taps have (``tap / gain + read^2``), the scaled ones
    bring a part along, ``factor^2 / averaged`` of theirs; the rest is drawn. Then taps are rounded and clipped. What was
    saturated stays so: how bright it was is not known. Light between surfaces, which goes with the product of their albedos,
    scales like the direct one here: keep factors near 1 where multipath matters.

    Parameters
    ----------
    raw
        (..., K, H, W), one frame or the mean of ``averaged`` frames; integers or floats, raw units.
    factor
        Positive, broadcastable to ``raw``.
    ambient
        Part of a tap that is not the lamp's light, raw units.
    generator
        Of the device that ``raw`` is on.
    averaged
        Frames that ``raw`` is the mean of; ``inf`` for taps without noise.
    noise
        Of one tap of one frame.
    full_scale
        Raw value of saturation.

    Returns
    -------
    float32 of whole numbers, like one frame, shaped like ``raw``.

    Raises
    ------
    ConfigError
        When the scaled taps would be noisier than a frame may be: ``factor^2 > averaged`` for a factor above 1.
    """
    noise = noise or TapNoise()
    taps = raw.to(torch.float32)
    # a number stays on the host, where it can be looked at without waiting for a GPU
    scale = factor.to(taps) if isinstance(factor, Tensor) else torch.tensor(factor, dtype=torch.float32)
    if not bool((scale > 0).all()) or bool(((scale > 1) & (scale**2 > averaged)).any()):
        raise ConfigError(
            f"scale_albedo: expected positive factors up to {max(averaged, 1.0) ** 0.5:g}, got up to {scale.max():g}",
            hint="a single frame can be made darker only; the mean of a burst brighter, too",
        )
    brighter = ambient + scale * (taps - ambient)
    wanted = _variance(brighter, noise)
    brought = scale**2 * _variance(taps, noise) / averaged
    drawn = torch.randn(taps.shape, generator=generator, device=taps.device)
    out = (brighter + drawn * (wanted - brought).clamp(min=0).sqrt()).round().clamp(0, full_scale)
    return torch.where(taps >= full_scale, full_scale, out)


def _variance(taps: Tensor, noise: TapNoise) -> Tensor:
    return taps.clamp(min=0) / noise.electrons_per_unit + noise.read**2


def redraw_noise(
    taps: Tensor,
    generator: torch.Generator,
    *,
    averaged: float = float("inf"),
    noise: TapNoise | None = None,
    full_scale: float = FULL_SCALE,
) -> Tensor:
    """One more frame of a static burst: shot and read noise drawn on the taps from their own values.

    Parameters
    ----------
    taps
        (..., K, H, W), the mean of ``averaged`` frames, raw units; with all of a burst the noise is that of one frame, exactly.
    generator
        Of the device that ``taps`` are on.
    averaged, noise, full_scale
        As for :func:`scale_albedo`.

    Returns
    -------
    float32 of whole numbers, shaped like ``taps``.
    """
    return scale_albedo(taps, 1.0, 0.0, generator, averaged=averaged, noise=noise, full_scale=full_scale)


def redraw_frame(frame: Frame, generator: torch.Generator, burst: BurstNoise) -> Frame:
    """One more frame of a static burst, decoded: fresh noise on the taps, and what it does to phasors, depth and gap.

    The turn of each phasor moves the range of its frequency, so calibration and wraps stay those of the mean. Cues stay, too:
    they are smooth. Holes keep their filling.

    Parameters
    ----------
    frame
        Decoded from the mean of ``burst.averaged`` frames; (B, ., H, W).
    generator
        Of the frame's device.
    burst
        Noise of its frames.

    Returns
    -------
    A frame like one of the burst: same statistics of raw, phasor, depth, confidence and gap.
    """
    raw = redraw_noise(frame.raw * burst.full_scale, generator, **burst._asdict()) / burst.full_scale
    phasor = torch.einsum("bck,bkhw->bchw", frame.demodulation, raw)
    low = turn(phasor[:, :2], frame.phasor[:, :2]) * metres_per_radian(frame, 0)
    high = turn(phasor[:, 2:], frame.phasor[:, 2:]) * metres_per_radian(frame, 1)
    confidence = phasor[:, 2:].square().sum(1, keepdim=True).sqrt()
    return _moved(frame, low, high)._replace(raw=raw, phasor=phasor, confidence=confidence)


def redraw_calibration(frame: Frame, generator: torch.Generator, radians: float) -> Frame:
    """The same frame as if another camera of the make had taken it, whose calibration is wrong in another way.

    Of each frequency's systematic error a part is never known: ``sum_m (a_m cos m phi + b_m sin m phi)`` over the measured
    phase phi, with m = 0, 2, 4, as :class:`tofcapture.rig.RangeError` writes it. ``a_m`` and ``b_m`` are drawn anew for each frame of the batch, so
    that no network can learn the errors of a few cameras by heart and take its depth for surer than it is.

    Parameters
    ----------
    frame
        (B, ., H, W).
    generator
        Of the frame's device.
    radians
        Standard deviation of each amplitude, as phase; a camera's error varies by ``sqrt(3)`` times this.

    Returns
    -------
    A frame of which depth, gap and the cue of the gap have moved; raw, phasors and confidence are what was measured.
    """
    low, high = (_drawn_error(frame, which, generator) * radians for which in (0, 1))
    moved = _moved(frame, low, high)
    cues = torch.cat([frame.cues[:, :-1], frame.cues[:, -1:] + low - high], dim=1)
    return moved._replace(cues=cues)


def _drawn_error(frame: Frame, which: int, generator: torch.Generator) -> Tensor:
    """(B, 1, H, W) metres per radian of amplitude, for the low (0) or the high (1) frequency."""
    in_phase, quadrature = frame.phasor[:, 2 * which : 2 * which + 2].chunk(2, dim=1)
    phase = torch.atan2(quadrature, in_phase)
    waves = torch.cat([wave(m * phase) for m in _ORDERS for wave in (torch.cos, torch.sin)], dim=1)
    amplitudes = torch.randn((*waves.shape[:2], 1, 1), generator=generator, device=waves.device)
    return (amplitudes * waves).sum(1, keepdim=True) * metres_per_radian(frame, which)


def _moved(frame: Frame, low: Tensor, high: Tensor) -> Frame:
    """Add (B, 1, H, W) metres to the range of each frequency: depth moves as the decoder fuses them, holes do not."""
    square = frame.modulation.square()
    lean = (square[:, :1] / square.sum(1, keepdim=True)).reshape(-1, 1, 1, 1)
    length = rays(frame.intrinsics, *frame.depth.shape[-2:]).square().sum(1, keepdim=True).sqrt()
    depth = frame.depth + frame.valid * (high + lean * (low - high)) / length
    return frame._replace(depth=depth, gap=frame.gap + low - high)
