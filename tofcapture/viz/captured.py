"""Shots of view files and recordings."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from tofcapture.devices.kinematics import ArmModel, arm_model, link_frames
from tofcapture.errors import DataError, TofError
from tofcapture.files.view import read_view
from tofcapture.frames import View
from tofcapture.ops.phase import Decoder
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.colours import GROUND_TRUTH, SENSOR
from tofcapture.viz.shots import Cloud, Panel, Shot, Source

_STEREO_STEP = 4  # every fourth point of the stereo grid, each way: 80 000 points are enough to look at
_FAR = 3.0  # m; what lies beyond is floor and walls


def recording_source(recording: Path) -> Source:
    """Shots of every view of a recording.

    Parameters
    ----------
    recording
        Folder with ``views/``; ``rig.toml`` in it is used where ``align`` has written one.

    Raises
    ------
    DataError
        It holds no view.
    """
    paths = sorted((recording / "views").glob("*/view-*.h5"))
    if not paths:
        raise DataError(
            f"{recording}: expected views, found none", hint="tofcapture record --scene NAME --out RECORDING"
        )
    aligned = recording / "rig.toml"
    rig = load_rig(aligned) if aligned.exists() else read_view(paths[0]).rig
    arm = arm_of(recording)
    names = [f"{p.parent.name} {int(p.stem.removeprefix('view-'))}" for p in paths]
    return Source(
        f"recording {recording.resolve().name}",
        names,
        lambda i: view_shot(read_view(paths[i]), rig, arm),
        rig,
    )


def view_source(path: Path) -> Source:
    """The one shot of a view file; ``rig.toml`` and ``station.toml`` of the recording that it lies in are used."""
    folder = path.resolve().parents[2] if len(path.resolve().parents) > 2 else path.parent
    view, aligned = read_view(path), folder / "rig.toml"
    rig = load_rig(aligned) if aligned.exists() and path.resolve().parent.parent.name == "views" else view.rig
    return Source(
        f"view {path.name}",
        [f"{view.scene} {view.index}"],
        lambda _: view_shot(view, rig, arm_of(folder)),
        rig,
    )


def arm_of(recording: Path) -> ArmModel | None:
    """Arm that ``station.toml`` names; ``None`` where it names none that is known."""
    try:
        table = tomllib.loads((recording / "station.toml").read_text(encoding="utf-8"))
        return arm_model(str(table["arm"].get("model", "ur10e")))
    except (OSError, KeyError, AttributeError, UnicodeDecodeError, tomllib.TOMLDecodeError, TofError):
        return None  # a picture without the arm's links is still a picture


def view_shot(view: View, rig: Rig, arm: ArmModel | None = None) -> Shot:
    """Decode a view and put its stereo points beside it.

    Parameters
    ----------
    view
        As it was captured.
    rig
        Brings stereo points into the ToF frame.
    arm
        Draws the links; ``None``: not drawn.
    """
    burst = view.tof
    maps = Decoder(burst.info).burst(burst.raw, float(np.mean(burst.celsius)))
    grid = view.stereo.points[::_STEREO_STEP, ::_STEREO_STEP]
    stereo = transform_points(rig.T_tof_stereo, grid[np.isfinite(grid).all(axis=-1)].astype(np.float64))
    panels = [
        Panel("ToF amplitude, high frequency", "amplitude", maps.confidence),
        Panel("ToF depth", "depth", maps.depth),
        Panel("stereo depth", "depth", grid[..., 2]),
    ]
    if view.truth is not None:
        panels.append(Panel("exact depth (simulated)", "depth", view.truth.depth))
    clouds = {
        "tof": Cloud(near(burst.info.camera.unproject(maps.depth)), SENSOR),
        "stereo": Cloud(near(stereo), GROUND_TRUTH),
    }
    T = view.arm_after.T_base_flange @ rig.T_flange_tof
    return Shot(f"{view.scene} {view.index}", panels, clouds, T, _links(arm, view.arm_after.joints))


def near(points: Float64) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """(N, 3) float32: the points that are there and no farther than 3 m."""
    flat = points.reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        keep = np.isfinite(flat).all(axis=1) & (flat[:, 2] < _FAR)
    out: np.ndarray[tuple[int, int], np.dtype[np.float32]] = flat[keep].astype(np.float32)
    return out


def _links(arm: ArmModel | None, joints: Float64) -> Float64 | None:
    if arm is None:
        return None
    return np.vstack([np.zeros(3), link_frames(arm, joints)[:, :3, 3]])
