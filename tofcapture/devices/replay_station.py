"""Writes a station that replays a recording: ``python -m tofcapture.devices.replay_station RECORDING FOLDER``."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

from tofcapture.devices.registry import ROLES
from tofcapture.devices.replay_source import Replay
from tofcapture.errors import ConfigError
from tofcapture.rig import dumps_rig


def write_station(recording: Path, folder: Path, order: str = "joints") -> Path:
    """Write a station that replays a recording with the plan, the seed and the rig that it was made with.

    Parameters
    ----------
    recording
        Folder with ``station.toml`` and views.
    folder
        Where ``station.toml`` and ``rig.toml`` go; made when missing.
    order
        See :class:`Replay`.

    Returns
    -------
    Path of the station.
    """
    import tomli_w

    try:
        made_with = tomllib.loads((recording / "station.toml").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(f"{recording}: expected a recording with station.toml: {err}") from err
    station: dict[str, Any] = {k: made_with[k] for k in ("plan", "sim") if k in made_with}
    for role in ROLES:
        station[role] = {"driver": "replay"}
    station["arm"] |= {"recording": str(recording.resolve()), "order": order}
    station["rig"] = {"path": "rig.toml"}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(dumps_rig(Replay(recording, order).first().rig), encoding="utf-8")
    (folder / "station.toml").write_text(tomli_w.dumps(station), encoding="utf-8")
    return folder / "station.toml"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(f"usage: {sys.executable} -m tofcapture.devices.replay_station RECORDING FOLDER")
    print(write_station(Path(sys.argv[1]), Path(sys.argv[2])))
