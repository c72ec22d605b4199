"""Depth and normal metrics as sums and counts, so that they add over batches, views and processes.

A pixel without an answer (depth or normal not finite, or a normal of length zero) is in no mean: it is not covered, and
counted as ``refused``.

``pixel`` pools all pixels, ``image`` averages the value of every image; both are reported, because they differ as soon as
masks do. Lengths are metres, keys that end in ``_deg`` degrees, in ``_pct`` percent; fractions are in [0, 1];
``rmse_log`` (natural logarithm), ``one_minus_cos`` and ``comp_mae`` have no unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

Row = dict[str, float]

_DEPTH_BIN = 1e-4  # m; medians are exact to half of it
_ANGLE_BIN = 0.01  # deg
_BINS = 20_000  # 2 m, 200 deg
_LEAST = 1e-3  # m; the logarithm of a depth below is that of a millimetre

DEPTH_TERMS: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = {
    "abs": lambda d, g: (d - g).abs() / g,
    "sq": lambda d, g: (d - g).square() / g,
    "square": lambda d, g: (d - g).square(),
    "square_log": lambda d, g: (d.clamp_min(_LEAST) / g).log().square(),
    "mae": lambda d, g: (d - g).abs(),
    "bias": lambda d, g: d - g,
    **{f"within_{mm}mm": lambda d, g, t=mm / 1000: ((d - g).abs() < t).double() for mm in (5, 10, 20, 50)},  # type: ignore[misc]
    **{f"delta_{k}": lambda d, g, t=1.25**k: ((d < t * g) & (t * d > g)).double() for k in (1, 2, 3)},  # type: ignore[misc]
}
"""Per-pixel terms of predicted depth and ground truth, float64 metres; each column of the table is a mean of one."""

ANGLE_TERMS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "mean_deg": lambda a: a,
    "square": lambda a: a.square(),
    "one_minus_cos": lambda a: 2 * torch.deg2rad(a / 2).sin().square(),
    **{f"within_{t:g}deg": lambda a, t=t: (a < t).double() for t in (5, 7.5, 11.25, 20, 22.5, 30)},  # type: ignore[misc]
}
"""Per-pixel terms of the angle between normals, degrees."""


def angles_deg(normals: Tensor, gt: Tensor) -> Tensor:
    """Angle in degrees between (..., 3, N) vectors of any length; exact near 0 and 180, where the cosine is not."""
    a, b = normals.double(), gt.double()
    cross = torch.linalg.cross(a, b, dim=-2).norm(dim=-2)
    return torch.rad2deg(torch.atan2(cross, (a * b).sum(-2)))


def component_error(normals: Tensor, gt: Tensor) -> Tensor:
    """Mean absolute difference (..., N) of the components of (..., 3, N) vectors of any length, once they are unit."""
    a, b = (torch.nn.functional.normalize(x.double(), dim=-2) for x in (normals, gt))
    return (a - b).abs().mean(-2)


@dataclass
class Pool:
    """Sums of per-pixel terms over the masks of images, and what becomes of them.

    Attributes
    ----------
    sums, count
        Over pixels.
    image_sums, images
        Over images with at least one pixel.
    histogram
        (bins,) counts of the value whose median is asked for, in the host's memory.
    measured, refused, wanted
        Pixels that the method covers, pixels without an answer, and pixels of the mask.
    """

    sums: dict[str, float] = field(default_factory=dict)
    count: int = 0
    image_rows: dict[str, float] = field(default_factory=dict)
    images: int = 0
    histogram: Tensor = field(default_factory=lambda: torch.zeros(_BINS, dtype=torch.float64))
    measured: int = 0
    refused: int = 0
    wanted: int = 0

    def add(
        self, terms: Mapping[str, Tensor], values: Tensor, width: float, finish: Callable[[Row], Row]
    ) -> None:
        """Add one image: per-pixel terms (N,), the non-negative values (N,) of the median, its bin width."""
        if len(values) == 0:
            return
        sums = {k: float(v.sum()) for k, v in terms.items()}
        row = finish({k: v / len(values) for k, v in sums.items()} | {"median": float(values.median())})
        self.sums = {k: self.sums.get(k, 0.0) + v for k, v in sums.items()}
        self.image_rows = {k: self.image_rows.get(k, 0.0) + v for k, v in row.items()}
        self.count, self.images = self.count + len(values), self.images + 1
        counts = torch.bincount((values / width).long().clamp_max(_BINS - 1), minlength=_BINS)
        self.histogram += counts.cpu()

    def means(self, width: float, finish: Callable[[Row], Row]) -> dict[str, Row]:
        """Both poolings of every column, and how much they stand on."""
        if self.count == 0:
            none = {"coverage": 0.0, "refused": self.refused} if self.refused else {}
            return {"pixel": {"pixels": 0, **none}, "image": {"images": 0, **none}}
        pixel = finish({k: v / self.count for k, v in self.sums.items()} | {"median": self._median(width)})
        image = {k: v / self.images for k, v in self.image_rows.items()}
        told = {"coverage": self.measured / max(self.wanted, 1), "refused": self.refused}
        return {
            "pixel": pixel | {"pixels": self.count, **told},
            "image": image | {"images": self.images, **told},
        }

    def _median(self, width: float) -> float:
        return (int(torch.searchsorted(self.histogram.cumsum(0), self.count / 2)) + 0.5) * width


def _finish_depth(row: Row) -> Row:
    row["rmse"] = math.sqrt(row.pop("square"))
    row["rmse_log"] = math.sqrt(row.pop("square_log"))
    return row


def _finish_angle(row: Row) -> Row:
    row["rmse_deg"] = math.sqrt(row.pop("square"))
    row["median_deg"] = row.pop("median")
    row["paper_normal_mae"] = math.radians(row["mean_deg"])
    row["paper_bad20_pct"] = 100 * (1 - row["within_20deg"])
    return row


@dataclass
class Score:
    """Metrics of one method over many frames."""

    depth: Pool = field(default_factory=Pool)
    normal: Pool = field(default_factory=Pool)

    def add(
        self,
        depth: Tensor,
        normals: Tensor,
        gt_depth: Tensor,
        gt_normals: Tensor,
        mask: Tensor,
        measured: Tensor,
    ) -> None:
        """Add a batch.

        Parameters
        ----------
        depth, gt_depth
            (B, 1, H, W) metres.
        normals, gt_normals
            (B, 3, H, W), any length.
        mask
            (B, 1, H, W) bool: where the ground truth is good.
        measured
            (B, 1, H, W) bool: where the method answers by itself, and not by a neighbour; only counted, as coverage.
        """
        for d, n, gd, gn, m, seen in zip(depth, normals, gt_depth, gt_normals, mask, measured, strict=True):
            answered = d[0].isfinite() & n.isfinite().all(0) & (n != 0).any(0)
            at = m[0] & answered
            self._add_image(d[0][at].double(), n[:, at], gd[0][at].double(), gn[:, at])
            wanted, answers, measures = (int(x.sum()) for x in (m[0], at, at & seen[0]))
            for pool in (self.depth, self.normal):
                pool.wanted += wanted
                pool.refused += wanted - answers
                pool.measured += measures

    def _add_image(self, d: Tensor, n: Tensor, gd: Tensor, gn: Tensor) -> None:
        self.depth.add(
            {k: term(d, gd) for k, term in DEPTH_TERMS.items()}, (d - gd).abs(), _DEPTH_BIN, _finish_depth
        )
        angle = angles_deg(n, gn)
        terms = {k: term(angle) for k, term in ANGLE_TERMS.items()} | {"comp_mae": component_error(n, gn)}
        self.normal.add(terms, angle, _ANGLE_BIN, _finish_angle)

    def table(self) -> dict[str, dict[str, Row]]:
        """``{"depth": {"pixel": {...}, "image": {...}}, "normal": {...}}``."""
        return {
            "depth": self.depth.means(_DEPTH_BIN, _finish_depth),
            "normal": self.normal.means(_ANGLE_BIN, _finish_angle),
        }
