"""From a view and a rig to one sample of the dataset. :func:`make_sample` is the main path; read it first."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.hdf import dumps
from tofcapture.files.info import tof_from, tof_table
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, TofMaps
from tofcapture.frames import TofBurst, TofInfo, View
from tofcapture.ops.crop import Crop, crop_depth, find_crop, refine_clearance
from tofcapture.ops.denoise import denoise
from tofcapture.ops.normals import PlaneField, grazing
from tofcapture.ops.phase import Decoder
from tofcapture.ops.project import Projection, project, triangulate
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig

SCALES = (1, 2)  # always there
FINEST = (*SCALES, 4)
SPARSE = 4  # pixels of the stereo grid between points that vote for the table


@dataclass(frozen=True)
class SampleConfig:
    """What a sample depends on besides the view and the rig.

    Attributes
    ----------
    crop_radius
        Largest distance of the object from the point the ToF camera looks at, along the table, metres; from 100 m on
        everything is the object: no table is looked for and no pixel is OUTSIDE.
    far
        Largest depth of ground truth in the ToF frame, metres.
    scales
        Of the ToF image's resolution, that ground truth is made at: 1 and 2, or 1, 2 and 4.

    Raises
    ------
    ConfigError
        For other scales.
    """

    crop_radius: float = 0.35
    far: float = 2.0
    scales: tuple[int, ...] = SCALES

    def __post_init__(self) -> None:
        if tuple(self.scales) not in (SCALES, FINEST):
            raise ConfigError(f"scales: expected {SCALES} or {FINEST}, got {self.scales}")
        object.__setattr__(self, "scales", tuple(self.scales))

    def table(self) -> dict[str, Any]:
        """As JSON types; the scales only where they are not the default, which shards have always had."""
        table: dict[str, Any] = {"crop_radius": self.crop_radius, "far": self.far}
        return table if self.scales == SCALES else {**table, "scales": list(self.scales)}


def make_sample(
    view: View,
    rig: Rig,
    config: SampleConfig,
    rng: np.random.Generator,
    depth: NDArray[np.float32] | None = None,
) -> Sample:
    """Make one sample: the paper's pre-processing, section III.

    Parameters
    ----------
    view
        What was captured.
    rig
        Calibrated constants; they override what the cameras say of themselves.
    config
        Constants of the ground truth.
    rng
        Draws the triples of the plane search; the same state gives the same sample.
    depth
        (SH, SW) z of the view's point map, for a view that was read without it.

    Returns
    -------
    Sample

    Raises
    ------
    DataError
        When the view and the rig are of different cameras.
    """
    check_cameras(view, rig)
    T_base_tof = view.arm_before.T_base_flange @ rig.T_flange_tof
    tof = decode_burst(view.tof, calibrated(view.tof.info, rig))
    measured = np.ascontiguousarray(view.stereo.points[..., 2] if depth is None else depth)
    native = np.where(denoise(measured, rig.stereo), measured, np.float32(np.nan))
    sheet = triangulate(native, rig.stereo)
    field = PlaneField(np.where(sheet.vertex, sheet.depth, np.nan), rig.stereo)
    crop = find_object(native, rig, T_base_tof, config, rng)
    truths = {}
    for scale in config.scales:
        camera = rig.tof.scaled(scale)
        projection = project(sheet, rig.stereo, rig.T_tof_stereo, camera, edge_pixels=scale, far=config.far)
        truths[scale] = assemble(smoothed(projection, field, rig, camera), rig, camera, crop)
    return Sample(
        index=view.index,
        raw=view.tof.raw,
        celsius=np.asarray(view.tof.celsius, dtype=np.float64),
        time_ns=np.asarray(view.tof.time_ns, dtype=np.int64),
        tof=tof,
        native_depth=crop_depth(crop, native, rig.stereo, rig.T_tof_stereo),
        ground_truth=truths,
        T_base_tof=T_base_tof,
        truth=None if view.truth is None else ExactMaps(view.truth.depth, view.truth.normals),
    )


def check_cameras(view: View, rig: Rig) -> None:
    """Refuse a rig of other cameras than the view's; :class:`DataError` names both sizes."""
    for name, found, expected in (
        ("ToF", view.tof.info.camera.shape, rig.tof.shape),
        ("stereo", view.stereo.info.camera.shape, rig.stereo.shape),
    ):
        if found != expected:
            raise DataError(
                f"{view.scene} view {view.index}: expected {name} images of {expected} as the rig says, got {found}",
                hint="is it the rig of another station?",
            )


def calibrated(info: TofInfo, rig: Rig) -> TofInfo:
    """Describe the ToF camera with the rig's constants instead of the maker's, where the rig has them."""
    return replace(
        info, camera=rig.tof, illuminator=rig.illuminator, range_errors=rig.range_errors or info.range_errors
    )


def decode_burst(burst: TofBurst, info: TofInfo) -> TofMaps:
    """Average a burst as I and Q, decode it to depth, confidence and flags."""
    decoder = _decoder(dumps(tof_table(info)), threading.get_ident())
    found = decoder.burst(burst.raw, float(np.mean(burst.celsius)))
    return TofMaps(found.depth, found.confidence, found.flags)


@lru_cache(maxsize=2)
def _decoder(info: str, thread: int) -> Decoder:  # noqa: ARG001  a decoder's buffers serve one thread
    """Build the tables of a camera once for all views of a scene."""
    return Decoder(tof_from(json.loads(info), "tof_info"))


def find_object(
    native: NDArray[np.float32], rig: Rig, T_base_tof: Float64, config: SampleConfig, rng: np.random.Generator
) -> Crop:
    """Find the table, and so the object on it, in every fourth point of every fourth row of stereo depth (SH, SW)."""
    points = native[::SPARSE, ::SPARSE, None] * rig.stereo.rays[::SPARSE, ::SPARSE]
    points = transform_points(rig.T_tof_stereo, points)
    return find_crop(points, T_base_tof[2, :3], rng, config.crop_radius, config.far)


def smoothed(projection: Projection, field: PlaneField, rig: Rig, camera: Camera) -> Projection:
    """Take depth and normals of the planes that fit the surface where it is flat but for noise."""
    depth, normals = field.smooth(
        projection.depth, projection.normals, projection.pixels, camera, rig.T_tof_stereo
    )
    return replace(projection, depth=depth, normals=normals)


def assemble(projection: Projection, rig: Rig, camera: Camera, crop: Crop) -> GroundTruth:
    """Put every reason for mistrust into the bits of one mask; where nothing is cropped, nothing is OUTSIDE."""
    some = projection.depth[::SPARSE, ::SPARSE, None] * camera.rays[::SPARSE, ::SPARSE]
    crop = refine_clearance(crop, some[~projection.edge[::SPARSE, ::SPARSE]])
    slanted = np.empty(camera.shape, dtype=bool)
    grazing(projection.depth, projection.normals, camera.rays, rig.T_tof_stereo[:3, 3].copy(), slanted)
    mask = np.zeros(camera.shape, dtype=np.uint8)
    for bit, where in (
        (MaskBit.NOT_HIT, np.isnan(projection.depth)),
        (MaskBit.OCCLUDED, projection.occluded),
        (MaskBit.EDGE, projection.edge),
        (MaskBit.GRAZING, slanted),
        (MaskBit.OUTSIDE, np.isfinite(crop.offset) & np.isnan(crop_depth(crop, projection.depth, camera))),
    ):
        mask |= where * np.uint8(bit)
    return GroundTruth(projection.depth.astype(np.float32), projection.normals.astype(np.float32), mask)
