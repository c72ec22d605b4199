"""Read point clouds and meshes (.ply, .pcd, .stl, .obj) as ground truth."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import FormatError
from tofcapture.importing.said import Said
from tofcapture.importing.source import Piece
from tofcapture.libraries import load_open3d

SUFFIXES = (".ply", ".pcd", ".stl", ".obj")


def claims(path: Path) -> bool:
    """Tell by the suffix."""
    return path.is_file() and path.suffix.lower() in SUFFIXES


def pieces(path: Path, said: Said) -> Iterator[Piece]:
    """List the one cloud or mesh of a file."""
    del said
    yield Piece("", path, partial(read_surface, path), role="truth")


def read_surface(path: Path) -> NDArray[Any]:
    """Read points (N, 3), those of a point map (H, W, 3) in PCD, or the corners of triangles (M, 3, 3), in the file's own unit.

    :class:`FormatError` for a file that holds neither, :class:`ConfigError` without Open3D.
    """
    o3d = load_open3d()
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    if path.suffix.lower() != ".pcd":
        mesh = o3d.io.read_triangle_mesh(path)
        if len(mesh.triangles):
            corners: NDArray[Any] = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
            return corners
    points: NDArray[Any] = np.asarray(o3d.io.read_point_cloud(path).points)
    if not len(points) or not np.isfinite(points).any():
        raise FormatError(
            f"{path}: expected points or triangles, found none", hint="copy it again, or leave it out"
        )
    with path.open("rb") as file:
        head = file.read(1000) if path.suffix.lower() == ".pcd" else b""
    rows = int(next(iter(re.findall(rb"^HEIGHT\s+(\d+)", head, re.MULTILINE)), 1))
    if rows > 1 and len(points) % rows == 0:
        return points.reshape(rows, -1, 3)
    finite: NDArray[Any] = points[np.isfinite(points).all(axis=1)]
    return finite
