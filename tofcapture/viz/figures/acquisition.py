"""The station as it recorded: arm poses, cameras and the scene in space, the rig, and what one view of each kind shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.files.view import read_view
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig, load_rig
from tofcapture.viz.captured import arm_of, view_shot
from tofcapture.viz.colours import GROUND_TRUTH
from tofcapture.viz.figures.recording import BOARD, links_of, pick_view, scene_views
from tofcapture.viz.figures.table import (
    FONT,
    SMALL,
    WIDTH,
    Cell,
    Scale,
    draw_bar,
    draw_cell,
    percentile,
    round_up,
)
from tofcapture.viz.shots import Shot

_HEIGHT, _HEAD = 4.9, 0.5  # inches
_LEFT, _GAP = 5.35, 0.06  # inches: where panels begin, and between them
_NEAR = 75.0  # percent of all depths that the scale covers
_POINTS = 6000  # of the scene's cloud in space
_FRUSTUM = 0.08  # m, length of a camera's drawing
_REACH = 0.45  # m around what the cameras look at: the cloud that is drawn
_TOF, _STEREO, _ARM = "#e69f00", "#0072b2", "0.35"


@dataclass(frozen=True)
class _Pose:
    """Flange in the base frame, and the origins of the arm's links where they are known."""

    T_base_flange: Float64
    links: Float64 | None


def draw_acquisition(figure: Any, path: Path, scene: str | None, view: int | None) -> str:
    """Draw a recording's way around a scene.

    Parameters
    ----------
    figure
        Of matplotlib.
    path
        Recording.
    scene, view
        Which; ``None``: the first that is no board, and its first view.

    Returns
    -------
    What is on it, in words.

    Raises
    ------
    DataError
        It is no recording, or has no such view.
    """
    if path.is_file():
        raise DataError(f"{path}: expected a recording, got a file", hint="give the folder that holds views/")
    chosen = pick_view(path, scene, view)
    paths = scene_views(path, chosen.parent.name)
    aligned = path / "rig.toml"
    rig = load_rig(aligned) if aligned.exists() else read_view(chosen).rig
    arm = arm_of(path)
    poses = [_Pose(*links_of(p, arm)) for p in paths]
    shots = [view_shot(read_view(p), rig) for p in (chosen, *_board(path, chosen))]
    figure.set_size_inches(WIDTH, _HEIGHT)
    words = f"{chosen.parent.name}: {len(poses)} arm poses; view {int(chosen.stem.removeprefix('view-'))} in black"
    figure.text(0.05 / WIDTH, 1 - 0.05 / _HEIGHT, f"Acquisition of {words}", fontsize=FONT, va="top")
    _space(figure, poses, paths.index(chosen), rig, shots[0])
    _rig(figure.add_axes((0.07, 0.1, 0.26, 0.175)), rig)
    _panels(figure, shots)
    return words + (f", and a view of the board ({shots[1].name})" if len(shots) > 1 else "")


def _board(recording: Path, chosen: Path) -> list[Path]:
    """First board view, where there is one and it is not shown already."""
    found = sorted((recording / "views" / BOARD).glob("view-*.h5"))
    return found[:1] if chosen.parent.name != BOARD else []


def _space(figure: Any, poses: Sequence[_Pose], chosen: int, rig: Rig, shot: Shot) -> None:
    """All of it in the arm's base frame."""
    import mpl_toolkits.mplot3d  # noqa: F401  registers the projection

    axes = figure.add_axes((0.0, 0.37, 0.42, 0.58), projection="3d", computed_zorder=False)
    T = poses[chosen].T_base_flange @ rig.T_flange_tof
    cloud = _cloud(shot, T)
    axes.scatter(*cloud.T, s=0.6, c=np.array([GROUND_TRUTH]) / 255, linewidths=0, rasterized=True, zorder=1)
    drawn = [cloud]
    for i, pose in sorted(enumerate(poses), key=lambda each: each[0] == chosen):
        drawn.append(_pose(axes, pose, rig, is_chosen=i == chosen))
    _equal(axes, np.concatenate(drawn))
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} (m)", fontsize=SMALL, labelpad=2)
        getattr(axes, f"{name}axis").set_major_locator(_ticks())
    axes.tick_params(labelsize=SMALL - 1, pad=0)
    axes.view_init(elev=22, azim=-60)


def _ticks() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(4)


def _cloud(shot: Shot, T_base_tof: Float64) -> Float64:
    """Stereo points (N, 3) around what the camera looks at, base frame, thinned."""
    points = np.asarray(shot.clouds["stereo"].points, dtype=np.float64)
    if len(points) == 0:
        return points
    points = points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < _REACH]
    return transform_points(T_base_tof, points[:: max(1, len(points) // _POINTS)])


def _pose(axes: Any, pose: _Pose, rig: Rig, *, is_chosen: bool) -> Float64:
    """Draw one pose; returns the points (N, 3) that it takes."""
    style = {"lw": 1.2, "alpha": 1.0, "zorder": 3} if is_chosen else {"lw": 0.7, "alpha": 0.7, "zorder": 2}
    taken = []
    for T, camera, colour in (
        (rig.T_flange_tof, rig.tof, _TOF),
        (rig.T_flange_stereo, rig.stereo, _STEREO),
    ):
        lines = transform_points(pose.T_base_flange @ T, _frustum(camera))
        axes.plot(*lines.T, color=colour, **style)
        taken.append(lines)
    if pose.links is not None:
        colour, thick = ("black", 3.0) if is_chosen else (_ARM, 0.7)
        axes.plot(*pose.links.T, color=colour, **{**style, "lw": thick}, marker="o", ms=thick)
        taken.append(pose.links)
    return np.concatenate(taken)


def _frustum(camera: Camera) -> Float64:
    """One line (12, 3) along all edges of a camera's pyramid, its own frame, metres."""
    w, h = camera.width - 1, camera.height - 1
    rays = camera.rays_at(np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=np.float64))
    a, b, c, d = _FRUSTUM * rays / rays[:, 2:]
    o = np.zeros(3)
    return np.stack([o, a, b, o, b, c, o, c, d, o, d, a])


def _equal(axes: Any, points: Float64) -> None:
    low, high = points.min(axis=0), points.max(axis=0)
    extent = np.maximum(high - low, 0.1)
    for name, lo, wide in zip("xyz", low, extent, strict=True):
        getattr(axes, f"set_{name}lim")(lo, lo + wide)
    axes.set_box_aspect(extent, zoom=1.0)


def _rig(axes: Any, rig: Rig) -> None:
    """Both cameras seen along y of the ToF frame."""
    for name, T, camera, colour in (
        ("ToF", np.eye(4), rig.tof, _TOF),
        ("stereo", rig.T_tof_stereo, rig.stereo, _STEREO),
    ):
        lines = 1e3 * transform_points(T, _frustum(camera))
        axes.plot(lines[:, 0], lines[:, 2], color=colour, lw=1.5)
        axes.annotate(
            name,
            lines[0, [0, 2]],
            xytext=(0, -12),
            textcoords="offset points",
            color=colour,
            fontsize=SMALL,
            ha="center",
        )
    baseline = 1e3 * float(np.linalg.norm(rig.T_tof_stereo[:3, 3]))
    axes.set_title(f"rig: {baseline:.0f} mm between the cameras", fontsize=SMALL, pad=3)
    axes.set_xlabel("x, ToF frame (mm)", fontsize=SMALL, labelpad=1)
    axes.set_ylabel("z (mm)", fontsize=SMALL, labelpad=1)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.1, 0.25)
    axes.tick_params(labelsize=SMALL - 1)
    axes.grid(alpha=0.3)


def _panels(figure: Any, shots: Sequence[Shot]) -> None:
    """Amplitude, ToF depth and stereo depth, a row for each shot; columns share their scale."""
    rows = [shot.panels[:3] for shot in shots]
    scales = _scales([[p.values for p in row] for row in rows])
    aspects = [p.values.shape[1] / p.values.shape[0] for p in rows[0]]
    tall = (WIDTH - _LEFT - 0.1 - 2 * _GAP) / sum(aspects)  # all columns are of one height
    lefts = _LEFT + np.concatenate([[0], np.cumsum([a * tall + _GAP for a in aspects])])
    for r, row in enumerate(rows):
        bottom = _HEIGHT - _HEAD - (r + 1) * tall - r * _GAP
        for c, panel in enumerate(row):
            box = (lefts[c] / WIDTH, bottom / _HEIGHT, aspects[c] * tall / WIDTH, tall / _HEIGHT)
            axes = figure.add_axes(box)
            draw_cell(axes, Cell(panel.values, scales[c]))
            if r == 0:
                axes.set_title(("ToF amplitude", "ToF depth", "stereo depth")[c], fontsize=SMALL, pad=3)
            if c == 0:
                axes.set_ylabel(shots[r].name, fontsize=SMALL)
    low = (_HEIGHT - _HEAD - len(rows) * (tall + _GAP) - 0.2) / _HEIGHT
    for scale, left, right in ((scales[0], lefts[0], lefts[1]), (scales[1], lefts[1], lefts[3])):
        draw_bar(
            figure, ((left + 0.1) / WIDTH, low, (right - left - _GAP - 0.2) / WIDTH, 0.11 / _HEIGHT), scale
        )


def _scales(rows: Sequence[Sequence[NDArray[Any]]]) -> tuple[Scale, Scale, Scale]:
    """Amplitude, and one depth for both cameras, which leaves out what is far behind the scene."""
    depths = [values for row in rows for values in row[1:]]
    low = percentile(depths, 2, 0.0)
    high = max(percentile(depths, _NEAR, 1.0), low + 1e-3)
    bright = round_up(percentile([row[0] for row in rows], 99, 1.0))
    depth = Scale("viridis", low, high, "depth (m), each in its camera's frame; grey: none", "both")
    return Scale("cividis", 0.0, bright, "amplitude (raw units)", "max", 0.5), depth, depth
