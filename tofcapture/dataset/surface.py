"""One surface a scene: the stereo clouds of all its views in one frame, from which every view's ground truth is fused.

:func:`put_together` is the story. Each view's cloud is measured and laid down in files that all processes map; the arm's poses
are refined jointly; views that do not see the same surface as the others are kept apart, and named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import TofError
from tofcapture.files.view import read_depth_view
from tofcapture.frames import View
from tofcapture.ops.crop import WHOLE, Crop, crop_depth, find_crop
from tofcapture.ops.denoise import denoise
from tofcapture.ops.fuse import INNER, SURFACE, TARGET, Clouds, Hits, fuse, meet
from tofcapture.ops.normals import RADII, PlaneField, alike_pixels
from tofcapture.ops.project import Projection, RayCast, Sheet, edges, triangulate
from tofcapture.ops.register import Samples, register
from tofcapture.pool import Pool
from tofcapture.poses import Float64, adjoint, invert, rotate_vectors, transform_points
from tofcapture.rig import Rig

SPARSE = 4  # pixels between points that vote for the table
BORDER = 2  # cells from where the surface is cut, in which matches mix both sides
MARGIN = 12  # cells about the object
ABOUT = 0.02  # m, about the object, that are fused with it
PLACES = 600, 300  # sampled planes of the object and of what is about it
APART = "it does not see what the others see: the object moved, or its pose is wrong"
PLANE = 3  # numbers that a plane has


@dataclass(frozen=True)
class Measured:
    """Tell of one view's cloud what the joint refinement needs."""

    samples: Samples
    T_base_stereo: Float64  #: (4, 4) as the arm and the rig say.
    posed: bool  #: Whether anybody said where the view was taken.
    turn: float  #: Of the object, degrees.


@dataclass(frozen=True)
class Surface:
    """Say where the clouds of a scene lie, and which of them one view's ground truth is made of.

    Attributes
    ----------
    folder
        Of the clouds' files.
    poses
        (N, 4, 4) of the stereo cameras, refined.
    group
        (N,) views of one number see one surface.
    covariance
        (6 N, 6 N) of the poses' twists, each in its own stereo frame, metres and radians.
    bounds
        (N, 2, 3) least and largest coordinates of each group's object, base frame, metres.
    alone
        Reason by the number of a view in the scene's list whose truth is its own alone.
    """

    folder: Path
    poses: Float64
    group: NDArray[np.intp]
    covariance: Float64
    bounds: Float64
    alone: Mapping[int, str]

    def members(self, view: int) -> NDArray[np.intp]:
        """Number the views that a view's truth is made of."""
        return np.flatnonzero(self.group == self.group[view])

    def relative(self, view: int, T: Float64) -> Float64:
        """Tell the covariance (N, 6, N, 6) of how all surfaces lie in one view's frame, as twists in a frame that ``T`` maps it to."""
        count = len(self.poses)
        J = np.zeros((count, 6, count, 6))
        for k, pose in enumerate(self.poses):
            if k != view and self.group[k] == self.group[view]:
                J[k, :, k] = adjoint(T @ invert(self.poses[view]) @ pose)
                J[k, :, view] = -adjoint(T)
        flat = J.reshape(6 * count, 6 * count)
        return (flat @ self.covariance @ flat.T).reshape(count, 6, count, 6)

    def clouds(self) -> Clouds:
        """Map the clouds of all views from their files."""
        arrays = {n: np.asarray(np.load(self.folder / f"{n}.npy", mmap_mode="r")) for n in _SHAPES}
        return Clouds(**arrays)


_SHAPES: dict[str, Any] = {
    "depth": np.float32,
    "quads": np.uint8,
    "planes": np.float32,
    "free": np.float32,
    "boxes": np.int64,
}


def _shape(name: str, views: int, camera: Camera) -> tuple[int, ...]:
    height, width = camera.height // 2, camera.width // 2
    last = {"quads": (height - 1, width - 1), "planes": (height, width, 5), "boxes": (4,)}
    return views, *last.get(name, (height, width))


def put_together(
    paths: Sequence[Path], rig: Rig, reach: tuple[float, float], folder: Path, pool: Pool | None = None
) -> Surface:
    """Measure, refine, group.

    ``reach`` is how far the object extends along the table and the largest depth, metres; ``folder`` receives the clouds.
    """
    folder.mkdir()
    for name, dtype in _SHAPES.items():
        np.lib.format.open_memmap(
            folder / f"{name}.npy", "w+", dtype=dtype, shape=_shape(name, len(paths), rig.stereo)
        ).flush()
    work = [(path, rig, reach, folder, number) for number, path in enumerate(paths)]
    if pool is None:
        found = [measure(*arguments) for arguments in work]
    else:
        made: dict[int, Measured] = {}
        for number, one in pool.run(measure, work):
            if isinstance(one, TofError):
                raise one
            made[number] = one
        found = [made[number] for number in range(len(paths))]
    return _joined(found, rig, folder)


def _joined(found: Sequence[Measured], rig: Rig, folder: Path) -> Surface:
    """Refine the poses of each turn of the object; what cannot be fused stays alone, with the reason."""
    poses = np.stack([m.T_base_stereo for m in found])
    group, covariance = np.arange(len(found)), np.zeros((6 * len(found), 6 * len(found)))
    alone: dict[int, str] = {}
    planes, free = (np.load(folder / f"{name}.npy", mmap_mode="r") for name in ("planes", "free"))
    for number, m in enumerate(found):
        if not m.posed:
            alone[number] = "nobody said where it was taken"
        elif not m.samples.target.any():
            alone[number] = "stereo saw nothing of the object"
    for turn in sorted({m.turn for m in found}):
        mine = [k for k, m in enumerate(found) if m.turn == turn and k not in alone]
        if len(mine) < 2:
            alone |= dict.fromkeys(mine, "no other view of it")
            continue
        samples = [found[k].samples for k in mine]
        done = register(samples, planes[mine], free[mine], rig.stereo, poses[mine])
        rows = (6 * np.array(mine)[:, None] + np.arange(6)).ravel()
        covariance[np.ix_(rows, rows)] = done.covariance
        for place, k in enumerate(mine):
            together = int((done.group == done.group[place]).sum())
            if together == 1:
                met = np.isfinite(done.agreeing[place]) | np.isfinite(done.agreeing[:, place])
                alone[k] = APART if met.any() else "no other view shows the same part of the object"
            else:
                poses[k] = done.poses[place]
                group[k] = mine[int(np.flatnonzero(done.group == done.group[place])[0])]
    bounds = np.zeros((len(found), 2, 3))
    for number in set(group.tolist()):
        mine = [k for k in np.flatnonzero(group == number).tolist() if found[k].samples.target.any()]
        points = [transform_points(poses[k], found[k].samples.points[found[k].samples.target]) for k in mine]
        if points:
            cloud = np.concatenate(points)
            bounds[number] = cloud.min(axis=0) - ABOUT, cloud.max(axis=0) + ABOUT
    return Surface(folder, poses, group, covariance, bounds, alone)


def measure(path: Path, rig: Rig, reach: tuple[float, float], folder: Path, number: int) -> Measured:
    """Measure the cloud of one view and lay it down."""
    view, depth = read_depth_view(path)
    native = clean(depth, rig)
    sheet = triangulate(native, rig.stereo)
    crop = find_object(view, native, rig, reach, np.random.default_rng(view.index))
    target: NDArray[np.bool_] = np.isfinite(crop_depth(crop, native, rig.stereo, rig.T_tof_stereo))
    arrays = _cloud(sheet, target, rig)
    for name, values in arrays.items():
        kept = np.load(folder / f"{name}.npy", mmap_mode="r+")
        kept[number] = values
        kept.flush()
    samples = _samples(arrays["planes"], arrays["quads"], rig.stereo, view.index)
    # Without an arm a pose may still be told; one that is exactly nowhere is none.
    posed = not np.array_equal(view.arm_before.T_base_flange, np.eye(4))
    turn = float(view.provenance.get("turn_deg", 0.0))
    return Measured(samples, view.arm_before.T_base_flange @ rig.T_flange_stereo, posed, turn)


def clean(depth: NDArray[np.floating], rig: Rig) -> NDArray[np.float32]:
    """Keep of a stereo depth image (SH, SW) what denoising keeps."""
    return np.where(denoise(depth, rig.stereo), depth, np.float32(np.nan))


def find_object(
    view: View, native: NDArray[np.float32], rig: Rig, reach: tuple[float, float], rng: np.random.Generator
) -> Crop:
    """Find the table, and so the object on it, in every fourth point of every fourth row of stereo depth (SH, SW).

    ``reach`` is as for :func:`put_together`. Without an arm nobody knows which way is up: all of it is the object.
    """
    radius, far = reach
    points = native[::SPARSE, ::SPARSE, None] * rig.stereo.rays[::SPARSE, ::SPARSE]
    points = transform_points(rig.T_tof_stereo, points)
    up = (view.arm_before.T_base_flange @ rig.T_flange_tof)[2, :3]
    return find_crop(points, up, rng, radius if view.has_arm else WHOLE, far)


def _cloud(sheet: Sheet, target: NDArray[np.bool_], rig: Rig) -> dict[str, NDArray[Any]]:
    """Lay out one view as :class:`tofcapture.ops.fuse.Clouds` has it."""
    from scipy.ndimage import minimum_filter

    camera = rig.stereo
    height, width = camera.height // 2, camera.width // 2
    at = np.s_[: 2 * height : 2, : 2 * width : 2]
    surface: NDArray[np.bool_] = np.zeros((2 * height, 2 * width), dtype=bool)
    rows, columns = (min(a, b) for a, b in zip(surface.shape, sheet.surface.shape, strict=True))
    surface[:rows, :columns] = sheet.surface[:rows, :columns]
    cells: NDArray[np.bool_] = np.asarray(surface.reshape(height, 2, width, 2).all(axis=(1, 3)))[:-1, :-1]
    inner = minimum_filter(cells.view(np.uint8), 2 * BORDER + 1, mode="constant")
    quads = (
        cells * np.uint8(SURFACE)
        | inner * np.uint8(INNER)
        | (target[at][:-1, :-1] & cells) * np.uint8(TARGET)
    )
    corner: NDArray[np.bool_] = np.zeros((height, width), dtype=bool)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        corner[down : height - 1 + down, right : width - 1 + right] |= cells
    depth = np.where(sheet.vertex, sheet.depth, np.nan)
    fitted, residual, share = PlaneField(depth, camera).cells()
    planes = np.empty((height, width, 5), dtype=np.float32)
    alike = np.sqrt(alike_pixels(depth, fitted, residual, camera))
    # Of noise that is alike in many pixels a plane takes more than three pixels' worth with it.
    residual = residual / np.sqrt(max(1 - PLANE * (alike / (2 * max(RADII))) ** 2, 0.5))
    noise = float(np.nanmedian(residual)) if np.isfinite(residual).any() else 1e-3
    planes[..., :3] = fitted
    planes[..., 3] = np.where(np.isfinite(residual), residual, noise)
    # A window that is hardly wider than its noise averages more of it than the count says; the numbers are the simulator's.
    planes[..., 4] = residual * share * alike * np.maximum(1.08 - alike * share / np.pi, 0.54)
    planes[~sheet.vertex[at], 4] = np.nan
    z = np.nan_to_num(sheet.depth[: 2 * height, : 2 * width], nan=0.0).reshape(height, 2, width, 2)
    box = np.zeros(4, dtype=np.int64)
    some = (quads & TARGET) > 0
    if some.any():
        v, u = np.flatnonzero(some.any(axis=1)), np.flatnonzero(some.any(axis=0))
        box[:] = (
            max(v[0] - MARGIN, 0),
            min(v[-1] + MARGIN, height),
            max(u[0] - MARGIN, 0),
            min(u[-1] + MARGIN, width),
        )
    return {
        "depth": np.where(corner, sheet.depth[at], np.nan).astype(np.float32),
        "quads": quads,
        "planes": planes,
        "free": minimum_filter(z.min(axis=(1, 3)), 3, mode="constant").astype(np.float32),
        "boxes": box,
    }


def _samples(planes: NDArray[np.float32], quads: NDArray[np.uint8], camera: Camera, seed: int) -> Samples:
    """Draw planes from all directions that the surface has, each as often as the others."""
    rng = np.random.default_rng(seed)
    height, width = planes.shape[:2]
    kind = np.zeros((height, width), dtype=np.uint8)
    kind[:-1, :-1] = quads
    rays = camera.rays[0 : 2 * height : 2, 0 : 2 * width : 2] + 0.5 / np.array([camera.fx, camera.fy, np.inf])
    good = ((kind & INNER) > 0) & (planes[..., 4] > 0)
    points, normals, sigmas, targets = [], [], [], []
    for target, wanted in zip((True, False), PLACES, strict=True):
        at = np.flatnonzero(good.ravel() & (((kind & TARGET) > 0).ravel() == target))
        if not len(at):
            continue
        m = planes.reshape(-1, 5)[at].astype(np.float64)
        size = np.linalg.norm(m[:, :3], axis=1)
        n = -m[:, :3] / size[:, None]
        bucket = np.rint(3 * n).astype(np.int64) @ [1, 10, 100] + 333
        often = np.bincount(bucket)[bucket]
        picked = rng.choice(len(at), min(wanted, len(at)), replace=False, p=1 / often / (1 / often).sum())
        picked.sort()
        r = rays.reshape(-1, 3)[at[picked]]
        z = 1 / np.einsum("mc,mc->m", m[picked, :3], r)
        points.append(z[:, None] * r)
        normals.append(n[picked])
        sigmas.append(z * m[picked, 4] / size[picked])
        targets.append(np.full(len(picked), target))
    if not points:
        return Samples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=bool))
    return Samples(*(np.concatenate(a) for a in (points, normals, sigmas, targets)))


def fused(
    surface: Surface, own: int, rig: Rig, camera: Camera, seen: Projection, edge_pixels: int, far: float
) -> tuple[Projection, Float64, NDArray[np.int8]]:
    """Fuse the scene's surface into a view's image.

    ``seen`` is what the view's own stereo camera shows there. Where no other view measured anything it stays.

    Returns the projection, the standard deviation of its depth (H, W), metres, and the number of views (H, W) that it is made
    of, negative without the own one.
    """
    clouds, members = surface.clouds(), surface.members(own)
    rays = camera.rays
    T_tof_stereo = rig.T_tof_stereo @ invert(surface.poses[own]) @ surface.poses
    grid = rig.stereo
    eye = np.array([grid.fx, grid.fy, grid.cx, grid.cy])
    x, y = (np.ascontiguousarray(r[::2]) for r in (grid.rays[0, :, 0], grid.rays[:, 0, 1]))
    depth, normals, occluded = seen.depth.copy(), seen.normals.copy(), seen.occluded.copy()
    doubtful, others = np.zeros((2, *camera.shape), dtype=bool)
    sigma, views = np.full(camera.shape, np.nan), np.zeros(camera.shape, dtype=np.int8)
    window = np.s_[:, :] if len(members) == 1 else _window(surface, own, rig, camera)
    part = np.array(rays[window], order="C").reshape(-1, 3)
    cast = RayCast(camera, rays[window])
    hits = Hits.none(len(T_tof_stereo), len(part))
    off = surface.relative(own, rig.T_tof_stereo)
    for k in members.tolist():
        top, bottom, left, right = clouds.boxes[k].tolist()
        if k == own:
            top, left = 0, 0
            met = np.concatenate([seen.depth[window][..., None], seen.pixels[window] / 2], axis=-1)
        elif top < bottom:
            box = np.s_[top:bottom, left:right]
            cut = (clouds.quads[k, top : bottom - 1, left : right - 1] & SURFACE) > 0
            met = cast.met(clouds.depth[k][box], cut, x[left:right], y[top:bottom], T_tof_stereo[k], far)
        else:
            continue
        meet(hits, k, met.reshape(-1, 3), (top, left), clouds, T_tof_stereo[k], part, off[k, :, k])
    near, clear = _entry(surface, own, rig, part), ~seen.occluded[window].ravel()
    found = fuse(hits, members, own, clouds, T_tof_stereo, eye, part, off, near, clear, cast.shape[1])
    shape, more = cast.shape, found.others.reshape(cast.shape)
    others[window] = more
    depth[window] = np.where(more, found.depth.reshape(shape), depth[window])
    normals[window] = np.where(more[..., None], found.normals.reshape(*shape, 3), normals[window])
    occluded[window] = np.where(more, found.occluded.reshape(shape), occluded[window])
    doubtful[window] = found.doubtful.reshape(shape)
    sigma[window], views[window] = found.sigma.reshape(shape), found.views.reshape(shape)
    edge = np.where(others, edges(depth, camera, edge_pixels), seen.edge) | doubtful
    return Projection(depth, seen.pixels, normals, occluded, edge), sigma, views


def _window(surface: Surface, own: int, rig: Rig, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of a view's image that may show the object."""
    low, high = surface.bounds[surface.group[own]]
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    p = transform_points(rig.T_tof_stereo @ invert(surface.poses[own]), corners)
    if not (p[:, 2] > 0).all():
        return np.s_[: camera.height, : camera.width]
    at = camera.project(p)[0]
    (left, top), (right, bottom) = (
        np.floor(at.min(axis=0)).astype(int),
        np.ceil(at.max(axis=0)).astype(int) + 1,
    )
    top, left = np.clip((top, left), 0, np.array(camera.shape) - 1)  # one pixel at least
    return np.s_[top : max(bottom, 1), left : max(right, 1)]


def _entry(surface: Surface, own: int, rig: Rig, rays: Float64) -> Float64:
    """Depth at which rays (P, 3) of a view enter the box about the object, metres."""
    T_base_tof = surface.poses[own] @ invert(rig.T_tof_stereo)
    low, high = surface.bounds[surface.group[own]] - T_base_tof[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        way = 1 / rotate_vectors(T_base_tof, rays)
        walls = np.minimum(low * way, high * way)
    return np.asarray(np.maximum(np.maximum(walls[:, 0], walls[:, 1]), walls[:, 2]))
