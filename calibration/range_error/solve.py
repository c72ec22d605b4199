"""Linear least squares over all views with shared unknowns and random effects of every view; see :mod:`calibration.range_error.fit`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.range_error.error import jackknife
from tofcapture.poses import Float64

OWN = 3  # a view's own error: offset and slopes over the image
START_SPREAD = 0.001  # m
BELIEF = 3.0  # views that the first guess of the spread counts as
TUKEY = 4.685


@dataclass(frozen=True)
class Problem:
    """Linear equations of every view: columns of the shared unknowns, of the own ones, and what is left to explain."""

    shared: list[Float64]  # (F, N, U)
    own: list[Float64]  # (N, OWN)
    y: list[Float64]  # (F, N)
    weight: list[Float64]  # (F, N), 1 / m^2
    prior: Float64  # (U,) one sigma
    expected: Float64  # (U,) before any view: what is left of the transform's prior after it was moved


@dataclass(frozen=True)
class Found:
    """Solution: shared unknowns, the same without each view, their covariance, and the views' own errors with their variances."""

    x: Float64  # (U,)
    left_out: Float64  # (V, U)
    covariance: Float64  # (U, U)
    variances: Float64  # (F, OWN)
    own: Float64  # (V, F, OWN)


def solve(p: Problem, rounds: int) -> Found:
    """Solve for the shared unknowns, with so many rounds of spreads and robust weights."""
    F = len(p.y[0])
    robust = [np.ones_like(y) for y in p.y]
    variances: Float64 = np.full((F, OWN), START_SPREAD**2)
    for _ in range(rounds):
        reduced = [_reduced(p, v, robust[v], variances) for v in range(len(p.y))]
        H = sum(r[0] for r in reduced) + np.diag(p.prior**-2.0)
        g = sum(r[1] for r in reduced) + p.expected / np.square(p.prior)
        x = np.asarray(np.linalg.solve(H, g), dtype=np.float64)
        covariance = np.linalg.inv(H)
        own, moments = (
            np.stack(part).astype(np.float64)
            for part in zip(*(_own(p, v, robust[v], variances, x) for v in range(len(p.y))), strict=True)
        )
        variances = np.asarray(
            (moments.sum(axis=0) + BELIEF * START_SPREAD**2) / (len(p.y) + BELIEF), dtype=np.float64
        )
        robust = [_tukey(p, v, x, own[v]) for v in range(len(p.y))]
    left_out = np.stack([np.linalg.solve(H - h, g - b) for h, b in reduced])
    influence = jackknife(left_out)[1]
    believed = covariance @ np.diag(p.prior**-2.0) @ covariance
    return Found(x, left_out, influence + believed, variances, own)


def _reduced(p: Problem, v: int, robust: Float64, variances: Float64) -> tuple[Float64, Float64]:
    """Equations of the shared unknowns of one view, its own ones eliminated."""
    U = len(p.prior)
    H, g = np.zeros((U, U)), np.zeros(U)
    B = p.own[v]
    for i, (A, y) in enumerate(zip(p.shared[v], p.y[v], strict=True)):
        w = robust[i] * p.weight[v][i]
        AW, BW = A * w[:, None], B * w[:, None]
        gain = (AW.T @ B) @ np.linalg.inv(BW.T @ B + np.diag(1 / variances[i]))
        H += AW.T @ A - gain @ (BW.T @ A)
        g += AW.T @ y - gain @ (BW.T @ y)
    return H, g


def _own(p: Problem, v: int, robust: Float64, variances: Float64, x: Float64) -> tuple[Float64, Float64]:
    """A view's own errors (F, OWN) and their second moments."""
    out, moments = np.zeros_like(variances), np.zeros_like(variances)
    B = p.own[v]
    for i, (A, y) in enumerate(zip(p.shared[v], p.y[v], strict=True)):
        BW = B * (robust[i] * p.weight[v][i])[:, None]
        C = np.linalg.inv(BW.T @ B + np.diag(1 / variances[i]))
        out[i] = C @ (BW.T @ (y - A @ x))
        moments[i] = np.square(out[i]) + np.diag(C)
    return out, moments


def _tukey(p: Problem, v: int, x: Float64, own: Float64) -> Float64:
    left = p.y[v] - p.shared[v] @ x - own @ p.own[v].T
    scaled = left * np.sqrt(p.weight[v])
    scale = np.maximum(1.4826 * np.median(np.abs(scaled), axis=1, keepdims=True), 1.0)
    out: Float64 = np.square(np.clip(1 - np.square(scaled / scale / TUKEY), 0, None))
    return out
