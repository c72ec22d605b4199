"""The compiled search of the Chamfer loss against brute force and against the torch search, on clouds of any kind."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")
pytest.importorskip("numba")

from tofcapture_model.geometry.maps import unproject
from tofcapture_model.losses.chamfer import neighbours, trees
from tofcapture_model.losses.chamfer import robust as chamfer

SHIFTS = chamfer.candidate_shifts()
MASKS = ("full", "sparse", "holes", "one pixel", "corner")


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


def depths(kind, shape, rng):
    """A depth (H, W), metres."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    depth = 0.8 + 0.002 * u + 0.03 * np.sin(v / 3) + rng.normal(0, 0.001, shape)
    if kind == "jumbled":
        depth = rng.uniform(0.2, 3.0, shape)
    elif kind == "stepped":
        depth = np.where((u // 7 + v // 5) % 2 == 0, depth, depth - 0.3)
    elif kind == "flat":
        depth = np.full(shape, 0.8)
    return torch.tensor(depth, dtype=torch.float32)


@st.composite
def pairs(draw):
    """Clouds p, q (3, H, W), masks, intrinsics."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (draw(st.integers(1, 23)), draw(st.integers(1, 29)))
    centre = [draw(st.sampled_from([0.5, -0.3, 1.4])) * (n - 1) for n in shape[::-1]]
    camera = torch.tensor([[40.0, 43.0, *centre]])
    kinds = st.sampled_from(["smooth", "jumbled", "stepped", "flat"])
    clouds = [unproject(depths(draw(kinds), shape, rng)[None, None], camera)[0] for _ in range(2)]
    clouds[0] = clouds[0] + draw(st.sampled_from([0.0, 0.004, 0.06, -0.5]))
    off = draw(st.sampled_from([0.0, 0.002]))  # of their rays
    clouds[0] = clouds[0] + off * torch.tensor(rng.normal(size=clouds[0].shape), dtype=torch.float32)
    masks = [masked(draw(st.sampled_from(MASKS)), shape, rng) for _ in range(2)]
    return (*clouds, *masks, camera[0])


def brute(p, q, p_mask, q_mask, shift):
    """Least squares of all pairs both ways in float64 (2 arrays), the nearest, and where the second is as near (to 1e-6)."""
    a, b = (c.double().numpy()[:, m.numpy()].T for c, m in ((p, p_mask), (q, q_mask)))
    apart = (((a + shift.double().numpy())[:, None] - b[None]) ** 2).sum(-1)
    out = []
    for table in (apart, apart.T):
        ordered = np.sort(table, 1)
        doubtful = (
            ordered[:, 1] <= ordered[:, 0] * (1 + 1e-5) + 1e-12
            if table.shape[1] > 1
            else np.zeros(len(table), bool)
        )
        out.append((ordered[:, 0], table.argmin(1), doubtful))
    return out


def close(found, expected):
    """Equal to 1e-5, or to what float32 resolves of a metre."""
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(pairs())
def test_all_shifts_have_the_distances_of_brute_force(pair):
    """Steps, noise, holes, single pixels, points off their rays, far clouds: every least distance, and whose it is."""
    p, q, p_mask, q_mask, _ = pair
    for one, shift in zip(trees.nearest(p, q, p_mask, q_mask, SHIFTS), SHIFTS, strict=True):
        truth = brute(p, q, p_mask, q_mask, shift)
        for way, mask in enumerate((p_mask, q_mask)):
            close(one.squared[way][mask].numpy(), truth[way][0])
        moved, index = (p + shift[:, None, None]).flatten(1).double(), one.index.flatten(1)
        own, other = moved[:, p_mask.flatten()], q.flatten(1)[:, index[0][p_mask.flatten()]].double()
        np.testing.assert_allclose((own - other).square().sum(0).numpy(), truth[0][0], rtol=1e-3, atol=1e-9)
        assert q_mask.flatten()[index[0][p_mask.flatten()]].all()
        assert p_mask.flatten()[index[1][q_mask.flatten()]].all()


@settings(max_examples=40, deadline=None)
@given(pairs())
def test_the_loss_and_its_gradient_are_those_of_brute_force(pair):
    """To 1e-5, in float64, but for the gradients of points that take part in a draw between neighbours."""
    p, q, p_mask, q_mask, camera = pair
    p = p.clone().requires_grad_()
    best = chamfer.robust_chamfer(p[None], q[None], p_mask[None, None], q_mask[None, None], camera[None])
    best.loss.sum().backward()
    every = [brute(p.detach(), q, p_mask, q_mask, s) for s in SHIFTS]
    losses = np.array([forward[0].mean() + backward[0].mean() for forward, backward in every])
    close(best.loss.item(), losses.min())
    close(losses[best.winner.item()], losses.min())
    assert (best.candidates[0].numpy() <= losses * (1 + 1e-5) + 1e-12).all()
    (_, to_q, doubt), (_, to_p, back) = every[best.winner.item()]
    a, b = (c.detach().double().numpy()[:, m.numpy()].T for c, m in ((p, p_mask), (q, q_mask)))
    a = a + SHIFTS[best.winner.item()].double().numpy()
    gradient = 2 * (a - b[to_q]) / len(a)
    np.add.at(gradient, to_p, 2 * (a[to_p] - b) / len(b))
    sure = ~doubt
    table = ((a[:, None] - b[None]) ** 2).sum(-1)
    near = table <= table.min(0) * (1 + 1e-5) + 1e-12
    sure &= ~near[:, back].any(1)
    ours = p.grad[:, p_mask].numpy().T[sure]
    np.testing.assert_allclose(ours, gradient[sure], rtol=1e-5, atol=1e-5 * np.abs(gradient).max() + 1e-12)
    assert (p.grad[:, ~p_mask] == 0).all()


@settings(max_examples=15, deadline=None)
@given(pairs())
def test_the_torch_search_finds_the_same_distances(pair):
    """The search that GPUs use is held against the compiled one."""
    *clouds, camera = pair
    ours, theirs = trees.nearest(*clouds, SHIFTS), neighbours.nearest(*clouds, camera, SHIFTS)
    for one, other in zip(ours, theirs, strict=True):
        for way in (0, 1):
            mask = clouds[2 + way]
            np.testing.assert_allclose(
                one.squared[way][mask], other.squared[way][mask], rtol=1e-3, atol=1e-10
            )


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_change_nothing(threads, monkeypatch):
    """The winner, its neighbours and every bound are the same bits whatever the number of threads."""
    monkeypatch.setattr(trees, "_WORTH_A_THREAD", 100)
    rng = np.random.default_rng(0)
    camera = torch.tensor([[40.0, 43.0, 30.0, 20.0]])
    p, q = (unproject(depths("stepped", (48, 64), rng)[None, None], camera)[0] for _ in range(2))
    mask = masked("holes", (48, 64), rng)
    expected, before = trees.nearest_of_best(p, q, mask, mask, SHIFTS), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        found = trees.nearest_of_best(p, q, mask, mask, SHIFTS)
    finally:
        torch.set_num_threads(before)
    assert found[0] == expected[0]
    assert torch.equal(found[1].index, expected[1].index)
    assert torch.equal(found[2], expected[2])


def test_without_numba_the_torch_search_gives_the_same_loss(monkeypatch):
    """Chamfer works with the model extra alone."""
    rng = np.random.default_rng(1)
    camera = torch.tensor([[40.0, 43.0, 14.0, 10.0]])
    p, q = (unproject(depths("stepped", (23, 29), rng)[None, None], camera) for _ in range(2))
    mask = masked("holes", (23, 29), rng)[None, None]
    compiled = chamfer.robust_chamfer(p, q, mask, mask, camera)
    monkeypatch.setattr(trees, "usable", lambda _: False)
    plain = chamfer.robust_chamfer(p, q, mask, mask, camera)
    assert plain.winner.item() == compiled.winner.item()
    assert plain.loss.item() == pytest.approx(compiled.loss.item(), rel=1e-5)


@pytest.mark.parametrize("count", [5, 256, 300, 2048, 4000])
def test_sharing_out_leaves_loses_no_point(count):
    """The same points with the same pixels, before as after; across steps the boxes of the leaves are far shorter along the rays."""
    from tofcapture_model.losses.chamfer.leaves import FAN, tidy

    rng = np.random.default_rng(count)
    near = rng.random(count) < 0.5
    points = np.stack([*rng.uniform(-0.02, 0.02, (2, count)), np.where(near, 0.5, 0.9)]).astype(np.float32)
    leaves = np.full((-(-count // FAN), 3, FAN), np.inf, np.float32)
    for i in range(count):
        leaves[i // FAN, :, i % FAN] = points[:, i]
    pixels = np.arange(count)
    tidy(leaves, pixels)
    assert sorted(pixels) == list(range(count))
    after = leaves.transpose(0, 2, 1).reshape(-1, 3)
    np.testing.assert_array_equal(after[:count], points.T[pixels])
    assert np.isinf(after[count:]).all()
    depth = np.where(np.isfinite(leaves[:, 2]), leaves[:, 2], leaves[:, 2, :1])
    mixed = (np.ptp(depth, axis=1) > 0.1).mean()
    assert mixed <= max(0.13, 1.01 / len(leaves)) or count < FAN


def test_bounds_of_other_shifts_are_below_their_truth_and_rise_to_it():
    """No square changes by more than the clouds are moved: from any answer to any other shift."""
    from tofcapture_model.losses.chamfer.boxes import bound

    rng = np.random.default_rng(4)
    camera = torch.tensor([[40.0, 43.0, 30.0, 20.0]])
    p, q = (unproject(depths("stepped", (24, 32), rng)[None, None], camera)[0] for _ in range(2))
    mask = torch.ones(24, 32, dtype=torch.bool)
    every = [f.squared[0].flatten().numpy() for f in trees.nearest(p, q, mask, mask, SHIFTS)]
    for known, shift in zip(every, SHIFTS, strict=True):
        for truth, other in zip(every, SHIFTS, strict=True):
            sums = np.zeros(len(known) // 16)
            bound(known, float((shift - other).norm()), sums)
            exact = truth.reshape(-1, 16).astype(float).sum(1)
            assert (sums <= exact * (1 + 1e-5) + 1e-12).all()
            if other is shift:
                np.testing.assert_allclose(sums, exact, rtol=1e-5)
