"""What the suites measure beyond the columns of the tables: regions, repeatability, and what a predicted uncertainty is worth."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from tofcapture_model.frame import Frame, Target

EDGE_BAND = 5  # px at the output resolution
EDGE_STEP = 0.03  # m
STRONG_MPI = 0.005  # m of expected interreflection error, from which a pixel counts as one with multipath
DARK = 0.02  # of saturation: amplitude of the high frequency below which a pixel is noisy
_PARTS = 20  # of the sparsification curve


def regions(frame: Frame, target: Target) -> dict[str, Tensor]:
    """Masks (B, 1, 2H, 2W) bool of good ground truth: all, near depth edges or not, with much multipath or little, dark or bright."""
    known = target.good | target.context
    size, band = 2 * EDGE_BAND + 1, EDGE_BAND
    most = F.max_pool2d(torch.where(known, target.depth, -torch.inf), size, 1, band)
    least = -F.max_pool2d(torch.where(known, -target.depth, -torch.inf), size, 1, band)
    edge = (most - least) > EDGE_STEP
    mpi = _doubled(frame.cues[:, :1].abs()) > STRONG_MPI
    dark = _doubled(frame.confidence) < DARK
    cases = {
        "all": known,
        "edge": edge,
        "interior": ~edge,
        "mpi": mpi,
        "no-mpi": ~mpi,
        "dark": dark,
        "bright": ~dark,
    }
    return {name: target.good & where for name, where in cases.items()}


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
        """Add one image: absolute errors (N,) and predicted sigmas (N,), metres, or any number that grows with the expected error."""
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
    """Spread of a view's frames: standard deviation over the shots per pixel, averaged over the good ones."""

    total: float = 0.0
    views: int = 0
    _shots: list[Tensor] = field(default_factory=list)

    def add(self, depth: Tensor) -> None:
        """Add the depths (N,) of one frame of the present view at its good pixels."""
        self._shots.append(depth)

    def close(self) -> None:
        """End the present view."""
        if len(self._shots) > 1 and len(self._shots[0]):
            self.total += float(torch.stack(self._shots).std(0).mean())
            self.views += 1
        self._shots = []

    def row(self) -> dict[str, float]:
        """``precision``: metres; absent where no view has two frames."""
        return {"precision": self.total / self.views} if self.views else {}
