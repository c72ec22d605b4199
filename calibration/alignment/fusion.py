"""Information-weighted fusion of rigid transforms.

``argmin_T sum_i |log(T_i^-1 T)|^2_{H_i}``: each registration counts in each direction as much as it knows there. A view that
slides along its board has little information across it and does not drag the mean that way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofcapture.errors import DataError
from tofcapture.poses import Float64, exp, hat, invert, log, transform

ITERATIONS = 30
STOP = 1e-13


@dataclass(frozen=True)
class Fusion:
    """A fused transform.

    Attributes
    ----------
    T
        (4, 4).
    information
        (6, 6) sum of the informations at ``T``, of the right twist (rho, phi): ``T exp(xi)``.
    chi2
        ``sum |log(T_i^-1 T)|^2_{H_i}``; about 6 (N - 1) where the informations tell the truth.
    """

    T: Float64
    information: Float64
    chi2: float


def fuse(transforms: Sequence[Float64], informations: Sequence[Float64]) -> Fusion:
    """Fuse transforms by Gauss-Newton on SE(3).

    Parameters
    ----------
    transforms
        N of (4, 4), N >= 1.
    informations
        N of (6, 6), symmetric, not negative, of the right twist of each: ``T_true = T_i exp(xi)``, xi = (rho, phi) with
        covariance ``H_i^-1``. Each may be singular, their sum may not.

    Raises
    ------
    DataError
        No transforms, as many informations, or a motion that none of them determines.
    """
    if len(transforms) == 0 or len(transforms) != len(informations):
        raise DataError(
            f"fusion: expected as many informations as transforms, got {len(informations)}, {len(transforms)}"
        )
    T = np.asarray(transforms[int(np.argmax([np.trace(H) for H in informations]))], dtype=np.float64)
    for _ in range(ITERATIONS):
        H, g, chi2 = _equations(T, transforms, informations)
        if np.linalg.cond(H) > 1e14:
            raise DataError(
                "fusion: the informations leave a motion undetermined", hint="add views that see it"
            )
        step = -np.linalg.solve(H, g)
        T = T @ exp(step)
        if np.linalg.norm(step) < STOP:
            break
    H, _, chi2 = _equations(T, transforms, informations)
    return Fusion(T, H, chi2)


def about(information: Float64, centre: Float64) -> Float64:
    """Information (6, 6) of a twist about the frame's origin, from one of (motion of ``centre`` (3,), rotation)."""
    A = np.eye(6)
    A[:3, 3:] = -hat(centre)  # motion of the centre = rho + phi x centre
    out: Float64 = A.T @ information @ A
    return out


def twist_about(motion: Float64, centre: Float64) -> Float64:
    """Twist (6,), (rho, phi), of a motion (4, 4) as seen from ``centre`` (3,): rho is how far the centre moves."""
    W = transform(np.eye(3), centre)
    return log(invert(W) @ motion @ W)


def jackknife(left_out: Float64) -> tuple[Float64, Float64]:
    """What leaving views out says of a result.

    Parameters
    ----------
    left_out
        (N, 6) results without each of the views in turn, as twists from any fixed transform near them.

    Returns
    -------
    influence
        (N, 6) how far each view alone departs from all: Tukey's pseudo-values about their mean.
    covariance
        (6, 6), widened by Student's t so that one sigma holds 68 % of the time however few the views are.
    """
    from scipy.stats import norm, t

    n = len(left_out)
    influence: Float64 = (n - 1) * (left_out.mean(axis=0) - left_out)
    widened = float(t.ppf(norm.cdf(1.0), n - 1)) ** 2
    return influence, widened * influence.T @ influence / (n * (n - 1))


def _equations(
    T: Float64, transforms: Sequence[Float64], informations: Sequence[Float64]
) -> tuple[Float64, Float64, float]:
    H, g, chi2 = np.zeros((6, 6)), np.zeros(6), 0.0
    for Ti, Hi in zip(transforms, informations, strict=True):
        e = log(invert(Ti) @ T)
        J = _right_jacobian_inverse(e)
        H += J.T @ Hi @ J
        g += J.T @ Hi @ e
        chi2 += float(e @ Hi @ e)
    return H, g, chi2


def _right_jacobian_inverse(e: Float64) -> Float64:
    """``log(exp(e) exp(d)) = e + J d``, to second order in e (Barfoot, State Estimation for Robotics, 7.86)."""
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = hat(e[3:])
    ad[:3, 3:] = hat(e[:3])
    out: Float64 = np.eye(6) + ad / 2 + ad @ ad / 12
    return out
