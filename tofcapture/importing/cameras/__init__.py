"""Read cameras from one line, or from the files of other tools, in our conventions.

Read are Kalibr's camchain, ROS's CameraInfo (YAML or echoed), OpenCV's FileStorage (YAML, XML, JSON) and NPZ, COLMAP's
``cameras.txt`` and ``cameras.bin``, Open3D's, RealSense's and nerfstudio's JSON, a matrix of NumPy's, BOP's ``camera.json`` and ``scene_camera.json``, our TOML.
``FILE#NAME`` names one camera of several. Lenses of other models are refused, or, where it is exact, written as OpenCV's.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import LENS_NAMES
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.importing.cameras.trees import read_tree
from tofcapture.importing.readers.arrays import arrays_of
from tofcapture.poses import Float64, check_transform, invert

ORDER = ("fx", "fy", "cx", "cy")
SIZE = (("width", "height"), ("image_width", "image_height"), ("w", "h"), ("cols", "rows"))
SIZES = ("image_size", "imagesize", "img_size", "resolution", "size", "imagesize_wh", "img_shape")
MATRIX = [
    "camera_matrix", "cameramatrix", "camera", "k", "m", "mtx", "intrinsics", "intrinsic",
    "intrinsic_matrix", "cam_k", "a", "cm",
]  # fmt: skip
LENS = [
    "distortion_coefficients", "distcoeffs", "dist_coeffs", "distortion", "d", "dist",
    "distortion_coeffs", "distcoef", "coeffs",
]  # fmt: skip
_SAME = [
    "plumb_bob", "radtan", "rational_polynomial", "opencv", "full_opencv", "pinhole", "simple_pinhole",
    "simple_radial", "radial", "perspective", "brown", "none", "brown_conrady", "distortion.brown_conrady",
]  # fmt: skip
_FISHEYE = ["equidistant", "equi", "fisheye", "kannala_brandt", "opencv_fisheye"]
# COLMAP's models by number: name, and what its parameters are.
_COLMAP = {
    0: ("SIMPLE_PINHOLE", "f cx cy"), 1: ("PINHOLE", "fx fy cx cy"), 2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"), 4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"), 6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    7: ("FOV", ""), 8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"), 9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    10: ("THIN_PRISM_FISHEYE", ""),
}  # fmt: skip
_REALSENSE = {"ppx": "cx", "ppy": "cy"}
_STEPS = 400  # of the radius, where a fisheye is fitted
_FITTED = 0.02  # px, at most, that the fit may be off


@dataclass(frozen=True)
class Found:
    """Hold one camera of a file.

    Attributes
    ----------
    keys
        As in a rig's ``[tof]``: width, height, fx, fy, cx, cy, distortion. A file that does not say the size has none.
    T
        (4, 4) from its frame to that of the file's first camera, metres; ``None``: not told.
    """

    keys: dict[str, Any]
    T: Float64 | None = None


def camera_keys(text: str) -> dict[str, Any]:
    """Read ``fx,fy,cx,cy[,k1,k2,p1,p2,k3...]``, a file, or ``FILE#NAME`` as the keys of a rig's ``[tof]``.

    A line has no image size. :class:`ConfigError` for anything else.
    """
    file, _, name = text.rpartition("#") if "#" in text and not Path(text).exists() else (text, "", "")
    if Path(file).exists():
        return keys_of_file(Path(file), name)
    try:
        numbers = [float(n) for n in re.split(r"[,;\s]+", text.strip())]
    except ValueError as err:
        raise ConfigError(
            f"--camera: expected fx,fy,cx,cy[,k1,k2,p1,p2,k3] or a file, got {text!r}"
            + (", which is not there" if re.search("[A-Za-z]{2}", text) else ""),
            hint="--camera 190.6,200.8,116.8,101.5",
        ) from err
    if len(numbers) < 4:
        raise ConfigError(
            f"--camera: expected at least fx,fy,cx,cy, got {len(numbers)} numbers",
            hint="190.6,200.8,116.8,101.5, in pixels",
        )
    lens = {"distortion": [*numbers[4:], *(0.0,) * (8 - len(numbers))]} if numbers[4:] else {}
    return {**dict(zip(ORDER, numbers, strict=False)), **lens}


def keys_of_file(path: Path, name: str = "") -> dict[str, Any]:
    """Read one camera of a file as the keys of a rig's ``[tof]``.

    :class:`ConfigError` when there are several that differ and ``name`` is none of them, or a lens that is not OpenCV's.
    """
    found = cameras_of(path)
    if name in found:
        return found[name].keys
    if not found:
        raise ConfigError(
            f"{path}: no camera in it", hint="rig.toml, Kalibr, ROS, OpenCV, COLMAP or nerfstudio"
        )
    first = next(iter(found.values())).keys
    if name or any(one.keys != first for one in found.values()):
        raise ConfigError(
            f"{path}: expected {name or 'one camera'}, got {', '.join(found)}",
            hint=f"name one: {path}#{next(iter(found))}",
        )
    return first


def cameras_of(path: Path) -> dict[str, Found]:
    """Read all cameras of a file, or of a COLMAP folder, by their names.

    Raises :class:`FormatError` for a file without cameras, :class:`ConfigError` for lenses that are not OpenCV's.
    """
    if path.is_dir():
        places = [
            path / sub / f"cameras.{end}" for sub in ("", "sparse/0", "sparse") for end in ("txt", "bin")
        ]
        inside = next((p for p in places if p.is_file()), None)
        if inside is None:
            raise FormatError(f"{path}: expected a COLMAP model with cameras.txt or cameras.bin, found none")
        return cameras_of(inside)
    if path.suffix.lower() == ".bin":
        return dict(_colmap_bin(path))
    if path.suffix.lower() == ".npz":
        with np.load(path, allow_pickle=False) as held:
            tree: Any = {name: held[name] for name in held.files}
    elif path.suffix.lower() == ".mat":
        tree = arrays_of(path)
    elif (matrix := _matrix_of(path)) is not None:
        tree = {"k": matrix}
    elif path.suffix.lower() == ".txt":
        return dict(_colmap_txt(path))
    else:
        tree = read_tree(path)
    tree = tree[0] if isinstance(tree, list) and tree else tree  # of a topic's echo, the first message
    found = dict(_cameras(tree, path)) if isinstance(tree, Mapping) else {}
    if not found:
        names = ", ".join(map(str, tree)) if isinstance(tree, Mapping) else type(tree).__name__
        raise FormatError(
            f"{path}: expected a camera: Kalibr, ROS CameraInfo, OpenCV, COLMAP, or width, height, fx, fy, cx, cy; got {names[:120]}",
            hint="--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3] takes the numbers",
        )
    return found


def _matrix_of(path: Path) -> NDArray[np.float64] | None:
    """Read the camera matrix (3, 3) alone, as NumPy saves it: .npy, or lines of three numbers; ``None`` for anything else."""
    if path.suffix.lower() not in {".npy", ".txt", ".csv"} or not path.stat().st_size:
        return None
    try:
        if path.suffix.lower() == ".npy":
            found = np.load(path, allow_pickle=False)
        else:
            found = np.loadtxt(path, delimiter="," if path.suffix.lower() == ".csv" else None)
    except (ValueError, OSError, UnicodeDecodeError):
        return None
    return np.asarray(found, np.float64) if found.shape == (3, 3) else None


def _cameras(tree: Mapping[Any, Any], path: Path) -> Iterator[tuple[str, Found]]:
    """List the cameras of a file's dictionary: itself, those numbered in its names, or those below its names."""
    low = {str(k).lower().removeprefix("camera."): v for k, v in tree.items()}  # ORB-SLAM's names
    low = {_REALSENSE.get(k, k): v for k, v in low.items()}
    chain = np.eye(4)
    if (own := camera_of_table(low, f"{path}")) is not None:
        yield "camera", Found(own)
    for end in ("1", "2", "_left", "_right", "l", "r"):
        part = {k.removesuffix(end): v for k, v in low.items() if k.endswith(end)}
        shared = {k: v for k, v in low.items() if k in SIZES or any(k in pair for pair in SIZE)}
        if (
            own is None
            and any(k in part for k in MATRIX)
            and (keys := camera_of_table({**shared, **part}, f"{path}: {end}"))
        ):
            turned = end in ("2", "_right", "r") and "r" in low and "t" in low
            T = (
                np.vstack([np.c_[_array(low["r"]).reshape(3, 3), _array(low["t"]).reshape(3)], [0, 0, 0, 1]])
                if turned
                else None
            )
            yield (
                end.strip("_"),
                Found(keys, None if T is None else invert(T)),
            )  # OpenCV's R, T map camera 1 to 2
    for name, below in tree.items():
        if isinstance(below, Mapping) and (
            keys := camera_of_table({str(k).lower(): v for k, v in below.items()}, f"{path}: {name}")
        ):
            if "T_cn_cnm1" in below:
                chain = chain @ invert(
                    check_transform(_array(below["T_cn_cnm1"]).reshape(4, 4), f"{path}: {name}: T_cn_cnm1")
                )
            yield str(name), Found(keys, chain if "T_cn_cnm1" in below or "camera_model" in below else None)


def camera_of_table(low: Mapping[str, Any], where: str) -> dict[str, Any] | None:
    """Read one camera of a dictionary with names in small letters; ``None`` when it is none."""
    size = _size(low)
    model = str(low.get("distortion_model", low.get("model", low.get("camera_model", "")))).lower()
    if "fl_x" in low:  # nerfstudio and instant-ngp: centres at halves
        fx, cx, cy = (float(low[k]) for k in ("fl_x", "cx", "cy"))
        K: tuple[float, ...] = (fx, float(low.get("fl_y", fx)), cx - 0.5, cy - 0.5)
        lens: Sequence[float] = [float(low.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2", "k3")]
        if model == "opencv_fisheye":
            lens = [float(low.get(k, 0.0)) for k in ("k1", "k2", "k3", "k4")]
        elif float(low.get("k4", 0.0)):
            raise ConfigError(
                f"{where}: expected a lens of OpenCV's model, got a fourth radial term",
                hint="fit it with k1, k2, k3",
            )
    elif set(ORDER) <= low.keys():
        K = tuple(float(low[k]) for k in ORDER)
        held: Any = next((low[k] for k in LENS if k in low), low)
        lens = [float(held.get(k, 0.0)) for k in LENS_NAMES] if _is_named(held) else _numbers(held)
    else:
        matrix = next((low[k] for k in MATRIX if k in low and _is_matrix(low[k])), None)
        if matrix is None:
            return None
        K = _intrinsics(matrix, where, turned="intrinsic_matrix" in low)
        lens = _numbers(next((low[k] for k in LENS if k in low), ()))
    if low.get("camera_model") in {"omni", "ds", "eucm", "omni-radtan", "double_sphere"}:
        raise ConfigError(
            f"{where}: expected a pinhole camera, got Kalibr's {low['camera_model']}",
            hint="kalibr_calibrate_cameras --models pinhole-radtan",
        )
    K, size = _binned(K, size, low)
    keys: dict[str, Any] = {
        **(dict(zip(("width", "height"), size, strict=True)) if size else {}),
        **dict(zip(ORDER, K, strict=True)),
    }
    return _with_lens(keys, model, lens, where)


def _with_lens(keys: dict[str, Any], model: str, lens: Sequence[float], where: str) -> dict[str, Any]:
    """Add a lens of OpenCV's model; refuse others."""
    if model in _FISHEYE:
        lens = _fisheye(keys, lens, where)
    elif model and model not in _SAME:
        raise ConfigError(
            f"{where}: expected a lens of OpenCV's model, got {model}",
            hint="fit it again with radtan (Kalibr), plumb_bob or rational_polynomial (ROS), OPENCV or FULL_OPENCV (COLMAP)",
        )
    return {**keys, "distortion": [float(k) for k in lens]} if any(lens) else keys


def _fisheye(keys: Mapping[str, Any], lens: Sequence[float], where: str) -> list[float]:
    """Write an equidistant lens as a rational one: fitted over the image, exact to 0.02 px, or refused."""
    if "width" not in keys:
        raise ConfigError(
            f"{where}: a fisheye without an image size", hint="add width and height to the file"
        )
    x, y = (
        [(e - keys[c]) / keys[f] for e in (-0.5, keys[n] - 0.5)]
        for f, c, n in (("fx", "cx", "width"), ("fy", "cy", "height"))
    )
    reach = max(float(np.hypot(a, b)) for a in x for b in y)
    theta = np.linspace(1e-4, 1.4, 20 * _STEPS)
    seen = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(lens)))
    theta = theta[: int(np.searchsorted(seen, reach)) + 1]
    if seen[len(theta) - 1] < reach or (np.diff(seen[: len(theta)]) <= 0).any():
        raise ConfigError(
            f"{where}: the fisheye sees more than 160 degrees",
            hint="crop the images, or rectify them with OpenCV's fisheye module",
        )
    theta = theta[:: max(len(theta) // _STEPS, 1)]
    r, g = np.tan(theta), np.interp(theta, np.linspace(1e-4, 1.4, 20 * _STEPS), seen) / np.tan(theta)
    s = r**2
    A = np.stack([s, s**2, s**3, -g * s, -g * s**2, -g * s**3], axis=1) * r[:, None]
    scale = np.linalg.norm(A, axis=0)
    k = np.linalg.lstsq(A / scale, (g - 1) * r, rcond=None)[0] / scale
    fit = (1 + s * (k[0] + s * (k[1] + s * k[2]))) / (1 + s * (k[3] + s * (k[4] + s * k[5])))
    off = float(np.abs((fit - g) * r).max()) * max(keys["fx"], keys["fy"])
    if off > _FITTED:
        raise ConfigError(
            f"{where}: the fisheye differs from OpenCV's rational lens by {off:.2f} px",
            hint="fit it again with radtan or rational_polynomial, or rectify the images",
        )
    return [*k[:2].tolist(), 0.0, 0.0, *k[2:].tolist()]


def _binned(
    K: Sequence[float], size: tuple[int, int] | None, low: Mapping[str, Any]
) -> tuple[tuple[float, ...], tuple[int, int] | None]:
    """Apply the binning and region of interest of a ROS CameraInfo: K is of the full image."""
    roi: Mapping[str, Any] = low.get("roi") or {}
    ax, ay = (max(int(low.get(f"binning_{c}", 0)), 1) for c in "xy")
    x0, y0 = (float(roi.get(f"{c}_offset", 0)) for c in "xy")
    w, h = (int(roi.get(n, 0)) for n in ("width", "height"))
    if size and (w or h or ax > 1 or ay > 1):
        size = ((w or size[0]) // ax, (h or size[1]) // ay)
    fx, fy, cx, cy = K
    return (fx / ax, fy / ay, (cx - x0 + 0.5) / ax - 0.5, (cy - y0 + 0.5) / ay - 0.5), size


def _size(low: Mapping[str, Any]) -> tuple[int, int] | None:
    for w, h in SIZE:
        if w in low and h in low and np.ndim(_array(low[w])) <= 1:
            return int(_array(low[w]).reshape(-1)[0]), int(_array(low[h]).reshape(-1)[0])
    held = next((low[k] for k in SIZES if k in low), None)
    numbers = _numbers(held) if held is not None else []
    return (int(numbers[0]), int(numbers[1])) if len(numbers) == 2 else None


def _is_named(value: Any) -> bool:
    return isinstance(value, Mapping) and "data" not in value


def _is_matrix(value: Any) -> bool:
    try:
        return _array(value).size in (4, 9)
    except (TypeError, ValueError):
        return False


def _array(value: Any) -> NDArray[np.float64]:
    return np.asarray(
        value["data"] if isinstance(value, Mapping) and "data" in value else value, dtype=np.float64
    )


def _numbers(value: Any) -> list[float]:
    return [float(x) for x in _array(value).ravel()]


def _intrinsics(matrix: Any, where: str, *, turned: bool) -> tuple[float, ...]:
    """Four numbers of a matrix (3, 3), or as they are; Open3D writes columns first."""
    K = _array(matrix)
    if K.size == 4:
        return tuple(K.ravel().tolist())
    K = K.reshape(3, 3)
    K = K.T if turned and K[2, 0] else K
    if abs(K[0, 1]) > 1e-6 * K[0, 0] or K[1, 0] or K[2, 0] or K[2, 1]:
        raise FormatError(
            f"{where}: expected a camera matrix [fx 0 cx; 0 fy cy; 0 0 1], got {K.round(3).tolist()}",
            hint="a skew cannot be kept; is it transposed?",
        )
    return (K[0, 0] / K[2, 2], K[1, 1] / K[2, 2], K[0, 2] / K[2, 2], K[1, 2] / K[2, 2])


def _colmap(model: tuple[str, str], w: int, h: int, values: Sequence[float], where: str) -> Found:
    """Turn COLMAP's parameters into ours: its pixel centres lie at halves."""
    name, names = model
    if len(values) != len(names.split()) or not names:
        raise ConfigError(
            f"{where}: expected a COLMAP camera with OpenCV's lens, got {name} with {len(values)} numbers",
            hint="colmap image_undistorter, or reconstruct with --ImageReader.camera_model OPENCV",
        )
    told = dict(zip(names.split(), values, strict=True))
    fx, fy = told.get("fx", told.get("f", 0.0)), told.get("fy", told.get("f", 0.0))
    keys = {"width": w, "height": h, "fx": fx, "fy": fy, "cx": told["cx"] - 0.5, "cy": told["cy"] - 0.5}
    if "FISHEYE" in name:
        return Found(_with_lens(keys, "fisheye", [told.get(f"k{i}", 0.0) for i in range(1, 5)], where))
    lens = [told.get(k, 0.0) for k in LENS_NAMES]
    return Found(_with_lens(keys, "", lens, where))


def _colmap_txt(path: Path) -> Iterator[tuple[str, Found]]:
    models = {name: (name, names) for name, names in _COLMAP.values()}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            number, name, w, h, *values = words
            yield (
                number,
                _colmap(models.get(name, (name, "")), int(w), int(h), [float(v) for v in values], str(path)),
            )
        except ValueError as err:
            raise FormatError(
                f"{path}: expected lines of COLMAP's cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {line[:60]!r}",
                hint="colmap model_converter --output_type TXT",
            ) from err


def _colmap_bin(path: Path) -> Iterator[tuple[str, Found]]:
    data = path.read_bytes()
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            number, model, w, h = struct.unpack_from("<iiQQ", data, at)
            kind = _COLMAP.get(model, (f"model {model}", ""))
            n = len(kind[1].split())
            values = struct.unpack_from(f"<{n}d", data, at + 24)
            at += 24 + 8 * n
            yield str(number), _colmap(kind, w, h, values, str(path))
    except struct.error as err:
        raise DataError(
            f"{path}: expected COLMAP's cameras.bin, got {len(data)} bytes that are none",
            hint="name cameras.txt",
        ) from err
