"""Read a ToF camera from one line, or from the files that other tools write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError

ORDER = ("fx", "fy", "cx", "cy")


def camera_keys(text: str) -> dict[str, Any]:
    """Read ``fx,fy,cx,cy[,k1,k2,p1,p2,k3...]`` or a file, as the keys of a rig's ``[tof]``; a line has no image size.

    :class:`ConfigError` for anything else.
    """
    if Path(text).exists():
        return keys_of_file(Path(text))
    try:
        numbers = [float(n) for n in text.split(",")]
    except ValueError as err:
        raise ConfigError(
            f"--camera: expected fx,fy,cx,cy[,k1,k2,p1,p2,k3] or a file, got {text!r}",
            hint="--camera 190.6,200.8,116.8,101.5",
        ) from err
    if len(numbers) < 4:
        raise ConfigError(
            f"--camera: expected at least fx,fy,cx,cy, got {len(numbers)} numbers", hint="pixels"
        )
    lens = {"distortion": numbers[4:]} if numbers[4:] else {}
    return {**dict(zip(ORDER, numbers, strict=False)), **lens}


def keys_of_file(path: Path) -> dict[str, Any]:
    """Read the camera of a file."""
    raise ConfigError(f"{path}: not yet")
