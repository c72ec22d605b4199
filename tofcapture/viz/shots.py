"""Hold what a view or a prediction has to show, whatever file it came from, and draw its clouds.

Points are splatted from far to near and darkened where they lie behind their neighbours. Pictures of a fixed size keep PDF and SVG
small, whatever the number of points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import Kind as ScaleKind
from tofcapture.colours import Scale, UInt8, mask_classes, mask_colours, paint_normals, scale_for
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig

Kind = Literal[ScaleKind, "normals", "mask"]


@dataclass(frozen=True)
class Panel:
    """One picture: values (H, W), or (H, W, 3) for normals, NaN: none; and where the object is, if that is known.

    Its kind decides colours and unit: ``depth`` metres, ``amplitude`` raw units, ``error`` signed and ``expected`` unsigned
    millimetres, ``normals`` unit vectors, ``mask`` bits of ground truth.
    """

    title: str
    kind: Kind
    values: NDArray[Any]
    on_object: NDArray[np.bool_] | None = None

    def paint(self, scale: Scale | None) -> UInt8:
        """(H, W, 3) colours; normals and masks need no scale."""
        if self.kind == "normals":
            return paint_normals(self.values)
        if scale is None:
            painted: UInt8 = mask_colours()[mask_classes(self.values)]
            return painted
        return scale.paint(self.values)


@dataclass(frozen=True)
class Cloud:
    """Points (N, 3) in the ToF frame, metres, and what they are drawn with (r, g, b)."""

    points: NDArray[np.float32]
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class Shot:
    """One row of a sheet, one step of the timeline.

    ``T_base_tof`` is (4, 4) and ``links`` (7, 3) the origins of the arm's links in the base frame, metres, from the base to
    the flange; both are ``None`` where no arm is known.
    """

    name: str
    panels: Sequence[Panel]
    clouds: Mapping[str, Cloud] = field(default_factory=dict)
    T_base_tof: Float64 | None = None
    links: Float64 | None = None


@dataclass(frozen=True)
class Calibration:
    """Hold what an alignment says: its words for people, and per pair of clouds (number, RMSE in metres, accepted)."""

    words: str
    pairs: Sequence[tuple[str, float, bool]] = ()


@dataclass(frozen=True)
class Source:
    """Everything that a path has to show: names of the shots, ``load`` reads shot ``i`` when it is asked for.

    ``rig`` says where the cameras sit, if the file does; only an alignment has a ``calibration``.
    """

    title: str
    names: Sequence[str]
    load: Callable[[int], Shot]
    rig: Rig | None = None
    calibration: Calibration | None = None

    def spread(self, most: int) -> list[int]:
        """Numbers of at most ``most`` shots, spread evenly over all."""
        n = len(self.names)
        return list(range(n)) if n <= most else [round(i) for i in np.linspace(0, n - 1, most)]


def scales_of(panels: Sequence[Panel]) -> dict[str, Scale]:
    """Scale of every kind that has one; panels of one kind share it, so that they can be compared."""
    scales: dict[str, Scale] = {}
    for kind in get_args(ScaleKind):
        alike = sorted((p for p in panels if p.kind == kind), key=lambda p: p.on_object is None)
        if alike:
            objects = [p.on_object for p in alike if p.on_object is not None]
            scales[kind] = scale_for(kind, [p.values for p in alike], objects)
    return scales


# From where clouds are seen: beside the camera, above the table
_AZIMUTH, _ELEVATION = np.radians((40.0, 20.0))
_SHADE = 60.0  # how dark a step of depth makes a point, per unit of the picture's extent
_MARGIN = 0.06  # of the extent


@dataclass(frozen=True)
class Eye:
    """From where clouds are seen, orthographically: x right, y down, z away; corners (2,) of the picture, metres."""

    T_eye_tof: Float64
    low: Float64
    high: Float64

    @property
    def aspect(self) -> float:
        """Width over height."""
        width, height = self.high - self.low
        return float(width / height)


def eye_for(points: Float64, T_base_tof: Float64, aspect: float = 4 / 3) -> Eye:
    """Look at points (N, 3) of the ToF frame from the camera's left and from above, the table level.

    All but 0.5 percent at each side are in the picture, whose width over height is ``aspect``.
    """
    axis = T_base_tof[:3, 2]
    heading = np.arctan2(axis[1], axis[0]) + _AZIMUTH
    flat = np.cos(_ELEVATION)
    away = np.array([np.cos(heading) * flat, np.sin(heading) * flat, -np.sin(_ELEVATION)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(away, right), away]) @ T_base_tof[:3, :3]
    seen = transform_points(T, points)[:, :2] if len(points) else np.zeros((1, 2))
    low, high = np.percentile(seen, (0.5, 99.5), axis=0)
    extent = np.maximum((high - low) * (1 + 2 * _MARGIN), 0.01)
    extent = np.array([max(extent[0], aspect * extent[1]), max(extent[1], extent[0] / aspect)])
    middle = (low + high) / 2
    return Eye(T, middle - extent / 2, middle + extent / 2)


def splat(
    clouds: Sequence[tuple[NDArray[Any], Any]], eye: Eye, width: int = 480, size: int = 2, ground: int = 255
) -> UInt8:
    """Draw clouds as (H, W, 3) uint8 on a plain grey ground, points as squares of ``size`` pixels.

    A cloud is its points (..., 3) in the ToF frame, metres, NaN allowed, and its colour (3,) or colours (..., 3).
    """
    height = round(width / eye.aspect)
    found: list[tuple[Any, Any, Any]] = [(np.zeros(0, np.intp), np.zeros(0), np.zeros((0, 3)))]
    for points, colour in clouds:
        flat = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        known = np.isfinite(flat).all(axis=1)
        painted = np.broadcast_to(np.reshape(colour, (-1, 3)), flat.shape)[known]
        seen = transform_points(eye.T_eye_tof, flat[known])
        at = np.floor((seen[:, :2] - eye.low) / (eye.high - eye.low) * [width, height]).astype(np.intp)
        for dy, dx in np.ndindex(size, size):
            x, y = at[:, 0] + dx, at[:, 1] + dy
            keep = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            found.append(((y * width + x)[keep], seen[keep, 2], painted[keep]))
    index, depth, colours = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.argsort(-depth, kind="stable")  # the nearest is written last
    nearest = np.full(width * height, np.inf)
    nearest[index[order]] = depth[order]
    image = np.full((width * height, 3), float(ground))
    image[index[order]] = colours[order]
    shade = _shade(nearest.reshape(height, width) / float(np.max(eye.high - eye.low)))
    return np.rint(image.reshape(height, width, 3) * shade[..., None]).astype(np.uint8)


def _shade(depth: Float64) -> Float64:
    """Eye-dome lighting (Boucheny 2009): 1 where no neighbour is nearer, less behind a step."""
    padded = np.pad(depth, 2, constant_values=np.inf)
    height, width = depth.shape
    behind = np.zeros(depth.shape)
    there = np.isfinite(depth)
    for dy, dx in ((-2, 0), (2, 0), (0, -2), (0, 2)):
        other = padded[2 + dy : 2 + dy + height, 2 + dx : 2 + dx + width]
        both = there & np.isfinite(other)
        behind[both] += np.clip(depth[both] - other[both], 0, 0.02)
    out: Float64 = np.exp(-_SHADE * behind / 4)
    return out
