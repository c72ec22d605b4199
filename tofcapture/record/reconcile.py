"""Make a recording's journal and its files agree, at the start of every run.

A sealed file without a row is verified and adopted. A row without a file is planned again. Leftovers of a killed writer go.
A damaged file is set aside under another name, so that its view can be taken again.
"""

from __future__ import annotations

import itertools
from pathlib import Path

from tofcapture.errors import DataError
from tofcapture.files.seal import sealed_digest
from tofcapture.files.view import read_view, view_path
from tofcapture.record.journal import Journal


def reconcile(journal: Journal, recording: Path, scene: str) -> list[str]:
    """Put right what a killed run, or a person, left behind of one scene; say each thing in a sentence.

    The process holds the recording.
    """
    folder, rows = view_path(recording, scene, 0).parent, journal.rows(scene)
    known = {row.index for row in rows if row.state == "sealed"}
    done = []
    for path in sorted(folder.glob("*.partial")):
        path.unlink()
        done.append(f"{path}: removed, it was never finished")
    for path in sorted(folder.glob("view-*.h5")):
        number = path.stem.removeprefix("view-")
        if number.isdigit() and int(number) not in known:
            done.append(_adopt(journal, path, scene, int(number)))
    for index in sorted(i for i in known if not view_path(recording, scene, i).exists()):
        journal.forget(scene, index, "the file was gone")
        done.append(f"view {index} of {scene!r}: its file is gone, it will be taken again")
    sealed = {row.index for row in journal.rows(scene) if row.state == "sealed"}
    for row in rows:
        if row.step and row.index not in sealed:
            journal.step(scene, row.index, "")
            done.append(
                f"view {row.index} of {scene!r}: the last run ended at {row.step!r}, it is taken again"
            )
    return done


def _adopt(journal: Journal, path: Path, scene: str, index: int) -> str:
    """Take a whole file that the journal does not know, or set it aside; say which."""
    sha256 = ""
    try:
        sha256 = sealed_digest(path)
        view = read_view(path)
    except DataError as err:
        if not sha256 and isinstance(err.__cause__, OSError):
            raise  # its bytes cannot be read just now: that is no damage
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
