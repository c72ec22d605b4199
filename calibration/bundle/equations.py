"""Residuals of the bundle and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.closed_form import invert_all, rotation_vectors
from tofcapture.poses import Float64, log

FREEDOM = 8.0  # degrees of freedom of Student's t: efficient on Gaussian noise, and outliers lose their vote


@dataclass(frozen=True)
class Observations:
    """K board fits over N arm poses.

    Attributes
    ----------
    arm
        (N, 4, 4) T_base_flange.
    view, camera
        (K,) of each fit; camera 0 is the ToF camera, 1 the stereo camera.
    board
        (K, 4, 4) T_camera_board.
    covariance
        (K, 6, 6) of (displacement of the board's origin, rotation vector), camera axes.
    arm_variance
        (6,) of an arm pose, m^2 and rad^2.
    """

    arm: Float64
    view: NDArray[np.intp]
    camera: NDArray[np.intp]
    board: Float64
    covariance: Float64
    arm_variance: Float64

    def linearised(self, X: list[Float64], Z: Float64, E: Float64) -> tuple[Float64, Float64]:
        """Residuals (K, 6), seen minus predicted board in camera axes, and their derivative (K, 6, 18).

        The columns are (displacement, rotation) of the fit's own camera in flange axes, of the board in base axes, and of the arm's
        error in its view as a twist in flange axes.
        """
        T_base_flange = self.arm[self.view] @ E[self.view]
        camera = np.stack(X)[self.camera]
        flange_board = invert_all(T_base_flange) @ Z
        predicted = invert_all(camera) @ flange_board
        moved = self.board[:, :3, 3] - predicted[:, :3, 3]
        turned = rotation_vectors(self.board[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2))
        back = np.swapaxes(camera[:, :3, :3], 1, 2)
        to_base = back @ np.swapaxes(T_base_flange[:, :3, :3], 1, 2)
        lever = flange_board[:, :3, 3] - camera[:, :3, 3]
        # What the flange's error moves is everything in the base, seen from the flange before the error.
        error = back @ np.swapaxes(E[self.view][:, :3, :3], 1, 2)
        before = (invert_all(self.arm[self.view]) @ Z)[:, :3, 3]
        J = np.zeros((len(self.view), 6, 18))
        J[:, :3, 0:3], J[:, :3, 3:6], J[:, 3:, 3:6] = back, -back @ _hats(lever), back
        J[:, :3, 6:9], J[:, 3:, 9:12] = -to_base, -to_base
        J[:, :3, 12:15], J[:, :3, 15:18], J[:, 3:, 15:18] = error, -error @ _hats(before), error
        return np.concatenate([moved, turned], axis=1), J

    def arm_error(self, E: Float64) -> Float64:
        """(N, 6) twists of the arm's errors."""
        return np.stack([log(T) for T in E])

    def variance(self, r: Float64, weight: Float64, E: Float64) -> float:
        """Weighted sum of squares over the degrees of freedom: one where the stated covariances are right."""
        total = (weight * squares(r, self.covariance)).sum()
        total += (np.square(self.arm_error(E)) / self.arm_variance).sum()
        # Each view brings six unknowns and as many prior equations, which leaves the fits against X, X and Z.
        return float(total / max(6 * len(r) - 18, 1))


def squares(r: Float64, covariance: Float64) -> Float64:
    """Mahalanobis distances (K,) squared."""
    return np.asarray(np.einsum("ki,ki->k", r, np.linalg.solve(covariance, r[..., None])[..., 0]))


def weights_of(r: Float64, covariance: Float64) -> Float64:
    """Student-t weights (K,), at most one, under a common scale that their median tells."""
    d = squares(r, covariance)
    scale = max(float(np.median(d)) / 5.35, 1.0)  # median of chi squared with 6 degrees of freedom
    return np.asarray(np.minimum((FREEDOM + 6) / (FREEDOM + d / scale), 1.0))


def normal_equations(
    seen: Observations, r: Float64, J: Float64, weight: Float64, E: Float64
) -> tuple[Float64, Float64]:
    """``J^T W J`` and ``J^T W r`` in (X_tof, X_stereo, Z, E_1 ... E_N), the arm's prior included."""
    size = 18 + 6 * len(seen.arm)
    H, g = np.zeros((size, size)), np.zeros(size)
    for k, (view, camera) in enumerate(zip(seen.view, seen.camera, strict=True)):
        at = np.concatenate([6 * camera + np.arange(6), np.arange(12, 18), 18 + 6 * view + np.arange(6)])
        pull = weight[k] * np.linalg.inv(seen.covariance[k])
        H[np.ix_(at, at)] += J[k].T @ pull @ J[k]
        g[at] += J[k].T @ pull @ r[k]
    prior = np.tile(1 / seen.arm_variance, len(seen.arm))
    H[18:, 18:] += np.diag(prior)
    g[18:] += prior * seen.arm_error(E).ravel()
    return H, g


def _hats(v: Float64) -> Float64:
    o = np.zeros(len(v))
    flat = np.stack([o, -v[:, 2], v[:, 1], v[:, 2], o, -v[:, 0], -v[:, 1], v[:, 0], o], axis=1)
    return flat.reshape(-1, 3, 3)
