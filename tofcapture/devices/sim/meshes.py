"""Read meshes for the simulated world: PLY, OBJ or STL, in a stated unit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.o3d import load_open3d
from tofcapture.poses import Float64

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SUFFIXES = (".ply", ".obj", ".stl")


def metres_per(unit: str, where: str) -> float:
    """Metres in one unit.

    Raises
    ------
    ConfigError
        On anything but m, cm, mm.
    """
    if unit not in UNITS:
        raise ConfigError(f"{where}: expected a unit among {', '.join(UNITS)}, got {unit!r}")
    return UNITS[unit]


def read_mesh(path: Path, unit: str) -> tuple[Float64, NDArray[np.int64]]:
    """Vertices (N, 3) in metres and triangles (M, 3) of a mesh file.

    Raises
    ------
    ConfigError
        Missing, of another type, unreadable or without triangles.
    """
    scale = metres_per(unit, str(path))
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: expected a mesh file ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise ConfigError(f"{path}: no such mesh", hint="mesh paths are relative to the world file")
    o3d = load_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale
    triangles = np.asarray(mesh.triangles, dtype=np.int64)
    if len(triangles) == 0:
        raise ConfigError(f"{path}: expected a triangle mesh, found no triangles")
    return vertices, triangles
