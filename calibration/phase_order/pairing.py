"""Which channels of raw frames are half a period apart: the second harmonic of four taps vanishes for the right pairing only."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError, QualityError
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64

Complex128 = NDArray[np.complex128]
Block = tuple[int, int, int, int]  # channels a, b, c, d: a opposite b, c opposite d

PIXELS = 20_000  # looked at; more change nothing
NO_STRUCTURE = 0.35  # second harmonic over amplitude beyond which there are no four phases
PAIRING_MARGIN = 1.5  # the next pairing must leave this much more


class PhaseOrderRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Raw frames that do not tell their phases."""


def usable_pixels(
    raw: NDArray[Any], modulation_hz: Sequence[float]
) -> tuple[Float64, NDArray[np.intp], tuple[int, int]]:
    """Taps (K, M) of usable pixels and their flat indices: finite, not clipped, and moving over the taps."""
    raw = np.asarray(raw)
    if raw.ndim not in (3, 4) or raw.shape[-3] != 4 * len(frequencies(modulation_hz)):
        raise DataError(
            f"raw: expected (frames, K, H, W) with 4 channels for each of {len(frequencies(modulation_hz))} "
            f"frequencies, got shape {raw.shape}"
        )
    if raw.shape[-3] > 8:
        raise DataError(f"raw: expected one or two frequencies, got {raw.shape[-3] // 4}")
    frames = raw.reshape(-1, *raw.shape[-3:]).astype(np.float64)
    mean = frames.mean(axis=0).reshape(raw.shape[-3], -1)
    top, bottom = frames.max(initial=-np.inf), frames.min(initial=np.inf)
    clipped = ((frames == top) | (frames == bottom)).any(axis=(0, 1)).ravel()
    finite = np.isfinite(mean).all(axis=0)
    # A single extreme pixel is no sign of clipping; many at the same value are.
    good = finite & ~clipped if 10 < clipped.sum() < 0.9 * clipped.size else finite
    spread = np.where(good, np.ptp(np.where(good, mean, 0.0), axis=0), 0.0)
    usable = np.flatnonzero(
        good & (spread > 0.25 * np.median(spread[good]) if good.any() else good) & (spread > 0)
    )
    if len(usable) < 100:
        raise PhaseOrderRefused(
            f"phase order refused: expected at least 100 modulated pixels, got {len(usable)}",
            hint="empty or constant frames, or all pixels saturated: record a lit scene",
        )
    usable = usable[:: max(1, len(usable) // PIXELS)]
    return mean[:, usable], usable, (raw.shape[-2], raw.shape[-1])


def _blocks(channels: Sequence[int]) -> Iterator[Block]:
    a, *rest = channels
    for b in rest:
        c, d = (k for k in rest if k != b)
        yield a, b, c, d


def _readings(K: int) -> Iterator[tuple[Block, ...]]:
    """Every way to split K channels into blocks of two pairs of opposite taps."""
    if K == 4:
        yield from ((b,) for b in _blocks(range(4)))
        return
    for rest in combinations(range(1, 8), 3):
        first = (0, *rest)
        second = [k for k in range(8) if k not in first]
        for one in _blocks(first):
            yield from ((one, two) for two in _blocks(second))


def pairings(taps: Float64) -> tuple[list[tuple[Block, ...]], float, float]:
    """Readings whose second harmonic is as small as the best one's, its size, and the margin to the next."""
    readings = list(_readings(len(taps)))
    size = np.array([_second_harmonic(taps, r) for r in readings])
    best = float(size.min())
    # Blocks of one exposure share B, so pairs may be exchanged between blocks: those ties are for later.
    floor = PAIRING_MARGIN * best + 1e-9
    ties = [r for r, s in zip(readings, size, strict=True) if s <= floor]
    if best > NO_STRUCTURE:
        raise PhaseOrderRefused(
            f"phase order refused, no four-phase structure: the second harmonic is {best:.2f} of the amplitude in the best of "
            f"{len(readings)} orders, expected below {NO_STRUCTURE}",
            hint="the channels may hold 3 phases, several exposures, or decoded images",
        )
    if len(ties) > (1 if len(taps) == 4 else 3):
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous: {len(ties)} ways to pair the channels fit alike",
            hint="record a scene with more than one distance, brighter, and more frames",
        )
    beyond = size[size > floor]
    following = float(beyond.min()) if len(beyond) else 1.0
    return ties, best, 1 - best / following


def _second_harmonic(taps: Float64, reading: tuple[Block, ...]) -> float:
    total = []
    for a, b, c, d in reading:
        even = (taps[a] + taps[b] - taps[c] - taps[d]) / 4
        amplitude = np.hypot(taps[a] - taps[b], taps[c] - taps[d]) / 2
        total.append(np.sqrt(np.mean(even**2) / max(float(np.mean(amplitude**2)), 1e-30)))
    return float(max(total))


def phasor(taps: Float64, block: Block, *, flip: bool) -> Complex128:
    """Phasors (M,) of the taps of a block."""
    a, b, c, d = block
    z = np.asarray(((taps[a] - taps[b]) + 1j * (taps[d] - taps[c])) / 2, dtype=np.complex128)
    return np.conj(z) if flip else z


def concentration(z: Complex128) -> float:
    """Length of the mean unit phasor: 1 where all agree."""
    return float(np.abs(np.mean(z / np.maximum(np.abs(z), 1e-30))))
