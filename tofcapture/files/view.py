"""View files: everything captured at one pose of one scene, written once.

::

    digest = write_view(view_path(recording, "mug", 7), view)
    view = open_view(recording / "views/mug/view-007.h5")
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DataError, FormatError, PassedOver, TofError
from tofcapture.files.disk import unreadable
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
from tofcapture.files.seal import digest_once, partial_path, seal, stored_digest
from tofcapture.frames import ArmState, StereoFrame, TofBurst, Truth, View
from tofcapture.rig import dumps_rig, loads_rig

_SCENE = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_NUMBERED = re.compile(r"view-(\d{3,})\.h5")
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


def view_number(path: Path) -> int | None:
    """Find the number of a view in its file's exact name; ``None`` for ``view-007 (1).h5`` and other names."""
    found = _NUMBERED.fullmatch(path.name)
    return int(found[1]) if found and path.name == f"view-{int(found[1]):03d}.h5" else None


def find_views(recording: Path) -> dict[str, tuple[Path, ...]]:
    """Find the view files of a recording, by scene and number; what is passed over is named by a :class:`PassedOver`.

    Raises :class:`UnreadableError`: a folder cannot be looked into.
    """
    scenes, others = list_views(recording)
    for path, why in others.items():
        warnings.warn(f"{path}: passed over: {why}", PassedOver, stacklevel=2)
    return scenes


def list_views(recording: Path) -> tuple[dict[str, tuple[Path, ...]], dict[Path, str]]:
    """List a recording's view files by scene and number, and the files that are passed over, each with the reason.

    A view has an exact name in a scene's folder, and a digest that no other has. Raises as :func:`find_views` does.
    """
    root, found, others = Path(recording) / "views", list[Path](), dict[Path, str]()
    for folder in _entries(root):
        files = [p for p in _entries(folder) if p.suffix.lower() == ".h5"] if folder.is_dir() else []
        if files and not _SCENE.fullmatch(folder.name):
            others[folder] = "expected the name of a scene"
            continue
        named = [p for p in files if view_number(p) is not None]
        found += sorted(named, key=lambda p: view_number(p) or 0)
        others |= {p: "expected a name like view-007.h5" for p in files if p not in named}
    others |= _copies(found)
    scenes: dict[str, tuple[Path, ...]] = {}
    for path in found:
        if path not in others:
            scenes[path.parent.name] = (*scenes.get(path.parent.name, ()), path)
    return scenes, others


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, by name; nothing where there is none."""
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as err:
        raise unreadable(folder, err) or DataError(f"{folder}: {err.strerror}") from err


def _copies(paths: Iterable[Path]) -> dict[Path, str]:
    """Say of which view a file is a copy, told by its digest; the original is the one that lies where its content says."""
    same: dict[str, list[Path]] = {}
    for path in paths:
        try:
            same.setdefault(stored_digest(path) or digest_once(path), []).append(path)
        except (OSError, DataError):
            continue  # whoever reads it says why it cannot be read
    found: dict[Path, str] = {}
    for alike in (paths for paths in same.values() if len(paths) > 1):
        original = next((p for p in alike if _place_of(p) == (p.parent.name, view_number(p))), alike[0])
        found |= {p: f"a copy of {original.parent.name}/{original.name}" for p in alike if p != original}
    return found


def _place_of(path: Path) -> tuple[str, int] | None:
    """Scene and number that a view says it has; ``None`` when it cannot be read."""
    try:
        with open_checked(path, VIEW) as file:
            return text_attr(file, "scene", path), int(attr(file, "index", path))
    except (DataError, ValueError, TypeError):
        return None


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


def write_view(path: str | Path, view: View) -> str:
    """Write a view, verify it byte by byte, seal it read-only under its name.

    Killed at any moment it leaves either no file of that name or a whole one. The same view gives the same bytes.

    Returns the SHA-256 of the file, hexadecimal; also stored beside it.

    Raises :class:`FormatError`: when an array has a shape or dtype that the layout does not allow;
    :class:`DataError`: when what was read back is not what was written; :class:`OSError`: when the disk
    refuses (full, read-only).

    Parameters
    ----------
    path
        Usually :func:`view_path`; folders are made, an older file of that name is replaced.
    view
        What to write.
    """
    path = Path(path)
    check_scene_name(view.scene)
    arrays, partial = _arrays(view), partial_path(path)
    try:
        with h5py.File(partial, "w", locking=False) as file:
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
    sizes = {"F": F, "K": K, "H": H, "W": W, "SH": SH, "SW": SW, "J": len(view.arm_before.joints)}
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


def open_view(path: str | Path) -> View:
    """Read a view back, bit by bit what was written.

    Raises :class:`DataError`: missing, truncated, not HDF5, or damaged data; the message names the file and
    the dataset; :class:`FormatError`: another format or version, a dataset missing, or shapes that contradict
    each other.
    """
    path = Path(path)
    with _opened(path) as file:
        return _read(file, path, fetch(file, VIEW["stereo/points"], path))


def read_depth_view(path: str | Path) -> tuple[View, NDArray[np.float32]]:
    """Read a view without x and y of its point map, which are two thirds of the work; raises as :func:`open_view` does.

    Returns
    -------
    view
        As :func:`open_view`, but every point of the map is NaN.
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
