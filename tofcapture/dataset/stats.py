"""Count what a dataset holds: distributions by split, mask and flag bits, views that stand out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.files.layout import SPLITS, MaskBit
from tofcapture.files.manifest import load_manifest, manifest_path
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ShardReader
from tofcapture.frames import TofFlag

Array = NDArray[Any]
BINS = 400
STANDS_OUT = 6.0  # robust standard deviations of a view's number from the median of all views
FEWEST = 8  # views below which nothing can stand out
_WORST = 1e3  # deviations of a view that has no good pixel at all
_PER_MAD = 1.4826  # standard deviations of a normal distribution per median absolute deviation


@dataclass(frozen=True)
class Quantity:
    """Hold what is counted: name, unit, the histogram's range, and whether its bins grow by a constant factor.

    ``floor`` is the least deviation of views that counts, so that where all are but equal no hair stands out.
    """

    name: str
    unit: str
    low: float
    high: float
    floor: float
    log: bool = False

    @property
    def edges(self) -> NDArray[np.float64]:
        """(BINS + 1,) edges of the bins."""
        space = np.geomspace if self.log else np.linspace
        return np.asarray(space(self.low, self.high, BINS + 1), dtype=np.float64)


QUANTITIES = (
    Quantity("gt_depth", "m", 0.0, 10.0, 0.01),
    Quantity("tof_depth", "m", 0.0, 10.0, 0.01),
    Quantity("tof_minus_gt", "m", -0.1, 0.1, 0.001),
    Quantity("amplitude", "DN", 0.1, 1e5, 1.0, log=True),
    Quantity("incidence", "deg", 0.0, 90.0, 1.0),
    Quantity("celsius", "degC", -40.0, 125.0, 0.5),
)
_FLOOR = {q.name: q.floor for q in QUANTITIES} | {"good_share": 0.02, "flagged_share": 0.01}


@dataclass
class Tally:
    """Counts (BINS,) of one quantity, values beyond its range in the outermost bins; smallest and largest value."""

    quantity: Quantity
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, np.int64))
    low: float = np.inf
    high: float = -np.inf

    def add(self, values: Array) -> None:
        """Count the finite values of an array."""
        values = values[np.isfinite(values)]
        if values.size:
            self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))
            edges = self.quantity.edges
            self.counts += np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]

    def quantile(self, q: float) -> float:
        """Value below which a share ``q`` lies, to a bin's width; NaN without values."""
        total = self.counts.sum()
        if not total:
            return float("nan")
        at = np.interp(q * total, np.concatenate([[0], np.cumsum(self.counts)]), self.quantity.edges)
        return float(np.clip(at, self.low, self.high))

    def table(self) -> dict[str, Any]:
        """As JSON types."""
        count = int(self.counts.sum())
        out: dict[str, Any] = {"unit": self.quantity.unit, "count": count}
        if count:
            quantiles = {f"p{round(100 * q)}": self.quantile(q) for q in (0.01, 0.25, 0.5, 0.75, 0.99)}
            out |= {"min": self.low, "max": self.high, **quantiles}
        return out


@dataclass
class SplitStats:
    """Counts over the views of one split."""

    scenes: int = 0
    views: int = 0
    pixels: int = 0
    tof_pixels: int = 0
    tallies: dict[str, Tally] = field(default_factory=lambda: {q.name: Tally(q) for q in QUANTITIES})
    mask: dict[str, int] = field(default_factory=lambda: {"GOOD": 0, **{str(b.name): 0 for b in MaskBit}})
    flags: dict[str, int] = field(default_factory=lambda: {str(b.name): 0 for b in TofFlag})

    def add(self, arrays: Mapping[str, Array], mask: Array, flags: Array) -> None:
        """Count one view."""
        for name, values in arrays.items():
            self.tallies[name].add(values)
        self.views += 1
        self.pixels += mask.size
        self.tof_pixels += flags.size
        self.mask["GOOD"] += int((mask == 0).sum())
        for counts, bits, image in ((self.mask, MaskBit, mask), (self.flags, TofFlag, flags)):
            for bit in bits:
                counts[str(bit.name)] += int(((image & bit) > 0).sum())

    def table(self) -> dict[str, Any]:
        """As JSON types; shares of mask and flag bits are of all pixels."""
        return {
            "scenes": self.scenes,
            "views": self.views,
            "quantities": {name: tally.table() for name, tally in self.tallies.items()},
            "mask": {name: n / max(1, self.pixels) for name, n in self.mask.items()},
            "flags": {name: n / max(1, self.tof_pixels) for name, n in self.flags.items()},
        }


@dataclass(frozen=True)
class DatasetStats:
    """Statistics of a dataset: by split, by view, and the :func:`outliers`."""

    dataset: Path
    manifest_sha256: str
    splits: Mapping[str, SplitStats]
    views: Sequence[Mapping[str, Any]]
    outliers: Sequence[Mapping[str, Any]]

    def table(self) -> dict[str, Any]:
        """As JSON types; numbers that are not finite become null."""
        rows = [
            {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}
            for row in self.views
        ]
        return {
            "format": "tofcapture-stats",
            "version": 1,
            "dataset": str(self.dataset),
            "manifest_sha256": self.manifest_sha256,
            "splits": {name: split.table() for name, split in self.splits.items()},
            "outliers": list(self.outliers),
            "views": rows,
        }


def dataset_stats(
    dataset: Path, progress: Callable[[int, int], None] = lambda _done, _total: None
) -> DatasetStats:
    """Count a dataset in one pass over its shards; ``progress`` is told views done and views in all.

    Raises :class:`DataError`: the manifest or a shard is missing or damaged.
    """
    manifest = load_manifest(dataset)
    splits = {name: SplitStats() for name in SPLITS if manifest.split(name)}
    rows: list[dict[str, Any]] = []
    total = sum(e.views for e in manifest.scenes.values())
    for name, entry in sorted(manifest.scenes.items()):
        split = splits[entry.split]
        split.scenes += 1
        with ShardReader(dataset / entry.path, entry.sha256) as shard:
            for view in range(shard.views):
                arrays, mask, flags = _view(shard, view)
                split.add(arrays, mask, flags)
                numbers = {key: _median(values) for key, values in arrays.items()}
                numbers |= {
                    "good_share": float((mask == 0).mean()),
                    "flagged_share": float((flags != 0).mean()),
                }
                rows.append({"scene": name, "split": entry.split, "view": view, **numbers})
        progress(len(rows), total)
    return DatasetStats(Path(dataset), sha256_of(manifest_path(dataset)), splits, rows, outliers(rows))


def _view(shard: ShardReader, view: int) -> tuple[dict[str, Array], Array, Array]:
    """Quantities of one view (ground truth and angles where the mask at 1x is 0), its mask and its flags."""
    tof, gt = shard.tof(view), shard.ground_truth(view, 1)
    good = gt.mask == 0
    arrays = {
        "gt_depth": gt.depth[good],
        "tof_depth": tof.depth[np.isfinite(tof.depth)],
        "tof_minus_gt": (tof.depth - gt.depth)[good],
        "amplitude": tof.confidence[np.isfinite(tof.confidence)],
        "incidence": incidence_deg(gt.normals, shard.camera.rays)[good],
        "celsius": np.array([shard.celsius(view, frame) for frame in range(shard.frames)]),
    }
    return arrays, gt.mask, tof.flags


def _median(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def incidence_deg(normals: Array, rays: Array) -> Array:
    """Angle between ray and surface normal, degrees (H, W), of normals (H, W, 3); NaN where they are."""
    cosine = -np.einsum("hwc,hwc->hw", normals.astype(np.float64), rays) / np.linalg.norm(rays, axis=-1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def outliers(views: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Find views that stand out in a number, largest deviation first.

    Each is ``scene``, ``view``, ``name``, ``value``, ``median`` of all views, and ``deviations`` from it. A number stands out when it is more than :data:`STANDS_OUT` robust standard deviations (1.4826 times the median absolute
    deviation, with a floor for each number) from the median of all views. A view without a good pixel always does.
    """
    if not views:
        return []
    middle = float(np.median([row["good_share"] for row in views]))
    found = [_outlier(row, "good_share", middle, -_WORST) for row in views if row["good_share"] == 0]
    for name in [k for k, v in views[0].items() if isinstance(v, float)] if len(views) >= FEWEST else ():
        values = np.array([row[name] for row in views])
        if not np.isfinite(values).any():
            continue
        median = float(np.nanmedian(values))
        scale = max(_PER_MAD * float(np.nanmedian(np.abs(values - median))), _FLOOR[name])
        for row, value in zip(views, values, strict=True):
            z = (value - median) / scale
            if abs(z) > STANDS_OUT and not (name == "good_share" and value == 0):
                found.append(_outlier(row, name, median, float(z)))
    return sorted(found, key=lambda o: -abs(o["deviations"]))


def _outlier(row: Mapping[str, Any], name: str, median: float, deviations: float) -> dict[str, Any]:
    said = {"name": name, "value": float(row[name]), "median": median, "deviations": deviations}
    return {"scene": row["scene"], "view": row["view"], **said}
