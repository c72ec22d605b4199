"""The dataset's card (``README.md``) and its Croissant description."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofcapture.files.layout import SHARD, SPLITS
from tofcapture.files.manifest import Manifest
from tofcapture.files.seal import write_text
from tofcapture.files.shard import ShardReader

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

_BODY = """\
# {name}

Raw time-of-flight phase images with stereo ground truth: {views} views of {scenes} scenes, {frames} ToF frames each.
ToF {tof} ({W} x {H}), stereo {stereo} ({SW} x {SH}). Lengths are metres.

| split | scenes | views |
|---|---|---|
{splits}

## Reading

```python
from tofcapture.files.shard import ShardReader

with ShardReader("{first}") as shard:
    raw = shard.raw(view=0, frame=0)          # phase images, the sensor's integers
    gt = shard.ground_truth(view=0, scale=2)  # depth, normals, mask; mask == 0 is good
```

Plain h5py opens the files as well; every dataset carries its `units` and `description`. `manifest.json` holds the splits
and the SHA-256 of every shard; `tofcapture check .` verifies all of it.

## Ground truth

Stereo points, aligned by averaged ICP, denoised, triangulated and ray-cast onto the ToF plane at 1x and 2x. The mask says
for each pixel why not to trust it (not hit, occluded for the stereo camera, grazing, at a depth edge, outside the object).
{error}

## Limits

Splits are by object. Black, transparent and mirroring surfaces have little or no ground truth; pixels without it are
marked, never filled.
"""


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


def card_text(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> str:
    """Markdown of the card; ``gt`` is a :meth:`TruthError.table`."""
    name = dataset.resolve().name
    first = manifest.scenes[min(manifest.scenes)]
    with ShardReader(dataset / first.path) as shard:
        (H, W), (SH, SW) = shard.camera.shape, shard.rig.stereo.shape
        body = _BODY.format(
            name=name,
            views=sum(e.views for e in manifest.scenes.values()),
            scenes=len(manifest.scenes),
            frames=shard.frames,
            tof=shard.info.model,
            stereo=shard.stereo_info.model,
            H=H,
            W=W,
            SH=SH,
            SW=SW,
            splits=_split_rows(manifest),
            first=first.path,
            error=_error_line(gt),
        )
    return _FRONT.format(name=name) + body


def croissant(dataset: Path, manifest: Manifest) -> dict[str, Any]:
    """Croissant 1.0 description: the shards as file objects with their digests."""
    files = [
        {
            "@type": "cr:FileObject",
            "@id": f"shard-{name}",
            "name": name,
            "description": f"{entry.views} views, split {entry.split}",
            "contentUrl": entry.path,
            "encodingFormat": "application/x-hdf5",
            "sha256": entry.sha256,
        }
        for name, entry in sorted(manifest.scenes.items())
    ]
    return {
        "@context": {
            "@language": "en",
            "@vocab": "https://schema.org/",
            "cr": "http://mlcommons.org/croissant/",
            "sc": "https://schema.org/",
            "conformsTo": "dct:conformsTo",
            "dct": "http://purl.org/dc/terms/",
        },
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.resolve().name,
        "description": f"Raw time-of-flight phase images with stereo ground truth ({SHARD.format} {SHARD.version}).",
        "distribution": files,
    }


def write_card(dataset: Path, manifest: Manifest, gt: Mapping[str, Any] | None) -> None:
    """Write ``README.md`` and ``croissant.json``; nothing for a dataset without scenes."""
    if not manifest.scenes:
        return
    write_text(dataset / "README.md", card_text(dataset, manifest, gt))
    write_text(dataset / "croissant.json", json.dumps(croissant(dataset, manifest), indent=1) + "\n")
