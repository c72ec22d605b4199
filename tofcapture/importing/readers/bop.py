"""Read scenes of BOP datasets that have raw frames beside their pictures: ``SCENE/raw/000000.npy`` and alike, by image number.

Ground truth is what the objects' models show in their poses, where a scene has them, else ``depth_gt`` or ``depth``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.importing.cameras import camera_of_table
from tofcapture.importing.cameras.trees import read_tree
from tofcapture.importing.readers import arrays, images
from tofcapture.importing.readers.clouds import read_surface
from tofcapture.importing.said import Facts, Said
from tofcapture.importing.source import Piece, natural
from tofcapture.poses import Float64, invert, transform, transform_points
from tofcapture.rig import camera_from

CAMERAS, POSES = "scene_camera.json", "scene_gt.json"
_ROUGH = 1e-3  # by which a printed rotation may be off


def claims(path: Path) -> bool:
    """Tell by ``scene_camera.json``, in it or two folders below."""
    return path.is_dir() and ((path / CAMERAS).is_file() or any(path.glob(f"*/*/{CAMERAS}")))


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List raw frames with their cameras and poses, and ground truth in the camera's frame, in millimetres."""
    if not (path / CAMERAS).is_file():
        scenes = [str(p.parent) for p in sorted(path.glob(f"*/*/{CAMERAS}"))]
        raise DataError(
            f"{path}: expected a scene of a BOP dataset, got all of it: {len(scenes)} scenes",
            hint=f"tofcapture import {' '.join(scenes[:2])} --out RECORDING takes scenes, each by its folder",
        )
    told, objects = _table(path / CAMERAS), _table(path / POSES) if (path / POSES).is_file() else {}
    files = sorted(path.glob("raw/*"), key=lambda p: natural(p.name))
    if not files:
        raise DataError(
            f"{path}: expected raw frames beside the pictures, found none in raw/",
            hint="write them by image number: raw/000000.npy of (K, H, W) or (frames, K, H, W) counts",
        )
    for file in files:
        number = _number(file, told)
        reader = next((r for r in (arrays, images) if r.claims(file)), None)
        if reader is None:
            raise FormatError(f"{file}: expected arrays or 16-bit images", hint="np.save(...)")
        facts = Facts(camera=_camera(path, told[number]))
        for piece in reader.pieces(file, said):
            name = f"raw/{file.name}:{piece.name}" if piece.name else f"raw/{file.name}"
            T = _pose(told[number], "w2c", f"{path / CAMERAS}: {number}")
            yield Piece(
                name, file, piece.load, "raw", None, piece.facts.over(facts), None if T is None else invert(T)
            )
    numbers = dict.fromkeys(_number(f, told) for f in files)
    for number in numbers:
        target = _truth(path, number, told[number], objects.get(number, []))
        if target is None:
            continue
        file, load = target
        facts = Facts(unit="mm", camera=_camera(path, told[number]))
        yield Piece(f"truth/{number:06d}", file, load, "truth", None, facts, np.eye(4))


def _table(path: Path) -> dict[int, Any]:
    found = read_tree(path)
    if not isinstance(found, Mapping) or not all(str(k).isdigit() for k in found):
        raise FormatError(f"{path}: expected image numbers as names, got {str(found)[:60]}")
    return {int(k): v for k, v in found.items()}


def _number(file: Path, told: Mapping[int, Any]) -> int:
    number = int(next(iter(re.findall(r"\d+", file.stem)), -1))
    if number not in told:
        raise DataError(
            f"{file}: expected the number of an image of {CAMERAS}, {min(told, default=0)} to {max(told, default=0)}, got {number}",
            hint="name raw files by BOP's image numbers: raw/000003.npy",
        )
    return number


def _camera(scene: Path, told: Mapping[str, Any]) -> Camera:
    """Read K; the size is that of a picture of the scene."""
    picture = next(
        (p for kind in ("depth", "gray", "rgb", "depth_gt") for p in sorted(scene.glob(f"{kind}/*"))), None
    )
    if picture is None or "cam_K" not in told:
        got = "no picture" if picture is None else ", ".join(told)
        raise ConfigError(
            f"{scene}: expected cam_K and a picture that says its size, got {got}", hint="--camera FILE"
        )
    H, W = _image(picture).shape[:2]
    keys = camera_of_table({"cam_k": told["cam_K"], "width": W, "height": H}, str(scene / CAMERAS))
    return camera_from(keys or {}, str(scene / CAMERAS))


@lru_cache(maxsize=4)
def _image(path: Path) -> NDArray[Any]:
    import cv2

    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None:
        raise FormatError(f"{path}: expected an image", hint="copy it again")
    return np.asarray(found)


def _pose(told: Mapping[str, Any], what: str, where: str) -> Float64 | None:
    """(4, 4) in metres of ``cam_R_...`` and ``cam_t_...``, which are millimetres; ``None`` when it is not told."""
    if f"cam_R_{what}" not in told:
        return None
    R, t = np.reshape(told[f"cam_R_{what}"], (3, 3)), np.asarray(told[f"cam_t_{what}"], dtype=np.float64)
    U, _, V = np.linalg.svd(R)
    if np.abs(U @ V - R).max() > _ROUGH or np.linalg.det(R) < 0:
        raise DataError(f"{where}: expected a rotation in cam_R_{what}, got {R.round(3).tolist()}")
    return transform(U @ V, t.ravel() / 1000)


def _truth(scene: Path, number: int, told: Mapping[str, Any], objects: list[Any]) -> tuple[Path, Any] | None:
    """File and reader of an image's ground truth: triangles (M, 3, 3) or depth (H, W), millimetres, camera's frame."""
    models = next((p for p in sorted(scene.parent.parent.glob("models*")) if any(p.glob("obj_*.ply"))), None)
    if models and objects:
        return scene / POSES, partial(_triangles, models, f"{scene / POSES}: {number}", objects)
    for kind in ("depth_gt", "depth"):
        file = next(iter(sorted(scene.glob(f"{kind}/{number:06d}.*"))), None)
        if file is not None:
            return file, partial(_scaled, file, float(told.get("depth_scale", 1.0)))
    return None


def _scaled(path: Path, scale: float) -> NDArray[Any]:
    return _image(path).astype(np.float32) * np.float32(scale)


def _triangles(models: Path, where: str, objects: list[Any]) -> NDArray[Any]:
    found = []
    for one in objects:
        mesh = models / f"obj_{int(one['obj_id']):06d}.ply"
        T = _pose(one, "m2c", where)
        if not mesh.is_file() or T is None:
            raise DataError(f"{where}: expected a model and a pose of object {one['obj_id']}, got no {mesh}")
        corners = read_surface(mesh)
        if corners.ndim != 3:
            raise DataError(
                f"{mesh}: expected triangles, got points", hint="models_eval or models_cad hold meshes"
            )
        found.append(transform_points(T, corners / 1000) * 1000)
    return np.concatenate(found)
