"""From a view and a rig to one sample of the dataset. :func:`make_sample` is the main path; read it first."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.dataset.surface import SPARSE, Surface, clean, find_object, fused
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, ShardReader, TofMaps
from tofcapture.frames import TofInfo, View
from tofcapture.ops.crop import Crop, crop_depth, refine_clearance
from tofcapture.ops.normals import PlaneField, grazing
from tofcapture.ops.phase import Decoder
from tofcapture.ops.project import Projection, Sheet, project, triangulate
from tofcapture.rig import Rig

Float32 = NDArray[np.float32]
SCALES = (1, 2)  # always there
FINEST = (*SCALES, 4)
TRUTHS = ("fused", "single")


@dataclass(frozen=True)
class SampleConfig:
    """Choose what a sample depends on besides the view and the rig.

    Raises :class:`ConfigError`: for other scales.

    Attributes
    ----------
    crop_radius
        Largest distance of the object from the point the ToF camera looks at, along the table, metres. From 100 m on
        everything is the object: no table is looked for and no pixel is OUTSIDE.
    far
        Largest depth of ground truth in the ToF frame, metres.
    scales
        Of the ToF image's resolution, that ground truth is made at: 1 and 2, or 1, 2 and 4.
    truth
        ``fused``: of all views of a scene where their poses allow it; ``single``: each view's own stereo camera alone.
    """

    crop_radius: float = 0.35
    far: float = 2.0
    scales: tuple[int, ...] = SCALES
    truth: str = "single"

    def __post_init__(self) -> None:
        if tuple(self.scales) not in (SCALES, FINEST):
            raise ConfigError(f"scales: expected {SCALES} or {FINEST}, got {self.scales}")
        if self.truth not in TRUTHS:
            raise ConfigError(f"truth: expected {' or '.join(TRUTHS)}, got {self.truth!r}")
        object.__setattr__(self, "scales", tuple(self.scales))

    @property
    def reach(self) -> tuple[float, float]:
        """How far the object extends along the table, and the largest depth, metres."""
        return self.crop_radius, self.far

    def table(self) -> dict[str, Any]:
        """Return the config as JSON types."""
        return {
            "crop_radius": self.crop_radius,
            "far": self.far,
            "scales": list(self.scales),
            "truth": self.truth,
        }


def make_sample(
    view: View,
    rig: Rig,
    config: SampleConfig,
    rng: np.random.Generator,
    decoder: Decoder,
    depth: Float32 | None = None,
    surface: tuple[Surface, int] | None = None,
) -> Sample:
    """Make one sample: the paper's pre-processing, section III.

    Raises :class:`DataError`: the view and the rig are of different cameras.

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
    surface
        The scene's, and the view's number in it, to take the truth from; ``None``: from the view's own cloud.
    """
    check_cameras(view, rig)
    T_base_tof = view.arm_before.T_base_flange @ rig.T_flange_tof
    # Decode the burst, averaged as I and Q.
    decoded = decoder.burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    # Denoise the stereo depth.
    measured = np.ascontiguousarray(view.stereo.points[..., 2] if depth is None else depth)
    native = clean(measured, rig)
    # Align it with the ToF camera, and crop what stands on the table.
    crop = find_object(view, native, rig, config.reach, rng)
    # Project the surface on the ToF plane, with normals and mask: the view's own, or what all views of the scene say.
    sheet = triangulate(native, rig.stereo)
    planes = PlaneField(np.where(sheet.vertex, sheet.depth, np.nan), rig.stereo)
    truths = {
        scale: _ground_truth(sheet, planes, crop, rig, scale, config.far, surface) for scale in config.scales
    }
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
    errors, reach = rig.range_errors or info.range_errors, rig.reach or info.reach
    return replace(info, camera=rig.tof, illuminator=rig.illuminator, range_errors=errors, reach=reach)


def decoder_for(view: View, rig: Rig) -> Decoder:
    """Build the decoder of a view's ToF camera by the rig's constants; it serves all views of that camera."""
    return Decoder(calibrated(view.tof.info, rig))


def _ground_truth(
    sheet: Sheet, planes: PlaneField, crop: Crop, rig: Rig, scale: int, far: float, surface: tuple[Surface, int] | None
) -> GroundTruth:  # fmt: skip
    camera = rig.tof.scaled(scale)
    # A step marks one pixel on either side; from 2x on, those beside it make that one ToF pixel.
    near = max(1, scale - 1)
    seen = project(sheet, rig.stereo, rig.T_tof_stereo, camera, edge_pixels=near, far=far)
    single = smoothed(seen, planes, rig, camera)
    if surface is None:
        return masked(single, rig, camera, crop)
    seen, sigma, views = fused(*surface, rig, camera, single, near, far)
    if len(surface[0].members(surface[1])) == 1:
        seen = single  # no other view says anything of it
    # The last of 24 bits are noise of no use, and would be most of what a shard stores of it.
    coarse = (sigma.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF8000)).view(np.float32)
    return replace(masked(seen, rig, camera, crop, alone=np.abs(views) <= 1), sigma=coarse, views=views)


def smoothed(projection: Projection, planes: PlaneField, rig: Rig, camera: Camera) -> Projection:
    """Take depth and normals of the planes that fit the surface where it is flat but for noise."""
    depth, normals = planes.smooth(
        projection.depth, projection.normals, projection.pixels, camera, rig.T_tof_stereo
    )
    return replace(projection, depth=depth, normals=normals)


def masked(
    projection: Projection, rig: Rig, camera: Camera, crop: Crop, alone: NDArray[np.bool_] | None = None
) -> GroundTruth:
    """Put every reason for mistrust into the bits of one mask; where nothing is cropped, nothing is OUTSIDE.

    Where the view is not ``alone`` (H, W), others saw a surface better, and the standard deviation tells how well it is known.
    """
    some = projection.depth[::SPARSE, ::SPARSE, None] * camera.rays[::SPARSE, ::SPARSE]
    crop = refine_clearance(crop, some[~projection.edge[::SPARSE, ::SPARSE]])
    slanted = np.empty(camera.shape, dtype=bool)
    grazing(projection.depth, projection.normals, camera.rays, rig.T_tof_stereo[:3, 3].copy(), slanted)
    if alone is not None:
        slanted &= alone
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


@dataclass(frozen=True)
class TruthError:
    """Error of ground-truth depth at 2x, over the pixels whose mask is 0.

    Attributes
    ----------
    median_error_mm, p99_error_mm
        Of ``|depth - truth|``, millimetres, printed as such; NaN without pixels.
    pixels
        Pixels whose mask is 0.
    target_pixels, covered_pixels
        Pixels whose ray truly hits the object, and those of them whose mask is 0.
    coverage
        The share of the latter.
    """

    median_error_mm: float
    p99_error_mm: float
    pixels: int
    target_pixels: int
    covered_pixels: int
    coverage: float

    def table(self) -> dict[str, Any]:
        """Return JSON types: numbers that are not finite become null."""
        return {k: v if np.isfinite(v) else None for k, v in asdict(self).items()}


def error_in_words(gt: Mapping[str, Any]) -> str:
    """Say what :meth:`TruthError.table` holds, as far as there is anything."""
    median, p99, share = gt["median_error_mm"], gt["p99_error_mm"], gt["coverage"]
    if median is None:
        return "no pixel to compare"
    most = "more than 1 % where there is no surface" if p99 is None else f"99 % within {p99:.2f} mm"
    covers = "no object is in it" if share is None else f"good on {share:.0%} of the object's pixels"
    return f"median {median:.2f} mm, {most}, {covers}"


@dataclass(frozen=True)
class ViewError:
    """Errors of one view.

    Attributes
    ----------
    errors
        (n,) float32 absolute depth errors where the mask is 0, metres.
    covered, target_pixels
        Pixels of the object with mask 0, pixels of the object.
    """

    errors: Float32
    covered: int
    target_pixels: int


def view_error(sample: Sample, view: View) -> ViewError | None:
    """Compare a sample with the truth that its view carries; ``None`` in the real world."""
    if view.truth is None:
        return None
    gt = sample.ground_truth[2]
    covered = int(((gt.mask == 0) & view.truth.target).sum())
    return ViewError(_absolute(gt, view.truth.depth), covered, int(view.truth.target.sum()))


def pooled(views: Sequence[ViewError]) -> TruthError:
    """Pool the pixels of several views."""
    errors = np.concatenate([v.errors for v in views] or [np.zeros(0, np.float32)])
    target = sum(v.target_pixels for v in views)
    median, p99 = np.percentile(errors, [50, 99], method="nearest") * 1e3 if len(errors) else (np.nan, np.nan)
    covered = sum(v.covered for v in views)
    return TruthError(
        float(median), float(p99), len(errors), target, covered, covered / target if target else float("nan")
    )


def pooled_error(shards: Iterable[Path]) -> TruthError | None:
    """Pool over finished shards; ``None`` when none of them carries truth."""
    views: list[ViewError] = []
    for path in shards:
        with ShardReader(path) as shard:
            gt = shard.provenance.get("gt")
            if gt is not None:
                views.append(ViewError(_shard_errors(shard), gt["covered_pixels"], gt["target_pixels"]))
    return pooled(views) if views else None


def _shard_errors(shard: ShardReader) -> Float32:
    pairs = ((shard.ground_truth(view, 2), shard.truth(view)) for view in range(shard.views))
    return np.concatenate([_absolute(gt, truth.depth) for gt, truth in pairs if truth is not None])


def _absolute(gt: GroundTruth, truth: Float32) -> Float32:
    """Absolute depth errors where the mask is 0.

    Ground truth where the truth has no surface at all is as wrong as can be: it must not vanish from the percentiles.
    """
    errors = np.abs(gt.depth - truth)[gt.mask == 0]
    return np.where(np.isfinite(errors), errors, np.float32(np.inf))
