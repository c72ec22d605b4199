"""Count what stands on the table, and nothing else: pixels by their height above the support, errors by object and by camera.

The object crop of a dataset begins a fraction of a millimetre above the table, so sheets of paper lie in it. They are a class of
their own here, and so is the table around.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tofcapture.ops.crop import dominant_plane
from tofcapture_model.evaluation.metrics import Row, angles_deg
from tofcapture_model.frame import Target
from tofcapture_model.geometry.maps import scale_intrinsics, unproject

HEIGHT = 0.004  # m above the support, from which a pixel is an object's
SIGMAS = 4.0  # of the ground truth on the support; the height is at least so many
_RING = 40  # px about the crop, whose surface tells the support
RATIOS = ("mae", "rmse", "angle")
_WORDS = dict(zip(RATIOS, ("MAE", "RMSE", "normals"), strict=True))
_TINY = 1e-9
_FEWEST = 500  # px of it that are enough
_NORMAL_SIGMA = (
    1.4826  # standard deviation of a normal distribution in units of its median absolute deviation
)


class Support(NamedTuple):
    """The plane ``normal . p = offset`` that objects stand on, ToF frame, metres; ``sigma`` is the ground truth's scatter about it."""

    normal: Tensor
    offset: float
    sigma: float


def find_support(target: Target, intrinsics: Tensor) -> Support | None:
    """Fit the plane of the measured surface around the object crop of one view (1, 1, 2H, 2W); ``None`` where there is none.

    A view that nothing was cropped from has no such surface.
    """
    around = target.context & _near(target.good)
    points = unproject(target.depth, scale_intrinsics(intrinsics, 2))[0][:, around[0, 0]].T.double()
    if len(points) < _FEWEST:
        return None
    found = dominant_plane(points.cpu().numpy(), np.random.default_rng(0))
    if found is None:
        return None
    normal, offset = torch.from_numpy(found[0]).to(points), found[1]
    apart = points @ normal - offset
    apart = apart[apart.abs() < HEIGHT]
    sigma = _NORMAL_SIGMA * float((apart - apart.median()).abs().median())
    return Support(normal, offset + float(apart.median()), sigma)


def _near(mask: Tensor) -> Tensor:
    """Pixels within a ring about a mask, or all where it is empty."""
    rows, cols = mask[0, 0].any(1).nonzero(), mask[0, 0].any(0).nonzero()
    if not len(rows):
        return torch.ones_like(mask)
    out = torch.zeros_like(mask)
    top, left = (max(int(x[0]) - _RING, 0) for x in (rows, cols))
    out[..., top : int(rows[-1]) + _RING + 1, left : int(cols[-1]) + _RING + 1] = True
    return out


def classes(target: Target, intrinsics: Tensor, support: Support | None) -> dict[str, Tensor]:
    """Masks (1, 1, 2H, 2W) of one view: ``object``, ``sheet`` (in the crop, but flat on the support) and ``support`` (around it).

    Without a support all of the crop is the object.
    """
    nothing = torch.zeros_like(target.good)
    if support is None:
        return {"object": target.good, "sheet": nothing, "support": nothing}
    points = unproject(target.depth, scale_intrinsics(intrinsics, 2)).double()
    normal = support.normal.to(points)[None, :, None, None]
    height = (points * normal).sum(1, keepdim=True) - support.offset
    least = max(HEIGHT, SIGMAS * support.sigma)
    return {
        "object": target.good & (height.abs() >= least),
        "sheet": target.good & (height.abs() < least),
        "support": target.context & (height.abs() < least),
    }


@dataclass(frozen=True)
class Tally:
    """Sums over pixels of one method; they add.

    Attributes
    ----------
    wanted, pixels
        Pixels of the mask, and those of them that have an answer.
    error, square, angle
        Sums of absolute depth errors in metres, of their squares, and of the angles between normals in degrees.
    told, inside
        Pixels with a predicted sigma, and those whose error is within it.
    """

    wanted: float = 0
    pixels: float = 0
    error: float = 0
    square: float = 0
    angle: float = 0
    told: float = 0
    inside: float = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def row(self) -> dict[str, float]:
        """``mae``, ``rmse`` in metres, ``angle`` in degrees, and ``within_sigma``, a share, where a sigma was predicted."""
        n = self.pixels or float("nan")
        cover = {"within_sigma": self.inside / self.told} if self.told else {}
        return {
            "mae": self.error / n,
            "rmse": (self.square / n) ** 0.5,
            "angle": self.angle / n,
            **cover,
        }


def tally(depth: Tensor, normals: Tensor, sigma: Tensor | None, target: Target, mask: Tensor) -> Tally:
    """Sum up one view: depth, sigma and mask (1, 1, 2H, 2W), normals (1, 3, 2H, 2W)."""
    at = mask & depth.isfinite() & normals.isfinite().all(1, keepdim=True)
    off = (depth - target.depth)[at].abs().double()
    where = at[:, 0]
    angle = angles_deg(normals.movedim(1, -1)[where].T, target.normals.movedim(1, -1)[where].T)
    known = torch.zeros_like(off, dtype=torch.bool) if sigma is None else sigma[at].isfinite()
    inside = 0.0 if sigma is None else float((off <= sigma[at])[known].sum())
    return Tally(
        float(mask.sum()), len(off), float(off.sum()), float(off.square().sum()),
        float(angle.sum()), float(known.sum()), inside,
    )  # fmt: skip


class Objects:
    """Sums by class of pixels, by object (a scene's), and by camera, of several methods; the first is the one that the others are held against.

    ``cameras`` is the serial number by scene.
    """

    def __init__(self, cameras: Mapping[str, str]) -> None:
        self._cameras = cameras
        self._sums: dict[tuple[str, str, str], Tally] = {}  # of (class, scene, method)

    def add(
        self,
        scene: str,
        method: str,
        answer: tuple[Tensor, Tensor, Tensor | None],
        target: Target,
        where: Mapping[str, Tensor],
    ) -> None:
        """Add a frame: depth, normals and predicted sigma of a method, and the masks of :func:`classes`."""
        for name, mask in where.items():
            key = name, scene, method
            self._sums[key] = self._sums.get(key, Tally()) + tally(*answer, target, mask)

    def _pooled(self, kind: str, by: Callable[[str], str]) -> dict[str, dict[str, Row]]:
        """Rows by group and method of one class; groups without a pixel are left out."""
        sums: dict[str, dict[str, Tally]] = {}
        for (name, scene, method), one in self._sums.items():
            if name == kind:
                group = sums.setdefault(by(scene), {})
                group[method] = group.get(method, Tally()) + one
        return {
            key: {method: one.row() | {"pixels": one.wanted} for method, one in group.items()}
            for key, group in sums.items()
            if all(one.pixels for one in group.values())
        }

    def table(self) -> dict[str, Any]:
        """``classes``, ``objects`` and ``cameras``: rows by their name and by method; ``spread``: of the ratios, see :func:`spread`."""
        kinds = dict.fromkeys(name for name, _, _ in self._sums)
        found = {kind: self._pooled(kind, lambda _scene: kind) for kind in kinds}  # noqa: B023
        objects = self._pooled("object", lambda scene: scene)
        return {
            "classes": {kind: rows[kind] for kind, rows in found.items() if rows},
            "objects": objects,
            "cameras": self._pooled("object", lambda scene: self._cameras[scene]),
            "spread": spread(objects),
        }


def spread(groups: Mapping[str, Mapping[str, Row]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Median, 90th percentile and worst of each method's ratios to the first one, over groups such as objects; by method and column.

    ``groups`` are rows by name and method; ``worst_of`` names the worst one.
    """
    out: dict[str, dict[str, dict[str, Any]]] = {}
    methods = list(next(iter(groups.values()), {}))
    for method in methods[1:]:
        for key in RATIOS:
            each = {
                name: rows[method][key] / max(rows[methods[0]][key], _TINY) for name, rows in groups.items()
            }
            values, worst = list(each.values()), max(each, key=each.__getitem__)
            out.setdefault(method, {})[key] = {
                "median": float(np.median(values)),
                "p90": float(np.quantile(values, 0.9)),
                "worst": each[worst],
                "worst_of": worst,
            }
    return out


def told(results: Mapping[str, Any]) -> list[str]:
    """Say for people what :meth:`Objects.table` holds: shares, and what of the sensor's errors is left; crop: all above the table."""
    kinds = results["classes"]
    whole = next((row["pixels"] for row in kinds.get("crop", {}).values()), 0.0)
    lines = [
        "",
        f"{'pixels':24} {'share':>6} {'MAE mm':>8} {'model':>7} {'MAE':>6} {'RMSE':>6} {'normals':>8} {'1 sigma':>8}",
    ]
    for name, rows in [*kinds.items(), *((f"camera {k}", v) for k, v in results["cameras"].items())]:
        share = next(iter(rows.values()))["pixels"] / whole if whole else float("nan")
        lines.append(f"{name:24} {share:6.0%} {_ratios(rows)}")
    for method, columns in results["spread"].items():
        for key, row in columns.items():
            lines.append(
                f"{method}, {_WORDS[key]} over the sensor's by object: median {row['median']:.2f}, 90 % {row['p90']:.2f}, "
                f"worst {row['worst']:.2f} ({row['worst_of']})"
            )
    return lines


def _ratios(rows: Mapping[str, Row]) -> str:
    sensor, model = rows["sensor"], rows["model"]
    left = {key: model[key] / max(sensor[key], _TINY) for key in RATIOS}
    cover = f"{100 * model['within_sigma']:7.1f}%" if "within_sigma" in model else f"{'–':>8}"
    return f"{1e3 * sensor['mae']:8.2f} {1e3 * model['mae']:7.2f} {left['mae']:6.2f} {left['rmse']:6.2f} {left['angle']:8.2f} {cover}"
