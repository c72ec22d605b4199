"""Make shots of view files, recordings, shards, datasets and predictions; find the views of a recording."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import ESTIMATE, GROUND_TRUTH, SENSOR
from tofcapture.devices.kinematics import ArmModel, arm_model, link_frames
from tofcapture.errors import DataError, TofError
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.files.manifest import load_manifest
from tofcapture.files.shard import ShardReader
from tofcapture.files.view import find_views, open_view
from tofcapture.frames import View
from tofcapture.ops.phase import Decoder
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.shots import Cloud, Panel, Shot, Source

_STEREO_STEP = 4  # every fourth point of the stereo grid, each way: 80 000 points are enough to look at
_FAR = 3.0  # m; what lies beyond is floor and walls


def recording_source(recording: Path) -> Source:
    """Shots of every view of a recording; ``rig.toml`` in it is used where ``align`` has written one.

    Raises :class:`DataError`: it holds no view.
    """
    paths = [path for views in scenes_of(recording).values() for path in views]
    rig, arm = rig_of(recording, paths[0]), arm_of(recording)
    names = [f"{p.parent.name} {number_of(p)}" for p in paths]
    title = _titled("recording", recording)
    return Source(title, names, lambda i: view_shot(open_view(paths[i]), rig, arm), rig)


def view_source(path: Path) -> Source:
    """The one shot of a view file, with ``rig.toml`` and ``station.toml`` of the recording that it lies in."""
    folder, view = path.resolve().parent.parent, open_view(path)
    home = folder.parent if folder.name == "views" else path.parent
    rig = rig_of(home, path) if folder.name == "views" else view.rig
    name = f"{view.scene} {view.index}"
    return Source(f"view {path.name}", [name], lambda _: view_shot(view, rig, arm_of(home)), rig)


def scenes_of(recording: Path) -> dict[str, list[Path]]:
    """View files of a recording by scene.

    Raises :class:`DataError`: it is no recording, or holds no view.
    """
    if not recording.exists():
        raise DataError(
            f"{recording}: no such file or folder", hint="give a recording or one of its view files"
        )
    found = find_views(recording)
    if not found:
        raise DataError(
            f"{recording}: expected a recording with views, found none",
            hint="tofcapture record --scene NAME --out RECORDING",
        )
    return {scene: list(views) for scene, views in found.items()}


def scene_views(recording: Path, scene: str | None = None) -> list[Path]:
    """View files of one scene in order; ``None``: of the first one that is not the board.

    Raises :class:`DataError`: it is no recording, or has no such scene.
    """
    found = scenes_of(recording)
    if scene is not None and scene not in found:
        raise DataError(f"{recording}: no scene {scene}", hint=f"it has {', '.join(found)}")
    name = scene or next((n for n in found if n != BOARD_SCENE), BOARD_SCENE)
    return found[name]


def pick_view(path: Path, scene: str | None, view: int | None) -> Path:
    """Find one view file: ``path`` itself, or the named view of a recording's scene; ``None``: the first.

    Raises :class:`DataError`: there is no such view.
    """
    if path.is_file():
        return path
    paths = scene_views(path, scene)
    found = [p for p in paths if view is None or number_of(p) == view]
    if not found:
        numbers = ", ".join(str(number_of(p)) for p in paths)
        raise DataError(f"{path}: scene {paths[0].parent.name} has no view {view}", hint=f"it has {numbers}")
    return found[0]


def number_of(path: Path) -> int:
    """Number of a view in the name of its file."""
    return int(path.stem.removeprefix("view-"))


def rig_of(recording: Path, view: Path) -> Rig:
    """Rig that ``align`` has written, otherwise that of a view."""
    aligned = recording / "rig.toml"
    return load_rig(aligned) if aligned.exists() else open_view(view).rig


def arm_of(recording: Path) -> ArmModel | None:
    """Arm that ``station.toml`` names; ``None`` where it names none that is known."""
    try:
        table = tomllib.loads((recording / "station.toml").read_text(encoding="utf-8"))
        return arm_model(str(table["arm"].get("model", "ur10e")))
    except (OSError, KeyError, AttributeError, UnicodeDecodeError, tomllib.TOMLDecodeError, TofError):
        return None  # a picture without the arm's links is still a picture


def view_shot(view: View, rig: Rig, arm: ArmModel | None = None) -> Shot:
    """Decode a view and bring its stereo points into the ToF frame by a rig; an arm gives the links."""
    burst = view.tof
    maps = Decoder(burst.info).burst(burst.raw, float(np.mean(burst.celsius)))
    grid = view.stereo.points[::_STEREO_STEP, ::_STEREO_STEP]
    panels = [
        Panel("ToF amplitude", "amplitude", maps.confidence),
        Panel("ToF depth", "depth", maps.depth),
        Panel("stereo depth", "depth", grid[..., 2]),
    ]
    if view.truth is not None:
        panels.append(Panel("exact depth (simulated)", "depth", view.truth.depth, view.truth.target))
    clouds = {
        "tof": Cloud(near(burst.info.camera.unproject(maps.depth)), SENSOR),
        "stereo": Cloud(near(transform_points(rig.T_tof_stereo, grid.astype(np.float64))), GROUND_TRUTH),
    }
    T = view.arm_after.T_base_flange @ rig.T_flange_tof
    return Shot(f"{view.scene} {view.index}", panels, clouds, T, links_of(arm, view.arm_after.joints))


def near(points: NDArray[Any]) -> NDArray[np.float32]:
    """(N, 3) points that are there and no farther than 3 m."""
    flat = points.reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(flat).all(axis=1) & (flat[:, 2] < _FAR)
    out: NDArray[np.float32] = flat[keep].astype(np.float32)
    return out


def links_of(arm: ArmModel | None, joints: Float64) -> Float64 | None:
    """(J + 1, 3) origins of an arm's links from the base to the flange, metres; ``None`` without a model, or joints."""
    return (
        None
        if arm is None or np.isnan(joints).any()
        else np.vstack([np.zeros(3), link_frames(arm, joints)[:, :3, 3]])
    )


def shard_source(path: Path) -> Source:
    """Shots of every view of a shard."""
    return _shards(f"shard {path.name}", [path])


def dataset_source(dataset: Path) -> Source:
    """Shots of every view of every shard that the manifest names.

    Raises :class:`DataError`: the manifest, or a shard, is missing or damaged.
    """
    entries = load_manifest(dataset).scenes
    return _shards(_titled("dataset", dataset), [dataset / entries[name].path for name in sorted(entries)])


def _titled(kind: str, folder: Path) -> str:
    """Name a folder and what it is, once where the name says it."""
    name = folder.resolve().name
    return name if kind in name else f"{kind} {name}"


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

    Raises :class:`DataError`: a file of it is missing or damaged.
    """
    depth, normals = read_maps(folder)
    try:
        error = folder / "error.npy"  # some networks predict none
        expected = [1e3 * np.load(error, allow_pickle=False)] if error.exists() else []
        own = folder / "sensor.npy"
        sensor = [np.load(own, allow_pickle=False)] if own.exists() else []
        points = _ply_points(folder / "cloud.ply")
    except (OSError, ValueError) as err:
        raise _unreadable(folder, err) from err
    panels = [
        *(Panel("ToF depth", "depth", image) for image in sensor),
        Panel("estimated depth", "depth", depth),
        *(Panel("expected error", "expected", image) for image in expected),
        Panel("estimated normals", "normals", normals),
    ]
    shot = Shot(folder.name, panels, {"estimate": Cloud(near(points), ESTIMATE)})
    return Source(f"prediction {folder.name}", [folder.name], lambda _: shot)


def read_maps(folder: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Depth (H, W) in metres and normals (H, W, 3) that ``predict`` wrote.

    Raises :class:`DataError`: a file is missing or damaged.
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
    points = np.frombuffer(body, "<f4").reshape(-1, len(names))[:, :3]
    if f"element vertex {len(points)}\n".encode() not in head:
        raise ValueError(f"{path.name} holds {len(points)} points, fewer or more than it says")
    return points
