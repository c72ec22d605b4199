"""The rig as tables and a drawing, in millimetres and degrees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.poses import Float64, invert, rotation_log
from tofcapture.rig import RangeError, Rig

_DRAWING = (560, 300)  # width and height in user units
_AXIS = 0.045  # m, length of the drawn axes
_SAME_DEG, _SAME_MM = 1e-6, 1e-6


@dataclass(frozen=True)
class Transform:
    """A rigid transform in words: name, meaning, where it came from, translation, rotation, matrix rows."""

    name: str
    words: str
    origin: str
    translation: str
    rotation: str
    matrix: list[str]


def camera_rows(rig: Rig) -> list[tuple[str, list[str]]]:
    """Intrinsics of both cameras: (name, cells)."""
    return [(name, _camera(camera)) for name, camera in (("ToF", rig.tof), ("stereo", rig.stereo))]


def _camera(c: Camera) -> list[str]:
    field_of_view = [np.degrees(2 * np.arctan(n / (2 * f))) for n, f in ((c.width, c.fx), (c.height, c.fy))]
    return [
        f"{c.width} x {c.height}",
        *(f"{v:.2f}" for v in (c.fx, c.fy, c.cx, c.cy)),
        " x ".join(f"{a:.1f}" for a in field_of_view),
    ]


def transforms(rig: Rig, evidence: Mapping[str, Any] | None) -> list[Transform]:
    """The rig's two transforms."""
    return [
        _transform(
            "T_tof_stereo", "stereo frame to ToF frame", origin_of_alignment(rig, evidence), rig.T_tof_stereo
        ),
        _transform(
            "T_flange_tof", "ToF frame to flange frame", "as the station's rig says", rig.T_flange_tof
        ),
    ]


def _transform(name: str, words: str, origin: str, T: Float64) -> Transform:
    turn = rotation_log(T[:3, :3])
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle > 0 else np.zeros(3)
    translation = ", ".join(f"{1e3 * x:.2f}" for x in T[:3, 3])
    rotation = f"{np.degrees(angle):.3f} deg about ({', '.join(f'{x:.3f}' for x in axis)})"
    return Transform(name, words, origin, f"({translation}) mm", rotation, [_row(row) for row in T])


def _row(row: Float64) -> str:
    return " ".join(f"{x:10.6f}" for x in row)


def origin_of_alignment(rig: Rig, evidence: Mapping[str, Any] | None) -> str:
    """Say whether the dataset was built with what the evidence describes."""
    if evidence is None:
        return "no evidence was given"
    change = rig.T_tof_stereo @ invert(np.asarray(evidence["T_tof_stereo"], dtype=np.float64))
    angle, shift = (
        float(np.degrees(np.linalg.norm(rotation_log(change[:3, :3])))),
        1e3 * float(np.linalg.norm(change[:3, 3])),
    )
    if angle < _SAME_DEG and shift < _SAME_MM:
        return "calibrated: averaged ICP over board views, see the alignment evidence"
    return f"not the one that the evidence describes: {angle:.3f} deg and {shift:.2f} mm apart"


def range_rows(errors: tuple[RangeError, ...]) -> list[list[str]]:
    """One row per modulation frequency: MHz, offset, scale, wiggling, per pixel, per kelvin."""
    return [
        [
            f"{1e-6 * e.modulation_hz:g}",
            f"{1e3 * e.offset:.2f}",
            f"{1e3 * e.scale:.2f}",
            ", ".join(f"{1e3 * np.hypot(a, b):.2f} ({m}x)" for m, a, b in e.harmonics) or "–",
            f"{1e3 * e.per_pixel_radius:.4f}",
            f"{1e3 * e.per_kelvin:.3f}",
        ]
        for e in errors
    ]


@dataclass(frozen=True)
class Drawing:
    """Lines and labels of a drawing: (x1, y1, x2, y2, class) and (x, y, text), in user units of width x height."""

    width: int
    height: int
    lines: list[tuple[float, float, float, float, str]]
    labels: list[tuple[float, float, str]]


def drawing(rig: Rig) -> Drawing:
    """Flange, ToF and stereo frames with their axes and fields of view, in a parallel projection, to scale."""
    frames = {
        "flange": (np.eye(4), None),
        "ToF": (rig.T_flange_tof, rig.tof),
        "stereo": (rig.T_flange_stereo, rig.stereo),
    }
    segments: list[tuple[Float64, Float64, str]] = []
    for name, (T, camera) in frames.items():
        segments += [(T[:3, 3], T[:3, 3] + _AXIS * T[:3, i], "xyz"[i]) for i in range(3)]
        segments += [] if camera is None else _view_field(T, camera)
        segments += [] if name == "flange" else [(np.zeros(3), T[:3, 3], "link")]
    points = _flat(np.array([p for a, b, _ in segments for p in (a, b)]))
    place = _fit(points)
    at = place(points).round(1).tolist()
    lines = [(*at[2 * i], *at[2 * i + 1], kind) for i, (_, _, kind) in enumerate(segments)]
    origins = place(_flat(np.array([T[:3, 3] for T, _ in frames.values()]))).round(1).tolist()
    return Drawing(
        *_DRAWING, lines, [(x - 8, y - 6, name) for (x, y), name in zip(origins, frames, strict=True)]
    )


def _view_field(T: Float64, camera: Camera) -> list[tuple[Float64, Float64, str]]:
    """Pyramid of what a camera sees, up to 0.12 m."""
    u, v = (
        np.array([0, camera.width, camera.width, 0]) - 0.5,
        np.array([0, 0, camera.height, camera.height]) - 0.5,
    )
    corners = 0.12 * np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=1)
    corners = corners @ T[:3, :3].T + T[:3, 3]
    rim = [(corners[i], corners[(i + 1) % 4], "field") for i in range(4)]
    return rim + [(T[:3, 3], c, "field") for c in corners]


def _flat(points: Float64) -> Float64:
    """Project (N, 3) flange points onto the page: z of the flange runs to the right, y down, x comes out obliquely."""
    right, down = np.array([0.34, 0.0, 0.94]), np.array([-0.30, 0.95, 0.11])
    return np.stack([points @ right, points @ down], axis=1)


def _fit(points: Float64) -> Any:
    """Return the map of page points into the drawing, with a margin, keeping proportions."""
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.array(_DRAWING, dtype=np.float64)
    scale = float(np.min((size - 60) / np.maximum(high - low, 1e-6)))
    return lambda p: (p - (low + high) / 2) * scale + size / 2
