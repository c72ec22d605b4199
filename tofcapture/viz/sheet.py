"""Draw rows and columns of pictures that share scales, 1200 pixels wide; contact sheets are such tables, a row a shot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.colours import GOOD, MASK, Scale, UInt8, palette
from tofcapture.viz.page import canvas, draw_bars, draw_rig, save
from tofcapture.viz.shots import Panel, Shot, Source, scales_of

NORMAL_KEY = ((None, "red right, green up,"), (None, "blue towards the camera"))
DEPTH_KEY = ((None, "dark near, bright far: see"), (None, "each picture; grey: none"))
WIDTH = 12.0  # inches: 1200 pixels
SMALL, FONT = 9.0, 11.0  # points at 100 dots an inch: 12 and 15 pixels
_HEAD, _FOOT, _GAP = 0.5, 0.72, 0.05  # inches
_LEFT = 0.3  # inches: names of rows
_MASK = [(GOOD[0], "good"), *((c, str(bit.name).lower().replace("_", " ")) for bit, (c, _) in MASK.items())]
_KEYS: Mapping[str, Any] = {"normals": NORMAL_KEY, "mask": _MASK, "depth": DEPTH_KEY}


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


def write_sheet(source: Source, path: Path, most: int, progress: Callable[[int, int], None]) -> int:
    """Write a contact sheet as PNG with at most so many shots, spread evenly; returns their number.

    ``progress`` is told how many shots of how many are read.
    """
    picked = source.spread(most)
    shots = []
    for done, i in enumerate(picked, start=1):
        shots.append(source.load(i))
        progress(done, len(picked))
    with canvas() as figure:
        if shots:
            _shots(figure, source, shots)
        else:
            _calibration(figure, source)
        save(figure, path, "png")
    return len(shots)


def _shots(figure: Any, source: Source, shots: list[Shot]) -> None:
    total = len(source.names)
    views = f"{total} views" if len(shots) == total else f"{len(shots)} of {total} views"
    shared = scales_of([panel for shot in shots for panel in shot.panels])
    columns = []
    for c in range(max(len(shot.panels) for shot in shots)):
        panels = [shot.panels[c] for shot in shots if c < len(shot.panels)]
        cells = [_cell(shot, shot.panels[c], shared) if c < len(shot.panels) else None for shot in shots]
        columns.append(Column(panels[0].title, cells, _KEYS.get(panels[0].kind, ())))
    height, width = shots[0].panels[0].values.shape[:2]
    draw_table(figure, f"{source.title}: {views}", [s.name for s in shots], columns, width / height)


def _cell(shot: Shot, panel: Panel, shared: Mapping[str, Scale]) -> Cell:
    """Paint a panel: depth on a scale of the shot's own that shows its object, all else on those of the sheet."""
    if panel.kind != "depth":
        return Cell(panel.paint(shared.get(panel.kind)), shared.get(panel.kind))
    scale = scales_of(shot.panels)["depth"]
    return Cell(panel.paint(scale), scale, scale.words)


def _calibration(figure: Any, source: Source) -> None:
    """Draw the cameras from two sides, and what each pair of clouds left over."""
    figure.set_size_inches(WIDTH, 5.2)
    figure.suptitle(source.title, x=0.01, y=0.98, ha="left", fontsize=FONT)
    said, rig = source.calibration, source.rig
    grid = figure.add_gridspec(
        1, 3, left=0.06, right=0.99, top=0.62, bottom=0.12, wspace=0.28, width_ratios=(1, 1, 1.6)
    )
    if rig is not None:
        for column, (across, along) in enumerate(((0, 2), (1, 2))):
            draw_rig(figure.add_subplot(grid[column]), rig, across, along)
    if said is not None:
        figure.text(0.01, 0.91, said.words, fontsize=SMALL, va="top")
    if said is not None and said.pairs:
        axes = figure.add_subplot(grid[2])
        names, rmse, accepted = zip(*said.pairs, strict=True)
        draw_bars(axes, names, [1e3 * r for r in rmse], accepted)
        axes.set_xlabel("view; hollow: not used")
        axes.set_ylabel("RMSE (mm)")
