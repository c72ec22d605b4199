"""How long the robust Chamfer loss takes, forward and backward, beside k-d trees in the same run.

    python benchmarks/chamfer.py [--device cpu] [--repeats 3]

480 x 360, seven candidates. The peer is what one would write with scipy: two ``cKDTree``, shared between the candidates (shifting
the queries is the same as shifting the cloud), both cores (``workers=-1``), indices into torch, ``gather``, backward. On a GPU the
peer is chunked ``torch.cdist``. The pairs of clouds: a tabletop with objects as a trained network would have it; the same over its
objects' masks, over 2,000 pixels, and with noise; 60 mm off; the same with noise and outliers, as an untrained network; and facets
before and behind each other, whose depth steps are smeared.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from tofcapture_model.geometry.maps import unproject
from tofcapture_model.losses.chamfer import candidate_shifts, robust_chamfer

K = torch.tensor([[381.2, 401.5, 234.2, 203.5]])
SHAPE = (360, 480)


def tabletop(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Depth (1, 1, H, W) of a tilted table with balls and boxes on it, and where they are."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    depth = 1.0 / (1.0 + 0.0011 * (v - SHAPE[0] / 2))
    objects = np.zeros(SHAPE, bool)
    for k in range(6):
        cu, cv, r = rng.uniform(100, 380), rng.uniform(90, 270), rng.uniform(25, 60)
        if k % 2:
            inside = (abs(u - cu) < r) & (abs(v - cv) < 0.7 * r)
            near = 0.75 + 0.0006 * (u - cu) + 0.0003 * (v - cv)
        else:
            inside = np.hypot(u - cu, v - cv) < r
            near = 0.85 - np.sqrt(np.maximum(r**2 - (u - cu) ** 2 - (v - cv) ** 2, 0)) * 0.85 / 390
        depth = np.where(inside & (near < depth), near, depth)
        objects |= inside
    return torch.tensor(depth, dtype=torch.float32)[None, None], torch.tensor(objects)[None, None]


def facets(seed: int) -> torch.Tensor:
    """Depth (1, 1, H, W) of a wall with many tilted facets before it: edges and depth steps everywhere."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    depth = np.full(SHAPE, 1.3)
    for _ in range(60):
        cu, cv, angle = rng.uniform(0, SHAPE[1]), rng.uniform(0, SHAPE[0]), rng.uniform(0, np.pi)
        a = np.cos(angle) * (u - cu) + np.sin(angle) * (v - cv)
        b = np.cos(angle) * (v - cv) - np.sin(angle) * (u - cu)
        inside = (abs(a) < rng.uniform(15, 60)) & (abs(b) < rng.uniform(15, 60))
        near = 1 / (
            1 / rng.uniform(0.6, 1.2) + rng.uniform(-0.002, 0.002) * a + rng.uniform(-0.002, 0.002) * b
        )
        depth = np.where(inside & (near < depth), near, depth)
    return torch.tensor(depth, dtype=torch.float32)[None, None]


def untrained(depth: torch.Tensor, seed: int) -> torch.Tensor:
    """60 mm off, noisy, and one pixel of twenty anywhere."""
    g = torch.Generator().manual_seed(seed)
    anywhere = 0.3 + 1.2 * torch.rand(depth.shape, generator=g)
    off = predicted(depth, 0.003, seed) + 0.06
    return torch.where(torch.rand(depth.shape, generator=g) < 0.05, anywhere, off)


def predicted(depth: torch.Tensor, noise: float, seed: int) -> torch.Tensor:
    """Change a depth as a network's errors would: smooth bias, rounded edges, some noise."""
    g = torch.Generator().manual_seed(seed)
    smooth = torch.nn.functional.avg_pool2d(depth, 3, 1, 1, count_include_pad=False)
    broad = torch.nn.functional.interpolate(
        0.003 * torch.randn(1, 1, 9, 12, generator=g), SHAPE, mode="bicubic"
    )
    return smooth + broad + noise * torch.randn(depth.shape, generator=g)


def by_trees(p: torch.Tensor, q: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Compute the same loss with k-d trees."""
    from scipy.spatial import cKDTree

    a, b = p[0][:, mask[0, 0]].T, q[0][:, mask[0, 0]].T
    x, y = a.detach().numpy().astype(float), b.numpy().astype(float)
    tree_p, tree_q = cKDTree(x), cKDTree(y)
    losses = []
    for s in candidate_shifts():
        shift = s.double().numpy()
        to_q = torch.from_numpy(tree_q.query(x + shift, workers=-1)[1])
        to_p = torch.from_numpy(tree_p.query(y - shift, workers=-1)[1])
        losses.append((a - b[to_q] + s).square().sum(1).mean() + (a[to_p] - b + s).square().sum(1).mean())
    return torch.stack(losses).min()


def by_cdist(p: torch.Tensor, q: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Compute the same loss by brute force in chunks."""
    a, b = p[0][:, mask[0, 0]].T, q[0][:, mask[0, 0]].T
    losses = []
    for s in candidate_shifts().to(p):
        ways = []
        for x, y in ((a.detach() + s, b), (b, a.detach() + s)):
            ways.append(
                torch.cat(
                    [
                        torch.cdist(c, y, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
                        for c in x.split(4096)
                    ]
                )
            )
        losses.append(
            (a + s - b[ways[0]]).square().sum(1).mean() + (a[ways[1]] + s - b).square().sum(1).mean()
        )
    return torch.stack(losses).min()


def timed(call, device: str) -> tuple[float, float, float, torch.Tensor]:
    """Wall and CPU seconds, loss, gradient."""
    if device != "cpu":
        torch.cuda.synchronize()
    wall, cpu = time.perf_counter(), time.process_time()
    depth, loss = call()
    loss.backward()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - wall, time.process_time() - cpu, float(loss.detach()), depth.grad


def main() -> None:
    """Print one line per pair of clouds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    truth, objects = tabletop(0)
    everywhere, small, mesh = torch.ones_like(objects), torch.zeros_like(objects), facets(0)
    small[..., 150:190, 200:250] = True
    good, noisy = predicted(truth, 0.0005, 1), predicted(truth, 0.003, 2)
    cases = {
        "whole image": (truth, good, everywhere),
        "objects only": (truth, good, objects),
        "noise of 3 mm": (truth, noisy, everywhere),
        "small mask": (truth, good, small),
        "60 mm off": (truth, good + 0.06, everywhere),
        "untrained": (truth, untrained(truth, 3), everywhere),
        "facets": (mesh, predicted(mesh, 0.0005, 4), everywhere),
    }
    k = K.to(args.device)
    print(
        f"{args.device}, {torch.get_num_threads()} threads, {SHAPE[1]} x {SHAPE[0]}, 7 candidates, forward + backward; medians"
    )
    for name, (surface, start, mask) in cases.items():
        mask, q = mask.to(args.device), unproject(surface, K).to(args.device)  # noqa: PLW2901
        ours, theirs = [], []

        def grid(start=start, mask=mask, q=q):
            depth = start.to(args.device).clone().requires_grad_()
            return depth, robust_chamfer(unproject(depth, k), q, mask, mask).loss.sum()

        def peer(start=start, mask=mask, q=q):
            depth = start.to(args.device).clone().requires_grad_()
            way = by_trees if args.device == "cpu" else by_cdist
            return depth, way(unproject(depth, k), q, mask)

        timed(grid, args.device)
        for _ in range(args.repeats):  # in turns, so that other load meets both
            ours.append(timed(grid, args.device))
            theirs.append(timed(peer, args.device))
        wall, cpu, other, other_cpu = (
            float(np.median([r[i] for r in rows])) for rows in (ours, theirs) for i in (0, 1)
        )
        loss, gradient = (
            abs(ours[0][2] / theirs[0][2] - 1),
            (ours[0][3] - theirs[0][3]).norm() / theirs[0][3].norm(),
        )
        print(
            f"{name:14} {int(mask.sum()):7} points  ours {1000 * wall:7.1f} ms (cpu {1000 * cpu:.1f})  peer {1000 * other:7.0f} ms"
            f" (cpu {1000 * other_cpu:.0f})  ratio {other / wall:5.1f} (cpu {other_cpu / cpu:.1f})  loss differs by {loss:.1e}, gradient by {gradient:.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
