"""Write tables that Hugging Face's ``datasets`` and LeRobot read: one Parquet file a scene, a view a row.

Both are written with pyarrow alone: LeRobot pins versions that few programs can live with.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import png_bytes
from tofcapture.dataset.export.scene import SceneExport, grey, quaternion
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing, write_text

PICTURE = {"_type": "Image"}
CHUNK, EPISODES = "data/chunk-000/file-{:03d}.parquet", "meta/episodes/chunk-000/file-{:03d}.parquet"
POSE = ["x", "y", "z", "qx", "qy", "qz", "qw"]
_TIFF = {
    256: 0,
    257: 0,
    258: 32,
    259: 8,
    262: 1,
    273: 0,
    277: 1,
    278: 0,
    279: 0,
    339: 3,
}  # tags of a float image
_SPLITS = {"train": "train", "val": "validation", "test": "test"}


def _arrow() -> tuple[ModuleType, ModuleType]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as err:
        raise ConfigError(
            f"this format needs the library pyarrow: {err}", hint="pip install 'tofcapture[export]'"
        ) from err
    return pa, pq


def export_huggingface(scene: SceneExport) -> list[Path]:
    """Write ``data/<split>/<scene>.parquet``: everything of each view but the stereo camera's native depth.

    Arrays keep dtype and NaN. ``amplitude`` is a picture for viewers; ``camera`` is JSON: intrinsics at 1x, channels.
    """
    shard = scene.shard
    told = {
        **asdict(shard.camera),
        "modulation_hz": list(shard.info.modulation_hz),
        "phase_rad": list(shard.info.phase_rad),
    }
    path = scene.out / "data" / scene.split / f"{scene.name}.parquet"

    def row(view: int) -> dict[str, Any]:
        tof, frames = shard.tof(view), range(shard.frames)
        out = {
            "scene": scene.name,
            "view": np.int64(shard.index(view)),
            "amplitude": png_bytes(grey(tof.confidence)),
            "camera": json.dumps(told),
            "T_base_tof": shard.T_base_tof(view),
            "time_ns": np.array([shard.time_ns(view, f) for f in frames], dtype=np.int64),
            "celsius": np.array([shard.celsius(view, f) for f in frames]),
            "raw": np.stack([shard.raw(view, f) for f in frames]),
            "tof_depth": tof.depth,
            "tof_confidence": tof.confidence,
            "tof_flags": tof.flags,
        }
        for scale in shard.scales:
            maps = vars(shard.ground_truth(view, scale))
            out |= {f"gt_{name}_{scale}x": a for name, a in maps.items() if a is not None}
        return out

    _write_rows(path, (row(v) for v in range(shard.views)))
    return [path]


def finish_huggingface(out: Path, scenes: Sequence[SceneExport]) -> list[Path]:
    """Write ``README.md``, whose head tells ``datasets`` which files are which split."""
    files = {_SPLITS[s.split]: f"data/{s.split}/*.parquet" for s in scenes}
    lines = [f"      - split: {split}\n        path: {glob}" for split, glob in files.items()]
    head = "configs:\n  - config_name: default\n    data_files:\n" + "\n".join(lines)
    body = "Depths in metres, z; NaN is none. Mask 0 is good ground truth. T_base_tof maps camera to base."
    write_text(out / "README.md", f"---\n{head}\n---\n\n{body}\n")
    return [out / "README.md"]


def _feature(value: Any) -> dict[str, Any]:
    """Feature of ``datasets`` of one column."""
    if isinstance(value, bytes):
        return PICTURE
    if isinstance(value, str):
        return {"dtype": "string", "_type": "Value"}
    if value.ndim == 0:
        return {"dtype": value.dtype.name, "_type": "Value"}
    if value.ndim == 1:
        one = {"dtype": value.dtype.name, "_type": "Value"}
        return {"feature": one, "length": len(value), "_type": "List"}
    return {"shape": list(value.shape), "dtype": value.dtype.name, "_type": f"Array{value.ndim}D"}


def _extension(feature: Mapping[str, Any]) -> dict[str, str] | None:
    """Arrow's mark of an array with a shape; without ``datasets`` it is read as nested lists."""
    if "shape" not in feature:
        return None
    kind = f"datasets.features.features.{feature['_type']}ExtensionType"
    told = json.dumps((feature["shape"], feature["dtype"]))
    return {"ARROW:extension:name": kind, "ARROW:extension:metadata": told}


def _column(pa: Any, value: Any) -> Any:
    """One row of a column."""
    if isinstance(value, bytes):
        return pa.array(
            [{"bytes": value, "path": None}], pa.struct({"bytes": pa.binary(), "path": pa.string()})
        )
    if isinstance(value, str):
        return pa.array([value])
    out = pa.array(np.ascontiguousarray(value).reshape(-1))
    for n in reversed(value.shape):
        if value.ndim == 1:
            return pa.FixedSizeListArray.from_arrays(out, n)
        out = pa.ListArray.from_arrays(np.arange(0, len(out) + 1, n, dtype=np.int32), out)
    return out


def _write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows of named values, a row group each, with the features that ``datasets`` takes them for."""
    pa, pq = _arrow()
    with replacing(path) as partial:
        writer = None
        for row in rows:
            table = pa.table({name: _column(pa, value) for name, value in row.items()})
            if writer is None:
                features = {name: _feature(value) for name, value in row.items()}
                told = {"huggingface": json.dumps({"info": {"features": features}})}
                fields = [f.with_metadata(_extension(features[f.name])) for f in table.schema]
                schema = pa.schema(fields, told)
                writer = pq.ParquetWriter(partial, schema, compression="zstd")
            writer.write_table(table.cast(schema))
        if writer is not None:
            writer.close()


def export_lerobot(scene: SceneExport) -> list[Path]:
    """Write an episode of a LeRobot dataset (v3.0): the camera's way through a scene, a view a frame.

    ``observation.state`` is the camera's pose in the base, x, y, z in metres and a quaternion; ``action`` is the next one.
    Depths are TIFF of float32 metres, as LeRobot stores them without loss; 0 is none.
    """
    shard, N = scene.shard, scene.shard.views
    poses = np.array([_pose(shard.T_base_tof(v)) for v in range(N)], dtype=np.float32)
    sums: dict[str, list[dict[str, Any]]] = {}

    def row(view: int) -> dict[str, Any]:
        tof, gt = shard.tof(view), shard.ground_truth(view, 2)
        picture = np.repeat(grey(tof.confidence)[..., None], 3, axis=-1)
        depths = {"tof": np.nan_to_num(tof.depth), "ground_truth": np.nan_to_num(gt.depth)}
        seen: dict[str, Any] = {"observation.images.amplitude": np.moveaxis(picture, -1, 0) / 255}
        seen |= {f"observation.depth.{name}": depth[None] for name, depth in depths.items()}
        numbers = {"observation.state": poses[view], "action": poses[min(view + 1, N - 1)]}
        counts = {
            "timestamp": np.float32(view),
            "frame_index": np.int64(view),
            "episode_index": np.int64(scene.number),
            "index": np.int64(scene.first + view),
            "task_index": np.int64(scene.number),
        }
        for name, value in {**seen, **numbers, **counts}.items():
            sums.setdefault(name, []).append(_moments(np.asarray(value)))
        tiffs = {f"observation.depth.{name}": tiff_bytes(depth) for name, depth in depths.items()}
        return {"observation.images.amplitude": png_bytes(picture), **tiffs, **numbers, **counts}

    data, episode = (scene.out / p.format(scene.number) for p in (CHUNK, EPISODES))
    _write_rows(data, (row(v) for v in range(N)))
    place = {"chunk_index": 0, "file_index": scene.number}
    told: dict[str, Any] = {
        "episode_index": scene.number,
        "tasks": [scene.name],
        "length": N,
        "dataset_from_index": scene.first,
        "dataset_to_index": scene.first + N,
        **{f"{what}/{k}": v for what in ("data", "meta/episodes") for k, v in place.items()},
    }
    for name, parts in sums.items():
        told |= {f"stats/{name}/{k}": v.tolist() for k, v in _pooled(parts).items()}
    pa, pq = _arrow()
    with replacing(episode) as partial:
        pq.write_table(pa.table({k: [v] for k, v in told.items()}), partial)
    return [data, episode]


def finish_lerobot(out: Path, scenes: Sequence[SceneExport]) -> list[Path]:
    """Write ``meta``: ``info.json``, ``stats.json`` over all episodes, ``tasks.parquet`` with a task a scene."""
    pa, pq = _arrow()
    camera, N = scenes[0].shard.camera, sum(s.views for s in scenes)
    picture = {"dtype": "image", "names": ["height", "width", "channels"]}
    depth = {**picture, "info": {"is_depth_map": True, "depth_unit": "m"}}
    pose = {"dtype": "float32", "shape": [7], "names": POSE}
    number = {"shape": [1], "names": None}
    info: dict[str, Any] = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(scenes),
        "total_frames": N,
        "total_tasks": len(scenes),
        "chunks_size": len(scenes),
        "fps": 1,
        "splits": _ranges(scenes),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {
            "observation.images.amplitude": {**picture, "shape": [*camera.shape, 3]},
            "observation.depth.tof": {**depth, "shape": [*camera.shape, 1]},
            "observation.depth.ground_truth": {**depth, "shape": [*camera.scaled(2).shape, 1]},
            "observation.state": pose,
            "action": pose,
            "timestamp": {"dtype": "float32", **number},
            **{
                k: {"dtype": "int64", **number}
                for k in ("frame_index", "episode_index", "index", "task_index")
            },
        },
    }
    rows = [pq.read_table(out / EPISODES.format(s.number)).to_pylist()[0] for s in scenes]
    stats: dict[str, Any] = {}
    for name in info["features"]:
        parts = [
            {k: np.array(r[f"stats/{name}/{k}"]) for k in ("min", "max", "mean", "std", "count")}
            for r in rows
        ]
        stats[name] = {k: v.tolist() for k, v in _pooled(parts).items()}
    tasks = pa.table({"task_index": [s.number for s in scenes], "task": [s.name for s in scenes]})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    tables = {"info": info, "stats": stats}
    for name, table in tables.items():
        write_text(out / "meta" / f"{name}.json", json.dumps(table, indent=1) + "\n")
    with replacing(out / "meta/tasks.parquet") as partial:
        pq.write_table(tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), partial)
    return [out / "meta" / name for name in ("info.json", "stats.json", "tasks.parquet")]


def _ranges(scenes: Sequence[SceneExport]) -> dict[str, str]:
    """Episodes of each split, first and one after the last: they are numbered split by split."""
    splits = [s.split for s in scenes]
    return {s: f"{splits.index(s)}:{splits.index(s) + splits.count(s)}" for s in dict.fromkeys(splits)}


def _pose(T: NDArray[np.float64]) -> list[float]:
    return [*T[:3, 3].tolist(), *quaternion(T)]


def _moments(value: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Statistics over an image's pixels (C, 1, 1), or of numbers themselves."""
    flat = value.astype(np.float64).reshape(len(value), -1) if value.ndim == 3 else value.reshape(-1, 1)
    shape = (-1, 1, 1) if value.ndim == 3 else (-1,)
    found = {
        n: getattr(flat, n)(axis=1).astype(np.float64).reshape(shape) for n in ("min", "max", "mean", "std")
    }
    return {**found, "count": np.array([1])}


def _pooled(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Statistics of several from theirs, each weighted by its count."""
    low, high, mean, std, n = (
        np.array([p[k] for p in parts]) for k in ("min", "max", "mean", "std", "count")
    )
    weight = (n / n.sum()).reshape(-1, *(1,) * (mean.ndim - 1))
    centre = (weight * mean).sum(axis=0)
    spread = np.sqrt((weight * (std**2 + (mean - centre) ** 2)).sum(axis=0))
    return {
        "min": low.min(axis=0),
        "max": high.max(axis=0),
        "mean": centre,
        "std": spread,
        "count": n.sum(axis=0),
    }


def tiff_bytes(image: NDArray[np.float32]) -> bytes:
    """Encode float32 (H, W) as a TIFF of one strip, compressed without loss."""
    H, W = image.shape
    data = zlib.compress(image.astype("<f4").tobytes(), 6)
    values = {**_TIFF, 256: W, 257: H, 273: 8, 278: H, 279: len(data)}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in values.items())
    at = 8 + len(data) + len(data) % 2
    body = data + b"\0" * (len(data) % 2)
    return struct.pack("<2sHI", b"II", 42, at) + body + struct.pack("<H", len(values)) + entries + b"\0" * 4
