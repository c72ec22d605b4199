"""Define what a board view contributes to the joint alignment: ranges per frequency, rims, and the stereo camera's dense answer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from calibration.range_error.terms import SIMPLE, Terms
from calibration.registration.clouds import (
    TOF_MARGIN,
    Cloud,
    dilate,
    range_sigma,
)
from calibration.registration.pairs import Sighting
from calibration.registration.rims import ACROSS, Rims, lit_rims, square_rims, unveiled_rims
from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.frames import View
from tofcapture.ops import phase
from tofcapture.poses import Float64
from tofcapture.rig import RangeError

STRIDE = 5  # surface pixels skipped; thousands a view remain, and their common bias is not lowered by more
RIM_BESIDE = TOF_MARGIN + ACROSS + 1  # px that a rim may lie off its board's trusted pixels
HALO_RADII = (0.05, 0.15, 0.45)  # of the image width: narrow, middle and wide lens scattering
TERMS = len(SIMPLE)  # range-error coefficients of a frequency


@dataclass(frozen=True)
class JointView:
    """One board view, reduced."""

    illuminator: Float64  #: (3,) ToF frame, metres
    modulation_hz: tuple[float, ...]  #: (F,) distinct frequencies, ascending
    rays: Float64  #: (N, 3) unit rays of the board's pixels, ToF frame
    radius_px: Float64  #: (N,) their distances to the principal point
    ranges: Float64  #: (F, N) metres, free of the factory's range errors, unwrapped
    sigma: Float64  #: (F, N) metres, noise of the ranges
    halos: Float64  #: (F, N, len(HALO_RADII)) metres that a scattered share of one would add to the ranges
    rims: Rims  #: ToF rims, ToF frame
    factory: tuple[RangeError, ...]  #: Range errors that were taken off
    #: Stereo points with normals, and stereo rims, stereo frame
    surface: Cloud
    held: Cloud

    def points(self, frequency: int, error: Float64) -> Float64:
        """Compute points (N, 3), ToF frame, of one frequency's ranges freed of ``error`` (N,) metres."""
        path = 2 * (self.ranges[frequency] - error)
        s = self.illuminator
        radial = (path**2 - s @ s) / (2 * (path - self.rays @ s))
        out: Float64 = radial[:, None] * self.rays
        return out

    def terms(self, frequency: int, coefficients: Float64) -> Float64:
        """Compute what each of U coefficients multiplies, (N, U), in the range error of one frequency.

        They are ``TERMS`` of every frequency (:class:`calibration.range_error.terms.Terms`), then the scattered shares, which
        all frequencies have in common. The error is a function of the true range, so the measured one is first freed of
        ``coefficients`` (U,).
        """
        count = len(self.modulation_hz)
        out = np.zeros((len(self.rays), count * TERMS + len(HALO_RADII)))
        out[:, count * TERMS :] = self.halos[frequency]
        own, terms = slice(frequency * TERMS, (frequency + 1) * TERMS), Terms(self.modulation_hz[frequency])
        true = self.ranges[frequency]
        for _ in range(2):
            out[:, own] = terms.columns(true, self.radius_px)
            true = self.ranges[frequency] - out @ coefficients
        return out


def joint_view_of(view: View, seen: Sighting) -> JointView:
    """Reduce a view."""
    info, phasor = view.tof.info, seen.phasor
    celsius = float(np.mean(view.tof.celsius))
    _, signals = phase.Decoder(info).signals(view.tof.raw.mean(axis=0, dtype=np.float64), celsius)
    board = _pixels_of(seen.surface, info.camera)
    pixels = board[::STRIDE]
    hz = phase.frequencies(info.modulation_hz)
    rays = (info.camera.rays / info.camera.ray_lengths[..., None]).reshape(-1, 3)
    high_sigma = range_sigma(view.tof).reshape(-1)[pixels]
    # Of the board alone: a dark pixel elsewhere has no amplitude to divide by.
    lit = np.abs(phasor).reshape(len(hz), -1)[:, pixels]
    sigma = [high_sigma * hz[-1] / f * lit[-1] / a for f, a in zip(hz, lit, strict=True)]
    stereo = unveiled_rims(seen.rims, view.stereo.points, view.stereo.info.camera)
    return JointView(
        illuminator=info.illuminator,
        modulation_hz=hz,
        rays=rays[pixels],
        radius_px=phase.radius_px(info.camera).reshape(-1)[pixels],
        ranges=signals.ranges.reshape(len(hz), -1)[:, pixels].astype(np.float64),
        sigma=np.stack(sigma),
        halos=halo_errors(phasor, hz).reshape(len(hz), -1, len(HALO_RADII))[:, pixels],
        rims=_beside(lit_rims(phasor, seen.depth, info.camera, info.illuminator), board, info.camera),
        factory=info.range_errors,
        surface=seen.cloud,
        held=square_rims(stereo, seen.cloud, view.rig.T_stereo_tof[:3, 3]),
    )


def halo_errors(phasor: NDArray[np.complex128], modulation_hz: tuple[float, ...]) -> Float64:
    """Compute the range error per unit of scattered share, from the image (F, H, W) that scatters.

    A share k of the light falls back on the sensor as a broad halo: ``z' = z + k (z * h)``, ``h ~ (1 + (r/a)^2)^(-3/2)`` of unit
    sum. The range grows by ``c/(4 pi f) Im(conj(z) (z * h)) / |z|^2`` per unit of k, to first order.

    The answer is (F, H, W, len(HALO_RADII)), metres.
    """
    from scipy.fft import fft2, ifft2

    H, W = phasor.shape[-2:]
    halos = _halo_spectra(H, W)
    out = np.zeros((*phasor.shape, len(HALO_RADII)))
    for j, hz in enumerate(modulation_hz):
        spectrum = fft2(phasor[j], halos[0].shape)
        toward = phasor[j].conj() / np.maximum(np.square(np.abs(phasor[j])), 1e-9)
        for i, halo in enumerate(halos):
            spread = ifft2(spectrum * halo)[:H, :W]
            out[j, :, :, i] = SPEED_OF_LIGHT / (4 * np.pi * hz) * (toward * spread).imag
    return out


@lru_cache(maxsize=1)
def _halo_spectra(H: int, W: int) -> list[NDArray[np.complex128]]:
    """Spectra of the halos of unit sum about the first pixel, on a grid where an image (H, W) does not wrap."""
    from scipy.fft import fft2, next_fast_len

    shape = next_fast_len(2 * H - 1), next_fast_len(2 * W - 1)
    out = []
    for radius in HALO_RADII:
        v, u = np.mgrid[-H + 1 : H, -W + 1 : W]
        halo = (1 + (np.hypot(u, v) / (radius * W)) ** 2) ** -1.5
        about = np.zeros(shape)
        about[v, u] = halo / halo.sum()
        out.append(np.asarray(fft2(about)))
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
