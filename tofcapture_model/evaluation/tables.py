"""The suites' tables as Markdown, LaTeX and HTML: millimetres, degrees, percent; the best value of a column marked."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tofcapture.files.seal import write_text


@dataclass(frozen=True)
class Column:
    """Words, where the number is in a method's results, factor into the printed unit, digits, and which is ``best``: a key of ``RANKS``."""

    words: str
    path: tuple[str, ...]
    factor: float = 1e3
    digits: int = 2
    best: str = "least"


@dataclass(frozen=True)
class Suite:
    """Title, columns, rows: names of methods and what the table calls them, in its order; ``others``: those that no table names follow."""

    title: str
    columns: tuple[Column, ...]
    rows: Mapping[str, str] = field(default_factory=dict)
    others: bool = True


def _main(pool: str) -> tuple[Column, ...]:
    d, n = ("depth", pool), ("normal", pool)
    return (
        Column("ABS %", (*d, "abs"), 100),
        Column("SQ mm", (*d, "sq"), 1e3, 3),
        Column("RMSE mm", (*d, "rmse")),
        Column("MAE mm", (*d, "mae")),
        Column("normal MAE rad", (*n, "paper_normal_mae"), 1, 3),
        Column("above 20 deg %", (*n, "paper_bad20_pct"), 1),
    )


def _by_region(*names: str) -> tuple[Column, ...]:
    return tuple(
        column
        for name in names
        for column in (
            Column(f"{name}: MAE mm", ("regions", name, "depth", "pixel", "mae")),
            Column(f"{name}: bias mm", ("regions", name, "depth", "pixel", "bias")),
            Column(f"{name}: normals deg", ("regions", name, "normal", "pixel", "mean_deg"), 1),
        )
    )


_QUALITY = (
    *_by_region("edge", "interior"),
    Column("precision mm", ("extra", "precision")),
    Column("within 1 sigma %", ("extra", "coverage_1sigma"), 100, 1, best="one sigma"),
    Column("AUSE", ("extra", "ause"), 1, 3),
    Column("coverage %", ("depth", "pixel", "coverage"), 100, 1, best="most"),
)
_BUDGET = (
    Column("minutes", ("budget", "minutes"), 1, 1, best="none"),
    Column("steps", ("budget", "steps"), 1, 0, best="none"),
)
SUITES: Mapping[str, Suite] = {
    "main": Suite(
        "Comparison (the paper's table II; Ours is the paper's network)",
        (*_main("pixel"), *_QUALITY, *_BUDGET),
        {
            "sensor": "ToF sensor",
            "lf2": "LF2",
            "su2018": "Su et al.",
            "guo2018": "Guo et al.",
            "coarse-fine": "Agresti et al.",
            "paper": "Ours",
        },
    ),
    "ablation": Suite(
        "Ablation of modules (table III)",
        (*_main("pixel"), *_BUDGET),
        {
            "sensor": "ToF sensor",
            "inputs-raw": "w/o multi-input",
            "without-chamfer": "w/o Chamfer loss",
            "without-error-map": "w/o error map",
            "without-refinement": "w/o refinement",
            "paper": "Ours (full model)",
        },
        others=False,
    ),
    "inputs": Suite(
        "Inputs (table IV)",
        (*_main("pixel"), *_BUDGET),
        {
            "sensor": "ToF sensor",
            "inputs-confidence": "Conf.",
            "inputs-raw": "Raw",
            "inputs-depth": "Depth",
            "inputs-raw-depth": "Depth + Raw",
            "paper": "Depth + Conf. + Raw",
        },
        others=False,
    ),
    "mpi": Suite("Multipath", _by_region("mpi", "no-mpi")),
    "noise": Suite("Noise", (Column("precision mm", ("extra", "precision")), *_by_region("dark", "bright"))),
    "indoor": Suite("Indoor scenes", _main("image")),
}


def cells(results: Mapping[str, Any], suite: Suite) -> list[tuple[str, list[tuple[str, bool]]]]:
    """Rows: what the table calls the method, and text and "is the best" of every column."""
    found = results["methods"]
    named = {name for one in SUITES.values() for name in one.rows if suite.rows}
    others = [name for name in found if suite.others and name not in named]
    methods = {name: found[name] for name in (*suite.rows, *others) if name in found}
    columns = [column_cells(methods, results.get("spread", {}), c) for c in suite.columns]
    return [(suite.rows.get(name, name), [column[i] for column in columns]) for i, name in enumerate(methods)]


ONE_SIGMA_PCT = 68.27  # of the errors lie within one sigma, if it is right

RANKS: Mapping[str, Callable[[float], float]] = {
    "least": abs,
    "most": lambda value: -value,
    "one sigma": lambda value: abs(value - ONE_SIGMA_PCT),
    "none": lambda _value: math.nan,
}
"""What is smallest for the best value of a column; NaN where none is better."""


def column_cells(
    methods: Mapping[str, Any], spread: Mapping[str, Any], column: Column
) -> list[tuple[str, bool]]:
    """Text of a column for every method, and whether it is the best; what looks equal in print is equal."""
    values = [value_of(table, column) for table in methods.values()]
    ranks = [math.nan if v is None else RANKS[column.best](round(v, column.digits)) for v in values]
    known = [r for r in ranks if not math.isnan(r)]
    out = []
    for name, value, rank in zip(methods, values, ranks, strict=True):
        if value is None:
            out.append(("–", False))
            continue
        other = value_of(spread.get(name, {}), column)
        text = f"{value:.{column.digits}f}" + ("" if other is None else f" ± {other:.{column.digits}f}")
        out.append((text, len(known) > 1 and rank == min(known)))
    return out


def value_of(table: Any, column: Column) -> float | None:
    """Value of a method's results in the printed unit; None where it is absent."""
    for key in column.path:
        table = table.get(key) if isinstance(table, Mapping) else None
    return column.factor * float(table) if isinstance(table, int | float) and math.isfinite(table) else None


def _markdown(results: Mapping[str, Any], suite: Suite) -> str:
    head = ["method", *(c.words for c in suite.columns)]
    lines = [f"## {suite.title}", "", _joined(head), _joined(["---"] * len(head))]
    lines += [
        _joined([name, *(f"**{t}**" if b else t for t, b in row)]) for name, row in cells(results, suite)
    ]
    return "\n".join(lines) + "\n"


def _joined(row: Sequence[str]) -> str:
    return "| " + " | ".join(text.replace("|", r"\|") for text in row) + " |"


_LATEX = str.maketrans(
    {
        **{sign: rf"\{sign}" for sign in "%_&#${}"},
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "\\": r"\textbackslash{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "±": r"$\pm$",
        "–": "--",
    }
)


def _latex(results: Mapping[str, Any], suite: Suite) -> str:
    def line(row: Sequence[tuple[str, bool]]) -> str:
        safe = [(text.translate(_LATEX), best) for text, best in row]
        return " & ".join(rf"\textbf{{{text}}}" if best else text for text, best in safe) + r" \\"

    rows = [line([(name, False), *row]) for name, row in cells(results, suite)]
    head = line([(words, False) for words in ("method", *(c.words for c in suite.columns))])
    start = rf"\begin{{tabular}}{{l{'r' * len(suite.columns)}}}"
    return "\n".join(
        [f"% {suite.title}", start, r"\hline", head, r"\hline", *rows, r"\hline", r"\end{tabular}", ""]
    )


def _html(results: Mapping[str, Any], suite: Suite) -> str:
    head = "".join(f"<th>{html.escape(x)}</th>" for x in ("method", *(c.words for c in suite.columns)))
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th>"
        + "".join(f"<td>{'<b>' if b else ''}{html.escape(t)}{'</b>' if b else ''}</td>" for t, b in row)
        + "</tr>\n"
        for name, row in cells(results, suite)
    )
    return f"<h2>{html.escape(suite.title)}</h2>\n<table><tr>{head}</tr>\n{rows}</table>\n"


WRITERS: Mapping[str, tuple[Callable[[Mapping[str, Any], Suite], str], str, str]] = {
    "md": (_markdown, "", ""),
    "tex": (_latex, "", ""),
    "html": (
        _html,
        (
            '<!doctype html><html lang="en"><meta charset="utf-8"><title>Tables</title>\n'
            "<style>td,th{padding:.2em .6em;text-align:right}body{font-family:sans-serif}</style>\n"
        ),
        "</html>\n",
    ),
}


def markdown(results: Mapping[str, Any], names: Sequence[str]) -> str:
    """Print the suites' tables for people."""
    return "\n".join(_markdown(results, SUITES[name]) for name in names)


def write_tables(out: Path, results: Mapping[str, Any], names: Sequence[str]) -> list[Path]:
    """Write ``tables.md``, ``.tex`` and ``.html`` beside ``out``."""
    paths = []
    for kind, (writer, start, end) in WRITERS.items():
        path = out.with_name(f"tables.{kind}")
        write_text(path, start + "\n".join(writer(results, SUITES[name]) for name in names) + end)
        paths.append(path)
    return paths
