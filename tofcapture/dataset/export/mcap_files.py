"""Write recordings that Foxglove plays: one MCAP file a scene, in Foxglove's JSON schemas."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.dataset.export.scene import SceneExport, quaternion
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64


def export_mcap(scene: SceneExport) -> list[Path]:
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
    shard, path = scene.shard, scene.folder / f"{scene.name}.mcap"
    with replacing(path) as partial, partial.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="tofcapture")
        schemas = {
            name: writer.register_schema(f"foxglove.{name}", "jsonschema", json.dumps(_typed(kinds)).encode())
            for name, kinds in _SCHEMAS.items()
        }
        writer.add_metadata("tofcapture", {"scene": scene.name, "views": str(shard.views)})
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
        "distortion_model": "rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob",
        "D": list(camera.distortion) or [0.0] * 5,  # OpenCV's order, as the camera has it
        "K": K,
        "R": np.eye(3).ravel().tolist(),
        "P": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
    }


def _pose(T_base_tof: Float64) -> dict[str, Any]:
    return {
        "parent_frame_id": "base",
        "child_frame_id": "tof",
        "translation": dict(zip("xyz", T_base_tof[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quaternion(T_base_tof), strict=True)),
    }
