"""Tell what a path is, and make it a source of shots."""

from __future__ import annotations

from pathlib import Path

from tofcapture.errors import DataError
from tofcapture.viz.shots import Source

_HDF5 = b"\x89HDF\r\n\x1a\n"
_HINT = "a recording, view-000.h5, a shard, a dataset, a folder of predict, rig.toml or evidence.json"


def open_source(path: Path) -> Source:
    """Open whatever tofcapture writes and a person may want to look at.

    Parameters
    ----------
    path
        Recording, view file, dataset, shard, prediction, ``rig.toml`` or ``evidence.json``.

    Returns
    -------
    Source
        Shots are read when they are asked for.

    Raises
    ------
    DataError
        Nothing is there, or nothing that can be shown.
    FormatError
        A file is not what its name or header promises.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder", hint=f"give {_HINT}")
    return _folder(path) if path.is_dir() else _file(path)


def _folder(path: Path) -> Source:
    if (path / "views").is_dir():
        from tofcapture.viz.captured import recording_source

        return recording_source(path)
    from tofcapture.viz.sharded import dataset_source, prediction_source

    if (path / "manifest.json").exists():
        return dataset_source(path)
    if (path / "depth.npy").exists():
        return prediction_source(path)
    raise DataError(f"{path}: neither a recording, nor a dataset, nor a prediction", hint=f"give {_HINT}")


def _file(path: Path) -> Source:
    from tofcapture.viz.aligned import evidence_source, rig_source

    if path.suffix == ".toml":
        return rig_source(path)
    if path.suffix == ".json":
        return evidence_source(path)
    with path.open("rb") as file:
        if file.read(len(_HDF5)) != _HDF5:
            raise DataError(f"{path}: nothing that can be shown (not HDF5)", hint=f"give {_HINT}")
    return _hdf5(path)


def _hdf5(path: Path) -> Source:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            kind = file.attrs.get("format", "")
    except OSError as err:
        raise DataError(f"{path}: cannot read the file: {err}", hint=f"tofcapture check {path}") from err
    if kind == "tofcapture-shard":
        from tofcapture.viz.sharded import shard_source

        return shard_source(path)
    from tofcapture.viz.captured import view_source

    return view_source(path)
