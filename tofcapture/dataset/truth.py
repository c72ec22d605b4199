"""How wrong the ground truth is, where a simulator knows the truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.dataset.sample import SampleConfig, make_sample
from tofcapture.errors import DataError
from tofcapture.files.shard import Sample
from tofcapture.frames import View
from tofcapture.rig import Rig

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
    target_pixels
        Pixels whose ray truly hits the object.
    coverage
        Share of the object's pixels whose mask is 0.
    """

    median_error_mm: float
    p99_error_mm: float
    pixels: int
    target_pixels: int
    coverage: float

    def table(self) -> dict[str, Any]:
        """As JSON types: numbers that are not finite become null."""
        return {k: None if v != v else v for k, v in asdict(self).items()}  # noqa: PLR0124  NaN


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
    good = gt.mask == 0
    errors = np.abs(gt.depth - view.truth.depth)[good]
    # Ground truth where the truth has no surface at all is as wrong as can be: it must not vanish from the percentiles.
    errors = np.where(np.isfinite(errors), errors, np.float32(np.inf))
    return ViewError(errors, int((good & view.truth.target).sum()), int(view.truth.target.sum()))


def pool(views: list[ViewError]) -> TruthError:
    """Pool the pixels of several views."""
    errors = np.concatenate([v.errors for v in views] or [np.zeros(0, np.float32)])
    target = sum(v.target_pixels for v in views)
    median, p99 = np.percentile(errors, [50, 99], method="nearest") * 1e3 if len(errors) else (np.nan, np.nan)
    covered = sum(v.covered for v in views) / target if target else np.nan
    return TruthError(float(median), float(p99), len(errors), target, float(covered))


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
    return pool([error])
