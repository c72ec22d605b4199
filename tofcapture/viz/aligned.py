"""Rigs and the evidence of alignments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.errors import FormatError
from tofcapture.poses import rotation_angle
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.shots import Calibration, Shot, Source


def rig_source(path: Path) -> Source:
    """What ``rig.toml`` says; the evidence beside it too where there is one."""
    rig, evidence = load_rig(path), path.parent / "evidence.json"
    said = _read(evidence) if evidence.exists() else {}
    return Source(
        f"calibration {path.parent.name}", [], _nothing, rig, Calibration(_words(rig, said), _pairs(said))
    )


def evidence_source(path: Path) -> Source:
    """What ``evidence.json`` says; the rig beside it is needed.

    Raises
    ------
    FormatError
        The file is no evidence of an alignment.
    """
    _read(path)
    return rig_source(path.parent / "rig.toml")


def _nothing(i: int) -> Shot:
    raise IndexError(i)


def _read(path: Path) -> Mapping[str, Any]:
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


def _pairs(evidence: Mapping[str, Any]) -> list[tuple[str, float, bool]]:
    rows = evidence.get("pairs", [])
    return [
        (
            Path(str(row.get("view", i))).stem.removeprefix("view-"),
            float(row["rmse_mm"]) / 1e3,
            bool(row.get("accepted")),
        )
        for i, row in enumerate(rows)
        if row.get("rmse_mm") is not None
    ]


def _words(rig: Rig, evidence: Mapping[str, Any]) -> str:
    lines = []
    for name, T in (("T_tof_stereo", rig.T_tof_stereo), ("T_flange_tof", rig.T_flange_tof)):
        x, y, z = 1e3 * T[:3, 3]
        lines.append(
            f"{name}: {x:.2f}, {y:.2f}, {z:.2f} mm, turned by {np.degrees(rotation_angle(T[:3, :3])):.3f} deg"
        )
    if evidence:
        lines.append(
            f"{evidence.get('used')} of {evidence.get('views')} pairs used, {evidence.get('backend')}"
        )
        error = evidence.get("standard_error", {})
        lines += [
            f"one sigma: {v:.3g} {k.rpartition('_')[2]} ({k.partition('_')[0]})"
            for k, v in error.items()
            if isinstance(v, float)
        ]
    return "\n".join(lines)
