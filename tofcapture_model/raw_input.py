"""What a prediction starts from: a burst of raw frames from a view file, a shard or a plain ``.npy``, and a look at whether it makes sense."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import Decoder, ambiguity, frequencies
from tofcapture.rig import RangeError, load_rig

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
"""Range errors measured on that sensor; taken for a plain array without a rig whose two frequencies agree with them and not without."""

CHANNELS = "20 MHz at 0, 90, 180, 270 deg, then 100 MHz at the same"
_REACH = (0.05, 5.0)  # m, depths that a table-top rig can see; the networks take others for holes
# In 76 frames of simulated cameras and rooms, all in the right order: at most 0.11, at least 0.97, at least 0.86.
_HARMONIC, _AGREEMENT, _WITHIN = 0.3, 0.5, 0.5


@dataclass(frozen=True)
class RawInput:
    """A burst and what is needed to decode it: raw (F, 8, H, W), sensor temperatures (F,), camera, intrinsics; what was assumed."""

    raw: NDArray[Any]
    celsius: NDArray[np.float64]
    info: TofInfo
    camera: Camera
    assumed: str = ""


def read_input(path: Path, view: int = 0, rig: Path | None = None) -> RawInput:
    """Read a burst.

    Parameters
    ----------
    path
        View file or shard (``.h5``), or an array (8, H, W) or (F, 8, H, W) (``.npy``): counts of a 12-bit sensor, in the order of
        :data:`CHANNELS`.
    view
        Of a shard.
    rig
        ``rig.toml`` for an array; without it, nominal intrinsics, and no range errors or :data:`NOMINAL_RANGE_ERRORS`, whichever the
        two frequencies agree with; ``assumed`` says which.

    Raises
    ------
    DataError
        Missing, damaged, of a wrong shape, or an array that is no four-phase raw data of this order and unit.
    ConfigError
        No such view, or a rig for a file that carries its own.
    """
    if not path.is_file():
        what = "a folder, expected one file" if path.is_dir() else "no such file"
        raise DataError(f"{path}: {what}", hint="a view file or a shard (.h5), or an array (.npy)")
    if path.suffix == ".npy":
        return _from_npy(path, rig)
    if rig is not None:
        raise ConfigError(
            f"--rig {rig}: expected an array (.npy), got {path}", hint="views and shards carry their camera"
        )
    return _from_h5(path, view)


def _from_npy(path: Path, rig_path: Path | None) -> RawInput:
    try:
        raw = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as err:
        raise DataError(f"{path}: cannot read the array: {err}") from err
    raw = raw[None] if raw.ndim == 3 else raw
    rig = load_rig(rig_path) if rig_path else None
    camera = rig.tof if rig else NOMINAL_CAMERA
    _check_shape(raw, camera, path)
    mean = raw.mean(axis=0, dtype=np.float64)
    celsius = np.full(len(raw), np.nan)
    if rig:
        info = _array_info(camera, rig.illuminator, rig.range_errors)
        check_taps(mean, info, str(path))
        return RawInput(raw, celsius, info, camera)
    return _without_rig(raw, mean, celsius, path)


def _array_info(
    camera: Camera, illuminator: NDArray[np.float64], range_errors: tuple[RangeError, ...]
) -> TofInfo:
    return TofInfo("array", "", camera, illuminator, range_errors=range_errors)


def _without_rig(
    raw: NDArray[Any], mean: NDArray[np.float64], celsius: NDArray[np.float64], path: Path
) -> RawInput:
    """Take a camera that corrects its ranges itself, or else the sensor of :data:`NOMINAL_RANGE_ERRORS`, as the data say."""
    words = "nominal intrinsics of 240 x 180 pixels, "
    plain = _array_info(NOMINAL_CAMERA, np.zeros(3), ())
    try:
        check_taps(mean, plain, str(path))
    except DataError as err:
        known = _array_info(NOMINAL_CAMERA, np.zeros(3), NOMINAL_RANGE_ERRORS)
        try:
            check_taps(mean, known, str(path))
        except DataError:
            raise err from None
        return RawInput(raw, celsius, known, NOMINAL_CAMERA, words + "range errors of a known sensor")
    return RawInput(raw, celsius, plain, NOMINAL_CAMERA, words + "no range errors")


def _check_shape(raw: NDArray[Any], camera: Camera, path: Path) -> None:
    """Refuse anything but (F, 8, H, W) numbers of more than 8 bits."""
    h, w = camera.shape
    shape, fine = raw.shape[1:], raw.ndim == 4 and len(raw) > 0
    if fine and shape == (8, h, w) and raw.dtype.kind in "uif" and raw.dtype.itemsize > 1:
        return
    hint = "--rig names a camera of another size"
    if fine and shape == (h, w, 8):
        hint = "np.moveaxis(raw, -1, -3) puts the channels before rows and columns"
    elif fine and shape == (8, w, h):
        hint = "np.swapaxes(raw, -1, -2) puts the rows before the columns"
    elif fine and shape == (8, h, w):
        hint = "counts as the sensor gives them, such as uint16"
    expected = f"(8, {h}, {w}) or (F, 8, {h}, {w})"
    got = raw.shape[1:] if len(raw) == 1 else raw.shape
    raise DataError(f"{path}: expected numbers of shape {expected}, got {raw.dtype} {got}", hint=hint)


def check_taps(raw: NDArray[np.float64], info: TofInfo, where: str) -> None:
    """Refuse taps that cannot be what ``info`` says: other units, other channels, no signal.

    Taps half a period apart add up to twice the offset, so ``C_0 - C_1 + C_2 - C_3`` vanishes for the right order; ranges of both
    frequencies agree up to noise and calibration; depths lie within the reach of the rig. Looked at are the brighter half of
    the pixels below saturation, and the bounds are wide: what is refused is not merely noisy. A start tap that is wrong by
    the same quarter in both frequencies passes: no frame can tell.

    Parameters
    ----------
    raw
        (8, H, W) one frame or the mean of some.
    info
        What they are taken for: four phases of the low frequency, then of the high one.
    where
        For the message.

    Raises
    ------
    DataError
        With what was found, and what to try.
    """
    _check_counts(raw, info.saturation, where)
    maps, signals = Decoder(info).signals(raw)
    amplitude = np.hypot(signals.phasor[:, 0], signals.phasor[:, 1])
    weaker = np.where(raw.max(axis=0) < info.saturation, amplitude.min(axis=0), np.nan)
    bright = (weaker >= np.nanmedian(weaker)) & (weaker > 0)
    if not bright.any():
        raise DataError(f"{where}: no modulated light: the four phases are equal everywhere")
    found = _contradiction(
        raw[:, bright], amplitude[:, bright], signals.gap[bright], maps.depth[bright], info
    )
    if found:
        raise DataError(
            f"{where}: {found}; expected channels: {CHANNELS}",
            hint=f"tofcapture calibrate phase-order {where} says what the channels are; reorder them",
        )


def _contradiction(
    raw: NDArray[np.float64],
    amplitude: NDArray[np.float32],
    gap: NDArray[np.float32],
    depth: NDArray[np.float32],
    info: TofInfo,
) -> str:
    """Say what of taps (8, N), amplitudes (2, N), gaps (N,) and depths (N,) cannot be; nothing when all is well."""
    taps = raw.reshape(2, 4, -1)
    second = np.abs(taps[:, 0] - taps[:, 1] + taps[:, 2] - taps[:, 3])
    harmonic = np.median(second / amplitude, axis=1).max()
    if harmonic > _HARMONIC:
        return f"taps half a period apart do not add up, by {harmonic:.1f} of the amplitude"
    wrap = ambiguity(frequencies(info.modulation_hz)[1])
    agreement = np.cos(2 * np.pi * gap / wrap).mean()
    if agreement < _AGREEMENT:
        return f"the ranges of the two frequencies contradict each other (agreement {agreement:.2f} of 1)"
    within = ((depth > _REACH[0]) & (depth < _REACH[1])).mean()
    if within < _WITHIN:
        return f"only {within:.0%} of the bright pixels decode to between {_REACH[0]} and {_REACH[1]} m"
    return ""


def _check_counts(raw: NDArray[np.float64], saturation: float, where: str) -> None:
    if not np.isfinite(raw).all():
        raise DataError(f"{where}: expected finite numbers, got {np.count_nonzero(~np.isfinite(raw))} others")
    unit = f"counts of a sensor that saturates at {saturation:g}"
    if raw.max() <= 1:
        raise DataError(
            f"{where}: expected {unit}, got values up to {raw.max():.3g}",
            hint=f"multiply what is scaled to 1 by {saturation:g}",
        )
    share = (raw.max(axis=0) >= saturation).mean()
    if share > 0.5:
        raise DataError(
            f"{where}: expected {unit}, got {share:.0%} of the pixels at or beyond it",
            hint="scale counts of more than 12 bits to 12; an overexposed frame holds no phase",
        )


def _from_h5(path: Path, view: int) -> RawInput:
    import h5py

    from tofcapture.files.shard import ShardReader
    from tofcapture.files.view import read_view

    try:
        with h5py.File(path, "r") as file:
            kind = str(file.attrs.get("format", ""))
    except OSError as err:
        hint = (
            f"tofcapture check {path}"
            if path.suffix == ".h5"
            else "a view file or a shard (.h5), or an array (.npy)"
        )
        raise DataError(f"{path}: cannot read the file: {err}", hint=hint) from err
    if kind != "tofcapture-shard":
        found = read_view(path)
        return RawInput(found.tof.raw, found.tof.celsius, found.tof.info, found.rig.tof)
    with ShardReader(path) as shard:
        if not 0 <= view < shard.views:
            raise ConfigError(f"{path}: expected a view of 0 to {shard.views - 1}, got {view}")
        raw = np.stack([shard.raw(view, f) for f in range(shard.frames)])
        celsius = np.array([shard.celsius(view, f) for f in range(shard.frames)])
        return RawInput(raw, celsius, shard.info, shard.camera)
