"""Fields of a layout as HDF5 datasets, cameras as JSON tables with every bit, and files opened with every failure named."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import noise_table, parse_noise, parse_reach
from tofcapture.errors import DataError, FormatError, TofError
from tofcapture.files.disk import unreadable
from tofcapture.files.layout import Field, Layout
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.rig import camera_from, camera_table, range_error_from, range_error_table

Array = NDArray[Any]
DAMAGES = (OSError, RuntimeError, ValueError, KeyError)  # what h5py raises of a damaged file
_FILTERS = {
    "shuffle": True,
    "compression": "gzip",
    "compression_opts": 1,  # half a per cent more bytes than 4, written and read a third faster (docs/decisions/0012)
    "fletcher32": True,
}


def create(file: h5py.File, field: Field, shape: tuple[int, ...], dtype: np.dtype[Any]) -> h5py.Dataset:
    """Create a field's dataset, of a dtype that it allows; the same calls give the same bytes (no time stamps)."""
    if dtype.name not in field.dtypes:
        raise FormatError(f"/{field.path}: expected {' or '.join(field.dtypes)}, got {dtype.name}")
    chunks = field.chunks(shape)
    how: dict[str, Any] = {} if chunks is None else {"chunks": chunks, **_FILTERS}
    dataset = file.create_dataset(field.path, shape, dtype, track_times=False, **how)
    dataset.attrs["units"] = field.units
    dataset.attrs["description"] = field.doc
    return dataset


def write_attrs(file: h5py.File, layout: Layout, values: Mapping[str, Any]) -> None:
    """Write the root attributes of a layout; JSON kinds are serialised, format and version come from the layout."""
    known = {"format": layout.format, "version": layout.version, "units": "m", **values}
    for name, kind, _ in layout.attrs:
        file.attrs[name] = dumps(known[name]) if kind == "JSON" else known[name]


def open_h5(path: Path) -> h5py.File:
    """Open a sealed file for reading; without locks, as nobody writes it and some disks have none.

    :class:`DataError` when it is missing, truncated or not HDF5; :class:`UnreadableError` when it cannot be opened just now.
    """
    try:
        # Chunks are single frames, read whole: HDF5 2 would keep 8 MB of each field of each open file for nothing.
        return h5py.File(path, "r", rdcc_nbytes=0, locking=False)
    except FileNotFoundError as err:
        raise DataError(f"{path}: expected a file, found nothing there") from err
    except DAMAGES as err:
        raise failure(path, "cannot be opened as HDF5", err) from err


def failure(path: Path, what: str, err: BaseException) -> DataError:
    """Name a failure to read: no damage where the system says why, else perhaps."""
    return unreadable(path, err) or DataError(f"{path}: {what}: {err}", hint=f"tofcapture check {path}")


def open_checked(path: Path, layout: Layout) -> h5py.File:
    """Open a file of a layout for reading.

    Raises as :func:`open_h5` does, and :class:`FormatError` when it is of another format or version.
    """
    file = open_h5(path)
    try:
        _check_format(file, path, layout)
    except BaseException:
        file.close()
        raise
    return file


def _check_format(file: h5py.File, path: Path, layout: Layout) -> None:
    found, version = text_attr(file, "format", path), attr(file, "version", path)
    if found != layout.format:
        raise FormatError(f"{path}: expected format {layout.format}, got {found!r}")
    if version != layout.version:
        raise FormatError(
            f"{path}: expected {layout.format} version {layout.version}, got {version}",
            hint="another tofcapture wrote it: upgrade",
        )


def attr(file: h5py.File, name: str, path: Path) -> Any:
    """Read a root attribute, or say that it is missing or damaged."""
    try:
        return file.attrs[name]
    except (*DAMAGES, TypeError) as err:
        if passing := unreadable(path, err):
            raise passing from err
        raise FormatError(f"{path}: expected the attribute {name!r}, cannot read it: {err}") from err


def text_attr(file: h5py.File, name: str, path: Path) -> str:
    """Read a root attribute that must be text."""
    value = attr(file, name, path)
    if not isinstance(value, str):
        raise FormatError(f"{path}: expected the attribute {name!r} to be text, got {type(value).__name__}")
    return value


def json_attr(file: h5py.File, name: str, path: Path) -> Any:
    """Read a root attribute that holds JSON."""
    try:
        return json.loads(text_attr(file, name, path))
    except json.JSONDecodeError as err:
        raise FormatError(f"{path}: attribute {name!r} is not JSON: {err}") from err


def find(file: h5py.File, field: Field, path: Path) -> h5py.Dataset:
    """Find a field's dataset; :class:`FormatError` when it is missing or of another dtype."""
    try:
        dataset = file.get(field.path)
    except DAMAGES as err:
        raise failure(path, f"/{field.path} cannot be opened", err) from err
    if not isinstance(dataset, h5py.Dataset):
        raise FormatError(f"{path}: expected the dataset /{field.path}, found none")
    if dataset.dtype.name not in field.dtypes:
        right = " or ".join(field.dtypes)
        raise FormatError(f"{path}: /{field.path}: expected {right}, got {dataset.dtype.name}")
    return dataset


def read(dataset: h5py.Dataset, path: Path, part: Any = ()) -> Array:
    """Read a dataset, whole or a part of it; :class:`DataError` when its bytes are damaged (Fletcher-32)."""
    try:
        return np.asarray(dataset[part])
    except DAMAGES as err:
        where = f"{dataset.name}{list(part) if part else ''}"
        raise failure(path, f"{where} is damaged", err) from err


def fetch(file: h5py.File, field: Field, path: Path, part: Any = ()) -> Array:
    """Read a field, whole or a part of it, with the errors of :func:`find` and :func:`read`."""
    return read(find(file, field, path), path, part)


def dumps(value: Any) -> str:
    """Write JSON with sorted keys; numpy scalars and arrays become plain numbers, floats keep every bit."""
    return json.dumps(value, sort_keys=True, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"expected JSON types, got {type(value).__name__}")


def tof_table(info: TofInfo) -> dict[str, Any]:
    """Describe a ToF camera as JSON types."""
    return {
        "model": info.model,
        "serial": info.serial,
        "camera": camera_table(info.camera),
        "illuminator": [float(x) for x in info.illuminator],
        "modulation_hz": [float(f) for f in info.modulation_hz],
        "phase_rad": [float(p) for p in info.phase_rad],
        "exposure": float(info.exposure) if np.isfinite(info.exposure) else None,
        "saturation": float(info.saturation),
        "range_errors": [range_error_table(e) for e in info.range_errors],
        "offset": bool(info.offset),
        "reach": info.reach and [float(r) for r in info.reach],
        "noise": noise_table(info.noise),
    }


def tof_from(table: Mapping[str, Any], where: str) -> TofInfo:
    """Read what :func:`tof_table` wrote; :class:`FormatError` when something is missing or impossible."""
    try:
        return TofInfo(
            model=str(table["model"]),
            serial=str(table["serial"]),
            camera=camera_from(table["camera"], where),
            illuminator=np.asarray(table["illuminator"], dtype=np.float64),
            modulation_hz=tuple(float(f) for f in table["modulation_hz"]),
            phase_rad=tuple(float(p) for p in table["phase_rad"]),
            exposure=float("nan" if table["exposure"] is None else table["exposure"]),
            saturation=float(table["saturation"]),
            range_errors=tuple(range_error_from(e) for e in table["range_errors"]),
            offset=bool(table.get("offset", True)),
            reach=parse_reach(table.get("reach"), where),
            noise=parse_noise(table.get("noise"), where),
        )
    except TofError as err:
        raise FormatError(
            f"{where}: tof_info does not describe a ToF camera: {err.message}", err.hint
        ) from err
    except (KeyError, TypeError, ValueError) as err:
        raise FormatError(f"{where}: tof_info does not describe a ToF camera: {err!r}") from err


def stereo_table(info: StereoInfo) -> dict[str, Any]:
    """Describe a stereo camera as JSON types."""
    return {"model": info.model, "serial": info.serial, "camera": camera_table(info.camera)}


def stereo_from(table: Mapping[str, Any], where: str) -> StereoInfo:
    """Read what :func:`stereo_table` wrote; :class:`FormatError` when something is missing or impossible."""
    try:
        return StereoInfo(str(table["model"]), str(table["serial"]), camera_from(table["camera"], where))
    except (KeyError, TypeError, ValueError, TofError) as err:
        raise FormatError(f"{where}: stereo_info does not describe a stereo camera: {err!r}") from err
