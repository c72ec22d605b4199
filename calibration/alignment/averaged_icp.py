"""The average of several registrations of one rig.

The paper aligns its cameras by "an average ICP method": rotations are averaged on SO(3), translations about a point in the
working volume. About any other point rotation noise leaks into the working volume: by its square in the mean itself, but in
full into the distances that tell outliers and the spread (0.1 degrees are 1.4 mm at 0.8 m).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import DataError
from tofcapture.poses import Float64, rotation_angle, rotation_exp, rotation_log, transform

OUTLIER = 3.0  # times the median distance: 4.6 sigma of a 3-D Gaussian, whose median distance is 1.54 sigma
FLOOR_ROTATION = np.radians(0.05)  # below these no registration is an outlier, however well the others agree
FLOOR_TRANSLATION = 0.0005  # m


@dataclass(frozen=True)
class Average:
    """A mean transform and how far its inputs lie from it.

    Attributes
    ----------
    T
        (4, 4) mean of the kept transforms.
    kept
        (N,) bool, False for outliers.
    rotation_from_mean
        (N,) float64, radians.
    translation_from_mean
        (N,) float64, metres, distance between the images of the working point.
    """

    T: Float64
    kept: NDArray[np.bool_]
    rotation_from_mean: Float64
    translation_from_mean: Float64

    @property
    def spread(self) -> tuple[float, float]:
        """Standard deviation of one registration: rotation in radians, translation at the working point in metres."""
        return _deviation(self.rotation_from_mean[self.kept]), _deviation(
            self.translation_from_mean[self.kept]
        )

    @property
    def standard_error(self) -> tuple[float, float]:
        """Spread over the root of the number kept: what the mean has, where errors are independent."""
        root = float(np.sqrt(self.kept.sum()))
        return self.spread[0] / root, self.spread[1] / root


def mean_rotation(rotations: ArrayLike, weights: ArrayLike | None = None) -> Float64:
    """Chordal L2 mean of rotations, the same as Markley's quaternion mean.

    ``argmin_R sum_i w_i |R - R_i|_F^2``: the rotation nearest to the weighted sum, found by SVD (Markley et al., J. Guidance
    30(4), 2007; Hartley et al., IJCV 103, 2013, section 5.3).

    Parameters
    ----------
    rotations
        (N, 3, 3), N >= 1.
    weights
        (N,), not negative, not all zero; equal when None.

    Returns
    -------
    (3, 3) float64

    Raises
    ------
    DataError
        No rotations, wrong shapes, or weights that determine no mean.
    """
    R = np.asarray(rotations, dtype=np.float64)
    if R.ndim != 3 or R.shape[1:] != (3, 3) or len(R) == 0:
        raise DataError(f"mean rotation: expected (N, 3, 3) with N >= 1, got shape {R.shape}")
    w = _weights(weights, len(R))
    U, singular, Vt = np.linalg.svd(np.einsum("n,nij->ij", w, R))
    handed = np.array([1.0, 1.0, np.linalg.det(U @ Vt)])
    if singular[1] + handed[2] * singular[2] < 1e-9:
        raise DataError("mean rotation: the rotations are spread so far that they have no mean")
    out: Float64 = (U * handed) @ Vt
    return out


def median_rotation(rotations: ArrayLike, iterations: int = 50) -> Float64:
    """Geodesic L1 mean of rotations (3, 3), which up to half of them cannot carry away.

    Weiszfeld's algorithm on SO(3) (Hartley, Aftab, Trumpf, CVPR 2011), started at the chordal mean.

    Parameters
    ----------
    rotations
        (N, 3, 3), N >= 1.
    iterations
        Most steps to take.
    """
    R = np.asarray(rotations, dtype=np.float64)
    centre = mean_rotation(R)
    for _ in range(iterations):
        offsets = np.stack([rotation_log(r @ centre.T) for r in R])
        step = _weiszfeld_step(offsets)
        centre = rotation_exp(step) @ centre
        if np.linalg.norm(step) < 1e-12:
            break
    return centre


def median_point(points: ArrayLike, iterations: int = 50) -> Float64:
    """Geometric median (3,) of points (N, 3), by Weiszfeld's algorithm from the component-wise median."""
    P = np.asarray(points, dtype=np.float64)
    centre = np.median(P, axis=0)
    for _ in range(iterations):
        step = _weiszfeld_step(P - centre)
        centre = centre + step
        if np.linalg.norm(step) < 1e-12:
            break
    return np.asarray(centre)


def average_transforms(
    transforms: Sequence[Float64], working_point: ArrayLike, weights: ArrayLike | None = None
) -> Average:
    """Average rigid transforms ``T_a_b``, without outliers.

    The rotation is :func:`mean_rotation`; the translation makes the mean map the working point c to the mean of its images:
    ``t = mean(R_i c + t_i) - R c``. Transforms farther from the robust centre than three times the median distance, in
    rotation or in translation, are outliers.

    Parameters
    ----------
    transforms
        N of (4, 4), N >= 1.
    working_point
        (3,) in frame b, metres: where the transform must be good.
    weights
        (N,), not negative; equal when None.

    Returns
    -------
    Average

    Raises
    ------
    DataError
        No transforms or wrong shapes.
    """
    T = np.asarray(transforms, dtype=np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4) or len(T) == 0:
        raise DataError(f"average: expected (N, 4, 4) with N >= 1, got shape {T.shape}")
    c = np.asarray(working_point, dtype=np.float64)
    w = _weights(weights, len(T))
    R, images = T[:, :3, :3], T[:, :3, :3] @ c + T[:, :3, 3]
    turned, moved = _distances(R, images, median_rotation(R), median_point(images))
    kept = (turned <= _limit(turned, FLOOR_ROTATION)) & (moved <= _limit(moved, FLOOR_TRANSLATION))
    rotation = mean_rotation(R[kept], w[kept])
    image = np.average(images[kept], axis=0, weights=w[kept])
    turned, moved = _distances(R, images, rotation, image)
    return Average(transform(rotation, image - rotation @ c), kept, turned, moved)


def _distances(R: Float64, images: Float64, rotation: Float64, image: Float64) -> tuple[Float64, Float64]:
    turned = np.array([rotation_angle(r @ rotation.T) for r in R])
    return turned, np.linalg.norm(images - image, axis=-1)


def _limit(distance: Float64, floor: float) -> float:
    return max(floor, OUTLIER * float(np.median(distance)))


def _deviation(distance: Float64) -> float:
    return float(np.sqrt(np.square(distance).sum() / max(len(distance) - 1, 1)))


def _weiszfeld_step(offsets: Float64) -> Float64:
    weights = 1 / np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
    out: Float64 = weights @ offsets / weights.sum()
    return out


def _weights(weights: ArrayLike | None, count: int) -> Float64:
    w = np.ones(count) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (count,) or not (w >= 0).all() or not w.sum() > 0:
        raise DataError(f"weights: expected {count} numbers >= 0, not all zero, got {w.tolist()}")
    out: Float64 = w / w.sum()
    return out
