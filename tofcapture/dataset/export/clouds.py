"""Write point clouds: one PLY a view."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.dataset.export.scene import SceneExport
from tofcapture.files.layout import MASK_DOCS
from tofcapture.files.seal import replacing
from tofcapture.files.shard import ShardReader

_POINT = [(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [("mask", "u1")]


def export_ply(scene: SceneExport) -> list[Path]:
    """Write ``folder/view-003.ply`` for every view; the number is the view's row in the shard.

    Vertices are the ground truth at 2x, wherever the ray hits, in the ToF frame in metres. ``mask`` holds the mask bits, 0 is
    good; ``sigma`` is there where the truth is fused. A comment holds the pose ``T_base_tof`` (16 numbers, by rows).
    """
    bits = ", ".join(f"{int(bit)} {bit.name}" for bit in MASK_DOCS)
    shard, paths = scene.shard, []
    for view in range(shard.views):
        pose = " ".join(repr(float(x)) for x in shard.T_base_tof(view).ravel())
        comments = [
            f"{scene.name}, view {shard.index(view)}; ToF frame, metres",
            f"mask 0 is good ground truth; bits {bits}",
            f"T_base_tof {pose}",
        ]
        path = scene.folder / f"view-{view:03d}.ply"
        with replacing(path) as partial:
            partial.write_bytes(_ply(_points(shard, view), comments))
        paths.append(path)
    return paths


def _points(shard: ShardReader, view: int) -> NDArray[Any]:
    gt = shard.ground_truth(view, 2)
    hit = np.isfinite(gt.depth)
    out = np.zeros(int(hit.sum()), _POINT if gt.sigma is None else [*_POINT, ("sigma", "<f4")])
    points = shard.points(view, 2)[hit]
    for i, (p, n) in enumerate((("x", "nx"), ("y", "ny"), ("z", "nz"))):
        out[p], out[n] = points[:, i], gt.normals[hit][:, i]
    out["mask"] = gt.mask[hit]
    if gt.sigma is not None:
        out["sigma"] = gt.sigma[hit]
    return out


def _ply(points: NDArray[Any], comments: list[str]) -> bytes:
    """Binary little-endian PLY of points as :data:`_POINT`."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {text}" for text in comments),
        f"element vertex {len(points)}",
        *(f"property {'uchar' if name == 'mask' else 'float'} {name}" for name in points.dtype.names or ()),
        "end_header\n",
    ]
    return "\n".join(header).encode("ascii") + points.tobytes()
