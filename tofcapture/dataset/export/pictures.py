"""Write pictures: 16-bit PNG with our own JSON, BOP folders, nerfstudio's ``transforms.json``."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.colours import png_bytes
from tofcapture.dataset.export.scene import SceneExport, grey
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import replacing, write_text
from tofcapture.poses import invert

LARGEST = 65535  # steps of PNG depth
TURNED = np.diag([1.0, -1.0, -1.0, 1.0])  # a camera of OpenGL looks along -z, its y is up


def export_png(scene: SceneExport) -> list[Path]:
    """Write ``tof-003.png``, ``depth-003.png`` and ``mask-003.png`` for every view, and ``cameras.json``.

    Depth is z in steps of ``unit`` metres, at most half a step off but for what is nearer than one step, 0 is none. The unit also stands in each picture's text
    chunk ``unit_m``. ``mask`` holds the mask bits, 8 bits a pixel. ``cameras.json`` has the unit, the intrinsics at 1x and 2x
    (pixel centres at whole numbers) and each view's pose.
    """
    shard, unit, paths = scene.shard, scene.unit, []
    for view in range(shard.views):
        gt = shard.ground_truth(view, 2)
        where = f"{shard.path}: view {view}"
        images: dict[str, NDArray[Any]] = {
            "tof": _quantised(shard.tof(view).depth, unit, where),
            "depth": _quantised(gt.depth, unit, where),
            "mask": gt.mask,
        }
        for name, image in images.items():
            text = {} if name == "mask" else {"unit_m": repr(unit)}
            paths.append(_written(scene.folder / f"{name}-{view:03d}.png", png_bytes(image, text)))
    cameras = {
        "scene": scene.name,
        "unit_m": unit,
        "none": 0,
        "tof": asdict(shard.camera),
        "depth": asdict(shard.camera.scaled(2)),
        "views": [
            {"index": shard.index(v), "T_base_tof": shard.T_base_tof(v).tolist()} for v in range(shard.views)
        ],
    }
    return [*paths, _written_json(scene.folder / "cameras.json", cameras)]


def _written(path: Path, data: bytes) -> Path:
    with replacing(path) as partial:
        partial.write_bytes(data)
    return path


def _written_json(path: Path, table: Any) -> Path:
    write_text(path, json.dumps(table, indent=1) + "\n")
    return path


def _quantised(depth: NDArray[np.floating], unit: float, where: str) -> NDArray[np.uint16]:
    """Depth (H, W), metres, as whole steps of ``unit``, at least one; 0 is none."""
    known = np.isfinite(depth)
    steps = np.rint(np.where(known, depth, 0.0).astype(np.float64) / unit)
    near = known & (steps < 1)  # single wrong wraps of a camera lie right before it; a whole image does not
    steps[near] = 1
    if steps.max(initial=0) > LARGEST or near.sum() > 0.01 * known.sum() or (depth[near] <= 0).any():
        raise DataError(
            f"{where}: expected depth above 0 and up to {LARGEST * unit:g} m in steps of {unit:g} m, "
            f"got {np.nanmin(depth):g} to {np.nanmax(depth):g} m",
            hint="--unit 0.001",
        )
    return steps.astype(np.uint16)


def export_bop(scene: SceneExport) -> list[Path]:
    """Write a scene of a BOP dataset: ``<split>/000003`` with ``gray``, ``depth``, ``depth_gt`` and three JSON files.

    The image number is the view's row in the shard. ``depth`` is the sensor's burst, ``depth_gt`` the ground truth at 1x;
    ``depth_scale`` turns their steps into millimetres. The world is the arm's base, in millimetres. BOP has no lens: images
    are rectified by the nearest pixel. Objects have no poses here, so ``scene_gt.json`` has empty lists.
    """
    shard, folder = scene.shard, scene.out / scene.split / f"{scene.place:06d}"
    camera, rectified = _rectified(shard.camera)
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    paths, cameras = [], {}
    for view in range(shard.views):
        tof, where = shard.tof(view), f"{shard.path}: view {view}"
        images = {
            "gray": grey(tof.confidence),
            "depth": _quantised(tof.depth, scene.unit, where),
            "depth_gt": _quantised(shard.ground_truth(view, 1).depth, scene.unit, where),
        }
        for name, image in images.items():
            paths.append(_written(folder / name / f"{view:06d}.png", png_bytes(rectified(image))))
        T_tof_base = invert(shard.T_base_tof(view))
        cameras[str(view)] = {
            "cam_K": K,
            "depth_scale": scene.unit * 1000,
            "cam_R_w2c": T_tof_base[:3, :3].ravel().tolist(),
            "cam_t_w2c": (T_tof_base[:3, 3] * 1000).tolist(),
        }
    empty: dict[str, list[Any]] = {view: [] for view in cameras}
    tables = {"scene_camera": cameras, "scene_gt": empty, "scene_gt_info": empty}
    return paths + [_written_json(folder / f"{name}.json", table) for name, table in tables.items()]


def finish_bop(out: Path, scenes: Sequence[SceneExport]) -> list[Path]:
    """Write ``camera.json``, for simulating the sensor, and ``dataset_info.md``, which names the scenes."""
    camera, _ = _rectified(scenes[0].shard.camera)
    table = {**asdict(camera), "depth_scale": scenes[0].unit * 1000}
    del table["distortion"]
    rows = "\n".join(f"- {s.split}/{s.place:06d}: {s.name}" for s in scenes)
    text = (
        f"Depth of a time-of-flight camera, its ground truth in depth_gt. World: base of the arm.\n\n{rows}\n"
    )
    write_text(out / "dataset_info.md", text)
    return [_written_json(out / "camera.json", table), out / "dataset_info.md"]


def _rectified(camera: Camera) -> tuple[Camera, Any]:
    """Return the camera without its lens, and what takes images of the one to images of the other, by the nearest pixel."""
    straight = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    if not camera.distortion:
        return straight, lambda image: image
    pixels, _ = camera.project(straight.rays)
    u, v = np.moveaxis(np.rint(np.nan_to_num(pixels, nan=-1.0)).astype(np.int64), -1, 0)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    return straight, lambda image: np.where(inside, image[v, u], np.zeros_like(image[:1, :1]))


def export_nerfstudio(scene: SceneExport) -> list[Path]:
    """Write ``<scene>/transforms.json`` with ``images`` and ``depths``, as nerfstudio's parser reads them.

    Images are amplitudes, 8 bits. Depths are the ground truth at 1x, float32 in millimetres, which is the parser's default
    unit; 0 is none. Poses are camera to base, y up and z backwards; pixel centres lie at halves.

    Raises
    ------
    ConfigError
        A rational lens, which nerfstudio does not have.
    """
    shard, camera = scene.shard, scene.shard.camera
    k1, k2, p1, p2, k3, *rational = camera.distortion or (0.0,) * 5
    if rational:
        raise ConfigError(
            f"{shard.path}: nerfstudio has no rational lens, this one has k4 {rational[0]:g}",
            hint="--format bop writes rectified images",
        )
    paths, frames = [], []
    for view in range(shard.views):
        image, depth = f"images/frame_{view:05d}.png", f"depths/frame_{view:05d}.npy"
        held = io.BytesIO()
        np.save(held, np.nan_to_num(shard.ground_truth(view, 1).depth * np.float32(1000)), allow_pickle=False)
        paths.append(_written(scene.folder / image, png_bytes(grey(shard.tof(view).confidence))))
        paths.append(_written(scene.folder / depth, held.getvalue()))
        T_base_gl = shard.T_base_tof(view) @ TURNED
        frames.append({"file_path": image, "depth_file_path": depth, "transform_matrix": T_base_gl.tolist()})
    table = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "k1": k1,
        "k2": k2,
        "p1": p1,
        "p2": p2,
        "k3": k3,
        "frames": frames,
    }
    return [*paths, _written_json(scene.folder / "transforms.json", table)]
