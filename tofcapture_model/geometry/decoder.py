"""Decode where the network is: the torch form of :class:`tofcapture.ops.phase.Decoder`, with its tables, for GPUs.

Only the taps are copied to the device. No value is looked at on the way, so a CUDA graph can hold all of it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import Decoder, ambiguity, frequencies
from tofcapture.ops.phase.decoder import UNKNOWN_CELSIUS
from tofcapture.ops.phase.float32 import Correction, tap_weights
from tofcapture.rig import RangeError
from tofcapture_model.frame import MAX_RANGE, MIN_RANGE, Frame
from tofcapture_model.geometry.maps import expect_usable, intrinsics_of

_HELD = 1 << 25  # elements of the table of distances


class Taps(NamedTuple):
    """Hold what is sent to the device for one frame: taps (K, H, W) float32, sensor temperature () float32, NaN if unknown."""

    raw: Tensor
    celsius: Tensor


class _Range:
    """Range of one frequency: :class:`tofcapture.ops.phase.float32.Correction` with its tables on the device."""

    def __init__(self, error: RangeError, camera: Camera, device: torch.device) -> None:
        tables = Correction(error, camera)
        self.step, self.start, self.unambiguous = tables.step, tables.start, tables.R
        self.table = None if tables.plain else torch.from_numpy(tables.table).to(device)
        self.fixed = torch.from_numpy(tables.fixed).reshape(camera.shape).to(device)
        self.per_kelvin, self.reference, self.dark = tables.per_kelvin, tables.reference, float(tables.dark)

    def __call__(self, in_phase: Tensor, quadrature: Tensor, amplitude: Tensor, celsius: Tensor) -> Tensor:
        """Compute the range (H, W), metres, without what is known of its systematic error."""
        turns = torch.atan2(quadrature, in_phase) / (2 * math.pi)
        steps = (turns - torch.floor(turns)) * (self.unambiguous / self.step) - self.fixed
        if self.dark:
            steps = steps - self.dark / amplitude
        if self.per_kelvin:
            steps = steps - self.per_kelvin * (celsius - self.reference)
        if self.table is None:
            return steps * self.step + self.start
        # no light has no phase, and none by amplitude: any entry will do
        entry = torch.nan_to_num(steps, nan=0.0).clamp(0, len(self.table) - 1).to(torch.int64)
        return steps * self.step + self.table[entry]


class TorchDecoder:
    """Decodes single frames of one camera on a device; arguments as for :func:`tofcapture_model.data.make_frame`.

    Raises
    ------
    DataError
        There are not exactly two frequencies in a whole ratio, or phases that determine no phasor.
    """

    def __init__(self, info: TofInfo, camera: Camera, device: torch.device) -> None:
        Decoder(replace(info, camera=camera))  # refuses what cannot be decoded
        expect_usable(camera)
        low, high = frequencies(info.modulation_hz)
        errors = {e.modulation_hz: e for e in info.range_errors}
        self._low, self._high = (_Range(errors.get(f, RangeError(f)), camera, device) for f in (low, high))
        # fusion leans on the high frequency by f^2: inverse variance at equal phase noise
        self._lean = high**2 / (low**2 + high**2)
        self._unambiguous = ambiguity(low), ambiguity(high)
        self._saturation = info.saturation
        place = np.asarray(info.illuminator, dtype=np.float64)
        self._quarter, self._nearest = float(place @ place / 4), float(np.sqrt(place @ place) / 2)

        def there(array: NDArray[Any]) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self._length, self._slant = there(camera.ray_lengths), there(camera.rays @ place / 2)
        self._demodulation = there(tap_weights(info)[[0, 2, 1, 3]])
        self._modulation = there(np.array([low, high]))
        self._intrinsics = intrinsics_of(camera).to(device)

    def taps(self, raw: NDArray[Any], celsius: float) -> Taps:
        """Send one frame (K, H, W), any real dtype, and its temperature to the device; :class:`DataError` for another shape."""
        expected = (self._demodulation.shape[1], *self._length.shape)
        if raw.shape != expected:
            raise DataError(f"decode: expected raw of shape {expected}, got {raw.shape}")
        device = self._length.device
        return Taps(
            torch.from_numpy(np.ascontiguousarray(raw, dtype=np.float32)).to(device),
            torch.tensor(celsius, dtype=torch.float32).to(device),
        )

    def __call__(self, taps: Taps) -> Frame:
        """Decode one frame: a batch of one, without cues."""
        raw = taps.raw
        known = taps.celsius.isfinite()
        celsius = torch.where(known, taps.celsius, torch.full_like(taps.celsius, UNKNOWN_CELSIUS))
        # no matrix product: TF32, where somebody allows it, would round counts of 12 bits to 11
        phasor = (self._demodulation[:, :, None, None] * raw).sum(1)
        amplitude = torch.stack([phasor[:2], phasor[2:]]).square().sum(1).sqrt()
        low = self._low(phasor[0], phasor[1], amplitude[0], celsius)
        high = self._high(phasor[2], phasor[3], amplitude[1], celsius)
        gap = (low - high) / self._unambiguous[1]
        gap = (gap - torch.round(gap)) * self._unambiguous[1]
        fused = low - gap * self._lean
        fused = fused - torch.floor(fused / self._unambiguous[0]) * self._unambiguous[0]
        depth = (fused.square() - self._quarter) / (fused * self._length - self._slant)
        lit = amplitude.amin(0) > 0
        sure = lit & (raw.amax(0) < self._saturation) & (fused > self._nearest)
        valid = sure & (depth > MIN_RANGE) & (depth < MAX_RANGE)  # false where it is no number
        frame = Frame(
            raw=raw / self._saturation,
            phasor=phasor / self._saturation,
            depth=fill_nearest(depth, valid)[None],
            valid=valid[None].to(raw),
            confidence=amplitude[1:] / self._saturation,
            gap=torch.where(lit, gap, torch.zeros_like(gap))[None],
            cues=raw[:0],
            modulation=self._modulation,
            intrinsics=self._intrinsics,
            demodulation=self._demodulation,
        )
        return Frame(*(x[None] for x in frame))


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
