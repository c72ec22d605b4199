"""How wrong the ground truth is, where a simulator knows the truth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.dataset.sample import SampleConfig, make_sample
from tofcapture.errors import DataError
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import GroundTruth, Sample, ShardReader
from tofcapture.frames import Truth, View
from tofcapture.rig import Rig

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
WRONG = 0.002  # m; a pixel whose depth is off by more is wrong
THROUGH = 0.005  # m; a pixel whose depth lies this far behind the truth shows what is behind it


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
        """As JSON types: numbers that are not finite become null."""
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


@dataclass(frozen=True)
class ClassError:
    """Errors of the pixels of one mask class.

    Attributes
    ----------
    errors
        (n,) float32 absolute depth errors, metres; infinite where the truth has no surface.
    through
        Pixels whose depth lies behind the true surface: background seen through it.
    """

    errors: Float32
    through: int

    @property
    def wrong(self) -> float:
        """Share of pixels that are off by more than :data:`WRONG`."""
        return float((self.errors > WRONG).mean()) if len(self.errors) else 0.0


@dataclass(frozen=True)
class CropShares:
    """Of the pixels with sound depth, no edge among them: those of the object, those the crop keeps; the same of the rest."""

    target: int
    target_kept: int
    other: int
    other_kept: int


def mask_classes(mask: NDArray[np.uint8]) -> dict[str, Bool]:
    """Pixels (H, W) of each class.

    ``object`` carries no bit and ``table`` only OUTSIDE; the others are the pixels with depth that carry a bit, whatever else
    they carry, edge pixels only under ``edge``.
    """
    edge = (mask & MaskBit.EDGE) > 0
    hit = (mask & MaskBit.NOT_HIT) == 0
    return {
        "object": mask == 0,
        "table": mask == MaskBit.OUTSIDE,
        "edge": hit & edge,
        "grazing": hit & ~edge & ((mask & MaskBit.GRAZING) > 0),
        "occluded": hit & ~edge & ((mask & MaskBit.OCCLUDED) > 0),
    }


def class_errors(gt: GroundTruth, truth: Truth) -> dict[str, ClassError]:
    """Errors of ground truth at 2x, by mask class."""
    error = gt.depth - truth.depth
    absolute = np.where(np.isfinite(error), np.abs(error), np.float32(np.inf))
    return {
        name: ClassError(absolute[where], int((error[where] > THROUGH).sum()))
        for name, where in mask_classes(gt.mask).items()
    }


def crop_shares(gt: GroundTruth, truth: Truth) -> CropShares:
    """What the crop keeps of the object and of everything else, at 2x."""
    sound = (gt.mask & ~np.uint8(MaskBit.OUTSIDE)) == 0
    target, other, kept = sound & truth.target, sound & ~truth.target, gt.mask == 0
    return CropShares(*(int(m.sum()) for m in (target, target & kept, other, other & kept)))


def pooled(views: list[ViewError]) -> TruthError:
    """Pool the pixels of several views."""
    errors = np.concatenate([v.errors for v in views] or [np.zeros(0, np.float32)])
    target = sum(v.target_pixels for v in views)
    median, p99 = np.percentile(errors, [50, 99], method="nearest") * 1e3 if len(errors) else (np.nan, np.nan)
    covered = sum(v.covered for v in views)
    return TruthError(
        float(median), float(p99), len(errors), target, covered, covered / target if target else float("nan")
    )


def ground_truth_error(view: View, rig: Rig, config: SampleConfig | None = None) -> TruthError:
    """Error of the ground truth that ``rig`` gives of a simulated view.

    Raises
    ------
    DataError
        When the view carries no truth.
    """
    sample = make_sample(view, rig, config or SampleConfig(), np.random.default_rng(view.index))
    error = view_error(sample, view)
    if error is None:
        raise DataError(
            f"{view.scene} view {view.index}: carries no truth", hint="only simulated recordings do"
        )
    return pooled([error])


def pooled_error(shards: Iterable[Path]) -> TruthError | None:
    """Pool over finished shards; ``None`` when none of them carries truth."""
    errors: list[ViewError] = []
    for path in shards:
        with ShardReader(path) as shard:
            gt = shard.provenance.get("gt")
            if gt is not None:
                errors.append(ViewError(_shard_errors(shard), gt["covered_pixels"], gt["target_pixels"]))
    return pooled(errors) if errors else None


def _shard_errors(shard: ShardReader) -> Float32:
    out = [np.zeros(0, np.float32)]
    for view in range(shard.views):
        gt, truth = shard.ground_truth(view, 2), shard.truth(view)
        if truth is not None:
            out.append(_absolute(gt, truth.depth))
    return np.concatenate(out)


def _absolute(gt: GroundTruth, truth: Float32) -> Float32:
    """Absolute depth errors where the mask is 0.

    Ground truth where the truth has no surface at all is as wrong as can be: it must not vanish from the percentiles.
    """
    errors = np.abs(gt.depth - truth)[gt.mask == 0]
    return np.where(np.isfinite(errors), errors, np.float32(np.inf))
