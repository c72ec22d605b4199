"""What people call: light to import, typed, by one verb, from text or paths, in scripts without a guard."""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import tofcapture
from tests.test_files_shard import write
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest

PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
HEAVY = ("numpy", "h5py", "torch", "scipy", "numba", "open3d")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two scenes of two splits."""
    folder, entries = tmp_path_factory.mktemp("dataset"), {}
    for scene, split in (("bowl", "test"), ("mug", "train")):
        path = folder / "shards" / f"{scene}.h5"
        path.parent.mkdir(exist_ok=True)
        digest = write(path)
        with tofcapture.open_shard(path) as shard:
            entries[scene] = SceneEntry(f"shards/{scene}.h5", digest or "", len(shard), split)
    write_manifest(folder, Manifest(entries))
    return folder


def python(code, **more):
    """What a fresh interpreter prints."""
    env = {**os.environ, "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(words, capture_output=True, text=True, check=True, env=env, **more).stdout.strip()


def test_importing_the_packages_loads_nothing_heavy():
    """All three at once, and no library of theirs."""
    loaded = python(
        f"import sys, {', '.join(PACKAGES)}; print([n for n in {HEAVY} if n in sys.modules])",
    )
    assert loaded == "[]"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_and_says_what_it_does(package):
    """``__all__`` is complete and true; other names are refused as Python does."""
    face = importlib.import_module(package)
    for name in face.__all__:
        thing = getattr(face, name)
        assert callable(thing), name
        assert thing.__doc__, name
        assert name in dir(face)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        _ = face.nothing


def test_a_function_of_a_room_is_called_by_the_rooms_name_whatever_was_imported_before():
    """``tofcapture.record`` and ``calibration.align`` are modules too; imported or not, they are called."""
    code = (
        "import tofcapture, calibration\n"
        "from tofcapture.errors import TofError\n"
        "for again in range(2):\n"
        "    for call in (lambda: tofcapture.record(None, 'mug', 'rec', frames=0), lambda: calibration.align('nowhere'),\n"
        "                 lambda: calibration.hand_eye([], [])):\n"
        "        try:\n"
        "            call()\n"
        "        except TofError as err:\n"
        "            print(type(err).__name__)\n"
        "    import tofcapture.record.recorder, calibration.align, calibration.hand_eye.solve\n"
    )
    said = python(code).split()
    assert len(said) == 6
    assert said[:3] == said[3:]


def test_a_dataset_is_a_sequence_of_named_views(dataset):
    """Length, index from both ends, iteration, splits; beyond its ends it is an IndexError."""
    data = tofcapture.open_dataset(str(dataset))
    assert len(data) == len(list(data)) == sum(len(shard) for shard in data.shards.values()) > 2
    assert "2 scenes" in repr(data)
    assert (data[0].scene, data[-1].scene) == ("bowl", "mug")
    for a, b in zip(data[-1], data[len(data) - 1], strict=True):
        np.testing.assert_array_equal(a, b)
    with tofcapture.open_shard(dataset / "shards/mug.h5") as shard:
        truth = shard.ground_truth(len(shard) - 1, 2)
        np.testing.assert_array_equal(data[-1].depth, truth.depth)
        np.testing.assert_array_equal(data[-1].raw[1], shard.raw(-1, 1))
        np.testing.assert_array_equal(shard[-1].ground_truth[1].mask, shard.ground_truth(-1, 1).mask)
        assert [sample.index for sample in shard] == [shard[i].index for i in range(len(shard))]
        with pytest.raises(IndexError, match=f"no view {len(shard)}"):
            _ = shard[len(shard)]
    assert {view.scene for view in tofcapture.Dataset(dataset, "train")} == {"mug"}
    assert len(tofcapture.Dataset(dataset, "val")) == 0
    for index in (len(data), -len(data) - 1):
        with pytest.raises(IndexError, match=f"no view {index}"):
            _ = data[index]
    with pytest.raises(ConfigError, match="train, val, test"):
        tofcapture.Dataset(dataset, "training")


def test_what_is_not_there_is_said_when_it_is_opened(tmp_path):
    """Not at the first use; and a reader can be printed at any time."""
    for opened in (tofcapture.open_view, tofcapture.open_shard, tofcapture.open_dataset):
        with pytest.raises(DataError, match="nowhere"):
            opened(tmp_path / "nowhere.h5")
    with pytest.raises(ConfigError, match="nowhere"):
        tofcapture.load_rig(str(tmp_path / "nowhere.toml"))


def test_readers_say_what_they_hold(dataset):
    """Path, scene and number of views in one line."""
    shard = tofcapture.open_shard(dataset / "shards/mug.h5")
    assert "mug.h5" in repr(shard)
    assert f"{len(shard)} views" in repr(shard)
    shard.close()
    assert "not opened yet" in repr(pickle.loads(pickle.dumps(shard)))  # noqa: S301


@pytest.mark.parametrize("workers", [0, 2])
def test_torchs_loader_makes_batches_of_it(dataset, workers):
    """As it is, without a word of ours; a batch has the same names."""
    torch = pytest.importorskip("torch")
    data = tofcapture.Dataset(dataset)
    (batch,) = torch.utils.data.DataLoader(data, batch_size=len(data), num_workers=workers)
    assert batch.depth.shape == (len(data), *data[0].depth.shape)
    assert batch.scene[0] == "bowl"
    np.testing.assert_array_equal(batch.raw[-1].numpy(), data[-1].raw)


def test_a_script_without_a_guard_may_use_processes(tmp_path):
    """Workers do not run the script again: it prints once, and the work is done."""
    script = tmp_path / "script.py"
    script.write_text(
        "from tofcapture.pool import Pool\nprint('once')\nwith Pool(2) as pool:\n"
        "    print(sorted(pool.run(divmod, [(7, 2), (9, 4)])))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["once", "[(0, (3, 1)), (1, (2, 1))]"], done.stderr


def test_a_function_of_the_script_itself_finds_its_script(tmp_path):
    """What only the script defines needs it in the worker, and a guard, as ever."""
    script = tmp_path / "script.py"
    script.write_text(
        "from tofcapture.pool import Pool\ndef twice(x):\n    return 2 * x\n"
        "if __name__ == '__main__':\n    with Pool(1) as pool:\n        print(pool.call(twice, 21))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.stdout == "42\n", done.stderr
    assert Path(script).exists()
