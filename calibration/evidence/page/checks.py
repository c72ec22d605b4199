"""Judge what is measured anew for the page: residuals, coverage, drift."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibration.evidence.compare import Drift
from calibration.evidence.page.charts import binned
from calibration.evidence.page.samples import Samples
from calibration.limits import Judged, judged
from tofcapture.poses import Float64

GRID = (9, 12)  # cells of the image, as in calibration.board.coverage
MOST_EMPTY = 30  # points below which a cell of the image has no median


def residual_checks(samples: Samples, wave_mm: Float64 | None) -> list[Judged]:
    """Judge what is left of the residuals over range, amplitude and the image, the rims, and the common range error."""
    if len(samples.residual) < 200:
        return [judged("bias_range", None)]
    mm = 1e3 * samples.residual
    by_range = np.abs(binned(samples.range, mm, 12)[1][:, 1]).max()
    by_amplitude = np.abs(binned(samples.amplitude, mm, 12)[1][:, 1]).max()
    cells = np.abs(image_medians(samples))
    out = [judged("bias_range", float(by_range)), judged("bias_amplitude", float(by_amplitude))]
    out.append(judged("bias_image", float(np.nanquantile(cells, 0.9))))
    out.append(judged("rims", float(np.median(np.abs(1e3 * samples.rims))) if len(samples.rims) else None))
    if wave_mm is not None:
        out.append(judged("wiggle", float(np.sqrt(np.mean(np.square(wave_mm))))))
    return out


def image_medians(samples: Samples) -> Float64:
    """Median residual (9, 12) of each cell of the image, millimetres; NaN where there are too few points."""
    rows, columns = GRID
    height, width = samples.camera.shape
    r = np.clip((samples.pixel[:, 1] + 0.5) * rows / height, 0, rows - 1).astype(int)
    c = np.clip((samples.pixel[:, 0] + 0.5) * columns / width, 0, columns - 1).astype(int)
    out = np.full(rows * columns, np.nan)
    for cell in range(rows * columns):
        inside = samples.residual[r * columns + c == cell]
        if len(inside) >= MOST_EMPTY:
            out[cell] = 1e3 * np.median(inside)
    return out.reshape(GRID)


def coverage_checks(covered: Mapping[str, Any]) -> list[Judged]:
    """Judge a coverage of :func:`calibration.board.coverage.coverage`."""
    if not covered["views"]:
        return [judged("image", 0.0)]
    return [
        judged("image", covered["image_share"]),
        judged("sectors", sum(n > 0 for n in covered["sectors"].values())),
        judged("tilt", float(np.median(covered["tilt_deg"]))),
        judged("distances", max(covered["distance_m"]) / min(covered["distance_m"])),
    ]


def drift_checks(moved: Drift) -> list[Judged]:
    """Judge a drift by its size; one that may be chance passes."""
    out = [
        judged("drift_rotation", float(np.degrees(moved.rotation))),
        judged("drift_translation", 1e3 * moved.translation),
    ]
    if moved.verdict == "PASS":
        return [Judged(c.words, c.value, c.limits, "PASS", "") for c in out]
    return out
