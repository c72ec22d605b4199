"""``results.json`` as tables: lengths in millimetres, the better value marked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tofcapture_model.report.panels import METHOD_TITLES

POOLS = {"pixel": "all pixels pooled", "image": "mean over images"}


@dataclass(frozen=True)
class Column:
    """A metric: its key, its words, its unit, what turns it into that unit, whether less or more is better."""

    key: str
    words: str
    unit: str
    factor: float
    better: str  # less, more, nearer (to zero), or nothing
    digits: int = 2


DEPTH = (
    Column("mae", "MAE (mean absolute error)", "mm", 1e3, "less"),
    Column("median", "median absolute error", "mm", 1e3, "less"),
    Column("rmse", "RMSE (root mean square)", "mm", 1e3, "less"),
    Column("bias", "mean signed error", "mm", 1e3, "nearer"),
    Column("sq", "SQ (square over depth)", "mm", 1e3, "less", 3),
    Column("abs", "ABS (relative error)", "%", 100, "less"),
    *(Column(f"within_{t}mm", f"within {t} mm", "%", 100, "more", 1) for t in (5, 10, 20, 50)),
    Column("delta_1", "ratio below 1.25", "%", 100, "more", 1),
    Column("coverage", "measured, not filled in", "%", 100, "", 1),
)
NORMAL = (
    Column("mean_deg", "mean angle", "deg", 1, "less"),
    Column("median_deg", "median angle", "deg", 1, "less"),
    Column("rmse_deg", "RMS angle", "deg", 1, "less"),
    *(Column(f"within_{t}deg", f"within {t} deg", "%", 100, "more", 1) for t in ("5", "11.25", "20", "30")),
)


@dataclass(frozen=True)
class Cell:
    """One number as text, and whether it is the best of its pool."""

    text: str
    best: bool


@dataclass(frozen=True)
class Row:
    """One metric: words, unit, one cell for every (pool, method)."""

    words: str
    unit: str
    cells: list[Cell]


@dataclass(frozen=True)
class Table:
    """A table: title, (pool, number of methods) over the columns, methods below, rows."""

    title: str
    pools: list[tuple[str, int]]
    methods: list[str]
    rows: list[Row]


def method_title(name: str) -> str:
    """How a method is called on the page."""
    return METHOD_TITLES.get(name, name)


def tables(results: Mapping[str, Any]) -> list[Table]:
    """Both tables of a ``results.json``; metrics that it does not hold are left out."""
    return [_table(results, "Depth", "depth", DEPTH), _table(results, "Normals", "normal", NORMAL)]


def _table(results: Mapping[str, Any], title: str, kind: str, columns: tuple[Column, ...]) -> Table:
    methods = list(results["methods"])
    rows = []
    for column in columns:
        cells = [cell for pool in POOLS for cell in _cells(results, kind, pool, column)]
        if any(c.text != "–" for c in cells):
            rows.append(Row(column.words, column.unit, cells))
    heads = [(words, len(methods)) for words in POOLS.values()]
    return Table(title, heads, [method_title(m) for m in methods] * len(POOLS), rows)


def _cells(results: Mapping[str, Any], kind: str, pool: str, column: Column) -> list[Cell]:
    values = [value_of(table, kind, pool, column) for table in results["methods"].values()]
    ranks = [None if v is None else _rank(round(v, column.digits), column.better) for v in values]
    best = min((r for r in ranks if r is not None), default=None)
    alone = len(ranks) > 1 and ranks.count(best) == 1
    return [
        Cell(shown(v, column), alone and r is not None and r == best)
        for v, r in zip(values, ranks, strict=True)
    ]


def value_of(method: Mapping[str, Any], kind: str, pool: str, column: Column) -> float | None:
    """Value of a metric in the unit of its column; None where it is absent."""
    value = method.get(kind, {}).get(pool, {}).get(column.key)
    return None if value is None or not math.isfinite(value) else column.factor * float(value)


def shown(value: float | None, column: Column) -> str:
    """Print a number, or a dash."""
    return "–" if value is None else f"{value:.{column.digits}f}"


def _rank(value: float, better: str) -> float | None:
    """Smaller is better; what looks equal in print is equal."""
    if not better:
        return None
    return {"less": value, "more": -value, "nearer": abs(value)}[better]


def networks(results: Mapping[str, Any]) -> list[str]:
    """Methods that headline and tiles are about: the networks, or where there are none what stands beside the sensor."""
    methods = [name for name in results["methods"] if name != "sensor"]
    learned = {"model", *(key.rpartition("#")[0] for key in results.get("runs", {}))}
    return [name for name in methods if name in learned] or methods


def headline(results: Mapping[str, Any]) -> str:
    """What becomes of the sensor's error: a sentence for every network."""
    where = f"On {sample(results)}"
    told = " ".join(filter(None, (_compared(results, name) for name in networks(results))))
    return f"{where}, {told}" if told else f"{where}: there is nothing to compare."


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


def sample(results: Mapping[str, Any]) -> str:
    """Say how many views of how many scenes were measured."""
    kind = "held-out scene" if results["split"] == "test" else f"{results['split']} scene"
    return f"{_count(results.get('views'), 'view')} of {_count(len(results.get('scenes', [])), kind)}"


def _two(results: Mapping[str, Any], method: str) -> tuple[Any, Any]:
    table = results["methods"].get(method, {})
    return value_of(table, "depth", "pixel", DEPTH[0]), value_of(table, "normal", "pixel", NORMAL[0])


def _change(before: float, after: float) -> str:
    if before <= 0:
        return "no comparison"
    percent = 100 * (after / before - 1)
    return f"{abs(percent):.0f} % {'more' if percent > 0 else 'less'}"


def _count(number: object, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def tiles(results: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(what, number with unit, whose it is and the sensor's) of the main metrics, pooled over pixels; of several networks the best."""
    names = networks(results)
    if not names:
        return []
    wanted = [
        ("depth error, mean", "depth", DEPTH[0]),
        ("depth error, median", "depth", DEPTH[1]),
        ("depth within 10 mm", "depth", DEPTH[7]),
        ("normals, mean error", "normal", NORMAL[0]),
    ]
    out = []
    for title, kind, column in wanted:
        values = {
            m: value_of(results["methods"].get(m, {}), kind, "pixel", column) for m in (*names, "sensor")
        }
        best = min(names, key=lambda m: _order(values[m], column))
        ours, theirs = shown(values[best], column), shown(values["sensor"], column)
        out.append((title, f"{ours} {column.unit}", f"{_whose(best, names)}sensor {theirs} {column.unit}"))
    return out


def _order(value: float | None, column: Column) -> float:
    rank = None if value is None else _rank(value, column.better)
    return math.inf if rank is None else rank


def _whose(name: str, names: list[str]) -> str:
    if len(names) > 1:
        return f"{name}, best of {len(names)}; "
    return "" if name == "model" else f"{name}; "
