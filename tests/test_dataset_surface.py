"""Ground truth fused of all views of a scene, on the simulated station with small cameras."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.test_dataset_engines import built_by_dask
from tofcapture.cli import main
from tofcapture.dataset.build import build_dataset
from tofcapture.dataset.sample import SampleConfig
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.world import SimWorld
from tofcapture.files.check import check
from tofcapture.files.layout import MaskBit
from tofcapture.files.shard import ShardReader
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.ops.fuse import Clouds, Hits, fuse
from tofcapture.ops.register import OWN, _repeats
from tofcapture.poses import exp, invert, look_at
from tofcapture.rig import dumps_rig

CAMERAS = {
    "tof": {"width": 120, "height": 90, "fx": 95.3, "fy": 100.4, "cx": 58.2, "cy": 50.5},
    "stereo": {"width": 640, "height": 512, "fx": 577.0, "fy": 577.0, "cx": 319.5, "cy": 255.5},
    "stereo_model": {"disparity_noise": 0.0125},
    "render": {"multipath": False, "subpixels": 1},
}
VIEWS = 6
ARM = np.array([1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])  # m, rad; standard deviations of what the arm says
HAND_EYE = exp([3e-4, -3e-4, 2e-4, 1e-3, -1e-3, 1e-3])
FUSED = SampleConfig(truth="fused")


@pytest.fixture(scope="module")
def views():
    """Views of a mug from around, as an arm with errors of a tenth of a millimetre tells its poses."""
    world, rng, out = (
        SimWorld(read_constants(CAMERAS, "test"), 0, scene_objects),
        np.random.default_rng(5),
        [],
    )
    world.place("mug")
    times = iter(range(1, 10**12, 10**6)).__next__
    target = np.asarray(TABLE_CENTRE) + np.array([0, 0, 0.03])
    for index in range(VIEWS):
        angle = 2 * np.pi * index / VIEWS
        T_base_tof = look_at(
            target + 0.45 * np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.85]), target
        )
        T_base_flange = T_base_tof @ invert(world.true_rig.T_flange_tof)
        world.set_pose(T_base_flange, bytes([index]))
        said = ArmState(np.zeros(6), T_base_flange @ exp(ARM * rng.standard_normal(6)), 5)
        out.append(
            View(
                "mug",
                index,
                world.tof(1, times),
                world.stereo(times),
                said,
                said,
                world.true_rig,
                {},
                world.truth(),
            )
        )
    return out


def recorded(root, views):
    """Put views into a recording whose hand-eye transform is wrong by half a millimetre and a tenth of a degree."""
    for view in views:
        write_view(view_path(root, view.scene, view.index), view)
    rig = views[0].rig
    (root / "rig.toml").write_text(dumps_rig(replace(rig, T_flange_tof=rig.T_flange_tof @ HAND_EYE)))
    return root


@pytest.fixture(scope="module")
def recording(views, tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("recording"), views)


@pytest.fixture(scope="module")
def fused(recording, tmp_path_factory):
    return build_dataset([recording], tmp_path_factory.mktemp("fused") / "dataset", jobs=1, config=FUSED)


@pytest.fixture(scope="module")
def single(recording, tmp_path_factory):
    return build_dataset([recording], tmp_path_factory.mktemp("single") / "dataset", jobs=1)


def said(moved, T):
    """A view whose arm says another pose."""
    state = ArmState(moved.arm_before.joints, T, 5)
    return replace(moved, arm_before=state, arm_after=state)


def test_all_views_see_more_than_one(views, fused, single):
    """Of the object more is good, what was good is not worse, what is new is right, and nothing is seen through."""
    assert fused.gt.coverage > single.gt.coverage + 0.1
    assert not fused.alone
    assert check(fused.dataset) == []
    before, added, sure = [], [], []
    with (
        ShardReader(fused.dataset / "shards/mug.h5") as a,
        ShardReader(single.dataset / "shards/mug.h5") as b,
    ):
        assert a.fused
        assert not b.fused
        assert b.ground_truth(0, 2).sigma is None
        for k, view in enumerate(views):
            gt, was = a.ground_truth(k, 2), b.ground_truth(k, 2)
            good, error = gt.mask == 0, np.abs(gt.depth - view.truth.depth)
            before.append(error[good & (was.mask == 0)])
            added.append(error[good & (was.mask > 0)])
            sure.append((error / gt.sigma)[good])
            assert (gt.views[good] != 0).all()
            assert (gt.views[good & ((was.mask & MaskBit.NOT_HIT) > 0)] < 0).all()  # only others saw it
            np.testing.assert_array_equal(np.isnan(gt.depth), (gt.mask & MaskBit.NOT_HIT) > 0)
        assert [v["truth"] for v in a.provenance["views"]] == ["fused"] * VIEWS
    before, added, sure = (np.concatenate(x) for x in (before, added, sure))
    assert np.median(before) < 0.0002
    assert np.percentile(before, 99) < 0.001
    assert len(added) > 500
    assert np.median(added) < 0.0003
    assert np.percentile(added, 99) < 0.002
    assert max(before.max(), added.max()) < 0.005
    assert 0.5 < (sure < 1).mean() < 0.95


def test_poses_tell_how_well_the_arm_repeats():
    """One that is wrong altogether does not count, and nothing is made of poses that nobody could tell apart."""
    rng, covariance = np.random.default_rng(0), np.zeros((41 * 6, 41 * 6))
    off = rng.standard_normal((40, 6)) * np.repeat([1e-4, 2e-4], 3)
    off[3] = 0.04
    np.testing.assert_allclose(_repeats(off, covariance), [1e-4, 2e-4], rtol=0.2)
    np.testing.assert_allclose(_repeats(0 * off, covariance + np.eye(len(covariance))), OWN)


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(recording, fused, tmp_path):
    """Whoever measures which view, and fuses which."""
    again = build_dataset([recording], tmp_path / "dataset", jobs=2, config=FUSED)
    assert again.scenes == fused.scenes
    assert build_dataset([recording], tmp_path / "dataset", jobs=2, config=FUSED).skipped == ("mug",)


@pytest.mark.slow
def test_dask_gives_the_same_bytes(recording, fused, tmp_path):
    """Two workers fuse what one process does."""
    pytest.importorskip("distributed")
    built_by_dask(recording, tmp_path / "dataset", "fused")
    for name in ("manifest.json", "shards/mug.h5", "shards/mug.sha256"):
        assert (tmp_path / "dataset" / name).read_bytes() == (fused.dataset / name).read_bytes()


@pytest.mark.slow
def test_a_view_with_a_wrong_pose_is_named_and_kept_apart(views, single, tmp_path, capsys):
    """It is 40 mm from where it says: its truth is its own, and no other view's is made of it."""
    wrong = said(views[2], views[2].arm_before.T_base_flange @ exp([0.03, 0.03, 0, 0, 0, 0.1]))
    root = recorded(tmp_path, [*views[:2], wrong, *views[3:]])
    command = ["build-dataset", str(root), "--out", str(tmp_path / "out"), "--truth", "fused", "--jobs", "1"]
    assert main([*command, "--json"]) == 0
    alone = json.loads(capsys.readouterr().out.splitlines()[-1])["alone"]
    assert list(alone["mug"]) == ["view-002.h5"]
    assert "its pose is wrong" in alone["mug"]["view-002.h5"]
    with ShardReader(tmp_path / "out/shards/mug.h5") as a, ShardReader(single.dataset / "shards/mug.h5") as b:
        np.testing.assert_array_equal(a.ground_truth(2, 2).depth, b.ground_truth(2, 2).depth)
        np.testing.assert_array_equal(a.ground_truth(2, 2).mask, b.ground_truth(2, 2).mask)
        for k in (0, 1, 3, 4, 5):
            good = a.ground_truth(k, 2).mask == 0
            error = np.abs(a.ground_truth(k, 2).depth - views[k].truth.depth)[good]
            assert np.percentile(error, 99) < 0.002
            assert error.max() < 0.005


def test_an_object_that_moved_makes_two_surfaces(views, tmp_path):
    """Told half way that the arm stood elsewhere, as if the object had moved: each half is fused of itself."""
    moved = [said(v, exp([0.03, 0, 0, 0, 0, 0]) @ v.arm_before.T_base_flange) for v in views[:3]]
    result = build_dataset([recorded(tmp_path, [*moved, *views[3:]])], tmp_path / "out", jobs=1, config=FUSED)
    with ShardReader(tmp_path / "out/shards/mug.h5") as shard:
        assert max(v.get("of", 1) for v in shard.provenance["views"]) <= 3
    assert result.gt.p99_error_mm < 2


@pytest.mark.parametrize(
    ("some", "why"),
    [
        (lambda views: views[:1], "no other view"),
        (lambda views: [said(v, np.eye(4)) for v in views[:2]], "nobody said"),
    ],
)
def test_what_cannot_be_fused_is_single(views, tmp_path, some, why):
    """One view alone, and views without poses: named, with the truth of their own."""
    root = recorded(tmp_path, some(views))
    result = build_dataset([root], tmp_path / "out", jobs=1, config=FUSED)
    assert all(why in reason for reason in result.alone["mug"].values())
    assert len(result.alone["mug"]) == result.scenes["mug"].views
    alone = build_dataset([root], tmp_path / "single", jobs=1)
    with ShardReader(tmp_path / "out/shards/mug.h5") as a, ShardReader(alone.dataset / "shards/mug.h5") as b:
        np.testing.assert_array_equal(a.ground_truth(0, 2).depth, b.ground_truth(0, 2).depth)
        np.testing.assert_array_equal(a.ground_truth(0, 2).mask, b.ground_truth(0, 2).mask)


def test_what_the_own_camera_is_sure_of_is_not_outvoted_in_silence():
    """Two views see past a surface that the target's own camera is sure of: their depth there is doubtful, not where all agree."""
    planes = np.full((3, 8, 8, 5), [0, 0, 2, 1e-4, 5e-5], dtype=np.float32)
    free = np.full((3, 8, 8), 0.7, dtype=np.float32)
    quads, boxes = np.zeros((3, 7, 7), dtype=np.uint8), np.zeros((3, 4), dtype=np.intp)
    hits = Hits.none(3, 2)
    hits.depth[:], hits.cell[:] = [[0.5, 0.6], [0.6, 0.6], [0.6, 0.6]], 0
    hits.sigma[:], hits.noise[:] = 1e-4, 1e-4
    clouds, rays = Clouds(free, quads, planes, free, boxes), np.array([[0.0, 0, 1], [0, 0, 1]])
    poses, eye = np.tile(np.eye(4), (3, 1, 1)), np.array([16.0, 16, 8, 8])
    known = np.zeros(2), np.ones(2, dtype=bool)
    found = fuse(hits, np.arange(3), 0, clouds, poses, eye, rays, np.zeros((3, 6, 3, 6)), *known, 2)
    assert found.depth == pytest.approx(0.6)
    assert found.doubtful.tolist() == [True, False]
