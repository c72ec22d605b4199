"""The robust Chamfer loss: each engine against brute force in float64, and what its seven candidates do and do not supervise."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.distance import cdist

torch = pytest.importorskip("torch")

from tofcapture_model.geometry.maps import unproject
from tofcapture_model.losses.chamfer import candidate_shifts, neighbours, robust_chamfer

K = torch.tensor([[40.0, 43.0, 11.5, 8.5]])
SHIFTS = candidate_shifts()
SURFACES = ("smooth", "jumbled", "stepped", "flat", "apart", "off their rays")
MASKS = ("full", "sparse", "holes", "one pixel", "corner")
SHAPES = ((1, 1), (3, 29), (19, 23), (35, 50), (70, 66))


def masked(kind, shape, rng):
    """A mask (H, W) that is not empty."""
    mask = np.zeros(shape, bool)
    if kind == "full":
        mask[:] = True
    elif kind == "corner":
        mask[: shape[0] // 3 + 1, : shape[1] // 4 + 1] = True
    elif kind in {"sparse", "holes"}:
        mask = rng.random(shape) < (0.05 if kind == "sparse" else 0.8)
    mask[rng.integers(shape[0]), rng.integers(shape[1])] = True
    return torch.tensor(mask)


def cloud(kind, shape, rng):
    """Points (3, H, W), metres."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    depth = 0.8 + 0.002 * u + 0.03 * np.sin(v / 3) + rng.normal(0, 0.001, shape)
    if kind == "jumbled":
        depth = rng.uniform(0.2, 3.0, shape)
    elif kind == "stepped":
        depth = np.where((u // 7 + v // 5) % 2 == 0, depth, depth - 0.3)
    elif kind == "flat":
        depth = np.full(shape, 0.8)
    points = unproject(torch.tensor(depth, dtype=torch.float32)[None, None], K)[0]
    off = torch.tensor(
        rng.normal(0, 0.002 if kind == "off their rays" else 0, points.shape), dtype=torch.float32
    )
    return points + off + (0.06 if kind == "apart" else 0.0)


def pair(surface, mask, shape, seed=0):
    """Clouds p, q (3, H, W) and masks (H, W)."""
    rng = np.random.default_rng(seed)
    return *(cloud(surface, shape, rng) for _ in "pq"), *(masked(mask, shape, rng) for _ in "pq")


def brute(p, q, p_mask, q_mask, shift):
    """Squared distances of all pairs (N, M), float64."""
    a, b = (c.detach().double().numpy()[:, m.numpy()].T for c, m in ((p, p_mask), (q, q_mask)))
    return cdist(a + shift.double().numpy(), b, "sqeuclidean")


def check(engine, clouds, device="cpu", shifts=SHIFTS):
    """Every least distance and their mean, to 1e-6 of brute force in float64 and to what float32 resolves of a metre."""
    for shift in shifts:
        _, index, score = (
            x.cpu() if isinstance(x, torch.Tensor) else x
            for x in engine.nearest_of_best(*(x.to(device) for x in (*clouds, shift[None])))
        )
        table, means = brute(*clouds, shift), 0.0
        for way, (mask, other) in enumerate(((clouds[2], clouds[3]), (clouds[3], clouds[2]))):
            truth = table if way == 0 else table.T
            assert other.flatten()[index[way][mask]].all()
            number = (np.cumsum(other.flatten().numpy()) - 1)[index[way][mask]]
            least = truth.min(1)
            # float32 resolves a coordinate of a metre to 6e-8, and twice the distance times that of a square
            assert (
                truth[np.arange(len(truth)), number] - least <= 1e-6 * least + 2e-7 * np.sqrt(least) + 1e-13
            ).all()
            means += least.mean()
        assert score.item() == pytest.approx(means, rel=1e-6, abs=2e-7 * means**0.5 + 1e-12)


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("mask", MASKS)
def test_the_trees_find_the_nearest(surface, mask):
    """Steps, noise, holes, single pixels, points off their rays, far clouds; images of any size."""
    trees = pytest.importorskip("tofcapture_model.losses.chamfer.trees")
    for seed, shape in enumerate(SHAPES[:4] if mask == "full" else SHAPES):
        check(trees, pair(surface, mask, shape, seed))


def test_brute_force_in_torch_is_brute_force():
    """What runs where no engine does."""
    for surface in SURFACES:
        check(neighbours, pair(surface, "holes", (19, 23)))


def test_the_interpreted_kernel_finds_the_nearest():
    """The search for GPUs by Triton's interpreter; Triton has to be told before it is imported."""
    pytest.importorskip("triton", reason="Triton comes with PyTorch's wheels for GPUs")
    env = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, __file__], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split("\n")[:-1] == list(SURFACES)


@pytest.mark.gpu
@pytest.mark.parametrize("surface", SURFACES)
def test_the_kernel_finds_the_nearest(surface):
    """The same on a GPU, and larger."""
    from tofcapture_model.losses.chamfer import tiles

    for mask in MASKS:
        check(tiles, pair(surface, mask, SHAPES[3]), "cuda")


def test_the_kernel_compiles_for_a_gpu(monkeypatch, tmp_path):
    """For compute capability 9.0, without such a GPU: one warp needs neither barriers nor memory to spill to."""
    triton = pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from tofcapture_model.losses.chamfer import tiles

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("TRITON_DEFAULT_FP_FUSION", "1")  # what it does unset, with a warning
    kinds = dict.fromkeys(("points", "boxes", "shifts", "squared"), "*fp32") | {
        "codes": "*i32",
        "tiles": "i32",
    }
    constants = {"POINTS": tiles.POINTS, "PART": tiles.PART, "BLOCK": tiles.BLOCK}
    source = ASTSource(tiles.search, kinds | dict.fromkeys(constants, "constexpr"), constexprs=constants)
    made = triton.compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 1})
    assert len(made.asm["cubin"]) > 0
    assert "bar.sync" not in made.asm["ptx"]
    assert made.metadata.shared == 0


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("mask", ["full", "holes", "corner"])
def test_the_loss_and_its_gradient_are_those_of_brute_force(surface, mask):
    """Value to 1e-6, winner, gradient in float64; the losers' bounds do not exceed their distances."""
    p, q, p_mask, q_mask = pair(surface, mask, (35, 50), seed=7)
    p = p.requires_grad_()
    found = robust_chamfer(p[None], q[None], p_mask[None, None], q_mask[None, None])
    found.loss.sum().backward()
    tables = [brute(p, q, p_mask, q_mask, s) for s in SHIFTS]
    losses = np.array([t.min(1).mean() + t.min(0).mean() for t in tables])
    winner = found.winner.item()
    assert found.loss.item() == pytest.approx(losses.min(), rel=1e-6, abs=1e-12)
    assert losses[winner] == pytest.approx(losses.min(), rel=1e-6, abs=1e-12)
    assert (found.candidates[0].numpy() <= losses * (1 + 1e-5) + 1e-12).all()
    exact = p.detach().double().requires_grad_()
    a, b = exact[:, p_mask].T + SHIFTS[winner].double(), q.double()[:, q_mask].T
    to_q, to_p = torch.tensor(tables[winner].argmin(1)), torch.tensor(tables[winner].argmin(0))
    ((a - b[to_q]).square().sum(1).mean() + (a[to_p] - b).square().sum(1).mean()).backward()
    if surface != "flat":  # draws between neighbours have no one gradient
        assert (p.grad.double() - exact.grad).norm() <= 1e-5 * exact.grad.norm()
    assert (p.grad[:, ~p_mask] == 0).all()


@pytest.mark.parametrize("threads", [1, 5])
def test_threads_change_nothing(threads):
    """The loss, the winner and every bound are the same bits whatever the number of threads."""
    p, q, p_mask, q_mask = (x[None] for x in pair("stepped", "holes", (150, 170)))
    before, found = torch.get_num_threads(), []
    try:
        for count in (2, threads):
            torch.set_num_threads(count)
            found.append(robust_chamfer(p, q, p_mask[None], q_mask[None]))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_a_batch_is_its_items():
    """Items do not see each other; one without points costs nothing and has no NaN in its gradient."""
    items = [pair("smooth", "holes", (19, 23)), pair("stepped", "sparse", (19, 23), 1)]
    items.append((*items[0][:2], items[0][2] & False, items[0][3]))
    p, q, p_mask, q_mask = (torch.stack(x) for x in zip(*items, strict=True))
    p = p.requires_grad_()
    both = robust_chamfer(p, q, p_mask[:, None], q_mask[:, None]).loss
    both.sum().backward()
    alone = [
        robust_chamfer(*(x[None] for x in (a, b)), *(x[None, None] for x in (m, n))).loss
        for a, b, m, n in items
    ]
    assert torch.equal(both, torch.cat(alone))
    assert both[2] == 0
    assert torch.isfinite(p.grad).all()


def facing(offset):
    """A facing plane, moved; its truth; full masks."""
    q = unproject(torch.full((1, 1, 36, 48), 0.8), K)
    mask = torch.ones(1, 1, 36, 48, dtype=torch.bool)
    return q + torch.tensor(offset)[None, :, None, None], q, mask, mask


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_bias_of_exactly_one_jitter_costs_nothing(axis, sign):
    """The minimum over seven copies forgives 10 mm along an axis entirely: eq. 1 has to supervise absolute depth."""
    q = cloud("smooth", (36, 48), np.random.default_rng(0))[None]
    p, mask = q.clone(), torch.ones(1, 1, 36, 48, dtype=torch.bool)
    p[:, axis] += sign * 0.010
    found = robust_chamfer(p, q, mask, mask)
    assert found.loss.item() < 1e-12
    assert found.winner.item() == 1 + 2 * axis + (sign > 0)


@pytest.mark.parametrize("bias", [0.005, -0.005])
def test_half_a_jitter_costs_its_square_twice(bias):
    """A z bias of 5 mm of a facing plane costs 25 mm^2 per point in each direction, to either side."""
    assert robust_chamfer(*facing((0.0, 0.0, bias))).loss.item() == pytest.approx(2 * 25e-6, rel=1e-3)


def test_lengths_scale_squared():
    """Scaling all lengths, the jitter included, by k scales the loss by k^2."""
    p, q, p_mask, q_mask = (x[None] for x in pair("smooth", "holes", (35, 50)))
    one, thrice = (
        robust_chamfer(k * p, k * q, p_mask[None], q_mask[None], 0.01 * k).loss.item() for k in (1, 3)
    )
    assert thrice == pytest.approx(9 * one, rel=1e-4)


if __name__ == "__main__":
    from triton.language import standard

    from tofcapture_model.losses.chamfer import tiles

    # Where draws may fall to any index the interpreter compares one by one, for minutes; the leftmost is one of them.
    standard._argmin_combine_tie_break_fast = standard._argmin_combine_tie_break_left
    for each in SURFACES:
        check(tiles, pair(each, "sparse" if each == "apart" else "holes", (9, 17)), shifts=SHIFTS[::3])
        print(each, flush=True)
