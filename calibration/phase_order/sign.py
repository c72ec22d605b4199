"""Which block of channels is which frequency, which way its phase runs, and where it starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.phase_order.pairing import Block, Complex128, PhaseOrderRefused, concentration, phasor
from tofcapture.errors import DataError
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT

CONCENTRATION = 0.7  # of phi_high - ratio phi_low, 1 is constant
CONCENTRATION_MARGIN = 0.08
DIM_CUE = 0.15  # correlation of phase and darkness that settles the sign


def assign(
    taps: Float64, readings: list[tuple[Block, ...]], ratio: float
) -> tuple[tuple[Block, ...], tuple[bool, ...], float, float]:
    """Which block is low, and the sign of the high one relative to it: where phi_high - ratio phi_low is most constant."""
    tried = []
    for reading in readings:
        for low, high in (reading, reading[::-1]):
            z_low, z_high = phasor(taps, low, flip=False), phasor(taps, high, flip=False)
            turned = np.exp(1j * ratio * np.angle(z_low))
            for flip in (False, True):
                z = (np.conj(z_high) if flip else z_high) * np.conj(turned)
                tried.append((concentration(z), (low, high), (False, flip)))
    tried.sort(key=lambda t: -t[0])
    best, following = tried[0], tried[1]
    if best[0] < CONCENTRATION or best[0] - following[0] < CONCENTRATION_MARGIN:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous: phi_high - {ratio:g} phi_low is constant to {best[0]:.2f} in the best reading and to "
            f"{following[0]:.2f} in the next; expected above {CONCENTRATION} and {CONCENTRATION_MARGIN} apart",
            hint="record a scene that fills a range of distances, or check the frequencies",
        )
    return best[1], best[2], best[0], min(1.0, 2 * (best[0] - following[0]))


def values_at(image: NDArray[np.floating], pixels: NDArray[np.intp], shape: tuple[int, int]) -> Float64:
    """Values of an image at flat pixels."""
    if image.shape != shape:
        raise DataError(f"reference depth: expected shape {shape}, got {image.shape}")
    return np.asarray(image, dtype=np.float64).ravel()[pixels]


def sign_from_depth(
    z: list[Complex128], hz: Sequence[float], radial: Float64
) -> tuple[tuple[int, ...], float, tuple[float, ...]]:
    """Quarter turns, signed margin, and phases left over, against known distances."""
    known = np.isfinite(radial) & (radial > 0)
    if known.sum() < 100:
        raise DataError(f"reference depth: expected at least 100 known pixels, got {int(known.sum())}")
    back = [np.exp(-4j * np.pi * f * radial[known] / SPEED_OF_LIGHT) for f in hz]
    fit = [
        np.mean([concentration(conj(p[known]) * b) for p, b in zip(z, back, strict=True)])
        for conj in (np.asarray, np.conj)
    ]
    margin = float(fit[0] - fit[1])
    if abs(margin) < CONCENTRATION_MARGIN or max(fit) < CONCENTRATION:
        raise PhaseOrderRefused(
            f"phase order refused, ambiguous sign: the phases fit the reference depth by {fit[0]:.2f} and reversed by {fit[1]:.2f}",
            hint="the reference must cover a range of distances, be along the ray, in metres, and of this very scene",
        )
    turned, left = [], []
    for p, b in zip(z, back, strict=True):
        signed = (p if margin > 0 else np.conj(p))[known] * b
        angle = float(np.angle(np.mean(signed / np.maximum(np.abs(signed), 1e-30))))
        quarter = round(angle / (np.pi / 2))
        turned.append(quarter % 4)
        left.append(angle - quarter * np.pi / 2)
    return tuple(turned), margin, tuple(left)


def sign_from_brightness(z: Complex128, pixels: NDArray[np.intp], shape: tuple[int, int]) -> float:
    """Correlation of phase steps and dimming between neighbours; its sign is the sign of the phase."""
    image = np.full(shape, np.nan, dtype=np.complex128)
    image.ravel()[pixels] = z
    steps = []
    for gap in (1, 4):
        for one, two in (
            (image[:, gap:], image[:, :-gap]),
            (image[gap:], image[:-gap]),
        ):
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


def find_start(z: list[Complex128], hz: Sequence[float]) -> tuple[tuple[int, ...], float]:
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
        turned.append(round(float(np.angle(np.mean(left / np.abs(left)))) / (np.pi / 2)) % 4)
    return tuple(turned), spread[best] / max(spread[following], 1e-30)


def described(
    blocks: tuple[Block, ...], flips: Sequence[bool], hz: Sequence[float], sign: float, turned: Sequence[int]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Frequency and phase of each channel."""
    K = 4 * len(blocks)
    f_out, theta = np.zeros(K), np.zeros(K)
    for block, flip, f, quarter in zip(blocks, flips, hz, turned, strict=True):
        a, b, c, d = block
        # _phasor reads taps a, c, b, d at 0, 90, 180, 270 degrees; conj(z) means minus those.
        direction = -1.0 if flip != (sign < 0) else 1.0
        for channel, k in ((a, 0), (c, 1), (b, 2), (d, 3)):
            f_out[channel] = f
            theta[channel] = np.mod((direction * k + quarter) % 4 * np.pi / 2, 2 * np.pi)
    return tuple(f_out.tolist()), tuple(theta.tolist())
