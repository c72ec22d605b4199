"""Read a maker's calibration file of a ToF camera's lens: Azure Kinect's JSON, and files that name their numbers.

Named numbers are found wherever they stand in JSON or YAML: ``fx, fy, cx, cy`` or a 3 x 3 matrix, ``k1 .. k6, p1, p2`` or a list, width and
height. So are ROS camera_info, OpenCV's files, depthai's, Orbbec's, royale's and ADI's intrinsics printed as JSON. What a file does not say,
or says in a model that :class:`tofcapture.camera.Camera` lacks, is refused by name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.camera import LENS_NAMES, Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.poses import Float64

# Azure Kinect's depth modes: size of the image -> size of the binned sensor, and where the image starts on it.
_KINECT_MODES = {
    (640, 576): (1024, (192, 180)), (320, 288): (512, (96, 90)), (1024, 1024): (1024, (0, 0)), (512, 512): (512, (0, 0)),
}  # fmt: skip
_KINECT = ("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6", "codx", "cody", "p2", "p1")
_MATRIX = ("camera_matrix", "cameramatrix", "intrinsicmatrix", "k", "m")
_LENS = (
    "distortion_coefficients",
    "distortioncoeff",
    "distortion_coeffs",
    "distcoeffs",
    "dist_coeffs",
    "distortion",
    "d",
)
_MODELS = (
    "plumb_bob",
    "rational_polynomial",
    "radtan",
    "brown",
    "perspective",
    "opencv",
    "pinhole",
    "rational",
)
_WIDTH, _HEIGHT = ("width", "image_width", "w"), ("height", "image_height", "h")


def factory_camera(path: Path, size: tuple[int, int], name: str | None = None) -> Camera:
    """Read the camera of images of ``size`` (width, height); ``name`` chooses where a file holds several.

    Raises :class:`DataError` for no such file or camera, :class:`FormatError` for another content, :class:`ConfigError` for a lens model or
    an image size that does not fit.
    """
    content = _content(path)
    try:
        if isinstance(content, Mapping) and "CalibrationInformation" in content:
            return _kinect(content, path, size)
        return _named(content, path, size, name)
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise FormatError(f"{path}: expected a camera's numbers, got {type(err).__name__}: {err}") from err


def _named(content: Any, path: Path, size: tuple[int, int], name: str | None) -> Camera:
    """Read the one camera whose numbers have names and whose images have the size."""
    found = {where: c for where, c in _cameras(content, "") if name is None or name in where}
    fitting = {where: c for where, c in found.items() if _steps(c, size)}
    if len(fitting) != 1:
        told = (
            ", ".join(f"{where or 'file'} {_of(c, _WIDTH)}x{_of(c, _HEIGHT)}" for where, c in found.items())
            or "none"
        )
        raise DataError(
            f"{path}: expected one camera of {size[0]}x{size[1]} pixels or a whole multiple, got {told}",
            hint="name its part of the file with --camera; it says fx, fy, cx, cy, width and height, or a 3 x 3 matrix",
        )
    return _camera(next(iter(fitting.values())), size, str(path))


def _content(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as err:
        raise DataError(f"{path}: no such file") from err
    except (OSError, UnicodeDecodeError) as err:
        raise FormatError(
            f"{path}: expected JSON or YAML text, got {err}",
            hint="print a binary block's intrinsics with the maker's program as JSON",
        ) from err
    try:
        return json.loads(text)
    except ValueError:
        import yaml

        try:  # OpenCV's own YAML has a directive and tags that YAML 1.1 does not know
            return yaml.safe_load(re.sub(r"!!opencv-\S+", "", re.sub(r"\A%YAML.*\n(---)?", "", text)))
        except yaml.YAMLError as err:
            raise FormatError(f"{path}: expected JSON or YAML, got {str(err)[:200]}") from err


def _kinect(content: Mapping[str, Any], path: Path, size: tuple[int, int]) -> Camera:
    """Azure Kinect's depth camera: lengths are shares of the sensor, the first pixel's corner is zero."""
    cameras = content["CalibrationInformation"]["Cameras"]
    lens = next(
        (c["Intrinsics"] for c in cameras if c.get("Location") == "CALIBRATION_CameraLocationD0"), None
    )
    if lens is None or len(lens["ModelParameters"]) < len(_KINECT):
        raise DataError(
            f"{path}: expected the depth camera CALIBRATION_CameraLocationD0 with {len(_KINECT)} parameters"
        )
    if size not in _KINECT_MODES:
        raise ConfigError(
            f"{path}: expected images of {', '.join(f'{w}x{h}' for w, h in _KINECT_MODES)}, got {size[0]}x{size[1]}"
        )
    told = dict(zip(_KINECT, map(float, lens["ModelParameters"]), strict=False))
    # Only Rational6KT has another centre, and half the tangential terms.
    if told["codx"] or told["cody"] or "BrownConrady" not in lens["ModelType"]:
        raise ConfigError(f"{path}: expected the model BrownConrady, got {lens['ModelType']}")
    (pixels, (left, top)) = _KINECT_MODES[size]
    cx, cy = told["cx"] * pixels - left - 0.5, told["cy"] * pixels - top - 0.5
    return Camera(*size, told["fx"] * pixels, told["fy"] * pixels, cx, cy, tuple(told[k] for k in LENS_NAMES))


def _cameras(content: Any, where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Find every dictionary that has a camera's numbers; its keys in lower case."""
    if isinstance(content, Mapping):
        own = {str(k).lower(): v for k, v in content.items()}
        if {"fx", "fy", "cx", "cy"} <= own.keys() or any(_matrix(own.get(k)) is not None for k in _MATRIX):
            yield where, own
            return
        # A lens beside the intrinsics of the same camera belongs to it.
        for key, value in content.items():
            for at, camera in _cameras(value, f"{where}/{key}"):
                yield (
                    at,
                    {
                        **{k: v for k, v in own.items() if not isinstance(v, Mapping)},
                        **_beside(own),
                        **camera,
                    },
                )
    elif isinstance(content, list):
        for i, value in enumerate(content):
            yield from _cameras(value, f"{where}/{i}")


def _beside(own: Mapping[str, Any]) -> dict[str, Any]:
    parts = [v for k, v in own.items() if "dist" in k and isinstance(v, Mapping)]
    return {str(k).lower(): v for part in parts for k, v in part.items() if str(k).lower() in LENS_NAMES}


def _matrix(value: Any) -> Float64 | None:
    value = value.get("data") if isinstance(value, Mapping) else value
    if not isinstance(value, list):
        return None
    found = np.asarray(value, dtype=object).ravel()
    return found.astype(np.float64).reshape(3, 3) if len(found) == 9 else None


def _of(camera: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((camera[k] for k in names if k in camera), None)


def _steps(camera: Mapping[str, Any], size: tuple[int, int]) -> int:
    """Tell how many of the file's pixels make one of the image's along a side; 0 when it is another image."""
    wide, high = int(_of(camera, _WIDTH) or 0), int(_of(camera, _HEIGHT) or 0)
    step = wide // size[0]
    return step if step and (wide, high) == (step * size[0], step * size[1]) else 0


def _camera(told: Mapping[str, Any], size: tuple[int, int], where: str) -> Camera:
    model = str(_of(told, ("distortion_model", "model", "cameratype", "lenstype")) or "plumb_bob").lower()
    if not any(known in model for known in _MODELS) or "fish" in model:
        raise ConfigError(f"{where}: expected a lens model of {', '.join(_MODELS)}, got {model}")
    matrix = next((m for k in _MATRIX if (m := _matrix(told.get(k))) is not None), None)
    keys = ("fx", "fy", "cx", "cy")
    fx, fy, cx, cy = (
        (float(told[k]) for k in keys) if matrix is None else matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    )
    if any(off := [float(told.get(k) or 0) for k in ("codx", "cody")]):
        raise ConfigError(f"{where}: expected codx and cody of 0, the distortion's centre, got {off}")
    lens = _of(told, _LENS)
    lens = lens.get("data") if isinstance(lens, Mapping) else lens
    lens = lens if isinstance(lens, list) else [float(told.get(k, 0.0)) for k in LENS_NAMES]
    step = _steps(told, size)
    return Camera(*size, fx / step, fy / step, (cx + 0.5) / step - 0.5, (cy + 0.5) / step - 0.5, tuple(lens))
