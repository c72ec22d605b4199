"""Both cameras on the arm's flange and the board in the room, from the arm's poses: one least-squares problem.

Every view gives two equations, ``A_i E_i X_c B_ci = Z`` for the cameras c: the arm says ``A_i`` (T_base_flange), the board's fit
``B_ci`` (T_camera_board) with its covariance. Unknown are X_tof, X_stereo (T_flange_camera), Z (T_base_board) and the arm's error
``E_i`` of every view, which both cameras share; what is known of it is the arm's standard deviation. A closed form starts it
(Park and Martin), Gauss-Newton with Student-t weights per fit ends it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.averaged_icp import average_transforms
from calibration.bundle.equations import Observations, normal_equations, weights_of
from calibration.hand_eye.checks import check_motion, clean
from calibration.hand_eye.closed_form import park_martin
from tofcapture.errors import DataError, QualityError
from tofcapture.poses import Float64, exp, invert

CAMERAS = ("tof", "stereo")
ARM_SIGMA = (
    0.0002,
    float(np.radians(0.01)),
)  # m, rad per axis: a good arm's pose against its own calibration
MIN_FITS = 5  # of each camera: six unknowns each, and one to spare
STEPS = 50
STOP = 1e-9  # m and rad
OUTLIER = 0.3  # weight below which a fit has lost its vote


@dataclass(frozen=True)
class BoardFit:
    """What one camera says of the board in one view.

    Attributes
    ----------
    view
        Index into the arm's poses.
    camera
        ``tof`` or ``stereo``.
    T_camera_board
        (4, 4).
    covariance
        (6, 6) of (displacement of the board's origin, rotation vector), camera axes, m^2 and rad^2.
    """

    view: int
    camera: str
    T_camera_board: Float64
    covariance: Float64


@dataclass(frozen=True)
class Bundle:
    """A solved bundle.

    Attributes
    ----------
    T_flange_tof, T_flange_stereo, T_base_board
        (4, 4).
    covariance
        (18, 18) of (displacement of the origin, rotation vector) of the three, in the axes of flange, flange and base. The stated
        covariances times ``variance``.
    variance
        What the residuals say the stated covariances must be multiplied by; never below one.
    weight
        (K,) of the fits; those below ``OUTLIER`` are ``outliers``.
    residual
        (K, 6) of the fits, camera axes, the arm's error taken off.
    arm
        (N, 6) error of the arm's poses as the cameras see it, flange axes.
    motion
        RMS relative rotation of the flange about its three principal axes, radians, descending.
    """

    T_flange_tof: Float64
    T_flange_stereo: Float64
    T_base_board: Float64
    covariance: Float64
    variance: float
    weight: Float64
    residual: Float64
    arm: Float64
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
        """Standard deviations (6,) of T_flange_tof (0), T_flange_stereo (1) or T_base_board (2), metres and radians."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[6 * which : 6 * which + 6]))

    def rig_covariance(self) -> Float64:
        """(6, 6) of T_tof_stereo: displacement of the stereo camera's centre and rotation vector, ToF axes."""
        R = self.T_flange_tof[:3, :3].T
        turn = np.kron(np.eye(2), R)
        J = np.zeros((6, 18))
        J[:, :6], J[:, 6:12] = -turn, turn
        a = self.T_flange_stereo[:3, 3] - self.T_flange_tof[:3, 3]
        # A turned ToF camera sees the stereo camera's centre on the other side: d(R^T a) = R^T [a] phi.
        J[:3, 3:6] = R @ np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        out: Float64 = J @ self.covariance @ J.T
        return out


def solve_bundle(
    arm: Float64, fits: Sequence[BoardFit], arm_sigma: tuple[float, float] = ARM_SIGMA
) -> Bundle:
    """Solve for both cameras and the board, or refuse by name.

    Parameters
    ----------
    arm
        (N, 4, 4) T_base_flange.
    fits
        Of both cameras, in any order; a view may lack either.
    arm_sigma
        Standard deviation of an arm pose per axis: metres, radians.

    Raises
    ------
    DataError
        Impossible poses, covariances or cameras.
    QualityError
        Fewer than five fits of a camera.
    HandEyeRefused
        Motion that determines nothing: pure translation, small rotations, a single axis; named by its ``cause``.
    """
    A = clean(arm, "arm poses")
    _check(A, fits)
    motion, start = _start(A, fits)
    seen = Observations(
        A,
        np.array([f.view for f in fits]),
        np.array([CAMERAS.index(f.camera) for f in fits]),
        np.stack([f.T_camera_board for f in fits]),
        np.stack([f.covariance for f in fits]),
        np.repeat(np.square(arm_sigma), 3),
    )
    return _refined(seen, start, motion)


def _check(A: Float64, fits: Sequence[BoardFit]) -> None:
    for f in fits:
        if f.camera not in CAMERAS or not 0 <= f.view < len(A):
            raise DataError(
                f"board fit: expected a camera of {CAMERAS} and a view below {len(A)}, got {f.camera!r}, {f.view}"
            )
        C = np.asarray(f.covariance)
        if C.shape != (6, 6) or not np.isfinite(C).all() or np.linalg.eigvalsh((C + C.T) / 2)[0] <= 0:
            raise DataError(
                f"board fit of view {f.view}, {f.camera}: expected a positive definite (6, 6) covariance"
            )
    for camera in CAMERAS:
        count = sum(f.camera == camera for f in fits)
        if count < MIN_FITS:
            raise QualityError(
                f"bundle refused, too few board fits: expected at least {MIN_FITS} of the {camera} camera, got {count}",
                hint="record more board views, tilted and rolled in all directions",
            )


def _start(
    A: Float64, fits: Sequence[BoardFit]
) -> tuple[tuple[float, float, float], tuple[Float64, Float64, Float64]]:
    """Closed form per camera behind the gate on motion; the board where most views put it."""
    found, places, motions = [], [], []
    for camera in CAMERAS:
        own = [f for f in fits if f.camera == camera]
        P = np.stack([A[f.view] for f in own])
        B = clean(np.stack([f.T_camera_board for f in own]), f"board poses of the {camera} camera")
        motions.append(check_motion(P, B))
        X = park_martin(P, B)
        found.append(X)
        places.append(P @ X @ B)
    Z = average_transforms(list(np.concatenate(places)), np.zeros(3)).T
    return min(motions, key=lambda m: m[1]), (found[0], found[1], Z)


def _refined(
    seen: Observations, start: tuple[Float64, Float64, Float64], motion: tuple[float, float, float]
) -> Bundle:
    X, Z, E = [start[0], start[1]], start[2], np.tile(np.eye(4), (len(seen.arm), 1, 1))
    r, J = seen.linearised(X, Z, E)
    weight = weights_of(r, seen.covariance)
    for _ in range(STEPS):
        H, g = normal_equations(seen, r, J, weight, E)
        step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        X = [_moved(T, step[6 * i : 6 * i + 6]) for i, T in enumerate(X)]
        Z = _moved(Z, step[12:18])
        E = np.stack([exp(s) @ T for s, T in zip(step[18:].reshape(-1, 6), E, strict=True)])
        r, J = seen.linearised(X, Z, E)
        weight = weights_of(r, seen.covariance)
        if np.abs(step).max() < STOP:
            break
    H, _ = normal_equations(seen, r, J, weight, E)
    variance = max(1.0, seen.variance(r, weight, E))
    covariance = np.asarray(np.linalg.inv(H)[:18, :18] * variance, dtype=np.float64)
    return Bundle(X[0], X[1], Z, covariance, variance, weight, r, seen.arm_error(E), motion)


def _moved(T: Float64, step: Float64) -> Float64:
    out = exp(np.concatenate([np.zeros(3), step[3:]])) @ T
    out[:3, 3] = T[:3, 3] + step[:3]
    return out
