"""Statistics of a dataset as one self-contained HTML page, with pictures."""

from __future__ import annotations

import base64
import io
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.dataset.stats import STANDS_OUT, DatasetStats
from tofcapture.errors import ConfigError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import write_text
from tofcapture.files.shard import ShardReader

_COLOURS = {"train": "#2166ac", "val": "#b35806", "test": "#1b7837"}
_PICTURES = 2  # scenes shown of each split
_DPI = 90


def write_stats_page(stats: DatasetStats, path: Path) -> Path:
    """Write the page atomically; it needs no other file and no network.

    Raises
    ------
    ConfigError
        jinja2 or matplotlib is missing.
    DataError
        A shard that is shown is missing or damaged.
    """
    try:
        from jinja2 import Environment, StrictUndefined
        from matplotlib.figure import Figure  # noqa: F401
    except ImportError as err:
        raise ConfigError(
            f"a page of statistics needs jinja2 and matplotlib: {err}",
            hint="pip install 'tofcapture[report]'",
        ) from err
    text = files("tofcapture.dataset").joinpath("stats.html").read_text(encoding="utf-8")
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(text)
    write_text(path, template.render(**_content(stats)))
    return path


def _content(stats: DatasetStats) -> dict[str, Any]:
    return {
        "name": stats.dataset.resolve().name,
        "scenes": sum(s.scenes for s in stats.splits.values()),
        "views": sum(s.views for s in stats.splits.values()),
        "manifest": stats.manifest_sha256,
        "histograms": _histograms(stats),
        "rows": quantity_rows(stats),
        "splits": list(stats.splits),
        "bits": bit_rows(stats),
        "outliers": outlier_rows(stats),
        "limit": f"{STANDS_OUT:g}",
        "pictures": _pictures(stats),
    }


def quantity_rows(stats: DatasetStats) -> list[list[str]]:
    """Rows of quantity, split, count, min, 1 %, median, 99 %, max."""
    rows = []
    for split, s in stats.splits.items():
        for name, tally in s.tallies.items():
            t = tally.table()
            numbers = [f"{t[k]:.4g}" for k in ("min", "p1", "p50", "p99", "max")] if t["count"] else ["-"] * 5
            rows.append([f"{name} [{t['unit']}]", split, f"{t['count']:,}", *numbers])
    return sorted(rows, key=lambda row: row[0])


def bit_rows(stats: DatasetStats) -> list[list[str]]:
    """Rows of a mask or flag bit and its share of the pixels in each split."""
    tables = [s.table() for s in stats.splits.values()]
    return [
        [f"{kind} {name}", *(f"{t[kind][name]:.2%}" for t in tables)]
        for kind in ("mask", "flags")
        for name in tables[0][kind]
    ]


def outlier_rows(stats: DatasetStats, most: int = 50) -> list[list[str]]:
    """Rows of view, number, value, median of all, robust standard deviations."""
    return [
        [f"{o.scene} view {o.view}", o.name, f"{o.value:.4g}", f"{o.median:.4g}", f"{o.deviations:+.1f}"]
        for o in stats.outliers[:most]
    ]


def _embedded(figure: Any) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()


def _histograms(stats: DatasetStats) -> str:
    from matplotlib.figure import Figure

    names = list(next(iter(stats.splits.values())).tallies)
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    for axes, name in zip(figure.subplots(2, 3).flat, names, strict=True):
        tallies = {
            split: s.tallies[name] for split, s in stats.splits.items() if s.tallies[name].counts.sum()
        }
        for split, tally in tallies.items():
            centres = (tally.quantity.edges[1:] + tally.quantity.edges[:-1]) / 2
            share = tally.counts / tally.counts.sum()
            axes.step(centres, share, where="mid", lw=1.2, color=_COLOURS[split], label=split)
        if tallies:
            _limits(axes, list(tallies.values()))
        axes.set_xlabel(f"{name} [{next(iter(stats.splits.values())).tallies[name].quantity.unit}]")
        axes.set_ylabel("share")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(frameon=False)
    return _embedded(figure)


def _limits(axes: Any, tallies: list[Any]) -> None:
    """Show what is there, not the whole range of the bins."""
    quantity = tallies[0].quantity
    low, high = min(t.quantile(0.001) for t in tallies), max(t.quantile(0.999) for t in tallies)
    step = (quantity.high - quantity.low) / len(tallies[0].counts)
    if quantity.log:
        axes.set_xscale("log")
        axes.set_xlim(max(low * 0.8, quantity.low), max(high, low * 1.1) * 1.2)
    else:
        axes.set_xlim(max(low - 3 * step, quantity.low), min(high + 3 * step, quantity.high))


def _pictures(stats: DatasetStats) -> list[dict[str, str]]:
    manifest = load_manifest(stats.dataset)
    out = []
    for split in stats.splits:
        for name, entry in list(manifest.split(split).items())[:_PICTURES]:
            with ShardReader(stats.dataset / entry.path, entry.sha256) as shard:
                out.append({"name": f"{name}, view 0, {split}", "data": _picture(shard, 0)})
    return out


def _picture(shard: ShardReader, view: int) -> str:
    from matplotlib.figure import Figure

    tof, gt = shard.tof(view), shard.ground_truth(view, 2)
    known = np.concatenate([m[np.isfinite(m)] for m in (tof.depth, gt.depth)])
    low, high = np.percentile(known, [2, 98]) if known.size else (0.0, 1.0)
    figure = Figure(figsize=(11, 2.1), layout="constrained")
    panels: tuple[tuple[str, Any, dict[str, Any]], ...] = (
        ("amplitude", tof.confidence, {"cmap": "gray"}),
        (f"ToF depth, {low:.2f} to {high:.2f} m", tof.depth, {"vmin": low, "vmax": high, "cmap": "viridis"}),
        ("ground-truth depth", gt.depth, {"vmin": low, "vmax": high, "cmap": "viridis"}),
        ("normals", np.where(np.isfinite(gt.normals), 0.5 - 0.5 * gt.normals, 1.0), {}),
        ("mask (white: good)", gt.mask == 0, {"cmap": "gray", "vmin": 0, "vmax": 1}),
    )
    for axes, (title, image, options) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        axes.imshow(image, interpolation="nearest", **options)
        axes.set_title(title, fontsize=8)
        axes.set_axis_off()
    return _embedded(figure)
