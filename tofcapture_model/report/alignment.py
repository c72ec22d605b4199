"""``evidence.json`` as a table and a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from statistics import median
from typing import Any

PASS, WARN, FAIL = "PASS", "WARN", "FAIL"


@dataclass(frozen=True)
class Check:
    """One judged number: what it is, its value and limits as text, PASS, WARN or FAIL."""

    words: str
    value: str
    limits: str
    verdict: str


@dataclass(frozen=True)
class PairRow:
    """One calibration view as text; ``accepted`` is the gate's answer."""

    view: str
    accepted: bool
    reason: str
    cells: list[str]


@dataclass(frozen=True)
class Alignment:
    """What the page says of the alignment.

    Attributes
    ----------
    verdict
        The worst of the checks.
    used, summary
        How many views it stands on, short and as a sentence.
    checks, pairs
        Tables.
    """

    verdict: str
    used: str
    summary: str
    checks: list[Check]
    pairs: list[PairRow]


def alignment(evidence: Mapping[str, Any]) -> Alignment:
    """Judge an ``evidence.json``."""
    checks = _checks(evidence)
    verdict = max((c.verdict for c in checks), key=[PASS, WARN, FAIL].index)
    used = f"{evidence['used']} of {evidence['views']} board views"
    summary = f"{used} used, registered with {evidence['backend']}."
    return Alignment(verdict, used, summary, checks, [_pair(p) for p in evidence["pairs"]])


def _checks(evidence: Mapping[str, Any]) -> list[Check]:
    error, spread, truth = evidence["standard_error"], evidence["spread"], evidence.get("truth")
    residuals = [p["rmse_mm"] for p in evidence["pairs"] if p["accepted"] and p["rmse_mm"] is not None]
    checks = [
        _more("board views used", evidence["used"], 8, 3, ""),
        _less("median residual of the used views", median(residuals) if residuals else None, 4.0, 5.0, "mm"),
        _less("spread of the views, rotation", spread["rotation_deg"], 0.15, 0.5, "deg"),
        _less("spread of the views, translation", spread["translation_mm"], 1.5, 5.0, "mm"),
        _less("standard error of the mean, rotation", error["rotation_deg"], 0.05, 0.2, "deg"),
        _less("standard error of the mean, translation", error["translation_mm"], 0.5, 2.0, "mm"),
    ]
    if truth:
        checks += [
            _less("against the true rig, rotation", truth["rotation_error_deg"], 0.1, 0.3, "deg"),
            _less("against the true rig, a point at 0.8 m", truth["translation_error_mm"], 1.0, 3.0, "mm"),
        ]
    return checks


def _less(words: str, value: float | None, good: float, bearable: float, unit: str) -> Check:
    limits = f"PASS to {good:g}, WARN to {bearable:g} {unit}"
    if value is None:
        return Check(words, "–", limits, FAIL)
    return Check(
        words, f"{value:.3f} {unit}", limits, PASS if value <= good else WARN if value <= bearable else FAIL
    )


def _more(words: str, value: float, good: float, bearable: float, unit: str) -> Check:
    verdict = PASS if value >= good else WARN if value >= bearable else FAIL
    return Check(words, f"{value:g} {unit}".strip(), f"PASS from {good:g}, WARN from {bearable:g}", verdict)


def _pair(pair: Mapping[str, Any]) -> PairRow:
    cells = [
        _number(pair["rmse_mm"], 2),
        f"{pair['inliers']}",
        _number(100 * pair["fitness"], 0),
        _number(pair["condition"], 0),
        _number(pair["rotation_from_mean_deg"], 3),
        _number(pair["translation_from_mean_mm"], 2),
    ]
    return PairRow(PurePath(pair["view"]).stem, bool(pair["accepted"]), pair["reason"] or "–", cells)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
