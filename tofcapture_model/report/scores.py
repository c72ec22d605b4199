"""Lay ``results.json`` out as tables, a headline and tiles: lengths in millimetres, the better value marked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from tofcapture_model.evaluation.tables import RANKS, Column, column_cells, value_of
from tofcapture_model.report.examples import METHOD_TITLES

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
