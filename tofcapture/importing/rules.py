"""Say what raw taps and depths of others must be like, and refuse the rest with the remedy.

Importing, predicting and ``calibrate phase-order`` hold data against these rules: units, NaN, zero as missing, signedness,
byte order, order of axes, rows that are no image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import channels_in_words, frequencies, mismatch, wrap_table
from tofcapture.errors import DataError, FormatError
from tofcapture.frames import TofInfo
from tofcapture.meshes import UNITS
from tofcapture.ops.phase import Decoder, information
from tofcapture.ops.phase.float32 import tap_rows

Float32 = NDArray[np.float32]
HEADER_ROWS = 4  # at most so many rows of an image are metadata
SATURATION = 4095.0  # counts, of a 12-bit sensor: taken unless it is said
NEAREST, FARTHEST = 0.02, 30.0  # m, medians of depth images that a camera indoors can give
FLAGS = (
    8  # at most so many values beyond saturation are marks that a sensor writes; more are counts of more bits
)
_SUSPICIOUS = 0.25  # of saturation: no count beyond it is what a sensor of two bits less would give
_REACH = (0.05, 5.0)  # m, depths that a table-top rig can see; the networks take others for holes
# In 76 frames of simulated cameras and rooms, all in the right order: at most 0.11, at least 0.97, at least 0.86.
_HARMONIC, _AGREEMENT, _WITHIN = 0.3, 0.5, 0.5


def expect_shape(raw: NDArray[Any], info: TofInfo, path: object) -> None:
    """Refuse anything but (F, K, H, W) numbers of more than 8 bits."""
    (h, w), K = info.camera.shape, len(info.modulation_hz)
    shape = raw.shape[1:] if raw.ndim == 4 and len(raw) > 0 else ()
    if shape == (K, h, w) and raw.dtype.kind in "uif" and raw.dtype.itemsize > 1:
        return
    hints = {
        (h, w, K): "np.moveaxis(raw, -1, -3) puts the channels before rows and columns",
        (K, w, h): "np.swapaxes(raw, -1, -2) puts the rows before the columns",
        (K, h, w): "counts as the sensor gives them, such as uint16",
    }
    if len(shape) == 3 and shape[0] != K and shape[1:] == (h, w):
        hints[shape] = (
            f"other channels than {channels_in_words(info.modulation_hz, info.phase_rad)} are said beside the array: np.savez(path, raw=raw, modulation_hz=hz, phase_rad=phases)"
        )
    raise DataError(
        f"{path}: expected numbers of shape ({K}, {h}, {w}) or (F, {K}, {h}, {w}), "
        f"got {raw.dtype} {raw.shape[1:] if raw.shape[:1] == (1,) else raw.shape}",
        hint=hints.get(shape, "--rig names a camera of another size"),
    )


def expect_finite(raw: NDArray[Any], where: str) -> None:
    """Refuse taps that are NaN or infinite with a :class:`DataError`: a network would spread them over the whole image."""
    if not (finite := np.isfinite(raw)).all():
        raise DataError(
            f"{where}: expected finite numbers, got {np.count_nonzero(~finite)} others",
            hint="choose another --frame, or give missing pixels the saturation value: they count as not measured",
        )


def check_unit(raw: NDArray[Any], info: TofInfo, path: object) -> str:
    """Refuse counts that this sensor cannot give; say what is suspicious, but a dark frame has low counts too."""
    largest, saturation = float(np.abs(raw[np.isfinite(raw)].astype(np.float64)).max()), info.saturation
    bits = math.ceil(math.log2(max(largest, 1) + 1))
    beyond = raw[np.abs(raw) > saturation] if largest > saturation else raw[:0]
    if len(np.unique(beyond)) > FLAGS:
        raise DataError(
            f"{path}: expected counts of a sensor that saturates at {saturation:g}, got values up to {largest:g}",
            hint=_other_bytes(raw)
            or f"--saturation COUNTS says where yours does ({2**bits - 1} with {bits} bits)",
        )
    if beyond.size:
        return ""
    if not 1 < largest <= _SUSPICIOUS * saturation:
        return ""
    return (
        f"{path}: no count exceeds {largest:g}. That is right for a dark scene of a sensor that saturates at {saturation:g}; "
        f"if yours has fewer bits, say so: --saturation {2**bits - 1} for {bits} bits"
    )


def _other_bytes(raw: NDArray[Any]) -> str:
    """Say that the bytes of words have changed places, where neighbours are alike only in the other order."""
    if (
        raw.dtype.kind not in "iu"
        or raw.dtype.itemsize == 1
        or roughness(raw.byteswap()) > 0.5 * roughness(raw)
    ):
        return ""
    return "the bytes of each word have changed places: raw.byteswap(), or of plain words [raw] dtype = '>u2' in import.toml"


def sign_unknown(info: TofInfo) -> str:
    """Say that no frame of one frequency tells which way its phases run; nothing for several, which contradict each other."""
    if len(frequencies(info.modulation_hz)) > 1:
        return ""
    turned = [round(float(d), 3) for d in np.degrees(np.negative(info.phase_rad)) % 360]
    return (
        f"one frequency: no frame tells which way its phases run; if near comes out far, phase_deg = {turned}"
    )


def burst_mean(raw: NDArray[Any], info: TofInfo) -> NDArray[np.float64]:
    """Average a burst (F, K, H, W).

    A tap that is saturated in any frame gets the saturation value: clipping took from its mean what nobody knows.
    :meth:`tofcapture.ops.phase.Decoder.burst` has the same rule.
    """
    mean: NDArray[np.float64] = raw.mean(axis=0, dtype=np.float64)
    mean[info.saturated(raw).any(axis=0)] = info.saturation
    return mean


def check_taps(
    raw: NDArray[np.float64], info: TofInfo, path: object, which: str = "", *, calibrated: bool = True
) -> str:
    """Refuse taps (K, H, W) that cannot be what ``info`` says: other units, other channels, no signal.

    What no cosine explains vanishes for the right order, where a frequency has four phases. Ranges of all frequencies agree up to
    noise and calibration. Depths lie within the reach of the rig. Looked at are the brighter half of the pixels below saturation,
    and the bounds are wide. A start tap that is wrong by the same quarter in all frequencies passes: no frame can tell. ``path``
    and ``which`` are names.

    Raises
    ------
    DataError
        With what was found, and what to try.
    """
    where = f"{path}{which}"
    _check_counts(raw, info, where)
    maps, signals = Decoder(info).signals(raw)
    amplitude = np.hypot(signals.phasor[:, 0], signals.phasor[:, 1])
    weaker = np.where(info.saturated(raw).any(axis=0), np.nan, amplitude.min(axis=0))
    bright = (weaker >= np.nanmedian(weaker)) & (weaker > 0)
    if not bright.any():
        raise DataError(f"{where}: no modulated light: the phases are equal everywhere")
    found = _misfit(raw[:, bright], amplitude[:, bright], info)
    apart = found or _disagreement(signals.ranges[:, bright], maps.depth[bright], info)
    if found or (apart and calibrated):
        found = apart
        hint = f"tofcapture calibrate phase-order {path} says what the channels are; reorder them"
        hint = _other_bytes(np.rint(raw).astype(np.int64).astype(np.uint16)) or hint
        raise DataError(
            f"{where}: {found}; expected channels: {channels_in_words(info.modulation_hz, info.phase_rad)}",
            hint=f"{hint}; or take another --frame, or --average, if only this one is so" if which else hint,
        )
    return apart


def _misfit(raw: NDArray[np.float64], amplitude: Float32, info: TofInfo) -> str:
    """Say by how much taps (K, N) of amplitudes (F, N) fit no cosine; nothing when they do."""
    rows = tap_rows(info)
    for size, (first, count) in zip(amplitude, rows.spare, strict=True):
        spare = rows.weights[first : first + count] @ raw
        harmonic = float(np.median(2 * np.sqrt(np.square(spare).mean(axis=0)) / size)) if count else 0.0
        if harmonic > _HARMONIC:
            return f"taps half a period apart do not add up, by {harmonic:.1f} of the amplitude"
    return ""


def _disagreement(ranges: Float32, depth: Float32, info: TofInfo) -> str:
    """Say how ranges (F, N) and depths (N,) cannot be; nothing when all is well."""
    hz = frequencies(info.modulation_hz)
    apart = wrap_table(hz, information(info), info.reach).apart
    agreement = float(np.cos(2 * np.pi * np.minimum(mismatch(ranges.T, hz) / apart, 0.5)).mean())
    if agreement < _AGREEMENT:
        return f"the ranges of the frequencies contradict each other (agreement {agreement:.2f} of 1)"
    within = ((depth > _REACH[0]) & (depth < _REACH[1])).mean()
    if within < _WITHIN:
        return f"only {within:.0%} of the bright pixels decode to between {_REACH[0]} and {_REACH[1]} m"
    return ""


def _check_counts(raw: NDArray[np.float64], info: TofInfo, where: str) -> None:
    saturation, raw = info.saturation, np.abs(raw)
    unit = f"counts of a sensor that saturates at {saturation:g}"
    if raw.max() <= 0:
        raise DataError(
            f"{where}: expected {unit}, got none above 0: no light",
            hint="choose another --frame if there are more",
        )
    if raw.max() <= 1:
        raise DataError(
            f"{where}: expected {unit}, got values up to {raw.max():.3g}",
            hint=f"multiply what is scaled to 1 by {saturation:g}",
        )
    share = (raw.max(axis=0) >= saturation).mean()
    if share > 0.5:
        raise DataError(
            f"{where}: expected {unit}, got {share:.0%} of the pixels at or beyond it",
            hint="an overexposed frame holds no phase: expose shorter, or choose another --frame; or say --saturation",
        )


def roughness(images: NDArray[Any]) -> float:
    """Measure how unlike neighbours in a row are; the wrong byte order makes noise of any image.

    The median passes over marks, the mean square sees a smooth depth whose low byte runs over.
    """
    rows = images.astype(np.float64)
    steps = np.abs(np.diff(rows, axis=-1))
    return (float(np.median(steps)) + float(np.sqrt(np.square(steps).mean()))) / max(
        float(np.std(rows)), 1e-9
    )


def framed(raw: NDArray[Any], counts: Sequence[int], where: str) -> NDArray[Any]:
    """Bring (N, H, W), (K, H, W), (N, K, H, W) and channels-last arrays into signed (frames, K, H, W)."""
    if raw.dtype.kind not in "iuf":
        raise FormatError(f"{where}: expected numbers, got {raw.dtype}")
    raw = raw.astype(raw.dtype.newbyteorder("="), copy=False)
    if raw.ndim == 5 and 1 in raw.shape[:2]:
        raw = raw.reshape(raw.shape[0] * raw.shape[1], *raw.shape[2:])
    for read in (_as_frames, _as_turns, _as_images):
        for channels in counts:
            found = read(raw, channels)
            if found is not None and len(found):
                return signed(found)
    raise DataError(
        f"{where}: expected (frames, K, H, W), or a multiple of K images, K of {', '.join(map(str, counts))}, got shape {raw.shape}",
        hint="--mhz says how many frequencies there are, --phases how many phase images each has",
    )


def _as_frames(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    if raw.ndim == 3:
        raw = raw[None]
    if raw.ndim == 4 and raw.shape[1] != channels and raw.shape[-1] == channels:
        raw = np.moveaxis(raw, -1, 1)
    return raw if raw.ndim == 4 and raw.shape[1] == channels else None


def _as_turns(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    """Two frequencies that take turns from frame to frame."""
    if raw.ndim == 4 and 2 * raw.shape[1] == channels and len(raw) % 2 == 0:
        return raw.reshape(-1, channels, *raw.shape[2:])
    return None


def _as_images(raw: NDArray[Any], channels: int) -> NDArray[Any] | None:
    if raw.ndim == 3 and len(raw) % channels == 0:
        return raw.reshape(-1, channels, *raw.shape[1:])
    return None


def signed(raw: NDArray[Any]) -> NDArray[Any]:
    """Give negative numbers back their sign where they were stored as the upper half of 12, 14 or 16 bits.

    Differences of taps lie about zero: unsigned, they crowd at both ends of the scale and leave its middle empty.
    """
    if raw.dtype.kind != "u" or raw.max(initial=0) < 1 << 11:
        return raw
    bits = next(b for b in (12, 14, 16, 32, 64) if int(raw.max()) < 1 << b)
    share = raw.astype(np.float64) / (1 << bits)
    middle = float(((share > 0.3) & (share < 0.7)).mean())
    ends = min(float((share < 0.3).mean()), float((share > 0.7).mean()))
    if middle > 0.01 or ends < 0.05:
        return raw
    return np.where(share >= 0.5, raw.astype(np.int64) - (1 << bits), raw.astype(np.int64))


def without_metadata(raw: NDArray[Any]) -> NDArray[Any]:
    """Take off first and last rows that are no image: their neighbours in the column say nothing of them.

    Cameras write temperature and counters there (method.md 0.4). A row is metadata when it differs from the row inside it by more than
    five times what the rows of the image differ by.
    """
    mean = raw.reshape(-1, *raw.shape[-2:]).astype(np.float64).mean(axis=0)
    step = np.median(np.abs(np.diff(mean, axis=0)), axis=1) + 1e-9
    typical = float(np.median(step[HEADER_ROWS:-HEADER_ROWS])) if len(step) > 4 * HEADER_ROWS else np.inf
    odd = step > 5 * typical + 0.02 * float(np.median(np.abs(mean)))
    first, last = (max(np.flatnonzero(side[:HEADER_ROWS]) + 1, default=0) for side in (odd, odd[::-1]))
    return raw[..., first : raw.shape[-2] - last, :]


_ORDERS = {
    2: ("HW",),
    3: ("KHW", "HWK"),
    4: ("FKHW", "FHWK", "KFHW", "KHWF", "HWKF", "HWFK"),
    5: ("NFKHW", "NFHWK", "HWKFN", "KHWFN"),
}


def in_order(
    raw: NDArray[Any], channels: int, size: tuple[int, int] | None, axes: str, where: str
) -> NDArray[Any]:
    """Bring raw images into (N, F, K, H, W): views, frames of a burst, channels, rows, columns.

    ``axes`` names the axes, as ``HWK`` does; empty: the first order that fits ``channels`` and ``size`` (H, W), where it is known.
    Raises :class:`DataError` when none fits, and names the order that would if rows and columns changed places.
    """
    if axes:
        return _ordered(raw, axes, channels, size, where)
    for order in _ORDERS.get(raw.ndim, ()):
        if _fits(raw.shape, order, channels, size):
            return _ordered(raw, order, channels, size, where)
    if raw.ndim == 3 and len(raw) % channels == 0 and size in (None, raw.shape[1:]):
        return framed(raw, [channels], where)[None]
    for i, (a, b) in reversed(list(enumerate(pairwise(raw.shape)))):
        if a * b == channels and 1 < a <= b and raw.ndim > 3:  # frequencies and phases on axes of their own
            return in_order(
                raw.reshape(*raw.shape[:i], channels, *raw.shape[i + 2 :]), channels, size, "", where
            )
    turned = next(
        (o for o in _ORDERS.get(raw.ndim, ()) if size and _fits(raw.shape, o, channels, size[::-1])), ""
    )
    image = f"{size[0]} x {size[1]} images" if size else "images"
    if turned:
        swapped = turned.translate(str.maketrans("HW", "WH"))
        hint = f'rows and columns have changed places: [raw] axes = "{swapped}" in import.toml'
    elif size and raw.ndim in _ORDERS:
        hint = "is the camera of another size? --camera, or [tof] width and height in import.toml; [raw] axes names the axes"
    else:
        hint = "[tof] modulation_mhz and phase_deg in import.toml say what the channels are; [raw] axes names the axes"
    raise DataError(f"{where}: expected {image} of {channels} channels, got shape {raw.shape}", hint)


def _fits(shape: tuple[int, ...], order: str, channels: int, size: tuple[int, int] | None) -> bool:
    found = dict(zip(order, shape, strict=True))
    image = (found["H"], found["W"])
    return found.get("K", channels) == channels and (size == image if size else min(image) > 4)


def _ordered(
    raw: NDArray[Any], axes: str, channels: int, size: tuple[int, int] | None, where: str
) -> NDArray[Any]:
    if len(axes) != raw.ndim or len(set(axes)) != len(axes) or not {"H", "W"} <= set(axes) <= set("NFKHW"):
        raise DataError(
            f"{where}: expected axes that name {raw.ndim} of N, F, K, H and W, got {axes!r} for shape {raw.shape}",
            hint='[raw] axes = "HWK" in import.toml is an array of rows, columns, channels',
        )
    found = np.transpose(raw, [axes.index(a) for a in "NFKHW" if a in axes])
    found = found.reshape([raw.shape[axes.index(a)] if a in axes else 1 for a in "NFKHW"])
    if found.shape[2] != channels or size not in (None, found.shape[-2:]):
        raise DataError(
            f"{where}: expected {channels} channels of {size or 'any size'}, got (N, F, K, H, W) = {found.shape}",
            hint="[raw] axes, and [tof] width, height and modulation_mhz in import.toml",
        )
    return found


def metres(depth: NDArray[Any], unit: str, missing: Sequence[float], where: str) -> Float32:
    """Bring depths of others into float32 metres with NaN where nothing was measured.

    Zero, NaN, infinity, the largest value of an unsigned integer and what ``missing`` lists are missing. A ``unit`` that is not
    said is taken for metres. Raises :class:`DataError` for depths that are none in this unit, with the unit that fits.
    """
    if depth.dtype.kind not in "iuf" or depth.dtype.itemsize == 1:
        raise DataError(
            f"{where}: expected depths, got {depth.dtype}",
            hint="8 bits are a picture of depths; export 16 bits or floats",
        )
    if depth.ndim != 2:
        raise DataError(
            f"{where}: expected a depth image (H, W), got shape {depth.shape}",
            hint='three floats a pixel are points: [truth] kind = "points" in import.toml',
        )
    values = depth.astype(np.float64)
    gone = ~np.isfinite(values) | (values == 0) | np.isin(values, list(missing))
    if depth.dtype.kind == "u":
        gone |= depth == np.iinfo(depth.dtype).max
    values[gone] = np.nan
    if gone.all():
        raise DataError(f"{where}: expected depths, every pixel is missing", hint="leave this view out")
    if (values[~gone] < 0).mean() > 0.01:
        share = (values[~gone] < 0).mean()
        raise DataError(
            f"{where}: expected depths before the camera, {share:.0%} are behind it",
            hint="z looks forward here, y down: turn OpenGL's y and z round; or name negative marks: [truth] missing = [-1]",
        )
    values[values < 0] = np.nan
    scale = UNITS.get(unit or "m", 1.0)
    median = float(np.nanmedian(values)) * scale
    if not NEAREST < median < FARTHEST:
        fits = [u for u, s in UNITS.items() if NEAREST < median / scale * s < 10]
        said = f"as {unit} say" if unit else "in metres"
        raise DataError(
            f"{where}: expected depths of {NEAREST:g} to {FARTHEST:g} m, got a median of {median:.4g} m {said}",
            hint=f'[truth] unit = "{fits[-1]}" in import.toml'
            if fits
            else "[truth] unit in import.toml: m, cm or mm",
        )
    return (values * scale).astype(np.float32)
