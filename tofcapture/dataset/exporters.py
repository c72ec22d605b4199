"""One scene of a shard as point clouds (PLY), as 16-bit depth images (PNG), or as a recording that Foxglove plays (MCAP)."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.layout import MASK_DOCS
from tofcapture.files.png import png_bytes
from tofcapture.files.seal import replacing, write_text
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64

LARGEST = 65535  # steps of PNG depth
_POINT = np.dtype([(n, "<f4") for n in ("x", "y", "z", "nx", "ny", "nz")] + [("mask", "u1")])


def export_ply(shard: ShardReader, folder: Path, unit: float) -> list[Path]:  # noqa: ARG001  PNG's unit
    """Write ``folder/view-003.ply`` for every view; the number is the view's row in the shard.

    Vertices are the ground truth at 2x, wherever the ray hits, in the ToF frame in metres. ``mask`` holds the mask bits, 0 is
    good. A comment holds the pose ``T_base_tof`` (16 numbers, by rows).
    """
    bits = ", ".join(f"{int(bit)} {bit.name}" for bit in MASK_DOCS)
    paths = []
    for view in range(shard.views):
        pose = " ".join(repr(float(x)) for x in shard.T_base_tof(view).ravel())
        comments = [
            f"{shard.scene}, view {shard.index(view)}; ToF frame, metres",
            f"mask 0 is good ground truth; bits {bits}",
            f"T_base_tof {pose}",
        ]
        path = folder / f"view-{view:03d}.ply"
        with replacing(path) as partial:
            partial.write_bytes(_ply(_points(shard, view), comments))
        paths.append(path)
    return paths


def _points(shard: ShardReader, view: int) -> NDArray[Any]:
    gt = shard.ground_truth(view, 2)
    hit = np.isfinite(gt.depth)
    out = np.zeros(int(hit.sum()), _POINT)
    points = shard.points(view, 2)[hit]
    for i, (p, n) in enumerate((("x", "nx"), ("y", "ny"), ("z", "nz"))):
        out[p], out[n] = points[:, i], gt.normals[hit][:, i]
    out["mask"] = gt.mask[hit]
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


def export_png(shard: ShardReader, folder: Path, unit: float) -> list[Path]:
    """Write ``tof-003.png``, ``depth-003.png`` and ``mask-003.png`` for every view, and ``cameras.json``.

    Depth is z in steps of ``unit`` metres, at most half a step off, 0 is none. The unit also stands in each picture's text
    chunk ``unit_m``. ``mask`` holds the mask bits, 8 bits a pixel. ``cameras.json`` has the unit, the intrinsics at 1x and 2x
    (pixel centres at whole numbers) and each view's pose.
    """
    paths = []
    for view in range(shard.views):
        gt = shard.ground_truth(view, 2)
        where = f"{shard.path}: view {view}"
        images: dict[str, NDArray[Any]] = {
            "tof": _quantised(shard.tof(view).depth, unit, where),
            "depth": _quantised(gt.depth, unit, where),
            "mask": gt.mask,
        }
        for name, image in images.items():
            path = folder / f"{name}-{view:03d}.png"
            with replacing(path) as partial:
                partial.write_bytes(png_bytes(image, {} if name == "mask" else {"unit_m": repr(unit)}))
            paths.append(path)
    cameras = {
        "scene": shard.scene,
        "unit_m": unit,
        "none": 0,
        "tof": asdict(shard.camera),
        "depth": asdict(shard.camera.scaled(2)),
        "views": [
            {"index": shard.index(v), "T_base_tof": shard.T_base_tof(v).tolist()} for v in range(shard.views)
        ],
    }
    write_text(folder / "cameras.json", json.dumps(cameras, indent=1) + "\n")
    return [*paths, folder / "cameras.json"]


def _quantised(depth: NDArray[np.floating], unit: float, where: str) -> NDArray[np.uint16]:
    """Depth (H, W), metres, as whole steps of ``unit``; 0 is none."""
    known = np.isfinite(depth)
    steps = np.rint(np.where(known, depth, 0.0).astype(np.float64) / unit)
    if steps.max(initial=0) > LARGEST or (known & (steps < 1)).any():
        raise DataError(
            f"{where}: expected depth from {unit:g} to {LARGEST * unit:g} m in steps of {unit:g} m, "
            f"got {np.nanmin(depth):g} to {np.nanmax(depth):g} m",
            hint="--unit 0.001",
        )
    return steps.astype(np.uint16)


def export_mcap(shard: ShardReader, folder: Path, unit: float) -> list[Path]:  # noqa: ARG001  PNG's unit
    """Write ``folder/<scene>.mcap`` in Foxglove's JSON schemas: images, calibration, poses.

    Each view stands at the time of its first frame. Depth is in metres as 32-bit floats, NaN is none.

    Raises
    ------
    ConfigError
        The library ``mcap`` is missing.
    """
    try:
        from mcap.writer import Writer
    except ImportError as err:
        raise ConfigError(
            f"MCAP needs the library mcap: {err}", hint="pip install 'tofcapture[export]'"
        ) from err
    path = folder / f"{shard.scene}.mcap"
    with replacing(path) as partial, partial.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="tofcapture")
        schemas = {
            name: writer.register_schema(f"foxglove.{name}", "jsonschema", json.dumps(_typed(kinds)).encode())
            for name, kinds in _SCHEMAS.items()
        }
        writer.add_metadata("tofcapture", {"scene": shard.scene, "views": str(shard.views)})
        channels: dict[str, int] = {}
        for view in range(shard.views):
            at = shard.time_ns(view, 0)
            stamp = {"sec": at // 10**9, "nsec": at % 10**9}
            for topic, schema, message in _messages(shard, view):
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "json", schemas[schema])
                data = json.dumps({"timestamp": stamp, **message}).encode()
                writer.add_message(channels[topic], at, data, at, view)
        writer.finish()
    return [path]


_STAMP = {"sec": "integer", "nsec": "integer"}
_SCHEMAS: dict[str, dict[str, Any]] = {
    "RawImage": {
        "timestamp": _STAMP,
        **dict.fromkeys(("frame_id", "encoding"), "string"),
        **dict.fromkeys(("width", "height", "step"), "integer"),
        "data": "base64",
    },
    "CameraCalibration": {
        "timestamp": _STAMP,
        **dict.fromkeys(("frame_id", "distortion_model"), "string"),
        **dict.fromkeys(("width", "height"), "integer"),
        **dict.fromkeys(("D", "K", "R", "P"), "numbers"),
    },
    "FrameTransform": {
        "timestamp": _STAMP,
        **dict.fromkeys(("parent_frame_id", "child_frame_id"), "string"),
        "translation": dict.fromkeys("xyz", "number"),
        "rotation": dict.fromkeys("xyzw", "number"),
    },
}
_ENCODINGS = {"float32": "32FC1", "uint8": "8UC1", "uint16": "16UC1"}


def _typed(kind: Any) -> dict[str, Any]:
    """JSON schema of a table of names and kinds."""
    if isinstance(kind, dict):
        return {"type": "object", "properties": {name: _typed(k) for name, k in kind.items()}}
    if kind == "numbers":
        return {"type": "array", "items": {"type": "number"}}
    return {"type": "string", "contentEncoding": "base64"} if kind == "base64" else {"type": kind}


def _messages(shard: ShardReader, view: int) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Topic, schema and message of everything of one view."""
    tof, gt = shard.tof(view), shard.ground_truth(view, 2)
    yield "/tf", "FrameTransform", _pose(shard.T_base_tof(view))
    yield "/tof/calibration", "CameraCalibration", _calibration(shard.camera)
    yield "/gt/calibration", "CameraCalibration", _calibration(shard.camera.scaled(2))
    images: dict[str, NDArray[Any]] = {
        "/tof/depth": tof.depth,
        "/tof/confidence": tof.confidence,
        "/tof/flags": tof.flags,
        "/gt/depth": gt.depth,
        "/gt/mask": gt.mask,
    }
    for topic, image in images.items():
        yield topic, "RawImage", _image(image)


def _image(image: NDArray[Any]) -> dict[str, Any]:
    H, W = image.shape
    little = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    return {
        "frame_id": "tof",
        "width": W,
        "height": H,
        "encoding": _ENCODINGS[image.dtype.name],
        "step": W * image.dtype.itemsize,
        "data": base64.b64encode(little.tobytes()).decode("ascii"),
    }


def _calibration(camera: Camera) -> dict[str, Any]:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return {
        "frame_id": "tof",
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "plumb_bob",
        "D": list(camera.distortion) or [0.0] * 5,  # both have k1, k2, p1, p2, k3
        "K": K,
        "R": np.eye(3).ravel().tolist(),
        "P": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
    }


def _pose(T_base_tof: Float64) -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(T_base_tof[:3, :3]).as_quat(canonical=True).tolist()
    return {
        "parent_frame_id": "base",
        "child_frame_id": "tof",
        "translation": dict(zip("xyz", T_base_tof[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quaternion, strict=True)),
    }
