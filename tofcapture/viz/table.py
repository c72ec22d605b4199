"""Draw rows and columns of pictures that share scales, with a colour bar or a key below each column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofcapture.colours import Scale, UInt8, palette

NORMAL_KEY = ((None, "red right, green up,"), (None, "blue towards the camera"))
DEPTH_KEY = ((None, "dark near, bright far: see"), (None, "each picture; grey: none"))
WIDTH = 12.0  # inches: 1200 pixels
SMALL, FONT = 9.0, 11.0  # points at 100 dots an inch: 12 and 15 pixels
_HEAD, _FOOT, _GAP = 0.5, 0.72, 0.05  # inches
_LEFT = 0.3  # inches: names of rows


@dataclass(frozen=True)
class Cell:
    """A picture (H, W, 3), the scale that it was painted with, and words in its lower left corner."""

    image: UInt8
    scale: Scale | None = None
    note: str = ""


@dataclass(frozen=True)
class Column:
    """Title, cells from top to bottom, and the key below a column without a scale: colours (or none) and words."""

    title: str
    cells: Sequence[Cell | None]
    key: Sequence[tuple[tuple[int, ...] | None, str]] = ()

    @property
    def scale(self) -> Scale | None:
        """Scale that all its cells share."""
        scales = {cell.scale for cell in self.cells if cell}
        return scales.pop() if len(scales) == 1 else None


def draw_table(
    figure: Any, title: str, names: Sequence[str], columns: Sequence[Column], aspect: float
) -> None:
    """Fill a figure and set its size; adjacent columns of one scale share its colour bar.

    ``names`` are those of the rows, ``aspect`` is width over height of every cell.
    """
    width = (WIDTH - _LEFT - 0.05) / len(columns) - _GAP
    tall = width / aspect
    height = _HEAD + len(names) * (tall + _GAP) + _FOOT
    figure.set_size_inches(WIDTH, height)
    figure.text(0.05 / WIDTH, 1 - 0.05 / height, title, fontsize=FONT, va="top")
    for c, column in enumerate(columns):
        x = _LEFT + c * (width + _GAP)
        for r, cell in enumerate(column.cells):
            y = height - _HEAD - (r + 1) * (tall + _GAP) + _GAP
            axes = figure.add_axes((x / WIDTH, y / height, width / WIDTH, tall / height))
            if cell:
                draw_cell(axes, cell)
            else:
                axes.set_axis_off()
            if r == 0:
                axes.set_title(column.title, fontsize=SMALL, pad=3)
            if c == 0:
                axes.set_ylabel(names[r], fontsize=SMALL)
        if column.scale is None:
            _draw_key(figure, column, x, width, height)
    _draw_bars(figure, columns, width, height)


def draw_cell(axes: Any, cell: Cell) -> None:
    """Draw one picture with its note; grey is where no value is."""
    axes.imshow(cell.image, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set(color="0.7", linewidth=0.5)
    if cell.note:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
        axes.text(0.02, 0.03, cell.note, transform=axes.transAxes, fontsize=SMALL - 1, bbox=box)


def draw_bar(figure: Any, box: tuple[float, float, float, float], scale: Scale, label: str) -> None:
    """Draw a horizontal colour bar with its unit in a box: left, bottom, width and height, as shares of the figure."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, PowerNorm
    from matplotlib.ticker import FixedLocator, MaxNLocator

    colours = ListedColormap(palette(scale.colours)[:-1] / 255)
    drawn = ScalarMappable(PowerNorm(scale.gamma, scale.low, scale.high), colours)
    extend = "both" if scale.colours in {"viridis", "RdBu_r"} else "max"
    bar = figure.colorbar(
        drawn, cax=figure.add_axes(box), orientation="horizontal", extend=extend, extendfrac=0.03
    )
    bar.set_label(label, fontsize=SMALL - 0.5, labelpad=1)
    ends = [scale.low, scale.low + (scale.high - scale.low) / 5, scale.high]
    bar.ax.xaxis.set_major_locator(MaxNLocator(4) if scale.gamma == 1 else FixedLocator(ends))
    bar.ax.xaxis.set_major_formatter("{x:g}")
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL - 0.5, pad=1.5, length=2)
    bar.solids.set_rasterized(True)


def _draw_bars(figure: Any, columns: Sequence[Column], width: float, height: float) -> None:
    c = 0
    while c < len(columns):
        scale, last = columns[c].scale, c
        while scale is not None and last + 1 < len(columns) and columns[last + 1].scale == scale:
            last += 1
        if scale is not None:
            x, across = _LEFT + c * (width + _GAP), (last - c) * (width + _GAP) + width
            inset = 0.06 * across
            box = ((x + inset) / WIDTH, (_FOOT - 0.2) / height, (across - 2 * inset) / WIDTH, 0.11 / height)
            draw_bar(figure, box, scale, f"{scale.unit}; grey: none")
        c = last + 1


def _draw_key(figure: Any, column: Column, x: float, width: float, height: float) -> None:
    """Write the key of a column in two columns of lines, each after a square of its colour."""
    for i, (colour, words) in enumerate(column.key):
        two = len(column.key) > 3
        left = x + (i % 2) * width / 2 if two else x
        y = _FOOT - 0.1 - 0.19 * (i // 2 if two else i)
        if colour is not None:
            box = {"facecolor": np.array(colour) / 255, "edgecolor": "0.5", "boxstyle": "square,pad=0.15"}
            figure.text((left + 0.04) / WIDTH, y / height, "  ", fontsize=5, va="top", bbox=box)
            left += 0.16
        figure.text(left / WIDTH, y / height, words, fontsize=SMALL - 0.5, va="top")
