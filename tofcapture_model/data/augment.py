"""Changes of decoded frames that a sensor could have seen: another draw of the noise, another camera's calibration.

Each keeps raw taps, phasors, depth and gap consistent: decoding the changed taps would have given the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tofcapture_model.frame import Frame
from tofcapture_model.geometry.maps import metres_per_radian, rays, turn

_WIDE = 3  # cue that is the gap over a wide window
_ORDERS = (0, 2, 4)  # of the phase: offset, and the wiggling of sensors with four phases


class BurstNoise(NamedTuple):
    """Hold what it takes to draw the noise of a frame anew: numbers, or (B, 1, 1, 1) of each of a batch."""

    averaged: Any  #: frames that a given one is the mean of
    electrons_per_unit: Any  #: of one tap of one frame, as :class:`tofcapture.ops.phase.TapNoise` has them
    read: Any
    full_scale: Any  #: raw value of saturation
    least: Any = 0.0  #: smallest raw value; below 0 where taps are signed


def redraw_noise(taps: Tensor, generator: torch.Generator, burst: BurstNoise) -> Tensor:
    """Draw one more frame of a static burst: shot and read noise from the taps' own values, (..., K, H, W) raw units.

    The mean brings ``1 / averaged`` of the variance along; the rest is drawn. Taps are rounded and clipped as a sensor does, and
    what was saturated stays so. The generator is of the taps' device.
    """
    taps = taps.to(torch.float32)
    variance = taps.clamp(min=0) / burst.electrons_per_unit + burst.read**2
    drawn = torch.randn(taps.shape, generator=generator, device=taps.device)
    lacking = (variance - variance / burst.averaged).clamp(min=0).sqrt()
    full, least = (torch.as_tensor(x, device=taps.device) for x in (burst.full_scale, burst.least))
    out = (taps + drawn * lacking).round().clamp(least, full)
    return torch.where(taps >= full, full, out)


def redraw_frame(frame: Frame, generator: torch.Generator) -> Frame:
    """Draw one more frame of a static burst, decoded: fresh noise on the taps, phasors, depth, confidence and gap.

    ``frame`` (B, ., H, W) is decoded from the mean of some frames, as its ``noise`` says. The turn of each phasor moves the range of its
    frequency, so calibration and wraps stay. Cues stay, too, as they are smooth. Holes keep their filling.
    """
    burst = BurstNoise(*frame.noise.T.reshape(5, -1, 1, 1, 1))
    raw = redraw_noise(frame.raw * burst.full_scale, generator, burst) / burst.full_scale
    before, after = _phasors(frame, frame.raw), _phasors(frame, raw)
    moves = [
        turn(z, was) * metres_per_radian(frame, k)
        for k, (z, was) in enumerate(zip(after, before, strict=True))
    ]
    phasor = torch.cat(after[:2], dim=1)
    confidence = after[1].square().sum(1, keepdim=True).sqrt()
    return _moved(frame, moves)._replace(raw=raw, phasor=phasor, confidence=confidence)


def _phasors(frame: Frame, raw: Tensor) -> tuple[Tensor, ...]:
    """Compute the phasors (B, 2, H, W) of taps (B, K, H, W), of each frequency as ``frame.modulation`` has them."""
    phasors = torch.einsum("bck,bkhw->bchw", frame.demodulation, raw)
    return phasors.chunk(phasors.shape[1] // 2, dim=1)


def redraw_calibration(frame: Frame, generator: torch.Generator, radians: float | Tensor) -> Frame:
    """Give each frame of a batch another calibration error, as another camera of the make would have.

    A part of each frequency's systematic error is never known: ``sum_m (a_m cos m phi + b_m sin m phi)`` over the measured phase
    phi, m = 0, 2, 4, as :class:`tofcapture.rig.RangeError` writes it. Drawn anew, no network learns a few cameras by heart.
    ``radians``, one or (B, 1, 1, 1), is the standard deviation of each amplitude; a camera's error varies by ``sqrt(3)`` times this. Depth, gap and the
    gap's cue move; raw, phasors and confidence are what was measured.
    """
    phasors = (frame.phasor[:, :2], frame.phasor[:, 2:], *_phasors(frame, frame.raw)[2:])
    drawn = [_drawn_error(frame, k, z, generator) * radians for k, z in enumerate(phasors)]
    one = (frame.modulation[:, 0] == frame.modulation[:, 1]).reshape(-1, 1, 1, 1)
    drawn[0] = torch.where(one, drawn[1], drawn[0])  # one frequency has one error
    moved = _moved(frame, drawn)
    wide = frame.cues[:, _WIDE : _WIDE + 1] + drawn[0] - drawn[1]
    cues = torch.cat([frame.cues[:, :_WIDE], wide, frame.cues[:, _WIDE + 1 :]], dim=1)
    return moved._replace(cues=cues)


def _drawn_error(frame: Frame, which: int, phasor: Tensor, generator: torch.Generator) -> Tensor:
    """(B, 1, H, W) metres per radian of amplitude, for one of the frequencies and its phasor (B, 2, H, W)."""
    in_phase, quadrature = phasor.chunk(2, dim=1)
    phase = torch.atan2(quadrature, in_phase)
    waves = torch.cat([wave(m * phase) for m in _ORDERS for wave in (torch.cos, torch.sin)], dim=1)
    amplitudes = torch.randn((*waves.shape[:2], 1, 1), generator=generator, device=waves.device)
    return (amplitudes * waves).sum(1, keepdim=True) * metres_per_radian(frame, which)


def _moved(frame: Frame, moves: Sequence[Tensor]) -> Frame:
    """Add (B, 1, H, W) metres to the range of each frequency: depth moves as the decoder fuses them, holes do not."""
    square = frame.modulation.square()
    leans = (square / square.sum(1, keepdim=True)).T.reshape(len(moves), -1, 1, 1, 1)
    fused = sum((lean * move for lean, move in zip(leans, moves, strict=True)), torch.zeros_like(frame.depth))
    length = rays(frame.intrinsics, *frame.depth.shape[-2:]).square().sum(1, keepdim=True).sqrt()
    return frame._replace(
        depth=frame.depth + frame.valid * fused / length, gap=frame.gap + moves[0] - moves[1]
    )
