"""Find frequency blocks, order, sign and start of the phases of raw four-phase frames from the data alone.

``C_k = B + A cos(phi + theta_k)`` (method.md 4.1). Taps half a period apart add up to 2 B, so the second harmonic over the four
taps of a block vanishes for the right pairing and for no other. With two frequencies, ``phi_high - ratio phi_low`` is nearly constant
over the image for the right blocks and the right relative sign. What no phase can tell, whether all signs are flipped, a reference
depth tells, or else that light grows weaker with distance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError, QualityError
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT

Complex128 = NDArray[np.complex128]
Block = tuple[int, int, int, int]  # channels a, b, c, d: a opposite b, c opposite d

PIXELS = 20_000  # looked at; more change nothing
NO_STRUCTURE = 0.35  # second harmonic over amplitude beyond which there are no four phases
PAIRING_MARGIN = 1.5  # the next pairing must leave this much more
CONCENTRATION = 0.7  # of phi_high - ratio phi_low, 1 is constant
CONCENTRATION_MARGIN = 0.08
DIM_CUE = 0.15  # correlation of phase and darkness that settles the sign
START_MARGIN = 0.8  # spread of A r^2 of the best start over that of the next


class PhaseOrderRefused(QualityError):  # noqa: N818  a gate's answer is a refusal, not a fault
    """Raw frames that do not tell their phases."""


@dataclass(frozen=True)
class PhaseOrder:
    """Tell how raw channels are to be decoded."""

    #: (K,) as :func:`tofcapture.ops.phase.phasors` takes them: ``C_k = B + A cos(phi + phase_rad[k])``
    modulation_hz: tuple[float, ...]
    phase_rad: tuple[float, ...]
    #: In (0, 1]: the smallest margin of the decisions taken; below 0.2 a look at the decoded depth is advised
    confidence: float
    sign_from: str  #: ``reference depth`` or ``brightness``
    #: False where the start tap is only assumed: ranges then hold up to a multiple of a quarter period
    start_known: bool
    second_harmonic: float  #: RMS of the taps' second harmonic over the amplitude; 0 is perfect
    concentration: float  #: Of ``phi_high - ratio phi_low``, 1 is constant; 1 for a single frequency
    #: (F,) constant phase left over against the reference depth, ascending frequencies; NaN without one
    offset_rad: tuple[float, ...]


def find_phase_order(
    raw: NDArray[Any], modulation_hz: Sequence[float], radial: NDArray[np.floating] | None = None
) -> PhaseOrder:
    """Find what each raw channel is.

    ``raw`` is (frames, K, H, W), or (K, H, W), any real dtype; K is 4 per frequency; unipolar or bipolar taps. ``modulation_hz`` are
    the one or two modulation frequencies, in any order, Hz. ``radial`` (H, W) is the known distance along the ray, metres, NaN where
    unknown.

    :class:`DataError` for wrong shapes, other than one or two frequencies, NaN only. :class:`PhaseOrderRefused` for no four-phase
    structure, or more than one reading that fits.
    """
    hz = frequencies(modulation_hz)
    taps, pixels, shape = _usable_pixels(np.asarray(raw), len(hz))
    blocks, harmonic, pairing = _pairings(taps)
    flips: tuple[bool, ...] = (False,)
    chosen, steady, margin = blocks[0], 1.0, 1.0
    if len(hz) == 2:
        chosen, flips, steady, margin = _assign(taps, blocks, hz[1] / hz[0])
    z = [_phasor(taps, b, flip=f) for b, f in zip(chosen, flips, strict=True)]
    if radial is not None:
        turned, sign, offsets = _sign_from_depth(z, hz, _values_at(radial, pixels, shape))
        source, known = "reference depth", True
    else:
        sign = _sign_from_brightness(z[0], pixels, shape)
        turned, start = _find_start([np.conj(p) if sign < 0 else p for p in z], hz)
        source, known, offsets = "brightness", start < START_MARGIN, (float("nan"),) * len(hz)
    return PhaseOrder(
        *_described(chosen, flips, hz, sign, turned),
        confidence=float(min(pairing, margin, abs(sign))),
        sign_from=source,
        start_known=known,
        second_harmonic=harmonic,
        concentration=steady,
        offset_rad=offsets,
    )


def _usable_pixels(raw: NDArray[Any], count: int) -> tuple[Float64, NDArray[np.intp], tuple[int, int]]:
    """Taps (K, M) of usable pixels, their flat indices, the image's shape: finite, not clipped, moving over the taps."""
    if raw.ndim not in (3, 4) or raw.shape[-3] != 4 * count:
        raise DataError(
            f"raw: expected (frames, K, H, W) with 4 channels for each of {count} frequencies, got shape {raw.shape}"
        )
    if count > 2:
        raise DataError(f"raw: expected one or two frequencies, got {count}")
    frames = raw.reshape(-1, *raw.shape[-3:]).astype(np.float64)
    mean = frames.mean(axis=0).reshape(raw.shape[-3], -1)
    top, bottom = frames.max(initial=-np.inf), frames.min(initial=np.inf)
    clipped = ((frames == top) | (frames == bottom)).any(axis=(0, 1)).ravel()
    finite = np.isfinite(mean).all(axis=0)
    # A single extreme pixel is no sign of clipping; many at the same value are.
    good = finite & ~clipped if 10 < clipped.sum() < 0.9 * clipped.size else finite
    spread = np.where(good, np.ptp(np.where(good, mean, 0.0), axis=0), 0.0)
    typical = np.median(spread[good]) if good.any() else 0.0
    usable = np.flatnonzero(good & (spread > 0.25 * typical) & (spread > 0))
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


def _pairings(taps: Float64) -> tuple[list[tuple[Block, ...]], float, float]:
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


def _phasor(taps: Float64, block: Block, *, flip: bool) -> Complex128:
    a, b, c, d = block
    z = np.asarray(((taps[a] - taps[b]) + 1j * (taps[d] - taps[c])) / 2, dtype=np.complex128)
    return np.conj(z) if flip else z


def _mean_unit(z: Complex128) -> complex:
    """Mean unit phasor: of length 1 where all agree."""
    return complex(np.mean(z / np.maximum(np.abs(z), 1e-30)))


def _assign(
    taps: Float64, readings: list[tuple[Block, ...]], ratio: float
) -> tuple[tuple[Block, ...], tuple[bool, ...], float, float]:
    """Which block is low, and the sign of the high one relative to it: where phi_high - ratio phi_low is most constant."""
    tried = []
    for reading in readings:
        for low, high in (reading, reading[::-1]):
            turned = np.exp(1j * ratio * np.angle(_phasor(taps, low, flip=False)))
            for flip in (False, True):
                z = _phasor(taps, high, flip=flip) * np.conj(turned)
                tried.append((abs(_mean_unit(z)), (low, high), (False, flip)))
    tried.sort(key=lambda t: -t[0])
    best, following = tried[0], tried[1]
    if best[0] < CONCENTRATION or best[0] - following[0] < CONCENTRATION_MARGIN:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous: phi_high - {ratio:g} phi_low is constant to {best[0]:.2f} in the best reading and to "
            f"{following[0]:.2f} in the next; expected above {CONCENTRATION} and {CONCENTRATION_MARGIN} apart",
            hint="record a scene that fills a range of distances, or check the frequencies",
        )
    return best[1], best[2], best[0], min(1.0, 2 * (best[0] - following[0]))


def _values_at(image: NDArray[np.floating], pixels: NDArray[np.intp], shape: tuple[int, int]) -> Float64:
    if image.shape != shape:
        raise DataError(f"reference depth: expected shape {shape}, got {image.shape}")
    return np.asarray(image, dtype=np.float64).ravel()[pixels]


def _sign_from_depth(
    z: list[Complex128], hz: Sequence[float], radial: Float64
) -> tuple[tuple[int, ...], float, tuple[float, ...]]:
    """Quarter turns, signed margin, and phases left over, against known distances."""
    known = np.isfinite(radial) & (radial > 0)
    if known.sum() < 100:
        raise DataError(f"reference depth: expected at least 100 known pixels, got {int(known.sum())}")
    back = [np.exp(-4j * np.pi * f * radial[known] / SPEED_OF_LIGHT) for f in hz]
    fit = [
        np.mean([abs(_mean_unit(conj(p[known]) * b)) for p, b in zip(z, back, strict=True)])
        for conj in (np.asarray, np.conj)
    ]
    margin = float(fit[0] - fit[1])
    if abs(margin) < CONCENTRATION_MARGIN or max(fit) < CONCENTRATION:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous sign: the phases fit the reference depth by {fit[0]:.2f} and reversed by {fit[1]:.2f}",
            hint="the reference must cover a range of distances, be along the ray, in metres, and of this very scene",
        )
    signed = [(p if margin > 0 else np.conj(p))[known] * b for p, b in zip(z, back, strict=True)]
    angles = [float(np.angle(_mean_unit(s))) for s in signed]
    quarters = [round(angle / (np.pi / 2)) for angle in angles]
    left = tuple(angle - q * np.pi / 2 for angle, q in zip(angles, quarters, strict=True))
    return tuple(q % 4 for q in quarters), margin, left


def _sign_from_brightness(z: Complex128, pixels: NDArray[np.intp], shape: tuple[int, int]) -> float:
    """Correlation of phase steps and dimming between neighbours; its sign is the sign of the phase."""
    image = np.full(shape, np.nan, dtype=np.complex128)
    image.ravel()[pixels] = z
    steps = []
    for gap in (1, 4):
        for one, two in ((image[:, gap:], image[:, :-gap]), (image[gap:], image[:-gap])):
            both = np.isfinite(one) & np.isfinite(two)
            a, b = one[both], two[both]
            steps.append(np.stack([np.angle(a * np.conj(b)), np.log(np.abs(b) / np.abs(a))]))
    far, dim = np.concatenate(steps, axis=1)
    if len(far) < 100:
        far, dim = np.zeros(2), np.zeros(2)
    far, dim = (np.clip(s, *np.quantile(s, [0.05, 0.95])) for s in (far, dim))
    cue = float(np.sum(far * dim) / max(np.sqrt(np.sum(far**2) * np.sum(dim**2)), 1e-30))
    if abs(cue) < DIM_CUE:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous sign: phase and darkness correlate by {cue:.2f} only, expected {DIM_CUE} either way",
            hint="pass a reference depth, or record a bare wall at an angle",
        )
    return cue


def _find_start(z: list[Complex128], hz: Sequence[float]) -> tuple[tuple[int, ...], float]:
    """Quarter turns by which A r^2 varies least at the low frequency; the high one follows the low."""
    spread = []
    for quarter in range(4):
        phase = np.mod(np.angle(z[0] * (-1j) ** quarter), 2 * np.pi)
        level = np.log(np.abs(z[0])) + 2 * np.log(np.maximum(phase, 0.02))
        spread.append(float(np.subtract(*np.quantile(level, [0.84, 0.16]))))
    best, following = np.argsort(spread)[:2]
    turned = [int(best)]
    if len(z) == 2:
        low = np.angle(z[0] * (-1j) ** best)
        left = z[1] * np.exp(-1j * hz[1] / hz[0] * low)
        turned.append(round(float(np.angle(_mean_unit(left))) / (np.pi / 2)) % 4)
    return tuple(turned), spread[best] / max(spread[following], 1e-30)


def _described(
    blocks: tuple[Block, ...], flips: Sequence[bool], hz: Sequence[float], sign: float, turned: Sequence[int]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Frequency and phase of each channel."""
    K = 4 * len(blocks)
    f_out, theta = np.zeros(K), np.zeros(K)
    for (a, b, c, d), flip, f, quarter in zip(blocks, flips, hz, turned, strict=True):
        # _phasor reads taps a, c, b, d at 0, 90, 180, 270 degrees; conj(z) means minus those.
        direction = -1.0 if flip != (sign < 0) else 1.0
        for channel, k in ((a, 0), (c, 1), (b, 2), (d, 3)):
            f_out[channel] = f
            theta[channel] = np.mod((direction * k + quarter) % 4 * np.pi / 2, 2 * np.pi)
    return tuple(f_out.tolist()), tuple(theta.tolist())
