"""The rig transform from scenes without a board: silhouettes of the stereo surface against steps of the ToF image.

:func:`align_scenes` is the story. All views of a scene make one surface, so that it is known behind what one view sees. Where a
ToF camera at the present guess would see it end, the image says how far off it ends (:mod:`calibration.registration.steps`), and all
these displacements move the guess. Stereo ends all surfaces a little early or late; by how much is one more unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from calibration.range_error.terms import jackknife
from calibration.registration.relief import Relief
from calibration.registration.steps import (
    SHIFTS,
    Phasors,
    Steps,
    measure_steps,
    misfits_of_shifts,
    phasors_of,
)
from tofcapture.camera import Camera
from tofcapture.dataset.sample import SampleConfig, calibrated
from tofcapture.dataset.surface import clean, put_together
from tofcapture.errors import DataError, QualityError
from tofcapture.files.view import open_view
from tofcapture.ops.project import triangulate
from tofcapture.poses import Float64, exp, hat, invert, rotation_exp, transform, transform_points
from tofcapture.rig import Rig

ROUNDS = 6  # most, with few views in each image of the surface, and with many
NEAR, STILL = 0.06, 0.008  # px that steps move in the median of a round that is the last
BEYOND = 1.3  # a displacement of half a pixel is underestimated by so much
FEW, NEAREST = 3, 8  # views that one image of the surface is made of
FLOOR = 0.05  # px, what the surface's own borders are off
CUT = 4.0  # times as far off as most: such steps do not count
PLACE = 0.04  # m; steps within one cube are one witness
WITNESSES, MIN_VIEWS = 12, 4  # places and views, least
OFF = 0.15  # px that silhouettes may be off in the median; 0.03 to 0.08 in good answers
FATTENING = 0.0005  # m, one sigma by which stereo ends surfaces late
# rad, one sigma by which steps of one side of the image come out wrong in all views alike, a twenty-fifth of a ToF pixel: stereo ends
# surfaces earlier where they turn away from it. Chosen on six stations.
INSET = 2e-4
SIDES = 4
UNCLEAR = "start from a better rig: --initial; did anything move between or during the views?"
PRIOR: Float64 = np.diag([0.0] * 6 + [FATTENING**-2])
TWIST = 1e-6  # m and rad, of numerical derivatives

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TargetlessSolution:
    """What the steps of V views say together."""

    T_tof_stereo: Float64  #: (4, 4)
    centre: Float64  #: (3,) working point, ToF frame, metres
    covariance: Float64  #: (6, 6) of the twist (rho, phi) about ``centre``, ToF axes, that moves the truth to the result
    influence: Float64  #: (V, 6) by how much each view alone departs from all
    used: NDArray[np.intp]  #: (V,) steps that count in each view
    off: Float64  #: (V,) metres, median by which its steps are off, NaN without any
    alone: dict[int, str]  #: why a view does not see what the others of its scene do


@dataclass(frozen=True)
class _Seen:
    """All steps, and where they are."""

    steps: Steps
    view: NDArray[np.intp]  # (N,)
    points: Float64  # (N, 3) on the front's end, ToF frame
    place: NDArray[np.intp]  # (N,) number of the cube of its scene


def align_scenes(
    scenes: Sequence[Sequence[Path]], start: Rig, progress: Progress = lambda _stage, _done, _total: None
) -> TargetlessSolution:
    """Align the cameras by the views of scenes, lists of view files; the rig they start from may be off by 2 degrees and 1 cm.

    :class:`QualityError` where too little of the scenes ends before something deeper, :class:`DataError` where cameras differ.
    """
    views = _read(scenes, start, progress)
    few = replace(views, reliefs=[relief.of(FEW) for relief in views.reliefs])
    down, right = few.best_shift(start.T_tof_stereo, progress)
    turned = transform(rotation_exp([-down / start.tof.fy, right / start.tof.fx, 0.0]), np.zeros(3))
    near = few.settled(turned @ start.T_tof_stereo, NEAR, BEYOND, progress)
    _demand_fit(near)
    done = views.settled(near.T_tof_stereo, STILL, 1.0, progress)
    _demand_fit(done)
    moved, shift = _moved(done, start.tof), few.best_shift(done.T_tof_stereo, progress)
    if moved > NEAR or shift != (0, 0):
        raise QualityError(
            f"targetless alignment: no clear answer: silhouettes moved {moved:.2f} px at last and fit best {shift[1]} px to the right "
            f"and {shift[0]} down",
            hint=UNCLEAR,
        )
    return _solution(done, views)


@dataclass(frozen=True)
class _Views:
    """What is read of V views."""

    images: Sequence[Phasors]
    reliefs: Sequence[Relief]  # the own view first
    scene: NDArray[np.intp]  # (V,) number
    alone: dict[int, str]

    def seen_by(self, view: int, T_tof_stereo: Float64) -> tuple[Float64, Float64]:
        """Pose of a view's ToF camera and the fine depth image there."""
        relief = self.reliefs[view]
        T_base_tof = relief.T_base_stereo[0] @ invert(T_tof_stereo)
        return T_base_tof, relief.seen_by(self.images[view].camera, T_base_tof)

    def best_shift(self, T_tof_stereo: Float64, progress: Progress) -> tuple[int, int]:
        """Say by how many whole pixels, down and right, the images lie off the surface."""
        total = np.zeros((2 * SHIFTS + 1, 2 * SHIFTS + 1))
        for k, image in enumerate(self.images):
            progress("shifts", k, len(self.images))
            total += misfits_of_shifts(image, self.seen_by(k, T_tof_stereo)[1])
        down, right = np.unravel_index(total.argmin(), total.shape)
        return int(down) - SHIFTS, int(right) - SHIFTS

    def settled(self, T_tof_stereo: Float64, still: float, beyond: float, progress: Progress) -> _Done:
        """Move the cameras, ``beyond`` times as far as the steps say, until these move less than ``still`` pixels."""
        for _ in range(ROUNDS):
            seen = self.steps(T_tof_stereo, progress)
            solved = _solve(seen, self.images[0].camera)
            T_tof_stereo = exp(beyond * solved.x[:6]) @ T_tof_stereo
            done = _Done(T_tof_stereo, seen, solved)
            if _moved(done, self.images[0].camera) < still:
                break
        return done

    def steps(self, T_tof_stereo: Float64, progress: Progress) -> _Seen:
        """Measure the steps of all views where space beside them is known to be empty."""
        parts, views, points, places = [], [], [], []
        for k, (image, relief) in enumerate(zip(self.images, self.reliefs, strict=True)):
            progress("steps", k, len(self.images))
            T_base_tof, depth = self.seen_by(k, T_tof_stereo)
            steps = measure_steps(image, depth)
            steps = steps[relief.empty_beside(steps, image.camera, T_base_tof)]
            parts.append(steps)
            views.append(np.full(len(steps), k))
            points.append(image.camera.rays_at(steps.pixel) * steps.front[:, None])
            cube = np.floor(transform_points(T_base_tof, points[-1]) / PLACE)
            places.append(np.column_stack([np.full(len(steps), self.scene[k]), cube]))
        place = np.unique(np.concatenate(places), axis=0, return_inverse=True)[1]
        return _Seen(Steps.joined(parts), np.concatenate(views), np.concatenate(points), place.reshape(-1))


@dataclass(frozen=True)
class _Done:
    T_tof_stereo: Float64
    seen: _Seen  # at the guess before
    solved: _Solved


def _read(scenes: Sequence[Sequence[Path]], start: Rig, progress: Progress) -> _Views:
    """Read all views, and put each scene's surface together."""
    paths = [p for scene in scenes for p in scene]
    images: list[Phasors] = []
    reliefs: list[Relief] = []
    alone: dict[int, str] = {}
    cameras: tuple[Camera, Camera] | None = None
    for scene in scenes:
        sheets = []
        for path in scene:
            progress("reading", len(images), len(paths))
            view = open_view(path)
            if (view.rig.tof, view.rig.stereo) != (cameras := cameras or (view.rig.tof, view.rig.stereo)):
                raise DataError(
                    f"{path}: taken with other cameras than {paths[0]}", hint="use one recording per rig"
                )
            images.append(phasors_of(replace(view.tof, info=calibrated(view.tof.info, start))))
            sheets.append(triangulate(clean(view.stereo.points[..., 2], start), start.stereo))
        with TemporaryDirectory() as folder:
            surface = put_together(scene, start, SampleConfig().reach, Path(folder) / "clouds")
        first = len(images) - len(scene)
        alone |= {first + k: why for k, why in surface.alone.items()}
        for k in range(len(scene)):
            near = _nearest(surface.poses, surface.members(k), k)
            reliefs.append(Relief([sheets[i] for i in near], surface.poses[near], start.stereo))
    return _Views(images, reliefs, np.repeat(np.arange(len(scenes)), [len(s) for s in scenes]), alone)


def _nearest(poses: Float64, members: NDArray[np.intp], own: int) -> NDArray[np.intp]:
    """Choose the views that an image of the surface is made of, the own one first."""
    far = np.linalg.norm(poses[members, :3, 3] - poses[own, :3, 3], axis=1)
    far[members == own] = -1.0
    return members[np.argsort(far, kind="stable")][:NEAREST]


def _demand_fit(done: _Done) -> None:
    """Refuse silhouettes that lie beside the image's steps (:class:`QualityError`)."""
    off = float(np.median(np.abs(done.solved.off)))
    if off > OFF:
        raise QualityError(
            f"targetless alignment: silhouettes stay {off:.2f} px off, expected at most {OFF}", hint=UNCLEAR
        )


def _moved(done: _Done, tof: Camera) -> float:
    """Tell how far the steps moved, px, in the median."""
    return float(np.median(np.linalg.norm(_motion(done.seen.points, tof) @ done.solved.x[:6], axis=1)))


@dataclass(frozen=True)
class _Solved:
    x: Float64  # (7,) twist about the ToF camera, and by how much stereo ends surfaces late, metres
    H: Float64  # (N, 7, 7) normal equations of each step, weighed
    g: Float64  # (N, 7)
    weight: Float64  # (N,)
    inset: Float64  # (7, SIDES) by how much a radian on each side moves the result
    off: Float64  # (N,) px, by which the step is still off, across itself

    def without(self, group: NDArray[np.intp]) -> Float64:
        """Solve (G, 7) without each of the groups (N,) of steps in turn."""
        number = np.unique(group, return_inverse=True)[1]
        H, g = np.zeros((int(number.max()) + 1, 7, 7)), np.zeros((int(number.max()) + 1, 7))
        np.add.at(H, number, self.H)
        np.add.at(g, number, self.g)
        return np.asarray(np.linalg.solve(H.sum(axis=0) + PRIOR - H, (g.sum(axis=0) - g)[..., None])[..., 0])


def _solve(seen: _Seen, tof: Camera) -> _Solved:
    """Find the motion of the surface that explains most displacements."""
    steps = seen.steps
    places, views = len(np.unique(seen.place)), len(np.unique(seen.view))
    if places < WITNESSES or views < MIN_VIEWS:
        raise QualityError(
            f"targetless alignment: expected silhouettes in {WITNESSES} places and {MIN_VIEWS} views, got {places} and {views}",
            hint="record scenes of several objects that stand up from the table, six views or more of each",
        )
    out = steps.outward
    J = np.concatenate([_motion(seen.points, tof), (out * tof.fx / steps.front[:, None])[..., None]], axis=2)
    misfit = np.maximum(steps.misfit, np.median(steps.misfit))
    N, g = steps.information / misfit[:, None, None], steps.gradient / misfit[:, None]
    gain = np.linalg.inv(np.eye(2) + FLOOR**2 * N)
    N, g = N @ gain, (g[:, None] @ gain)[:, 0]
    each_H, each_g = np.einsum("nia,nij,njb->nab", J, N, J, optimize=True), np.einsum("nia,ni->na", J, g)
    weight = np.ones(len(steps))
    for _ in range(30):
        H = np.tensordot(weight, each_H, 1) + PRIOR
        x = np.linalg.solve(H, weight @ each_g)
        left = g - np.einsum("nij,njb,b->ni", N, J, x, optimize=True)
        squared = np.einsum("ni,nij,nj->n", left, np.linalg.pinv(N + 1e-9 * np.eye(2)), left)
        limit = CUT**2 * max(float(np.median(squared)) / 0.8, 0.1)
        weight = np.clip(1 - squared / limit, 0, None) ** 2
    side = [
        np.where((sign * out[:, axis] > 0.5)[:, None], np.eye(2)[axis] * sign * (tof.fx, tof.fy)[axis], 0)
        for axis in (0, 1)
        for sign in (1, -1)
    ]
    inset = np.linalg.solve(
        H, np.einsum("n,nia,nij,nsj->as", weight, J, N, np.stack(side, axis=1), optimize=True)
    )
    off = np.einsum("ni,ni->n", out, left) / np.maximum(np.einsum("ni,nij,nj->n", out, N, out), 1e-9)
    return _Solved(x, weight[:, None, None] * each_H, weight[:, None] * each_g, weight, inset, off)


def _motion(points: Float64, tof: Camera) -> Float64:
    """Move the image (N, 2, 6) of points (N, 3), px, by a twist (rho, phi) about the ToF camera."""
    at = tof.project(points)[0]
    moved = [tof.project(transform_points(exp(TWIST * e), points))[0] - at for e in np.eye(6)]
    return np.stack(moved, axis=-1) / TWIST


def _solution(done: _Done, views: _Views) -> TargetlessSolution:
    """Add what is not known: how views depart from each other, places do, and sides of the image.

    The surface is off alike at one place in all views; by the views' poses, it is off alike in all of one view.
    """
    seen, solved, count = done.seen, done.solved, len(views.images)
    counts = solved.weight > 0
    centre: Float64 = np.average(seen.points, axis=0, weights=solved.weight)
    about = np.eye(6)
    about[:3, 3:] = -hat(centre)
    influence, by_view = jackknife(solved.without(seen.view)[:, :6] @ about.T)
    _, by_place = jackknife(solved.without(seen.place)[:, :6] @ about.T)
    inset = INSET * about @ solved.inset[:6]
    metres = np.abs(solved.off) * seen.steps.front / views.images[0].camera.fx
    off = np.full(count, np.nan)
    for k in np.unique(seen.view[counts]):
        off[k] = np.median(metres[(seen.view == k) & counts])
    used = np.bincount(seen.view[counts], minlength=count)
    covariance = by_view + by_place + inset @ inset.T
    return TargetlessSolution(done.T_tof_stereo, centre, covariance, influence, used, off, views.alone)
