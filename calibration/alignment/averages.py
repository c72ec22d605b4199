"""One transform from several registrations of one rig: their average, or their information-weighted fusion.

The paper aligns its cameras by "an average ICP method". Rotations are averaged on SO(3), translations about a point in the working
volume. About any other point rotation noise leaks into the working volume: by its square in the mean itself, but in full into the
distances that tell outliers and the spread (0.1 degrees are 1.4 mm at 0.8 m).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofcapture.errors import DataError
from tofcapture.poses import (
    Float64,
    exp,
    hat,
    invert,
    log,
    rotation_angle,
    rotation_exp,
    rotation_log,
    transform,
)

OUTLIER = 3.0  # times the median distance: 4.6 sigma of a 3-D Gaussian, whose median distance is 1.54 sigma
FLOOR_ROTATION = np.radians(0.05)  # below these no registration is an outlier, however well the others agree
FLOOR_TRANSLATION = 0.0005  # m
ITERATIONS = 50
STOP = 1e-12


@dataclass(frozen=True)
class Average:
    """A mean transform and how far its N inputs lie from it."""

    T: Float64  #: (4, 4) mean of the kept transforms
    kept: NDArray[np.bool_]  #: (N,) bool, False for outliers
    rotation_from_mean: Float64  #: (N,) float64, radians
    translation_from_mean: Float64  #: (N,) float64, metres, distance between the images of the working point

    @property
    def spread(self) -> tuple[float, float]:
        """Standard deviation of one registration: rotation in radians, translation at the working point in metres."""
        turned, moved = self.rotation_from_mean[self.kept], self.translation_from_mean[self.kept]
        return _deviation(turned), _deviation(moved)

    @property
    def standard_error(self) -> tuple[float, float]:
        """Spread over the root of the number kept: what the mean has, where errors are independent."""
        root = float(np.sqrt(self.kept.sum()))
        return self.spread[0] / root, self.spread[1] / root


def average_transforms(transforms: Sequence[Float64], working_point: ArrayLike) -> Average:
    """Average rigid transforms ``T_a_b`` (4, 4), without outliers.

    The translation makes the mean map the working point c (3,), frame b, metres, to the mean of its images:
    ``t = mean(R_i c + t_i) - R c``. Transforms farther from the robust centre than three times the median distance, in rotation
    or in translation, are outliers.
    """
    T = np.asarray(transforms, dtype=np.float64)
    c = np.asarray(working_point, dtype=np.float64)
    R, images = T[:, :3, :3], T[:, :3, :3] @ c + T[:, :3, 3]
    turned, moved = _distances(R, images, median_rotation(R), median_point(images))
    kept = (turned <= _limit(turned, FLOOR_ROTATION)) & (moved <= _limit(moved, FLOOR_TRANSLATION))
    rotation, image = mean_rotation(R[kept]), images[kept].mean(axis=0)
    turned, moved = _distances(R, images, rotation, image)
    return Average(transform(rotation, image - rotation @ c), kept, turned, moved)


def mean_rotation(rotations: ArrayLike) -> Float64:
    """Average rotations (N, 3, 3) by the chordal L2 mean, ``argmin_R sum_i |R - R_i|_F^2``.

    It is Markley's quaternion mean (J. Guidance 30(4), 2007; Hartley et al., IJCV 103, 2013, section 5.3).
    """
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(np.asarray(rotations)).mean().as_matrix())


def median_rotation(rotations: ArrayLike) -> Float64:
    """Find the geodesic L1 mean (3, 3) of rotations (N, 3, 3), which up to half of them cannot carry away.

    Weiszfeld's algorithm on SO(3) (Hartley, Aftab, Trumpf, CVPR 2011), started at the chordal mean.
    """
    R = np.asarray(rotations, dtype=np.float64)
    return _weiszfeld(
        mean_rotation(R),
        lambda centre: np.stack([rotation_log(r @ centre.T) for r in R]),
        lambda centre, step: np.asarray(rotation_exp(step) @ centre),
    )


def median_point(points: ArrayLike) -> Float64:
    """Find the geometric median (3,) of points (N, 3), by Weiszfeld's algorithm, started at the mean.

    From there its steps are the same in every frame: near one of the points it creeps, and where it began would still be seen.
    """
    P = np.asarray(points, dtype=np.float64)
    return _weiszfeld(
        P.mean(axis=0), lambda centre: P - centre, lambda centre, step: np.asarray(centre + step)
    )


def _weiszfeld(
    centre: Float64, offsets: Callable[[Float64], Float64], moved: Callable[[Float64, Float64], Float64]
) -> Float64:
    for _ in range(ITERATIONS):
        away = offsets(centre)
        weights = 1 / np.maximum(np.linalg.norm(away, axis=1), 1e-12)
        step = weights @ away / weights.sum()
        centre = moved(centre, step)
        if np.linalg.norm(step) < STOP:
            break
    return centre


def fuse(transforms: Sequence[Float64], informations: Sequence[Float64]) -> Float64:
    """Fuse transforms (4, 4) by their informations: ``argmin_T sum_i |log(T_i^-1 T)|^2_{H_i}``, by Gauss-Newton on SE(3).

    Each registration counts in each direction as much as it knows there. A view that slides along its board has little
    information across it and does not drag the mean that way.

    The informations (6, 6) are of the right twist of each: ``T_true = T_i exp(xi)``, xi = (rho, phi) with covariance ``H_i^-1``.
    Each may be singular; :class:`DataError` where their sum leaves a motion undetermined.
    """
    T = np.asarray(transforms[int(np.argmax([np.trace(H) for H in informations]))], dtype=np.float64)
    for _ in range(ITERATIONS):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for Ti, Hi in zip(transforms, informations, strict=True):
            e = log(invert(Ti) @ T)
            J = _right_jacobian_inverse(e)
            H += J.T @ Hi @ J
            g += J.T @ Hi @ e
        if np.linalg.cond(H) > 1e14:
            raise DataError("fusion: the views leave a motion undetermined", hint="add views that see it")
        step = -np.linalg.solve(H, g)
        T = T @ exp(step)
        if np.linalg.norm(step) < STOP:
            break
    return T


def about(information: Float64, centre: Float64) -> Float64:
    """Express an information (6, 6) of (motion of ``centre`` (3,), rotation) as one of a twist about the frame's origin."""
    A = np.eye(6)
    A[:3, 3:] = -hat(centre)  # motion of the centre = rho + phi x centre
    out: Float64 = A.T @ information @ A
    return out


def twist_about(motion: Float64, centre: Float64) -> Float64:
    """Express a motion (4, 4) as a twist (6,), (rho, phi), seen from ``centre`` (3,): rho is how far the centre moves."""
    W = transform(np.eye(3), centre)
    return log(invert(W) @ motion @ W)


def _distances(R: Float64, images: Float64, rotation: Float64, image: Float64) -> tuple[Float64, Float64]:
    turned = np.array([rotation_angle(r @ rotation.T) for r in R])
    return turned, np.linalg.norm(images - image, axis=-1)


def _limit(distance: Float64, floor: float) -> float:
    return max(floor, OUTLIER * float(np.median(distance)))


def _deviation(distance: Float64) -> float:
    return float(np.sqrt(np.square(distance).sum() / max(len(distance) - 1, 1)))


def _right_jacobian_inverse(e: Float64) -> Float64:
    """``log(exp(e) exp(d)) = e + J d``, to second order in e (Barfoot, State Estimation for Robotics, 7.86)."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = hat(e[3:])
    ad[:3, 3:] = hat(e[:3])
    out: Float64 = np.eye(6) + ad / 2 + ad @ ad / 12
    return out
