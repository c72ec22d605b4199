"""Boards as data: outline, thickness, cut-outs and what is printed on the front, read from TOML and checked by name.

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

from tofcapture.errors import ConfigError
from tofcapture.meshes import circle, inside, rectangle, signed_area
from tofcapture.ops.pattern import KINDS, Pattern, pattern_from
from tofcapture.poses import Float64

BOARDS = Path(__file__).with_name("boards")
DEFAULT = "default"
SIZES = (0.05, 3.0)  # m; an outline beyond these was written in other units
MIN_WEB = 0.005  # m of material between cut-outs: less breaks, and hides from a ToF pixel
SEGMENTS = 64  # facets of a circle where the file does not say
EDGE = 0.5  # squares of plate around a pattern where the file gives no outline
FILE = {"format": "tofcapture-board", "version": 1, "units": "m", "thickness": 0.005}
SAME = 0.0015  # m; symmetric to less than this looks symmetric to a camera


@dataclass(frozen=True)
class Hole:
    """One cut-out."""

    name: str  #: As in the file
    corners: Float64  #: (M, 2) float64 simple polygon, metres, counter-clockwise; of a circle, its facets
    #: Of a circle, metres; None and 0 for a polygon
    centre: tuple[float, float] | None = None
    radius: float = 0.0


@dataclass(frozen=True)
class Board:
    """A flat plate with cut-outs."""

    name: str  #: As in the file
    outline: Float64  #: (N, 2) float64 simple polygon, metres, counter-clockwise
    thickness: float  #: Metres
    holes: tuple[Hole, ...]  #: In the order of the file
    pattern: Pattern | None = None  #: What is printed on the front, in the middle of the board's frame

    @property
    def rings(self) -> list[Float64]:
        """Outline, then the corners of every hole."""
        return [self.outline, *(hole.corners for hole in self.holes)]

    @property
    def middle(self) -> Float64:
        """(2,) centre of the outline's bounding box."""
        out: Float64 = (self.outline.max(axis=0) + self.outline.min(axis=0)) / 2
        return out


def load_board(board: str | Path = DEFAULT) -> Board:
    """Read a board: a TOML file, a packaged one by name, Kalibr's YAML, or words such as ``charuco:7x5:0.07:0.05:DICT_4X4_50``.

    The words are kind, columns x rows, square, marker and dictionary. :class:`ConfigError` where it is missing, not TOML, or not a board; the message names the hole.
    """
    packaged = {p.stem: p for p in sorted(BOARDS.glob("*.toml"))}
    path = packaged.get(str(board), Path(board))
    if ":" in str(board) and str(board).split(":")[0] in KINDS:
        return board_from({**FILE, "pattern": _in_words(str(board))}, str(board))
    try:
        text = path.read_text(encoding="utf-8")
        if path.suffix in {".yaml", ".yml"}:
            return board_from({**FILE, "pattern": _kalibr(text, path)}, str(path))
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{path}: not TOML: {err}") from err
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read the board: {err}", hint=f"packaged boards: {', '.join(packaged)}"
        ) from err
    return board_from(table, str(path))


def _in_words(words: str) -> dict[str, Any]:
    """Read a pattern from ``kind:columns x rows:square[:marker[:dictionary]]``."""
    kind, *rest = words.split(":")
    try:
        columns, rows = (int(n) for n in rest[0].lower().split("x"))
        lengths = dict(zip(("square", "marker"), map(float, rest[1:3]), strict=False))
    except (IndexError, ValueError) as err:
        raise ConfigError(
            f"board {words!r}: expected kind:COLUMNSxROWS:SQUARE[:MARKER[:DICTIONARY]], lengths in metres",
            hint="such as charuco:7x5:0.07:0.05:DICT_4X4_50; columns and rows count squares, of an AprilGrid tags",
        ) from err
    return {
        "kind": kind,
        "columns": columns,
        "rows": rows,
        **lengths,
        **({"dictionary": rest[3]} if rest[3:] else {}),
    }


def _kalibr(text: str, path: Path) -> dict[str, Any]:
    """Read a pattern from a target file of Kalibr."""
    import yaml

    try:
        found = dict(yaml.safe_load(text))
        if found["target_type"] == "checkerboard":
            count = {"columns": int(found["targetCols"]) + 1, "rows": int(found["targetRows"]) + 1}
            return {"kind": "chessboard", **count, "square": float(found["colSpacingMeters"])}
        tag, spacing = float(found["tagSize"]), float(found["tagSpacing"])
        count = {"columns": int(found["tagCols"]), "rows": int(found["tagRows"])}
        return {
            "kind": str(found["target_type"]),
            **count,
            "square": tag * (1 + spacing),
            "marker": tag,
            "border": 2,
        }
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as err:
        raise ConfigError(f"{path}: expected a target of Kalibr, aprilgrid or checkerboard: {err!r}") from err


def board_from(table: Mapping[str, Any], where: str = "board") -> Board:
    """Read a board from plain TOML types and check it.

    :class:`ConfigError` for wrong format, units or keys, and for polygons that cross themselves or each other, leave the outline, or
    leave too little material.
    """
    _known(table, {"format", "version", "units", "name", "thickness", "outline", "hole", "pattern"}, where)
    if table.get("format") != "tofcapture-board" or table.get("version") != 1:
        raise ConfigError(
            f"{where}: expected format tofcapture-board, version 1, got {table.get('format')!r}, {table.get('version')!r}",
            hint="see docs/board.md",
        )
    if table.get("units") != "m":
        raise ConfigError(f'{where}: expected units = "m", got {table.get("units")!r}')
    holes = tuple(_hole(t, f"{where}: hole {i + 1}") for i, t in enumerate(table.get("hole", [])))
    pattern = pattern_from(table["pattern"], f"{where}: pattern") if "pattern" in table else None
    around = None if pattern is None else rectangle(*(pattern.size + 2 * EDGE * pattern.square))
    outline = _polygon(table.get("outline", around), f"{where}: outline")
    thickness = _length(table, "thickness", f"{where}: thickness")
    board = Board(str(table.get("name", where)), outline, thickness, holes, pattern)
    if pattern is not None and not inside(outline, rectangle(*pattern.size)).all():
        raise ConfigError(
            f"{where}: pattern: expected inside the outline, got {pattern.size.round(4).tolist()} m"
        )
    _check_cuttable(board, where)
    return board


def _check_cuttable(board: Board, where: str) -> None:
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
        nested = inside(a.corners, b.corners).any() or inside(b.corners, a.corners).any()
        if nested or _gap(a.corners, b.corners) < MIN_WEB:
            raise ConfigError(
                f"{where}: holes {a.name!r} and {b.name!r}: expected {MIN_WEB} m of material between them"
            )


def distance_to_ring(polygon: Float64, points: Float64) -> Float64:
    """Measure the distance (...,) of points (..., 2) to the border of a polygon (N, 2), metres."""
    side = np.roll(polygon, -1, axis=0) - polygon
    offset = points[..., None, :] - polygon
    t = np.clip((offset * side).sum(axis=-1) / np.square(side).sum(axis=-1), 0, 1)
    out: Float64 = np.linalg.norm(offset - t[..., None] * side, axis=-1).min(axis=-1)
    return out


def sampled(ring: Float64, pitch: float = 0.004) -> tuple[Float64, Float64]:
    """Sample a closed polygon (N, 2) about every ``pitch`` metres: points (M, 2), and unit directions (M, 2) to the right of its way."""
    at, right = [], []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        side = b - a
        length = float(np.linalg.norm(side))
        n = max(1, round(length / pitch))
        at.append(a + side * ((np.arange(n) + 0.5) / n)[:, None])
        right.append(np.broadcast_to([side[1] / length, -side[0] / length], (n, 2)))
    return np.concatenate(at), np.concatenate(right)


def symmetries(board: Board) -> list[str]:
    """Name the turns in its plane that map a board onto itself to 1.5 mm: no camera can tell them apart."""
    samples = np.concatenate([sampled(ring)[0] for ring in board.rings])
    found = []
    for degrees in (60, 72, 90, 120, 180):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = (samples - board.middle) @ np.array([[c, s], [-s, c]]) + board.middle
        off = np.min([distance_to_ring(ring, turned) for ring in board.rings], axis=0)
        if off.max() < SAME:
            found.append(f"turn by {degrees} deg")
    return found


def _gap(a: Float64, b: Float64) -> float:
    return float(min(distance_to_ring(a, sampled(b)[0]).min(), distance_to_ring(b, sampled(a)[0]).min()))


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
    x, y = _points([table["centre"]], where)[0].tolist()
    radius, segments = _length(table, "radius", where), table.get("segments", SEGMENTS)
    if not isinstance(segments, int) or not 8 <= segments <= 1024:
        raise ConfigError(f"{where}: segments: expected 8 to 1024, got {segments!r}")
    return Hole(name, circle(radius, (x, y), segments), (x, y), radius)


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
    side, away = np.roll(points, -1, axis=0) - points, points - points[:, None]
    start, end = (side[:, None, 0] * w[..., 1] - side[:, None, 1] * w[..., 0] for w in (away, away + side))
    apart = start * end < 0  # [i, j]: side j has its ends on either side of the line along side i
    if (apart & apart.T).any():
        raise ConfigError(f"{where}: the polygon crosses itself", hint="list the corners in order")
    return points if signed_area(points) > 0 else points[::-1].copy()
