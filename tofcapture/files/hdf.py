"""Fields of a layout as HDF5 datasets, and files opened with every failure named."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError, FormatError
from tofcapture.files.info import dumps
from tofcapture.files.layout import Field, Layout

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


def open_checked(path: Path, layout: Layout) -> h5py.File:
    """Open a file of a layout for reading.

    :class:`DataError` when it is missing, truncated or not HDF5; :class:`FormatError` when it is of another format or version.
    """
    try:
        # Chunks are single frames, read whole: HDF5 2 would keep 8 MB of each field of each open file for nothing.
        file = h5py.File(path, "r", rdcc_nbytes=0)
    except FileNotFoundError as err:
        raise DataError(f"{path}: expected a {layout.format} file, found nothing there") from err
    except DAMAGES as err:
        raise DataError(f"{path}: cannot be opened as HDF5: {err}", hint=f"tofcapture check {path}") from err
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
        hint = f"tofcapture check {path}"
        raise DataError(f"{path}: /{field.path} cannot be opened: {err}", hint) from err
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
        raise DataError(f"{path}: {where} is damaged: {err}", hint=f"tofcapture check {path}") from err


def fetch(file: h5py.File, field: Field, path: Path, part: Any = ()) -> Array:
    """Read a field, whole or a part of it, with the errors of :func:`find` and :func:`read`."""
    return read(find(file, field, path), path, part)
