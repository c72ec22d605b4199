"""Decode where the network is: the torch form of :class:`tofcapture.ops.phase.Decoder`, with its tables, for GPUs.

Only the taps, and what the host measures of their noise, are copied to the device. No value is looked at on the way, so a CUDA graph can hold all of it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tofcapture.camera import Camera
from tofcapture.channels import frequencies, wrap_table
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import information
from tofcapture.ops.phase.decoder import GROSS, RADIUS, most_odd, odd_beyond, rare
from tofcapture.ops.phase.float32 import SURE, UNLIKELY, Correction, tap_rows
from tofcapture.ops.phase.noise import NoiseLine, NoiseMeter, stuck_lines
from tofcapture.ops.phase.reference import UNKNOWN_CELSIUS
from tofcapture.rig import RangeError
from tofcapture_model.frame import MAX_RANGE, MIN_RANGE, Frame
from tofcapture_model.geometry.maps import expect_usable, intrinsics_of

_HELD = 1 << 25  # elements of the table of distances
_TINY = 1e-30


class Taps(NamedTuple):
    """Hold what is sent to the device for one frame, float32."""

    raw: Tensor  #: (K, H, W)
    celsius: Tensor  #: (), sensor temperature, NaN if unknown
    noise: Tensor  #: (3,), :class:`tofcapture.ops.phase.noise.NoiseLine`
    noisier: Tensor  #: (F,) times the noise model's variance that each frequency shows, :class:`tofcapture.ops.phase.noise.NoiseMeter`
    stuck: Tensor  #: (H, W), 1 in lines that repeat others


class _Range:
    """Range of one frequency: :class:`tofcapture.ops.phase.float32.Correction` with its tables on the device."""

    def __init__(self, error: RangeError, camera: Camera, device: torch.device) -> None:
        self.host = tables = Correction(error, camera)
        self.step, self.start, self.unambiguous = tables.step, tables.start, tables.R
        self.table = None if tables.plain else torch.from_numpy(tables.table).to(device)
        self.fixed = torch.from_numpy(tables.fixed).reshape(camera.shape).to(device)
        self.per_kelvin, self.reference, self.dark = tables.per_kelvin, tables.reference, float(tables.dark)

    def __call__(self, in_phase: Tensor, quadrature: Tensor, amplitude: Tensor, celsius: Tensor) -> Tensor:
        """Compute the range (H, W) within one ambiguity, metres, without what is known of its systematic error."""
        turns = torch.atan2(quadrature, in_phase) / (2 * math.pi)
        steps = (turns - torch.floor(turns)) * (self.unambiguous / self.step) - self.fixed
        if self.dark:
            steps = steps - self.dark / (amplitude + _TINY)
        if self.per_kelvin:
            steps = steps - self.per_kelvin * (celsius - self.reference)
        if self.table is None:
            range_ = steps * self.step + self.start
        else:
            entry = torch.nan_to_num(steps, nan=0.0).clamp(0, len(self.table) - 1).to(torch.int64)
            range_ = steps * self.step + self.table[entry]
        return range_ - torch.floor(range_ / self.unambiguous) * self.unambiguous


class TorchDecoder:
    """Decodes single frames of one camera on a device; arguments as for :func:`tofcapture_model.data.make_frame`."""

    def __init__(self, info: TofInfo, camera: Camera, device: torch.device) -> None:
        expect_usable(camera)
        info = replace(info, camera=camera)
        hz, known = frequencies(info.modulation_hz), information(info)
        errors = {e.modulation_hz: e for e in info.range_errors}
        self._range = [_Range(errors.get(f, RangeError(f)), camera, device) for f in hz]
        self._wraps, self._info, self._frequencies = wrap_table(hz, known, info.reach), info, len(hz)
        place = np.asarray(info.illuminator, dtype=np.float64)
        self._quarter, self._nearest = float(place @ place / 4), float(np.sqrt(place @ place) / 2)

        def there(array: NDArray[Any]) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._length, self._slant = there(camera.ray_lengths), there(camera.rays @ place / 2)
        rows = tap_rows(info)
        self._rows, self._spare = there(rows.weights), rows.spare
        U, self._tops = self._wraps.U, there(self._wraps.tops)
        weight = np.square(2 * np.pi / U) * known
        self._meter = NoiseMeter(info, self._wraps, [each.host for each in self._range], weight)
        self._unambiguous, self._weight, self._lean = (
            there(x)[:, None, None] for x in (U, weight, self._wraps.lean)
        )
        self._demodulation, self._modulation = demodulation(info).to(device), modulation(info).to(device)
        self._intrinsics = intrinsics_of(camera).to(device)

    def taps(self, raw: NDArray[Any], celsius: float) -> Taps:
        """Send one frame (K, H, W), any real dtype, and its temperature to the device; :class:`DataError` for another shape."""
        expected = (self._rows.shape[1], *self._length.shape)
        if raw.shape != expected:
            raise DataError(f"decode: expected raw of shape {expected}, got {raw.shape}")
        device, raw = self._length.device, np.ascontiguousarray(raw)
        known = celsius if np.isfinite(celsius) else UNKNOWN_CELSIUS
        stated = self._info.noise
        stuck, saturated = stuck_lines(raw), np.asarray(self._info.saturated(raw).any(axis=0))
        line = NoiseLine.of(stated, 1) if stated else self._meter(raw[None], known, stuck)
        told = celsius, line, self._meter.noisier(raw, saturated, line), stuck.reshape(raw.shape[1:])
        return Taps(
            torch.from_numpy(np.ascontiguousarray(raw, dtype=np.float32)).to(device),
            *(torch.tensor(x, dtype=torch.float32).to(device) for x in told),
        )

    def _inconsistent(
        self, rows: Tensor, power: Tensor, variance: Tensor, unsaturated: Tensor, taps: Taps
    ) -> Tensor:
        """Tell where taps (H, W) fit no cosine: what the processor's decoder flags as such."""
        out = taps.stuck > 0
        for own, (first, count), times in zip(power, self._spare, taps.noisier, strict=True):
            if count:
                misfit, noise = rows[first : first + count].square().sum(0), variance * times
                most = torch.minimum(noise * rare(count), own * float(GROSS))
                odd = (misfit > noise * odd_beyond(count)) & unsaturated
                columns, lines = (odd.sum(d, keepdim=True) > most_odd(odd.shape[d]) for d in (0, 1))
                out = out | (misfit > torch.maximum(variance * rare(count), most)) | columns | lines
        return out & unsaturated

    def __call__(self, taps: Taps) -> Frame:
        """Decode one frame: a batch of one, without cues."""
        raw, F = taps.raw, self._frequencies
        known = taps.celsius.isfinite()
        celsius = torch.where(known, taps.celsius, torch.full_like(taps.celsius, UNKNOWN_CELSIUS))
        # no matrix product: TF32, where somebody allows it, would round counts of 12 bits to 11
        rows = (self._rows[:, :, None, None] * raw).sum(1)
        real, imag = rows[:F], rows[F : 2 * F]
        amplitude = (real.square() + imag.square()).sqrt()
        each = zip(self._range, real, imag, amplitude, strict=True)
        ranges = torch.stack([range_(i, q, size, celsius) for range_, i, q, size in each])
        mean = rows[2 * F] if self._info.offset else amplitude[-1]
        slope, dark, least = taps.noise.unbind()
        variance = torch.maximum(mean * slope + dark, least)
        lit = amplitude.amin(0) > 0
        saturation = self._info.saturation
        unsaturated = (raw.amax(0) < saturation) & (raw.amin(0) > -saturation)
        sure = lit & unsaturated
        odd = self._inconsistent(rows, amplitude.square(), variance, unsaturated, taps)
        which = self._unwrapped(ranges, amplitude, variance, sure)
        unwrapped = ranges[-1] + self._tops[which]
        unwrapped = unwrapped + self._apart(ranges, unwrapped)
        fused = (self._lean * unwrapped).sum(0)
        start, period = self._wraps.start, self._wraps.period
        fused = fused - torch.floor((fused - start) / period) * period
        depth = (fused.square() - self._quarter) / (fused * self._length - self._slant)
        # False where it is no number
        valid = sure & ~odd & (fused > self._nearest) & (depth > MIN_RANGE) & (depth < MAX_RANGE)
        gap = torch.where(lit, unwrapped[0] - unwrapped[-1], torch.zeros_like(fused))
        ends = [0, F, F - 1, 2 * F - 1]
        frame = Frame(
            raw=raw / saturation,
            phasor=torch.stack([rows[i] for i in ends]) / saturation,
            depth=fill_nearest(depth, valid)[None],
            valid=valid[None].to(raw),
            confidence=amplitude[-1:] / saturation,
            gap=gap[None],
            cues=raw[:0],
            modulation=self._modulation,
            intrinsics=self._intrinsics,
            demodulation=self._demodulation,
            light=raw.new_zeros(2),
            noise=raw.new_zeros(5),
        )
        return Frame(*(x[None] for x in frame))

    def _unwrapped(self, ranges: Tensor, amplitude: Tensor, variance: Tensor, good: Tensor) -> Tensor:
        """Choose wrap vectors (H, W) as :func:`tofcapture.ops.phase.float32.choose` and ``ask`` do."""
        which, best, second = self._likeliest(ranges, amplitude.square())
        pooled, power = self._pooled(ranges, amplitude * good, good)
        found, _, _ = self._likeliest(pooled, power)
        mine = self._misfit(
            self._apart(ranges, ranges[-1] + self._tops[found]), self._weight * amplitude.square()
        )
        unsure = (second - best < SURE * variance) & good
        return torch.where(unsure & (mine - best <= UNLIKELY * variance), found, which)

    def _apart(self, ranges: Tensor, highest: Tensor) -> Tensor:
        """Compute how far ranges (F, H, W), with their nearest wraps, are from the unwrapped highest one (H, W)."""
        x = ranges - highest
        return x - torch.floor(x / self._unambiguous + 0.5) * self._unambiguous

    @staticmethod
    def _misfit(apart: Tensor, weight: Tensor) -> Tensor:
        """Compute chi squared times a tap's variance, (H, W), of how far ranges (F, H, W) are from the highest one's."""
        linear = (weight * apart).sum(0)
        return (weight * apart.square()).sum(0) - linear.square() / (weight.sum(0) + _TINY)

    def _likeliest(self, ranges: Tensor, power: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Find the best wrap vector (H, W), its misfit and the second one's."""
        weight = self._weight * power
        best = second = torch.full_like(ranges[0], math.inf)
        which = torch.zeros_like(ranges[0], dtype=torch.int64)
        for j, top in enumerate(self._tops):
            highest = ranges[-1] + top
            misfit = self._misfit(self._apart(ranges, highest), weight)
            least, most = self._wraps.bounds
            misfit = torch.where((highest >= least) & (highest <= most), misfit, math.inf)
            second = torch.minimum(second, torch.maximum(misfit, best))
            which = torch.where(misfit < best, j, which)
            best = torch.minimum(misfit, best)
        return which, best, second

    def _pooled(self, ranges: Tensor, amplitude: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
        """Add up the phasors of each pixel's window on its own surface: ranges and power (F, H, W)."""
        U, size = self._unambiguous, 2 * RADIUS + 1
        maps = torch.cat([ranges, amplitude, good[None].to(ranges)])
        around = nn.functional.unfold(maps[None], size, padding=RADIUS).reshape(
            len(maps), size**2, *ranges.shape[1:]
        )
        there, strength, seen = (around[: len(ranges)], around[len(ranges) : -1], around[-1])
        farther = (there[-1] - ranges[-1]) / U[-1]
        farther = farther - torch.floor(farther + 0.5)
        alike = seen * (0.5 + 0.5 * torch.cos(2 * math.pi * farther)).square()
        angle = 2 * math.pi * (there - farther * U[-1]) / U[:, None]
        real, imag = ((strength * alike * wave(angle)).sum(1) for wave in (torch.cos, torch.sin))
        turns = torch.atan2(imag, real) / (2 * math.pi)
        pooled = torch.cat([((turns - torch.floor(turns)) * U)[:-1], ranges[-1:]])
        return pooled, (real.square() + imag.square()) / (alike.square().sum(0) + _TINY)


def demodulation(info: TofInfo) -> Tensor:
    """Compute weights (2F, K) that turn taps into I and Q of the frequencies of :func:`modulation`."""
    hz = frequencies(info.modulation_hz)
    rows = [row for k in _order(len(hz)) for row in (k, len(hz) + k)]
    return torch.tensor(tap_rows(info).weights[rows], dtype=torch.float32)


def modulation(info: TofInfo) -> Tensor:
    """Return the lowest, the highest and the other modulation frequencies (F,), Hz; a camera of one frequency has it twice."""
    hz = frequencies(info.modulation_hz)
    return torch.tensor([hz[k] for k in _order(len(hz))], dtype=torch.float32)


def _order(count: int) -> list[int]:
    return [0, count - 1, *range(1, count - 1)]


def fill_nearest(image: Tensor, valid: Tensor) -> Tensor:
    """Give every pixel (H, W) outside ``valid`` the value of a nearest pixel inside; 1 where nothing is valid at all.

    Distances are exact: first the nearest of each column, then the nearest of those along the row, some rows at a time.
    """
    h, w = image.shape
    rows = torch.arange(h, dtype=torch.int32, device=image.device)[:, None]
    columns = torch.arange(w, dtype=torch.int32, device=image.device)
    far = 2 * (h + w)
    above = torch.where(valid, rows, -far).cummax(0).values
    below = torch.where(valid, rows, far + h).flip(0).cummin(0).values.flip(0)
    nearest = torch.where(rows - above <= below - rows, above, below)
    up_and_down, sideways = (rows - nearest).square(), (columns[:, None] - columns).square()
    # (row, pixel, column) of some rows at a time: all of a large image are gigabytes, which a graph would keep
    some = torch.split(up_and_down, max(1, _HELD // w**2))
    column = torch.cat([(part[:, None, :] + sideways).argmin(2) for part in some])
    row = nearest.gather(1, column).clamp(0, h - 1)
    filled = image.flatten()[row * w + column]
    return torch.where(valid.any(), filled, torch.ones_like(filled))
