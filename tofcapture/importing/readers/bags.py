"""Read bags of ROS 1 and 2, and MCAP, without ROS: frames of raw images with the ground truth and the pose of their moment.

Frames are the messages of the topic that has fewest; every other topic gives its message nearest in time. Poses come from tf,
PoseStamped or Odometry, interpolated; an arm's joints from JointState. Which topics are raw, ground truth and poses, their names
say, or ``[raw] files``, ``[truth] files`` and ``[poses] file``.
"""

from __future__ import annotations

import re
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, PassedOver
from tofcapture.importing.poses import pose_at
from tofcapture.importing.readers.messages import (
    POSES,
    camera_of,
    image_of,
    joints_of,
    opened,
    pose_of,
    stamp_of,
    transforms_of,
)  # fmt: skip
from tofcapture.importing.said import Facts, Said
from tofcapture.importing.source import Piece, natural
from tofcapture.poses import Float64, invert

PICTURES = ("Image", "CompressedImage", "PointCloud2")
TRUTH = frozenset(
    ["depth", "depths", "gt", "truth", "ground", "points", "cloud", "xyz", "stereo", "disparity"]
)
OTHER = frozenset(
    [
        "amplitude",
        "confidence",
        "flags",
        "mask",
        "ir",
        "infra",
        "intensity",
        "rgb",
        "color",
        "colour",
        "rect",
        "preview",
        "ambient",
    ]
)
_LOST = 0.2  # of the frames that may lack a message of another topic; more is a damaged recording
_FASTER = 5.0  # times, that stamps may run apart from the recording
_SET_BACK = 1.0  # s that stamps may go back: messages overtake each other by less


@dataclass
class _Topic:
    """What a bag holds of one topic of images."""

    kind: str
    frame: str = ""
    encoding: str = ""
    stamps: list[int] = field(default_factory=list)  # ns, of the headers or of recording
    received: list[int] = field(default_factory=list)  # ns


@dataclass
class _Bag:
    """What a bag holds."""

    path: Path
    topics: dict[str, _Topic] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)  # type by topic
    cameras: dict[str, Any] = field(default_factory=dict)  # CameraInfo by topic
    links: dict[str, tuple[str, list[tuple[int, Float64]]]] = field(default_factory=dict)  # by child
    poses: dict[str, list[tuple[str, str, int, Float64]]] = field(default_factory=dict)  # by topic, as of tf
    joints: list[tuple[int, Float64]] = field(default_factory=list)


def claims(path: Path) -> bool:
    """Tell by the suffix; a folder of ROS 2 has ``metadata.yaml``."""
    return (
        path.suffix.lower() in {".bag", ".mcap", ".db3"}
        if path.is_file()
        else (path / "metadata.yaml").is_file()
    )


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List frames (K, H, W), their ground truth and pose; names are ``/topic/view000012``."""
    bag = _looked_through(path, said)
    raw, truth = _chosen(bag, said)
    camera = _camera(bag, raw[0])
    if camera is None and not {"fx", "fy", "cx", "cy"} <= said.tof.keys():
        raise ConfigError(
            f"{path}: expected a CameraInfo beside {raw[0]}, got {', '.join(bag.cameras) or 'none'}",
            hint="--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], or --camera FILE; record the camera_info topic with the images",
        )
    K = len(said.channels(Facts())[0])
    size = said.size(Facts(camera=camera))
    turns = K if len(raw) == 1 and _alternates(bag, raw[0], K, size) else 1
    rows = _frames(bag, raw, truth, turns, said)
    facts, T_tof_truth = Facts(camera=camera, axes="KHW"), None
    known = _truth_facts(bag, truth) if truth else Facts()
    frame = bag.topics[raw[0]].frame
    _hang_poses(bag, frame, said)
    if truth and bag.topics[truth].frame:
        T_tof_truth = _between(bag, frame, bag.topics[truth].frame, rows[0][0], said)
    file = _file(path)
    for i, (time, held, target) in enumerate(rows):
        pose, load = _between(bag, "", frame, time, said), partial(_stacked, path, held, K, size)
        joints = None if pose is None else _joints(bag, time, said)
        yield Piece(f"{raw[0]}/view{i:06d}", file, load, "raw", time, facts, pose, joints)
        if truth and target is not None:
            load = partial(_message, path, truth, target)
            yield Piece(f"{truth}/view{i:06d}", file, load, "truth", time, known, T_tof_truth)


def _file(path: Path) -> Path:
    """File whose digest stands for the bag: of a folder its only storage, else what lists them."""
    if path.is_file():
        return path
    held = [p for p in path.iterdir() if p.suffix in {".mcap", ".db3"}]
    return held[0] if len(held) == 1 else path / "metadata.yaml"


def _looked_through(path: Path, said: Said) -> _Bag:
    """Read stamps, cameras and transforms; :class:`DataError` for no images, or stamps that are none."""
    bag, received = _Bag(path), said.raw.get("stamps") == "received"
    with opened(path) as messages:
        for topic, kind, time, load in messages():
            bag.others[topic] = kind
            if kind in PICTURES:
                message = load()
                held = bag.topics.setdefault(topic, _Topic(kind, message.header.frame_id.strip("/")))
                held.encoding = getattr(message, "encoding", getattr(message, "format", ""))
                held.stamps.append(time if received else stamp_of(message))
                held.received.append(time)
            elif kind == "CameraInfo":
                bag.cameras.setdefault(topic, load())
            elif kind in {"TFMessage", "tfMessage"}:
                for parent, child, stamp, T in transforms_of(load()):
                    known = bag.links.setdefault(child, (parent, []))[1]
                    if topic.endswith("tf_static"):  # published again by every node that starts
                        known.clear()
                    known.append((stamp, T))
            elif kind in POSES:
                bag.poses.setdefault(topic, []).append(pose_of(load()))
            elif kind == "JointState" and (row := joints_of(load())) is not None:
                bag.joints.append(row)
    if not bag.topics:
        found = ", ".join(f"{t} ({k})" for t, k in bag.others.items()) or "no message at all"
        raise DataError(
            f"{path}: expected topics of images, got {found[:200]}",
            hint="ros2 bag info, or mcap info, lists what was recorded",
        )
    for topic, held in bag.topics.items():
        _in_order(held, f"{path}: {topic}")
        if (len(held.stamps) > 1 and len(set(held.stamps)) == 1) or not any(held.stamps):
            raise DataError(
                f"{path}: {topic}: expected a stamp for every message, all are {held.stamps[0] / 1e9:g} s: its driver sets none",
                hint='[raw] stamps = "received" in import.toml takes the times of recording',
            )
        span, taken = np.ptp(held.stamps), np.ptp(held.received)
        if len(held.stamps) > 2 and taken and not 1 / _FASTER < span / taken < _FASTER:
            raise DataError(
                f"{path}: {topic}: expected stamps that run as the recording does, they run {span / taken:.3g} times as fast",
                hint='does its driver write ms or ns as s? [raw] stamps = "received" in import.toml takes the times of recording',
            )
    for _, poses in bag.links.values():
        poses.sort(key=lambda p: p[0])
    bag.joints.sort(key=lambda j: j[0])
    return bag


def _in_order(held: _Topic, where: str) -> None:
    """Bring messages that overtook each other into the order of their stamps; :class:`DataError` when the clock went back."""
    back = -min(np.diff(held.stamps), default=0) / 1e9
    if back > _SET_BACK:
        raise DataError(
            f"{where}: expected stamps that ascend, they go back by {back:.3g} s",
            hint='was a clock set while recording, or a bag played in a loop? [raw] stamps = "received" takes the times of recording',
        )
    if back > 0:
        pairs = sorted(zip(held.stamps, held.received, strict=True))
        held.stamps, held.received = map(list, zip(*pairs, strict=True))


def _hang_poses(bag: _Bag, frame: str, said: Said) -> None:
    """Put the poses of a topic into the tree of frames: the one that is said, else what moves the root that the camera hangs on."""
    told, chain = str(said.poses.get("file", "")), _chain(bag, frame)
    root = chain[-1]
    topics = [told] if told in bag.poses else [t for t, rows in bag.poses.items() if rows[0][1] == root]
    if told.startswith("/") and told not in bag.poses and not Path(told).exists():
        found = ", ".join(bag.poses) or ", ".join(f"{t} ({k})" for t, k in bag.others.items())
        raise DataError(
            f"{bag.path}: expected PoseStamped or Odometry in [poses] file = {told!r}, got {found[:200]}",
            hint="ros2 bag info lists the topics; without [poses] poses come from tf",
        )
    if not topics and root == frame:  # tf does not place the camera
        topics = list(bag.poses)
    elif not topics and bag.poses and all(len(bag.links[f][1]) == 1 for f in chain[:-1]):
        text = (
            f"{bag.path}: poses of {', '.join(bag.poses)} are not used: tf lets {frame} stand still on {root}"
        )
        warnings.warn(f"{text}; [poses] file takes them for the camera's", PassedOver, stacklevel=2)
    if len(topics) > 1:
        raise DataError(
            f"{bag.path}: expected one topic of poses of the camera, got {', '.join(topics)}",
            hint=f'[poses] file = "{topics[0]}" in import.toml',
        )
    for topic in topics:
        parent, child = bag.poses[topic][0][:2]
        if child not in {"", frame, root}:
            text = f"{bag.path}: {topic} has the poses of {child}, tf does not say where {frame or 'the camera'} is on it: taken for the camera's"
            warnings.warn(text, PassedOver, stacklevel=2)
        hung = root if child == root else frame
        rows = sorted(((stamp, T) for _, _, stamp, T in bag.poses[topic]), key=lambda p: p[0])
        bag.links[hung] = (parent if parent not in {"", hung} else "world", rows)


def _chain(bag: _Bag, frame: str) -> list[str]:
    """Name a frame and all that it hangs on."""
    chain = [frame]
    while chain[-1] in bag.links and bag.links[chain[-1]][0] not in chain:
        chain.append(bag.links[chain[-1]][0])
    return chain


def _words(topic: str) -> set[str]:
    return set(re.findall(r"[a-z]+", topic.lower()))


def _chosen(bag: _Bag, said: Said) -> tuple[list[str], str]:
    """Choose raw topics, in natural order, and the topic of ground truth, or none."""
    told = {n: str(getattr(said, n).get("files", "")) for n in ("raw", "truth")}
    found: dict[str, list[str]] = {}
    for name, pattern in told.items():
        if "/" in pattern:  # else it is a file's name
            found[name] = [t for t in bag.topics if fnmatch(t, pattern)]
            if not found[name]:
                raise DataError(
                    f"{bag.path}: expected images in [{name}] files = {pattern!r}, got topics {', '.join(bag.topics)}",
                    hint=f'[{name}] files = "{next(iter(bag.topics))}" in import.toml',
                )
    left = [t for t in bag.topics if t not in found.get("raw", ())]
    truth = found.get("truth") or [
        t for t in left if bag.topics[t].kind == "PointCloud2" or _words(t) & TRUTH
    ]
    truth = (
        []
        if said.truth.get("kind") == "none"
        else sorted(truth, key=lambda t: (bool(_words(t) & {"tof"}), natural(t)))
    )
    raw = found.get("raw") or [t for t in left if t not in truth and not _words(t) & (OTHER | TRUTH)]
    if not raw:
        raise DataError(
            f"{bag.path}: expected raw images of a ToF camera, got topics {', '.join(bag.topics)}",
            hint='say which are raw: [raw] files = "/tof/raw*" in import.toml',
        )
    return sorted(raw, key=natural), truth[0] if truth else ""


def _camera(bag: _Bag, topic: str) -> Camera | None:
    """Find the camera of a topic: in its own folder, with its frame, or the only one."""
    place = topic.rsplit("/", 1)[0]
    mine = {t: m for t, m in bag.cameras.items() if t.rsplit("/", 1)[0] == place}
    mine = mine or {
        t: m for t, m in bag.cameras.items() if m.header.frame_id.strip("/") == bag.topics[topic].frame
    }
    mine = mine or (bag.cameras if len(bag.cameras) == 1 and len(bag.topics) == 1 else {})
    if mine:
        name, message = next(iter(mine.items()))
        return camera_of(message, f"{bag.path}: {name}", rectified="rect" in topic)
    return None


def _alternates(bag: _Bag, topic: str, K: int, size: tuple[int, int] | None) -> bool:
    """Whether channels come message by message; else one image has all below each other, and is tall."""
    first = _message(bag.path, topic, bag.topics[topic].received[0])
    tall = K * size[0] if size else 2 * max(first.shape[1:])
    return K > 1 and first.ndim == 2 and first.shape[0] < tall


def _frames(
    bag: _Bag, raw: Sequence[str], truth: str, turns: int, said: Said
) -> list[tuple[int, list[tuple[str, int]], int | None]]:
    """Put messages together by their stamps: time, (topic, time of recording) of each image, and that of the ground truth."""
    first = bag.topics[raw[0]]
    starts = range(0, len(first.stamps) - turns + 1, turns)
    frames = [(first.stamps[i], [(raw[0], first.received[j]) for j in range(i, i + turns)]) for i in starts]
    if not frames:
        raise DataError(
            f"{bag.path}: expected {turns} messages of {raw[0]} for a frame, got {len(first.stamps)}",
            hint="[tof] modulation_mhz and phase_deg in import.toml say what the channels are",
        )
    half = _half(first.stamps)
    for topic in raw[1:]:
        partners = [_nearest(bag.topics[topic], time, half) for time, _ in frames]
        _expect_most(bag, topic, raw[0], [p is not None for p in partners], half)
        frames = [
            (t, [*held, (topic, p)]) for (t, held), p in zip(frames, partners, strict=True) if p is not None
        ]
    if not truth:
        return [(time, held, None) for time, held in frames]
    other, offset = bag.topics[truth], round(float(said.truth.get("time_offset_s", 0.0)) * 1e9)
    shifted = _Topic(other.kind, stamps=[s + offset for s in other.stamps], received=other.received)
    if len(other.stamps) < len(frames):  # a slower camera: its images choose the frames
        near = [int(np.argmin([abs(t - s) for t, _ in frames])) for s in shifted.stamps]
        frames = [frames[i] for i in sorted(set(near))]
    half = max(half, _half(shifted.stamps)) if len(frames) > 1 else max(half, 10**9)
    targets = [_nearest(shifted, time, half) for time, _ in frames]
    _expect_most(bag, truth, raw[0], [t is not None for t in targets], half)
    return [(time, held, t) for (time, held), t in zip(frames, targets, strict=True) if t is not None]


def _half(stamps: Sequence[int]) -> int:
    """Half of the usual time between messages; a second where there is one."""
    return int(np.median(np.diff(sorted(stamps))) / 2) if len(stamps) > 1 else 10**9


def _nearest(topic: _Topic, time: int, within: int) -> int | None:
    i = int(np.argmin(np.abs(np.asarray(topic.stamps) - time)))
    return topic.received[i] if abs(topic.stamps[i] - time) <= within else None


def _expect_most(bag: _Bag, topic: str, of: str, there: Sequence[bool], within: int) -> None:
    missing = len(there) - sum(there)
    if not missing:
        return
    spans = [
        f"{t} from {min(bag.topics[t].stamps) / 1e9:.3f} to {max(bag.topics[t].stamps) / 1e9:.3f} s"
        for t in (of, topic)
    ]
    text = f"{bag.path}: {missing} of {len(there)} messages of {of} have none of {topic} within {within / 1e6:.1f} ms"
    if missing > _LOST * len(there):
        raise DataError(
            f"{text}: {', '.join(spans)}",
            hint="clocks that differ: [truth] time_offset_s in import.toml; else messages were lost: record again, with fewer topics or larger queues",
        )
    warnings.warn(f"{text}: left out", PassedOver, stacklevel=2)


def _message(path: Path, topic: str, received: int) -> NDArray[Any]:
    """Read one image."""
    return _messages(path, [(topic, received)])[0]


def _messages(path: Path, held: Sequence[tuple[str, int]]) -> list[NDArray[Any]]:
    """Read images of topics and times of recording."""
    times = [t for _, t in held]
    with opened(path) as messages:
        found = {
            (topic, time): image_of(load(), f"{path}: {topic}")
            for topic, _, time, load in messages({t for t, _ in held}, min(times), max(times) + 1)
            if (topic, time) in held
        }
    if gone := [f"{topic} at {time} ns" for topic, time in held if (topic, time) not in found]:
        raise DataError(
            f"{path}: {gone[0]}: the message is gone", hint="was the bag written again meanwhile?"
        )
    return [found[one] for one in held]


def _stacked(
    path: Path, held: Sequence[tuple[str, int]], K: int, size: tuple[int, int] | None
) -> NDArray[Any]:
    """Read the channels (K, H, W) of a frame, from one image or from several."""
    images = _messages(path, held)
    if len({i.shape for i in images}) > 1:
        raise DataError(f"{path}: expected images of one size, got {', '.join(str(i.shape) for i in images)}")
    one = np.stack(images) if len(images) > 1 else images[0]
    if one.ndim == 2:
        n = K if size is None or one.shape[0] == K * size[0] else 1
        return one.reshape(n, -1, one.shape[1]) if one.shape[0] % n == 0 else one[None]
    if len(images) > 1 and one.ndim == 4:  # several topics of several channels
        return np.moveaxis(one, -1, 1).reshape(-1, *one.shape[1:3])
    return one if len(images) > 1 else np.moveaxis(one, -1, 0)


def _truth_facts(bag: _Bag, truth: str) -> Facts:
    """Camera and unit of ground truth, as ROS fixes them: integers are millimetres, floats metres."""
    held = bag.topics[truth]
    camera = _camera(bag, truth)
    whole = "16UC1" in held.encoding or "mono16" in held.encoding
    return Facts(camera=camera, unit="mm" if whole else "m")


def _between(bag: _Bag, outer: str, inner: str, time: int, said: Said) -> Float64 | None:
    """(4, 4) from frame ``inner`` to ``outer``, or to the root of its tree; ``None`` when tf does not say."""
    time -= _offset(said)
    if inner == outer:
        return np.eye(4)
    chains = [_to_root(bag, frame, time) for frame in (inner, outer) if frame]
    if outer and (chains[0][0] != chains[1][0]):
        return None
    T = chains[0][1] if not outer else invert(chains[1][1]) @ chains[0][1]
    return None if not outer and chains[0][0] == inner else T


def _to_root(bag: _Bag, frame: str, time: int) -> tuple[str, Float64]:
    T, seen = np.eye(4), deque([frame])
    while seen[-1] in bag.links:
        parent, poses = bag.links[seen[-1]]
        T = _at(poses, time, f"{bag.path}: tf of {seen[-1]}") @ T
        if parent in seen:
            raise DataError(
                f"{bag.path}: tf runs in a circle: {', '.join([*seen, parent])}",
                hint="two programs publish a transform",
            )
        seen.append(parent)
    return seen[-1], T


def _at(poses: Sequence[tuple[int, Float64]], time: int, where: str) -> Float64:
    """Interpolate a pose; one alone stands still."""
    stamps = [s for s, _ in poses]
    if len(poses) > 1 and not stamps[0] - 2 * _half(stamps) <= time <= stamps[-1] + 2 * _half(stamps):
        raise DataError(
            f"{where}: expected a pose at {time / 1e9:.3f} s, it goes from {stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f} s",
            hint="clocks that differ: [poses] time_offset_s in import.toml",
        )
    T = pose_at(stamps, [T for _, T in poses], time, np.inf)
    if not np.isfinite(T).all():
        raise DataError(
            f"{where}: expected a pose at {time / 1e9:.3f} s, got NaN or a quaternion of length 0",
            hint="the tracker had lost it there: cut the bag before, or record again",
        )
    return T


def _joints(bag: _Bag, time: int, said: Said) -> Float64 | None:
    """Interpolate the arm's joints (6,); ``None`` where the bag has none within a second."""
    stamps = np.array([s for s, _ in bag.joints])
    time -= _offset(said)
    if not len(stamps) or np.abs(stamps - time).min() > 10**9:
        return None
    rows = np.stack([row for _, row in bag.joints])
    return np.array([np.interp(time - stamps[0], stamps - stamps[0], row) for row in rows.T])


def _offset(said: Said) -> int:
    """Return what is added to the stamps of poses, nanoseconds."""
    return round(float(said.poses.get("time_offset_s", 0.0)) * 1e9)
