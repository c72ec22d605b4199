"""Read arrays of NumPy (.npy, .npz), MATLAB (.mat) and HDF5 (.h5)."""

from __future__ import annotations

import re
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.importing.said import Facts, Said
from tofcapture.importing.source import Piece

SUFFIXES = (".npy", ".npz", ".mat", ".h5", ".hdf5", ".hdf")
_KINDS = {
    ".npy": "NumPy",
    ".npz": "NumPy",
    ".mat": "MATLAB",
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), "HDF5"),
}
CHANNELS = ("modulation_hz", "phase_rad", "offset", "saturation")  # what may lie beside an array


def claims(path: Path) -> bool:
    """Tell by the suffix."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List the arrays of two axes and more; channels that lie beside them are facts."""
    del said
    held = arrays_of(path)
    facts = facts_of(held, path)
    for name, array in held.items():
        if name not in CHANNELS and array.ndim >= 2 and max(array.shape) > 4:
            own = facts.over(Facts(unit=_unit(path, name)))
            yield Piece(name if len(held) > 1 else "", path, partial(load_array, path, name), facts=own)


def _unit(path: Path, name: str) -> str:
    """Read the unit of length that an HDF5 dataset's attribute says; empty for any other."""
    if _KINDS[path.suffix.lower()] != "HDF5":
        return ""
    import h5py

    with h5py.File(path, "r") as file:
        told = next((file[name].attrs[k] for k in ("units", "unit") if k in file[name].attrs), "")
    word = told.decode() if isinstance(told, bytes) else str(told)
    return next(
        (
            u
            for u, begin in (("mm", "mm|milli"), ("cm", "cm|centi"), ("m", "m$|met"))
            if re.match(begin, word.lower())
        ),
        "",
    )


def facts_of(held: Mapping[str, NDArray[Any]], path: Path) -> Facts:
    """Read the channels that lie beside an array."""
    said = {k: np.asarray(held[k]).reshape(-1) for k in CHANNELS if k in held}
    try:
        return Facts(
            modulation_hz=tuple(map(float, said.get("modulation_hz", ()))),
            phase_rad=tuple(map(float, said.get("phase_rad", ()))),
            saturation=float(said["saturation"][0]) if "saturation" in said else None,
            offset=bool(said["offset"][0]) if "offset" in said else None,
        )
    except (TypeError, ValueError, IndexError) as err:
        hint = "np.savez(path, raw=raw, modulation_hz=hz, phase_rad=phases), one number a channel"
        raise DataError(
            f"{path}: the channels that lie beside the array are no numbers: {err}", hint
        ) from err


def load_array(path: Path, name: str) -> NDArray[Any]:
    """Read one array of a file by its name."""
    array = arrays_of(path)[name]
    if array.dtype.kind not in "iufb":
        hint = "I and Q as two channels: np.stack([z.real, z.imag], 1), phase_deg = [0, 270], offset = false"
        raise DataError(
            f"{path}: {name or 'array'}: expected numbers, got {array.dtype}",
            hint=hint if array.dtype.kind == "c" else "save each field as an array of its own: np.savez",
        )
    return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("="), copy=False))


def arrays_of(path: Path) -> dict[str, NDArray[Any]]:
    """Read every array of a file by name; a ``.npy`` has one without a name.

    Arrays of MATLAB have the axes that MATLAB shows, in both of its formats. Raises :class:`FormatError` for a file that is
    damaged or of another kind.
    """
    suffix = path.suffix.lower()
    try:
        if suffix in {".npy", ".npz"}:
            return _numpy(path)
        with path.open("rb") as file:
            head = file.read(16)
        if suffix == ".mat" and not head.startswith((b"\x89HDF", b"MATLAB 7.3")):
            return _matlab(path)
        return _hdf5(path)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, KeyError) as err:
        raise FormatError(
            f"{path}: cannot read the array of a {_KINDS[suffix]} file: {err}",
            hint="copy the file again, or write it with np.save"
            if suffix.startswith(".n")
            else "copy it again",
        ) from err


def _numpy(path: Path) -> dict[str, NDArray[Any]]:
    found = np.load(path, allow_pickle=False, mmap_mode="r" if path.suffix.lower() == ".npy" else None)
    if isinstance(found, np.ndarray):
        return {"": found}
    with found:
        return {name: np.asarray(found[name]) for name in found.files}


def _matlab(path: Path) -> dict[str, NDArray[Any]]:
    try:
        from scipy.io import loadmat
        from scipy.io.matlab import MatReadError
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading MATLAB files needs scipy: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = loadmat(path)
    except (MatReadError, NotImplementedError, TypeError, IndexError) as err:
        raise ValueError(f"{err}: save it with -v7 or -v7.3") from err
    return dict(_unpacked("", {k: v for k, v in found.items() if not k.startswith("__")}))


def _unpacked(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """List the arrays in MATLAB's structs and cells: ``s/raw``, ``raw/0``."""
    if isinstance(value, Mapping):
        for key, below in value.items():
            yield from _unpacked(f"{name}/{key}" if name else key, below)
    elif not isinstance(value, np.ndarray):
        return
    elif value.dtype.names or value.dtype.kind == "O":
        for i, one in enumerate(value.ravel()):
            place = f"{name}/{i}" if value.size > 1 else name
            named = {n: one[n] for n in value.dtype.names} if value.dtype.names else one
            yield from _unpacked(place, named)
    elif value.dtype.kind in "iufbc":
        yield name, value


def _hdf5(path: Path) -> dict[str, NDArray[Any]]:
    """Read all datasets, and those of MATLAB's cells; MATLAB writes the axes of its arrays in reverse."""
    import h5py

    held: dict[str, NDArray[Any]] = {}
    turned = False

    def keep(name: str, item: Any) -> None:
        nonlocal turned
        turned |= "MATLAB_class" in item.attrs
        if not isinstance(item, h5py.Dataset) or name.startswith("#refs#"):
            return
        if item.dtype.kind in "iufbc":
            held[name] = np.asarray(item[()])
        elif h5py.check_ref_dtype(item.dtype) is h5py.Reference:  # a cell
            for i, ref in enumerate(np.ravel(item[()], order="F")):
                keep(f"{name}/{i}", file[ref])

    with path.open("rb") as raw:
        turned = raw.read(10) == b"MATLAB 7.3"
    with h5py.File(path, "r") as file:
        kind = file.attrs.get("format")
        if isinstance(kind, str) and kind.startswith("tofcapture-"):
            raise FormatError(
                f"{path}: is a {kind.removeprefix('tofcapture-')} of tofcapture already",
                hint="tofcapture check names what it holds; build-dataset and predict take it as it is",
            )
        file.visititems(keep)
    return {k: v.T for k, v in held.items()} if turned else held
