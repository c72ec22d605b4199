"""What the arrays of a view or a shard must obey beyond shape and dtype; each rule yields ``(where, message)``."""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.files.hdf import Array
from tofcapture.files.layout import MaskBit, TofFlag
from tofcapture.poses import check_transform

Finding = tuple[str, str]

_UNIT = 1e-3  # tolerance of a normal's length: float32 and then some
_ALL_BITS = np.uint8(sum(MaskBit))
_ALL_FLAGS = np.uint8(sum(TofFlag))
FARTHEST = 30.0  # m; twice what 10 MHz measures without ambiguity, farther than any station or room
REACH = 20.0  # m; from an arm's base to its camera
CELSIUS = (-40.0, 125.0)  # what electronics survive


def _count(bad: NDArray[np.bool_]) -> str:
    return f"{int(bad.sum())} of {bad.size} pixels"


def rigid(file: h5py.File, name: str) -> Iterator[Finding]:
    """Transforms (..., 4, 4) are rigid."""
    for T in np.asarray(file[name][()]).reshape(-1, 4, 4):
        try:
            check_transform(T, "transform")
        except ConfigError as err:
            yield f"/{name}", err.message
            return


def increasing(file: h5py.File, name: str) -> Iterator[Finding]:
    """Time goes on along the last axis."""
    time = np.asarray(file[name][()])
    if (np.diff(time, axis=-1) <= 0).any():
        yield f"/{name}", "expected times that increase within a burst, they do not"


def normals_obey(where: str, normals: Array, there: NDArray[np.bool_]) -> Iterator[Finding]:
    """Normals are unit where there is a surface and NaN elsewhere."""
    length = np.linalg.norm(normals.astype(np.float64), axis=-1)
    bad = there != (np.abs(length - 1) < _UNIT)
    if bad.any():
        yield where, f"expected unit normals exactly where there is depth, {_count(bad)} disagree"


def faces(where: str, normals: Array, rays: Array) -> Iterator[Finding]:
    """Normals face the camera: ``n . r < 0``."""
    away = np.einsum("hwc,hwc->hw", normals.astype(np.float64), rays) > 1e-6  # NaN compares false
    if away.any():
        yield where, f"expected normals that face the camera, {_count(away)} do not"


def positive(where: str, depth: Array) -> Iterator[Finding]:
    """Depth is a positive length or NaN; zero never means missing."""
    bad = ~(np.isnan(depth) | (np.isfinite(depth) & (depth > 0)))
    if bad.any():
        yield where, f"expected positive depth or NaN, {_count(bad)} are neither"


def near(where: str, depth: Array) -> Iterator[Finding]:
    """No surface is farther than :data:`FARTHEST`."""
    far = depth > FARTHEST  # NaN compares false
    if far.any():
        yield where, f"expected depth of at most {FARTHEST:g} m, {_count(far)} are farther"


def amplitude(where: str, confidence: Array) -> Iterator[Finding]:
    """An amplitude is a number from zero up, or NaN."""
    bad = (confidence < 0) | np.isinf(confidence)
    if bad.any():
        yield where, f"expected amplitudes from zero up, {_count(bad)} are not"


def flagged(where: str, flags: Array) -> Iterator[Finding]:
    """No unknown flag is set."""
    if (flags & ~_ALL_FLAGS).any():
        yield where, f"expected the flags {[b.name for b in TofFlag]} only, others are set"


def plausible(file: h5py.File) -> Iterator[Finding]:
    """Temperatures that electronics survive, poses within an arm's reach."""
    celsius = np.asarray(file["tof/celsius"][()])
    if ((celsius < CELSIUS[0]) | (celsius > CELSIUS[1])).any():
        yield "/tof/celsius", f"expected {CELSIUS[0]:g} to {CELSIUS[1]:g} degC or NaN, some are not"
    if (np.abs(np.asarray(file["views/T_base_tof"][()])[..., :3, 3]) > REACH).any():
        yield "/views/T_base_tof", f"expected a camera within {REACH:g} m of the base, it is farther away"


def distinct(file: h5py.File, name: str) -> Iterator[Finding]:
    """Every view of the recording is there once."""
    index = np.asarray(file[name][()])
    if len(np.unique(index)) != len(index) or (index < 0).any():
        yield f"/{name}", f"expected distinct numbers from 0 up, got {index.tolist()}"


def masked(where: str, depth: Array, mask: Array) -> Iterator[Finding]:
    """Depth is finite exactly where ``NOT_HIT`` is unset, and no unknown bit is set."""
    bad = np.isfinite(depth) == ((mask & MaskBit.NOT_HIT) > 0)
    if bad.any():
        yield where, f"expected depth exactly where NOT_HIT is unset, {_count(bad)} disagree"
    if (mask & ~_ALL_BITS).any():
        yield where, f"expected the bits {[b.name for b in MaskBit]} only, others are set"


def point_map(where: str, points: Array) -> Iterator[Finding]:
    """A point is measured in all three coordinates or in none, before the camera."""
    finite = np.isfinite(points)
    bad = finite.any(axis=-1) != finite.all(axis=-1)
    if bad.any():
        yield where, f"expected points that are finite or NaN as a whole, {_count(bad)} are half"
    behind = points[..., 2] <= 0  # NaN compares false
    if behind.any():
        yield where, f"expected points before the camera, {_count(behind)} are not"


def saturated_or_not(file: h5py.File, name: str, saturation: float) -> Iterator[Finding]:
    """Not every tap of a frame is saturated or zero: that is a covered or blinded sensor."""
    raw = file[name]
    for index in np.ndindex(raw.shape[:-3]):
        frame = raw[index]
        if (frame == 0).all() or (frame >= saturation).all():
            yield f"/{name}{list(index)}", "expected an image, every tap is zero or saturated"
            return
