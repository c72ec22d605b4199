"""List every problem of one view file or shard.

A sealed file is first compared with its stored digest: a flipped byte anywhere is found there, and HDF5 is not asked to parse
a damaged file. Then come the layout (missing, dtype, shape, units), the descriptions, the chunks' checksums and the rules that
the arrays obey.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, TofError, UnreadableError
from tofcapture.files.disk import is_there, unreadable
from tofcapture.files.hdf import Array, json_attr, open_h5, stereo_from, text_attr, tof_from
from tofcapture.files.layout import LAYOUTS, SHARD, VIEW, Field, Layout, MaskBit
from tofcapture.files.seal import digest_path, digest_text, sha256_of, stored_digest
from tofcapture.frames import StereoInfo, TofFlag, TofInfo
from tofcapture.poses import check_transform
from tofcapture.rig import loads_rig

FARTHEST = 30.0  # m; twice what 10 MHz measures without ambiguity, farther than any station or room
REACH = 20.0  # m; from an arm's base to its camera
CELSIUS = (-40.0, 125.0)  # what electronics survive
_UNIT = 1e-3  # tolerance of a normal's length: float32 and then some
_AGAIN = "restore it from a copy, or delete it and run the same command again"
Finding = tuple[str, str]
"""Place in the file and message."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: where in which file or folder (empty: all of it), expected and found, what to do."""

    path: Path
    where: str
    message: str
    hint: str = ""

    def __str__(self) -> str:
        return ": ".join(str(part) for part in (self.path, self.where, self.message) if str(part))


def guarded(path: Path, problems: Callable[[], Iterator[Problem]]) -> list[Problem]:
    """Collect problems; whatever goes wrong while looking for them is one more."""
    found: list[Problem] = []
    try:
        found.extend(problems())
    except TofError as err:
        found.append(Problem(path, "", err.message.removeprefix(f"{path}: "), err.hint))
    except Exception as err:
        # Damaged HDF5 raises anything; whatever it is, it is a problem of this file.
        if passing := unreadable(path, err):
            return [*found, Problem(path, "", passing.message.removeprefix(f"{path}: "), passing.hint)]
        found.append(Problem(path, "", f"cannot be checked: {type(err).__name__}: {err}", _AGAIN))
    return found


def check_file(path: Path, sha256: str | None = None) -> list[Problem]:
    """List every problem of one view file or shard; ``sha256`` is what the manifest or the journal promises."""
    return guarded(path, lambda: _check_file(path, sha256))


def _check_file(path: Path, sha256: str | None) -> Iterator[Problem]:
    if not is_there(path) or not path.is_file():
        yield Problem(path, "", "expected a file, found none", _AGAIN)
        return
    found, stored, beside = sha256_of(path), stored_digest(path), digest_path(path)
    if stored is None and not _signed(path):
        yield Problem(path, "", "expected HDF5: not that, truncated, or damaged", _AGAIN)
        return
    if stored is None:
        hint = "copy NAME.sha256 along with the file"
        yield Problem(path, "", f"expected its digest in {beside.name}", hint)
    elif beside.read_bytes() != digest_text(path, stored).encode():
        hint = "restore it from a copy, or write it anew with sha256sum once the file itself is known to be right"
        yield Problem(beside, "", "expected one line as sha256sum writes it, for this file", hint)
    promises = {beside.name: stored, "the manifest or journal": sha256}
    differing = [source for source, promised in promises.items() if promised not in (None, found)]
    for source in differing:
        message = f"sha256 differs from {source}: truncated or changed after it was sealed"
        yield Problem(path, "", message, _AGAIN)
    if differing:
        return
    try:
        file = open_h5(path)
    except UnreadableError:
        raise
    except Exception as err:
        yield Problem(path, "", f"not HDF5, or damaged: {err}", _AGAIN)
        return
    with file:
        yield from _check_open(file, path)


def _signed(path: Path) -> bool:
    """Whether a file begins as HDF5 does; HDF5 itself would want a lock to say it."""
    with path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def _check_open(file: h5py.File, path: Path) -> Iterator[Problem]:
    layout = LAYOUTS.get(text_attr(file, "format", path) if "format" in file.attrs else "")
    if layout is None:
        yield Problem(path, "format", f"expected {' or '.join(LAYOUTS)}, got {file.attrs.get('format')!r}")
        return
    if file.attrs.get("version") != layout.version:
        message = f"expected {layout.version}, got {file.attrs.get('version')!r}"
        yield Problem(path, "version", message, "upgrade tofcapture")
        return
    parsed, problems = _descriptions(file, path, layout)
    yield from problems
    if problems:
        return
    info: TofInfo = parsed["tof_info"]
    sizes = _sizes(file, info, parsed["stereo_info"])
    problems = [p for field in layout for p in _check_field(file, field, layout, sizes, path)]
    yield from problems
    if not problems:
        rules = _view_rules if layout is VIEW else _shard_rules
        yield from (Problem(path, where, message, _AGAIN) for where, message in rules(file, info))
        yield from _check_names(file, layout, path)


def _descriptions(file: h5py.File, path: Path, layout: Layout) -> tuple[dict[str, Any], list[Problem]]:
    """Parse every attribute of the root; the cameras' descriptions size everything else."""
    readers: dict[str, Callable[[], Any]] = {
        "rig": lambda: loads_rig(text_attr(file, "rig", path), "rig"),
        "tof_info": lambda: tof_from(json_attr(file, "tof_info", path), "tof_info"),
        "stereo_info": lambda: stereo_from(json_attr(file, "stereo_info", path), "stereo_info"),
        "provenance": lambda: json_attr(file, "provenance", path),
    }
    parsed: dict[str, Any] = {}
    problems = []
    for name, kind, _ in layout.attrs:
        try:
            parsed[name] = readers[name]() if name in readers else file.attrs[name]
            if kind == "text" and not isinstance(parsed[name], str):
                problems.append(Problem(path, name, f"expected text, got {parsed[name]!r}"))
        except Exception as err:
            if passing := unreadable(path, err):
                raise passing from err
            problems.append(Problem(path, name, f"expected the attribute, cannot read it: {err}"))
    if parsed.get("units", "m") != "m":
        problems.append(Problem(path, "units", f"expected 'm', got {parsed['units']!r}"))
    return parsed, problems


def _sizes(file: h5py.File, info: TofInfo, stereo: StereoInfo) -> dict[str, int]:
    """Tell what the dims' letters mean here: from the descriptions; views and frames from the raw array itself."""
    raw = file.get("tof/raw")
    shape: tuple[int, ...] = raw.shape if isinstance(raw, h5py.Dataset) else ()
    (H, W), (SH, SW) = info.camera.shape, stereo.camera.shape
    N, F = shape[:2] if len(shape) == 5 else (1, *shape[:1], 0)[:2]
    arm = file.get("arm/before/joints")
    J = max(arm.size, 6) if isinstance(arm, h5py.Dataset) else 6
    return {"N": N, "F": F, "K": len(info.modulation_hz), "H": H, "W": W, "SH": SH, "SW": SW, "J": J}


def _expected(file: h5py.File, field: Field, layout: Layout) -> bool:
    """Whether a dataset has to be there; the optional ones of a group are there together or not at all."""
    if not field.optional:
        return True
    if field.path.startswith("fused/"):  # at the scales of the ground truth
        return "fused" in file and f"gt/depth_{field.path[-2:]}" in file
    group = field.path.split("/", maxsplit=1)[0]
    mates = [f for f in layout if f.path.startswith(f"{group}/")]
    if all(f.optional for f in mates):
        return group in file
    return any(f.optional and f.path in file for f in mates)


def _check_field(
    file: h5py.File, field: Field, layout: Layout, sizes: Mapping[str, int], path: Path
) -> Iterator[Problem]:
    dataset, where = file.get(field.path), f"/{field.path}"
    if not isinstance(dataset, h5py.Dataset):
        if _expected(file, field, layout):
            yield Problem(path, where, "expected a dataset, found none", _AGAIN)
        return
    if dataset.attrs.get("units") != field.units:
        yield Problem(path, where, f"expected units {field.units!r}, got {dataset.attrs.get('units')!r}")
    if dataset.dtype.name not in field.dtypes or dataset.shape != field.shape(sizes):
        right = f"{' or '.join(field.dtypes)} {field.shape(sizes)}"
        yield Problem(path, where, f"expected {right}, got {dataset.dtype.name} {dataset.shape}")
        return
    try:
        for row in range(dataset.shape[0]) if field.dims[:1] == ("N",) else [()]:
            dataset[row]
    except Exception as err:
        if passing := unreadable(path, err):
            raise passing from err
        yield Problem(path, where, f"damaged: {err}", _AGAIN)


def _check_names(file: h5py.File, layout: Layout, path: Path) -> Iterator[Problem]:
    """A file lies where its attributes say, so that a mixed-up copy is noticed."""
    scene = file.attrs["scene"]
    if layout is SHARD and path.stem != scene:
        yield Problem(path, "scene", f"expected {path.stem!r} from the file's name, got {scene!r}")
    if layout is VIEW and path.parent.parent.name == "views":
        expected, got = (path.parent.name, path.name), (scene, f"view-{int(file.attrs['index']):03d}.h5")
        if expected != got:
            yield Problem(path, "scene", f"expected {'/'.join(expected)} from its place, got {'/'.join(got)}")


def _view_rules(file: h5py.File, info: TofInfo) -> Iterator[Finding]:
    yield from _increasing(file)
    yield from _an_image(file, info)
    yield from _point_map("/stereo/points", file["stereo/points"][()])
    yield from _rigid(file, "arm/before/T_base_flange", "arm/after/T_base_flange")
    if "truth" in file:
        depth, normals = file["truth/depth"][()], file["truth/normals"][()]
        yield from _depth("/truth/depth", depth, np.inf)
        yield from _unit_normals("/truth/normals", normals, np.isfinite(depth))
        yield from _rigid(file, "truth/T_tof_stereo", "truth/T_flange_tof")


def _shard_rules(file: h5py.File, info: TofInfo) -> Iterator[Finding]:
    celsius, index, pose = (file[name][()] for name in ("tof/celsius", "views/index", "views/T_base_tof"))
    if ((celsius < CELSIUS[0]) | (celsius > CELSIUS[1])).any():
        yield "/tof/celsius", f"expected {CELSIUS[0]:g} to {CELSIUS[1]:g} degC or NaN, some are not"
    if (np.abs(pose[..., :3, 3]) > REACH).any():
        yield "/views/T_base_tof", f"expected a camera within {REACH:g} m of the base, it is farther away"
    if len(np.unique(index)) != len(index) or (index < 0).any():
        yield "/views/index", f"expected distinct numbers from 0 up, got {index.tolist()}"
    yield from _rigid(file, "views/T_base_tof")
    yield from _increasing(file)
    yield from _an_image(file, info)
    for view in range(len(index)):
        for name in ("tof/depth", "gt/native_depth"):
            yield from _depth(f"/{name}[{view}]", file[name][view], FARTHEST)
        confidence = file["tof/confidence"][view]
        bad = (confidence < 0) | np.isinf(confidence)
        if bad.any():
            where = f"/tof/confidence[{view}]"
            yield where, f"expected amplitudes from zero up, {_count(bad)} are not"
        yield from _known_bits(f"/tof/flags[{view}]", file["tof/flags"][view], TofFlag, "flags")
        for scale in (1, 2, 4) if "gt/depth_4x" in file else (1, 2):
            yield from _projected(file, view, scale, info.camera.scaled(scale).rays)


def _projected(file: h5py.File, view: int, scale: int, rays: Array) -> Iterator[Finding]:
    """Ground truth is finite exactly where ``NOT_HIT`` is unset; its normals face the camera: ``n . r < 0``."""
    depth, normals, mask = (file[f"gt/{name}_{scale}x"][view] for name in ("depth", "normals", "mask"))
    yield from _depth(f"/gt/depth_{scale}x[{view}]", depth, FARTHEST)
    where = f"/gt/mask_{scale}x[{view}]"
    bad = np.isfinite(depth) == ((mask & MaskBit.NOT_HIT) > 0)
    if bad.any():
        yield where, f"expected depth exactly where NOT_HIT is unset, {_count(bad)} disagree"
    yield from _known_bits(where, mask, MaskBit, "bits")
    if "fused" in file:
        yield from _depth(f"/fused/sigma_{scale}x[{view}]", file[f"fused/sigma_{scale}x"][view], FARTHEST)
    where = f"/gt/normals_{scale}x[{view}]"
    yield from _unit_normals(where, normals, np.isfinite(depth))
    away = np.einsum("hwc,hwc->hw", normals.astype(np.float64), rays) > 1e-6  # NaN compares false
    if away.any():
        yield where, f"expected normals that face the camera, {_count(away)} do not"


def _count(bad: NDArray[np.bool_]) -> str:
    return f"{int(bad.sum())} of {bad.size} pixels"


def _rigid(file: h5py.File, *names: str) -> Iterator[Finding]:
    for name in names:
        try:
            for T in file[name][()].reshape(-1, 4, 4):
                check_transform(T, "transform")
        except ConfigError as err:
            yield f"/{name}", err.message


def _increasing(file: h5py.File) -> Iterator[Finding]:
    if (np.diff(file["tof/time_ns"][()], axis=-1) <= 0).any():
        yield "/tof/time_ns", "expected times that increase within a burst, they do not"


def _an_image(file: h5py.File, info: TofInfo) -> Iterator[Finding]:
    """Not every tap of a frame is saturated or zero: that is a covered or blinded sensor."""
    raw = file["tof/raw"]
    for index in np.ndindex(raw.shape[:-3]):
        frame = raw[index]
        if (frame == 0).all() or info.saturated(frame).all():
            yield f"/tof/raw{list(index)}", "expected an image, every tap is zero or saturated"
            return


def _depth(where: str, depth: Array, farthest: float) -> Iterator[Finding]:
    """Depth is a positive length or NaN; zero never means missing."""
    bad = ~(np.isnan(depth) | (np.isfinite(depth) & (depth > 0)))
    if bad.any():
        yield where, f"expected positive depth or NaN, {_count(bad)} are neither"
    far = depth > farthest  # NaN compares false
    if far.any():
        yield where, f"expected depth of at most {farthest:g} m, {_count(far)} are farther"


def _unit_normals(where: str, normals: Array, there: NDArray[np.bool_]) -> Iterator[Finding]:
    bad = there != (np.abs(np.linalg.norm(normals.astype(np.float64), axis=-1) - 1) < _UNIT)
    if bad.any():
        yield where, f"expected unit normals exactly where there is depth, {_count(bad)} disagree"


def _known_bits(where: str, bits: Array, known: type[MaskBit | TofFlag], what: str) -> Iterator[Finding]:
    if (bits & ~np.uint8(sum(known))).any():
        yield where, f"expected the {what} {[b.name for b in known]} only, others are set"


def _point_map(where: str, points: Array) -> Iterator[Finding]:
    """A point is measured in all three coordinates or in none, before the camera."""
    finite = np.isfinite(points)
    bad = finite.any(axis=-1) != finite.all(axis=-1)
    if bad.any():
        yield where, f"expected points that are finite or NaN as a whole, {_count(bad)} are half"
    behind = points[..., 2] <= 0  # NaN compares false
    if behind.any():
        yield where, f"expected points before the camera, {_count(behind)} are not"
