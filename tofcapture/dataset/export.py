"""Export a dataset or a shard: clouds (PLY), 16-bit depth images (PNG), or recordings that Foxglove plays (MCAP).

Exports go scene by scene, are resumed, and every file is whole or not there.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.colours import png_bytes
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.layout import MASK_DOCS
from tofcapture.files.manifest import load_manifest, load_signed, signed_text
from tofcapture.files.seal import replacing, sealed_digest, sha256_of, write_text
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
        "distortion_model": "rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob",
        "D": list(camera.distortion) or [0.0] * 5,  # OpenCV's order, as the camera has it
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


FORMAT, VERSION = "tofcapture-export", 1
INDEX = "export.json"
UNIT = 1 / 8000  # m, of PNG depth: 8.19 m, which holds the 7.5 m that 20 MHz measures; 0.1 mm would not
_AGAIN = "choose another --out, or delete it"
Exporter = Callable[[ShardReader, Path, float], list[Path]]
"""Writes one scene below a folder, PNG depth in steps of so many metres; returns its files."""
EXPORTERS: Mapping[str, Exporter] = {"ply": export_ply, "png16": export_png, "mcap": export_mcap}


@dataclass(frozen=True)
class Exported:
    """Report what an export did.

    Attributes
    ----------
    scenes
        All scenes that are in the folder now.
    written
        Those that this call wrote.
    files, size
        Number of files and bytes, of all scenes.
    """

    scenes: tuple[str, ...]
    written: tuple[str, ...]
    files: int
    size: int


def export(
    path: Path,
    kind: str,
    out: Path,
    *,
    unit: float = UNIT,
    progress: Callable[[str, int, int], None] | None = None,
) -> Exported:
    """Export a dataset or a shard, or complete an export that was begun.

    Parameters
    ----------
    path
        A dataset's folder, or a shard.
    kind
        ``ply``, ``png16`` or ``mcap``.
    out
        Folder; scenes in it that come from the same shards and whose files are whole are kept.
    unit
        Metres per step of PNG depth; the others do not use it.
    progress
        Told scene, scenes done and scenes in all.

    Raises
    ------
    ConfigError
        An unknown kind, a unit that is not positive, or a library is missing.
    DataError
        A shard is missing or damaged, or a depth does not fit into 16 bits.
    FormatError
        ``out`` holds an export of another kind or unit.
    """
    if kind not in EXPORTERS or not unit > 0:
        raise ConfigError(
            f"expected a format of {', '.join(EXPORTERS)} and a positive unit, got {kind}, {unit}"
        )
    out, shards = Path(out), _shards(Path(path))
    index = _begun(out / INDEX, kind, unit)
    written = []
    for done, (scene, (shard_path, promised)) in enumerate(sorted(shards.items())):
        digest = promised or sealed_digest(shard_path)
        if not _whole(out, index["scenes"].get(scene), digest):
            with ShardReader(shard_path, promised) as shard:
                files = EXPORTERS[kind](shard, out / scene, unit)
            index["scenes"][scene] = {"shard_sha256": digest, "files": _entries(out, files)}
            write_text(out / INDEX, signed_text(index))
            written.append(scene)
        if progress:
            progress(scene, done + 1, len(shards))
    sizes = [f["bytes"] for s in index["scenes"].values() for f in s["files"].values()]
    return Exported(tuple(sorted(index["scenes"])), tuple(written), len(sizes), sum(sizes))


def _shards(path: Path) -> dict[str, tuple[Path, str | None]]:
    """Shard and promised digest of each scene."""
    if path.is_dir():
        return {name: (path / e.path, e.sha256) for name, e in load_manifest(path).scenes.items()}
    with ShardReader(path) as shard:
        return {shard.scene: (path, None)}


def _begun(path: Path, kind: str, unit: float) -> dict[str, Any]:
    wanted = {"format": FORMAT, "version": VERSION, "kind": kind, "unit": unit}
    if not path.exists():
        return {**wanted, "scenes": {}}
    index = load_signed(path, "export's index", (FORMAT, VERSION), _AGAIN)
    found = {name: index.get(name) for name in wanted}
    if found != wanted:
        raise FormatError(f"{path}: expected {wanted}, got {found}", hint=_AGAIN)
    return index


def _entries(out: Path, files: list[Path]) -> dict[str, dict[str, Any]]:
    return {
        f.relative_to(out).as_posix(): {"bytes": f.stat().st_size, "sha256": sha256_of(f)}
        for f in sorted(files)
    }


def _whole(out: Path, known: Mapping[str, Any] | None, digest: str) -> bool:
    """Whether a scene's files are there, byte for byte, and of the shard that is there now."""
    if known is None or known["shard_sha256"] != digest:
        return False
    return all(
        (out / name).is_file() and sha256_of(out / name) == entry["sha256"]
        for name, entry in known["files"].items()
    )
