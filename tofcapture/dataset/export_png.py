"""Depth as 16-bit PNG, as most depth datasets come: ToF at 1x, ground truth and mask at 2x."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import DataError
from tofcapture.files.png import png_bytes
from tofcapture.files.seal import replacing, write_text
from tofcapture.files.shard import ShardReader

LARGEST = 65535
_UP = 2  # PNG's filter: the difference to the row above, which suits smooth surfaces


def quantise(depth: NDArray[np.floating], unit: float, where: str) -> NDArray[np.uint16]:
    """Depth (H, W), metres, as whole steps of ``unit``; 0 is none.

    Raises
    ------
    DataError
        A depth does not fit.
    """
    known = np.isfinite(depth)
    steps = np.rint(np.where(known, depth, 0.0).astype(np.float64) / unit)
    if steps.max(initial=0) > LARGEST or (known & (steps < 1)).any():
        raise DataError(
            f"{where}: expected depth from {unit:g} to {LARGEST * unit:g} m in steps of {unit:g} m, "
            f"got {np.nanmin(depth):g} to {np.nanmax(depth):g} m",
            hint="--unit 0.001",
        )
    return steps.astype(np.uint16)


def export_png(shard: ShardReader, folder: Path, unit: float) -> list[Path]:
    """Write ``tof-003.png``, ``depth-003.png`` and ``mask-003.png`` for every view, and ``cameras.json``.

    Depth is z in steps of ``unit`` metres, at most half a step off, 0 is none; the unit also stands in each picture's text chunk
    ``unit_m``. ``mask`` holds the mask bits, 8 bits a pixel. ``cameras.json`` has the unit, the intrinsics at 1x and 2x (pixel
    centres at whole numbers) and each view's pose.
    """
    paths = []
    for view in range(shard.views):
        gt = shard.ground_truth(view, 2)
        where = f"{shard.path}: view {view}"
        images: dict[str, NDArray[Any]] = {
            "tof": quantise(shard.tof(view).depth, unit, where),
            "depth": quantise(gt.depth, unit, where),
            "mask": gt.mask,
        }
        for name, image in images.items():
            path = folder / f"{name}-{view:03d}.png"
            with replacing(path) as partial:
                partial.write_bytes(png_bytes(image, {} if name == "mask" else {"unit_m": repr(unit)}))
            paths.append(path)
    write_text(folder / "cameras.json", json.dumps(_cameras(shard, unit), indent=1) + "\n")
    return [*paths, folder / "cameras.json"]


def _cameras(shard: ShardReader, unit: float) -> dict[str, Any]:
    views = range(shard.views)
    return {
        "scene": shard.scene,
        "unit_m": unit,
        "none": 0,
        "tof": asdict(shard.camera),
        "depth": asdict(shard.camera.scaled(2)),
        "views": [{"index": shard.index(v), "T_base_tof": shard.T_base_tof(v).tolist()} for v in views],
    }
