"""A picture of a plan, from above and from the side: table, object, cameras, and what stood against the other candidates."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices.clearance import Stage
from tofcapture.poses import Float64, transform_points
from tofcapture.record.plan import FATES, REMEDIES, Plan, PlannedView
from tofcapture.rig import Rig

_SIZE, _MARGIN, _HEAD, _LEGEND = 560.0, 28.0, 56.0, 190.0  # px
_REACH = 0.12  # m; how long the pyramids are drawn
_DOTS = 1500  # refused candidates that are drawn, of what there are
_GRID = 0.5  # m
_COLUMN = 0.20  # m; the base and what must not come near it
_COLOURS = dict(
    zip(FATES, ("#9aa0a6", "#b5651d", "#d93025", "#7b1fa2", "#c2185b", "#5f6368", "#f9ab00"), strict=True)
)
_TURNS = ("#1a73e8", "#188038", "#e8710a", "#9334e6", "#d01884", "#12858d")


def plan_svg(plan: Plan, stage: Stage, rig: Rig, target: Float64, title: str) -> str:
    """Draw a plan.

    Parameters
    ----------
    plan, stage, rig
        What is drawn; :attr:`Plan.tried` gives the refused candidates, if it is there.
    target
        (3,) what the views look at, base frame, metres.
    title
        Stands above.

    Returns
    -------
    An SVG document: from above (x to the right, y up) and from the side (x to the right, z up), one scale.
    """
    low, high = _bounds(plan, stage, rig, target)
    above = _Panel((0, 1), low, high, _MARGIN)
    aside = _Panel((0, 2), low, high, 2 * _MARGIN + _SIZE)
    width, height = 3 * _MARGIN + 2 * _SIZE, _HEAD + _SIZE + _LEGEND
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" font-family="sans-serif" font-size="12">',
        f"<title>{escape(title)}</title><desc>{escape(plan.summary())}</desc>",
        '<rect width="100%" height="100%" fill="#fff"/>',
        _text(_MARGIN, 22, title, size=16),
        _text(_MARGIN, 44, f"from above: x right, y up; a grid line every {_GRID:g} m"),
        _text(2 * _MARGIN + _SIZE, 44, "from the side: x right, z up"),
    ]
    colours = _turn_colours(plan)
    for panel in (above, aside):
        parts += [panel.frame(), *_refused(plan, panel), *_stage(stage, target, panel)]
        parts.append(_way(plan.views, rig, panel))
        parts += [_view(view, rig, panel, colours[view.turn]) for view in plan.views]
    return "\n".join([*parts, *_legend(plan, colours), "</svg>\n"])


def _turn_colours(plan: Plan) -> dict[float, str]:
    """A colour for each turn of the object."""
    return {turn: _TURNS[n % len(_TURNS)] for n, turn in enumerate(sorted({v.turn for v in plan.views}))}


class _Panel:
    """Two axes of the base frame on the page."""

    def __init__(self, axes: tuple[int, int], low: Float64, high: Float64, left: float) -> None:
        self.axes, self.left = list(axes), left
        self.scale = _SIZE / float((high - low).max())
        self._middle = (low + high)[self.axes] / 2

    def at(self, points: Float64) -> Float64:
        """(..., 2) px of points (..., 3)."""
        flat = (np.asarray(points)[..., self.axes] - self._middle) * self.scale * [1, -1]
        out: Float64 = flat + np.array([self.left + _SIZE / 2, _HEAD + _SIZE / 2])
        return out

    def frame(self) -> str:
        """Border and grid."""
        box = f'x="{self.left:.0f}" y="{_HEAD:.0f}" width="{_SIZE:.0f}" height="{_SIZE:.0f}"'
        half = _SIZE / 2 / self.scale
        lines = []
        for axis in (0, 1):
            first = np.ceil((self._middle[axis] - half) / _GRID) * _GRID
            for value in np.arange(first, self._middle[axis] + half, _GRID):
                offset = (value - self._middle[axis]) * self.scale + _SIZE / 2
                if axis == 0:
                    lines.append(f"M{self.left + offset:.1f} {_HEAD:.0f}v{_SIZE:.0f}")
                else:
                    lines.append(f"M{self.left:.0f} {_HEAD + _SIZE - offset:.1f}h{_SIZE:.0f}")
        grid = f'<path d="{"".join(lines)}" stroke="#eceff1" fill="none"/>'
        return f'<g>{grid}<rect {box} fill="none" stroke="#bdc1c6"/></g>'


def _bounds(plan: Plan, stage: Stage, rig: Rig, target: Float64) -> tuple[Float64, Float64]:
    """Corners (3,) of what is drawn."""
    points = [np.zeros((1, 3)), target[None], np.array([[*target[:2], stage.table]])]
    points += [_eye(view, rig)[None] for view in plan.views]
    if plan.tried is not None:
        points.append(plan.tried.spots)
    all_ = np.concatenate(points)
    return all_.min(axis=0) - 0.15, all_.max(axis=0) + 0.15


def _eye(view: PlannedView, rig: Rig) -> Float64:
    out: Float64 = (view.T_base_flange @ rig.T_flange_tof)[:3, 3]
    return out


def _text(x: float, y: float, words: str, size: int = 12, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="#202124"{more}>{escape(words)}</text>'


def _stage(stage: Stage, target: Float64, panel: _Panel) -> list[str]:
    """Base, table, keep-out and target."""
    base, spot = panel.at(np.zeros(3)), panel.at(target)
    r, column = stage.keep_out_radius * panel.scale, _COLUMN * panel.scale
    middle = panel.at(np.array([*stage.target[:2], stage.table]))
    out = []
    if panel.axes == [0, 1]:
        out.append(
            f'<circle cx="{middle[0]:.1f}" cy="{middle[1]:.1f}" r="{r:.1f}" fill="#fce8e6" stroke="#d93025"/>'
        )
        out.append(
            f'<circle cx="{base[0]:.1f}" cy="{base[1]:.1f}" r="{column:.1f}" fill="#e8eaed" stroke="#5f6368"/>'
        )
    else:
        tall = stage.keep_out_height * panel.scale
        out.append(
            f'<rect x="{middle[0] - r:.1f}" y="{middle[1] - tall:.1f}" width="{2 * r:.1f}" height="{tall:.1f}" fill="#fce8e6" stroke="#d93025"/>'
        )
        out.append(
            f'<path d="M{panel.left:.1f} {middle[1]:.1f}h{_SIZE:.1f}" stroke="#795548" stroke-width="3"/>'
        )
        out.append(_text(panel.left + 6, middle[1] + 15, "table"))
        out.append(
            f'<rect x="{base[0] - column:.1f}" y="{base[1] - 6:.1f}" width="{2 * column:.1f}" height="12" fill="#e8eaed" stroke="#5f6368"/>'
        )
    out.append(_text(base[0] - 14, base[1] + 4, "base"))
    out.append(
        f'<path d="M{spot[0] - 6:.1f} {spot[1]:.1f}h12M{spot[0]:.1f} {spot[1] - 6:.1f}v12" stroke="#d93025" stroke-width="2"/>'
    )
    return out


def _refused(plan: Plan, panel: _Panel) -> list[str]:
    """One path of dots for each reason, thinned out evenly."""
    if plan.tried is None:
        return []
    lost = np.flatnonzero(plan.tried.fates >= 0)
    lost = lost[:: max(1, -(-len(lost) // _DOTS))]
    out = []
    for number, fate in enumerate(FATES):
        dots = panel.at(plan.tried.spots[lost[plan.tried.fates[lost] == number]])
        if len(dots):
            d = "".join(f"M{x:.0f} {y:.0f}h0" for x, y in dots)
            out.append(
                f'<path d="{d}" stroke="{_COLOURS[fate]}" stroke-width="3" stroke-linecap="round" opacity="0.45"/>'
            )
    return out


def _way(views: Sequence[PlannedView], rig: Rig, panel: _Panel) -> str:
    """The camera's travel, as the crow flies."""
    if not views:
        return ""
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in panel.at(np.stack([_eye(v, rig) for v in views])))
    return f'<polyline points="{points}" fill="none" stroke="#9aa0a6" stroke-dasharray="3 3"/>'


def _view(view: PlannedView, rig: Rig, panel: _Panel, colour: str) -> str:
    """One camera: its pyramid and its number."""
    T = view.T_base_flange @ rig.T_flange_tof
    corners = panel.at(transform_points(T, _corners(rig.tof)))
    x, y = panel.at(T[:3, 3])
    ring = "M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in corners) + "Z"
    rays = "".join(f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}" for u, v in corners)
    where = f"view {view.index}: {view.distance:.2f} m, object turned by {np.degrees(view.turn):.0f} deg"
    return (
        f'<g class="view" stroke="{colour}" fill="{colour}"><title>{where}</title>'
        f'<path d="{ring}{rays}" fill-opacity="0.15"/><circle cx="{x:.1f}" cy="{y:.1f}" r="2.5"/>'
        f'<text x="{x + 4:.1f}" y="{y - 4:.1f}" stroke="#fff" stroke-width="3" paint-order="stroke">{view.index}</text></g>'
    )


def _corners(camera: Camera) -> Float64:
    """(4, 3) corners of the image at :data:`_REACH`, ToF frame."""
    u = np.array([-0.5, camera.width - 0.5, camera.width - 0.5, -0.5])
    v = np.array([-0.5, -0.5, camera.height - 0.5, camera.height - 0.5])
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=1)
    out: Float64 = rays * _REACH
    return out


def _legend(plan: Plan, colours: dict[float, str]) -> list[str]:
    """How many, and what the colours mean."""
    y = _HEAD + _SIZE + 26
    out = [
        _text(_MARGIN, y, f"{len(plan.views)} of {plan.wanted} views; {plan.candidates} candidates", size=14)
    ]
    for n, (turn, colour) in enumerate(colours.items() if len(colours) > 1 else ()):
        x = 2 * _MARGIN + _SIZE + 150 * (n % 3)
        out.append(
            f'<rect x="{x:.0f}" y="{y + 12 + 20 * (n // 3):.0f}" width="10" height="10" fill="{colour}"/>'
        )
        out.append(_text(x + 16, y + 21 + 20 * (n // 3), f"turned by {np.degrees(turn):.0f} deg"))
    for n, (fate, count) in enumerate((f, c) for f, c in plan.refused.items() if c):
        row = y + 24 + 18 * n
        out.append(f'<circle cx="{_MARGIN + 5:.0f}" cy="{row - 4:.1f}" r="5" fill="{_COLOURS[fate]}"/>')
        out.append(_text(_MARGIN + 18, row, f"{count} {REMEDIES[fate][0]}"))
    return out
