"""What lies in recordings: the scenes' view files, and the rig to build them with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tofcapture.errors import ConfigError, DataError
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.files.view import read_depth_view
from tofcapture.rig import Rig, load_rig


def find_scenes(recordings: Sequence[Path]) -> dict[str, tuple[Path, tuple[Path, ...]]]:
    """View files by scene: ``(recording, views in order)``, without the board's.

    Raises
    ------
    DataError
        When a recording does not exist or holds no scene.
    ConfigError
        When two recordings hold the same scene.
    """
    found: dict[str, tuple[Path, tuple[Path, ...]]] = {}
    for recording in recordings:
        folder = Path(recording) / "views"
        if not folder.is_dir():
            raise DataError(
                f"{recording}: expected a recording with a folder 'views'",
                hint="tofcapture record --scene NAME",
            )
        for scene in sorted(p for p in folder.iterdir() if p.is_dir() and p.name != BOARD_SCENE):
            if scene.name in found:
                raise ConfigError(
                    f"scene {scene.name} is in {found[scene.name][0]} and in {recording}",
                    hint="rename one of them",
                )
            views = tuple(sorted(scene.glob("view-*.h5")))
            if views:
                found[scene.name] = (Path(recording), views)
    if not found:
        raise DataError(
            f"no scene in {', '.join(map(str, recordings))}",
            hint="tofcapture record --scene NAME --out RECORDING",
        )
    return found


def rig_for(recording: Path, first_view: Path, rig_path: Path | None, *, true_rig: bool) -> Rig:
    """Rig to build with: the given one, the simulator's, or the one that ``align`` wrote.

    Raises
    ------
    ConfigError
        No rig there, or the true rig asked of a view that does not know it.
    """
    if true_rig:
        view, _ = read_depth_view(first_view)
        if view.truth is None:
            raise ConfigError(
                f"{first_view}: carries no true rig", hint="--true-rig is for simulated recordings"
            )
        return replace(view.rig, T_tof_stereo=view.truth.T_tof_stereo, T_flange_tof=view.truth.T_flange_tof)
    path = rig_path or recording / "rig.toml"
    if not path.is_file():
        raise ConfigError(
            f"{path}: expected the calibrated rig, found none", hint=f"tofcapture align {recording}"
        )
    return load_rig(path)
