"""Draw a contact sheet, 1200 pixels wide: one row a shot, or what a calibration says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tofcapture.colours import GOOD, MASK, Scale
from tofcapture.viz.charts import canvas, draw_bars, draw_rig, save
from tofcapture.viz.shots import Panel, Shot, Source, scales_of
from tofcapture.viz.table import DEPTH_KEY, FONT, NORMAL_KEY, SMALL, WIDTH, Cell, Column, draw_table

_MASK = [(GOOD[0], "good"), *((c, str(bit.name).lower().replace("_", " ")) for bit, (c, _) in MASK.items())]
_KEYS: Mapping[str, Any] = {"normals": NORMAL_KEY, "mask": _MASK, "depth": DEPTH_KEY}


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
    return Cell(panel.paint(scale), scale, f"{scale.low:.2f} to {scale.high:.2f} m")


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
