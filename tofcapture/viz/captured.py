"""Make shots of view files and recordings, and find their views."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import GROUND_TRUTH, SENSOR
from tofcapture.devices.kinematics import ArmModel, arm_model, link_frames
from tofcapture.errors import DataError, TofError
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.files.view import read_view
from tofcapture.frames import View
from tofcapture.ops.phase import Decoder
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.shots import Cloud, Panel, Shot, Source

_STEREO_STEP = 4  # every fourth point of the stereo grid, each way: 80 000 points are enough to look at
_FAR = 3.0  # m; what lies beyond is floor and walls


def recording_source(recording: Path) -> Source:
    """Shots of every view of a recording; ``rig.toml`` in it is used where ``align`` has written one.

    Raises
    ------
    DataError
        It holds no view.
    """
    paths = [p for scene in scenes_of(recording) for p in scene_views(recording, scene)]
    rig, arm = rig_of(recording, paths[0]), arm_of(recording)
    names = [f"{p.parent.name} {number_of(p)}" for p in paths]
    title = f"recording {recording.resolve().name}"
    return Source(title, names, lambda i: view_shot(read_view(paths[i]), rig, arm), rig)


def view_source(path: Path) -> Source:
    """The one shot of a view file, with ``rig.toml`` and ``station.toml`` of the recording that it lies in."""
    folder, view = path.resolve().parent.parent, read_view(path)
    home = folder.parent if folder.name == "views" else path.parent
    rig = rig_of(home, path) if folder.name == "views" else view.rig
    name = f"{view.scene} {view.index}"
    return Source(f"view {path.name}", [name], lambda _: view_shot(view, rig, arm_of(home)), rig)


def scenes_of(recording: Path) -> list[str]:
    """Names of the scenes that a recording has views of.

    Raises
    ------
    DataError
        It is no recording, or holds no view.
    """
    if not recording.exists():
        raise DataError(
            f"{recording}: no such file or folder", hint="give a recording or one of its view files"
        )
    found = sorted({p.parent.name for p in (recording / "views").glob("*/view-*.h5")})
    if not found:
        raise DataError(
            f"{recording}: expected a recording with views, found none",
            hint="tofcapture record --scene NAME --out RECORDING",
        )
    return found


def scene_views(recording: Path, scene: str | None = None) -> list[Path]:
    """View files of one scene in order; ``None``: of the first one that is not the board.

    Raises
    ------
    DataError
        It is no recording, or has no such scene.
    """
    found = scenes_of(recording)
    if scene is not None and scene not in found:
        raise DataError(f"{recording}: no scene {scene}", hint=f"it has {', '.join(found)}")
    name = scene or next((n for n in found if n != BOARD_SCENE), found[0])
    return sorted((recording / "views" / name).glob("view-*.h5"))


def pick_view(path: Path, scene: str | None, view: int | None) -> Path:
    """Find one view file: ``path`` itself, or the named view of a recording's scene; ``None``: the first.

    Raises
    ------
    DataError
        There is no such view.
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
    return load_rig(aligned) if aligned.exists() else read_view(view).rig


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
    """(7, 3) origins of an arm's links from the base to the flange, metres; ``None`` without a model."""
    return None if arm is None else np.vstack([np.zeros(3), link_frames(arm, joints)[:, :3, 3]])
