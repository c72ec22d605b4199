"""Printed targets as data: chessboard, ChArUco board, AprilGrid; where their corners are, and what is dark.

A pattern lies in a plane with x right and y up as its front is looked at, metres, the origin in its middle. ChArUco boards are
OpenCV's, with the first square dark and markers from 0 in the light ones; AprilGrids are Kalibr's, tag 0 at the lower left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError

Float64 = NDArray[np.float64]

KINDS = ("chessboard", "charuco", "aprilgrid")
SIDES = (0.002, 1.0)  # m; a square beyond these was written in other units
PLANE = 2  # coordinates of a corner


@dataclass(frozen=True)
class Pattern:
    """One printed target."""

    kind: str  #: One of :data:`KINDS`
    columns: int  #: Squares of a chessboard or ChArUco board, tags of an AprilGrid
    rows: int
    square: float  #: Metres: side of a square; of an AprilGrid, from one tag to the next
    marker: float = 0.0  #: Metres: side of a marker
    dictionary: str = "DICT_APRILTAG_36h11"  #: OpenCV's name
    border: int = 1  #: Bits of a marker's dark border; Kalibr's AprilGrids have 2
    legacy: bool = False  #: ChArUco board of OpenCV before 4.6: the first square is light where rows are even

    def __post_init__(self) -> None:
        where = f"pattern {self.kind!r}"
        if self.kind not in KINDS:
            raise ConfigError(f"{where}: expected one of {', '.join(KINDS)}")
        least = 1 if self.kind == "aprilgrid" else 3
        if min(self.columns, self.rows) < least or max(self.columns, self.rows) > 100:
            raise ConfigError(
                f"{where}: expected {least} to 100 columns and rows, got {self.columns} x {self.rows}"
            )
        if not SIDES[0] <= self.square <= SIDES[1]:
            raise ConfigError(
                f"{where}: square: expected {SIDES[0]} to {SIDES[1]} m, got {self.square:g}",
                hint="lengths are in metres, not millimetres",
            )
        if self.kind != "chessboard" and not 0 < self.marker < self.square:
            raise ConfigError(
                f"{where}: marker: expected less than the square of {self.square:g} m, got {self.marker:g}"
            )

    @property
    def size(self) -> Float64:
        """(2,) width and height of what is printed, metres."""
        gap = self.square - self.marker if self.kind == "aprilgrid" else 0.0
        return np.array([self.columns, self.rows]) * self.square + gap

    @property
    def half_turn(self) -> bool:
        """Tell whether half a turn looks the same: a chessboard of two odd or two even numbers."""
        return self.kind == "chessboard" and (self.columns + self.rows) % 2 == 0

    @cached_property
    def corners(self) -> Float64:
        """(N, 2) corners, in the order of their numbers.

        Inner corners of squares row by row from the upper left; of an AprilGrid, four per tag, clockwise from its upper left.
        """
        low, high = -self.size / 2, self.size / 2
        if self.kind != "aprilgrid":
            x = low[0] + self.square * np.arange(1, self.columns)
            y = high[1] - self.square * np.arange(1, self.rows)
            return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, PLANE)
        gap = self.square - self.marker
        tag, (column, row) = self.marker, np.divmod(np.arange(self.columns * self.rows), self.columns)[::-1]
        lower_left = low + gap + self.square * np.stack([column, row], axis=1)
        around = np.array([[0, tag], [tag, tag], [tag, 0], [0, 0]])
        out: Float64 = (lower_left[:, None] + around).reshape(-1, PLANE)
        return out

    def dark(self, points: Float64) -> NDArray[np.bool_]:
        """Tell which points (N, 2) are dark; beside the pattern none is."""
        at = points + self.size / 2
        out = np.asarray(((at >= 0) & (at < self.size)).all(axis=1))
        out[out] = self._dark(at[out])
        return out

    def _dark(self, at: Float64) -> NDArray[np.bool_]:
        if self.kind == "aprilgrid":
            gap = self.square - self.marker
            inside = at - self.square * np.floor(at / self.square) - gap
            cell = np.floor(at / self.square).astype(int)
            on_tag = np.asarray((inside >= 0).all(axis=1) & (cell < [self.columns, self.rows]).all(axis=1))
            number = cell[:, 1] * self.columns + cell[:, 0]
            place = np.stack([inside[:, 0], self.marker - inside[:, 1]], axis=1) / self.marker
            return np.asarray((inside < 0).all(axis=1) | self._bit(on_tag, number, place))
        at = np.stack([at[:, 0], self.size[1] - at[:, 1]], axis=1)
        cell = np.minimum(np.floor(at / self.square).astype(int), [self.columns - 1, self.rows - 1])
        first_light = self.legacy and self.rows % 2 == 0
        black = np.asarray(cell.sum(axis=1) % 2 == int(first_light))
        if self.kind == "chessboard":
            return black
        place = (at - self.square * (cell + 0.5)) / self.marker + 0.5
        on_tag = np.asarray(~black & ((place >= 0) & (place < 1)).all(axis=1))
        # Light squares before this one, row by row.
        light = np.zeros((self.rows, self.columns), dtype=int)
        light[np.indices(light.shape).sum(axis=0) % 2 != int(first_light)] = 1
        number = (np.cumsum(light) - 1).reshape(light.shape)[tuple(cell[:, ::-1].T)]
        return np.asarray(black | self._bit(on_tag, number, place))

    def _bit(self, on_tag: NDArray[np.bool_], number: NDArray[Any], place: Float64) -> NDArray[np.bool_]:
        """Tell which points are on a dark bit of their marker; ``place`` (N, 2) is across and down it, 0 to 1."""
        out = np.zeros(len(place), dtype=bool)
        for k in np.unique(number[on_tag]):
            own, bits = on_tag & (number == k), self._bits(int(k))
            column, row = np.minimum((place[own] * len(bits)).astype(int), len(bits) - 1).T
            out[own] = bits[row, column]
        return out

    def _bits(self, number: int) -> NDArray[np.bool_]:
        import cv2

        book = aruco_dictionary(self.dictionary)
        side = book.markerSize + 2 * self.border
        return np.asarray(cv2.aruco.generateImageMarker(book, number, side, borderBits=self.border) < 128)

    def cuts(self) -> tuple[Float64, Float64]:
        """Return all x (A,) and all y (B,) at which the shade may change: between them it does not."""
        steps = [0.0, self.square]
        if self.kind != "chessboard":
            bits = self._bits(0).shape[0]
            edge = self.square - self.marker if self.kind == "aprilgrid" else (self.square - self.marker) / 2
            steps += (edge + self.marker * np.arange(bits + 1) / bits).tolist()
        out = []
        for size, count in zip(self.size, (self.columns, self.rows), strict=True):
            every = (np.arange(count + 1)[:, None] * self.square + steps).reshape(-1)
            every = np.unique(np.round(every[every < size + 1e-9], 9))
            out.append(every - size / 2)
        return out[0], out[1]


def aruco_dictionary(name: str) -> Any:
    """Look a dictionary of markers up; :class:`ConfigError` names those there are."""
    import cv2

    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or number is None:
        known = ", ".join(sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_")))
        raise ConfigError(f"pattern: unknown dictionary {name!r}", hint=f"OpenCV knows {known}")
    return cv2.aruco.getPredefinedDictionary(number)


def pattern_from(table: Mapping[str, Any], where: str) -> Pattern:
    """Read a pattern from plain TOML types; :class:`ConfigError` for unknown keys and impossible values."""
    kinds = {f.name: f.type for f in fields(Pattern)}
    if unknown := sorted(set(table) - set(kinds)):
        raise ConfigError(f"{where}: unknown key {', '.join(unknown)}", hint=f"it knows {', '.join(kinds)}")
    for key, value in table.items():
        allowed = {"int": (int,), "float": (int, float), "str": (str,), "bool": (bool,)}[str(kinds[key])]
        if not isinstance(value, allowed) or (isinstance(value, bool) and kinds[key] != "bool"):
            raise ConfigError(f"{where}: {key}: expected {kinds[key]}, got {value!r}")
    try:
        return Pattern(**table)
    except TypeError as err:
        raise ConfigError(f"{where}: expected at least kind, columns, rows and square: {err}") from err
