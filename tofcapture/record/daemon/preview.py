"""Draw small pictures of a view for the daemon's page, and give the numbers that say whether it is any good."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import Kind, scale_for
from tofcapture.files.png import png_bytes
from tofcapture.files.seal import replacing
from tofcapture.frames import View
from tofcapture.ops.phase import Decoder
from tofcapture.record.quality import measure

NAMES = ("amplitude", "depth", "stereo")
_WIDE = 320  # px; larger pictures are thinned out


def picture(kind: Kind, image: NDArray[Any]) -> bytes:
    """Encode a map (H, W), NaN: none, as PNG of at most 320 pixels across."""
    step = -(-image.shape[1] // _WIDE)
    small = image[::step, ::step]
    scale = scale_for(kind, [small])
    return png_bytes(scale.paint(small), level=1)


def pictures(view: View) -> dict[str, bytes]:
    """PNG of amplitude and depth of the ToF camera, and of the stereo camera's depth, by name."""
    decoded = Decoder(view.tof.info).burst(view.tof.raw, float(np.mean(view.tof.celsius)))
    return {
        "amplitude": picture("amplitude", decoded.confidence),
        "depth": picture("depth", decoded.depth),
        "stereo": picture("depth", view.stereo.points[..., 2]),
    }


def quality(view: View) -> dict[str, Any]:
    """Numbers about a view: those of ``record.quality``, its notes in sentences, frames, degrees Celsius."""
    found: Any = view.provenance.get("quality")
    if found is None:
        found = measure(view.tof, view.stereo, view.arm_before, view.arm_after, view.rig, len(view.tof.raw))
    celsius = float(np.mean(view.tof.celsius))
    return {
        **{name: value for name, value in found.items() if name != "notes"},
        "notes": [note["words"] for note in found.get("notes", ())],
        "frames": len(view.tof.time_ns),
        "celsius": round(celsius, 1) if np.isfinite(celsius) else None,
    }


def save(view: View, folder: Path) -> None:
    """Write the pictures of a view; a reader sees the old or the new one, never half of one."""
    for name, data in pictures(view).items():
        with replacing(folder / f"{name}.png") as partial:
            partial.write_bytes(data)
