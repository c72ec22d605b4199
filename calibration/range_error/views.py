"""What a board view says of the ToF camera's ranges: measured against the range that the stereo surface gives every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.range_error.surface import surface_at_pixels
from calibration.registration.clouds import Mask, range_sigma
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo, View
from tofcapture.ops import phase
from tofcapture.poses import Float64, transform_points
from tofcapture.rig import SPEED_OF_LIGHT

STEREO_STRIDE = 2  # stereo points of every second row and column
DARK = 0.010  # m; predicted noise of the high frequency beyond which a pixel says nothing
THIN = 5  # of how many board pixels one serves where there are thousands: neighbours say the same
FRONT = 0.1  # share of the image's middle that is nearer than what counts as the front
BEHIND = (0.12, 0.10)  # m, or share of the distance, by which what stands behind the front is farther
FLAT = 0.006  # m off the plane of the largest piece
PLENTY = 600  # pixels of a view
FEWEST_PIXELS = 150


@dataclass(frozen=True)
class Seen:
    """A view without what is not needed of it.

    Attributes
    ----------
    name
        Path of the view.
    info
        The ToF camera.
    phasor
        (F, H, W) complex128, mean of the burst.
    saturated
        (H, W).
    sigma
        (H, W) metres, noise of the high frequency's mean range.
    celsius
        Mean temperature; NaN when the camera does not say.
    points
        (M, 3) stereo frame, metres.
    truth
        (4, 4) ``T_tof_stereo`` of a simulated view, else None.
    """

    name: str
    info: TofInfo
    phasor: NDArray[np.complex128]
    saturated: Mask
    sigma: Float64
    celsius: float
    points: NDArray[np.float32]
    truth: Float64 | None


@dataclass(frozen=True)
class RangeView:
    """Measured and true ranges of one view's board pixels.

    Attributes
    ----------
    name
        Path of the view.
    pixels
        (N,) flat indices.
    true
        (N,) metres, half the path lamp - surface - camera, by the stereo camera.
    lever
        (N, 6) metres per unit of a twist (rho, phi) about ``centre``, ToF axes, on the left of ``T_tof_stereo``.
    measured
        (F, N) metres, wrapped, with all errors.
    sigma
        (F, N) metres.
    amplitude
        (F, N) raw units.
    celsius
        Mean temperature.
    """

    name: str
    pixels: NDArray[np.intp]
    true: Float64
    lever: Float64
    measured: Float64
    sigma: Float64
    amplitude: Float64
    celsius: float


def seen_of(view: View, name: str) -> Seen:
    """Keep of a view what its ranges are judged by."""
    burst = view.tof
    points = view.stereo.points[::STEREO_STRIDE, ::STEREO_STRIDE].reshape(-1, 3)
    celsius = burst.celsius[np.isfinite(burst.celsius)]
    return Seen(
        name=name,
        info=burst.info,
        phasor=phase.mean_phasors(burst.raw, burst.info.modulation_hz, burst.info.phase_rad),
        saturated=np.asarray((burst.raw >= burst.info.saturation).any(axis=(0, 1))),
        sigma=range_sigma(burst),
        celsius=float(celsius.mean()) if len(celsius) else float("nan"),
        points=points[np.isfinite(points).all(axis=1)],
        truth=None if view.truth is None else view.truth.T_tof_stereo,
    )


def range_view(seen: Seen, T_tof_stereo: Float64, centre: Float64) -> RangeView:
    """Compare the ranges of a view's board with the stereo surface.

    Parameters
    ----------
    seen
        The view.
    T_tof_stereo
        (4, 4).
    centre
        (3,) about which twists turn, ToF frame, metres.

    Raises
    ------
    DataError
        When no surface fills the middle of the image.
    """
    info = seen.info
    planes, good = surface_at_pixels(transform_points(T_tof_stereo, seen.points), info.camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = 1 / (planes * info.camera.rays).sum(axis=-1)
    front = _front(good & ~seen.saturated & (seen.sigma < DARK), depth)
    board = _coplanar(front, depth[..., None] * info.camera.rays)
    pixels = np.flatnonzero(board)
    pixels = pixels[:: min(THIN, max(1, len(pixels) // PLENTY))]
    if len(pixels) < FEWEST_PIXELS:
        raise DataError(
            f"{seen.name}: no surface that both cameras see fills the middle of the ToF image",
            hint="is the rig of this station? keep the board in both images",
        )
    ray = (info.camera.rays / info.camera.ray_lengths[..., None]).reshape(-1, 3)[pixels]
    plane = planes.reshape(-1, 3)[pixels]
    radial = 1 / (plane * ray).sum(axis=1)
    true, gain = _half_path(radial, ray, info.illuminator)
    moved = np.c_[plane, np.cross(radial[:, None] * ray - centre, plane)]
    amplitude = np.abs(seen.phasor).reshape(len(seen.phasor), -1)[:, pixels]
    hz = phase.frequencies(info.modulation_hz)
    flat = seen.phasor.reshape(len(hz), -1)[:, pixels]
    noise = seen.sigma.reshape(-1)[pixels]
    return RangeView(
        name=seen.name,
        pixels=pixels,
        true=true,
        lever=moved * (gain * radial)[:, None],  # n / (n . u) = m r, as m . u r = 1
        measured=np.stack([phase.wrapped_range(z, f) for z, f in zip(flat, hz, strict=True)]),
        sigma=np.stack([noise * hz[-1] / f * amplitude[-1] / A for f, A in zip(hz, amplitude, strict=True)]),
        amplitude=amplitude,
        celsius=seen.celsius,
    )


def _front(good: Mask, depth: Float64) -> NDArray[np.intp]:
    """Label the pieces of ``good`` in front in the image's middle: from afar the table about the board is larger and reflects more light."""
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
    """Pieces in the plane of the largest one: a board is flat, and what shows through its holes or beside it is not of it."""
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    out: Mask = (pieces == sizes.argmax()) & (pieces > 0)
    if not out.any():
        return out
    plane = np.linalg.lstsq(points[out], np.ones(int(out.sum())), rcond=None)[0]
    off = np.abs(points @ plane - 1) / np.linalg.norm(plane)
    near = [k for k in np.flatnonzero(sizes) if np.median(off[pieces == k]) < FLAT]
    return np.asarray(np.isin(pieces, near) & (off < 2 * FLAT))


def _half_path(radial: Float64, ray: Float64, lamp: Float64) -> tuple[Float64, Float64]:
    """Half the path lamp - surface - camera, and its derivative by the radial distance."""
    way = radial[:, None] * ray - lamp
    length = np.linalg.norm(way, axis=1)
    return (radial + length) / 2, (1 + (ray * way).sum(axis=1) / length) / 2


def common_camera(views: Sequence[Seen]) -> TofInfo:
    """Return the camera of all views; :class:`DataError` when they are of different ones."""
    first = views[0].info
    for view in views[1:]:
        if (view.info.camera, view.info.modulation_hz, view.info.range_errors) != (
            first.camera,
            first.modulation_hz,
            first.range_errors,
        ):
            raise DataError(
                f"{view.name}: taken with another ToF camera or calibration than {views[0].name}",
                hint="one recording per rig",
            )
    return first


def wrapped(difference: Float64, hz: float) -> Float64:
    """Differences of ranges of a frequency, taken into half an ambiguity either side of zero."""
    R = SPEED_OF_LIGHT / (2 * hz)
    out: Float64 = np.mod(difference + R / 2, R) - R / 2
    return out
