"""Hands, targets and streams of a camera that moves about a board, made with a known answer."""

from __future__ import annotations

import numpy as np

from calibration.hand_eye.pairs import make_stream
from tofcapture.poses import exp, invert, invert_all, look_at, rotation_angle, rotation_exp, transform


def station(seed=0, count=25, noise_m=0.0005, noise_rad=0.001, eye_to_hand=False):
    """Hand and target poses of a camera that looks at a board from all sides, and the true X."""
    rng = np.random.default_rng(seed)
    X = exp(rng.normal(0, [0.06, 0.06, 0.06, 0.8, 0.8, 0.8]))
    board = transform(np.eye(3), [0.6, 0.1, 0.0])
    hand, target = [], []
    for _ in range(count):
        tilt, turn, far = rng.uniform(0.1, 0.6), rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.8)
        way = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        camera = look_at(
            board[:3, 3] + far * way, board[:3, 3] + rng.normal(0, 0.03, 3), (1, 0, 0), rng.uniform(-1, 1)
        )
        B = invert(camera) @ board
        hand.append(camera @ invert(X))
        target.append(
            transform(
                rotation_exp(rng.normal(0, noise_rad, 3)) @ B[:3, :3], B[:3, 3] + rng.normal(0, noise_m, 3)
            )
        )
    A = np.stack(hand)
    return (invert_all(A) if eye_to_hand else A), np.stack(target), X


def apart(X, Y):
    return rotation_angle(X[:3, :3] @ Y[:3, :3].T), np.linalg.norm(X[:3, 3] - Y[:3, 3])


def streams(offset, seed=0, period=None):
    """A smooth irregular (or periodic) motion, seen by a hand at 100 Hz and a camera at 30 Hz whose clock is off."""
    rng = np.random.default_rng(seed)
    X, Z = exp([0.05, 0.02, 0.08, 0.3, -0.5, 0.8]), exp([0.6, 0, 0, 0, 0, 0.4])
    rate = rng.uniform(0.5, 3, (4, 6)) if period is None else np.full((4, 6), 2 * np.pi / period)
    phase, size = rng.uniform(0, 6, (4, 6)), np.r_[[0.04] * 3, [0.25] * 3]

    def at(t):
        return exp(size * np.sin(rate * t + phase).sum(axis=0))

    t_hand, t_camera = np.arange(0, 20, 0.01), np.arange(1, 18, 1 / 30)
    hand = np.stack([at(t) for t in t_hand])
    target = np.stack([invert(X) @ invert(at(t)) @ Z @ exp(rng.normal(0, 5e-4, 6)) for t in t_camera])
    return make_stream(t_hand, hand, "hand"), make_stream(t_camera - offset, target, "target"), X
