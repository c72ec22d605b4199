"""Hold hand-eye calibration against OpenCV 4 on noisy simulated poses, and against published answers on real ones.

    pip install opencv-python-headless==4.14.0.94      # OpenCV 5 has no calibrateHandEye
    python benchmarks/hand_eye.py [--seeds 60]

Printed per noise model and method: median error of X over the seeds (40 poses each), how often ours is the smaller one,
and how often our 1-sigma covers the truth. Skips the comparison with a reason where OpenCV has no hand-eye.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from calibration.hand_eye.solve import solve_hand_eye
from tofcapture.poses import (
    exp,
    invert,
    invert_all,
    look_at,
    rotation_angle,
    rotation_exp,
    rotation_log,
    transform,
)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "realdata"
# Noise per axis: hand metres and radians, target metres (x, y), metres along the axis, radians.
NOISES = {
    "camera only": (0.0, 0.0, 0.0005, 0.0005, np.radians(0.1)),
    "camera, deep": (0.0, 0.0, 0.0003, 0.0020, np.radians(0.3)),
    "arm and camera": (0.0005, np.radians(0.05), 0.0005, 0.0010, np.radians(0.1)),
    "arm": (0.0010, np.radians(0.1), 0.0002, 0.0002, np.radians(0.03)),
}
POSES = 40


def simulate(rng, noise, count=POSES, eye_to_hand=False):
    """Make hand and target poses of a camera that looks at a board from all sides, and the true X."""
    X, board = exp(rng.normal(0, [0.08, 0.08, 0.08, 0.8, 0.8, 0.8])), transform(np.eye(3), [0.6, 0.1, 0.0])
    hand_m, hand_rad, side_m, deep_m, target_rad = noise
    hand, target = [], []
    for _ in range(count):
        tilt, turn, far = rng.uniform(0, np.radians(35)), rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 0.8)
        eye = board[:3, 3] + far * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        )
        camera = look_at(eye, board[:3, 3] + rng.normal(0, 0.03, 3), (1, 0, 0), rng.uniform(-1.0, 1.0))
        A, B = camera @ invert(X), invert(camera) @ board
        hand.append(
            transform(
                A[:3, :3] @ rotation_exp(rng.normal(0, hand_rad, 3)), A[:3, 3] + rng.normal(0, hand_m, 3)
            )
        )
        moved = rng.normal(0, 1, 3) * [side_m, side_m, deep_m]
        target.append(transform(rotation_exp(rng.normal(0, target_rad, 3)) @ B[:3, :3], B[:3, 3] + moved))
    P = np.stack(hand)
    return (invert_all(P) if eye_to_hand else P), np.stack(target), X


def errors(X, truth):
    """Rotation (degrees) and translation (mm) error."""
    return np.degrees(rotation_angle(X[:3, :3] @ truth[:3, :3].T)), 1e3 * np.linalg.norm(
        X[:3, 3] - truth[:3, 3]
    )


def opencv_methods():
    """Return every hand-eye and robot-world method of OpenCV 4 as a function of (hand, target)."""
    import cv2

    if not hasattr(cv2, "calibrateHandEye"):
        return (
            {},
            f"OpenCV {cv2.__version__} has no calibrateHandEye: pip install opencv-python-headless==4.14.0.94",
        )
    found = {}
    for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        method = getattr(cv2, f"CALIB_HAND_EYE_{name}")
        found[f"OpenCV {name.title()}"] = lambda A, B, method=method: transform(
            *_flat(cv2.calibrateHandEye(A[:, :3, :3], A[:, :3, 3], B[:, :3, :3], B[:, :3, 3], method=method))
        )
    for name in ("SHAH", "LI"):
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}")

        def world(A, B, method=method):
            P = invert_all(A)
            out = cv2.calibrateRobotWorldHandEye(
                B[:, :3, :3], B[:, :3, 3], P[:, :3, :3], P[:, :3, 3], method=method
            )
            return invert(transform(*_flat(out[2:])))

        found[f"OpenCV {name.title()}"] = world
    return found, ""


def _flat(pair):
    return np.asarray(pair[0]), np.asarray(pair[1]).ravel()


def compare(seeds):
    """Run all methods on the same poses and print one table per noise model."""
    methods, why = opencv_methods()
    if why:
        print(f"comparison skipped: {why}\n")
    for label, noise in NOISES.items():
        table, covered, seconds = {}, [], []
        for seed in range(seeds):
            A, B, truth = simulate(np.random.default_rng(seed), noise)
            start = time.perf_counter()
            result = solve_hand_eye(A, B)
            seconds.append(time.perf_counter() - start)
            answers = {"ours, refined": result.X}
            answers |= {f"ours, {name}": X for name, X in result.closed_forms.items()}
            answers |= {name: method(A, B) for name, method in methods.items()}
            for name, X in answers.items():
                table.setdefault(name, []).append(errors(X, truth))
            off = np.r_[result.X[:3, 3] - truth[:3, 3], rotation_log(result.X[:3, :3] @ truth[:3, :3].T)]
            covered.append(np.abs(off) <= np.sqrt(np.diag(result.covariance)))
        _print(label, {k: np.array(v) for k, v in table.items()}, np.array(covered), seconds)


def _print(label, table, covered, seconds):
    print(f"{label}: {len(seconds)} seeds of {POSES} poses, median {1e3 * np.median(seconds):.0f} ms")
    print("  method                  rotation deg  translation mm   ours smaller (rot, trans)")
    ours = table["ours, refined"]
    for name, e in sorted(table.items(), key=lambda item: np.median(item[1][:, 1])):
        wins = (ours <= e).mean(axis=0)
        share = "" if name == "ours, refined" else f"   {100 * wins[0]:.0f} %, {100 * wins[1]:.0f} %"
        print(f"  {name:24}{np.median(e[:, 0]):11.4f}{np.median(e[:, 1]):15.3f}{share}")
    rivals = {k: np.median(e, axis=0) for k, e in table.items() if k.startswith("OpenCV")}
    if rivals:
        best = np.min(list(rivals.values()), axis=0)
        print(
            f"  ours / OpenCV's best: rotation {np.median(ours[:, 0]) / best[0]:.2f}, "
            f"translation {np.median(ours[:, 1]) / best[1]:.2f}"
        )
    print(f"  1-sigma covers {100 * covered.mean():.0f} % of the seed-components\n")


def published():
    """Print the answer on MoveIt's real samples beside the published one."""
    path = SHARED / "hand_eye_moveit" / "pose_samples.json"
    if not path.exists():
        print(f"real data skipped: no {path}")
        return
    pairs = np.array(json.loads(path.read_text()))
    result = solve_hand_eye(pairs[:, 0], pairs[:, 1], eye_to_hand=True)
    Rx, Ry, Rz = (rotation_exp(np.eye(3)[i] * a) for i, a in enumerate((0.230, -2.540, 1.950)))
    rotation, translation = errors(result.X, transform(Rx @ Ry @ Rz, [0.659, -0.249, 0.830]))
    print(
        f"hand_eye_moveit: t = {np.round(result.X[:3, 3], 4).tolist()} m, off the published answer (three digits) by "
        f"{rotation:.3f} deg and {translation:.2f} mm; noise {1e3 * result.noise[0]:.2f} mm, "
        f"{np.degrees(result.noise[1]):.3f} deg per axis"
    )


def halves(draws=60):
    """Print how far random halves of MoveIt's samples are apart in their combined sigmas, and what a wrong target size does."""
    path = SHARED / "hand_eye_moveit" / "pose_samples.json"
    if not path.exists():
        return
    A, B = np.swapaxes(json.loads(path.read_text()), 0, 1)
    rng, total, axes = np.random.default_rng(0), [], []
    for _ in range(draws):
        order = rng.permutation(len(A))
        one, two = (solve_hand_eye(A[i], B[i], eye_to_hand=True) for i in np.array_split(order, 2))
        off = np.r_[one.X[:3, 3] - two.X[:3, 3], rotation_log(one.X[:3, :3] @ two.X[:3, :3].T)]
        sigma = np.sqrt(np.diag(one.covariance + two.covariance))
        total.append([np.linalg.norm(off[h]) / np.linalg.norm(sigma[h]) for h in (slice(0, 3), slice(3, 6))])
        axes.append(np.abs(off) <= sigma)
    moved, turned = np.median(total, axis=0)
    print(
        f"halves of hand_eye_moveit, {draws} draws: {moved:.2f} (translation) and {turned:.2f} (rotation) combined sigma, medians"
    )
    print(f"  of the total of three axes; 1 sigma of an axis covers {100 * np.mean(axes):.0f} %")
    truth = solve_hand_eye(A, B, eye_to_hand=True).X
    for factor in (1 / 1.2, 1 / 1.06, 1.01, 1.03, 1.06, 1.11, 1.2):
        large = B.copy()
        large[:, :3, 3] *= factor
        result = solve_hand_eye(A, large, eye_to_hand=True)
        print(
            f"  target times {factor:.3f}: {result.verdict}, X {errors(result.X, truth)[1]:.2f} mm off, scale {result.scale[0]:.4f}"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=60)
    args = parser.parse_args()
    published()
    halves()
    compare(args.seeds)


if __name__ == "__main__":
    main()
