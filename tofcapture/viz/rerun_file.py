"""Write a source as a Rerun recording with a blueprint: the only module that speaks to Rerun's library, which changes often."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.colours import GROUND_TRUTH, SENSOR
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing
from tofcapture.poses import Float64, invert
from tofcapture.rig import Rig
from tofcapture.viz.shots import Shot, Source, scales_of

_TIMELINE = "view"
_POINT = 0.0012  # m, radius of a drawn point
_FRUSTUM = 0.08  # m, length of a drawn camera
_COLUMNS = 3


def _load_rerun() -> Any:
    try:
        import rerun
    except ImportError as err:
        raise ConfigError(
            "the viewer Rerun is not installed",
            hint="pip install 'tofcapture[view]', or ask for --png sheet.png",
        ) from err
    return rerun


def write_rrd(source: Source, path: Path, most: int, progress: Callable[[int, int], None]) -> int:
    """Write a source as ``.rrd`` with at most so many shots, spread evenly; returns their number.

    ``progress`` is told how many shots of how many are written.

    Raises :class:`ConfigError`: Rerun is not installed.
    """
    rr = _load_rerun()
    picked = source.spread(most)
    titles = [panel.title for panel in source.load(picked[0]).panels] if picked else []
    with replacing(path) as partial:
        stream = rr.RecordingStream("tofcapture", send_properties=False)
        stream.save(str(partial), default_blueprint=_blueprint(source, titles))
        stream.log("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if source.calibration is not None:
            _log_calibration(rr, stream, source)
        for done, i in enumerate(picked, start=1):
            stream.set_time(_TIMELINE, sequence=i)
            _log_shot(rr, stream, source.load(i), source.rig)
            progress(done, len(picked))
        stream.flush()
        stream.disconnect()
    return len(picked)


def _blueprint(source: Source, titles: list[str]) -> Any:
    """Arrange the space on the left; pictures on the right; words above them; the timeline stands open."""
    import rerun.blueprint as rrb

    space = rrb.Spatial3DView(origin="/base", name="arm, cameras, points (m)")
    words = rrb.TextDocumentView(origin="/words", name=source.title)
    if titles:
        pictures = [rrb.Spatial2DView(origin=f"/images/{i}", name=title) for i, title in enumerate(titles)]
        columns = min(_COLUMNS, max(1, len(pictures) // 2))
        right = rrb.Vertical(words, rrb.Grid(*pictures, grid_columns=columns), row_shares=[1, 5])
    else:
        right = rrb.Vertical(words, rrb.BarChartView(origin="/pairs", name="RMSE of every pair (mm)"))
    return rrb.Blueprint(
        rrb.Horizontal(space, right, column_shares=[2, 3]),
        rrb.TimePanel(state="expanded" if titles else "hidden", timeline=_TIMELINE, play_state="paused"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _place(rr: Any, stream: Any, at: str, T: Float64, *, static: bool = False) -> None:
    stream.log(at, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=static)


def _log_shot(rr: Any, stream: Any, shot: Shot, rig: Rig | None) -> None:
    _place(rr, stream, "base/tof", np.eye(4) if shot.T_base_tof is None else shot.T_base_tof)
    if rig is not None:
        _log_cameras(rr, stream, "base/tof", rig)
    if shot.links is not None:
        stream.log("base/arm", rr.LineStrips3D([shot.links], radii=0.02, colors=[[150, 150, 150]]))
    for name, cloud in shot.clouds.items():
        stream.log(f"base/tof/{name}", rr.Points3D(cloud.points, colors=cloud.colour, radii=_POINT))
    words = [f"### {shot.name}"]
    scales = scales_of(shot.panels)
    for i, panel in enumerate(shot.panels):
        scale = scales.get(panel.kind)
        stream.log(f"images/{i}", rr.Image(panel.paint(scale)))
        words.append(f"- {panel.title}{f': {scale.words}' if scale else ''}")
    words.append(
        "- points: orange the sensor, blue ground truth or stereo, green an estimate; grey pixels: none"
    )
    stream.log("words", rr.TextDocument("\n".join(words), media_type="text/markdown"))


def _log_cameras(rr: Any, stream: Any, at: str, rig: Rig) -> None:
    for name, T, camera, colour in (
        ("camera", np.eye(4), rig.tof, SENSOR),
        ("stereo_camera", rig.T_tof_stereo, rig.stereo, GROUND_TRUTH),
    ):
        _place(rr, stream, f"{at}/{name}", T, static=True)
        stream.log(
            f"{at}/{name}",
            rr.Pinhole(
                focal_length=[camera.fx, camera.fy],
                principal_point=[camera.cx + 0.5, camera.cy + 0.5],  # Rerun's pixel corners are integers
                resolution=[camera.width, camera.height],
                image_plane_distance=_FRUSTUM,
                color=colour,
            ),
            static=True,
        )


def _log_calibration(rr: Any, stream: Any, source: Source) -> None:
    said, rig = source.calibration, source.rig
    if said is None or rig is None:
        return
    _place(rr, stream, "base/tof", rig.T_flange_tof, static=True)
    _log_cameras(rr, stream, "base/tof", rig)
    axes = np.eye(3) * _FRUSTUM
    colours = [[213, 94, 0], [0, 158, 115], [0, 114, 178]]
    stream.log("base", rr.Arrows3D(vectors=axes, colors=colours, labels=["x", "y", "z: flange"]), static=True)
    back = invert(rig.T_flange_tof)[:3, 3]
    stream.log("base/tof", rr.LineStrips3D([[back, np.zeros(3)]], colors=[[150, 150, 150]]), static=True)
    words = "\n".join(f"- {line}" for line in said.words.splitlines())
    stream.log("words", rr.TextDocument(words, media_type="text/markdown"), static=True)
    if said.pairs:
        stream.log("pairs", rr.BarChart(np.array([1e3 * rmse for _, rmse, _ in said.pairs])), static=True)
