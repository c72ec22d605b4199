"""Find frequency blocks, order, sign and start of the phases of raw frames from the data alone.

``C_k = B + A cos(phi + theta_k)`` (method.md 4.1), the phases of a frequency evenly spread over the turn, or I and Q. Over four or more taps
in the right order every harmonic but the first vanishes; three taps of the right block have the same mean as the other blocks. With
several frequencies ``phi_f - f / f_low phi_low`` is nearly constant over the image for the right blocks and the right relative sign.
What no phase can tell, whether all signs are flipped, a reference depth tells, or else that light grows weaker with distance. Where
the taps start only a reference depth tells: a sensor's own delay looks the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations, product
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.errors import DataError, QualityError
from tofcapture.ops.phase import frequencies
from tofcapture.poses import Float64

Complex128 = NDArray[np.complex128]
Block = tuple[int, ...]  # channels of one frequency, in the order of their phases

PIXELS = 20_000  # looked at; more change nothing
FEW = 4_000  # of these tell which channels belong together
MOST_PHASES = 6  # of one frequency
NO_STRUCTURE = 0.35  # other harmonics over amplitude beyond which there are no such phases
PAIRING_MARGIN = 1.5  # the next pairing must leave this much more
CONCENTRATION = 0.7  # of phi_f - ratio phi_low, 1 is constant
APART = 0.7  # of the next reading's circular spread: so much smaller the best one's must be
CUTS, EMPTY = 36, 0.002  # directions of a phase, and the share of pixels up to which one is empty
DIM_CUE = 0.15  # correlation of phase and darkness that settles the sign


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
    #: ``data``, or ``order given`` where the data leave open which block is which of two near frequencies
    blocks_from: str
    #: False without a reference depth: the first channel of each frequency is taken for 0, and ranges hold up to a constant
    start_known: bool
    harmonics: (
        float  #: RMS of what the taps hold beside offset and first harmonic, over the amplitude; 0 is perfect
    )
    concentration: float  #: Of ``phi_f - ratio phi_low``, 1 is constant; 1 for a single frequency
    #: (F,) constant phase left over against the reference depth, ascending frequencies; NaN without one
    offset_rad: tuple[float, ...]


@dataclass(frozen=True)
class _Reading:
    """One way to read the channels, a block a frequency, ascending."""

    blocks: tuple[Block, ...]
    flips: tuple[bool, ...]  # whose sign is against the first one's
    steady: float  # concentration of the phases


def find_phase_order(
    raw: NDArray[Any], modulation_hz: Sequence[float], radial: NDArray[np.floating] | None = None,
    phases: Sequence[int] | None = None,
) -> PhaseOrder:  # fmt: skip
    """Find what each raw channel is.

    ``raw`` is (frames, K, H, W), or (K, H, W), any real dtype; unipolar or bipolar taps. ``modulation_hz`` are the modulation
    frequencies, Hz, each with so many ``phases``, 2 to 6; by default the channels are shared out evenly. ``radial`` (H, W) is the known
    distance along the ray, metres, NaN where unknown.

    :class:`DataError` for wrong shapes, NaN only. :class:`PhaseOrderRefused` for no structure of such phases, or more than one reading
    that fits.
    """
    given, hz = [float(f) for f in modulation_hz], frequencies(modulation_hz)
    counts = _counts(np.asarray(raw), given, phases)
    taps, pixels, shape = _usable_pixels(np.asarray(raw))
    ties, left, pairing = _pairings(taps, [counts[f] for f in hz])
    chosen, margin, blocks_from = _assigned(taps, ties, hz, [counts[f] for f in given], given)
    z = [_phasor(taps, b, flip=f) for b, f in zip(chosen.blocks, chosen.flips, strict=True)]
    steps = [_step(len(b)) for b in chosen.blocks]
    if radial is not None:
        starts, sign, offsets = _sign_from_depth(z, hz, steps, _values_at(radial, pixels, shape))
    else:
        sign = _sign_from_brightness(z[0], pixels, shape)
        starts, offsets = None, (float("nan"),) * len(hz)
    return PhaseOrder(
        *_described(chosen, hz, steps, sign, starts),
        confidence=float(min(pairing, margin, abs(sign))),
        sign_from="brightness" if radial is None else "reference depth",
        blocks_from=blocks_from,
        start_known=radial is not None,
        harmonics=left,
        concentration=chosen.steady,
        offset_rad=offsets,
    )


def _counts(raw: NDArray[Any], given: Sequence[float], phases: Sequence[int] | None) -> dict[float, int]:
    """Say how many phases each frequency has."""
    K = raw.shape[-3] if raw.ndim in (3, 4) else 0
    F = len(given)
    counts = list(phases) if phases is not None else [K // F] * F if F and K % F == 0 else []
    if (
        not F
        or len(set(given)) != F
        or len(counts) != F
        or sum(counts) != K
        or not all(2 <= n <= MOST_PHASES for n in counts)
    ):
        raise DataError(
            f"raw: expected (frames, K, H, W) with 2 to {MOST_PHASES} phases for each of {F} frequencies, got shape {raw.shape}"
            + (f" and phases {list(phases)}" if phases else ""),
            hint="--phases 4,3 says how many each frequency has",
        )
    return dict(zip(given, counts, strict=True))


def _usable_pixels(raw: NDArray[Any]) -> tuple[Float64, NDArray[np.intp], tuple[int, int]]:
    """Taps (K, M) of usable pixels, their flat indices, the image's shape: finite, not clipped, moving over the taps."""
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
            hint="empty or constant frames, phases all equal, or all pixels saturated: record a lit scene",
        )
    usable = usable[:: max(1, len(usable) // PIXELS)]
    return mean[:, usable], usable, (raw.shape[-2], raw.shape[-1])


def _step(count: int) -> float:
    """Return the angle between phases: evenly over the turn, and a quarter of it for I and Q."""
    return 2 * np.pi / max(count, 4 if count == 2 else count)


def _phasor(taps: Float64, block: Block, *, flip: bool) -> Complex128:
    turned = np.exp(-1j * _step(len(block)) * np.arange(len(block)))
    z = np.asarray(2 / len(block) * np.tensordot(turned, taps[list(block)], axes=1), dtype=np.complex128)
    return np.conj(z) if flip else z


class _Blocks:
    """Judges channels as the block of one frequency."""

    def __init__(self, taps: Float64) -> None:
        self.taps = taps[:, :: max(1, taps.shape[1] // FEW)]

    @cached_property
    def size(self) -> float:
        """Mean square of a tap about its pixel's mean: what harmonics and offsets are measured by."""
        return max(float(self.taps.var(axis=0).mean()), 1e-30)

    def best(self, channels: Block) -> list[tuple[float, Block]]:
        """Return the orders of channels, reversal and start aside, with the power of what is no first harmonic."""
        first, *rest = channels
        orders = [(first, *p) for p in permutations(rest) if len(p) < 2 or p[0] < p[-1]]
        return sorted((self._harmonics(o), o) for o in orders)

    def _harmonics(self, block: Block) -> float:
        n = len(block)
        waves = np.fft.fft(self.taps[list(block)], axis=0)[2 : n - 1] / n
        return float(np.mean(np.square(np.abs(waves)).sum(axis=0))) / self.size if n > 3 else 0.0

    def offsets(self, blocks: Sequence[Block]) -> float:
        """Return the power by which the means of three-phase blocks are not one image, but for its scale."""
        means = np.stack([self.taps[list(b)].mean(axis=0) for b in blocks if len(b) > 2] or [np.zeros(1)])
        common = means.mean(axis=0)
        scale = means @ common / max(float(common @ common), 1e-30)
        return float(np.mean(np.square(means - scale[:, None] * common))) / self.size


def _splits(channels: Block, counts: Sequence[int]) -> Iterator[tuple[Block, ...]]:
    """Split channels into sets of so many, each split once whatever the order of sets of one size."""
    if not counts:
        yield ()
        return
    lowest = channels[0]
    for n in sorted(set(counts)):
        others = list(counts)
        others.remove(n)
        for rest in combinations(channels[1:], n - 1):
            own = (lowest, *rest)
            for further in _splits(tuple(c for c in channels if c not in own), others):
                yield (own, *further)


def _pairings(taps: Float64, counts: Sequence[int]) -> tuple[list[tuple[Block, ...]], float, float]:
    """Readings that leave as little beside offset and first harmonic as the best one's, its size, and the margin to the next."""
    judge, known = _Blocks(taps), dict[Block, list[tuple[float, Block]]]()
    readings: list[tuple[float, tuple[Block, ...]]] = []
    for split in _splits(tuple(range(len(taps))), counts):
        for own in split:
            known[own] = known.get(own) or judge.best(own)
        apart = judge.offsets(split) if min(counts) == 3 and len(counts) > 1 else 0.0
        readings += [
            (float(np.sqrt(max(apart, *(left for left, _ in orders)))), tuple(o for _, o in orders))
            for orders in product(*(known[own][:3] for own in split))
        ]
    readings.sort()
    best = readings[0][0]
    # Blocks of one exposure share B, so pairs may be exchanged between blocks: those ties are for later.
    floor = PAIRING_MARGIN * best + 1e-9
    ties = [r for s, r in readings if s <= floor]
    if best > NO_STRUCTURE:
        raise PhaseOrderRefused(
            f"phase order refused, no structure of {', '.join(map(str, counts))} phases: {best:.2f} of the amplitude is beside offset and first "
            f"harmonic in the best of {len(readings)} orders, expected below {NO_STRUCTURE}",
            hint="the channels may hold another number of phases (--phases), several exposures, or decoded images",
        )
    if len(ties) > prod(range(1, 2 * len(counts), 2)):
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous: {len(ties)} ways to pair the channels fit alike",
            hint="record a scene with more than one distance, brighter, and more frames",
        )
    following = readings[len(ties)][0] if len(ties) < len(readings) else 1.0
    return ties, best, 1 - best / max(following, 1e-9)


def _mean_unit(z: Complex128) -> complex:
    """Mean unit phasor: of length 1 where all agree."""
    return complex(np.mean(z / np.maximum(np.abs(z), 1e-30)))


def _spread(concentration: float) -> float:
    """Return the circular standard deviation, radians, of phases that agree so much."""
    return float(np.sqrt(-2 * np.log(np.clip(concentration, 1e-9, 1 - 1e-9))))


def _unwrapped(z: Complex128) -> list[Float64]:
    """Phases from each empty direction on, or the emptiest: a scene shorter than the ambiguity has no wrap from one of them."""
    phase = np.mod(np.angle(z), 2 * np.pi)
    count = np.histogram(phase, CUTS, (0, 2 * np.pi))[0]
    empty = count <= max(EMPTY * len(z), count.min())
    first = np.flatnonzero(empty & ~np.roll(empty, 1))
    cuts = (first if len(first) else np.zeros(1)) * 2 * np.pi / CUTS
    return [np.asarray(np.mod(phase - cut, 2 * np.pi)) for cut in cuts]


def _assigned(
    taps: Float64, ties: list[tuple[Block, ...]], hz: Sequence[float], counts: Sequence[int], given: Sequence[float]
) -> tuple[_Reading, float, str]:  # fmt: skip
    """Which block is of which frequency, and its sign relative to the lowest: where phi_f - ratio phi_low is most constant."""
    if len(hz) == 1:
        return _Reading(ties[0], (False,), 1.0), 1.0, "data"
    taps = taps[:, :: max(1, taps.shape[1] // FEW)]
    size, tried = dict(zip(given, counts, strict=True)), []
    for blocks in {
        p
        for tie in ties
        for p in permutations(tie)
        if all(len(b) == size[f] for b, f in zip(p, hz, strict=True))
    }:
        others = [_phasor(taps, block, flip=False) for block in blocks[1:]]
        # (cut, frequency, flipped or not)
        fit = np.array([
            [[abs(_mean_unit(p * np.exp(-1j * f / hz[0] * low))) for p in (z, np.conj(z))] for z, f in zip(others, hz[1:], strict=True)]
            for low in _unwrapped(_phasor(taps, blocks[0], flip=False))
        ])  # fmt: skip
        for flips in product((False, True), repeat=len(others)):
            steady = fit[:, range(len(others)), [int(flip) for flip in flips]].min(axis=1).max()
            tried.append(_Reading(blocks, (False, *flips), float(steady)))
    tried.sort(key=lambda t: -t.steady)
    best, spread = tried[0], [_spread(t.steady) for t in tried]
    near = [t for t, s in zip(tried, spread, strict=True) if APART * s < spread[0]]
    if best.steady >= CONCENTRATION and len(near) == 1:
        return best, 1 - spread[0] / spread[1], "data"
    if best.steady >= CONCENTRATION and (stand := _as_given(near, hz, counts, given)):
        return stand[0], 1 - APART, "order given"
    raise PhaseOrderRefused(
        f"phase order refused, ambiguous: the phases of {', '.join(f'{f / 1e6:g}' for f in hz)} MHz go together to {best.steady:.2f} in the "
        f"best reading and to {tried[1].steady:.2f} in the next; expected above {CONCENTRATION}, and the best clearly apart",
        hint="record a scene that fills a range of distances, or check the frequencies; near frequencies in the channels' order",
    )


def _as_given(
    readings: Sequence[_Reading], hz: Sequence[float], counts: Sequence[int], given: Sequence[float]
) -> list[_Reading]:
    """Readings that differ only in which block is which, of them the one whose blocks stand as the frequencies were given."""
    ends = np.cumsum([0, *counts])
    sets = {f: set(range(a, b)) for f, a, b in zip(given, ends[:-1], ends[1:], strict=True)}
    signs = {frozenset(zip(r.blocks, r.flips, strict=True)) for r in readings}
    stand = [r for r in readings if all(set(b) == sets[f] for b, f in zip(r.blocks, hz, strict=True))]
    return stand if len(stand) == 1 and len(signs) == 1 else []


def _values_at(image: NDArray[np.floating], pixels: NDArray[np.intp], shape: tuple[int, int]) -> Float64:
    if image.shape != shape:
        raise DataError(f"reference depth: expected shape {shape}, got {image.shape}")
    return np.asarray(image, dtype=np.float64).ravel()[pixels]


def _sign_from_depth(
    z: list[Complex128], hz: Sequence[float], steps: Sequence[float], radial: Float64
) -> tuple[tuple[int, ...], float, tuple[float, ...]]:
    """Steps by which the taps start, signed margin, and phases left over, against known distances."""
    known = np.isfinite(radial) & (radial > 0)
    if known.sum() < 100:
        raise DataError(f"reference depth: expected at least 100 known pixels, got {int(known.sum())}")
    back = [np.exp(-4j * np.pi * f * radial[known] / SPEED_OF_LIGHT) for f in hz]
    fit = [
        float(np.mean([abs(_mean_unit(conj(p[known]) * b)) for p, b in zip(z, back, strict=True)]))
        for conj in (np.asarray, np.conj)
    ]
    near, far = sorted(map(_spread, fit))
    margin = (1 - near / far) * (1 if fit[0] > fit[1] else -1)
    if near > APART * far or max(fit) < CONCENTRATION:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous sign: the phases fit the reference depth by {fit[0]:.2f} and reversed by {fit[1]:.2f}",
            hint="the reference must cover a range of distances, be along the ray, in metres, and of this very scene",
        )
    signed = [(p if margin > 0 else np.conj(p))[known] * b for p, b in zip(z, back, strict=True)]
    angles = [float(np.angle(_mean_unit(s))) for s in signed]
    starts = [round(angle / step) for angle, step in zip(angles, steps, strict=True)]
    left = tuple(angle - k * step for angle, k, step in zip(angles, starts, steps, strict=True))
    return tuple(starts), margin, left


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


def _described(
    reading: _Reading, hz: Sequence[float], steps: Sequence[float], sign: float, starts: Sequence[int] | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Frequency and phase of each channel; without a start the first channel of each frequency is at 0."""
    K = sum(map(len, reading.blocks))
    f_out, theta = np.zeros(K), np.zeros(K)
    for i, (block, flip, f, step) in enumerate(zip(reading.blocks, reading.flips, hz, steps, strict=True)):
        direction = -1.0 if flip != (sign < 0) else 1.0  # conj(z) means minus the block's phases
        phase = direction * step * np.arange(len(block))
        begin = phase[np.argmin(block)] if starts is None else -step * starts[i]
        f_out[list(block)], theta[list(block)] = (
            f,
            np.mod((phase - begin) / step, round(2 * np.pi / step)) * step,
        )
    return tuple(f_out.tolist()), tuple(theta.tolist())
