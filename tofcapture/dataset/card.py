"""The dataset's card (``README.md``), a datasheet of what the data tell, and its Croissant 1.0 description (JSON-LD)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from tofcapture.dataset.sample import error_in_words
from tofcapture.files.layout import SHARD, SPLITS
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
_CROISSANT = "http://mlcommons.org/croissant/"
# The context that the specification prints; validators compare with it.
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": _CROISSANT,
    "rai": f"{_CROISSANT}RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
} | {
    name: f"cr:{name}"
    for name in [
        "citeAs",
        "column",
        "extract",
        "field",
        "fileProperty",
        "fileObject",
        "fileSet",
        "format",
        "includes",
        "isLiveDataset",
        "jsonPath",
        "key",
        "md5",
        "parentField",
        "path",
        "recordSet",
        "references",
        "regex",
        "repeated",
        "replace",
        "separator",
        "source",
        "subField",
        "transform",
    ]
}


def write_card(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> None:
    """Write ``README.md`` and ``croissant.json`` beside the manifest; nothing for a dataset without scenes."""
    if not manifest.scenes:
        return
    write_text(dataset / "README.md", card_text(dataset, manifest, gt))
    write_text(dataset / "croissant.json", json.dumps(croissant(dataset, manifest), indent=1) + "\n")


def card_text(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> str:
    """Write the card as Markdown; the manifest is written, ``gt`` is a :meth:`TruthError.table`."""
    name, first = dataset.resolve().name, _of_first(dataset, manifest)
    total = sum((dataset / e.path).stat().st_size for e in manifest.scenes.values())
    facts = {
        "name": name,
        "views": sum(e.views for e in manifest.scenes.values()),
        "scenes": len(manifest.scenes),
        "things": len({object_of(s) for s in manifest.scenes}),
        "splits": _split_rows(manifest),
        "size": f"{total / 1e9:.2f} GB" if total > 1e8 else f"{total / 1e6:.2f} MB",
        "error": _error_line(gt),
        "good": _good_share(dataset, manifest, 4 * first["H"] * first["W"]),
        "versions": ", ".join(f"{k} {v}" for k, v in sorted(manifest.versions.items())) or "unknown versions",
        "config": ", ".join(f"{k} = {v}" for k, v in sorted(manifest.config.items())) or "unknown",
        "manifest": sha256_of(manifest_path(dataset)),
    }
    sheet = files("tofcapture.dataset").joinpath("datasheet.md").read_text(encoding="utf-8")
    return _FRONT.format(name=name) + sheet.format(**first, **facts)


def _error_line(gt: Mapping[str, Any] | None) -> str:
    if gt is None or gt["median_error_mm"] is None:
        return "Its error is not known from within: there is no truth to compare with."
    return f"Against the simulator's truth, where the mask is 0: {error_in_words(gt)}."


def _split_rows(manifest: Manifest) -> str:
    parts = {name: manifest.split(name) for name in SPLITS}
    return "\n".join(
        f"| {name} | {len(part)} | {sum(e.views for e in part.values())} |" for name, part in parts.items()
    )


def _good_share(dataset: Path, manifest: Manifest, pixels: int) -> str:
    """Share of good ground-truth pixels, from what each shard's provenance counted."""
    views: list[Any] = []
    for entry in manifest.scenes.values():
        with ShardReader(dataset / entry.path, entry.sha256) as shard:
            views += shard.provenance.get("views", ())
    if not views:
        return "An unknown share"
    return f"{sum(v['good_pixels'] for v in views) / (pixels * len(views)):.0%}"


def _of_first(dataset: Path, manifest: Manifest) -> dict[str, Any]:
    """Tell what one shard tells of all: sensors, sizes, whether it was simulated."""
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


def croissant(dataset: Path, manifest: Manifest) -> dict[str, Any]:
    """Describe a dataset whose manifest is written.

    Returns JSON-LD: the manifest and every shard as file objects with their SHA-256, the splits and their
    scenes as a record set. What the data do not tell (licence, authors, citation) is left out, never
    invented. Croissant has no reader for HDF5, so arrays are not fields; ``docs/formats.md`` describes them.
    """
    about = "Raw time-of-flight phase images with stereo ground truth"
    first = manifest.scenes[min(manifest.scenes)]
    with ShardReader(dataset / first.path, first.sha256) as shard:
        if 4 in shard.scales:
            about += f" at {scales_text(shard.scales)}"
    scenes = sorted(manifest.scenes.items())
    said = "splits, and the digest of every shard and of itself"
    digest = sha256_of(manifest_path(dataset))
    listed = [_file("manifest", "manifest.json", said, "manifest.json", "application/json", digest)]
    for name, e in scenes:
        said = f"{e.views} views, split {e.split}"
        listed.append(_file(f"shard-{name}", name, said, e.path, "application/x-hdf5", e.sha256))
    kinds = {"name": "sc:Text", "split": "sc:Text", "views": "sc:Integer", "shard": "sc:Text"}
    records = {
        "@type": "cr:RecordSet",
        "@id": "scenes",
        "name": "scenes",
        "description": "one row per scene",
        "key": {"@id": "scenes/name"},
        "field": [
            {"@type": "cr:Field", "@id": f"scenes/{name}", "name": f"scenes/{name}", "dataType": kind}
            for name, kind in kinds.items()
        ],
        "data": [
            {"scenes/name": n, "scenes/split": e.split, "scenes/views": e.views, "scenes/shard": e.path}
            for n, e in scenes
        ],
    }
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": f"{_CROISSANT}1.0",
        "name": dataset.resolve().name,
        "description": f"{about} ({SHARD.format} {SHARD.version}).",
        "keywords": ["time-of-flight", "depth", "surface normals"],
        "distribution": listed,
        "recordSet": [records],
    }


def _file(identity: str, name: str, description: str, path: str, mime: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": identity,
        "name": name,
        "description": description,
        "contentUrl": path,
        "encodingFormat": mime,
        "sha256": sha256,
    }
