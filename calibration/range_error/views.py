"""Define what a board view says of the ToF camera's ranges: measured against the range that the stereo surface gives every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import TOF_MARGIN, Mask, dilate, plane_departure, range_sigma
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo, View
from tofcapture.ops import phase
from tofcapture.ops.normals import PlaneField
from tofcapture.ops.project import project, triangulate
from tofcapture.poses import Float64

JUMP = 0.004  # m; departure of the surface from its neighbours that marks a depth edge
WINDOW = 2.5  # px of the ToF image on either side whose stereo points make a pixel's plane
BENT = 0.0015  # m; scatter of the stereo points about the plane of a pixel that sees more than one surface
GRAZING = 0.5  # smallest cosine between ray and normal
DARK = 0.010  # m; predicted noise of the high frequency beyond which a pixel says nothing
THIN = 5  # of how many board pixels one serves where there are thousands: neighbours say the same
FRONT = 0.1  # share of the image's middle that is nearer than what counts as the front
BEHIND = (0.12, 0.10)  # m, or share of the distance, by which what stands behind the front is farther
FLAT = 0.006  # m off the plane of the largest piece
PLENTY = 600  # pixels of a view
FEWEST_PIXELS = 150


@dataclass(frozen=True)
class Seen:
    """A view's part that its ranges are judged by."""

    name: str  #: Path of the view
    info: TofInfo  #: The ToF camera
    phasor: NDArray[np.complex128]  #: (F, H, W) mean of the burst
    saturated: Mask  #: (H, W)
    sigma: Float64  #: (H, W) metres, noise of the high frequency's mean range
    celsius: float  #: Mean temperature; NaN when the camera does not say
    stereo: Camera  #: Intrinsics of the stereo grid
    depth: NDArray[np.float32]  #: (SH, SW) stereo frame, metres; NaN where nothing was measured


@dataclass(frozen=True)
class RangeView:
    """Measured and true ranges of one view's N board pixels at F frequencies."""

    pixels: NDArray[np.intp]  #: (N,) flat indices
    true: Float64  #: (N,) metres, half the path lamp - surface - camera, by the stereo camera
    #: (N, 6) metres per unit of a twist (rho, phi) about ``centre``, ToF axes, on the left of ``T_tof_stereo``
    lever: Float64
    measured: Float64  #: (F, N) metres, wrapped, with all errors
    sigma: Float64  #: (F, N) metres
    amplitude: Float64  #: (F, N) raw units
    celsius: float  #: Mean temperature


def seen_of(view: View, name: str) -> Seen:
    """Reduce a view to what its ranges are judged by."""
    burst = view.tof
    celsius = burst.celsius[np.isfinite(burst.celsius)]
    return Seen(
        name=name,
        info=burst.info,
        phasor=phase.mean_phasors(
            burst.raw, burst.info.modulation_hz, burst.info.phase_rad, offset=burst.info.offset
        ),
        saturated=np.asarray(burst.info.saturated(burst.raw).any(axis=(0, 1))),
        sigma=range_sigma(burst),
        celsius=float(celsius.mean()) if len(celsius) else float("nan"),
        stereo=view.stereo.info.camera,
        depth=np.ascontiguousarray(view.stereo.points[..., 2]),
    )


def surface_at_pixels(seen: Seen, T_tof_stereo: Float64) -> tuple[Float64, Mask]:
    """Fit the stereo surface where every ToF pixel's ray meets it, as ground truth does.

    Returns
    -------
    planes
        (H, W, 3) m with ``m . p = 1``, ToF frame, 1 / metres; NaN where there is no surface.
    good
        (H, W) one smooth surface, not at a grazing angle.
    """
    camera = seen.info.camera
    sheet = triangulate(seen.depth, seen.stereo)
    met = project(sheet, seen.stereo, T_tof_stereo, camera, 1)
    field = PlaneField(np.where(sheet.vertex, sheet.depth, np.nan), seen.stereo)
    radius = round(WINDOW * seen.stereo.fx / camera.fx)
    planes, residual = field.at(met.pixels.reshape(-1, 2), [radius])
    turned = planes @ T_tof_stereo[:3, :3].T
    planes = (turned / (1 + turned @ T_tof_stereo[:3, 3])[:, None]).reshape(*camera.shape, 3)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1 / (planes * camera.rays).sum(axis=-1)
        cosine = 1 / (depth * camera.ray_lengths * np.linalg.norm(planes, axis=-1))
        flat = residual.reshape(camera.shape) * np.square(depth) < BENT
        departure = plane_departure(depth)
    edge = dilate(np.isfinite(departure) & (departure > JUMP), TOF_MARGIN)
    return planes, flat & ~edge & ~met.edge & (cosine > GRAZING) & (depth > 0)


def range_view(seen: Seen, T_tof_stereo: Float64, centre: Float64) -> RangeView:
    """Compare a view's ranges with the stereo surface; twists turn about ``centre`` (3,), ToF frame, metres.

    Raises
    ------
    DataError
        When no surface fills the middle of the image.
    """
    info = seen.info
    planes, good = surface_at_pixels(seen, T_tof_stereo)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1 / (planes * info.camera.rays).sum(axis=-1)
    front = _front(good & ~seen.saturated & (seen.sigma < DARK), depth)
    pixels = np.flatnonzero(_coplanar(front, depth[..., None] * info.camera.rays))
    pixels = pixels[:: min(THIN, max(1, len(pixels) // PLENTY))]
    if len(pixels) < FEWEST_PIXELS:
        raise DataError(
            f"{seen.name}: no surface that both cameras see fills the middle of the ToF image",
            hint="is the rig of this station? keep the board in both images",
        )
    ray = (info.camera.rays / info.camera.ray_lengths[..., None]).reshape(-1, 3)[pixels]
    plane = planes.reshape(-1, 3)[pixels]
    radial = 1 / (plane * ray).sum(axis=1)
    from_lamp = radial[:, None] * ray - info.illuminator
    length = np.linalg.norm(from_lamp, axis=1)
    gain = (1 + (ray * from_lamp).sum(axis=1) / length) / 2  # of half the path, per metre of radial distance
    moved = np.c_[plane, np.cross(radial[:, None] * ray - centre, plane)]
    amplitude = np.abs(seen.phasor).reshape(len(seen.phasor), -1)[:, pixels]
    hz = phase.frequencies(info.modulation_hz)
    flat = seen.phasor.reshape(len(hz), -1)[:, pixels]
    noise = seen.sigma.reshape(-1)[pixels]
    return RangeView(
        pixels=pixels,
        true=(radial + length) / 2,
        lever=moved * (gain * radial)[:, None],  # n / (n . u) = m r, as m . u r = 1
        measured=np.stack([phase.wrapped_range(z, f) for z, f in zip(flat, hz, strict=True)]),
        sigma=np.stack([noise * hz[-1] / f * amplitude[-1] / A for f, A in zip(hz, amplitude, strict=True)]),
        amplitude=amplitude,
        celsius=seen.celsius,
    )


def _front(good: Mask, depth: Float64) -> NDArray[np.intp]:
    """Label the pieces of ``good`` in front: from afar the table about the board is larger and reflects more light."""
    from scipy.ndimage import label, median

    pieces, count = label(good)
    H, W = good.shape
    middle = (slice(H // 3, H - H // 3), slice(W // 3, W - W // 3))
    seen = depth[middle][np.isfinite(depth[middle]) & (depth[middle] > 0)]
    own = np.arange(1, count + 1)
    if not count or not len(seen):
        return np.zeros(good.shape, dtype=np.intp)
    far = np.asarray(median(np.where(good, depth, 0.0), pieces, own))
    reaching = np.isin(own, pieces[H // 4 : H - H // 4, W // 4 : W - W // 4])
    near = float(np.quantile(seen, FRONT))
    front = own[reaching & (far < near + max(BEHIND[0], BEHIND[1] * near))]
    return np.asarray(np.where(np.isin(pieces, front), pieces, 0))


def _coplanar(pieces: NDArray[np.intp], points: Float64) -> Mask:
    """Take the pieces in the plane of the largest one: what shows through a board's holes or beside it is not of it."""
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    out: Mask = (pieces == sizes.argmax()) & (pieces > 0)
    if not out.any():
        return out
    plane = np.linalg.lstsq(points[out], np.ones(int(out.sum())), rcond=None)[0]
    off = np.abs(points @ plane - 1) / np.linalg.norm(plane)
    near = [k for k in np.flatnonzero(sizes) if np.median(off[pieces == k]) < FLAT]
    return np.asarray(np.isin(pieces, near) & (off < 2 * FLAT))


def common_camera(views: Sequence[Seen]) -> TofInfo:
    """Return the camera of all views; :class:`DataError` when they are of different ones."""
    first = views[0].info
    for view in views[1:]:
        if any(
            getattr(view.info, k) != getattr(first, k) for k in ("camera", "modulation_hz", "range_errors")
        ):
            raise DataError(
                f"{view.name}: taken with another ToF camera or calibration than {views[0].name}",
                hint="one recording per rig",
            )
    return first


def wrapped(difference: Float64, hz: float) -> Float64:
    """Take differences of a frequency's ranges into half an ambiguity either side of zero."""
    R = SPEED_OF_LIGHT / (2 * hz)
    out: Float64 = np.mod(difference + R / 2, R) - R / 2
    return out
