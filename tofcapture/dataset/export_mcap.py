"""One MCAP file a scene, in Foxglove's JSON schemas: depth, amplitude, ground truth, mask, calibration, poses."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64

_ENCODINGS = {"float32": "32FC1", "uint8": "8UC1", "uint16": "16UC1"}
_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_XYZ = dict.fromkeys("xyz", _NUMBER)
_NUMBERS = {"type": "array", "items": _NUMBER}
SCHEMAS = {
    "foxglove.RawImage": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        width=_INTEGER,
        height=_INTEGER,
        encoding=_TEXT,
        step=_INTEGER,
        data={"type": "string", "contentEncoding": "base64"},
    ),
    "foxglove.CameraCalibration": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        width=_INTEGER,
        height=_INTEGER,
        distortion_model=_TEXT,
        **dict.fromkeys(("D", "K", "R", "P"), _NUMBERS),
    ),
    "foxglove.FrameTransform": _object(
        timestamp=_TIME,
        parent_frame_id=_TEXT,
        child_frame_id=_TEXT,
        translation=_object(**_XYZ),
        rotation=_object(**_XYZ, w=_NUMBER),
    ),
}
Message = tuple[str, str, dict[str, Any]]


def quaternion(R: Float64) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a rotation matrix (3, 3): eigenvector of its symmetric 4 x 4 form (Bar-Itzhack, 2000), w >= 0."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    lower = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    q = np.linalg.eigh(lower / 3, UPLO="L")[1][:, -1]
    x, y, z, w = (q if q[3] >= 0 else -q).tolist()
    return x, y, z, w


def raw_image(image: NDArray[Any], frame: str) -> dict[str, Any]:
    """Foxglove's RawImage of an (H, W) array; every bit is kept."""
    H, W = image.shape
    little = np.ascontiguousarray(image, image.dtype.newbyteorder("<"))
    return {
        "frame_id": frame,
        "width": W,
        "height": H,
        "encoding": _ENCODINGS[image.dtype.name],
        "step": W * image.dtype.itemsize,
        "data": base64.b64encode(little.tobytes()).decode("ascii"),
    }


def image_of(message: dict[str, Any]) -> NDArray[Any]:
    """Read what :func:`raw_image` wrote."""
    name = {v: k for k, v in _ENCODINGS.items()}[message["encoding"]]
    flat = np.frombuffer(base64.b64decode(message["data"]), np.dtype(name).newbyteorder("<"))
    return flat.reshape(message["height"], message["width"])


def _calibration(camera: Camera) -> dict[str, Any]:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
    R = np.eye(3).ravel().tolist()
    size = {"width": camera.width, "height": camera.height}
    return {
        "frame_id": "tof",
        **size,
        "distortion_model": "plumb_bob",
        "D": list(camera.distortion) or [0.0] * 5,  # both have k1, k2, p1, p2, k3
        "K": K,
        "R": R,
        "P": P,
    }


def _pose(T_base_tof: Float64) -> dict[str, Any]:
    return {
        "parent_frame_id": "base",
        "child_frame_id": "tof",
        "translation": dict(zip("xyz", T_base_tof[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", quaternion(T_base_tof[:3, :3]), strict=True)),
    }


def view_messages(shard: ShardReader, view: int) -> Iterator[Message]:
    """Topic, schema and message of everything of one view."""
    tof, gt = shard.tof(view), shard.ground_truth(view, 2)
    yield "/tf", "foxglove.FrameTransform", _pose(shard.T_base_tof(view))
    yield "/tof/calibration", "foxglove.CameraCalibration", _calibration(shard.camera)
    yield "/gt/calibration", "foxglove.CameraCalibration", _calibration(shard.camera.scaled(2))
    images: dict[str, NDArray[Any]] = {
        "/tof/depth": tof.depth,
        "/tof/confidence": tof.confidence,
        "/tof/flags": tof.flags,
        "/gt/depth": gt.depth,
        "/gt/mask": gt.mask,
    }
    for topic, image in images.items():
        yield topic, "foxglove.RawImage", raw_image(image, "tof")


def export_mcap(shard: ShardReader, folder: Path, unit: float) -> list[Path]:  # noqa: ARG001  PNG's unit
    """Write ``folder/<scene>.mcap``: each view at the time of its first frame, depth in metres as 32-bit floats, NaN for none.

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
            name: writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            for name, schema in SCHEMAS.items()
        }
        writer.add_metadata("tofcapture", {"scene": shard.scene, "views": str(shard.views)})
        channels: dict[str, int] = {}
        for view in range(shard.views):
            at = shard.time_ns(view, 0)
            stamp = {"sec": at // 10**9, "nsec": at % 10**9}
            for topic, schema, message in view_messages(shard, view):
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, "json", schemas[schema])
                data = json.dumps({"timestamp": stamp, **message}).encode()
                writer.add_message(channels[topic], at, data, at, view)
        writer.finish()
    return [path]
