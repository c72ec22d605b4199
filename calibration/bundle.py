"""Both cameras on the arm's flange and the board in the room, from the arm's poses: one least-squares problem.

Every view gives two equations, ``A_i E_i X_c B_ci = Z`` for the cameras c: the arm says ``A_i`` (T_base_flange), the board's fit
``B_ci`` (T_camera_board) with its covariance. Unknown are X_tof, X_stereo (T_flange_camera), Z (T_base_board) and the arm's error
``E_i`` of every view, which both cameras share; what is known of it is the arm's standard deviation. A closed form starts it
(Park and Martin), Gauss-Newton with Student-t weights per fit ends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.averages import average_transforms
from calibration.hand_eye.checks import check_motion, clean
from calibration.hand_eye.closed_form import hats, moved, park_martin, rotation_vectors
from tofcapture.errors import QualityError
from tofcapture.poses import Float64, exp, hat, invert, invert_all, log, rotation_log
from tofcapture.rig import Rig

CAMERAS = ("tof", "stereo")
# m, rad per axis: a good arm's pose against its own calibration
ARM_SIGMA = (0.0002, float(np.radians(0.01)))
MIN_FITS = 5  # of each camera: six unknowns each, and one to spare
STEPS = 50
STOP = 1e-9  # m and rad
FREEDOM = 8.0  # degrees of freedom of Student's t: efficient on Gaussian noise, and outliers lose their vote
AGREES = 3.0  # standard deviations per degree of freedom between the two rig transforms
OUTLIER = 0.3  # weight below which a fit has lost its vote


@dataclass(frozen=True)
class BoardFit:
    """Hold what one camera says of the board in one view."""

    view: int  #: Index into the arm's poses
    camera: str  #: ``tof`` or ``stereo``
    T_camera_board: Float64  #: (4, 4)
    #: (6, 6) of (displacement of the board's origin, rotation vector), camera axes, m^2 and rad^2
    covariance: Float64


@dataclass(frozen=True)
class Bundle:
    """A solved bundle of N views and K fits."""

    #: (4, 4)
    T_flange_tof: Float64
    T_flange_stereo: Float64
    T_base_board: Float64
    #: (18, 18) of (displacement of the origin, rotation vector) of the three, in the axes of flange,
    #: flange and base. The stated covariances times ``variance``
    covariance: Float64
    variance: float  #: What the residuals say the stated covariances must be multiplied by; never below one
    weight: Float64  #: (K,) of the fits; those below ``OUTLIER`` are ``outliers``
    arm: Float64  #: (N, 6) error of the arm's poses as the cameras see it, flange axes
    #: RMS relative rotation of the flange about its three principal axes, radians, descending
    motion: tuple[float, float, float]

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """(K,) fits that lost their vote."""
        return np.asarray(self.weight < OUTLIER)

    @property
    def T_tof_stereo(self) -> Float64:
        """(4, 4) rig transform that the two cameras' places imply."""
        return invert(self.T_flange_tof) @ self.T_flange_stereo

    def sigma(self, which: int) -> Float64:
        """Return standard deviations (6,) of T_flange_tof (0), T_flange_stereo (1) or T_base_board (2), metres and radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[6 * which : 6 * which + 6]))

    def rig_covariance(self) -> Float64:
        """Return the (6, 6) of T_tof_stereo: displacement of the stereo camera's centre and rotation vector, ToF axes."""
        R = self.T_flange_tof[:3, :3].T
        turn = np.kron(np.eye(2), R)
        J = np.zeros((6, 18))
        J[:, :6], J[:, 6:12] = -turn, turn
        # A turned ToF camera sees the stereo camera's centre on the other side: d(R^T a) = R^T [a] phi.
        J[:3, 3:6] = R @ hat(self.T_flange_stereo[:3, 3] - self.T_flange_tof[:3, 3])
        out: Float64 = J @ self.covariance @ J.T
        return out


def solve_bundle(
    arm: Float64, fits: Sequence[BoardFit], arm_sigma: tuple[float, float] = ARM_SIGMA
) -> Bundle:
    """Solve for both cameras and the board, or refuse by name.

    The fits are of both cameras, in any order; a view may lack either. ``arm`` is (N, 4, 4) T_base_flange, ``arm_sigma`` the standard
    deviation of an arm pose per axis, metres and radians.

    :class:`DataError` for impossible poses, :class:`QualityError` for fewer than five fits of a camera, and ``HandEyeRefused``, with
    its ``cause``, for motion that determines nothing: pure translation, small rotations, a single axis.
    """
    A = clean(arm, "arm poses")
    motion, X, Z = _start(A, fits)
    seen = _Observations(
        A,
        np.array([f.view for f in fits]),
        np.array([CAMERAS.index(f.camera) for f in fits]),
        np.stack([f.T_camera_board for f in fits]),
        np.stack([f.covariance for f in fits]),
        np.repeat(np.square(arm_sigma), 3),
    )
    E = np.tile(np.eye(4), (len(A), 1, 1))
    r, J = seen.linearised(X, Z, E)
    for _ in range(STEPS):
        H, g = seen.normal_equations(r, J, E)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        X = [moved(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(X)]
        Z = moved(Z, step[12:18])
        E = np.stack([exp(s) @ T for s, T in zip(step[18:].reshape(-1, 6), E, strict=True)])
        r, J = seen.linearised(X, Z, E)
        if np.abs(step).max() < STOP:
            break
    H, _ = seen.normal_equations(r, J, E)
    variance = max(1.0, seen.variance(r, E))
    covariance = np.asarray(np.linalg.inv(H)[:18, :18] * variance, dtype=np.float64)
    return Bundle(X[0], X[1], Z, covariance, variance, seen.weight(r), seen.arm_error(E), motion)


def _start(A: Float64, fits: Sequence[BoardFit]) -> tuple[tuple[float, float, float], list[Float64], Float64]:
    """Closed form per camera behind the gate on motion; the board where most views put it."""
    found, places, motions = [], [], []
    for camera in CAMERAS:
        own = [f for f in fits if f.camera == camera]
        if len(own) < MIN_FITS:
            raise QualityError(
                f"bundle refused, too few board fits: expected at least {MIN_FITS} of the {camera} camera, got {len(own)}",
                hint="record more board views, tilted and rolled in all directions",
            )
        P = np.stack([A[f.view] for f in own])
        B = clean(np.stack([f.T_camera_board for f in own]), f"board poses of the {camera} camera")
        motions.append(check_motion(P, B))
        X = park_martin(P, B)
        found.append(X)
        places.append(P @ X @ B)
    Z = average_transforms(list(np.concatenate(places)), np.zeros(3)).T
    return min(motions, key=lambda m: m[1]), found, Z


@dataclass(frozen=True)
class _Observations:
    """K board fits over N arm poses."""

    arm: Float64  # (N, 4, 4) T_base_flange
    view: NDArray[np.intp]  # (K,) of each fit
    camera: NDArray[np.intp]  # (K,), 0 the ToF camera, 1 the stereo camera
    board: Float64  # (K, 4, 4) T_camera_board
    covariance: Float64  # (K, 6, 6)
    arm_variance: Float64  # (6,) of an arm pose

    def linearised(self, X: list[Float64], Z: Float64, E: Float64) -> tuple[Float64, Float64]:
        """Residuals (K, 6), seen minus predicted board in camera axes, and their derivative (K, 6, 18).

        The columns are (displacement, rotation) of the fit's own camera in flange axes, of the board in base axes, and of the arm's
        error in its view as a twist in flange axes.
        """
        T_base_flange = self.arm[self.view] @ E[self.view]
        camera = np.stack(X)[self.camera]
        flange_board = invert_all(T_base_flange) @ Z
        predicted = invert_all(camera) @ flange_board
        shifted = self.board[:, :3, 3] - predicted[:, :3, 3]
        turned = rotation_vectors(self.board[:, :3, :3] @ np.swapaxes(predicted[:, :3, :3], 1, 2))
        back = np.swapaxes(camera[:, :3, :3], 1, 2)
        to_base = back @ np.swapaxes(T_base_flange[:, :3, :3], 1, 2)
        lever = flange_board[:, :3, 3] - camera[:, :3, 3]
        # What the flange's error moves is everything in the base, seen from the flange before the error.
        error = back @ np.swapaxes(E[self.view][:, :3, :3], 1, 2)
        before = (invert_all(self.arm[self.view]) @ Z)[:, :3, 3]
        J = np.zeros((len(self.view), 6, 18))
        J[:, :3, 0:3], J[:, :3, 3:6], J[:, 3:, 3:6] = back, -back @ hats(lever), back
        J[:, :3, 6:9], J[:, 3:, 9:12] = -to_base, -to_base
        J[:, :3, 12:15], J[:, :3, 15:18], J[:, 3:, 15:18] = error, -error @ hats(before), error
        return np.concatenate([shifted, turned], axis=1), J

    def normal_equations(self, r: Float64, J: Float64, E: Float64) -> tuple[Float64, Float64]:
        """``J^T W J`` and ``J^T W r`` in (X_tof, X_stereo, Z, E_1 ... E_N), the arm's prior included."""
        size, weight = 18 + 6 * len(self.arm), self.weight(r)
        H, g = np.zeros((size, size)), np.zeros(size)
        for k, (view, camera) in enumerate(zip(self.view, self.camera, strict=True)):
            at = np.concatenate([6 * camera + np.arange(6), np.arange(12, 18), 18 + 6 * view + np.arange(6)])
            pull = weight[k] * np.linalg.inv(self.covariance[k])
            H[np.ix_(at, at)] += J[k].T @ pull @ J[k]
            g[at] += J[k].T @ pull @ r[k]
        prior = np.tile(1 / self.arm_variance, len(self.arm))
        H[18:, 18:] += np.diag(prior)
        g[18:] += prior * self.arm_error(E).ravel()
        return H, g

    def weight(self, r: Float64) -> Float64:
        """Student-t weights (K,), at most one, under a common scale that the median of the residuals tells."""
        d = self._squares(r)
        scale = max(float(np.median(d)) / 5.35, 1.0)  # median of chi squared with 6 degrees of freedom
        return np.asarray(np.minimum((FREEDOM + 6) / (FREEDOM + d / scale), 1.0))

    def variance(self, r: Float64, E: Float64) -> float:
        """Weighted sum of squares over the degrees of freedom: one where the stated covariances are right."""
        total = (self.weight(r) * self._squares(r)).sum()
        total += (np.square(self.arm_error(E)) / self.arm_variance).sum()
        # Each view brings six unknowns and as many prior equations, which leaves the fits against X, X and Z.
        return float(total / max(6 * len(r) - 18, 1))

    def arm_error(self, E: Float64) -> Float64:
        """(N, 6) twists of the arm's errors."""
        return np.stack([log(T) for T in E])

    def _squares(self, r: Float64) -> Float64:
        """Mahalanobis distances (K,) squared."""
        return np.asarray(np.einsum("ki,ki->k", r, np.linalg.solve(self.covariance, r[..., None])[..., 0]))


def bundle_report(bundle: Bundle, fits: Sequence[BoardFit], rig: Rig) -> dict[str, Any]:
    """Lay a bundle out as JSON types, with its consistency with the rig's ``T_tof_stereo``."""
    places = {
        "T_flange_tof": bundle.T_flange_tof,
        "T_flange_stereo": bundle.T_flange_stereo,
        "T_base_board": bundle.T_base_board,
    }
    arm = np.sqrt(np.square(bundle.arm.reshape(-1, 2, 3)).mean(axis=(0, 2)))
    return {
        "format": "tofcapture-bundle",
        "version": 1,
        "units": "m",
        **{name: T.tolist() for name, T in places.items()},
        "standard_error": {name: _stated(bundle.sigma(i)) for i, name in enumerate(places)},
        "covariance": bundle.covariance.tolist(),
        "variance_factor": bundle.variance,
        "views": len(bundle.arm),
        "fits": {c: sum(f.camera == c for f in fits) for c in ("tof", "stereo")},
        "outliers": [
            f"view {f.view} {f.camera}" for f, bad in zip(fits, bundle.outliers, strict=True) if bad
        ],
        "arm_rms": {"translation_mm": 1e3 * float(arm[0]), "rotation_deg": float(np.degrees(arm[1]))},
        "motion_deg": np.degrees(bundle.motion).tolist(),
        "rig_check": consistency(bundle, rig.T_tof_stereo),
        "moved": _difference(bundle.T_flange_tof, rig.T_flange_tof),
    }


def consistency(bundle: Bundle, T_tof_stereo: Float64) -> dict[str, Any]:
    """Compare ``X_tof^-1 X_stereo`` with the rig transform that registration found, in the bundle's own standard deviations."""
    D = T_tof_stereo @ invert(bundle.T_tof_stereo)
    off = np.concatenate([T_tof_stereo[:3, 3] - bundle.T_tof_stereo[:3, 3], rotation_log(D[:3, :3])])
    distance = float(np.sqrt(off @ np.linalg.solve(bundle.rig_covariance(), off) / 6))
    return {
        **_difference(bundle.T_tof_stereo, T_tof_stereo),
        "standard_error": _stated(np.sqrt(np.diag(bundle.rig_covariance()))),
        "sigmas": distance,
        "agrees": distance < AGREES,
    }


def _difference(one: Float64, other: Float64) -> dict[str, float]:
    turned = rotation_log(one[:3, :3].T @ other[:3, :3])
    return {
        "translation_mm": 1e3 * float(np.linalg.norm(one[:3, 3] - other[:3, 3])),
        "rotation_deg": float(np.degrees(np.linalg.norm(turned))),
    }


def _stated(sigma: Float64) -> dict[str, list[float]]:
    return {
        "translation_mm": (1e3 * sigma[:3]).tolist(),
        "rotation_deg": np.degrees(sigma[3:]).tolist(),
    }
