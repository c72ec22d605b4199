"""Say everything that the report's template prints."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.camera import Camera
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import Manifest
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64, invert, rotation_log
from tofcapture.rig import RangeError, Rig
from tofcapture.viz.charts import chart, draw_rig, lines
from tofcapture_model.config import dumps_config
from tofcapture_model.report.examples import choose, load_examples, panels
from tofcapture_model.report.scores import POOLS, headline, sample, tables, tiles
from tofcapture_model.report.sources import Network, Sources, doubts

_SAME_DEG, _SAME_MM = 1e-6, 1e-6
_SIDES = ((0, "seen from above"), (1, "seen from the side"))


def content(sources: Sources, views: int) -> dict[str, Any]:
    """Make the parts of a page with so many example views; same sources, same text."""
    results, network = sources.results, sources.network
    shard = _shard(sources)
    return {
        "absent": sources.absent,
        "headline": headline(results) if results else "",
        "sample": sample(results) if results else "",
        "tiles": tiles(results) if results else [],
        "results": results,
        "pools": list(POOLS.values()),
        "tables": tables(results) if results else [],
        "evidence": sources.evidence,
        "shard": shard,
        "rig": None if shard is None else _rig(shard, sources.evidence),
        "panels": _panels(sources, views),
        "split": sources.split,
        "dataset": None if sources.manifest is None else _dataset(sources.manifest, sources.manifest_sha256),
        "network": None if network is None else _network(network),
        "doubts": doubts(sources),
        "versions": _versions(sources),
    }


def _shard(sources: Sources) -> dict[str, Any] | None:
    """Describe the first scene of the split, or of the dataset where the split is empty."""
    if sources.dataset is None or sources.manifest is None or not sources.manifest.scenes:
        return None
    scenes = sources.manifest.split(sources.split) or dict(sorted(sources.manifest.scenes.items()))
    scene, entry = next(iter(scenes.items()))
    with ShardReader(Path(sources.dataset) / entry.path, entry.sha256) as shard:
        return {
            "scene": scene,
            "rig": shard.rig,
            "tof": shard.info,
            "stereo": shard.stereo_info,
            "gt": shard.provenance.get("gt"),
            "simulated": shard.truth(0) is not None,
            "frames": shard.frames,
        }


def _panels(sources: Sources, views: int) -> list[Any]:
    if sources.dataset is None or sources.manifest is None:
        return []
    chosen = choose(sources.manifest, sources.split, views)
    model = sources.network.model if sources.network else None
    return panels(load_examples(sources.dataset, sources.manifest, chosen, model))


def _rig(shard: Mapping[str, Any], evidence: Mapping[str, Any] | None) -> dict[str, Any]:
    rig: Rig = shard["rig"]
    return {
        "transforms": [
            ("T_tof_stereo", "stereo frame to ToF frame", origin_of(rig, evidence), *_told(rig.T_tof_stereo)),
            (
                "T_flange_tof",
                "ToF frame to flange frame",
                "as the station's rig says",
                *_told(rig.T_flange_tof),
            ),
        ],
        "cameras": [
            [name, *_intrinsics(camera)] for name, camera in (("ToF", rig.tof), ("stereo", rig.stereo))
        ],
        "illuminator": ", ".join(f"{1e3 * x:.1f}" for x in rig.illuminator),
        "ranges": [_range_error(error) for error in shard["tof"].range_errors],
        "drawings": [(_drawing(rig, across, words), words) for across, words in _SIDES],
    }


def _drawing(rig: Rig, across: int, words: str) -> str:
    def draw(axes: Any) -> None:
        draw_rig(axes, rig, across, 2)

    return chart(draw, f"flange and cameras {words}", size=(5.6, 3.6))


def _told(T: Float64) -> tuple[str, str]:
    """Translation and rotation in words, and the matrix as text."""
    turn = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(turn))
    axis = ", ".join(f"{x:.3f}" for x in (turn / angle if angle > 0 else np.zeros(3)))
    shift = ", ".join(f"{1e3 * x:.2f}" for x in T[:3, 3])
    matrix = "\n".join(" ".join(f"{x:10.6f}" for x in row) for row in T)
    return f"({shift}) mm; {np.degrees(angle):.3f} deg about ({axis})", matrix


def origin_of(rig: Rig, evidence: Mapping[str, Any] | None) -> str:
    """Say whether the dataset was built with what the evidence describes."""
    if evidence is None:
        return "no evidence was given"
    change = rig.T_tof_stereo @ invert(np.asarray(evidence["T_tof_stereo"], dtype=np.float64))
    angle = float(np.degrees(np.linalg.norm(rotation_log(change[:3, :3]))))
    shift = 1e3 * float(np.linalg.norm(change[:3, 3]))
    if angle < _SAME_DEG and shift < _SAME_MM:
        return "calibrated over board views, see the alignment evidence"
    return f"not the one that the evidence describes: {angle:.3f} deg and {shift:.2f} mm apart"


def _intrinsics(c: Camera) -> list[str]:
    view = [np.degrees(2 * np.arctan(n / (2 * f))) for n, f in ((c.width, c.fx), (c.height, c.fy))]
    numbers = [f"{v:.2f}" for v in (c.fx, c.fy, c.cx, c.cy)]
    return [f"{c.width} x {c.height}", *numbers, " x ".join(f"{a:.1f}" for a in view)]


def _range_error(e: RangeError) -> list[str]:
    """MHz, offset, scale, wiggling, per pixel, per kelvin."""
    return [
        f"{1e-6 * e.modulation_hz:g}",
        f"{1e3 * e.offset:.2f}",
        f"{1e3 * e.scale:.2f}",
        ", ".join(f"{1e3 * np.hypot(a, b):.2f} ({m}x)" for m, a, b in e.harmonics) or "–",
        f"{1e3 * e.per_pixel_radius:.4f}",
        f"{1e3 * e.per_kelvin:.3f}",
    ]


def _dataset(manifest: Manifest, sha256: str) -> dict[str, Any]:
    parts = [(name, manifest.split(name)) for name in SPLITS]
    return {
        "splits": [[n, len(p), sum(e.views for e in p.values()), ", ".join(p) or "–"] for n, p in parts],
        "shards": [(name, e.split, e.views, e.sha256) for name, e in sorted(manifest.scenes.items())],
        "sha256": sha256,
        "config": json.dumps(dict(manifest.config), indent=1, sort_keys=True),
    }


def _network(network: Network) -> dict[str, Any]:
    curve, words = loss_curve(network.rows)
    return {
        "kind": network.config.network.kind,
        "parameters": f"{sum(p.numel() for p in network.model.parameters()):,}",
        "seed": network.config.training.seed,
        "steps": network.provenance.get("steps"),
        "name": network.name,
        "sha256": network.sha256,
        "curve": lines(curve, "step", "loss", f"training loss, {words}", log="y") if curve else "",
        "words": words,
        "validations": _validations(network.rows)[-8:],
        "config": dumps_config(network.config),
    }


def loss_curve(rows: Sequence[Mapping[str, Any]]) -> tuple[dict[str, tuple[list[int], list[float]]], str]:
    """Steps and losses by stage, and in words where they went; nothing with fewer than two points."""
    points = [
        (str(r.get("stage", "")), int(r["step"]), float(r["total"]))
        for r in rows
        if _positive(r.get("total"))
    ]
    if len(points) < 2:
        return {}, ""
    curve: dict[str, tuple[list[int], list[float]]] = {}
    for stage, step, loss in points:
        steps, losses = curve.setdefault(f"stage {stage}", ([], []))
        steps.append(step)
        losses.append(loss)
    (_, first, start), (_, last, end) = points[0], points[-1]
    return curve, f"from {start:.3g} at step {first} to {end:.3g} at step {last}"


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value) and value > 0


def _validations(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Step, stage, MAE in mm and mean angle in degrees of every validation, as text."""
    return [
        [str(r["step"]), str(r.get("stage", "")), f"{1e3 * r['val_mae']:.2f}", f"{r['val_angle_deg']:.2f}"]
        for r in rows
        if _positive(r.get("val_mae")) and _positive(r.get("val_angle_deg"))
    ]


def _versions(sources: Sources) -> list[list[str]]:
    """Library and version: of this page, of the dataset, of the alignment."""
    import torch

    rows = [["this page: tofcapture", __version__], ["this page: torch", str(torch.__version__)]]
    if sources.manifest:
        rows += [[f"dataset: {k}", str(v)] for k, v in sorted(sources.manifest.versions.items())]
    if sources.evidence:
        made = sources.evidence.get("provenance", {}).get("versions", {})
        rows += [[f"alignment: {k}", str(v)] for k, v in sorted(made.items())]
    return rows
