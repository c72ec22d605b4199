"""Relief: the surface of a scene, from the stereo clouds of several views, as a ToF camera would see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.registration.clouds import Mask
from calibration.registration.steps import FINE, Steps
from tofcapture.camera import Camera
from tofcapture.ops.project import RayCast, Sheet
from tofcapture.poses import Float64, invert, transform_points

FAR = 3.0  # m
SAME = 0.0015  # m; depths nearer to each other are one surface
PAST = 0.004  # m; a view sees past a point that is so much nearer than what it saw
EMPTY = 0.002  # m; the same beside a rim
BESIDE = (0.35, 0.8)  # px beside a rim, and
BEHIND = (-0.004, 0.0, 0.012)  # m behind its front, that must be seen empty


@dataclass(frozen=True)
class Relief:
    """What N stereo cameras of one grid saw of a scene, and where they stood."""

    sheets: Sequence[Sheet]
    T_base_stereo: Float64  #: (N, 4, 4)
    camera: Camera  #: of the stereo grid

    def of(self, count: int) -> Relief:
        """Keep the first views."""
        return Relief(self.sheets[:count], self.T_base_stereo[:count], self.camera)

    def seen_by(self, tof: Camera, T_base_tof: Float64) -> Float64:
        """Depth (H FINE, W FINE), metres, of the ToF camera scaled by ``FINE``; NaN where nobody measured.

        The nearest surface counts that no more views see past than agree on.
        """
        fine = tof.scaled(FINE)
        cast, T_tof_base = RayCast(fine, fine.rays), invert(T_base_tof)
        x, y = (np.ascontiguousarray(r) for r in (self.camera.rays[0, :, 0], self.camera.rays[:, 0, 1]))
        hits = np.empty((len(self.sheets), fine.width * fine.height), dtype=np.float32)
        for k, sheet in enumerate(self.sheets):
            T = T_tof_base @ self.T_base_stereo[k]
            depth = cast.met(sheet.depth, sheet.surface, x, y, T, FAR)[..., 0]
            hits[k] = np.where(np.isfinite(depth), depth, np.nan).ravel()
        count = np.isfinite(hits).sum(axis=0)
        nearest, farthest = np.fmin.reduce(hits), np.fmax.reduce(hits)
        sure = (count > 1) & (farthest - nearest < SAME)
        out = np.full(hits.shape[1], np.nan)
        out[sure] = np.nansum(hits[:, sure], axis=0) / count[sure]
        open_ = np.flatnonzero(~sure & (count > 0))
        ordered, rays = np.sort(hits[:, open_], axis=0), fine.rays.reshape(-1, 3)[open_]
        for depth in ordered:
            here = np.flatnonzero(np.isfinite(depth) & np.isnan(out[open_]))
            agree = np.abs(ordered[:, here] - depth[here]) < SAME
            mean = np.where(agree, ordered[:, here], 0).sum(axis=0) / np.maximum(agree.sum(axis=0), 1)
            past = self._views_past(transform_points(T_base_tof, rays[here] * mean[:, None]))
            kept = past < agree.sum(axis=0)
            out[open_[here[kept]]] = mean[kept]
        return out.reshape(fine.shape)

    def empty_beside(self, steps: Steps, tof: Camera, T_base_tof: Float64) -> Mask:
        """Tell beside which steps (N,) somebody saw that the front goes on no further."""
        out = np.ones(len(steps), dtype=bool)
        for beside in BESIDE:
            rays = tof.rays_at(steps.pixel + beside * steps.outward)
            for behind in BEHIND:
                depth = steps.front + np.minimum(behind, (steps.back - steps.front) / 2)
                points = transform_points(T_base_tof, rays * depth[:, None])
                seen = np.zeros(len(points), dtype=bool)
                for k in range(len(self.sheets)):
                    there, z = self._looked_up(k, points, 0)
                    seen |= there > z + EMPTY
                out &= seen
        return out

    def _views_past(self, points: Float64) -> NDArray[np.intp]:
        """How many views see past points (N, 3), base frame, all about them."""
        out = np.zeros(len(points), dtype=np.intp)
        for k in range(len(self.sheets)):
            there, z = self._looked_up(k, points, 1)
            out += there > z + PAST
        return out

    def _looked_up(self, k: int, points: Float64, reach: int) -> tuple[Float64, Float64]:
        """Least measured depth (N,) of a view about points, NaN where any is unknown, and the points' own depth there."""
        g, sheet = self.camera, self.sheets[k]
        p = transform_points(invert(self.T_base_stereo[k]), points)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.stack([g.fx * p[:, 0] / p[:, 2] + g.cx, g.fy * p[:, 1] / p[:, 2] + g.cy])
        inside = (
            (p[:, 2] > 0)
            & (at > reach).all(axis=0)
            & (at[0] < g.width - 1 - reach)
            & (at[1] < g.height - 1 - reach)
        )
        u, v = np.rint(np.where(inside, at, 0)).astype(np.intp)
        least = np.full(len(points), np.inf)
        for down in range(-reach, reach + 1):
            for right in range(-reach, reach + 1):
                place = np.clip(v + down, 0, g.height - 1), np.clip(u + right, 0, g.width - 1)
                least = np.minimum(least, np.where(sheet.vertex[place], sheet.depth[place], np.nan))
        return np.where(inside, least, np.nan), p[:, 2]
