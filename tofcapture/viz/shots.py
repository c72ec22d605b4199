"""Hold what one view, one shard's view or one prediction has to show, whatever file it came from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import Kind as ScaleKind
from tofcapture.colours import Scale, UInt8, mask_classes, mask_colours, paint_normals, scale_for
from tofcapture.poses import Float64
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
    """What an alignment says: its words for people, and per pair of clouds (number, RMSE in metres, accepted)."""

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
