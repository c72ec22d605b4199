"""Ground truth as point clouds: one binary PLY a view, with normals and mask."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import FormatError
from tofcapture.files.layout import MASK_DOCS
from tofcapture.files.seal import replacing
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64

POINT = np.dtype([(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [("mask", "u1")])
_TYPES = {"f4": "float", "u1": "uchar"}


def ply_points(shard: ShardReader, view: int) -> NDArray[Any]:
    """(n,) structured as :data:`POINT`: ground truth at 2x wherever the ray hits, ToF frame, metres."""
    gt = shard.ground_truth(view, 2)
    hit = np.isfinite(gt.depth)
    out = np.zeros(int(hit.sum()), POINT)
    points = shard.points(view, 2)[hit]
    for i, (p, n) in enumerate((("x", "nx"), ("y", "ny"), ("z", "nz"))):
        out[p], out[n] = points[:, i], gt.normals[hit][:, i]
    out["mask"] = gt.mask[hit]
    return out


def ply_bytes(points: NDArray[Any], comments: list[str]) -> bytes:
    """Binary little-endian PLY of structured points."""
    assert points.dtype.fields is not None
    fields = [(n, _TYPES[f[0].str[1:]]) for n, f in points.dtype.fields.items()]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    header += [
        f"element vertex {len(points)}",
        *(f"property {kind} {name}" for name, kind in fields),
        "end_header",
    ]
    return "\n".join(header).encode("ascii") + b"\n" + points.tobytes()


def parse_ply(data: bytes) -> tuple[NDArray[Any], list[str]]:
    """Points and comments of what :func:`ply_bytes` wrote; :class:`FormatError` for any other PLY."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    comments = [line.removeprefix("comment ") for line in lines if line.startswith("comment ")]
    count = next((int(line.split()[-1]) for line in lines if line.startswith("element vertex")), -1)
    if count < 0 or head + b"end_header\n" != ply_bytes(np.zeros(0, POINT), comments).replace(
        b"vertex 0\n", f"vertex {count}\n".encode()
    ):
        raise FormatError("expected a PLY of tofcapture, got another header")
    if len(body) != count * POINT.itemsize:
        raise FormatError(f"expected {count} points in the PLY, got {len(body)} bytes")
    return np.frombuffer(body, POINT), comments


def pose_comment(T_base_tof: Float64) -> str:
    """One line that holds a pose exactly."""
    return "T_base_tof " + " ".join(repr(float(x)) for x in np.asarray(T_base_tof).ravel())


def export_ply(shard: ShardReader, folder: Path, unit: float) -> list[Path]:  # noqa: ARG001  PNG's unit
    """Write ``folder/view-003.ply`` for every view; the number is the view's row in the shard.

    Vertices are the ground truth at 2x, wherever the ray hits, in the ToF frame in metres; ``mask`` holds the mask bits, 0 is
    good; a comment holds the pose ``T_base_tof`` (16 numbers, by rows).
    """
    bits = ", ".join(f"{int(bit)} {bit.name}" for bit in MASK_DOCS)
    paths = []
    for view in range(shard.views):
        comments = [
            f"{shard.scene}, view {shard.index(view)}; ToF frame, metres",
            f"mask 0 is good ground truth; bits {bits}",
            pose_comment(shard.T_base_tof(view)),
        ]
        path = folder / f"view-{view:03d}.ply"
        with replacing(path) as partial:
            partial.write_bytes(ply_bytes(ply_points(shard, view), comments))
        paths.append(path)
    return paths
