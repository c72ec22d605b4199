"""What figures read of recordings: which views there are, and where the arm stood."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofcapture.devices.kinematics import ArmModel, link_frames
from tofcapture.errors import DataError
from tofcapture.files.hdf import fetch, open_checked
from tofcapture.files.layout import VIEW
from tofcapture.poses import Float64

BOARD = "calibration"


def scene_views(recording: Path, scene: str | None = None) -> list[Path]:
    """View files of one scene in order.

    Parameters
    ----------
    recording
        Folder with ``views/``.
    scene
        ``None``: the first one that is not the board.

    Raises
    ------
    DataError
        It is no recording, or has no such scene.
    """
    if not recording.exists():
        raise DataError(
            f"{recording}: no such file or folder", hint="give a recording or one of its view files"
        )
    found = sorted({p.parent.name for p in (recording / "views").glob("*/view-*.h5")})
    if not found:
        raise DataError(
            f"{recording}: expected a recording with views, found none",
            hint="tofcapture record --scene NAME --out RECORDING",
        )
    if scene is not None and scene not in found:
        raise DataError(f"{recording}: no scene {scene}", hint=f"it has {', '.join(found)}")
    name = scene or next((n for n in found if n != BOARD), found[0])
    return sorted((recording / "views" / name).glob("view-*.h5"))


def pick_view(path: Path, scene: str | None, view: int | None) -> Path:
    """Find one view file.

    Parameters
    ----------
    path
        The file itself, or a recording.
    scene, view
        Which of a recording's, the number as in the file's name; ``None``: the first.

    Raises
    ------
    DataError
        There is no such view.
    """
    if path.is_file():
        return path
    paths = scene_views(path, scene)
    if view is None:
        return paths[0]
    found = [p for p in paths if p.stem == f"view-{view:03d}"]
    if not found:
        numbers = ", ".join(str(int(p.stem.removeprefix("view-"))) for p in paths)
        raise DataError(f"{path}: scene {paths[0].parent.name} has no view {view}", hint=f"it has {numbers}")
    return found[0]


def links_of(path: Path, arm: ArmModel | None) -> tuple[Float64, Float64 | None]:
    """Read where the arm stood, without the images.

    Parameters
    ----------
    path
        View file.
    arm
        ``None``: no links.

    Returns
    -------
    T_base_flange
        (4, 4).
    links
        (7, 3) origins from the base to the flange, metres; ``None`` without a model.
    """
    with open_checked(path, VIEW) as file:
        T, joints = (fetch(file, VIEW[f"arm/after/{name}"], path) for name in ("T_base_flange", "joints"))
    if arm is None:
        return T, None
    return T, np.vstack([np.zeros(3), link_frames(arm, joints)[:, :3, 3]])
