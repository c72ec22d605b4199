"""View files: everything captured at one pose of one scene, written once.

::

    digest = write_view(view_path(recording, "mug", 7), view)
    view = read_view(recording / "views/mug/view-007.h5")
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DataError, FormatError, TofError
from tofcapture.files.hdf import (
    Array,
    attr,
    create,
    fetch,
    json_attr,
    open_checked,
    stereo_from,
    stereo_table,
    text_attr,
    tof_from,
    tof_table,
    write_attrs,
)
from tofcapture.files.layout import VIEW
from tofcapture.files.seal import partial_path, seal
from tofcapture.frames import ArmState, StereoFrame, TofBurst, Truth, View
from tofcapture.rig import dumps_rig, loads_rig

_SCENE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_TRUTH = ("depth", "normals", "target", "T_tof_stereo", "T_flange_tof")


def check_scene_name(scene: str) -> str:
    """Return the name of a scene; :class:`ConfigError` for one that is no safe file name."""
    if not _SCENE.fullmatch(scene):
        raise ConfigError(
            f"scene: expected 1 to 64 letters, digits, '_', '.' or '-', got {scene!r}",
            hint="for example: --scene mug-2",
        )
    return scene


def view_path(recording: Path, scene: str, index: int) -> Path:
    """Path of a view: ``RECORDING/views/<scene>/view-007.h5``."""
    return Path(recording) / "views" / check_scene_name(scene) / f"view-{index:03d}.h5"


def _arrays(view: View) -> dict[str, Array]:
    arrays: dict[str, Any] = {
        "tof/raw": view.tof.raw,
        "tof/time_ns": np.asarray(view.tof.time_ns, dtype=np.int64),
        "tof/celsius": np.asarray(view.tof.celsius, dtype=np.float64),
        "stereo/points": view.stereo.points,
        "stereo/time_ns": np.int64(view.stereo.time_ns),
    }
    for when, state in (("before", view.arm_before), ("after", view.arm_after)):
        arrays[f"arm/{when}/joints"] = np.asarray(state.joints, dtype=np.float64)
        arrays[f"arm/{when}/T_base_flange"] = np.asarray(state.T_base_flange, dtype=np.float64)
        arrays[f"arm/{when}/time_ns"] = np.int64(state.time_ns)
    if view.truth is not None:
        arrays |= {f"truth/{name}": getattr(view.truth, name) for name in _TRUTH}
    return {path: np.asarray(a) for path, a in arrays.items()}


def write_view(path: Path, view: View) -> str:
    """Write a view, verify it byte by byte, seal it read-only under its name.

    Killed at any moment it leaves either no file of that name or a whole one. The same view gives the same bytes.

    Parameters
    ----------
    path
        Usually :func:`view_path`; folders are made, an older file of that name is replaced.
    view
        What to write.

    Returns
    -------
    SHA-256 of the file, hexadecimal; also stored beside it.

    Raises
    ------
    FormatError
        When an array has a shape or dtype that the layout does not allow.
    DataError
        When what was read back is not what was written.
    OSError
        When the disk refuses (full, read-only).
    """
    path = Path(path)
    check_scene_name(view.scene)
    arrays, partial = _arrays(view), partial_path(path)
    try:
        with h5py.File(partial, "w") as file:
            _write(file, view, arrays)
        with open_checked(partial, VIEW) as file:
            for name, data in arrays.items():
                if fetch(file, VIEW[name], path).tobytes() != data.tobytes():
                    raise DataError(
                        f"{path}: /{name} read back differs from what was written", hint="check the disk"
                    )
        return seal(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _write(file: h5py.File, view: View, arrays: dict[str, Array]) -> None:
    F, K, H, W = view.tof.raw.shape
    SH, SW = view.stereo.info.camera.shape
    sizes = {"F": F, "K": K, "H": H, "W": W, "SH": SH, "SW": SW}
    values = {
        "scene": view.scene,
        "index": view.index,
        "rig": dumps_rig(view.rig),
        "tof_info": tof_table(view.tof.info),
        "stereo_info": stereo_table(view.stereo.info),
        "provenance": dict(view.provenance),
    }
    write_attrs(file, VIEW, values)
    for name, data in arrays.items():
        expected = VIEW[name].shape(sizes)
        if data.shape != expected:
            raise FormatError(f"/{name}: expected shape {expected}, got {data.shape}")
        create(file, VIEW[name], data.shape, data.dtype)[...] = data


def read_view(path: Path) -> View:
    """Read a view back, bit by bit what was written.

    Raises
    ------
    DataError
        Missing, truncated, not HDF5, or damaged data; the message names the file and the dataset.
    FormatError
        Another format or version, a dataset missing, or shapes that contradict each other.
    """
    path = Path(path)
    with _opened(path) as file:
        return _read(file, path, fetch(file, VIEW["stereo/points"], path))


def read_depth_view(path: Path) -> tuple[View, NDArray[np.float32]]:
    """Read a view without x and y of its point map, which are two thirds of the work; raises as :func:`read_view` does.

    Returns
    -------
    view
        As :func:`read_view`, but every point of the map is NaN.
    depth
        (SH, SW) z of the map, stereo frame, metres.
    """
    path = Path(path)
    with _opened(path) as file:
        depth = fetch(file, VIEW["stereo/points"], path, np.s_[..., 2])
        return _read(file, path, np.broadcast_to(np.float32(np.nan), (*depth.shape, 3))), depth


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Open a view; errors from inside name it."""
    with open_checked(path, VIEW) as file:
        try:
            yield file
        except DataError as err:
            raise err if str(path) in err.message else type(err)(f"{path}: {err.message}", err.hint) from err
        except TofError as err:
            raise FormatError(f"{path}: {err.message}", hint=f"tofcapture check {path}") from err


def _read(file: h5py.File, path: Path, points: NDArray[np.float32]) -> View:
    def get(name: str) -> Array:
        return fetch(file, VIEW[name], path)

    def arm(when: str) -> ArmState:
        return ArmState(
            get(f"arm/{when}/joints"), get(f"arm/{when}/T_base_flange"), int(get(f"arm/{when}/time_ns"))
        )

    tof_info = tof_from(json_attr(file, "tof_info", path), str(path))
    stereo_info = stereo_from(json_attr(file, "stereo_info", path), str(path))
    return View(
        scene=text_attr(file, "scene", path),
        index=int(attr(file, "index", path)),
        tof=TofBurst(get("tof/raw"), get("tof/time_ns"), get("tof/celsius"), tof_info),
        stereo=StereoFrame(points, int(get("stereo/time_ns")), stereo_info),
        arm_before=arm("before"),
        arm_after=arm("after"),
        rig=loads_rig(text_attr(file, "rig", path), f"{path}: rig"),
        provenance=json_attr(file, "provenance", path),
        truth=Truth(**{name: get(f"truth/{name}") for name in _TRUTH}) if "truth" in file else None,
    )
