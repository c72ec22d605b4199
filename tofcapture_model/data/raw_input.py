"""Read what a prediction starts from: raw frames of a view file, a shard or a plain array, if they make sense."""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import channels_in_words, frequencies, mismatch, wrap_table
from tofcapture.errors import ConfigError, DataError, UnreadableError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.ops.phase import Decoder, information
from tofcapture.ops.phase.float32 import tap_rows
from tofcapture.rig import RangeError, load_rig

Float32 = NDArray[np.float32]
NOMINAL_CAMERA = Camera(width=240, height=180, fx=190.6186, fy=200.7526, cx=116.8406, cy=101.4767)
"""A real 240 x 180 sensor of 20/100 MHz; used for a plain array when no rig is given."""

NOMINAL_RANGE_ERRORS = (
    RangeError(20e6, offset=-0.01428),
    RangeError(
        100e6,
        offset=-0.7427,
        harmonics=((2, -0.006, 0.0012), (4, -0.0007, 0.0002)),
        per_pixel_radius=1.54e-4,
        per_kelvin=-1.8e-4,
    ),
)
"""Range errors measured on that sensor; taken for an array without a rig if its two frequencies agree with them only."""

SATURATION = 4095.0  # counts, of a 12-bit sensor: taken for an array unless it is said
_ARRAYS = (".npy", ".npz")
_KINDS = "a view file or a shard (.h5), or an array (.npy, .npz)"
_SUSPICIOUS = 0.25  # of saturation: no count beyond it is what a sensor of two bits less would give
_REACH = (0.05, 5.0)  # m, depths that a table-top rig can see; the networks take others for holes
# In 76 frames of simulated cameras and rooms, all in the right order: at most 0.11, at least 0.97, at least 0.86.
_HARMONIC, _AGREEMENT, _WITHIN = 0.3, 0.5, 0.5


@dataclass(frozen=True)
class RawInput:
    """A burst of F frames and what is needed to decode it."""

    raw: NDArray[Any]  #: (F, K, H, W) taps
    celsius: NDArray[np.float64]  #: (F,) sensor temperatures; NaN: unknown
    info: TofInfo  #: channels, saturation, light source, range errors
    camera: Camera  #: intrinsics
    source: str = ""  #: the file, for messages
    assumed: str = ""  #: what was taken for granted because nobody said it
    warning: str = ""  #: what looks wrong and may be right

    def named(self, frame: int | None) -> str:
        """Call a frame, or with ``None`` the mean of all, by name."""
        return self.source + _which(self.raw, frame)


def _which(raw: NDArray[Any], frame: int | None) -> str:
    if len(raw) == 1:
        return ""
    return ", mean of the burst" if frame is None else f", frame {frame}"


def taken(
    raw: NDArray[Any], frame: int | None, info: TofInfo, celsius: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Take one frame (K, H, W) of a burst (F, K, H, W), or with ``None`` the mean, and its sensor temperature of (F,).

    A tap that is saturated in any frame gets the saturation value in the mean: clipping took from its mean what nobody knows.
    :meth:`tofcapture.ops.phase.Decoder.burst` has the same rule. :class:`ConfigError`: no such frame.
    """
    if frame is not None:
        if not 0 <= frame < len(raw):
            raise ConfigError(f"expected a frame of 0 to {len(raw) - 1}, got {frame}")
        return raw[frame].astype(np.float64), float(celsius[frame])
    mean = raw.mean(axis=0, dtype=np.float64)
    mean[info.saturated(raw).any(axis=0)] = info.saturation
    return mean, float(celsius.mean())


def read_input(
    path: Path,
    view: int = 0,
    rig: Path | None = None,
    *,
    saturation: float | None = None,
    frame: int | None = None,
) -> RawInput:
    """Read a burst.

    Parameters
    ----------
    path
        View file or shard (``.h5``), or an array (K, H, W) or (F, K, H, W), ``.npy`` or ``.npz`` with one array or one called
        ``raw``: counts in the order of the paper's camera, or as ``modulation_hz`` and ``phase_rad`` beside it say.
    view
        Of a shard.
    rig, saturation
        Of an array: its ``rig.toml``, and the counts at which its sensor saturates. Without them nominal values are taken, and
        ``assumed`` names them.
    frame
        Of an array, what is looked at: one frame, or ``None``: the mean.

    Raises
    ------
    DataError
        Missing, damaged, of a wrong shape, or an array that is no raw data of these channels and this unit.
    ConfigError
        No such view or frame, or a rig or a saturation for a file that carries its own.
    """
    if not path.is_file():
        what = "a folder, expected one file" if path.is_dir() else "no such file"
        raise DataError(f"{path}: {what}", hint=_KINDS)
    if path.suffix.lower() in _ARRAYS:
        return _from_array(path, rig, saturation, frame)
    for option, value in (("--rig", rig), ("--saturation", saturation)):
        if value is not None:
            raise ConfigError(
                f"{option} {value}: expected an array ({', '.join(_ARRAYS)}), got {path}",
                hint="views and shards carry their camera",
            )
    return _from_h5(path, view)


def _from_array(path: Path, rig_path: Path | None, saturation: float | None, frame: int | None) -> RawInput:
    held = _load(path)
    raw = held["raw"][None] if held["raw"].ndim == 3 else held["raw"]
    rig = load_rig(rig_path) if rig_path else None
    camera = rig.tof if rig else NOMINAL_CAMERA
    plain = _described(held, camera, saturation, path)
    if rig:
        plain = replace(plain, illuminator=rig.illuminator, range_errors=rig.range_errors, reach=rig.reach)
    _check_shape(raw, plain, path)
    celsius = np.full(len(raw), np.nan)
    taps, _ = taken(raw, frame, plain, celsius)
    expect_finite(taps, f"{path}{_which(raw, frame)}")
    warning = _check_unit(raw, plain, path)
    if rig:
        info, assumed = plain, ""
        check_taps(taps, info, path, _which(raw, frame))
    else:
        info, words = _without_rig(taps, plain, path, _which(raw, frame))
        assumed = f"nominal intrinsics of 240 x 180 pixels, {words}"
    return RawInput(raw, celsius, info, camera, str(path), assumed, warning if saturation is None else "")


def _described(
    held: dict[str, NDArray[Any]], camera: Camera, saturation: float | None, path: Path
) -> TofInfo:
    """Take the channels that lie beside the array, or the paper's camera's."""
    said = {
        k: held[k].reshape(-1) for k in ("modulation_hz", "phase_rad", "offset", "saturation") if k in held
    }
    limit = said.get("saturation", [SATURATION])[0] if saturation is None else saturation
    try:
        return TofInfo(
            "array", "", camera, np.zeros(3),
            tuple(map(float, said.get("modulation_hz", PAPER_MODULATION_HZ))),
            tuple(map(float, said.get("phase_rad", PAPER_PHASE_RAD))),
            saturation=float(limit),
            offset=bool(said.get("offset", [True])[0]),
        )  # fmt: skip
    except DataError as err:
        raise DataError(f"{path}: {err.message}", err.hint) from err
    except (TypeError, ValueError, IndexError) as err:
        hint = "np.savez(path, raw=raw, modulation_hz=hz, phase_rad=phases), one number a channel"
        raise DataError(
            f"{path}: the channels that lie beside the array are no numbers: {err}", hint
        ) from err


def _load(path: Path) -> dict[str, NDArray[Any]]:
    """Read the array of a ``.npy`` or a ``.npz`` as ``raw``, with what lies beside it; whatever the file is called."""
    try:
        found = np.load(path, allow_pickle=False)
        if isinstance(found, np.ndarray):
            return {"raw": found}
        with found:
            held = {name: np.asarray(found[name]) for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as err:
        raise DataError(f"{path}: cannot read the array: {err}", hint="write it with np.save") from err
    if len(held) == 1:
        return {"raw": next(iter(held.values()))}
    if "raw" in held:
        return held
    raise DataError(
        f"{path}: expected one array, or one that is called raw, got {', '.join(held) or 'none'}",
        hint="np.savez(path, raw=raw)",
    )


def _without_rig(taps: NDArray[np.float64], plain: TofInfo, path: Path, which: str) -> tuple[TofInfo, str]:
    """Take no range errors or :data:`NOMINAL_RANGE_ERRORS`, as the data say."""
    try:
        check_taps(taps, plain, path, which)
    except DataError as err:
        if frequencies(plain.modulation_hz) != tuple(e.modulation_hz for e in NOMINAL_RANGE_ERRORS):
            raise
        known = replace(plain, range_errors=NOMINAL_RANGE_ERRORS)
        try:
            check_taps(taps, known, path, which)
        except DataError:
            raise err from None
        return known, "range errors of a known sensor"
    return plain, "no range errors"


def _check_shape(raw: NDArray[Any], info: TofInfo, path: Path) -> None:
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


def _check_unit(raw: NDArray[Any], info: TofInfo, path: Path) -> str:
    """Refuse counts that this sensor cannot give; say what is suspicious, but a dark frame has low counts too."""
    largest, saturation = float(np.abs(raw[np.isfinite(raw)].astype(np.float64)).max()), info.saturation
    bits = math.ceil(math.log2(max(largest, 1) + 1))
    if largest > saturation:
        raise DataError(
            f"{path}: expected counts of a sensor that saturates at {saturation:g}, got values up to {largest:g}",
            hint=f"--saturation COUNTS says where yours does ({2**bits - 1} with {bits} bits)",
        )
    if not 1 < largest <= _SUSPICIOUS * saturation:
        return ""
    return (
        f"{path}: no count exceeds {largest:g}. That is right for a dark scene of a sensor that saturates at {saturation:g}; "
        f"if yours has fewer bits, say so: --saturation {2**bits - 1} for {bits} bits"
    )


def check_taps(raw: NDArray[np.float64], info: TofInfo, path: Path, which: str = "") -> None:
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
    found = _contradiction(
        raw[:, bright], amplitude[:, bright], signals.ranges[:, bright], maps.depth[bright], info
    )
    if found:
        hint = f"tofcapture calibrate phase-order {path} says what the channels are; reorder them"
        raise DataError(
            f"{where}: {found}; expected channels: {channels_in_words(info.modulation_hz, info.phase_rad)}",
            hint=f"{hint}; or take another --frame, or --average, if only this one is so" if which else hint,
        )


def _contradiction(
    raw: NDArray[np.float64], amplitude: Float32, ranges: Float32, depth: Float32, info: TofInfo
) -> str:
    """Say what of taps (K, N), amplitudes (F, N), ranges (F, N) and depths (N,) cannot be; nothing when all is well."""
    rows, hz = tap_rows(info), frequencies(info.modulation_hz)
    for size, (first, count) in zip(amplitude, rows.spare, strict=True):
        spare = rows.weights[first : first + count] @ raw
        harmonic = float(np.median(2 * np.sqrt(np.square(spare).mean(axis=0)) / size)) if count else 0.0
        if harmonic > _HARMONIC:
            return f"taps half a period apart do not add up, by {harmonic:.1f} of the amplitude"
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


def _from_h5(path: Path, view: int) -> RawInput:
    from tofcapture.files.hdf import open_h5
    from tofcapture.files.shard import ShardReader
    from tofcapture.files.view import open_view

    try:
        with open_h5(path) as file:
            kind = str(file.attrs.get("format", ""))
    except UnreadableError:
        raise
    except DataError as err:
        raise DataError(
            f"cannot read the file: {err.message}", hint=err.hint if path.suffix == ".h5" else _KINDS
        ) from err
    if kind != "tofcapture-shard":
        found = open_view(path)
        return RawInput(found.tof.raw, found.tof.celsius, found.tof.info, found.rig.tof, str(path))
    with ShardReader(path) as shard:
        if not 0 <= view < shard.views:
            raise ConfigError(f"{path}: expected a view of 0 to {shard.views - 1}, got {view}")
        raw = np.stack([shard.raw(view, f) for f in range(shard.frames)])
        celsius = np.array([shard.celsius(view, f) for f in range(shard.frames)])
        return RawInput(raw, celsius, shard.info, shard.camera, str(path))
