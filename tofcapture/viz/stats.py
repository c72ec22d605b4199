"""Show the statistics of a dataset: as rows for the terminal and as one self-contained HTML page with pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tofcapture.colours import NORMAL_WORDS, Scale
from tofcapture.dataset.stats import QUANTITIES, STANDS_OUT, DatasetStats, Quantity
from tofcapture.files.manifest import load_manifest
from tofcapture.viz.page import (
    Picture,
    lines,
    map_picture,
    mask_legend,
    mask_picture,
    normal_picture,
    write_page,
)
from tofcapture.viz.shots import scales_of
from tofcapture.viz.sources import shard_shot

_SCENES = 2  # shown of each split
_ENDS = ("min", "p1", "p50", "p99", "max")
TABLES = {
    "quantities": ["quantity", "split", "values", "min", "1 %", "median", "99 %", "max"],
    "outliers": ["view that stands out", "number", "value", "median", "deviations"],
}
"""Titles of the columns of :func:`quantity_rows` and :func:`outlier_rows`."""


def write_stats_page(stats: DatasetStats, path: Path) -> Path:
    """Write the page atomically.

    Raises :class:`ConfigError`: jinja2 or matplotlib is missing; :class:`DataError`: a shard that is shown is
    missing or damaged.
    """
    content = {
        "name": stats.dataset.resolve().name,
        "scenes": sum(s.scenes for s in stats.splits.values()),
        "views": sum(s.views for s in stats.splits.values()),
        "manifest": stats.manifest_sha256,
        "histograms": [(_histogram(stats, quantity), quantity.name) for quantity in QUANTITIES],
        "heads": TABLES,
        "rows": quantity_rows(stats),
        "splits": list(stats.splits),
        "bits": bit_rows(stats),
        "outliers": outlier_rows(stats),
        "limit": f"{STANDS_OUT:g}",
        "examples": _examples(stats),
        "normal_words": NORMAL_WORDS,
    }
    return write_page(Path(__file__).with_name("stats.html.j2"), path, content)


_AXES = {
    "gt_depth": "ground truth depth, m",
    "tof_depth": "ToF depth, m",
    "tof_minus_gt": "ToF - ground truth, mm",
    "amplitude": "amplitude, raw units",
    "celsius": "temperature, degrees Celsius",
}
_UNITS = {q.name: q.unit for q in QUANTITIES}


def _shown(name: str) -> tuple[str, float]:
    """Return the unit that people read, "" for a share, and what it multiplies: errors are millimetres wherever people look."""
    return ("mm", 1e3) if name == "tof_minus_gt" else (_UNITS.get(name, ""), 1.0)


def quantity_rows(stats: DatasetStats) -> list[list[str]]:
    """Rows of quantity, split, count, min, 1 %, median, 99 %, max."""
    rows = []
    for split, s in stats.splits.items():
        for name, tally in s.tallies.items():
            t, (unit, times) = tally.table(), _shown(name)
            numbers = [f"{times * t[k]:.4g}" for k in _ENDS] if t["count"] else ["-"] * len(_ENDS)
            rows.append([f"{name} [{unit}]", split, f"{t['count']:,}", *numbers])
    return sorted(rows, key=lambda row: row[0])


def bit_rows(stats: DatasetStats) -> list[list[str]]:
    """Rows of a mask or flag bit and its share of the pixels in each split."""
    tables = [s.table() for s in stats.splits.values()]
    return [
        [f"{kind} {name}", *(f"{t[kind][name]:.2%}" for t in tables)]
        for kind in ("mask", "flags")
        for name in (tables[0][kind] if tables else ())
    ]


def outlier_rows(stats: DatasetStats, most: int = 50) -> list[list[str]]:
    """Rows of view, number, value, median of all, robust standard deviations."""
    rows = []
    for o in stats.outliers[:most]:
        unit, times = _shown(o["name"])
        named = o["name"] + (f" [{unit}]" if unit else "")
        numbers = [f"{times * o[k]:.4g}" for k in ("value", "median")]
        rows.append([f"{o['scene']} view {o['view']}", named, *numbers, f"{o['deviations']:+.1f}"])
    return rows


def _histogram(stats: DatasetStats, quantity: Quantity) -> str:
    """Draw the share of values by bin, a line for each split, over what is there."""
    found = {
        n: s.tallies[quantity.name] for n, s in stats.splits.items() if s.tallies[quantity.name].counts.any()
    }
    if not found:
        return ""
    centres = (quantity.edges[1:] + quantity.edges[:-1]) / 2
    low, high = min(t.quantile(0.001) for t in found.values()), max(t.quantile(0.999) for t in found.values())
    step = (quantity.high - quantity.low) / len(centres)
    span = (low * 0.8, high * 1.2) if quantity.log else (low - 3 * step, high + 3 * step)
    shares = {name: (centres, t.counts / t.counts.sum()) for name, t in found.items()}
    unit, times = _shown(quantity.name)
    words = _AXES.get(quantity.name, f"{quantity.name}, {unit}")
    shares = {name: (times * at, share) for name, (at, share) in shares.items()}
    span = (times * span[0], times * span[1])
    return lines(
        shares, words, "share", f"distribution of {quantity.name}", log="x" if quantity.log else "", span=span
    )


def _examples(stats: DatasetStats) -> list[dict[str, Any]]:
    """First view of the first scenes of each split, as groups of pictures."""
    manifest, out = load_manifest(stats.dataset), []
    for split in stats.splits:
        for name, entry in list(manifest.split(split).items())[:_SCENES]:
            shot = shard_shot(stats.dataset / entry.path, 0)
            scales = scales_of(shot.panels)
            title = f"{name}, view 0, {split}"
            pictures = [_picture(panel, scales.get(panel.kind), title) for panel in shot.panels]
            bars = [(kind, scale) for kind, scale in sorted(scales.items())]
            mask = next(panel.values for panel in shot.panels if panel.kind == "mask")
            out.append({"name": title, "pictures": pictures, "scales": bars, "legend": mask_legend(mask)})
    return out


def _picture(panel: Any, scale: Scale | None, of: str) -> Picture:
    alt = f"{panel.title} of {of}"
    if scale is not None:
        return map_picture(panel.title, panel.values, scale, alt)
    return (normal_picture if panel.kind == "normals" else mask_picture)(panel.title, panel.values, alt)
