"""Bring ground truth of any form into an organised point map of a camera that sees along z."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera, distorted
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.frames import NO_TRUTH
from tofcapture.importing.cameras import camera_keys, cameras_of
from tofcapture.importing.plan import Planned
from tofcapture.importing.rules import FARTHEST, NEAREST, Float32, metres
from tofcapture.importing.said import Said
from tofcapture.libraries import load_open3d
from tofcapture.meshes import UNITS
from tofcapture.poses import Float64, invert, transform_points
from tofcapture.rig import camera_from

_SAME = 0.5  # px between intrinsics of one camera
_GRID = 0.5  # px that a point map may be off the pinhole that fits it
_ELSE = (
    "views of the calibration board find it: import them first, --scene calibration, then tofcapture align"
)
_ONE_SURFACE = 0.02  # of depth; neighbours that differ by more are not interpolated


@dataclass(frozen=True)
class PointMap:
    """An organised point map and how its camera stands to the ToF camera."""

    points: NDArray[np.float32]  #: (SH, SW, 3) metres; NaN: not measured.
    camera: Camera  #: A pinhole.
    T_tof_stereo: Float64  #: (4, 4)
    model: str  #: What it was made of; :data:`tofcapture.frames.NO_TRUTH` when there is no ground truth.
    placed: bool = (
        True  #: Whether somebody says how its camera stands; views of the board are there to find it.
    )


def point_map(view: Planned, said: Said, tof: Camera, T_tof_stereo: Float64 | None = None) -> PointMap:
    """Make the point map of a view; ``T_tof_stereo`` is how a second camera stands, where the source does not say.

    Without ground truth it is empty, on the grid of the ToF camera. Raises :class:`DataError` or :class:`ConfigError`: units,
    shapes or frames that cannot be, with what to write into ``import.toml``.
    """
    pinhole = Camera(tof.width, tof.height, tof.fx, tof.fy, tof.cx, tof.cy)
    if view.truth is None:
        return PointMap(np.full((*tof.shape, 3), np.nan, np.float32), pinhole, np.eye(4), NO_TRUTH)
    where = view.pieces[-1].name
    values, kind = view.truth(), str(said.truth.get("kind", ""))
    if view.pieces[-1].path.suffix.lower() == ".pcd" and values.ndim == 3 and not _is_map(values, view, said):
        values = values[np.isfinite(values).all(axis=-1)]
    if values.shape[1:] in {(3,), (3, 3)} and len(values) > 3:
        return _of_surface(values, view, said, pinhole, where)
    if said.truth.get("axes") == "WH":
        values = np.swapaxes(values, 0, 1)
    if values.ndim == 3 and 1 in (values.shape[0], values.shape[-1]):
        values = values.reshape([n for n in values.shape if n > 1])
    if values.ndim == 3 and values.shape[0] == 3 and values.shape[-1] != 3:
        values = np.moveaxis(values, 0, -1)
    if not kind:
        kind = (
            "points" if values.ndim == 3 and values.shape[-1] == 3 and values.dtype.kind == "f" else "depth"
        )
    camera, chained = _second(said, tof, values.shape)
    camera = camera or view.truth_facts.camera
    T = said.transform("T_tof_truth")
    T = view.T_tof_truth if T is None else T
    T = chained if T is None else T
    T = T_tof_stereo if T is None and (camera or kind == "points") else T
    unit = str(said.truth.get("unit", "") or view.truth_facts.unit)
    missing = said.tuple_of("truth", "missing")
    placed = T is not None or view.scene != BOARD_SCENE or (camera is None and kind != "points")
    T = T if placed else np.eye(4)
    if kind == "points":
        found = _of_points(values, unit, missing, camera, T, where)
    else:
        depth = metres(values, unit, missing, where)
        found = _of_depth(depth, kind == "radial", camera, T, tof, where)
    return replace(found, placed=placed)


def _second(said: Said, tof: Camera, shape: tuple[int, ...]) -> tuple[Camera | None, Float64 | None]:
    """Read ``[truth] camera``: a table, ``fx,fy,cx,cy`` or ``FILE#NAME``; and (4, 4) to the ToF camera, where that is the file's first."""
    told = said.truth.get("camera")
    if not isinstance(told, str):
        return said.truth_camera(), None
    file, _, name = told.partition("#")
    beside = Path(said.where).parent / file
    path = beside if beside.exists() else Path(file)
    keys = camera_keys(f"{path}#{name}" if name else str(path))
    camera = camera_from({"height": shape[0], "width": shape[1], **keys}, f"{said.where}: [truth] camera")
    found = cameras_of(path) if name else {}
    first = next((one.keys for one in found.values()), {})
    ours = all(abs(first.get(k, np.inf) - getattr(tof, k)) < _SAME for k in ("fx", "fy", "cx", "cy"))
    return camera, found[name].T if ours and name in found else None


def _is_map(points: NDArray[Any], view: Planned, said: Said) -> bool:
    """Whether points (H, W, 3) of a cloud are seen by a pinhole that stands where somebody says; others are a surface."""
    if said.transform("T_tof_truth") is None and view.T_tof_truth is None and view.T_world_tof is not None:
        return False
    try:
        pinhole_of(np.where((points == 0).all(axis=-1, keepdims=True), np.nan, points), "")
    except DataError:
        return False
    return True


def _of_depth(
    depth: Float32, radial: bool, camera: Camera | None, T: Float64 | None, tof: Camera, where: str
) -> PointMap:
    """Lift a depth image (H, W), metres, of the ToF camera or of one of its own."""
    if camera is None and depth.shape != tof.shape:
        turned = " turned" if depth.shape == tof.shape[::-1] else ""
        raise DataError(
            f"{where}: expected depth in the ToF image, {tof.shape}, got {depth.shape}{turned}",
            hint='rows and columns have changed places: [truth] axes = "WH" in import.toml'
            if turned
            else "of another camera? [truth.camera] width, height, fx, fy, cx, cy and [truth] T_tof_truth in import.toml",
        )
    if camera is not None and depth.shape != camera.shape:
        raise DataError(
            f"{where}: expected depth of {camera.shape} as its camera says, got {depth.shape}",
            hint="[truth.camera] has the intrinsics of this very image",
        )
    if camera is not None and T is None:
        raise ConfigError(
            f"{where}: where its camera stands is not known: missing [truth] T_tof_truth",
            hint=f"the (4, 4) that maps its frame to the ToF frame, metres; {_ELSE}",
        )
    own = camera or tof
    z = np.asarray(depth / own.ray_lengths if radial else depth, dtype=np.float32)
    z = rectified(z, own)
    pinhole = Camera(own.width, own.height, own.fx, own.fy, own.cx, own.cy)
    points = (z[..., None] * pinhole.rays).astype(np.float32)
    return PointMap(points, pinhole, np.eye(4) if T is None else T, "imported depth")


def rectified(depth: Float32, camera: Camera) -> Float32:
    """Resample depth (H, W) of a camera with a lens on the grid of its pinhole; between pixels of one surface it is interpolated."""
    if not camera.distortion:
        return depth
    H, W = camera.shape
    v, u = np.mgrid[0:H, 0:W]
    xy = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    seen = distorted(xy, camera.distortion)
    x, y = seen[..., 0] * camera.fx + camera.cx, seen[..., 1] * camera.fy + camera.cy
    there = (x > -0.5) & (x < W - 0.5) & (y > -0.5) & (y < H - 0.5)
    c, r = np.clip(np.rint(x), 0, W - 1).astype(int), np.clip(np.rint(y), 0, H - 1).astype(int)
    nearest = np.where(there, depth[r, c], np.float32(np.nan))
    c, r = np.clip(np.floor(x), 0, W - 2).astype(int), np.clip(np.floor(y), 0, H - 2).astype(int)
    a, b = np.clip(x - c, 0, 1), np.clip(y - r, 0, 1)
    four = np.stack([depth[r, c], depth[r, c + 1], depth[r + 1, c], depth[r + 1, c + 1]])
    shares = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    with np.errstate(invalid="ignore", divide="ignore"):
        between = 1 / (shares / four).sum(axis=0)  # inverse depth is linear on a plane
        one = np.ptp(four, axis=0) < _ONE_SURFACE * nearest
    return np.where(one, between, nearest).astype(np.float32)


def _of_points(
    values: NDArray[Any],
    unit: str,
    missing: tuple[float, ...],
    camera: Camera | None,
    T: Float64 | None,
    where: str,
) -> PointMap:
    """Take an organised point map (H, W, 3)."""
    if values.ndim != 3 or values.shape[-1] != 3:
        raise DataError(
            f"{where}: expected an organised point map (H, W, 3), got shape {values.shape}",
            hint='a cloud without rows and columns is kind = "mesh"; a depth image is kind = "depth"',
        )
    given = np.asarray(values, dtype=np.float64)
    empty = ~np.isfinite(given).all(axis=-1) | (given == 0).all(axis=-1)
    depth = metres(np.where(empty, 0.0, given[..., 2]), unit, missing, where)
    scale = np.nanmedian(depth / np.where(empty, np.nan, given[..., 2]))
    points = np.asarray(given * scale, dtype=np.float32)
    points[~np.isfinite(depth)] = np.nan
    fitted = camera or pinhole_of(points, where)
    if T is None:
        raise ConfigError(
            f"{where}: where its camera stands is not known: missing [truth] T_tof_truth",
            hint=f"the (4, 4) that maps its frame to the ToF frame, metres; of one and the same camera it has ones on the diagonal; {_ELSE}",
        )
    return PointMap(points, fitted, T, "imported points")


def _of_surface(values: NDArray[Any], view: Planned, said: Said, pinhole: Camera, where: str) -> PointMap:
    """See points (N, 3), or triangles (M, 3, 3), with the ToF camera: the nearest in each pixel; meshes at twice its resolution."""
    T, T_world = said.transform("T_tof_truth"), said.transform("T_world_truth")
    T = view.T_tof_truth if T is None else T
    if T is None and view.T_world_tof is not None:
        T = invert(view.T_world_tof) @ (np.eye(4) if T_world is None else T_world)
    if T is None:
        raise ConfigError(
            f"{where}: where it lies is not known: missing [truth] T_tof_truth",
            hint="the (4, 4) that maps its frame to the ToF frame, metres; or poses of the camera: [poses] file",
        )
    unit = str(said.truth.get("unit", "") or view.truth_facts.unit)
    span = np.linalg.norm(np.ptp(values.reshape(-1, 3), axis=0))
    scale = UNITS[unit or "m"]
    if not NEAREST < span * scale < 10 * FARTHEST:
        fits = [u for u, s in UNITS.items() if NEAREST < span * s < FARTHEST]
        raise DataError(
            f"{where}: expected a surface of {NEAREST:g} m and more, got {span * scale:.4g} m across",
            hint=f'[truth] unit = "{fits[-1]}" in import.toml'
            if fits
            else "[truth] unit in import.toml: m, cm or mm",
        )
    points = transform_points(T, values * scale)
    camera = pinhole.scaled(2) if values.ndim == 3 else pinhole
    depth = _cast(points, camera) if values.ndim == 3 else camera.nearest(points)
    lifted = (depth[..., None] * camera.rays).astype(np.float32)
    return PointMap(lifted, camera, np.eye(4), "imported mesh" if values.ndim == 3 else "imported cloud")


def _cast(triangles: Float64, camera: Camera) -> Float32:
    """Cast the rays of a camera at triangles (M, 3, 3) in its frame: depth (H, W), NaN where none is hit."""
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    corners = np.ascontiguousarray(triangles.reshape(-1, 3), dtype=np.float32)
    numbers = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor.from_numpy(corners), o3d.core.Tensor.from_numpy(numbers))
    rays = np.concatenate([np.zeros_like(camera.rays), camera.rays], axis=-1).astype(np.float32)
    found: Float32 = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
    return np.where(np.isfinite(found), found, np.float32(np.nan))


def pinhole_of(points: NDArray[np.float32], where: str) -> Camera:
    """Fit the pinhole that an organised point map (H, W, 3) is seen by; :class:`DataError` when none fits within half a pixel."""
    H, W = points.shape[:2]
    v, u = np.mgrid[0:H, 0:W]
    there = np.isfinite(points).all(axis=-1)
    if there.sum() < 50:
        raise DataError(f"{where}: expected points, got {int(there.sum())}", hint="is another array meant?")
    p = points[there].astype(np.float64)
    fits, off = [], 0.0
    for pixel, along in ((u[there], p[:, 0]), (v[there], p[:, 1])):
        A = np.stack([along / p[:, 2], np.ones(len(p))], axis=1)
        found = np.linalg.lstsq(A, pixel.astype(np.float64), rcond=None)[0]
        off = max(off, float(np.median(np.abs(A @ found - pixel))))
        fits += found.tolist()
    fx, cx, fy, cy = fits
    if off > _GRID or fx <= 0 or fy <= 0:
        mirrored = [n for n, f in (("x", fx), ("y", fy)) if f < 0]
        raise DataError(
            f"{where}: expected points of a pinhole camera, got ones that miss the best by {off:.1f} px (fx {fx:.0f}, fy {fy:.0f})",
            hint=f"{' and '.join(mirrored)} runs the other way: x is right, y down, z forward here; change its sign"
            if mirrored and off < _GRID
            else "is x right, y down, z forward? else: is the map rectified? [truth.camera] names its intrinsics",
        )
    return Camera(W, H, fx, fy, cx, cy)
