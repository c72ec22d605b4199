"""Read messages of ROS, and Foxglove's in JSON: images, compressed images, clouds, cameras, transforms."""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.importing.cameras import camera_of_table
from tofcapture.poses import Float64, transform
from tofcapture.rig import camera_from

_KINDS = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_NAMED = {
    "mono8": "8UC1",
    "mono16": "16UC1",
    "rgb8": "8UC3",
    "bgr8": "8UC3",
    "rgba8": "8UC4",
    "bgra8": "8UC4",
}
_FOXGLOVE = {
    "RawImage": "Image", "CompressedImage": "CompressedImage", "CameraCalibration": "CameraInfo", "FrameTransform": "TFMessage",
    "FrameTransforms": "TFMessage", "PoseInFrame": "PoseStamped",
}  # fmt: skip
POSES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped")
_FROM_BASE = (
    "shoulder_pan",
    "shoulder_lift",
    "elbow",
    "wrist_1",
    "wrist_2",
    "wrist_3",
)  # ROS sorts them by name
_DAMAGED = (
    "ros2 bag reindex, rosbag reindex or mcap recover mend what a killed recorder left; else copy it again"
)
Message = tuple[str, str, int, Callable[[], Any]]
"""Topic, type without its package, time of recording in nanoseconds, and what reads it."""


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Open a bag: what is called with ``(topics, start, stop)`` lists its :data:`Message`.

    Raises :class:`FormatError` for a file that is damaged or of another kind, :class:`ConfigError` without the library.
    """
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading bags needs rosbags: {err}", hint="pip install 'tofcapture[bags]'"
        ) from err
    if path.suffix.lower() == ".mcap":
        yield _of_mcap(path)
        return
    try:
        with AnyReader([path], default_typestore=_types()) as bag:

            def messages(
                topics: Any = (), start: int | None = None, stop: int | None = None
            ) -> Iterator[Message]:
                chosen = [c for c in bag.connections if not topics or c.topic in topics]
                for link, time, data in bag.messages(chosen, start, stop) if chosen else ():
                    kind, load = link.msgtype.split("/")[-1], partial(bag.deserialize, data, link.msgtype)
                    yield link.topic, kind, time, load

            yield messages
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError, struct.error) as err:
        raise FormatError(f"{path}: cannot read the bag: {err}", hint=_DAMAGED) from err


@lru_cache(maxsize=1)
def _types() -> Any:
    """ROS 2's messages, for bags that do not hold their own."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _of_mcap(path: Path) -> Callable[..., Iterator[Message]]:
    """Read one MCAP file, of ROS 1 or 2 or of Foxglove's messages in JSON or protobuf; returns what lists its messages."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
    except (McapError, OSError, struct.error, EOFError) as err:
        raise FormatError(
            f"{path}: cannot read the MCAP file: {err or type(err).__name__}", hint=_DAMAGED
        ) from err
    links = summary.channels.values() if summary else ()
    if other := sorted({c.message_encoding for c in links} - {"json", "protobuf", "cdr", "ros1"}):
        raise FormatError(
            f"{path}: expected messages of ROS, or of Foxglove in JSON or protobuf, got {', '.join(other)}",
            hint="record with ros2 bag, or write them with the SDK of Foxglove",
        )
    read: dict[int, tuple[str, Callable[[bytes], Any]]] = {}

    def messages(topics: Any = (), start: int | None = None, stop: int | None = None) -> Iterator[Message]:
        try:
            with path.open("rb") as file:
                for schema, c, m in make_reader(file).iter_messages(list(topics) or None, start, stop):
                    if c.id not in read:
                        read[c.id] = _reader_of(c.message_encoding, schema, path)
                    kind, load = read[c.id]
                    yield c.topic, kind, m.log_time, partial(load, m.data)
        except (McapError, struct.error, EOFError) as err:
            raise FormatError(f"{path}: cannot read the MCAP file: {err}", hint=_DAMAGED) from err

    return messages


def _reader_of(encoding: str, schema: Any, path: Path) -> tuple[str, Callable[[bytes], Any]]:
    """Return a type without its package and what reads a message of it: of ROS by its own definition, else of Foxglove."""
    name = schema.name if schema else ""
    if encoding in {"json", "protobuf"}:
        kind = _FOXGLOVE.get(name.split(".")[-1], name)
        known = kind != name and encoding == "protobuf"
        table = _protobuf(schema.data, name, path) if known else json.loads
        return kind, lambda data: _foxglove(table(data), kind)
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    name, text = (
        name if "/msg/" in name else name.replace("/", "/msg/"),
        schema.data.decode() if schema else "",
    )
    types = get_typestore(Stores.EMPTY) if text else _types()
    if schema and schema.encoding == "ros2idl":
        for part in re.split(r"^=+\nIDL: .*$", text, flags=re.MULTILINE):
            types.register(get_types_from_idl(part) if part.strip() else {})
    elif text:
        types.register(get_types_from_msg(text, name))
    read = types.deserialize_ros1 if encoding == "ros1" else types.deserialize_cdr
    return name.split("/")[-1], lambda data: read(data, name)


def _protobuf(definition: bytes, name: str, path: Path) -> Callable[[bytes], dict[str, Any]]:
    """Return what reads messages of protobuf as dictionaries, by the definition that the file holds of them."""
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet
        from google.protobuf.descriptor_pool import DescriptorPool
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass
    except ImportError as err:
        raise ConfigError(f"{path}: reading protobuf needs it: {err}", hint="pip install protobuf") from err
    pool = DescriptorPool()
    try:
        for one in FileDescriptorSet.FromString(definition).file:
            pool.Add(one)
        kind = GetMessageClass(pool.FindMessageTypeByName(name))
    except (DecodeError, KeyError, TypeError) as err:
        raise FormatError(f"{path}: the schema of {name} cannot be read: {err}", hint=_DAMAGED) from err

    def table(message: Any) -> dict[str, Any]:
        found = {f.name: getattr(message, f.name) for f in message.DESCRIPTOR.fields}
        return {k: _plain(v) for k, v in found.items()}

    def _plain(value: Any) -> Any:
        if hasattr(value, "DESCRIPTOR"):
            return table(value)
        return value if isinstance(value, str | bytes | int | float) else [_plain(v) for v in value]

    return lambda data: table(kind.FromString(data))


def _foxglove(told: Mapping[str, Any], kind: str) -> Any:
    """Give a message of Foxglove's the names that ROS's has."""
    if "transforms" in told:
        return SimpleNamespace(transforms=[_foxglove(t, kind).transforms[0] for t in told["transforms"]])
    time = told["timestamp"]
    nanoseconds = next((int(time[k]) for k in ("nsec", "nanos", "nanosec") if k in time), 0)
    stamp = SimpleNamespace(sec=int(time.get("sec", time.get("seconds", 0))), nanosec=nanoseconds)
    header = SimpleNamespace(stamp=stamp, frame_id=told.get("frame_id", told.get("parent_frame_id", "")))
    if kind == "TFMessage":
        move, turn = (SimpleNamespace(**told[k]) for k in ("translation", "rotation"))
        link = SimpleNamespace(translation=move, rotation=turn)
        one = SimpleNamespace(header=header, child_frame_id=told["child_frame_id"], transform=link)
        return SimpleNamespace(transforms=[one])
    if kind == "PoseStamped":
        pose = SimpleNamespace(**{k: SimpleNamespace(**told["pose"][k]) for k in ("position", "orientation")})
        return SimpleNamespace(header=header, pose=pose)
    rest = {k: v for k, v in told.items() if k not in {"timestamp", "frame_id", "data"}}
    values = told.get("data", b"")
    values = np.frombuffer(values if isinstance(values, bytes) else base64.b64decode(values), np.uint8)
    return SimpleNamespace(header=header, data=values, is_bigendian=0, **rest)


def stamp_of(message: Any) -> int:
    """Return the stamp of a message's header, nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def image_of(message: Any, where: str) -> NDArray[Any]:
    """Read an image, a compressed one or a cloud: (H, W), (H, W, C) or points (H, W, 3).

    Raises :class:`FormatError` for encodings that lose values, with what to record instead.
    """
    if hasattr(message, "fields"):
        return _cloud(message, where)
    if hasattr(message, "format"):
        return _compressed(bytes(message.data), message.format.lower(), where)
    name = _NAMED.get(message.encoding, message.encoding)
    found = re.fullmatch(r"(8U|8S|16U|16S|32S|32F|64F)C(\d+)", name)
    if found is None:
        raise FormatError(
            f"{where}: expected an encoding such as 16UC1, 16SC1, 32FC1 or mono16, got {message.encoding}",
            hint="record the raw or depth topic, not a picture of it",
        )
    kind, C = np.dtype((">" if message.is_bigendian else "<") + _KINDS[found[1]]), int(found[2])
    H, W, step = message.height, message.width, message.step or message.width * C * kind.itemsize
    data = np.asarray(message.data, np.uint8)
    if data.size < H * step or step < W * C * kind.itemsize:
        raise DataError(
            f"{where}: expected {H} rows of {W * C * kind.itemsize} bytes ({message.encoding}), got {data.size} bytes, step {step}"
        )
    rows = data[: H * step].reshape(H, step)[:, : W * C * kind.itemsize]
    out = np.ascontiguousarray(rows).view(kind).reshape((H, W) if C == 1 else (H, W, C))
    return out.astype(kind.newbyteorder("="))


def _compressed(data: bytes, told: str, where: str) -> NDArray[Any]:
    """Decode PNG, TIFF and ROS's compressedDepth: 12 bytes before a PNG, which holds inverse depth where depth was float."""
    import cv2

    at = data.find(b"\x89PNG\r\n\x1a\n", 0, 64)
    if "jpeg" in told or "jpg" in told or "rvl" in told or data[:2] == b"\xff\xd8":
        lost = "rvl is not read" if "rvl" in told else "JPEG loses what is measured"
        raise FormatError(
            f"{where}: expected lossless images, got {told}: {lost}",
            hint="ros2 run image_transport republish compressed raw, or record the raw topic or compressedDepth with png",
        )
    found = cv2.imdecode(np.frombuffer(data, np.uint8, offset=max(at, 0)), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise FormatError(f"{where}: expected a PNG or TIFF, got {len(data)} bytes of {told!r}")
    out = np.asarray(found)
    if at == 12 and "32fc1" in told:
        _, a, b = struct.unpack("<iff", data[:12])
        out = np.where(out > 0, np.float32(a) / (out.astype(np.float32) - np.float32(b)), np.float32(np.nan))
    return out


def _cloud(message: Any, where: str) -> NDArray[Any]:
    fields = {f.name: f for f in message.fields}
    H, W = message.height, message.width
    if not {"x", "y", "z"} <= fields.keys() or H < 2:
        got = "a cloud without rows and columns" if H < 2 else f"fields {', '.join(fields)}"
        raise FormatError(
            f"{where}: expected an organised cloud with x, y, z, got {got}",
            hint="record the camera's organised point map or its depth image; filters and voxel grids lose the rows",
        )
    kinds = {7: "f4", 8: "f8"}
    kind = np.dtype(
        {
            "names": list("xyz"),
            "formats": [
                (">" if message.is_bigendian else "<") + kinds.get(fields[n].datatype, "f4") for n in "xyz"
            ],
            "offsets": [fields[n].offset for n in "xyz"],
            "itemsize": message.point_step,
        }
    )
    rows = np.asarray(message.data, np.uint8).reshape(H, message.row_step)[:, : W * message.point_step]
    points = np.ascontiguousarray(rows).view(kind).reshape(H, W)
    return np.stack([points[n] for n in "xyz"], axis=-1).astype(np.float32)


def camera_of(message: Any, where: str, *, rectified: bool) -> Camera:
    """Read a CameraInfo: K and D of a raw image, P of a rectified one; :class:`DataError` when nobody calibrated it."""
    told = {str(k).lower(): v for k, v in vars(message).items()} if hasattr(message, "__dict__") else {}
    if not told:
        told = {n.lower(): getattr(message, n) for n in getattr(message, "__slots__", ())}
    P = np.reshape(told["p"] if np.size(told["p"]) == 12 else np.zeros(12), (3, 4))
    if rectified and P[0, 0]:
        told |= {"k": P[:, :3].ravel(), "d": [], "distortion_model": ""}
    if not np.any(np.ravel(told["k"])[:1]):
        raise DataError(
            f"{where}: expected a calibrated camera, got a CameraInfo of zeros",
            hint="--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3]",
        )
    told["roi"] = (
        {k: getattr(told["roi"], k) for k in ("x_offset", "y_offset", "width", "height")}
        if told.get("roi")
        else {}
    )
    return camera_from(
        camera_of_table({k: v for k, v in told.items() if k not in {"header", "r", "p", "data"}}, where)
        or {},
        where,
    )


def transforms_of(message: Any) -> Iterator[tuple[str, str, int, Float64]]:
    """List parent, child, stamp and (4, 4) of a message of transforms; NaN where it holds none."""
    for one in message.transforms:
        T = _rigid(one.transform.translation, one.transform.rotation)
        yield one.header.frame_id.strip("/"), one.child_frame_id.strip("/"), stamp_of(one), T


def pose_of(message: Any) -> tuple[str, str, int, Float64]:
    """Return what :func:`transforms_of` does for a message of one pose; the child is empty where it does not say of what."""
    if hasattr(message, "transform"):
        T = _rigid(message.transform.translation, message.transform.rotation)
    else:
        pose = getattr(message.pose, "pose", message.pose)  # one with covariance
        T = _rigid(pose.position, pose.orientation)
    child = getattr(message, "child_frame_id", "")
    return message.header.frame_id.strip("/"), child.strip("/"), stamp_of(message), T


def _rigid(t: Any, q: Any) -> Float64:
    from scipy.spatial.transform import Rotation

    numbers = np.array([q.x, q.y, q.z, q.w, t.x, t.y, t.z])
    if not np.isfinite(numbers).all() or not numbers[:4].any():
        return np.full((4, 4), np.nan)
    return transform(Rotation.from_quat(numbers[:4]).as_matrix(), numbers[4:])


def joints_of(message: Any) -> tuple[int, Float64] | None:
    """Return stamp and angles (6,) of an arm from the base on; ``None`` for a gripper, or an arm of other joints."""
    arm = [i for i, n in enumerate(message.name) if not re.search("finger|gripper|hand", n)]
    if len(arm) != 6 or len(message.position) != len(message.name):
        return None
    ranks = [next((r for r, w in enumerate(_FROM_BASE) if w in message.name[i]), 0) for i in arm]
    arm = [i for _, _, i in sorted(zip(ranks, range(6), arm, strict=True))]
    return stamp_of(message), np.array([float(message.position[i]) for i in arm])
