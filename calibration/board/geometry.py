"""Boards with cut-outs as data: outline, thickness and holes, read from TOML and checked by name.

The board's frame has its origin in the plane of the back face, x and y as in the file, z towards the front face, which lies at
z = thickness.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.meshes import Mesh, circle, extrude, signed_area
from tofcapture.poses import Float64

BOARDS = Path(__file__).with_name("boards")
DEFAULT = "default"
SIZES = (0.05, 3.0)  # m; an outline beyond these was written in other units
MIN_WEB = 0.005  # m of material between cut-outs: less breaks, and hides from a ToF pixel
SEGMENTS = 64  # facets of a circle where the file does not say
SAME = 0.0015  # m; symmetric to less than this looks symmetric to a camera


@dataclass(frozen=True)
class Hole:
    """One cut-out.

    Attributes
    ----------
    name
        As in the file.
    corners
        (M, 2) float64 simple polygon, metres, counter-clockwise; of a circle, its facets.
    centre, radius
        Of a circle, metres; None and 0 for a polygon.
    """

    name: str
    corners: Float64
    centre: tuple[float, float] | None = None
    radius: float = 0.0


@dataclass(frozen=True)
class Board:
    """A flat plate with cut-outs.

    Attributes
    ----------
    name
        As in the file.
    outline
        (N, 2) float64 simple polygon, metres, counter-clockwise.
    thickness
        Metres.
    holes
        In the order of the file.
    """

    name: str
    outline: Float64
    thickness: float
    holes: tuple[Hole, ...]

    @property
    def rings(self) -> list[Float64]:
        """Outline, then the corners of every hole."""
        return [self.outline, *(hole.corners for hole in self.holes)]

    def mesh(self) -> Mesh:
        """Closed mesh (vertices, triangles) from z = 0 to the thickness, metres."""
        return extrude(self.outline, self.thickness, [hole.corners for hole in self.holes])


def load_board(board: str | Path = DEFAULT) -> Board:
    """Read a board.

    Parameters
    ----------
    board
        Path of a TOML file, or the name of a packaged board: ``default``, ``second``.

    Raises
    ------
    ConfigError
        Missing, not TOML, or not a board; the message names the hole.
    """
    packaged = {p.stem: p for p in sorted(BOARDS.glob("*.toml"))}
    path = packaged.get(str(board), Path(board))
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read the board: {err}", hint=f"packaged boards: {', '.join(packaged)}"
        ) from err
    return board_from(table, str(path))


def board_from(table: Mapping[str, Any], where: str = "board") -> Board:
    """Read a board from plain TOML types and check it.

    Raises
    ------
    ConfigError
        Wrong format, units or keys; polygons that cross themselves or each other, leave the outline, leave too little material.
    """
    _known(table, {"format", "version", "units", "name", "thickness", "outline", "hole"}, where)
    if table.get("format") != "tofcapture-board" or table.get("version") != 1:
        raise ConfigError(
            f"{where}: expected format tofcapture-board, version 1, got {table.get('format')!r}, {table.get('version')!r}",
            hint="see docs/board.md",
        )
    if table.get("units") != "m":
        raise ConfigError(f'{where}: expected units = "m", got {table.get("units")!r}')
    holes = tuple(_hole(t, f"{where}: hole {i + 1}") for i, t in enumerate(table.get("hole", [])))
    outline = _polygon(table.get("outline"), f"{where}: outline")
    board = Board(
        str(table.get("name", where)), outline, _length(table, "thickness", f"{where}: thickness"), holes
    )
    check_board(board, where)
    return board


def check_board(board: Board, where: str = "board") -> None:
    """Refuse a board that cannot be cut.

    Raises
    ------
    ConfigError
        With the hole's name.
    """
    size = float(np.ptp(board.outline, axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise ConfigError(
            f"{where}: outline: expected {SIZES[0]} to {SIZES[1]} m across, got {size:g}",
            hint="lengths are in metres, not millimetres",
        )
    if not board.thickness < size / 4:
        raise ConfigError(f"{where}: thickness: expected a plate, got {board.thickness:g} m on {size:g} m")
    names = [hole.name for hole in board.holes]
    if twice := sorted({n for n in names if names.count(n) > 1}):
        raise ConfigError(f"{where}: hole {twice[0]!r}: two holes have this name")
    for hole in board.holes:
        if not inside(board.outline, hole.corners).all() or _gap(board.outline, hole.corners) < MIN_WEB:
            raise ConfigError(
                f"{where}: hole {hole.name!r}: expected inside the outline, {MIN_WEB} m from it"
            )
    for a, b in combinations(board.holes, 2):
        if (
            inside(a.corners, b.corners).any()
            or inside(b.corners, a.corners).any()
            or _gap(a.corners, b.corners) < MIN_WEB
        ):
            raise ConfigError(
                f"{where}: holes {a.name!r} and {b.name!r}: expected {MIN_WEB} m of material between them"
            )


def inside(polygon: Float64, points: Float64) -> NDArray[np.bool_]:
    """Say which points (..., 2) lie in a simple polygon (N, 2), by crossings of the ray to the right."""
    x, y = points[..., None, 0], points[..., None, 1]
    x0, y0 = polygon.T
    x1, y1 = np.roll(polygon, -1, axis=0).T
    straddles = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    return np.asarray((straddles & (x < at)).sum(axis=-1) % 2 == 1)


def distance_to_ring(polygon: Float64, points: Float64) -> Float64:
    """Distance (...,) of points (..., 2) to the border of a polygon (N, 2), metres."""
    side = np.roll(polygon, -1, axis=0) - polygon
    offset = points[..., None, :] - polygon
    t = np.clip((offset * side).sum(axis=-1) / np.square(side).sum(axis=-1), 0, 1)
    out: Float64 = np.linalg.norm(offset - t[..., None] * side, axis=-1).min(axis=-1)
    return out


def symmetries(board: Board) -> list[str]:
    """Name the turns in its plane that map a board onto itself to 1.5 mm: no camera can tell them apart."""
    samples = np.concatenate([_sampled(ring) for ring in board.rings])
    centre = (board.outline.max(axis=0) + board.outline.min(axis=0)) / 2
    found = []
    for degrees in (60, 72, 90, 120, 180):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = (samples - centre) @ np.array([[c, s], [-s, c]]) + centre
        off = np.min([distance_to_ring(ring, turned) for ring in board.rings], axis=0)
        if off.max() < SAME:
            found.append(f"turn by {degrees} deg")
    return found


def _sampled(ring: Float64, pitch: float = 0.004) -> Float64:
    """Points (M, 2) along a closed polygon, about ``pitch`` metres apart."""
    parts = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        n = max(1, int(np.ceil(np.linalg.norm(b - a) / pitch)))
        parts.append(a + (b - a) * ((np.arange(n) + 0.5) / n)[:, None])
    return np.concatenate(parts)


def _gap(a: Float64, b: Float64) -> float:
    return float(min(distance_to_ring(a, _sampled(b)).min(), distance_to_ring(b, _sampled(a)).min()))


def _known(table: Mapping[str, Any], keys: set[str], where: str) -> None:
    if unknown := sorted(set(table) - keys):
        raise ConfigError(
            f"{where}: unknown key {', '.join(unknown)}", hint=f"it knows {', '.join(sorted(keys))}"
        )


def _length(table: Mapping[str, Any], key: str, where: str) -> float:
    value = table.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise ConfigError(f"{where}: expected a positive number of metres, got {value!r}")
    return float(value)


def _hole(table: Mapping[str, Any], where: str) -> Hole:
    name = str(table.get("name", where.rsplit(": ", 1)[-1]))
    where = f"{where} ({name})"
    _known(table, {"name", "centre", "radius", "segments", "corners"}, where)
    if ("corners" in table) == ("centre" in table):
        raise ConfigError(f"{where}: expected either corners, or centre and radius")
    if "corners" in table:
        return Hole(name, _polygon(table["corners"], where))
    centre = _points([table["centre"]], where)[0]
    radius, segments = _length(table, "radius", where), table.get("segments", SEGMENTS)
    if not isinstance(segments, int) or not 8 <= segments <= 1024:
        raise ConfigError(f"{where}: segments: expected 8 to 1024, got {segments!r}")
    at = (float(centre[0]), float(centre[1]))
    return Hole(name, circle(radius, at, segments), at, radius)


def _points(value: Any, where: str) -> Float64:
    try:
        points = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as err:
        raise ConfigError(f"{where}: expected a list of [x, y] in metres: {err}") from err
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ConfigError(f"{where}: expected a list of finite [x, y] in metres, got shape {points.shape}")
    return points


def _polygon(value: Any, where: str) -> Float64:
    points = _points(value, where)
    if len(points) < 3 or abs(signed_area(points)) < 1e-6:
        raise ConfigError(f"{where}: expected a polygon of at least 3 corners with an area")
    if _crosses_itself(points):
        raise ConfigError(f"{where}: the polygon crosses itself", hint="list the corners in order")
    return points if signed_area(points) > 0 else points[::-1].copy()


def _crosses_itself(ring: Float64) -> bool:
    ends = np.roll(ring, -1, axis=0)

    def side(a: Float64, b: Float64, p: Float64) -> float:
        return float((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]))

    for i, j in combinations(range(len(ring)), 2):
        a, b, c, d = ring[i], ends[i], ring[j], ends[j]
        if side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0:
            return True
    return False
