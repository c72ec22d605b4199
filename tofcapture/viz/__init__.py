"""Draw whatever people look at: recordings, shards and calibrations in Rerun or on a sheet, figures, plans and pages.

:func:`open_source` makes a :class:`tofcapture.viz.shots.Source` of shots from any path; viewer and sheet know shots only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import DataError, FormatError
from tofcapture.files.hdf import open_h5
from tofcapture.poses import rotation_angle
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.shots import Calibration, Shot, Source

__all__ = ["open_source"]
_HDF5 = b"\x89HDF\r\n\x1a\n"
_HINT = "give a recording, view-000.h5, a shard, a dataset, a folder of predict, rig.toml or evidence.json"


def open_source(path: Path) -> Source:
    """Open a recording, view file, dataset, shard, prediction, ``rig.toml`` or ``evidence.json``.

    Raises :class:`DataError`: nothing is there, or nothing that can be shown; :class:`FormatError`: a file is
    not what its name or header promises.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file or folder", hint=_HINT)
    if path.is_dir():
        return _folder(path)
    if path.suffix == ".toml":
        return _calibration(path)
    if path.suffix == ".json":
        _evidence(path)
        return _calibration(path.parent / "rig.toml")
    with path.open("rb") as file:
        if file.read(len(_HDF5)) != _HDF5:
            raise DataError(f"{path}: nothing that can be shown (not HDF5)", hint=_HINT)
    return _hdf5(path)


def _folder(path: Path) -> Source:
    from tofcapture.viz.sources import dataset_source, prediction_source, recording_source

    for name, source in (
        ("views", recording_source),
        ("manifest.json", dataset_source),
        ("depth.npy", prediction_source),
    ):
        if (path / name).exists():
            return source(path)
    raise DataError(f"{path}: neither a recording, nor a dataset, nor a prediction", hint=_HINT)


def _hdf5(path: Path) -> Source:
    from tofcapture.viz.sources import shard_source, view_source

    with open_h5(path) as file:
        kind = file.attrs.get("format", "")
    return shard_source(path) if kind == "tofcapture-shard" else view_source(path)


def _calibration(path: Path) -> Source:
    """Read a rig, and the evidence beside it where there is one."""
    rig, evidence = load_rig(path), path.parent / "evidence.json"
    said = _evidence(evidence) if evidence.exists() else {}
    pairs = [
        (
            Path(str(row.get("view", i))).stem.removeprefix("view-"),
            1e-3 * row["rmse_mm"],
            bool(row.get("accepted")),
        )
        for i, row in enumerate(said.get("pairs", []))
        if row.get("rmse_mm") is not None
    ]
    return Source(
        f"calibration {path.parent.name}", [], _no_shot, rig, Calibration(_rig_words(rig, said), pairs)
    )


def _no_shot(i: int) -> Shot:
    raise IndexError(i)


def _evidence(path: Path) -> Mapping[str, Any]:
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise FormatError(
            f"{path}: cannot read the evidence: {err}", hint="run tofcapture align again"
        ) from err
    if not isinstance(table, dict) or table.get("format") != "tofcapture-evidence":
        raise FormatError(
            f"{path}: expected the format tofcapture-evidence", hint="tofcapture view RECORDING/evidence.json"
        )
    return table


def _rig_words(rig: Rig, evidence: Mapping[str, Any]) -> str:
    lines = []
    for name, T in (("T_tof_stereo", rig.T_tof_stereo), ("T_flange_tof", rig.T_flange_tof)):
        x, y, z = 1e3 * T[:3, 3]
        angle = np.degrees(rotation_angle(T[:3, :3]))
        lines.append(f"{name}: {x:.2f}, {y:.2f}, {z:.2f} mm, turned by {angle:.3f} deg")
    if evidence:
        used, views = evidence.get("used"), evidence.get("views")
        lines.append(f"{used} of {views} pairs used, {evidence.get('backend')}")
    for key, value in evidence.get("standard_error", {}).items():
        what, _, unit = key.rpartition("_")
        lines.append(f"one sigma: {value:.3g} {unit} ({what})")
    return "\n".join(lines)
