"""Chamfer to tangent planes against brute force."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tofcapture_model.geometry.maps import depth_to_normals, unproject
from tofcapture_model.losses.chamfer.robust import candidate_shifts, robust_chamfer

SHAPE = (18, 24)
K = torch.tensor([[60.0, 60.0, 11.5, 8.5]])


def clouds():
    """Noisy points, those of a wavy truth, and its normals, which change from pixel to pixel."""
    rng = np.random.default_rng(0)
    u = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    truth = torch.tensor(0.8 + 0.05 * np.sin(u / 3), dtype=torch.float32)[None, None]
    noise = torch.tensor(rng.normal(0, 0.02, SHAPE), dtype=torch.float32)
    return (
        unproject(truth + noise, K),
        unproject(truth, K),
        depth_to_normals(truth, torch.ones_like(truth), K, 1),
    )


def test_distances_are_taken_along_the_normal_of_the_truth_either_way():
    """P to Q along the normal of the nearest q, Q to P along that of q itself: all seven candidates, and the least of them."""
    p, q, normals = clouds()
    a, b, n = (x[0].flatten(1).T for x in (p, q, normals))
    expected = []
    for shift in candidate_shifts():
        moved = a + shift
        apart = (moved[:, None] - b[None]).square().sum(2)
        to_q, to_p = apart.argmin(1), apart.argmin(0)
        forward = ((moved - b[to_q]) * n[to_q]).sum(1)
        backward = ((moved[to_p] - b) * n).sum(1)
        expected.append((forward.square().mean() + backward.square().mean()).item())
    mask = torch.ones(1, 1, *SHAPE, dtype=torch.bool)
    found = robust_chamfer(p, q, mask, mask, K, normals=normals)
    assert found.candidates[0].tolist() == pytest.approx(expected, rel=1e-3)
    assert found.loss.item() == pytest.approx(min(expected), rel=1e-3)
    assert found.winner.item() == np.argmin(expected)
