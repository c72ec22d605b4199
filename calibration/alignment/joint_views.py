"""What a board view contributes to the joint alignment: ranges per frequency, rims, and the stereo camera's dense answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.alignment.joint_rims import ACROSS, lit_rims, square_rims, unveiled_rims
from calibration.board.rims import Rims
from calibration.registration.clouds import (
    TOF_MARGIN,
    Cloud,
    dilate,
    range_sigma,
    stereo_cloud,
    surface_points,
    tof_depth,
)
from tofcapture.camera import Camera
from tofcapture.frames import View
from tofcapture.ops import phase
from tofcapture.poses import Float64
from tofcapture.rig import SPEED_OF_LIGHT, RangeError

STRIDE = 5  # surface pixels skipped; thousands a view remain, and their common bias is not lowered by more
RIM_BESIDE = TOF_MARGIN + ACROSS + 1  # px that a rim may lie off its board's trusted pixels
HALO_RADII = (0.05, 0.15, 0.45)  # of the image width: narrow, middle and wide lens scattering


@dataclass(frozen=True)
class JointView:
    """One board view, reduced.

    Attributes
    ----------
    name
        Path of the view.
    camera, illuminator
        Of the ToF camera; (3,) metres.
    modulation_hz
        (F,) distinct frequencies, ascending.
    rays
        (N, 3) unit rays of the board's pixels, ToF frame.
    radius_px
        (N,) their distances to the principal point.
    ranges
        (F, N) metres, free of the factory's range errors, unwrapped.
    sigma
        (F, N) metres, noise of the ranges.
    halos
        (F, N, len(HALO_RADII)) metres that a scattered share of one would add to the ranges.
    celsius
        Mean temperature of the burst.
    rims
        ToF rims, ToF frame.
    factory
        Range errors that were taken off.
    surface, held
        Stereo points with normals, and stereo rims, stereo frame.
    truth
        (4, 4) ``T_tof_stereo`` of a simulated view, else None.
    """

    name: str
    camera: Camera
    illuminator: Float64
    modulation_hz: tuple[float, ...]
    rays: Float64
    radius_px: Float64
    ranges: Float64
    sigma: Float64
    halos: Float64
    celsius: float
    rims: Rims
    factory: tuple[RangeError, ...]
    surface: Cloud
    held: Cloud
    truth: Float64 | None

    def points(self, frequency: int, error: Float64) -> Float64:
        """Points (N, 3), ToF frame, of one frequency's ranges freed of ``error`` (N,) metres."""
        path = 2 * (self.ranges[frequency] - error)
        s = self.illuminator
        radial = (path**2 - s @ s) / (2 * (path - self.rays @ s))
        out: Float64 = radial[:, None] * self.rays
        return out


def joint_view_of(view: View, name: str) -> JointView:
    """Reduce a view."""
    info = view.tof.info
    phasor, depth = tof_depth(view.tof)
    decoded = phase.decode(
        phasor,
        info.modulation_hz,
        info.camera,
        info.illuminator,
        info.range_errors,
        float(np.mean(view.tof.celsius)),
    )
    board = _pixels_of(surface_points(view.tof, depth), info.camera)
    pixels = board[::STRIDE]
    hz = phase.frequencies(info.modulation_hz)
    rays = (info.camera.rays / info.camera.ray_lengths[..., None]).reshape(-1, 3)
    high_sigma = range_sigma(view.tof).reshape(-1)[pixels]
    lit = decoded.amplitude.reshape(len(hz), -1)[
        :, pixels
    ]  # of the board: a dark pixel elsewhere has none to divide by
    sigma = [high_sigma * hz[-1] / f * lit[-1] / a for f, a in zip(hz, lit, strict=True)]
    points, surface = view.stereo.points, stereo_cloud(view.stereo)
    return JointView(
        name=name,
        camera=info.camera,
        illuminator=info.illuminator,
        modulation_hz=hz,
        rays=rays[pixels],
        radius_px=phase.radius_px(info.camera).reshape(-1)[pixels],
        ranges=np.stack([decoded.range_low.reshape(-1)[pixels], decoded.range_high.reshape(-1)[pixels]]),
        sigma=np.stack(sigma),
        halos=halo_errors(phasor, hz).reshape(len(hz), -1, len(HALO_RADII))[:, pixels],
        celsius=float(np.mean(view.tof.celsius)),
        rims=_beside(lit_rims(phasor, depth, info.camera, info.illuminator), board, info.camera),
        factory=info.range_errors,
        surface=surface,
        held=square_rims(
            unveiled_rims(points, view.stereo.info.camera), surface, view.rig.T_stereo_tof[:3, 3]
        ),
        truth=None if view.truth is None else view.truth.T_tof_stereo,
    )


def halo_errors(phasor: NDArray[np.complex128], modulation_hz: tuple[float, ...]) -> Float64:
    """Range error per unit of scattered share, from the image that scatters.

    A share k of the light falls back on the sensor as a broad halo: ``z' = z + k (z * h)``, ``h ~ (1 + (r/a)^2)^(-3/2)`` of unit
    sum, so that the range grows by ``c/(4 pi f) Im(conj(z) (z * h)) / |z|^2`` per unit of k, to first order.

    Parameters
    ----------
    phasor
        (F, H, W).
    modulation_hz
        (F,).

    Returns
    -------
    (F, H, W, len(HALO_RADII)) float64, metres.
    """
    H, W = phasor.shape[-2:]
    v, u = np.mgrid[-H + 1 : H, -W + 1 : W]
    out = np.zeros((*phasor.shape, len(HALO_RADII)))
    for i, radius in enumerate(HALO_RADII):
        halo = (1 + (np.hypot(u, v) / (radius * W)) ** 2) ** -1.5
        halo /= halo.sum()
        for j, hz in enumerate(modulation_hz):
            spread = _same(phasor[j], halo)
            power = np.maximum(np.square(np.abs(phasor[j])), 1e-9)
            out[j, :, :, i] = SPEED_OF_LIGHT / (4 * np.pi * hz) * (phasor[j].conj() * spread).imag / power
    return out


def _pixels_of(points: Float64, camera: Camera) -> NDArray[np.intp]:
    """Flat indices of the pixels that points (N, 3) were measured in."""
    u, v = camera.project(points)[0].T
    return np.asarray(np.rint(v).astype(np.intp) * camera.width + np.rint(u).astype(np.intp))


def _beside(rims: Rims, board: NDArray[np.intp], camera: Camera) -> Rims:
    """Rims of the board alone: round things end where they are looked at from, not where they end."""
    mask = np.zeros(camera.width * camera.height, dtype=bool)
    mask[board] = True
    near = dilate(mask.reshape(camera.shape), RIM_BESIDE).reshape(-1)[_pixels_of(rims.points, camera)]
    return Rims(rims.points[near], rims.outward[near])


def _same(image: NDArray[np.complex128], halo: Float64) -> NDArray[np.complex128]:
    from scipy.signal import fftconvolve

    H, W = image.shape
    out: NDArray[np.complex128] = fftconvolve(image, halo, mode="full")[H - 1 : 2 * H - 1, W - 1 : 2 * W - 1]
    return out
