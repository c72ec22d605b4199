"""Read the rig of a ToF camera alone: from a ``rig.toml``, from one line, or from other tools' files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofcapture.errors import ConfigError
from tofcapture.importing.cameras import camera_keys
from tofcapture.rig import Rig, camera_from, load_rig


def tof_rig(source: str | Path, size: tuple[int, int] | None = None) -> Rig:
    """Read a rig of which the ToF camera alone is used; the rest is neutral where it is not said.

    ``source`` is a ``rig.toml``, ``fx,fy,cx,cy[,k1,k2,p1,p2,k3]`` or a file of another tool; ``size`` (H, W) is that of images
    whose camera does not say it. :class:`ConfigError` for anything else, or a camera of another size.
    """
    path = Path(source)
    if path.suffix.lower() == ".toml" or not (path.exists() or "," in str(source) or "#" in str(source)):
        return load_rig(path, tof_only=True)
    keys = camera_keys(str(source))
    if size is not None:
        keys = {"height": size[0], "width": size[1], **keys}
    if not {"width", "height"} <= keys.keys():
        raise ConfigError(f"{source}: does not say the size of its images", hint="--size H,W")
    camera = camera_from(keys, str(source))
    if size not in (None, camera.shape):
        raise ConfigError(
            f"{source}: expected a camera of {size} pixels, got {camera.shape}", hint="--size H,W"
        )
    return Rig(camera, replace(camera, distortion=()), np.eye(4), np.eye(4))
