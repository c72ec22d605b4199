"""List every problem of one view file or shard.

A sealed file is first compared with its stored digest: a flipped byte anywhere is found there, and HDF5 is not asked to parse
a damaged file. Then come the layout (missing, dtype, shape, units), the descriptions, the chunks' checksums and the rules that
the arrays obey.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tofcapture.errors import TofError
from tofcapture.files import content
from tofcapture.files.hdf import fetch, json_attr, text_attr
from tofcapture.files.info import stereo_from, tof_from
from tofcapture.files.layout import LAYOUTS, SHARD, VIEW, Field, Layout
from tofcapture.files.seal import digest_path, digest_text, sha256_of, stored_digest
from tofcapture.frames import TofInfo
from tofcapture.rig import loads_rig

_DIGEST_AGAIN = (
    "restore it from a copy, or write it anew with sha256sum once the file itself is known to be right"
)
_AGAIN = "restore it from a copy, or delete it and run the same command again"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong.

    Attributes
    ----------
    path
        File or folder.
    where
        Dataset, attribute or entry; empty for the whole.
    message
        Expected and found.
    hint
        What to do; may be empty.
    """

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
        found.append(Problem(path, "", f"cannot be checked: {type(err).__name__}: {err}", _AGAIN))
    return found


def check_file(path: Path, sha256: str | None = None) -> list[Problem]:
    """List every problem of one view file or shard.

    Parameters
    ----------
    path
        The file.
    sha256
        Digest that the manifest or the journal promises.
    """
    return guarded(path, lambda: _check_file(path, sha256))


def _check_file(path: Path, sha256: str | None) -> Iterator[Problem]:
    if not path.is_file():
        yield Problem(path, "", "expected a file, found none", _AGAIN)
        return
    found, stored = sha256_of(path), stored_digest(path)
    if stored is None and not h5py.is_hdf5(path):
        yield Problem(path, "", "expected HDF5: not that, truncated, or damaged", _AGAIN)
        return
    if stored is None:
        yield Problem(
            path,
            "",
            f"expected its digest in {digest_path(path).name}",
            "copy NAME.sha256 along with the file",
        )
    elif digest_path(path).read_bytes() != digest_text(path, stored).encode():
        yield Problem(
            digest_path(path), "", "expected one line as sha256sum writes it, for this file", _DIGEST_AGAIN
        )
    damaged = False
    for source, promised in ((digest_path(path).name, stored), ("the manifest or journal", sha256)):
        if promised not in (None, found):
            damaged = True
            yield Problem(
                path, "", f"sha256 differs from {source}: truncated or changed after it was sealed", _AGAIN
            )
    if damaged:
        return
    try:
        file = h5py.File(path, "r")
    except Exception as err:
        yield Problem(path, "", f"not HDF5, or damaged: {err}", _AGAIN)
        return
    with file:
        yield from _check_open(file, path)


def _check_open(file: h5py.File, path: Path) -> Iterator[Problem]:
    layout = LAYOUTS.get(text_attr(file, "format", path) if "format" in file.attrs else "")
    if layout is None:
        yield Problem(path, "format", f"expected {' or '.join(LAYOUTS)}, got {file.attrs.get('format')!r}")
        return
    if file.attrs.get("version") != layout.version:
        yield Problem(
            path,
            "version",
            f"expected {layout.version}, got {file.attrs.get('version')!r}",
            f"tofcapture migrate {path}" if file.attrs.get("version") == 1 else "upgrade tofcapture",
        )
        return
    info, problems = _descriptions(file, path, layout)
    yield from problems
    if problems or info is None:
        return
    whole = True
    for field in layout:
        expected = _expected(file, field, layout)
        for problem in _check_field(file, field, _sizes(file, info, path), path, expected=expected):
            whole = False
            yield problem
    if whole:
        rules = _view_rules if layout is VIEW else _shard_rules
        yield from (Problem(path, where, message, _AGAIN) for where, message in rules(file, info))
        yield from _check_names(file, layout, path)


def _descriptions(file: h5py.File, path: Path, layout: Layout) -> tuple[TofInfo | None, list[Problem]]:
    """Parse every attribute of the root; the ToF camera's description sizes everything else."""
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
            read = readers.get(name, lambda n=name: file.attrs[n])
            parsed[name] = read()
            if kind == "text" and not isinstance(parsed[name], str):
                problems.append(Problem(path, name, f"expected text, got {parsed[name]!r}"))
        except Exception as err:
            problems.append(Problem(path, name, f"expected the attribute, cannot read it: {err}"))
    if parsed.get("units", "m") != "m":
        problems.append(Problem(path, "units", f"expected 'm', got {parsed['units']!r}"))
    return parsed.get("tof_info"), problems


def _sizes(file: h5py.File, info: TofInfo, path: Path) -> dict[str, int]:
    """What the dims' letters mean here: from the descriptions; views and frames from the raw array itself."""
    stereo = stereo_from(json_attr(file, "stereo_info", path), str(path))
    raw = file.get("tof/raw")
    shape: tuple[int, ...] = raw.shape if isinstance(raw, h5py.Dataset) else ()
    H, W = info.camera.shape
    SH, SW = stereo.camera.shape
    N, F = shape[:2] if len(shape) == 5 else (1, *shape[:1], 0)[:2]
    return {"N": N, "F": F, "K": len(info.modulation_hz), "H": H, "W": W, "SH": SH, "SW": SW}


def _expected(file: h5py.File, field: Field, layout: Layout) -> bool:
    """Whether a dataset has to be there; the optional ones of a group are there together or not at all."""
    group = field.path.split("/", maxsplit=1)[0]
    mates = [f for f in layout if f.path.startswith(f"{group}/")]
    if all(f.optional for f in mates):
        return group in file
    return not field.optional or any(f.optional and f.path in file for f in mates)


def _check_field(
    file: h5py.File, field: Field, sizes: dict[str, int], path: Path, *, expected: bool
) -> Iterator[Problem]:
    dataset, where = file.get(field.path), f"/{field.path}"
    if not isinstance(dataset, h5py.Dataset):
        if expected:
            yield Problem(path, where, "expected a dataset, found none", _AGAIN)
        return
    if dataset.attrs.get("units") != field.units:
        yield Problem(path, where, f"expected units {field.units!r}, got {dataset.attrs.get('units')!r}")
    if dataset.dtype.name not in field.dtypes or dataset.shape != field.shape(sizes):
        right = f"{' or '.join(field.dtypes)} {field.shape(sizes)}"
        yield Problem(path, where, f"expected {right}, got {dataset.dtype.name} {dataset.shape}")
        return
    try:
        if field.chunk:
            for row in range(dataset.shape[0]):
                dataset[row]
        else:
            fetch(file, field, path)
    except Exception as err:
        yield Problem(path, where, f"damaged: {err}", _AGAIN)


def _view_rules(file: h5py.File, info: TofInfo) -> Iterator[content.Finding]:
    yield from content.increasing(file, "tof/time_ns")
    yield from content.saturated_or_not(file, "tof/raw", info.saturation)
    yield from content.point_map("/stereo/points", file["stereo/points"][()])
    for when in ("before", "after"):
        yield from content.rigid(file, f"arm/{when}/T_base_flange")
    if "truth" in file:
        depth, normals = file["truth/depth"][()], file["truth/normals"][()]
        yield from content.positive("/truth/depth", depth)
        yield from content.normals_obey("/truth/normals", normals, np.isfinite(depth))
        yield from content.rigid(file, "truth/T_tof_stereo")
        yield from content.rigid(file, "truth/T_flange_tof")


def _shard_rules(file: h5py.File, info: TofInfo) -> Iterator[content.Finding]:
    yield from content.plausible(file)
    yield from content.distinct(file, "views/index")
    yield from content.rigid(file, "views/T_base_tof")
    yield from content.increasing(file, "tof/time_ns")
    yield from content.saturated_or_not(file, "tof/raw", info.saturation)
    scales = (1, 2, 4) if "gt/depth_4x" in file else (1, 2)
    for view in range(file["tof/raw"].shape[0]):
        for name in ("tof/depth", "gt/native_depth"):
            depth = file[name][view]
            yield from content.positive(f"/{name}[{view}]", depth)
            yield from content.near(f"/{name}[{view}]", depth)
        yield from content.amplitude(f"/tof/confidence[{view}]", file["tof/confidence"][view])
        yield from content.flagged(f"/tof/flags[{view}]", file["tof/flags"][view])
        for scale in scales:
            yield from _projected_rules(file, view, scale, info)


def _projected_rules(file: h5py.File, view: int, scale: int, info: TofInfo) -> Iterator[content.Finding]:
    depth, normals, mask = (file[f"gt/{name}_{scale}x"][view] for name in ("depth", "normals", "mask"))
    yield from content.positive(f"/gt/depth_{scale}x[{view}]", depth)
    yield from content.near(f"/gt/depth_{scale}x[{view}]", depth)
    yield from content.masked(f"/gt/mask_{scale}x[{view}]", depth, mask)
    yield from content.normals_obey(f"/gt/normals_{scale}x[{view}]", normals, np.isfinite(depth))
    yield from content.faces(f"/gt/normals_{scale}x[{view}]", normals, info.camera.scaled(scale).rays)


def _check_names(file: h5py.File, layout: Layout, path: Path) -> Iterator[Problem]:
    """A file lies where its attributes say, so that a mixed-up copy is noticed."""
    scene = file.attrs["scene"]
    if layout is SHARD and path.stem != scene:
        yield Problem(path, "scene", f"expected {path.stem!r} from the file's name, got {scene!r}")
    if layout is VIEW and path.parent.parent.name == "views":
        expected, got = (path.parent.name, path.name), (scene, f"view-{int(file.attrs['index']):03d}.h5")
        if expected != got:
            yield Problem(path, "scene", f"expected {'/'.join(expected)} from its place, got {'/'.join(got)}")
