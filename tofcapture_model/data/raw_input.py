"""Read what a prediction starts from: raw frames of a view file, a shard or a plain array, if they make sense."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import frequencies
from tofcapture.errors import ConfigError, DataError, UnreadableError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.importing.readers.arrays import arrays_of, facts_of
from tofcapture.importing.rigs import tof_rig
from tofcapture.importing.rules import (
    SATURATION,
    burst_mean,
    check_taps,
    check_unit,
    expect_finite,
    expect_shape,
    sign_unknown,
)
from tofcapture.importing.said import Facts
from tofcapture.rig import RangeError

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

_ARRAYS = (".npy", ".npz")
IMPORTED = "tofcapture import reads images, bags, MAT, HDF5 and bytes of cameras; predict takes its recording"
_KINDS = f"a view file or a shard (.h5), or an array (.npy, .npz); {IMPORTED}"


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

    :class:`ConfigError`: no such frame.
    """
    if frame is not None:
        if not 0 <= frame < len(raw):
            raise ConfigError(f"expected a frame of 0 to {len(raw) - 1}, got {frame}")
        return raw[frame].astype(np.float64), float(celsius[frame])
    return burst_mean(raw, info), float(celsius.mean())


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
        View file or shard (``.h5``), or an array (K, H, W) or (F, K, H, W), ``.npy`` or ``.npz`` with one array, one called
        ``raw`` or one of so many channels: counts in the order of the paper's camera, or as ``modulation_hz`` and ``phase_rad`` beside it say.
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
        return from_arrays(arrays_of(path), path, rig, saturation, frame)
    for option, value in (("--rig", rig), ("--saturation", saturation)):
        if value is not None:
            raise ConfigError(
                f"{option} {value}: expected an array ({', '.join(_ARRAYS)}), got {path}",
                hint="views and shards carry their camera" if path.suffix.lower() == ".h5" else IMPORTED,
            )
    return _from_h5(path, view)


def from_arrays(
    held: Mapping[str, NDArray[Any]],
    path: Path,
    rig_path: Path | None = None,
    saturation: float | None = None,
    frame: int | None = None,
) -> RawInput:
    """Read a burst from arrays by name, as :func:`read_input` does; ``path`` is what messages call them."""
    facts = facts_of(held, path)
    K = len(facts.modulation_hz or PAPER_MODULATION_HZ)
    like_raw = [n for n, a in held.items() if a.ndim in (3, 4) and K in (a.shape[-3], a.shape[-1])]
    name = next(
        (names[0] for names in (["raw"], list(held), like_raw) if len(names) == 1 and names[0] in held), None
    )
    if name is None:
        raise DataError(
            f"{path}: expected one array, or one that is called raw, got {', '.join(held) or 'none'}",
            hint="np.savez(path, raw=raw)",
        )
    raw = held[name][None] if held[name].ndim == 3 else held[name]
    last = raw.ndim > 2 and raw.shape[-1] == K != raw.shape[-3]  # channels that come last are told below
    first = -3 if last else -2
    rig = tof_rig(rig_path, raw.shape[first:][:2] if raw.ndim > 2 else None) if rig_path else None
    camera = rig.tof if rig else NOMINAL_CAMERA
    plain = _described(facts, camera, saturation, path)
    if rig:
        plain = replace(plain, illuminator=rig.illuminator, range_errors=rig.range_errors, reach=rig.reach)
    expect_shape(raw, plain, path)
    celsius = np.full(len(raw), np.nan)
    taps, _ = taken(raw, frame, plain, celsius)
    expect_finite(taps, f"{path}{_which(raw, frame)}")
    warning = "; ".join(filter(None, (check_unit(raw, plain, path), sign_unknown(plain))))
    if rig:
        info, assumed = plain, ""
        check_taps(taps, info, path, _which(raw, frame))
    else:
        info, words = _without_rig(taps, plain, path, _which(raw, frame))
        assumed = f"nominal intrinsics of 240 x 180 pixels, {words}"
    return RawInput(raw, celsius, info, camera, str(path), assumed, warning if saturation is None else "")


def _described(facts: Facts, camera: Camera, saturation: float | None, path: Path) -> TofInfo:
    """Take the channels that lie beside the array, or the paper's camera's."""
    limit = facts.saturation if saturation is None else saturation
    try:
        return TofInfo(
            "array", "", camera, np.zeros(3),
            facts.modulation_hz or PAPER_MODULATION_HZ,
            facts.phase_rad or PAPER_PHASE_RAD,
            saturation=SATURATION if limit is None else limit,
            offset=facts.offset is not False,
        )  # fmt: skip
    except DataError as err:
        raise DataError(f"{path}: {err.message}", err.hint) from err


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
    if not kind.startswith("tofcapture-"):
        raise DataError(f"{path}: expected a view or a shard, got HDF5 of another program", hint=IMPORTED)
    if kind != "tofcapture-shard":
        found = open_view(path)
        return RawInput(found.tof.raw, found.tof.celsius, found.tof.info, found.rig.tof, str(path))
    with ShardReader(path) as shard:
        if not 0 <= view < shard.views:
            raise ConfigError(f"{path}: expected a view of 0 to {shard.views - 1}, got {view}")
        raw = np.stack([shard.raw(view, f) for f in range(shard.frames)])
        celsius = np.array([shard.celsius(view, f) for f in range(shard.frames)])
        return RawInput(raw, celsius, shard.info, shard.camera, str(path))
