"""Tell which cameras and which light a network has learned from, and what of a frame lies outside of that.

A checkpoint remembers it as ``seen``: the frequencies of every camera, and the range of image sizes, fields of view and
brightness. Brightness is a frame's median amplitude of the highest frequency over the count at which the sensor saturates.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.channels import frequencies
from tofcapture_model.data import FrameDataset

Seen = Mapping[str, Any]
_FRAMES = 24  # that are looked at for their brightness
_ALIKE = 0.02  # share by which a frequency may differ
_MANY = 8  # sets of frequencies, of one number, between which others are known as well
_BEYOND = {"rows": 1.5, "columns": 1.5, "field_of_view_deg": 1.15, "brightness": 2.0}
_WORDS = {"rows": "rows", "columns": "columns", "field_of_view_deg": "degrees of view", "brightness": "of saturation in brightness"}  # fmt: skip
"""Factor beyond the range that is still taken for the same, and what a number is called."""


def seen_by(data: FrameDataset, before: Seen | None = None) -> dict[str, Any]:
    """Collect what a training learns from, together with what its first weights had ``before``."""
    modulation = {frequencies(reader.info.modulation_hz) for reader in data.readers.values()}
    rows = [_camera(reader.camera) for reader in data.readers.values()]
    some = data.samples[:: math.ceil(len(data.samples) / _FRAMES)]
    for frame in map(data.frame, some):
        there = frame.valid > 0
        if there.any():
            rows.append({"brightness": round(float(frame.confidence[there].median()), 4)})
    found: dict[str, Any] = {}
    for name in _BEYOND:
        values = [row[name] for row in rows if name in row] + list((before or {}).get(name, ()))
        if values:
            found[name] = [min(values), max(values)]
    modulation |= {tuple(hz) for hz in (before or {}).get("modulation_hz", ())}
    return {**found, "modulation_hz": sorted(map(list, modulation))}


def _camera(camera: Camera) -> dict[str, float]:
    width, height = camera.shape[1], camera.shape[0]
    view = math.degrees(2 * math.atan(width / (2 * camera.fx)))
    return {"rows": height, "columns": width, "field_of_view_deg": round(view, 2)}


def outside(seen: Seen | None, modulation_hz: tuple[float, ...], camera: Camera, brightness: float) -> str:
    """Say what of a frame a network has not seen in training; nothing where all is known, or the checkpoint does not tell."""
    if not seen:
        return ""
    said, known = [], [tuple(hz) for hz in seen.get("modulation_hz", ())]
    asked = frequencies(modulation_hz)
    alike = [hz for hz in known if len(hz) == len(asked)]
    if len(alike) >= _MANY:  # so many cameras that others between them are no strangers
        low, high = min(map(min, alike)) / (1 + _ALIKE), max(map(max, alike)) * (1 + _ALIKE)
        if not low <= min(asked) <= max(asked) <= high:
            said.append(f"{_megahertz(asked)} MHz instead of {low / 1e6:.3g} to {high / 1e6:.3g}")
    elif known and not any(np.allclose(hz, asked, rtol=_ALIKE, atol=0) for hz in alike):
        instead = " or ".join(map(_megahertz, known[:_MANY]))
        said.append(f"{_megahertz(asked)} MHz instead of {instead}")
    values = {**_camera(camera), "brightness": brightness}
    for name, factor in _BEYOND.items():
        low, high = seen.get(name, (0.0, math.inf))
        if math.isfinite(values[name]) and not low / factor <= values[name] <= high * factor:
            said.append(f"{values[name]:.3g} {_WORDS[name]} instead of {low:.3g} to {high:.3g}")
    return "; ".join(said)


def _megahertz(hz: tuple[float, ...]) -> str:
    return "/".join(f"{f / 1e6:g}" for f in hz)
