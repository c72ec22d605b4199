"""Frames of datasets as networks read them: items, crops, mirrors, order, memory, several datasets at once."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
import math
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tofcapture.cli import main
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import sha256_of
from tofcapture_model import data as module
from tofcapture_model.data import (
    FrameDataset,
    SampleId,
    collate,
    epoch_batches,
    frame_decoder,
    mirror,
    spare_memory,
)
from tofcapture_model.data.raw_input import NOMINAL_CAMERA
from tofcapture_model.geometry.maps import depth_to_normals, scale_intrinsics
from tofcapture_model.networks.checkpoint import load_checkpoint


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two training scenes and a test scene at half the sensor's resolution."""
    return make_dataset(tmp_path_factory.mktemp("data") / "dataset", scale=2)


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """One more training scene, with a name that the first dataset has, too."""
    return make_dataset(
        tmp_path_factory.mktemp("data") / "other", views=2, scale=2, splits=("train",), seed=5
    )


def test_items_line_up_with_the_camera(dataset):
    """Depth and doubled ground truth of the same item agree up to noise."""
    data = FrameDataset(dataset, "train", (48, 64), seed=1)
    frame, target = data[(0, 0)]
    assert frame.depth.shape == (1, 48, 64)
    assert target.depth.shape == (1, 96, 128)
    coarse = torch.nn.functional.avg_pool2d(target.depth, 2)
    inside = torch.nn.functional.avg_pool2d((target.good | target.context).float(), 2) == 1
    assert (frame.depth - coarse)[inside].abs().median() < 0.012


def test_items_depend_on_epoch_and_index_only(dataset):
    """The same key gives the same crop, whoever asks; another epoch gives another."""
    first, second = (FrameDataset(dataset, "train", (48, 64), flip=True, seed=1) for _ in range(2))
    second[(5, 3)]
    assert torch.equal(first[(2, 1)][0].depth, second[(2, 1)][0].depth)
    assert not torch.equal(first[(2, 1)][0].depth, first[(3, 1)][0].depth)


@pytest.mark.parametrize("axis", [-1, -2])
def test_mirroring_twice_is_the_identity_and_keeps_the_geometry(dataset, axis):
    """A mirrored frame is one of a mirrored world: plane fits of the mirrored depth are the mirrored normals."""
    data = FrameDataset(dataset, "train")
    frame, target = data[(0, 0)]
    once = mirror(frame, target, axis)
    twice = mirror(*once, axis)
    assert torch.equal(
        mirror(frame, target)[0].depth, frame.depth.flip(-1)
    )  # left and right, where nothing is said
    assert all(torch.allclose(a, b) for a, b in zip(frame, twice[0], strict=True))
    k = scale_intrinsics(once[0].intrinsics[None], 2)
    fitted = depth_to_normals(once[1].depth[None], once[1].good[None].float() + 1e-6, k, radius=1)[0]
    cosine = (fitted * once[1].normals).sum(0)[once[1].good[0]]
    assert cosine.median() > 0.999


def test_processes_share_an_epoch_without_overlap():
    """Two ranks take different samples and equally many batches."""
    one, two = (epoch_batches([0] * 21, 4, 0, 1, rank, 2) for rank in (0, 1))
    assert len(one) == len(two) == 2
    assert not {k for b in one for k in b} & {k for b in two for k in b}
    assert len(epoch_batches([0] * 3, 4, 0, 0)) == 1


def test_a_batch_is_of_one_kind_and_none_is_forgotten():
    """Cameras of other channels or sizes never meet in a batch; every one of them is seen, and in another order each epoch."""
    kinds = [f"{i % 3}" for i in range(30)] + ["rare"]
    batches = [epoch_batches(kinds, 4, 0, epoch) for epoch in (0, 1)]
    assert all(len({kinds[i] for _, i in batch}) == 1 for batch in batches[0])
    assert {kinds[i] for batch in batches[0] for _, i in batch} == set(kinds)
    assert all(len(batch) == 4 for batch in batches[0])
    assert [kinds[b[0][1]] for b in batches[0]] != [kinds[b[0][1]] for b in batches[1]]


def test_an_empty_split_is_an_error(dataset):
    """There is no validation scene here."""
    with pytest.raises(DataError, match="split val is empty"):
        FrameDataset(dataset, "val")


def test_whole_frames_and_crops_collate(dataset):
    """Batches keep names, shapes and channels-last order."""
    data = FrameDataset(dataset, "train", (48, 64))
    frame, target = collate([data[(0, i)] for i in range(2)])
    assert frame.raw.shape == (2, 8, 48, 64)
    assert frame.raw.is_contiguous(memory_format=torch.channels_last)
    assert target.good.dtype == torch.bool


def test_frames_stay_in_memory_as_far_as_it_goes(dataset):
    """What is kept is the very same object and takes no more than it may; what is not kept is the same bits."""
    first = SampleId("scene-0", 0, 0)
    plain = FrameDataset(dataset, "train")
    size = sum(x.nbytes for x in plain.frame(first))
    tables = sum(module.TABLES * math.prod(r.camera.shape) for r in plain.readers.values())
    data = FrameDataset(dataset, "train", cache_bytes=tables + 2.5 * size)
    kept = [data.frame(s) for s in data.samples]
    again = [data.frame(s) for s in data.samples]
    assert [a is b for a, b in zip(kept, again, strict=True)] == [True, True] + [False] * (len(kept) - 2)
    assert all(torch.equal(x, y) for a, b in zip(kept, again, strict=True) for x, y in zip(a, b, strict=True))


def test_decoders_take_what_is_set_aside_for_them(dataset):
    """Arrays of a decoder and its camera, measured: what training takes off the memory for frames."""
    reader = next(iter(FrameDataset(dataset, "train").readers.values()))
    camera = replace(NOMINAL_CAMERA, fx=191.25)  # one that nobody has tables of
    tracemalloc.start()
    decoder = frame_decoder(replace(reader.info, camera=camera), camera)
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert decoder.info.camera == camera
    assert 0.7 * module.TABLES < taken / math.prod(camera.shape) < 1.1 * module.TABLES


def test_memory_is_what_system_and_container_spare(monkeypatch):
    """Half of the smaller of the two, shared by the processes; a modest amount where neither is told."""
    files = {"/proc/meminfo": "MemTotal: 64 kB\nMemAvailable: 32 kB\n"}

    def read_text(path, *_args, **_kwargs):
        if str(path) not in files:
            raise FileNotFoundError(path)
        return files[str(path)]

    monkeypatch.setattr(Path, "read_text", read_text)
    assert spare_memory() == 32 * 1024 / 2
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    assert spare_memory() == 32 * 1024 / 8
    monkeypatch.delenv("LOCAL_WORLD_SIZE")
    files |= {"/sys/fs/cgroup/memory.max": "20000\n", "/sys/fs/cgroup/memory.current": "4000\n"}
    assert spare_memory() == 8000
    files["/sys/fs/cgroup/memory.max"] = "max\n"
    assert spare_memory() == 32 * 1024 / 2
    files.clear()
    assert spare_memory() == module.MODEST


def test_several_datasets_are_one(dataset, other):
    """Every frame of both, each with its own ground truth, though they share a scene's name."""
    both = FrameDataset([dataset, other], "train")
    one, two = FrameDataset(dataset, "train"), FrameDataset(other, "train")
    assert len(both) == len(one) + len(two)
    assert torch.equal(both[(0, len(one))][0].raw, two[(0, 0)][0].raw)
    assert torch.equal(both[(0, len(one))][1].depth, two[(0, 0)][1].depth)
    assert torch.equal(both[(0, 0)][0].raw, one[(0, 0)][0].raw)


def test_frames_of_two_sizes_share_no_batch_but_crops_do(dataset, tmp_path):
    """Each size has its batches; a crop that fits into both makes them one kind. One cache holds one dataset."""
    smaller = make_dataset(tmp_path / "smaller", views=1, scale=4, splits=("train",))
    for size, kinds in (((), 2), ((32, 32), 1), ((64, 64), 2)):
        data = FrameDataset([dataset, smaller], "train", size)
        assert len(set(data.kinds)) == kinds
        for batch in epoch_batches(data.kinds, 3, 0, 0):
            frames, _ = collate([data[key] for key in batch])
            assert len(frames.depth) == 3
    with pytest.raises(ConfigError, match="one dataset with the cache"):
        FrameDataset([dataset, smaller], "train", (32, 32), cache=tmp_path)


def test_the_command_trains_on_several_datasets(dataset, other, tmp_path, capsys):
    """The weights remember both; the card names both; another set of datasets does not continue the run."""
    config = tmp_path / "tiny.toml"
    config.write_text(
        'preset = "demo"\nstage = [{name = "joint", epochs = 1, learning_rate = 1e-3}]\n'
        "[network]\nwidth = 2\nlevels = 2\n[training]\nbatch = 4\ncrop = [32, 48]\n"
    )
    out = ["--config", str(config), "--out", str(tmp_path / "run"), "--json"]
    assert main(["train", str(dataset), str(other), *out]) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 4  # 12 + 4 frames by four
    provenance = load_checkpoint(tmp_path / "run")[2]
    assert provenance["dataset"] == str(dataset)
    digest = sha256_of(other / "manifest.json")
    assert provenance["also"] == {str(other): digest}
    card = (tmp_path / "run/README.md").read_text()
    assert digest in card
    assert f"tofcapture train {dataset} {other} --out" in card
    assert main(["train", str(dataset), *out]) == 3
    assert "another configuration, dataset, budget" in capsys.readouterr().out


def test_a_mean_measures_nothing_where_a_shot_is_saturated(dataset, monkeypatch):
    """Clipping took from that mean what nobody knows; the other pixels stay as they are."""
    data = FrameDataset(dataset, "train", mean=True)
    sample = data.samples[0]
    reader = data.readers[sample.scene]
    before = data.frame(sample)
    assert data.averaged > 1
    assert before.valid[0, 10, 20] == 1
    raw = type(reader).raw

    def dazzled(self, view, shot):
        taps = np.array(raw(self, view, shot))
        if shot == 0:
            taps[3, 10, 20] = self.info.saturation
        return taps

    monkeypatch.setattr(type(reader), "raw", dazzled)
    after = data.frame(sample)
    assert after.valid[0, 10, 20] == 0
    assert (after.valid != before.valid).sum() == 1
