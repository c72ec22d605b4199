"""Draw a plan from above and from the side: table, object, cameras, and what stood against the other candidates."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices.clearance import COLUMN, Workcell
from tofcapture.files.seal import write_text
from tofcapture.poses import Float64, transform_points
from tofcapture.record.plan import REMEDIES, Plan, PlannedView
from tofcapture.rig import Rig
from tofcapture.viz.page import LINES, canvas, frustum, svg_text

_REACH = 0.12  # m; how long the pyramids are drawn
_DOTS = 1500  # refused candidates that are drawn, of what there are
_RED, _PINK, _GREY = "#d93025", "#fce8e6", "#5f6368"
_REASONS = ("#9aa0a6", "#b5651d", "#d93025", "#7b1fa2", "#c2185b", "#5f6368", "#188038", "#f9ab00")
_SIDES = (((0, 1), "from above"), ((0, 2), "from the side"))


def write_plan(plan: Plan, workcell: Workcell, rig: Rig, target: Float64, title: str, out: Path) -> None:
    """Draw a plan as SVG: from above (x, y) and from the side (x, z) in the base frame, at one scale.

    The views look at ``target`` (3,), base frame, metres. The file is replaced when it exists.
    """
    low, high = _bounds(plan, workcell, rig, target)
    middle, reach = (low + high) / 2, float((high - low).max()) / 2
    turns = sorted({view.turn for view in plan.views})
    colours = {turn: LINES[n % len(LINES)] for n, turn in enumerate(turns)}
    with canvas() as figure:
        figure.set_size_inches(12, 7.6)
        figure.suptitle(f"{title}; {plan.summary()}", x=0.01, y=0.985, ha="left", fontsize=11)
        for column, (axes_of, words) in enumerate(_SIDES):
            axes = figure.add_axes((0.05 + 0.5 * column, 0.19, 0.44, 0.44 * 12 / 7.6))
            shown = list(axes_of)
            axes.set_title(words, fontsize=9)
            axes.set_xlim(*(middle[0] + [-reach, reach]))
            axes.set_ylim(*(middle[shown[1]] + [-reach, reach]))
            axes.set_xlabel("x (m)")
            axes.set_ylabel(f"{'xyz'[shown[1]]} (m)")
            axes.grid(alpha=0.3)
            _draw_refused(axes, plan, shown)
            (_draw_above if column == 0 else _draw_side)(axes, workcell)
            axes.plot(*target[shown], "+", color=_RED, ms=11, mew=2)
            if plan.views:
                way = np.stack([_pose(view, rig)[:3, 3] for view in plan.views])
                axes.plot(*way[:, shown].T, color=_REASONS[0], ls=":", lw=1)
            for view in plan.views:
                _draw_view(axes, view, rig, shown, colours[view.turn])
        _draw_legend(figure, plan, colours)
        write_text(out, _titled(svg_text(figure), plan))


def _pose(view: PlannedView, rig: Rig) -> Float64:
    return view.T_base_flange @ rig.T_flange_tof


def _bounds(plan: Plan, workcell: Workcell, rig: Rig, target: Float64) -> tuple[Float64, Float64]:
    """Corners (3,) of what is drawn."""
    points = [np.zeros((1, 3)), target[None], np.array([[*target[:2], workcell.table]])]
    points += [_pose(view, rig)[None, :3, 3] for view in plan.views]
    points += [] if plan.tried is None else [plan.tried.spots]
    every = np.concatenate(points)
    return every.min(axis=0) - 0.15, every.max(axis=0) + 0.15


def _draw_above(axes: Any, workcell: Workcell) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(
        Circle((workcell.target[0], workcell.target[1]), workcell.keep_out_radius, fc=_PINK, ec=_RED)
    )
    axes.add_patch(Circle((0, 0), COLUMN, fc="#e8eaed", ec=_GREY))
    axes.text(0, 0, "base", ha="center", va="center")


def _draw_side(axes: Any, workcell: Workcell) -> None:
    from matplotlib.patches import Rectangle

    r = workcell.keep_out_radius
    keep_out = Rectangle(
        (workcell.target[0] - r, workcell.table), 2 * r, workcell.keep_out_height, fc=_PINK, ec=_RED
    )
    axes.add_patch(keep_out)
    axes.add_patch(Rectangle((-COLUMN, -0.02), 2 * COLUMN, 0.04, fc="#e8eaed", ec=_GREY))
    axes.text(0, 0.03, "base", ha="center")
    axes.axhline(workcell.table, color="#795548", lw=2.5)
    axes.text(axes.get_xlim()[0], workcell.table, " table", va="top")


def _draw_refused(axes: Any, plan: Plan, shown: list[int]) -> None:
    """Draw a dot in the colour of its reason for each refused candidate, thinned out evenly."""
    if plan.tried is None:
        return
    lost = np.flatnonzero(plan.tried.refusal >= 0)
    lost = lost[:: max(1, -(-len(lost) // _DOTS))]
    for number, colour in enumerate(_REASONS):
        spots = plan.tried.spots[lost[plan.tried.refusal[lost] == number]]
        axes.plot(*spots[:, shown].T, "o", color=colour, ms=2.5, mew=0, alpha=0.45, rasterized=True)


def _draw_view(axes: Any, view: PlannedView, rig: Rig, shown: list[int], colour: str) -> None:
    """Draw one camera: its pyramid and its number."""
    corners = transform_points(_pose(view, rig), frustum(rig.tof, _REACH))[:, shown]
    axes.fill(*corners.T, fc=colour, ec=colour, alpha=0.15)
    axes.plot(*corners.T, color=colour, lw=0.8, gid=f"view-{view.index}")
    box = {"fc": "white", "ec": "none", "alpha": 0.6, "pad": 0.5}
    axes.annotate(
        f"{view.index}", corners[0], xytext=(3, 3), textcoords="offset points", color=colour, bbox=box
    )


def _draw_legend(figure: Any, plan: Plan, colours: dict[float, str]) -> None:
    """Say how many candidates each reason refused, and which turn has which colour."""
    rows = [
        (f"{count} {REMEDIES[reason][0]}", colour, "o")
        for (reason, count), colour in zip(plan.refused.items(), _REASONS, strict=True)
        if count
    ]
    turned = [(f"object turned by {np.degrees(turn):.0f} deg", c, "s") for turn, c in colours.items()]
    from matplotlib.lines import Line2D

    for place, entries in ((0.04, rows), (0.66, turned if len(turned) > 1 else [])):
        keys = [Line2D([], [], ls="", marker=marker, color=colour) for _, colour, marker in entries]
        words = [words for words, _, _ in entries]
        if keys:
            figure.legend(keys, words, loc="upper left", bbox_to_anchor=(place, 0.13), ncols=2, frameon=False)


def _titled(svg: str, plan: Plan) -> str:
    """Give every view a title, which browsers show under the pointer."""
    titles = {
        f"view-{v.index}": f"view {v.index}: {v.distance:.2f} m, object turned by {np.degrees(v.turn):.0f} deg"
        + ("" if np.isnan(v.coverage) else f", {v.coverage:.0%} of it covered")
        for v in plan.views
    }
    return re.sub(r'<g id="(view-\d+)">', lambda m: f'<g class="view"><title>{titles[m[1]]}</title>', svg)
