"""Charts as inline SVG: no script, text in the page's own font and colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from tofcapture.poses import Float64

WIDTH, HEIGHT, LEFT, BOTTOM, TOP, RIGHT = 560, 240, 52, 40, 12, 12
MOST_DOTS = 700  # dots of a scatter plot; medians use every point
POLAR = 240  # px, width and height of a polar plot


def scatter(
    x: Float64, y: Float64, x_words: str, y_words: str, limit: float, *, logarithmic: bool = False
) -> str:
    """Dots with the median and the quartiles of twelve bins of equal size.

    Parameters
    ----------
    x, y
        (N,).
    x_words, y_words
        Axes.
    limit
        The y axis runs from ``-limit`` to ``limit``; dots beyond are drawn at its ends.
    logarithmic
        Of the x axis.
    """
    if len(x) < 20:
        return ""
    place = np.log10(np.maximum(x, 1e-12)) if logarithmic else x
    low, high = float(np.quantile(place, 0.002)), float(np.quantile(place, 0.998))
    to_x, to_y = _axis(low, high, LEFT, WIDTH - RIGHT), _axis(-limit, limit, HEIGHT - BOTTOM, TOP)
    step = max(1, len(x) // MOST_DOTS)
    dots = "".join(
        f"M{to_x(np.clip(a, low, high)):.1f} {to_y(np.clip(b, -limit, limit)):.1f}h0"
        for a, b in zip(place[::step], y[::step], strict=True)
    )
    centre, q = binned(place, y, 12)
    band = [(to_x(a), to_y(b)) for a, b in zip(centre, q[:, 0], strict=True)]
    band += [(to_x(a), to_y(b)) for a, b in zip(centre[::-1], q[::-1, 2], strict=True)]
    line = [(to_x(a), to_y(b)) for a, b in zip(centre, q[:, 1], strict=True)]
    x_ticks = [(v, f"{10**v:.3g}" if logarithmic else f"{v:.2f}") for v in np.linspace(low, high, 6)]
    body = [f'<path class="dots" d="{dots}"/>', f'<polygon class="band" points="{_points(band)}"/>']
    body.append(f'<polyline class="curve curve0" points="{_points(line)}"/>')
    body += [f'<path class="zero" d="M{LEFT} {to_y(0.0):.1f}H{WIDTH - RIGHT}"/>']
    body += _ticks(x_ticks, _signed(limit), to_x, to_y, x_words, y_words)
    return _svg(WIDTH, HEIGHT, body, f"{y_words} over {x_words}")


def binned(x: Float64, y: Float64, bins: int) -> tuple[Float64, Float64]:
    """Centres (B,) and quartiles (B, 3) of ``y`` in bins of equal size along ``x``."""
    parts = [p for p in np.array_split(np.argsort(x, kind="stable"), bins) if len(p)]
    centres = np.array([np.median(x[p]) for p in parts])
    return centres, np.array([np.quantile(y[p], (0.25, 0.5, 0.75)) for p in parts])


def bars(names: Sequence[str], values: Sequence[float | None], good: Sequence[bool], words: str) -> str:
    """One bar per view; refused views are hollow."""
    finite = [v for v in values if v is not None]
    if not finite:
        return ""
    high = max(*finite, 1e-9) * 1.1
    to_y = _axis(0.0, high, HEIGHT - BOTTOM, TOP)
    pitch = (WIDTH - LEFT - RIGHT) / len(names)
    body = []
    for i, (name, value, kept) in enumerate(zip(names, values, good, strict=True)):
        x = LEFT + i * pitch
        if value is not None:
            y = to_y(value)
            body.append(
                f'<rect class="{"bar0" if kept else "bar1"}" x="{x + 0.15 * pitch:.1f}" y="{y:.1f}"'
                f' width="{0.7 * pitch:.1f}" height="{HEIGHT - BOTTOM - y:.1f}"/>'
            )
        if i % (len(names) // 16 + 1) == 0:
            body.append(
                f'<text x="{x + pitch / 2:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{escape(name)}</text>'
            )
    ticks = [(float(v), f"{v:.2g}") for v in np.linspace(0, high / 1.1, 4)]
    return _svg(WIDTH, HEIGHT, [*body, *_ticks([], ticks, None, to_y, "view", words)], words)


def heat(values: Float64, words: str, *, signed: bool, limit: float) -> str:
    """Grid of cells (rows, columns); NaN cells are hatched in grey. Signed values run from blue over white to orange."""
    rows, columns = values.shape
    size = (WIDTH - 20) / columns
    cells = []
    for r in range(rows):
        for c in range(columns):
            value = values[r, c]
            title = "none" if np.isnan(value) else f"{value:.3g}"
            fill = _colour(value, limit) if signed else _shade(value, limit)
            cells.append(
                f'<rect x="{10 + c * size:.1f}" y="{4 + r * size:.1f}" width="{size:.1f}" height="{size:.1f}" {fill}>'
                f"<title>{title}</title></rect>"
            )
    return _svg(WIDTH, int(rows * size) + 8, cells, words)


def polar(tilts: Sequence[float], leans: Sequence[float]) -> str:
    """Dot per view: distance from the centre is the tilt (rings at 15, 30, 45 deg), direction is where the board faces in the image."""
    half, per_degree = POLAR / 2, (POLAR / 2 - 14) / 50
    body = [f'<circle class="axis" cx="{half}" cy="{half}" r="{t * per_degree:.1f}"/>' for t in (15, 30, 45)]
    body += [f'<text x="{half + 3}" y="{half - t * per_degree - 2:.1f}">{t}°</text>' for t in (15, 30, 45)]
    for tilt, lean in zip(tilts, leans, strict=True):
        r, a = min(tilt, 50.0) * per_degree, np.radians(lean)
        body.append(
            f'<circle class="spot" cx="{half + r * np.cos(a):.1f}" cy="{half + r * np.sin(a):.1f}" r="5"/>'
        )
    return _svg(POLAR, POLAR, body, "tilts of the views")


def matrix(values: NDArray[np.floating], names: Sequence[str]) -> str:
    """Correlations (n, n) with their names and numbers."""
    size, edge = 62, 46
    body = []
    for i, name in enumerate(names):
        at = edge + (i + 0.5) * size
        body.append(f'<text x="{at}" y="{edge - 8}" text-anchor="middle">{escape(name)}</text>')
        body.append(f'<text x="{edge - 8}" y="{at + 4}" text-anchor="end">{escape(name)}</text>')
        for j in range(len(names)):
            x, y = edge + j * size, edge + i * size
            body.append(
                f'<rect x="{x}" y="{y}" width="{size}" height="{size}" {_colour(float(values[i, j]), 1.0)}/>'
            )
            body.append(
                f'<text x="{x + size / 2}" y="{y + size / 2 + 4}" text-anchor="middle" class="on">{values[i, j]:+.2f}</text>'
            )
    extent = edge + len(names) * size + 4
    return _svg(extent, extent, body, "correlations")


def _axis(low: float, high: float, start: float, stop: float) -> Callable[[float], float]:
    scale = (stop - start) / max(high - low, 1e-12)
    return lambda v: start + (float(v) - low) * scale


def _signed(limit: float) -> list[tuple[float, str]]:
    return [(float(v), f"{v:+.2g}") for v in np.linspace(-limit, limit, 5)]


def _ticks(
    x_ticks: Sequence[tuple[float, str]],
    y_ticks: Sequence[tuple[float, str]],
    to_x: Callable[[float], float] | None,
    to_y: Callable[[float], float],
    x_words: str,
    y_words: str,
) -> list[str]:
    floor = HEIGHT - BOTTOM
    out = [f'<path class="axis" d="M{LEFT} {TOP}V{floor}H{WIDTH - RIGHT}"/>']
    if to_x is not None:
        out += [
            f'<text x="{to_x(v):.1f}" y="{floor + 16}" text-anchor="middle">{t}</text>' for v, t in x_ticks
        ]
    out += [f'<text x="{LEFT - 6}" y="{to_y(v) + 4:.1f}" text-anchor="end">{t}</text>' for v, t in y_ticks]
    out.append(
        f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle">{escape(x_words)}</text>'
    )
    middle = (TOP + floor) / 2
    out.append(
        f'<text x="12" y="{middle}" text-anchor="middle" transform="rotate(-90 12 {middle})">{escape(y_words)}</text>'
    )
    return out


def _points(pairs: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pairs)


def _colour(value: float, limit: float) -> str:
    if np.isnan(value):
        return 'class="none"'
    t = float(np.clip(value / limit, -1, 1))
    end = np.array([213, 94, 0]) if t > 0 else np.array([0, 114, 178])
    red, green, blue = (np.array([245, 245, 245]) * (1 - abs(t)) + end * abs(t)).round().astype(int)
    return f'fill="rgb({red},{green},{blue})"'


def _shade(value: float, limit: float) -> str:
    if np.isnan(value) or value <= 0:
        return 'class="none"'
    return f'fill="#0072b2" fill-opacity="{0.15 + 0.85 * min(value / limit, 1.0):.2f}"'


def _svg(width: int, height: int, body: Sequence[str], words: str) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" aria-label="{escape(words, quote=True)}">'
        + "".join(body)
        + "</svg>"
    )
