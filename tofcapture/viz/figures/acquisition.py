"""Draw the station as it recorded: arm poses, cameras and the scene in space, the rig, and one view of each kind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.colours import GROUND_TRUTH
from tofcapture.devices.kinematics import ArmModel
from tofcapture.errors import DataError
from tofcapture.files.hdf import fetch, open_checked
from tofcapture.files.layout import BOARD_SCENE, VIEW
from tofcapture.files.view import open_view
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig
from tofcapture.viz.page import STEREO, TOF, draw_rig, frustum
from tofcapture.viz.sheet import FONT, SMALL, WIDTH, Cell, draw_bar, draw_cell
from tofcapture.viz.shots import Shot, scales_of
from tofcapture.viz.sources import (
    arm_of,
    links_of,
    number_of,
    pick_view,
    rig_of,
    scene_views,
    scenes_of,
    view_shot,
)

_HEIGHT, _HEAD = 4.9, 0.5  # inches
_LEFT, _GAP = 5.35, 0.06  # inches: where panels begin, and between them
_POINTS = 6000  # of the scene's cloud in space
_REACH = 0.45  # m around what the cameras look at: the cloud that is drawn
_CHOSEN = {"lw": 1.2, "alpha": 1.0, "zorder": 3}
_OTHER = {"lw": 0.7, "alpha": 0.7, "zorder": 2}


def draw_acquisition(figure: Any, path: Path, scene: str | None, view: int | None) -> str:
    """Draw a recording's way around a scene (the first that is no board); returns what is on it, in words.

    Raises :class:`DataError`: it is no recording, or has no such view.
    """
    if path.is_file():
        raise DataError(f"{path}: expected a recording, got a file", hint="give the folder that holds views/")
    chosen = pick_view(path, scene, view)
    paths = scene_views(path, chosen.parent.name)
    rig, arm = rig_of(path, chosen), arm_of(path)
    board = scenes_of(path).get(BOARD_SCENE, [])[:1]
    shown = [chosen, *(board if chosen.parent.name != BOARD_SCENE else [])]
    shots = [view_shot(open_view(p), rig) for p in shown]
    words = f"{chosen.parent.name}: {len(paths)} arm poses; view {number_of(chosen)} in black"
    figure.set_size_inches(WIDTH, _HEIGHT)
    figure.text(0.05 / WIDTH, 1 - 0.05 / _HEIGHT, f"Acquisition of {words}", fontsize=FONT, va="top")
    poses = [_pose_of(p, arm) for p in paths]
    _draw_space(figure, poses, paths.index(chosen), rig, shots[0])
    axes = figure.add_axes((0.07, 0.1, 0.26, 0.175))
    draw_rig(axes, rig, int(np.argmax(np.abs(rig.T_tof_stereo[:2, 3]))), 2)
    baseline = 1e3 * float(np.linalg.norm(rig.T_tof_stereo[:3, 3]))
    axes.set_title(f"rig: {baseline:.0f} mm between the cameras", fontsize=SMALL, pad=3)
    _draw_panels(figure, shots)
    return words + (f", and a view of the board ({shots[1].name})" if len(shots) > 1 else "")


def _pose_of(path: Path, arm: ArmModel | None) -> tuple[Float64, Float64 | None]:
    """Read the flange (4, 4) and the links (7, 3) of a view in the base frame, without its images."""
    with open_checked(path, VIEW) as file:
        T, joints = (fetch(file, VIEW[f"arm/after/{name}"], path) for name in ("T_base_flange", "joints"))
    return T, links_of(arm, joints)


def _draw_space(figure: Any, poses: Sequence[Any], chosen: int, rig: Rig, shot: Shot) -> None:
    """Draw all poses and the stereo cloud around what the camera looks at, in the arm's base frame."""
    import mpl_toolkits.mplot3d  # noqa: F401  registers the projection
    from matplotlib.ticker import MaxNLocator

    axes = figure.add_axes((0.0, 0.37, 0.42, 0.58), projection="3d", computed_zorder=False)
    points = np.asarray(shot.clouds["stereo"].points, dtype=np.float64)
    if len(points):
        points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < _REACH]
    cloud = transform_points(poses[chosen][0] @ rig.T_flange_tof, points[:: max(1, len(points) // _POINTS)])
    axes.scatter(*cloud.T, s=0.6, c=np.array([GROUND_TRUTH]) / 255, linewidths=0, rasterized=True, zorder=1)
    drawn = [cloud]
    for i, (T, links) in sorted(enumerate(poses), key=lambda each: each[0] == chosen):
        style = _CHOSEN if i == chosen else _OTHER
        for T_flange_camera, camera, colour in (
            (rig.T_flange_tof, rig.tof, TOF),
            (rig.T_flange_stereo, rig.stereo, STEREO),
        ):
            drawn.append(transform_points(T @ T_flange_camera, frustum(camera)))
            axes.plot(*drawn[-1].T, color=colour, **style)
        if links is not None:
            colour, thick = ("black", 3.0) if i == chosen else ("0.35", 0.7)
            axes.plot(*links.T, color=colour, **{**style, "lw": thick}, marker="o", ms=thick)
            drawn.append(links)
    every = np.concatenate(drawn)
    low, extent = every.min(axis=0), np.maximum(np.ptp(every, axis=0), 0.1)
    for name, lo, wide in zip("xyz", low, extent, strict=True):
        getattr(axes, f"set_{name}lim")(lo, lo + wide)
        getattr(axes, f"set_{name}label")(f"{name} (m)", fontsize=SMALL, labelpad=2)
        getattr(axes, f"{name}axis").set_major_locator(MaxNLocator(4))
    axes.set_box_aspect(extent, zoom=1.0)
    axes.tick_params(labelsize=SMALL - 1, pad=0)
    axes.view_init(elev=22, azim=-60)


def _draw_panels(figure: Any, shots: Sequence[Shot]) -> None:
    """Draw amplitude, ToF depth and stereo depth, a row for each shot; depth on a scale of its row's own."""
    rows = [shot.panels[:3] for shot in shots]
    shared = scales_of([panel for row in rows for panel in row])["amplitude"]
    aspects = [p.values.shape[1] / p.values.shape[0] for p in rows[0]]
    tall = (WIDTH - _LEFT - 0.1 - 2 * _GAP) / sum(aspects)  # all columns are of one height
    lefts = _LEFT + np.concatenate([[0], np.cumsum([a * tall + _GAP for a in aspects])])
    for r, (row, shot) in enumerate(zip(rows, shots, strict=True)):
        bottom = _HEIGHT - _HEAD - (r + 1) * tall - r * _GAP
        for c, panel in enumerate(row):
            box = (lefts[c] / WIDTH, bottom / _HEIGHT, aspects[c] * tall / WIDTH, tall / _HEIGHT)
            axes = figure.add_axes(box)
            scale = shared if panel.kind == "amplitude" else scales_of(row)[panel.kind]
            draw_cell(axes, Cell(panel.paint(scale), scale, "" if scale is shared else scale.words))
            if r == 0:
                axes.set_title(panel.title, fontsize=SMALL, pad=3)
            if c == 0:
                axes.set_ylabel(shot.name, fontsize=SMALL)
    low = (_HEIGHT - _HEAD - len(rows) * (tall + _GAP) - 0.2) / _HEIGHT
    box = ((_LEFT + 0.1) / WIDTH, low, (lefts[1] - _LEFT - _GAP - 0.2) / WIDTH, 0.11 / _HEIGHT)
    draw_bar(figure, box, shared, "amplitude (raw units)")
    depth = "depth in each camera's frame: dark near, bright far; grey: none"
    figure.text(lefts[1] / WIDTH, low, depth, fontsize=SMALL - 0.5)
