"""From a view and a rig to one sample of the dataset. :func:`make_sample` is the main path; read it first."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, TofMaps
from tofcapture.frames import TofBurst, TofInfo, View
from tofcapture.ops.crop import Crop, find_crop, inside
from tofcapture.ops.denoise import denoise
from tofcapture.ops.normals import NormalField, grazing
from tofcapture.ops.phase import decode, mean_phasors
from tofcapture.ops.project import Projection, project, triangulate
from tofcapture.ops.register import register
from tofcapture.poses import Float64, rotate_vectors
from tofcapture.rig import Rig

SCALES = (1, 2)


@dataclass(frozen=True)
class SampleConfig:
    """What a sample depends on besides the view and the rig.

    Attributes
    ----------
    crop_radius
        Largest distance of the object from the point the ToF camera looks at, along the table, metres.
    far
        Largest depth of ground truth in the ToF frame, metres.
    """

    crop_radius: float = 0.35
    far: float = 2.0


def make_sample(view: View, rig: Rig, config: SampleConfig, rng: np.random.Generator) -> Sample:
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

    Returns
    -------
    Sample

    Raises
    ------
    DataError
        When the view and the rig are of different cameras, or stereo measured nothing in the ToF camera's view.
    """
    check_cameras(view, rig)
    T_base_tof = view.arm_before.T_base_flange @ rig.T_flange_tof
    tof = decode_burst(view.tof, calibrated(view.tof.info, rig))
    measured = view.stereo.points[..., 2]
    native = np.where(denoise(measured, rig.stereo), measured, np.nan)
    sheet = triangulate(native, rig.stereo)
    points = register(rig.stereo.unproject(sheet.depth), rig.T_tof_stereo, config.far)
    field = NormalField(np.where(sheet.vertex, sheet.depth, np.nan), rig.stereo)
    measured_points = np.where(np.isfinite(native)[..., None], points, np.nan)
    crop = find_crop(measured_points, T_base_tof[2, :3], rng, config.crop_radius, config.far)
    truths = {}
    for scale in SCALES:
        camera = rig.tof.scaled(scale)
        projection = project(sheet, points, camera, edge_pixels=scale)
        truths[scale] = assemble(
            projection, smooth_normals(projection, field, rig, camera), rig, camera, crop
        )
    if all((truth.mask & MaskBit.NOT_HIT).all() for truth in truths.values()):
        raise DataError(
            f"{view.scene} view {view.index}: stereo measured nothing in the ToF camera's view",
            hint="check the rig",
        )
    return Sample(
        index=view.index,
        raw=view.tof.raw,
        celsius=np.asarray(view.tof.celsius, dtype=np.float64),
        time_ns=np.asarray(view.tof.time_ns, dtype=np.int64),
        tof=tof,
        native_depth=np.where(inside(crop, measured_points), native, np.nan).astype(np.float32),
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
    """Average a burst as I and Q, decode it to depth."""
    saturated: NDArray[np.bool_] = np.any(burst.raw >= info.saturation, axis=(0, 1))
    decoded = decode(
        mean_phasors(burst.raw, info.modulation_hz, info.phase_rad),
        info.modulation_hz,
        info.camera,
        info.illuminator,
        info.range_errors,
        celsius=float(np.mean(burst.celsius)),
        saturated=saturated,
    )
    depth = info.camera.radial_to_depth(decoded.radial)
    return TofMaps(depth.astype(np.float32), decoded.confidence.astype(np.float32), saturated)


def smooth_normals(projection: Projection, field: NormalField, rig: Rig, camera: Camera) -> Float64:
    """(H, W, 3) normals of the surface that is met, ToF frame, facing the ToF camera; a triangle's own where no fit does."""
    hit = np.isfinite(projection.depth)
    fitted = rotate_vectors(rig.T_tof_stereo, field.at(projection.pixels[hit]))
    usable = np.einsum("nc,nc->n", fitted, camera.rays[hit]) < 0  # NaN compares false
    out = projection.normals.copy()
    out[hit] = np.where(usable[:, None], fitted, out[hit])
    return out


def assemble(projection: Projection, normals: Float64, rig: Rig, camera: Camera, crop: Crop) -> GroundTruth:
    """Put every reason for mistrust into the bits of one mask."""
    points = camera.unproject(projection.depth)
    bits: tuple[tuple[MaskBit, NDArray[np.bool_]], ...] = (
        (MaskBit.NOT_HIT, ~np.isfinite(projection.depth)),
        (MaskBit.OCCLUDED, projection.occluded),
        (MaskBit.GRAZING, grazing(points, normals, (np.zeros(3), rig.T_tof_stereo[:3, 3]))),
        (MaskBit.EDGE, projection.edge),
        (MaskBit.OUTSIDE, ~inside(crop, points)),
    )
    mask = np.zeros(camera.shape, dtype=np.uint8)
    for bit, where in bits:
        mask[where] |= np.uint8(bit)
    return GroundTruth(projection.depth.astype(np.float32), normals.astype(np.float32), mask)
