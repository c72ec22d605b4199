"""Small pictures of a view for the page, and numbers that say whether it is any good."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.frames import View
from tofcapture.ops.phase import decode, mean_phasors
from tofcapture.poses import Float64
from tofcapture.record.quality import measure

NAMES = ("amplitude", "depth", "stereo")
_WIDE = 320  # px; larger pictures are thinned out
# Polynomial approximation of the colour map turbo: red, green, blue, constant term first.
_TURBO = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode an 8-bit picture as PNG.

    Parameters
    ----------
    image
        (H, W) grey or (H, W, 3) RGB, uint8.
    """
    height, width = image.shape[:2]
    kind = 2 if image.ndim == 3 else 0
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(rows.tobytes(), 1))
        + chunk(b"IEND", b"")
    )


def _thin(image: Float64) -> Float64:
    step = max(1, -(-image.shape[1] // _WIDE))
    return image[::step, ::step]


def _unit(image: Float64) -> tuple[Float64, NDArray[np.bool_]]:
    """Stretch the 2nd to 98th percentile to 0..1; say where there is a value."""
    found = np.isfinite(image)
    if not found.any():
        return np.zeros_like(image), found
    low, high = np.percentile(image[found], [2, 98])
    scaled = (np.where(found, image, low) - low) / max(float(high - low), 1e-9)
    return np.clip(scaled, 0, 1), found


def grey(image: Float64) -> NDArray[np.uint8]:
    """(H, W) to a grey picture, square root for the dark parts."""
    unit, found = _unit(_thin(image))
    out: NDArray[np.uint8] = np.where(found, np.sqrt(unit) * 255, 0).astype(np.uint8)
    return out


def colour(image: Float64) -> NDArray[np.uint8]:
    """(H, W), NaN where there is nothing, to (h, w, 3): near red, far blue, nothing black."""
    unit, found = _unit(_thin(image))
    # The map's dark end would look like nothing.
    powers = (1 - 0.88 * unit)[..., None] ** np.arange(6)
    rgb = np.clip(powers @ _TURBO.T, 0, 1) * 255
    out: NDArray[np.uint8] = np.where(found[..., None], rgb, 0).astype(np.uint8)
    return out


def pictures(view: View) -> dict[str, bytes]:
    """PNG of amplitude and depth of the ToF camera, and of the stereo camera's depth, by name."""
    tof, info = view.tof, view.tof.info
    phasor = mean_phasors(tof.raw, info.modulation_hz, info.phase_rad)
    celsius = float(np.mean(tof.celsius))
    decoded = decode(
        phasor,
        info.modulation_hz,
        info.camera,
        info.illuminator,
        info.range_errors,
        celsius,
        min_amplitude=5.0,
    )
    return {
        "amplitude": png(grey(decoded.amplitude[-1])),
        "depth": png(colour(decoded.radial)),
        "stereo": png(colour(view.stereo.points[..., 2].astype(np.float64))),
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
        partial = folder / f"{name}.png.partial"
        partial.write_bytes(data)
        partial.replace(folder / f"{name}.png")
