"""Versions of the shard format: golden files, reading the earlier one, migrating it."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.test_files_shard import write
from tofcapture.cli import main
from tofcapture.errors import DataError, FormatError
from tofcapture.files import migrate as migration
from tofcapture.files.check import check
from tofcapture.files.layout import SHARD, SHARD_1, TofFlag
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.migrate import migrate, migrate_shard
from tofcapture.files.seal import digest_path, sealed_digest, sha256_of
from tofcapture.files.shard import ShardReader
from tofcapture.ops.phase import Decoder

GOLDEN = Path(__file__).parent / "golden"
DIGESTS = json.loads((GOLDEN / "shard.json").read_text(encoding="utf-8"))


def copy(version, folder):
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("mug.h5", "mug.sha256"):
        shutil.copy(GOLDEN / f"shard-v{version}" / name, folder / name)
    return folder / "mug.h5"


def contents(path):
    """Digest of every dataset's bytes, by name."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(
            lambda name, d: (
                found.update({name: hashlib.sha256(d[()].tobytes()).hexdigest()[:16]})
                if isinstance(d, h5py.Dataset)
                else None
            )
        )
    return found


@pytest.mark.parametrize(("version", "layout"), [(1, SHARD_1), (2, SHARD)])
def test_golden_files_hold_what_they_held(version, layout):
    """Plain h5py opens both versions; datasets and bytes are those that were pinned, by the layout's names."""
    path = GOLDEN / f"shard-v{version}" / "mug.h5"
    assert contents(path) == DIGESTS[str(version)]
    assert contents(path).keys() == {f.path for f in layout if not f.path.endswith("_4x")}
    with h5py.File(path) as file:
        assert (file.attrs["format"], file.attrs["version"]) == (layout.format, layout.version)
        assert {name for name, _, _ in layout.attrs} == set(file.attrs)
    assert path.stat().st_size < 100_000


def test_the_reader_takes_both_versions():
    """The same calls give the same arrays; the earlier version knows of saturation only."""
    with (
        ShardReader(GOLDEN / "shard-v1/mug.h5") as one,
        ShardReader(GOLDEN / "shard-v2/mug.h5") as two,
    ):
        assert (one.version, two.version, one.views) == (1, 2, two.views)
        for view in range(one.views):
            np.testing.assert_array_equal(one.raw(view, 2), two.raw(view, 2))
            np.testing.assert_array_equal(one.tof(view).saturated, two.tof(view).saturated)
            np.testing.assert_allclose(one.tof(view).depth, two.tof(view).depth, atol=1e-5)
            np.testing.assert_array_equal(one.ground_truth(view, 2).mask, two.ground_truth(view, 2).mask)
            assert set(np.unique(one.flags(view))) == {0, TofFlag.SATURATED}
            np.testing.assert_array_equal(two.flags(view), Decoder(two.info).burst(*burst(two, view)).flags)


def burst(reader, view):
    frames = range(reader.frames)
    celsius = np.mean([reader.celsius(view, f) for f in frames])
    return np.stack([reader.raw(view, f) for f in frames]), float(celsius)


def test_an_unknown_version_is_refused_with_advice(tmp_path):
    """Newer than known: upgrade; older than known: migrate."""
    path = copy(2, tmp_path)
    path.chmod(0o644)
    for version, advice in ((3, "upgrade"), (0, "migrate")):
        with h5py.File(path, "a") as file:
            file.attrs["version"] = version
        digest_path(path).write_text(f"{sha256_of(path)}  {path.name}\n")
        with pytest.raises(FormatError, match=f"got {version}") as info, ShardReader(path) as shard:
            shard.views  # noqa: B018
        assert advice in info.value.hint


def test_a_migrated_shard_is_one_of_this_version(tmp_path):
    """Every array is kept, flags are what the decoder makes of the burst, check finds nothing; a second run does nothing."""
    path = copy(1, tmp_path)
    assert [p.where for p in check(path)] == ["version"]
    before, old = contents(path), sha256_of(path)
    done = migrate_shard(path)
    assert (done.before, done.changed, done.sha256) == (1, True, sealed_digest(path))
    after = contents(path)
    assert after.pop("tof/flags") == DIGESTS["2"]["tof/flags"]
    before.pop("tof/saturated")
    assert after == before
    assert check(path) == []
    with ShardReader(path) as shard:
        assert shard.provenance["migrated"] == {"version": 1, "sha256": old}
        assert shard.provenance["digest"] == "golden"
    assert not migrate_shard(path).changed


def old_dataset(folder):
    path = copy(1, folder / "shards")
    entry = SceneEntry("shards/mug.h5", sha256_of(path), 2, "train")
    write_manifest(folder, Manifest({"mug": entry}))
    described = {"distribution": [{"contentUrl": entry.path, "sha256": entry.sha256}], "description": "x"}
    (folder / "croissant.json").write_text(json.dumps(described), encoding="utf-8")
    return path


def test_a_migrated_dataset_is_whole(tmp_path, capsys):
    """Manifest and Croissant follow; the command says what it did."""
    old_dataset(tmp_path)
    assert main(["migrate", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["changed"] == 1
    assert check(tmp_path) == []
    assert main(["migrate", str(tmp_path)]) == 0
    assert "0 of 1 shards rewritten" in capsys.readouterr().out


@pytest.mark.parametrize("moment", ["rename of the shard", "manifest", "croissant"])
def test_a_killed_migration_is_finished_by_the_next(tmp_path, monkeypatch, moment):
    """Between any two steps that others can see, what is there can be read, and running again completes it."""
    path = old_dataset(tmp_path)

    def die(*args, **kwargs):
        raise KeyboardInterrupt

    if moment == "rename of the shard":

        def half(partial, final):
            shutil.copy(partial, tmp_path / "kept")
            digest_path(final).write_text(f"{sha256_of(partial)}  {final.name}\n")
            die()

        monkeypatch.setattr(migration, "seal", half)
    else:
        monkeypatch.setattr(migration, "write_manifest" if moment == "manifest" else "_describe", die)
    with pytest.raises(KeyboardInterrupt):
        migrate(tmp_path)
    monkeypatch.undo()
    if moment == "rename of the shard":  # a real kill would not have cleaned up
        (tmp_path / "kept").rename(path.with_name(path.name + ".partial"))
    # The digest beside the shard is stored before the shard: between the two it is the manifest that vouches for the old one.
    promised = load_manifest(tmp_path).scenes["mug"].sha256 if moment == "rename of the shard" else None
    with ShardReader(path, promised) as shard:
        assert shard.views == 2
    migrate(tmp_path)
    assert check(tmp_path) == []
    assert load_manifest(tmp_path).scenes["mug"].sha256 == sha256_of(path)


def test_damaged_and_foreign_shards_are_not_migrated(tmp_path):
    """A flipped byte, and a shard that the manifest does not mean, are refused; the file stays."""
    path = old_dataset(tmp_path)
    data = bytearray(path.read_bytes())
    data[30_000] ^= 1
    path.chmod(0o644)
    path.write_bytes(data)
    with pytest.raises(DataError):
        migrate(tmp_path)
    assert path.read_bytes() == bytes(data)
    path.unlink()
    digest_path(path).unlink()
    write(path)
    with pytest.raises(DataError, match="as in the manifest"):
        migrate(tmp_path)
