"""What the suites measure beyond the columns of the tables: regions, repeatability, and what a predicted uncertainty is worth."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Frame, Target
from tofcapture_model.geometry.maps import scale_intrinsics, unproject

EDGE_BAND = 5  # px at the output resolution, on either side of a step
EDGE_STEP = 0.03  # m between a pixel and its neighbour's plane
_VEILED = 5  # px; a masked rim up to so wide may hide a step
STRONG_MPI = 0.005  # m of expected interreflection error, from which a pixel counts as one with multipath
DARK = 0.02  # of saturation: amplitude of the high frequency below which a pixel is noisy
_PARTS = 20  # of the sparsification curve


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
    """Where there is ground truth, masked or not: :func:`tofcapture_model.data.make_target` gives the rest 1 m and (0, 0, -1)."""
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
