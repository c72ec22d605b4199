"""Points worth aligning: what a ToF burst and a stereo frame of one view say with certainty.

Averaged ICP is limited by bias, not by noise: flying pixels shrink holes, saturated and dark pixels bend planes. So points are
dropped freely here, and tens of thousands remain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.frames import StereoFrame, TofBurst
from tofcapture.ops import phase
from tofcapture.poses import Float64

Mask = NDArray[np.bool_]

WORKING_DEPTH = (0.2, 1.8)  # m, where a 240x180 sensor of this kind measures (UD-ToF: 0.180 to 1.788 m)
TOF_JUMP = 0.012  # m; departure from the local plane that marks a depth edge, over 4 sigma of a burst's noise
TOF_MARGIN = 2  # px around a ToF depth edge that mixed pixels may reach
STEREO_JUMP = 0.004  # m; the same on the reduced stereo grid, whose noise is ten times lower
STEREO_BLOCK = 4  # px averaged to one stereo point: 2.8 mm at 0.8 m, finer than a ToF pixel
MAX_SIGMA = 0.004  # m; predicted range noise of a burst-averaged pixel above which it is too dark to help


@dataclass(frozen=True)
class Cloud:
    """Points with the directions along which they are held."""

    points: Float64  #: (N, 3) float64, metres, finite
    #: (N, 3) float64, unit: of a surface, facing the camera at the origin of the points' frame; of a
    #: rim, across it
    normals: Float64

    def __len__(self) -> int:
        return len(self.points)

    def __add__(self, other: Cloud) -> Cloud:
        """Put the other cloud's points behind these."""
        return Cloud(
            np.concatenate([self.points, other.points]), np.concatenate([self.normals, other.normals])
        )


def dilate(mask: Mask, pixels: int) -> Mask:
    """Grow a mask (H, W) by a square of ``2 pixels + 1``."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(mask, 2 * pixels + 1, mode="constant"))


def plane_departure(depth: NDArray[np.floating]) -> Float64:
    """Measure how far each pixel lies off the line through its two neighbours, the larger of both image axes.

    Inverse depth is linear in the pixel coordinates on any plane. Its second difference is zero there, and one half jump at a
    depth edge. Depth (H, W) and answer are in metres: NaN where nothing was measured becomes infinite, as do its neighbours and
    the border.
    """
    inverse = 1 / np.asarray(depth, dtype=np.float64)
    bend = np.full((2, *inverse.shape), np.inf)
    bend[0, 1:-1] = inverse[:-2] - 2 * inverse[1:-1] + inverse[2:]
    bend[1, :, 1:-1] = inverse[:, :-2] - 2 * inverse[:, 1:-1] + inverse[:, 2:]
    out = np.abs(bend).max(axis=0) * np.square(depth) / 2
    return np.where(np.isfinite(out), out, np.inf)


def grid_normals(points: NDArray[np.floating]) -> Float64:
    """Compute normals (H, W, 3) of an organised point map (H, W, 3) from its tangents, smoothed over 3 x 3.

    They are unit and face the camera; NaN where a pixel of the 3 x 3 window is missing.
    """
    P = np.pad(np.asarray(points, dtype=np.float64), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    rows = P[:-2] + P[1:-1] + P[2:]
    columns = P[:, :-2] + P[:, 1:-1] + P[:, 2:]
    normal = np.cross(columns[2:] - columns[:-2], rows[:, 2:] - rows[:, :-2])
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    away = (normal * points).sum(axis=-1) > 0
    return np.where(away[..., None], -normal, normal)


def range_sigma(burst: TofBurst) -> Float64:
    """Predict the noise (H, W) of the burst-averaged range, metres, from the burst's own scatter.

    ``sigma_r = c / (4 pi f) sigma_z / A`` at the highest frequency (method: ``sigma_phi = sigma_z / A``). ``sigma_z`` is one
    number, the median over the pixels, so that ten frames estimate it well. A burst of one frame cannot tell and gives zero.
    """
    info, frames = burst.info, len(burst.raw)
    if frames < 2:
        return np.zeros(info.camera.shape)
    z = phase.phasors(burst.raw, info.modulation_hz, info.phase_rad, offset=info.offset)[:, -1]
    scatter = np.sqrt(np.median(z.var(axis=0, ddof=1) / 2) / frames)
    amplitude = np.maximum(np.abs(z.mean(axis=0)), 1e-9)
    out: Float64 = SPEED_OF_LIGHT / (4 * np.pi * max(info.modulation_hz)) * scatter / amplitude
    return out


def tof_depth(burst: TofBurst) -> tuple[NDArray[np.complex128], Float64]:
    """Average a burst as phasors (F, H, W), raw units, and decode it with the camera's own range errors.

    The depth (H, W), metres, is NaN where a tap was saturated or nothing can be decoded.
    """
    info = burst.info
    phasor = phase.mean_phasors(burst.raw, info.modulation_hz, info.phase_rad, offset=info.offset)
    depth = phase.Decoder(info).burst(burst.raw, float(np.mean(burst.celsius))).depth
    return phasor, depth.astype(np.float64)


def surface_points(burst: TofBurst, depth: Float64) -> Float64:
    """Choose trustworthy points (N, 3), ToF frame, metres, on the surface that the rig looks at.

    Dark pixels, pixels within two of a depth edge and everything outside the working depth are dropped. What is left falls
    into pieces, and the one that fills most of the image's centre is the board. Other surfaces see the board's light, which
    lengthens their ranges by up to a centimetre. ``depth`` is that of :func:`tof_depth`.
    """
    from scipy.ndimage import label

    edge = dilate(plane_departure(depth) > TOF_JUMP, TOF_MARGIN)
    good = ~edge & (range_sigma(burst) < MAX_SIGMA) & _within(depth)
    pieces, count = label(good)
    height, width = depth.shape
    centre = pieces[height // 4 : height - height // 4, width // 4 : width - width // 4]
    sizes = np.bincount(centre.ravel(), minlength=count + 1)
    sizes[0] = 0
    points: Float64 = burst.info.camera.unproject(depth)[good & (pieces == sizes.argmax())]
    return points


def stereo_cloud(frame: StereoFrame) -> Cloud:
    """Average dense stereo points over blocks of the organised grid, with normals; stereo frame.

    Blocks that miss more than a quarter of their pixels are dropped, and those at depth edges, where stereo matchers draw veils.
    """
    height, width = (n // STEREO_BLOCK for n in frame.points.shape[:2])
    whole = frame.points[: height * STEREO_BLOCK, : width * STEREO_BLOCK]
    points = _block_means(whole.reshape(height, STEREO_BLOCK, width, STEREO_BLOCK, 3))
    normals = grid_normals(points)
    depth = points[..., 2]
    edge = dilate(plane_departure(depth) > STEREO_JUMP, 1)
    good = ~edge & np.isfinite(normals).all(axis=-1) & _within(depth)
    return Cloud(points[good], normals[good])


def _block_means(tiles: NDArray[np.floating]) -> Float64:
    """Mean points (h, w, 3) of tiles (h, b, w, b, 3); NaN where more than a quarter is missing."""
    present = np.isfinite(tiles[..., 2])
    count = present.sum(axis=(1, 3))
    total = np.where(present[..., None], tiles, 0).sum(axis=(1, 3), dtype=np.float64)
    enough = 4 * count >= 3 * tiles.shape[1] * tiles.shape[3]
    return np.where(enough[..., None], total / np.maximum(count, 1)[..., None], np.nan)


def _within(depth: NDArray[np.floating]) -> Mask:
    near, far = WORKING_DEPTH
    return (depth > near) & (depth < far)
