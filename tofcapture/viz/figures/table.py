"""Rows and columns of pictures that share scales, with a colour bar and its unit below each column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tofcapture.viz.colours import GREY

Kind = Literal["acquisition", "preprocessing", "depth", "normals"]
DPI = 100
WIDTH = 12.0  # inches: 1200 pixels
SMALL, FONT = 9.0, 11.0  # points at 100 dots an inch: 12 and 15 pixels
_HEAD, _FOOT, _GAP = 0.5, 0.66, 0.05  # inches
_LEFT = 0.3  # inches: names of rows
_LADDER = (1.0, 1.5, 2.0, 3.0, 5.0, 7.5, 10.0)


@dataclass(frozen=True)
class Scale:
    """What colours mean.

    Attributes
    ----------
    colours
        Colour map.
    low, high
        Values at its ends.
    label
        What is printed below the bar, with the unit.
    extend
        Ends at which values are cut.
    gamma
        Exponent of the way from low to high; below 1 what is small is told apart better.
    """

    colours: str
    low: float
    high: float
    label: str
    extend: Literal["neither", "max", "both"] = "neither"
    gamma: float = 1.0

    def norm(self) -> Any:
        """As matplotlib wants it."""
        from matplotlib.colors import PowerNorm

        return PowerNorm(self.gamma, self.low, self.high)


@dataclass(frozen=True)
class Cell:
    """A picture.

    Attributes
    ----------
    values
        (H, W) values of a scale, NaN: none; or (H, W, 3) uint8 colours.
    scale
        ``None`` for colours.
    note
        Printed in the lower left corner.
    size
        (width, height) of the whole picture in the units of ``window``; ``None``: no window.
    window
        Part that is shown: left, right, top, bottom.
    """

    values: NDArray[Any]
    scale: Scale | None = None
    note: str = ""
    size: tuple[float, float] | None = None
    window: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class Column:
    """Title, cells from top to bottom, and words below a column without a scale."""

    title: str
    cells: Sequence[Cell]
    words: str = ""


def draw_table(
    figure: Any, title: str, names: Sequence[str], columns: Sequence[Column], aspect: float
) -> None:
    """Fill a figure; adjacent columns of one scale share its colour bar.

    Parameters
    ----------
    figure
        Of matplotlib; its size is set.
    title
        Above.
    names
        Of the rows.
    columns
        From left to right.
    aspect
        Width over height of every cell.
    """
    width = (WIDTH - _LEFT - 0.05) / len(columns) - _GAP
    tall = width / aspect
    height = _HEAD + len(names) * (tall + _GAP) + _FOOT
    figure.set_size_inches(WIDTH, height)
    figure.text(0.05 / WIDTH, 1 - 0.05 / height, title, fontsize=FONT, va="top")
    for c, column in enumerate(columns):
        for r, cell in enumerate(column.cells):
            x, y = _LEFT + c * (width + _GAP), height - _HEAD - (r + 1) * (tall + _GAP) + _GAP
            axes = figure.add_axes((x / WIDTH, y / height, width / WIDTH, tall / height))
            draw_cell(axes, cell)
            if r == 0:
                axes.set_title(column.title, fontsize=SMALL, pad=3)
            if c == 0:
                axes.set_ylabel(names[r], fontsize=SMALL)
    _bars(figure, columns, width, height)


def draw_cell(axes: Any, cell: Cell) -> None:
    """Draw one picture; grey is where no value is.

    Parameters
    ----------
    axes
        Where.
    cell
        What.
    """
    from matplotlib import colormaps

    shown: dict[str, Any] = {"interpolation": "nearest", "aspect": "auto"}
    if cell.size is not None:
        shown["extent"] = (0, cell.size[0], cell.size[1], 0)
    if cell.scale is None:
        axes.imshow(cell.values, **shown)
    else:
        colours = colormaps[cell.scale.colours].with_extremes(bad=np.array(GREY) / 255)
        axes.imshow(np.ma.masked_invalid(cell.values), cmap=colours, norm=cell.scale.norm(), **shown)
    if cell.window is not None:
        left, right, top, bottom = cell.window
        axes.set_xlim(left, right)
        axes.set_ylim(bottom, top)
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set(color="0.7", linewidth=0.5)
    if cell.note:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
        axes.text(0.02, 0.03, cell.note, transform=axes.transAxes, fontsize=SMALL - 1, bbox=box)


def draw_bar(figure: Any, box: tuple[float, float, float, float], scale: Scale) -> None:
    """Draw a horizontal colour bar with its unit.

    Parameters
    ----------
    figure
        Of matplotlib.
    box
        Left, bottom, width and height, as shares of the figure.
    scale
        What it says.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.ticker import FixedLocator, MaxNLocator

    colours = ScalarMappable(scale.norm(), scale.colours)
    bar = figure.colorbar(
        colours, cax=figure.add_axes(box), orientation="horizontal", extend=scale.extend, extendfrac=0.03
    )
    bar.set_label(scale.label, fontsize=SMALL, labelpad=1)
    ends = [scale.low, scale.low + round_up((scale.high - scale.low) / 6), scale.high]
    bar.ax.xaxis.set_major_locator(MaxNLocator(4) if scale.gamma == 1 else FixedLocator(ends))
    bar.ax.xaxis.set_major_formatter("{x:g}")
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL - 0.5, pad=1.5, length=2)
    bar.solids.set_rasterized(True)


def _bars(figure: Any, columns: Sequence[Column], width: float, height: float) -> None:
    c = 0
    while c < len(columns):
        scale, last = columns[c].cells[0].scale, c
        while scale is not None and last + 1 < len(columns) and columns[last + 1].cells[0].scale == scale:
            last += 1
        x, across = _LEFT + c * (width + _GAP), (last - c) * (width + _GAP) + width
        if scale is None:
            figure.text(x / WIDTH, (_FOOT - 0.1) / height, columns[c].words, fontsize=SMALL - 0.5, va="top")
        else:
            inset = 0.06 * across
            box = ((x + inset) / WIDTH, (_FOOT - 0.2) / height, (across - 2 * inset) / WIDTH, 0.11 / height)
            draw_bar(figure, box, scale)
        c = last + 1


def round_up(value: float) -> float:
    """Next of 1, 1.5, 2, 3, 5, 7.5, 10 times a power of ten: ends of scales that can be said in words."""
    if not np.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step for step in _LADDER if step * power >= value * (1 - 1e-9)) * power)


def percentile(values: Sequence[NDArray[Any]], share: float, default: float) -> float:
    """Percentile of everything finite in some arrays.

    Parameters
    ----------
    values
        Of any shapes.
    share
        0 to 100.
    default
        When nothing is finite.
    """
    flat = np.concatenate([np.ravel(v)[np.isfinite(np.ravel(v))] for v in values] or [np.zeros(0)])
    return float(np.percentile(flat, share)) if flat.size else default
