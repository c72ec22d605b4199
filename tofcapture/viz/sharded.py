"""Make shots of shards, datasets and predictions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import ESTIMATE, GROUND_TRUTH, SENSOR
from tofcapture.errors import DataError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.shard import ShardReader
from tofcapture.viz.captured import near
from tofcapture.viz.shots import Cloud, Panel, Shot, Source


def shard_source(path: Path) -> Source:
    """Shots of every view of a shard."""
    return _shards(f"shard {path.name}", [path])


def dataset_source(dataset: Path) -> Source:
    """Shots of every view of every shard that the manifest names.

    Raises
    ------
    DataError
        The manifest, or a shard, is missing or damaged.
    """
    entries = load_manifest(dataset).scenes
    return _shards(f"dataset {dataset.name}", [dataset / entries[name].path for name in sorted(entries)])


def _shards(title: str, paths: list[Path]) -> Source:
    where: list[tuple[Path, int]] = []
    names: list[str] = []
    for path in paths:
        with ShardReader(path) as shard:
            where += [(path, i) for i in range(shard.views)]
            names += [f"{shard.scene} {shard.index(i)}" for i in range(shard.views)]
            rig = shard.rig
    if not where:
        raise DataError(f"{title}: expected at least one view, found none")
    return Source(title, names, lambda i: shard_shot(*where[i]), rig)


def shard_shot(path: Path, view: int) -> Shot:
    """Read what the sensor says, ground truth, and their difference where ground truth is good."""
    with ShardReader(path) as shard:
        tof, truth, fine = shard.tof(view), shard.ground_truth(view, 1), shard.ground_truth(view, 2)
        error_mm = np.where(truth.mask == 0, 1e3 * (tof.depth - truth.depth), np.nan)
        panels = [
            Panel("ToF amplitude", "amplitude", tof.confidence),
            Panel("ToF depth", "depth", tof.depth, truth.mask == 0),
            Panel("ground truth depth", "depth", fine.depth, fine.mask == 0),
            Panel("ToF - ground truth", "error", error_mm),
            Panel("ground truth normals", "normals", fine.normals),
            Panel("mask", "mask", fine.mask),
        ]
        clouds = {
            "tof": Cloud(near(shard.tof_points(view)), SENSOR),
            "ground_truth": Cloud(near(shard.points(view, 2)), GROUND_TRUTH),
        }
        return Shot(f"{shard.scene} {shard.index(view)}", panels, clouds, shard.T_base_tof(view))


def prediction_source(folder: Path) -> Source:
    """The one shot of a folder that ``predict`` wrote.

    Raises
    ------
    DataError
        A file of it is missing or damaged.
    """
    depth, normals = read_maps(folder)
    try:
        error = folder / "error.npy"  # some networks predict none
        expected = [1e3 * np.load(error, allow_pickle=False)] if error.exists() else []
        points = _ply_points(folder / "cloud.ply")
    except (OSError, ValueError) as err:
        raise _unreadable(folder, err) from err
    panels = [
        Panel("estimated depth", "depth", depth),
        *(Panel("expected error", "expected", image) for image in expected),
        Panel("estimated normals", "normals", normals),
    ]
    shot = Shot(folder.name, panels, {"estimate": Cloud(near(points), ESTIMATE)})
    return Source(f"prediction {folder.name}", [folder.name], lambda _: shot)


def read_maps(folder: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depth (H, W) in metres and normals (H, W, 3) that ``predict`` wrote.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    try:
        depth, normals = (np.load(folder / f"{n}.npy", allow_pickle=False) for n in ("depth", "normals"))
    except (OSError, ValueError) as err:
        raise _unreadable(folder, err) from err
    return depth, normals


def _unreadable(folder: Path, err: Exception) -> DataError:
    return DataError(f"{folder}: cannot read the prediction: {err}", hint="run tofcapture predict again")


def _ply_points(path: Path) -> NDArray[np.float32]:
    head, mark, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.splitlines() if line.startswith(b"property float ")]
    if not mark or names[:3] != [b"x", b"y", b"z"]:
        raise ValueError(f"{path.name} is no binary PLY with x, y, z first")
    return np.frombuffer(body, "<f4").reshape(-1, len(names))[:, :3]
