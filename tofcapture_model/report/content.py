"""Say everything that the report's template prints: tables, a headline and tiles in millimetres, the better value marked."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from tofcapture.viz.page import chart, draw_rig, lines
from tofcapture_model.config import dumps_config
from tofcapture_model.evaluation.tables import RANKS, Column, column_cells, value_of
from tofcapture_model.report.examples import METHOD_TITLES, choose, load_examples, panels
from tofcapture_model.report.sources import Network, Sources, doubts

POOLS = {"pixel": "all pixels pooled", "image": "mean over images"}
DEPTH = (
    Column("MAE (mean absolute error), mm", ("mae",)),
    Column("median absolute error, mm", ("median",)),
    Column("RMSE (root mean square), mm", ("rmse",)),
    Column("mean signed error, mm", ("bias",)),
    Column("SQ (square over depth), mm", ("sq",), digits=3),
    Column("ABS (relative error), %", ("abs",), 100),
    *(Column(f"within {t} mm, %", (f"within_{t}mm",), 100, 1, "most") for t in (5, 10, 20, 50)),
    Column("ratio below 1.25, %", ("delta_1",), 100, 1, "most"),
    Column("measured, not filled in, %", ("coverage",), 100, 1, "none"),
)
NORMAL = (
    Column("mean angle, deg", ("mean_deg",), 1),
    Column("median angle, deg", ("median_deg",), 1),
    Column("RMS angle, deg", ("rmse_deg",), 1),
    *(Column(f"within {t} deg, %", (f"within_{t}deg",), 100, 1, "most") for t in ("5", "11.25", "20", "30")),
)
_TILES = (
    ("depth error, mean", "mm", "depth", DEPTH[0]),
    ("depth error, median", "mm", "depth", DEPTH[1]),
    ("depth within 10 mm", "%", "depth", DEPTH[7]),
    ("normals, mean error", "deg", "normal", NORMAL[0]),
)


@dataclass(frozen=True)
class Table:
    """A table: title, titles of the methods, rows of words and a cell (text, best of its pool) for each pool and method."""

    title: str
    methods: list[str]
    rows: list[tuple[str, list[tuple[str, bool]]]]


def tables(results: Mapping[str, Any]) -> list[Table]:
    """Lay out both tables of a ``results.json``; metrics that it does not hold are left out."""
    found, spread = results["methods"], results.get("spread", {})
    out = []
    for title, kind, columns in (("Depth", "depth", DEPTH), ("Normals", "normal", NORMAL)):
        rows = []
        for column in columns:
            cells = [
                cell
                for pool in POOLS
                for cell in _marked(column_cells(found, spread, _in(column, kind, pool)))
            ]
            if any(text != "–" for text, _ in cells):
                rows.append((column.words, cells))
        out.append(Table(title, [METHOD_TITLES.get(name, name) for name in found], rows))
    return out


def _in(column: Column, kind: str, pool: str = "pixel") -> Column:
    return replace(column, path=(kind, pool, *column.path))


def _marked(cells: Sequence[tuple[str, bool]]) -> list[tuple[str, bool]]:
    """Take the marks off where several are the best: equal print is no win."""
    alone = sum(best for _, best in cells) == 1
    return [(text, best and alone) for text, best in cells]


def networks(results: Mapping[str, Any]) -> list[str]:
    """Methods that headline and tiles are about: the networks, or where there are none what stands beside the sensor."""
    methods = [name for name in results["methods"] if name != "sensor"]
    learned = {"model", *(key.rpartition("#")[0] for key in results.get("runs", {}))}
    return [name for name in methods if name in learned] or methods


def headline(results: Mapping[str, Any]) -> str:
    """Say in a sentence for every network what becomes of the sensor's error."""
    told = " ".join(filter(None, (_compared(results, name) for name in networks(results))))
    return f"On {sample(results)}, {told}" if told else f"On {sample(results)}: there is nothing to compare."


def _compared(results: Mapping[str, Any], name: str) -> str:
    (d0, n0), (d1, n1) = _two(results, "sensor"), _two(results, name)
    if None in (d0, n0, d1, n1):
        return ""
    who = "the network" if name == "model" else name
    runs = [key for key in results.get("runs", {}) if key.rpartition("#")[0] == name]
    mean = f" (mean of {len(runs)} runs)" if len(runs) > 1 else ""
    return (
        f"{who}{mean} is {d1:.2f} mm off in depth on average where the ToF sensor is {d0:.2f} mm off "
        f"({_change(d0, d1)}); its normals are {n1:.1f} degrees off instead of {n0:.1f} ({_change(n0, n1)})."
    )


def _two(results: Mapping[str, Any], method: str) -> tuple[Any, Any]:
    table = results["methods"].get(method, {})
    return value_of(table, _in(DEPTH[0], "depth")), value_of(table, _in(NORMAL[0], "normal"))


def _change(before: float, after: float) -> str:
    if before <= 0:
        return "no comparison"
    percent = 100 * (after / before - 1)
    return f"{abs(percent):.0f} % {'more' if percent > 0 else 'less'}"


def sample(results: Mapping[str, Any]) -> str:
    """Say how many views of how many scenes were measured."""
    kind = "held-out scene" if results["split"] == "test" else f"{results['split']} scene"
    return f"{_count(results.get('views'), 'view')} of {_count(len(results.get('scenes', [])), kind)}"


def _count(number: object, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def tiles(results: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(what, number with unit, whose it is and the sensor's) of the main metrics over all pixels; of several networks the best."""
    names = networks(results)
    out = []
    for title, unit, kind, column in _TILES if names else ():
        found = {m: value_of(results["methods"].get(m, {}), _in(column, kind)) for m in (*names, "sensor")}
        rank = {m: math.inf if v is None else RANKS[column.best](v) for m, v in found.items()}
        best = min(names, key=lambda m: rank[m])
        ours, theirs = (
            "–" if v is None else f"{v:.{column.digits}f}" for v in (found[best], found["sensor"])
        )
        whose = "" if best == "model" else f"{best}; "
        whose = f"{best}, best of {len(names)}; " if len(names) > 1 else whose
        out.append((title, f"{ours} {unit}", f"{whose}sensor {theirs} {unit}"))
    return out


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
