"""A contact sheet: one row a shot, drawn by matplotlib, 1200 pixels wide at least."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.files.seal import replacing
from tofcapture.poses import transform_points
from tofcapture.rig import Rig
from tofcapture.viz.colours import GOOD, MASK, limits, paint
from tofcapture.viz.shots import Panel, Shot, Source

_DPI = 100
_WIDTH = 12.0  # inches: 1200 pixels
_ROW, _HEAD, _FOOT = 1.75, 0.62, 0.85  # inches
_SMALL, _FONT = 8.5, 10  # points at 100 dots an inch: 12 and 14 pixels


def write_sheet(source: Source, path: Path, most: int, progress: Callable[[int, int], None]) -> int:
    """Write a contact sheet as PNG.

    Parameters
    ----------
    source
        What to show.
    path
        Of the PNG; replaced when it exists.
    most
        Largest number of shots; more are thinned out evenly.
    progress
        Told how many shots of how many are read.

    Returns
    -------
    Number of shots on it.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    picked = source.spread(most)
    shots = []
    for done, i in enumerate(picked, start=1):
        shots.append(source.load(i))
        progress(done, len(picked))
    figure = Figure(dpi=_DPI, layout=None)
    FigureCanvasAgg(figure)
    if shots:
        _shots(figure, source, shots)
    else:
        _calibration(figure, source)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=_DPI, format="png", metadata={"Software": None})
    return len(shots)


def _scales(shots: list[Shot]) -> dict[str, tuple[float, float]]:
    """All panels of a kind share one scale, so that rows can be compared."""
    panels = [p for shot in shots for p in shot.panels]
    kinds = {p.kind for p in panels} - {"normals", "mask"}
    return {kind: limits([p for p in panels if p.kind == kind]) for kind in kinds}


def _shots(figure: Any, source: Source, shots: list[Shot]) -> None:
    columns, rows = max(len(s.panels) for s in shots), len(shots)
    height = _HEAD + rows * _ROW + _FOOT
    figure.set_size_inches(_WIDTH, height)
    figure.suptitle(
        _heading(source, rows), x=0.01, y=1 - 0.1 / height, ha="left", va="top", fontsize=_FONT + 2
    )
    grid = figure.add_gridspec(
        rows,
        columns,
        left=0.035,
        right=0.995,
        top=1 - _HEAD / height,
        bottom=_FOOT / height,
        wspace=0.04,
        hspace=0.06,
    )
    scales = _scales(shots)
    for r, shot in enumerate(shots):
        for c, panel in enumerate(shot.panels):
            axes = figure.add_subplot(grid[r, c])
            _picture(axes, panel, scales.get(panel.kind, (0.0, 1.0)))
            if c == 0:
                axes.set_ylabel(shot.name, fontsize=_SMALL)
            if r == 0:
                axes.set_title(panel.title, fontsize=_SMALL, pad=4)
            if r == rows - 1:
                _legend(figure, axes, panel, scales.get(panel.kind, (0.0, 1.0)), height)


def _heading(source: Source, shown: int) -> str:
    total = len(source.names)
    return f"{source.title}: {total} views" if shown == total else f"{source.title}: {shown} of {total} views"


def _picture(axes: Any, panel: Panel, scale: tuple[float, float]) -> None:
    axes.imshow(paint(panel, *scale).image, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_visible(False)


def _legend(figure: Any, axes: Any, panel: Panel, scale: tuple[float, float], height: float) -> None:
    """Draw a colour bar with its unit, or words for colours, below the last row."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    box = axes.get_position()
    painted = paint(panel, *scale)
    if painted.colours:
        bar = figure.add_axes((box.x0 + 0.004, 0.52 / height, box.width - 0.008, 0.12 / height))
        drawn = figure.colorbar(
            ScalarMappable(Normalize(*scale), painted.colours), cax=bar, orientation="horizontal"
        )
        drawn.set_label(f"{painted.unit}; grey: none", fontsize=_SMALL, labelpad=2)
        drawn.ax.locator_params(nbins=4)
        drawn.ax.tick_params(labelsize=_SMALL, pad=2)
    elif panel.kind == "mask":
        _mask_words(figure, box, height)
    else:
        text = "red right, green up,\nblue towards the camera"
        figure.text(box.x0, 0.66 / height, text, fontsize=_SMALL, va="top")


def _mask_words(figure: Any, box: Any, height: float) -> None:
    colours = {"good": GOOD, **{str(bit.name).lower().replace("_", " "): c for bit, c in MASK.items()}}
    for i, (word, colour) in enumerate(colours.items()):
        x, y = box.x0 + (i % 2) * box.width / 2, (0.66 - 0.17 * (i // 2)) / height
        paint_box = {"facecolor": np.array(colour) / 255, "edgecolor": "0.5", "boxstyle": "square,pad=0.15"}
        figure.text(x + 0.004, y, "  ", fontsize=5, va="top", bbox=paint_box)
        figure.text(x + 0.015, y, word, fontsize=_SMALL - 0.5, va="top")


def _calibration(figure: Any, source: Source) -> None:
    """Draw the cameras from two sides, and what each pair of clouds left over."""
    figure.set_size_inches(_WIDTH, 5.2)
    figure.suptitle(source.title, x=0.01, y=0.98, ha="left", fontsize=_FONT + 2)
    said, rig = source.calibration, source.rig
    if said is not None:
        figure.text(0.01, 0.9, said.words, fontsize=_SMALL, va="top")
    grid = figure.add_gridspec(
        1, 3, left=0.06, right=0.99, top=0.66, bottom=0.12, wspace=0.28, width_ratios=(1, 1, 1.6)
    )
    if rig is not None:
        for column, (across, along) in enumerate(((0, 2), (1, 2))):
            _side(figure.add_subplot(grid[column]), rig, across, along)
    if said is not None and said.pairs:
        _bars(figure.add_subplot(grid[2]), said.pairs)


def _side(axes: Any, rig: Rig, across: int, along: int) -> None:
    """Both cameras' axes in the ToF frame, seen along the third axis."""
    for name, T, colour in (("ToF", np.eye(4), "#e69f00"), ("stereo", rig.T_tof_stereo, "#0072b2")):
        corners = 0.1 * np.array([[-0.5, -0.4, 1], [0, 0, 0], [0.5, 0.4, 1]])
        drawn = 1e3 * transform_points(T, corners)
        axes.plot(drawn[:, across], drawn[:, along], color=colour, lw=2)
        axes.annotate(
            name,
            drawn[1][[across, along]],
            xytext=(4, -12),
            textcoords="offset points",
            fontsize=_SMALL,
            color=colour,
        )
    axes.set_xlabel(f"{'xyz'[across]} (mm)", fontsize=_SMALL)
    axes.set_ylabel(f"{'xyz'[along]}, ToF frame (mm)", fontsize=_SMALL)
    axes.set_aspect("equal", adjustable="datalim")
    axes.tick_params(labelsize=_SMALL)
    axes.grid(alpha=0.3)


def _bars(axes: Any, pairs: Any) -> None:
    names, rmse, accepted = zip(*pairs, strict=True)
    bars = axes.bar(
        range(len(names)),
        1e3 * np.array(rmse),
        color=["#0072b2" if a else "white" for a in accepted],
        edgecolor="#0072b2",
    )
    for bar, ok in zip(bars, accepted, strict=True):
        bar.set_hatch("" if ok else "///")
    axes.set_xticks(range(len(names)), names, fontsize=_SMALL)
    axes.set_xlabel("view; hatched: not used", fontsize=_SMALL)
    axes.set_ylabel("RMSE (mm)", fontsize=_SMALL)
    axes.tick_params(labelsize=_SMALL)
