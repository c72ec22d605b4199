"""Make a recording's journal and its files agree, at the start of every run.

A sealed file without a row is verified and adopted, a row without a file is planned again, leftovers of a killed writer go, and
a damaged file is set aside under another name so that its view can be taken again.
"""

from __future__ import annotations

import itertools
from pathlib import Path

from tofcapture.errors import DataError
from tofcapture.files.seal import sealed_digest
from tofcapture.files.view import read_view, view_path
from tofcapture.record.journal import Journal, Row


def reconcile(journal: Journal, recording: Path, scene: str) -> list[str]:
    """Put right what a killed run, or a person, left behind of one scene.

    Parameters
    ----------
    journal, recording
        Both held by this process.
    scene
        Its name.

    Returns
    -------
    One sentence for each thing that was put right.
    """
    folder = view_path(recording, scene, 0).parent
    known = {row.index for row in journal.rows(scene) if row.state == "sealed"}
    begun = [row for row in journal.rows(scene) if row.step]
    return [
        *_sweep(folder),
        *_adopt(journal, folder, known),
        *_miss(journal, recording, scene, known),
        *_roll_back(journal, begun),
    ]


def _roll_back(journal: Journal, begun: list[Row]) -> list[str]:
    """Plan views again in whose midst the last run ended, unless their files turned out to be whole."""
    sealed = {(row.scene, row.index) for row in journal.rows() if row.state == "sealed"}
    done = []
    for row in begun:
        if (row.scene, row.index) not in sealed:
            journal.step(row.scene, row.index, "")
            done.append(
                f"view {row.index} of {row.scene!r}: the last run ended at {row.step!r}, it is taken again"
            )
    return done


def _sweep(folder: Path) -> list[str]:
    """Remove what killed writers left."""
    stray = sorted(folder.glob("*.partial"))
    for path in stray:
        path.unlink()
    return [f"{path}: removed, it was never finished" for path in stray]


def _adopt(journal: Journal, folder: Path, known: set[int]) -> list[str]:
    """Take whole files that the journal does not know; set damaged ones aside."""
    done = []
    for path in sorted(folder.glob("view-*.h5")):
        number = path.stem.removeprefix("view-")
        if number.isdigit() and int(number) not in known:
            done.append(_adopt_one(journal, path, folder.name, int(number)))
    return done


def _adopt_one(journal: Journal, path: Path, scene: str, index: int) -> str:
    try:
        sha256 = sealed_digest(path)
        view = read_view(path)
    except DataError as err:
        return f"{path}: set aside as {_set_aside(path).name}: {err.message}"
    if (view.scene, view.index) != (scene, index):
        return f"{path}: set aside as {_set_aside(path).name}: it is view {view.index} of {view.scene!r}"
    journal.adopt(scene, index, str(view.provenance.get("pose", "")), sha256)
    return f"{path}: adopted, it was sealed but not in the journal"


def _set_aside(path: Path) -> Path:
    """Rename a file; nothing is ever deleted that might be data."""
    aside = path.with_name(f"{path.name}.damaged")
    for number in itertools.count(2):
        if not aside.exists():
            break
        aside = path.with_name(f"{path.name}.damaged-{number}")
    path.rename(aside)
    return aside


def _miss(journal: Journal, recording: Path, scene: str, known: set[int]) -> list[str]:
    """Plan sealed views again whose file is gone."""
    gone = sorted(i for i in known if not view_path(recording, scene, i).exists())
    for index in gone:
        journal.forget(scene, index, "the file was gone")
    return [f"view {index} of {scene!r}: its file is gone, it will be taken again" for index in gone]
