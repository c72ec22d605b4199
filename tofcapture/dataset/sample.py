"""From a view and a rig to one sample of the dataset. :func:`make_sample` is the main path; read it first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, TofMaps
from tofcapture.frames import TofInfo, View
from tofcapture.ops.crop import Crop, crop_depth, find_crop, refine_clearance
from tofcapture.ops.denoise import denoise
from tofcapture.ops.normals import PlaneField, grazing
from tofcapture.ops.phase import Decoder
from tofcapture.ops.project import Projection, Sheet, project, triangulate
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import Rig

Float32 = NDArray[np.float32]
SCALES = (1, 2)  # always there
FINEST = (*SCALES, 4)
SPARSE = 4  # pixels between points that vote for the table


@dataclass(frozen=True)
class SampleConfig:
    """Choose what a sample depends on besides the view and the rig.

    Attributes
    ----------
    crop_radius
        Largest distance of the object from the point the ToF camera looks at, along the table, metres. From 100 m on
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
        """Return the config as JSON types."""
        return {"crop_radius": self.crop_radius, "far": self.far, "scales": list(self.scales)}


def make_sample(
    view: View,
    rig: Rig,
    config: SampleConfig,
    rng: np.random.Generator,
    decoder: Decoder,
    depth: Float32 | None = None,
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
    decoder
        Of the ToF camera: :func:`decoder_for`.
    depth
        (SH, SW) z of the view's point map, for a view that was read without it.

    Raises
    ------
    DataError
        The view and the rig are of different cameras.
    """
    check_cameras(view, rig)
    T_base_tof = view.arm_before.T_base_flange @ rig.T_flange_tof
    # Decode the burst, averaged as I and Q.
    decoded = decoder.burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    # Denoise the stereo depth.
    measured = np.ascontiguousarray(view.stereo.points[..., 2] if depth is None else depth)
    native = np.where(denoise(measured, rig.stereo), measured, np.float32(np.nan))
    # Align it with the ToF camera, and crop what stands on the table.
    crop = find_object(native, rig, T_base_tof, config, rng)
    # Project the surface on the ToF plane, with normals and mask.
    sheet = triangulate(native, rig.stereo)
    planes = PlaneField(np.where(sheet.vertex, sheet.depth, np.nan), rig.stereo)
    truths = {scale: _ground_truth(sheet, planes, crop, rig, scale, config.far) for scale in config.scales}
    return Sample(
        index=view.index,
        raw=view.tof.raw,
        celsius=np.asarray(view.tof.celsius, dtype=np.float64),
        time_ns=np.asarray(view.tof.time_ns, dtype=np.int64),
        tof=TofMaps(decoded.depth, decoded.confidence, decoded.flags),
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


def decoder_for(view: View, rig: Rig) -> Decoder:
    """Build the decoder of a view's ToF camera by the rig's constants; it serves all views of that camera."""
    return Decoder(calibrated(view.tof.info, rig))


def _ground_truth(
    sheet: Sheet, planes: PlaneField, crop: Crop, rig: Rig, scale: int, far: float
) -> GroundTruth:
    camera = rig.tof.scaled(scale)
    seen = project(sheet, rig.stereo, rig.T_tof_stereo, camera, edge_pixels=scale, far=far)
    return masked(smoothed(seen, planes, rig, camera), rig, camera, crop)


def find_object(
    native: Float32, rig: Rig, T_base_tof: Float64, config: SampleConfig, rng: np.random.Generator
) -> Crop:
    """Find the table, and so the object on it, in every fourth point of every fourth row of stereo depth (SH, SW)."""
    points = native[::SPARSE, ::SPARSE, None] * rig.stereo.rays[::SPARSE, ::SPARSE]
    points = transform_points(rig.T_tof_stereo, points)
    return find_crop(points, T_base_tof[2, :3], rng, config.crop_radius, config.far)


def smoothed(projection: Projection, planes: PlaneField, rig: Rig, camera: Camera) -> Projection:
    """Take depth and normals of the planes that fit the surface where it is flat but for noise."""
    depth, normals = planes.smooth(
        projection.depth, projection.normals, projection.pixels, camera, rig.T_tof_stereo
    )
    return replace(projection, depth=depth, normals=normals)


def masked(projection: Projection, rig: Rig, camera: Camera, crop: Crop) -> GroundTruth:
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
