"""Measures how wrong the ground truth is, where a simulator knows the truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.files.shard import GroundTruth, Sample, ShardReader
from tofcapture.frames import View

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class TruthError:
    """Error of ground-truth depth at 2x, over the pixels whose mask is 0.

    Attributes
    ----------
    median_error_mm, p99_error_mm
        Of ``|depth - truth|``, millimetres, printed as such; NaN without pixels.
    pixels
        Pixels whose mask is 0.
    target_pixels, covered_pixels
        Pixels whose ray truly hits the object, and those of them whose mask is 0.
    coverage
        The share of the latter.
    """

    median_error_mm: float
    p99_error_mm: float
    pixels: int
    target_pixels: int
    covered_pixels: int
    coverage: float

    def table(self) -> dict[str, Any]:
        """Return JSON types: numbers that are not finite become null."""
        return {k: v if np.isfinite(v) else None for k, v in asdict(self).items()}


@dataclass(frozen=True)
class ViewError:
    """Errors of one view.

    Attributes
    ----------
    errors
        (n,) float32 absolute depth errors where the mask is 0, metres.
    covered, target_pixels
        Pixels of the object with mask 0, pixels of the object.
    """

    errors: Float32
    covered: int
    target_pixels: int


def view_error(sample: Sample, view: View) -> ViewError | None:
    """Compare a sample with the truth that its view carries; ``None`` in the real world."""
    if view.truth is None:
        return None
    gt = sample.ground_truth[2]
    covered = int(((gt.mask == 0) & view.truth.target).sum())
    return ViewError(_absolute(gt, view.truth.depth), covered, int(view.truth.target.sum()))


def pooled(views: Sequence[ViewError]) -> TruthError:
    """Pool the pixels of several views."""
    errors = np.concatenate([v.errors for v in views] or [np.zeros(0, np.float32)])
    target = sum(v.target_pixels for v in views)
    median, p99 = np.percentile(errors, [50, 99], method="nearest") * 1e3 if len(errors) else (np.nan, np.nan)
    covered = sum(v.covered for v in views)
    return TruthError(
        float(median), float(p99), len(errors), target, covered, covered / target if target else float("nan")
    )


def pooled_error(shards: Iterable[Path]) -> TruthError | None:
    """Pool over finished shards; ``None`` when none of them carries truth."""
    views: list[ViewError] = []
    for path in shards:
        with ShardReader(path) as shard:
            gt = shard.provenance.get("gt")
            if gt is not None:
                views.append(ViewError(_shard_errors(shard), gt["covered_pixels"], gt["target_pixels"]))
    return pooled(views) if views else None


def _shard_errors(shard: ShardReader) -> Float32:
    pairs = ((shard.ground_truth(view, 2), shard.truth(view)) for view in range(shard.views))
    return np.concatenate([_absolute(gt, truth.depth) for gt, truth in pairs if truth is not None])


def _absolute(gt: GroundTruth, truth: Float32) -> Float32:
    """Absolute depth errors where the mask is 0.

    Ground truth where the truth has no surface at all is as wrong as can be: it must not vanish from the percentiles.
    """
    errors = np.abs(gt.depth - truth)[gt.mask == 0]
    return np.where(np.isfinite(errors), errors, np.float32(np.inf))
