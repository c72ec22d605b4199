"""The Chamfer loss's search for GPUs: on one where there is one, else by Triton's interpreter, against brute force and the torch search."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import os
import subprocess
import sys

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("triton", reason="Triton comes with PyTorch's wheels for GPUs")

from tofcapture_model.geometry.maps import unproject
from tofcapture_model.losses.chamfer import neighbours, tile_search
from tofcapture_model.losses.chamfer import robust as chamfer

CAMERA = torch.tensor([[25.0, 26.0, 10.0, 6.0]])
SHAPE = (13, 21)  # no multiple of a tile's side
KINDS = ("smooth", "stepped", "jumbled", "apart", "sparse", "one point")


def pair(kind: str, device: str):
    """Clouds (3, H, W) and masks (H, W)."""
    g = torch.Generator().manual_seed(KINDS.index(kind))
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in SHAPE), indexing="ij")
    depths = [
        0.8 + 0.002 * u + 0.03 * torch.sin(v / 3) + 0.001 * torch.randn(SHAPE, generator=g) for _ in "pq"
    ]
    share = {"sparse": 0.05, "one point": 0.0}.get(kind, 0.9)
    masks = [torch.rand(SHAPE, generator=g) < share for _ in "pq"]
    for k in (0, 1):
        masks[k][7 + k, 3 + 14 * k] = True
        if kind == "stepped":
            depths[k] -= 0.3 * ((u // 7 + v // 5) % 2)
        if kind == "jumbled":
            depths[k] = 0.2 + 2.8 * torch.rand(SHAPE, generator=g)
    depths[0] += 0.06 if kind == "apart" else 0.004
    clouds = [unproject(d[None, None], CAMERA)[0] for d in depths]
    return [x.to(device) for x in (*clouds, *masks)]


def brute(p, q, p_mask, q_mask, shift):
    """(H, W) squared distances of P + s to Q, and of Q to P + s, float64."""
    a, b = (c.double().flatten(1).T for c in (p, q))
    apart = ((a + shift.double())[:, None] - b[None]).square().sum(-1)
    apart = apart.masked_fill(~p_mask.flatten()[:, None] | ~q_mask.flatten(), torch.inf)
    return apart.amin(1).view(SHAPE), apart.amin(0).view(SHAPE)


def check(kind: str, device: str) -> None:
    """Distances, neighbours, the best shift and its distance: all as they have to be."""
    p, q, p_mask, q_mask = clouds = pair(kind, device)
    shifts = chamfer.candidate_shifts().to(device)[[0, 1, 6]]
    means = []
    for found, shift in zip(tile_search.nearest(*clouds, shifts), shifts, strict=True):
        moved = shift[:, None, None]
        ways = ((p + moved, q, p_mask), (q - moved, p, q_mask))
        means.append(0.0)
        for k, (own, other, mask) in enumerate(ways):
            expected = brute(p, q, p_mask, q_mask, shift)[k][mask].float()
            told = found.squared[k][mask]
            other_mask = (q_mask, p_mask)[k].flatten()
            assert other_mask[found.index[k][mask]].all(), f"{kind}: a masked neighbour"
            reached = other.flatten(1)[:, found.index[k].flatten()].view_as(own)
            torch.testing.assert_close(told, expected, rtol=1e-4, atol=1e-12)
            torch.testing.assert_close((own - reached).square().sum(0)[mask], told, rtol=1e-4, atol=1e-12)
            means[-1] += float(expected.double().mean())
    best, found, distances = tile_search.nearest_of_best(*clouds, shifts)
    assert best == means.index(min(means))
    assert distances.tolist() == pytest.approx(means, rel=1e-5)
    of_torch = neighbours.nearest(*clouds, CAMERA[0].to(device), shifts[best : best + 1])[0]
    for k, mask in enumerate((p_mask, q_mask)):
        torch.testing.assert_close(found.squared[k][mask], of_torch.squared[k][mask], rtol=1e-4, atol=1e-12)


def test_the_interpreted_kernel_finds_the_nearest():
    """Smooth, stepped, random, distant and sparse clouds: as brute force. Triton has to be told before it is imported."""
    done = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split("\n")[:-1] == list(KINDS)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_the_kernel_finds_the_nearest(kind):
    """The same on a GPU, and the loss takes this search there."""
    assert tile_search.usable(torch.device("cuda"))
    check(kind, "cuda")


@pytest.mark.parametrize("with_codes", [False, True])
def test_the_kernel_compiles_for_a_gpu(with_codes, monkeypatch, tmp_path):
    """For compute capability 9.0, without such a GPU: one warp needs neither barriers nor memory to spill to."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from tofcapture_model.losses.chamfer import nearest_tiles as kernel

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("TRITON_DEFAULT_FP_FUSION", "1")  # what it does unset, with a warning
    kinds = dict.fromkeys(("points", "boxes", "shifts", "squared"), "*fp32") | {
        "codes": "*i32",
        "tiles": "i32",
    }
    constants = {
        "WITH_CODES": with_codes,
        "POINTS": kernel.POINTS,
        "PART": kernel.PART,
        "BLOCK": kernel.BLOCK,
    }
    source = ASTSource(kernel.search, kinds | dict.fromkeys(constants, "constexpr"), constexprs=constants)
    made = triton.compile(source, target=GPUTarget("cuda", 90, 32), options={"num_warps": 1})
    assert len(made.asm["cubin"]) > 0
    assert "bar.sync" not in made.asm["ptx"]
    assert made.metadata.shared == 0


if __name__ == "__main__":
    for each in KINDS:
        check(each, "cpu")
        print(each, flush=True)
