"""How a network was trained: its checkpoint's header, and the curve of ``metrics.jsonl`` beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config, dumps_config
from tofcapture_model.networks.zoo import Model
from tofcapture_model.training.checkpoint import find_model, load_model
from tofcapture_model.training.runlog import read_metrics

_WIDTH, _HEIGHT, _LEFT, _BOTTOM = 640, 220, 56, 34
_MOST = 400  # points of a curve


@dataclass(frozen=True)
class Network:
    """A loaded network and what its checkpoint says.

    Attributes
    ----------
    model, config, provenance
        From :func:`tofcapture_model.training.checkpoint.load_model`.
    name, sha256
        Of the file.
    parameters
        Number of weights.
    rows
        Lines of ``metrics.jsonl``; empty where there is none.
    bundled
        Whether it came with the installation.
    """

    model: Model
    config: Config
    provenance: Mapping[str, Any]
    name: str
    sha256: str
    parameters: int
    rows: list[dict[str, Any]]
    bundled: bool = False

    @property
    def config_text(self) -> str:
        """The resolved configuration as TOML."""
        return dumps_config(self.config)


@dataclass(frozen=True)
class Chart:
    """A curve chart: polylines as (stage, points), ticks as (position, text), in user units of width x height."""

    width: int
    height: int
    left: int
    bottom: int
    curves: list[tuple[str, str]]
    x_ticks: list[tuple[float, str]]
    y_ticks: list[tuple[float, str]]
    words: str


def load_network(weights: Path | None) -> tuple[Network | None, str]:
    """Load a network; where there is none, say so.

    Raises
    ------
    FormatError
        When the file is there and is not a checkpoint.
    """
    try:
        path = find_model(weights)
    except ConfigError as err:
        return None, f"{err.message}; {err.hint}"
    if not path.is_file():
        return None, f"there is no checkpoint at {path}"
    model, config, provenance = load_model(path)
    count = sum(p.numel() for p in model.parameters())
    rows = read_metrics(path.parent / "metrics.jsonl")
    return Network(model, config, provenance, path.name, sha256_of(path), count, rows, weights is None), ""


def loss_chart(rows: Sequence[Mapping[str, Any]]) -> Chart | None:
    """Loss against steps, one curve per stage, logarithmic; None with fewer than two points."""
    points = [
        (int(r["step"]), float(r["total"]), str(r.get("stage", "")))
        for r in rows
        if _positive(r.get("total"))
    ]
    if len(points) < 2:
        return None
    steps, losses = [p[0] for p in points], [math.log10(p[1]) for p in points]
    x = _axis(min(steps), max(steps), _LEFT, _WIDTH - 12)
    low, high = min(losses), max(losses)
    pad = max(0.05 * (high - low), 0.02)
    y = _axis(low - pad, high + pad, _HEIGHT - _BOTTOM, 10)
    curves = []
    for stage in dict.fromkeys(p[2] for p in points):
        chosen = _thinned([p for p in points if p[2] == stage])
        curves.append((stage, " ".join(f"{x(s):.1f},{y(math.log10(v)):.1f}" for s, v, _ in chosen)))
    y_ticks = [(round(y(t), 1), f"{10**t:.3g}") for t in (low, (low + high) / 2, high)]
    x_ticks = [
        (round(x(s), 1), str(s)) for s in sorted({min(steps), (min(steps) + max(steps)) // 2, max(steps)})
    ]
    words = f"from {points[0][1]:.3g} at step {points[0][0]} to {points[-1][1]:.3g} at step {points[-1][0]}"
    return Chart(_WIDTH, _HEIGHT, _LEFT, _BOTTOM, curves, x_ticks, y_ticks, words)


def _positive(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value) and value > 0


def _axis(low: float, high: float, start: float, end: float) -> Any:
    span = (high - low) or 1.0
    return lambda v: start + (v - low) / span * (end - start)


def _thinned(points: Sequence[Any]) -> Sequence[Any]:
    step = max(1, len(points) // _MOST)
    return [*points[:-1:step], points[-1]]


def validations(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str, str]]:
    """(step, stage, MAE in mm, mean angle in degrees) of every validation, as text."""
    return [
        (str(r["step"]), str(r.get("stage", "")), f"{1e3 * r['val_mae']:.2f}", f"{r['val_angle_deg']:.2f}")
        for r in rows
        if _positive(r.get("val_mae")) and _positive(r.get("val_angle_deg"))
    ]
