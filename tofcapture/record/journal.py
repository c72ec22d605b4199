"""The recording's journal: one row per view, in SQLite.

The journal says what should be there and what is. The sealed files themselves are the truth, and :func:`reconcile` makes the journal
agree with them at the start of every run. A sealed file without a row is verified and adopted. A row without a file is planned again.
Leftovers of a killed writer go. A damaged file is set aside, so that its view can be taken again.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError, DataError, UnreadableError
from tofcapture.files.disk import Database, is_there
from tofcapture.files.seal import replacing, sealed_digest, stored_digest
from tofcapture.files.view import open_view, view_number, view_path

_SCHEMA = """
CREATE TABLE IF NOT EXISTS views (
    scene TEXT NOT NULL, "index" INTEGER NOT NULL, pose TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('planned', 'sealed', 'failed')),
    sha256 TEXT, attempts INTEGER NOT NULL DEFAULT 0, reason TEXT NOT NULL DEFAULT '',
    planned_utc TEXT NOT NULL, changed_utc TEXT NOT NULL, step TEXT NOT NULL DEFAULT '',
    PRIMARY KEY (scene, "index")
);
CREATE TABLE IF NOT EXISTS meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
"""
_PLAN = """
INSERT INTO views (scene, "index", pose, state, planned_utc, changed_utc) VALUES (?, ?, ?, 'planned', ?, ?)
ON CONFLICT DO UPDATE SET pose = excluded.pose, state = 'planned', step = '', changed_utc = excluded.changed_utc WHERE state != 'sealed'
"""
_ADOPT = """
INSERT INTO views (scene, "index", pose, state, sha256, planned_utc, changed_utc) VALUES (?, ?, ?, 'sealed', ?, ?, ?)
ON CONFLICT DO UPDATE SET pose = excluded.pose, state = 'sealed', sha256 = excluded.sha256, reason = '', step = ''
"""


@dataclass(frozen=True)
class JournalRow:
    """Hold what the journal says of one view."""

    scene: str
    index: int
    pose: str  # digest of the planned view
    state: str
    sha256: str | None
    attempts: int
    reason: str
    step: str  # what was begun last for a view that is not sealed (record.observer.STEPS)


class JobRefused(ConfigError):  # noqa: N818  nothing is broken
    """What was asked for does not go with what the recording holds already; another job may."""


def utc_now() -> str:
    """Give the time of day as files have it: ISO 8601, UTC, whole seconds."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def journal_path(recording: Path) -> Path:
    """``RECORDING/journal.sqlite``."""
    return Path(recording) / "journal.sqlite"


class Journal:
    """Open journal of a recording, whose folder exists; one transaction per call, on disk when the call returns.

    Raises as :class:`tofcapture.files.disk.Database` does.
    """

    def __init__(self, recording: Path) -> None:
        hint = "move it away: it is rebuilt from the view files"
        self._db = Database(journal_path(recording), _SCHEMA, "a journal", hint)

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def rows(self, scene: str | None = None) -> list[JournalRow]:
        """All rows, or those of one scene, by scene and number."""
        where, values = ("WHERE scene = ?", (scene,)) if scene else ("", ())
        found = self._db.do(
            f'SELECT scene, "index", pose, state, sha256, attempts, reason, step FROM views {where} ORDER BY scene, "index"',  # noqa: S608
            values,
        )
        rows = [JournalRow(*row) for row in found]
        if wrong := next((row for row in rows if not _possible(row)), None):
            raise self._db.damaged(f"it says {wrong}")
        return rows

    def agree(self, facts: Mapping[str, Any]) -> None:
        """Remember facts of the recording (name -> JSON types), or compare with the remembered ones.

        Raises :class:`ConfigError`: a fact differs from what the recording was begun with; :class:`JobRefused`: one that every
        job brings.
        """
        for key, value in facts.items():
            text = json.dumps(value, sort_keys=True)
            self._db.do("INSERT OR IGNORE INTO meta VALUES (?, ?)", (key, text))
            known = self._db.do("SELECT value FROM meta WHERE key = ?", (key,))[0][0]
            if known != text:
                try:
                    expected = json.loads(known)
                except (ValueError, TypeError) as err:
                    raise self._db.damaged(f"{key}: {err}") from err
                # The next job has the same station, but its own frames and seed.
                kind = ConfigError if key == "station" else JobRefused
                raise kind(
                    f"the recording was begun with another {key}: expected {_first_difference(expected, value)}",
                    hint="go on with the same station and options, or record into another folder",
                )

    def expect(self, scene: str, poses: Mapping[int, Sequence[str]]) -> set[int]:
        """Note planned views (index -> digests of the pose and of others that do as well) and say which are there already.

        Raises :class:`JobRefused`: a view of that number was recorded at another pose.
        """
        sealed = {row.index: row.pose for row in self.rows(scene) if row.state == "sealed"}
        for index in sorted(sealed.keys() & poses.keys()):
            if sealed[index] not in poses[index]:
                raise JobRefused(
                    f"view {index} of {scene!r} was recorded at pose {sealed[index]}, the plan wants {poses[index][0]}",
                    hint="use the same --seed and --station as before, or record into another folder",
                )
        now = utc_now()
        self._db.do("BEGIN")
        for index, (pose, *_) in poses.items():
            self._db.do(_PLAN, (scene, index, pose, now, now))
        self._db.do("COMMIT")
        return sealed.keys() & poses.keys()

    def step(self, scene: str, index: int, step: str) -> None:
        """Note what is about to be done for a view."""
        self._set(scene, index, "step = ?", step)

    def attempt(self, scene: str, index: int) -> None:
        """Count one more attempt, before anything moves."""
        self._set(scene, index, "attempts = attempts + 1")

    def seal(self, scene: str, index: int, sha256: str, pose: str, reason: str = "") -> None:
        """Note that a view of a pose is on disk under its name, and why of another pose than planned."""
        change = "state = 'sealed', step = '', sha256 = ?, pose = ?, reason = ?"
        self._set(scene, index, change, sha256, pose, reason)

    def fail(self, scene: str, index: int, reason: str) -> None:
        """Note that a view was given up."""
        self._set(scene, index, "state = 'failed', step = '', reason = ?", reason)

    def forget(self, scene: str, index: int, reason: str) -> None:
        """Plan a view again whose file is gone."""
        self._set(scene, index, "state = 'planned', sha256 = NULL, step = '', reason = ?", reason)

    def adopt(self, scene: str, index: int, pose: str, sha256: str) -> None:
        """Note a verified file that the journal did not know to be sealed."""
        now = utc_now()
        self._db.do(_ADOPT, (scene, index, pose, sha256, now, now))

    def _set(self, scene: str, index: int, change: str, *values: object) -> None:
        self._db.do(
            f'UPDATE views SET {change}, changed_utc = ? WHERE scene = ? AND "index" = ?',  # noqa: S608
            (*values, utc_now(), scene, index),
        )


def _possible(row: JournalRow) -> bool:
    """Whether a row is one that a recorder writes."""
    texts = (row.scene, row.pose, row.state, row.reason, row.step)
    numbers = all(type(n) is int and n >= 0 for n in (row.index, row.attempts))
    return numbers and all(isinstance(text, str) for text in texts) and isinstance(row.sha256, str | None)


def _first_difference(known: Any, now: Any, where: str = "") -> str:
    """Say where two JSON values first differ: ``.serial = 'A', got 'B'``."""
    if isinstance(known, dict) and isinstance(now, dict):
        for key in sorted({*known, *now}):
            if known.get(key) != now.get(key):
                return _first_difference(known.get(key), now.get(key), f"{where}.{key}")
    return f"{where.lstrip('.') or 'value'} = {known!r}, got {now!r}"


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
        number = view_number(path)
        if number is not None and number not in known:
            done.append(_adopt(journal, path, scene, number))
    for index in sorted(i for i in known if not is_there(view_path(recording, scene, i))):
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
        view = open_view(path)
    except DataError as err:
        if isinstance(err, UnreadableError) or (sha256 and stored_digest(path)):
            raise  # its bytes are those that were sealed, or nobody knows: that is no damage
        return f"{path}: set aside as {_set_aside(path).name}: {err.message}"
    if (view.scene, view.index) != (scene, index):
        return f"{path}: set aside as {_set_aside(path).name}: it is view {view.index} of {view.scene!r}"
    journal.adopt(scene, index, str(view.provenance.get("pose", "")), sha256)
    return f"{path}: adopted, it was sealed but not in the journal"


def _set_aside(path: Path) -> Path:
    """Rename a file; nothing is ever deleted that might be data."""
    return path.rename(_free_name(path, "damaged"))


def keep_copy(path: Path, why: str) -> None:
    """Copy a view file to ``view-007.h5.WHY`` before another one takes its place."""
    with replacing(_free_name(path, why)) as partial:
        shutil.copyfile(path, partial)


def _free_name(path: Path, why: str) -> Path:
    aside = path.with_name(f"{path.name}.{why}")
    for number in itertools.count(2):
        if not aside.exists():
            break
        aside = path.with_name(f"{path.name}.{why}-{number}")
    return aside
