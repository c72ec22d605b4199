"""The trained network that comes with the installation: found and described without importing what runs it."""

from __future__ import annotations

import json
import math
import struct
import tomllib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from tofcapture.errors import FormatError

_LONGEST = 1 << 24  # bytes of a header; a file that claims more is no checkpoint


@dataclass(frozen=True)
class Bundled:
    """Bundled weights: the file, its size in bytes, the kind of network, how many weights it has."""

    path: Path
    size: int
    kind: str
    weights: int


def bundled_path() -> Path | None:
    """Where the bundled weights lie; ``None`` when there are none."""
    spec = find_spec("tofcapture_model")
    for folder in (spec and spec.submodule_search_locations) or ():
        path = Path(folder) / "weights" / "model.safetensors"
        if path.is_file():
            return path
    return None


def describe_weights(path: Path) -> Bundled:
    """Read the header of a checkpoint (safetensors: eight bytes of length, then JSON).

    Raises
    ------
    FormatError
        When it is none, or is cut short.
    """
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(min(length, _LONGEST)))
        kind = tomllib.loads(header.pop("__metadata__")["config"])["network"]["kind"]
        end = 8 + length + max(t["data_offsets"][1] for t in header.values())
        count = sum(math.prod(t["shape"]) for t in header.values())
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as err:
        raise FormatError(f"{path}: not a checkpoint: {err!r}", hint="install tofcapture again") from err
    size = path.stat().st_size
    if size != end:
        raise FormatError(f"{path}: expected {end} bytes, got {size}", hint="install tofcapture again")
    return Bundled(path, size, str(kind), count)
