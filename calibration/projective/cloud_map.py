"""Projective association for clouds that have lost their grid: what ``align`` registers, rims included.

The cloud is drawn into a pinhole image at its own origin, each pixel of which names the cloud point nearest to it in the
image. Surfaces and rims are drawn apart: a rim's normal lies across the view, so its points are found wherever the surface
beside them would hide them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import Cloud
from calibration.projective.newton import Match
from tofcapture.poses import Float64, transform_points

EDGE_ON = 0.15  # cosine between view and normal below which a point is a rim's: stereo loses surfaces at 0.2
DENSITY = 2.0  # pixels of the image for each cloud point
MARGIN = 0.1  # of the image, around the cloud: guesses are off by centimetres


@dataclass(frozen=True)
class _Layer:
    """Cloud point nearest to each pixel of an image over (x / z, y / z) that starts at ``corner``."""

    nearest: NDArray[np.intp]
    corner: Float64
    pitch: float

    def look_up(self, points: Float64) -> NDArray[np.intp]:
        """Index of the cloud point nearest in the image to points (3, N), -1 outside."""
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (points[0] / points[2] - self.corner[0]) / self.pitch
            v = (points[1] / points[2] - self.corner[1]) / self.pitch
        height, width = self.nearest.shape
        inside = (points[2] > 0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        column, row = (np.rint(np.where(inside, at, 0)).astype(np.intp) for at in (u, v))
        return np.where(inside, self.nearest[row, column], -1)


@dataclass(frozen=True)
class CloudMap:
    """A cloud and the images that find its points.

    Attributes
    ----------
    cloud
        Target, seen from its frame's origin.
    layers
        Of its surfaces and of its rims, as far as there are any.
    """

    cloud: Cloud
    layers: tuple[_Layer, ...]

    def match(self, source: Float64, T: Float64, distance: float) -> Match:
        """Pair moved source points with the nearer of the cloud points that the images name.

        Parameters
        ----------
        source
            (N, 3), source frame, metres.
        T
            (4, 4) ``T_target_source``.
        distance
            Largest distance of a pair, metres.

        Returns
        -------
        Match
            With unit variance: source points are weighted by how often they are repeated.
        """
        moved = np.ascontiguousarray(transform_points(T, source).T)
        best = np.full(len(source), np.square(distance))
        partner = np.full(len(source), -1)
        for layer in self.layers:
            found = layer.look_up(moved)
            apart = _dot(*[moved - self.cloud.points[found].T] * 2)
            nearer = (found >= 0) & (apart < best)
            best[nearer], partner[nearer] = apart[nearer], found[nearer]
        met = np.flatnonzero(partner >= 0)
        points, partner = moved[:, met], partner[met]
        normals = np.ascontiguousarray(self.cloud.normals[partner].T)
        signed = _dot(points - self.cloud.points[partner].T, normals)
        return Match(met, points, normals, signed, np.ones(len(met)), np.zeros(len(met)))


def _dot(a: Float64, b: Float64) -> Float64:
    """Products (N,) of vectors (3, N), summed in one order."""
    out: Float64 = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


def is_rim(cloud: Cloud) -> NDArray[np.bool_]:
    """Which points of a cloud are on rims: their normals lie across the view."""
    view = (cloud.points * cloud.normals).sum(axis=1)
    out: NDArray[np.bool_] = np.abs(view) < EDGE_ON * np.sqrt(np.square(cloud.points).sum(axis=1))
    return out


def cloud_map(cloud: Cloud) -> CloudMap:
    """Draw a cloud as its own camera sees it; points behind that camera are left out."""
    ahead, rim = cloud.points[:, 2] > 0, is_rim(cloud)
    parts = (np.flatnonzero(ahead & ~rim), np.flatnonzero(ahead & rim))
    if not ahead.any():
        return CloudMap(cloud, ())
    flat = cloud.points[ahead, :2] / cloud.points[ahead, 2:]
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = MARGIN * (high - low).max() + 1e-3
    low, size = low - margin, high - low + 2 * margin
    pitch = float(np.sqrt(size[0] * size[1] / (DENSITY * ahead.sum())))
    width, height = (int(n) for n in np.ceil(size / pitch) + 1)
    return CloudMap(
        cloud, tuple(_layer(cloud.points, part, low, pitch, (height, width)) for part in parts if len(part))
    )


def _layer(
    points: Float64, part: NDArray[np.intp], corner: Float64, pitch: float, shape: tuple[int, int]
) -> _Layer:
    from scipy.ndimage import distance_transform_edt

    part = part[np.argsort(-points[part, 2], kind="stable")]  # the nearest is drawn last and hides the others
    column, row = np.rint((points[part, :2] / points[part, 2:] - corner) / pitch).astype(np.intp).T
    drawn = np.full(shape, -1, dtype=np.intp)
    drawn[row, column] = part
    row, column = distance_transform_edt(drawn < 0, return_distances=False, return_indices=True)
    return _Layer(drawn[row, column], corner, pitch)
