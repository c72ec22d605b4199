"""Depth and normal metrics as sums and counts, so that they add over batches, views and processes.

A pixel without an answer (depth or normal not finite, or a normal of length zero) is in no mean: it lowers the coverage and is
counted as ``refused``. ``pixel`` pools all pixels, ``image`` averages the value of every image. Lengths are metres, keys that end in
``_deg`` degrees, in ``_pct`` percent; fractions are in [0, 1]; ``rmse_log``, ``one_minus_cos`` and ``comp_mae`` have no unit.

The suites measure more: regions, repeatability, and what a predicted uncertainty is worth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Frame, Target
from tofcapture_model.geometry.maps import scale_intrinsics, unproject

Row = dict[str, float]

EDGE_BAND = 5  # px at the output resolution, on either side of a step
EDGE_STEP = 0.03  # m between a pixel and its neighbour's plane
_VEILED = 5  # px; a masked rim up to so wide may hide a step
STRONG_MPI = 0.005  # m of expected interreflection error, from which a pixel counts as one with multipath
DARK = 0.02  # of saturation: amplitude of the high frequency below which a pixel is noisy
_PARTS = 20  # of the sparsification curve

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
    a, b = (F.normalize(x.double(), dim=-2) for x in (normals, gt))
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


def regions(frame: Frame, target: Target) -> dict[str, Tensor]:
    """Masks (B, 1, 2H, 2W) bool of good ground truth: all, near depth edges or not, with much multipath or little, dark or bright."""
    # Both pixels of a step are the first of their band.
    edge = _dilated(steps(target, frame.intrinsics), EDGE_BAND - 1)
    mpi = _doubled(frame.cues[:, :1].abs()) > STRONG_MPI
    dark = _doubled(frame.confidence) < DARK
    cases = {
        "all": target.good,
        "edge": edge,
        "interior": ~edge,
        "mpi": mpi,
        "no-mpi": ~mpi,
        "dark": dark,
        "bright": ~dark,
    }
    return {name: target.good & where for name, where in cases.items()}


def steps(target: Target, intrinsics: Tensor) -> Tensor:
    """Pixels (B, 1, 2H, 2W) bool on either side of a step, or in the middle of the masked rim that hides one.

    A step is a pair of pixels of a row or a column, each more than 3 cm off the other's tangent plane: slopes and creases
    are none. Masked pixels that have depth count. The pixels of a pair are neighbours, or only masked ones are between them.

    Parameters
    ----------
    target
        Ground truth.
    intrinsics
        (B, 4) of the frame, at the sensor's resolution.
    """
    points, normals = unproject(target.depth, scale_intrinsics(intrinsics, 2)), target.normals
    hit = _hit(target)
    out = torch.zeros_like(hit)
    for apart in range(1, _VEILED + 2):
        veiled = ~(target.good | target.context | out)
        for axis in (-1, -2):
            n = hit.shape[axis] - apart
            if n < 1:
                continue
            delta = points.narrow(axis, apart, n) - points.narrow(axis, 0, n)
            ends = [(normals.narrow(axis, at, n) * delta).sum(1, keepdim=True).abs() for at in (0, apart)]
            pair = hit.narrow(axis, 0, n) & hit.narrow(axis, apart, n) & (torch.minimum(*ends) > EDGE_STEP)
            for at in range(1, apart):
                pair &= veiled.narrow(axis, at, n)
            for at in {apart // 2, (apart + 1) // 2}:
                out.narrow(axis, at, n).logical_or_(pair)
    return out


def _dilated(mask: Tensor, reach: int) -> Tensor:
    rows = F.max_pool2d(mask.float(), (1, 2 * reach + 1), 1, (0, reach))
    return F.max_pool2d(rows, (2 * reach + 1, 1), 1, (reach, 0)) > 0


def _hit(target: Target) -> Tensor:
    """Tell where there is ground truth, masked or not: :func:`tofcapture_model.data.make_target` gives the rest 1 m and (0, 0, -1)."""
    placeholder = (target.depth == 1) & (target.normals[:, 2:] == -1)
    return target.good | target.context | ~placeholder


def _doubled(image: Tensor) -> Tensor:
    return F.interpolate(image, scale_factor=2, mode="nearest")


@dataclass
class Uncertainty:
    """Calibration of a predicted error and its order, over images.

    Attributes
    ----------
    inside, count
        Pixels whose error is within the predicted sigma, and all.
    ause
        Sum over images of the area between the sparsification curve and the best possible one, in units of the image's MAE.
    images
        Number of images.
    """

    inside: int = 0
    count: int = 0
    ause: float = 0.0
    images: int = 0

    def add(self, error: Tensor, sigma: Tensor) -> None:
        """Add one image: absolute errors (N,) and predicted sigmas (N,), metres, or any number that grows with the expected error.

        Pixels where either is not finite are left out: the tables count them as ``refused``.
        """
        known = error.isfinite() & sigma.isfinite()
        error, sigma = error[known], sigma[known]
        if len(error) < _PARTS:
            return
        self.inside += int((error <= sigma).sum())
        self.count, self.images = self.count + len(error), self.images + 1
        mean = error.mean().clamp_min(1e-12)
        gap = _sparsified(error, sigma) - _sparsified(error, error)
        self.ause += float((gap / mean).mean())

    def row(self, *, scale: bool = True) -> dict[str, float]:
        """``coverage_1sigma`` (absent where the order alone has a meaning) and ``ause``."""
        if not self.images:
            return {}
        cover = {"coverage_1sigma": self.inside / self.count} if scale else {}
        return cover | {"ause": self.ause / self.images}


def _sparsified(error: Tensor, key: Tensor) -> Tensor:
    """Mean error of what is left when 0, 5, ... 95 % with the largest key are gone."""
    kept = error[key.argsort(stable=True)].double().cumsum(0)
    ends = (torch.linspace(1, 1 / _PARTS, _PARTS, device=error.device) * len(error)).long().clamp_min(1)
    return (kept[ends - 1] / ends).float()


@dataclass
class Precision:
    """Spread of a view's frames: standard deviation over the shots per pixel, averaged over the good ones with an answer in each."""

    total: float = 0.0
    views: int = 0
    _shots: list[Tensor] = field(default_factory=list)

    def add(self, depth: Tensor) -> None:
        """Add the depths (N,) of one frame of the present view at its good pixels."""
        self._shots.append(depth)

    def close(self) -> None:
        """End the present view."""
        if len(self._shots) > 1:
            shots = torch.stack(self._shots)
            shots = shots[:, shots.isfinite().all(0)]
            if shots.numel():
                self.total += float(shots.std(0).mean())
                self.views += 1
        self._shots = []

    def row(self) -> dict[str, float]:
        """``precision``: metres; absent where no view has two frames."""
        return {"precision": self.total / self.views} if self.views else {}
