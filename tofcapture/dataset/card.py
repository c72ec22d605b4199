"""The dataset's card (``README.md``), a datasheet of what the data tell, and its Croissant description."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from tofcapture.dataset.croissant import croissant
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import Manifest, manifest_path, object_of
from tofcapture.files.seal import sha256_of, write_text
from tofcapture.files.shard import ShardReader, scales_text

_FRONT = """\
---
pretty_name: {name}
task_categories:
- depth-estimation
tags:
- time-of-flight
- surface-normals
- robotics
---
"""
_SIMULATED = (
    "Simulated: nothing here was measured. A renderer played both cameras and the arm, with the noise and the errors of its "
    "models."
)
_MEASURED = "Recorded on a robot arm that carries both cameras."


def _error_line(gt: Mapping[str, Any] | None) -> str:
    if gt is None or gt["median_error_mm"] is None:
        return "Its error is not known from within: there is no truth to compare with."
    return (
        f"Against the simulator's truth: median {gt['median_error_mm']:.2f} mm, 99th percentile {gt['p99_error_mm']:.2f} mm "
        f"where the mask is 0, which covers {gt['coverage']:.0%} of the object's pixels."
    )


def _split_rows(manifest: Manifest) -> str:
    parts = {name: manifest.split(name) for name in SPLITS}
    return "\n".join(
        f"| {name} | {len(part)} | {sum(e.views for e in part.values())} |" for name, part in parts.items()
    )


def _good_share(shards: Mapping[str, Mapping[str, Any]], pixels: int) -> str:
    """Share of good ground-truth pixels, from what each shard's provenance counted."""
    views = [view for provenance in shards.values() for view in provenance.get("views", ())]
    if not views or not all(isinstance(v, dict) and "good_pixels" in v for v in views):
        return "An unknown share"
    return f"{sum(v['good_pixels'] for v in views) / (pixels * len(views)):.0%}"


def _size(dataset: Path, manifest: Manifest) -> str:
    total = sum((dataset / e.path).stat().st_size for e in manifest.scenes.values())
    return f"{total / 1e9:.2f} GB" if total > 1e8 else f"{total / 1e6:.2f} MB"


def _provenances(dataset: Path, manifest: Manifest) -> dict[str, Mapping[str, Any]]:
    out: dict[str, Mapping[str, Any]] = {}
    for name, entry in manifest.scenes.items():
        with ShardReader(dataset / entry.path, entry.sha256) as shard:
            out[name] = shard.provenance
    return out


def _of_first(dataset: Path, manifest: Manifest) -> dict[str, Any]:
    """What one shard tells of all: sensors, sizes, whether it was simulated."""
    entry = manifest.scenes[min(manifest.scenes)]
    with ShardReader(dataset / entry.path, entry.sha256) as shard:
        (H, W), (SH, SW) = shard.camera.shape, shard.rig.stereo.shape
        simulated = shard.truth(0) is not None
        megahertz = sorted({float(f) / 1e6 for f in shard.info.modulation_hz})
        return {
            "frames": shard.frames,
            "tof": shard.info.model,
            "stereo": shard.stereo_info.model,
            "K": len(shard.info.modulation_hz),
            "mhz": " and ".join(f"{f:g}" for f in megahertz),
            "H": H,
            "W": W,
            "SH": SH,
            "SW": SW,
            "first": entry.path,
            "scales": scales_text(shard.scales),
            "collection": _SIMULATED if simulated else _MEASURED,
            "truth": "\n- `/truth/*`: exact depth and normals at 2x, of the simulator." if simulated else "",
        }


def card_text(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> str:
    """Markdown of the card; the manifest is written, ``gt`` is a :meth:`TruthError.table`."""
    name, first = dataset.resolve().name, _of_first(dataset, manifest)
    facts = {
        "name": name,
        "views": sum(e.views for e in manifest.scenes.values()),
        "scenes": len(manifest.scenes),
        "things": len({object_of(s) for s in manifest.scenes}),
        "splits": _split_rows(manifest),
        "size": _size(dataset, manifest),
        "error": _error_line(gt),
        "good": _good_share(_provenances(dataset, manifest), 4 * first["H"] * first["W"]),
        "versions": ", ".join(f"{k} {v}" for k, v in sorted(manifest.versions.items())) or "unknown versions",
        "config": ", ".join(f"{k} = {v}" for k, v in sorted(manifest.config.items())) or "unknown",
        "manifest": sha256_of(manifest_path(dataset)),
    }
    sheet = files("tofcapture.dataset").joinpath("datasheet.md").read_text(encoding="utf-8")
    return _FRONT.format(name=name) + sheet.format(**first, **facts)


def write_card(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> None:
    """Write ``README.md`` and ``croissant.json`` beside the manifest; nothing for a dataset without scenes."""
    if not manifest.scenes:
        return
    write_text(dataset / "README.md", card_text(dataset, manifest, gt))
    write_text(dataset / "croissant.json", json.dumps(croissant(dataset, manifest), indent=1) + "\n")
