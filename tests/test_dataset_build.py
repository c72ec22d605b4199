"""make_sample and build_dataset on the simulated station with small cameras."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.ground_truth import class_errors, crop_shares
from tests import answers
from tests.test_ops_clean import inside
from tofcapture.cli import main
from tofcapture.dataset import sample as sampling
from tofcapture.dataset.build import build_dataset
from tofcapture.dataset.sample import SampleConfig, decoder_for, masked, pooled, view_error
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.light import exact_view
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.world import SimWorld
from tofcapture.errors import ConfigError, DataError, TofError
from tofcapture.files.check import check
from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ShardReader
from tofcapture.files.view import open_view, view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.ops.crop import Crop
from tofcapture.ops.project import Projection
from tofcapture.poses import invert, look_at
from tofcapture.rig import dumps_rig

SMALL = {
    "tof": {"width": 60, "height": 45, "fx": 47.7, "fy": 50.2, "cx": 28.9, "cy": 25.1},
    "stereo": {"width": 320, "height": 256, "fx": 288.0, "fy": 288.0, "cx": 159.5, "cy": 127.5},
    "stereo_model": {"disparity_noise": 0.00625},
    "render": {"multipath": False, "subpixels": 1},
}
CONFIG = SampleConfig()


def placed(scene, index, distance=0.5, constants=SMALL):
    """World with the arm where view ``index`` of a scene is taken; flange to base."""
    world = SimWorld(read_constants(constants, "test"), 0, scene_objects)
    target = np.asarray(TABLE_CENTRE) + np.array([0, 0, 0.03])
    direction = np.array([0.3 * (index - 1), 0.3, 0.9])
    T_base_tof = look_at(target + distance * direction / np.linalg.norm(direction), target)
    T_base_flange = T_base_tof @ invert(world.true_rig.T_flange_tof)
    world.place(scene)
    world.set_pose(T_base_flange, bytes([index]))
    return world, T_base_flange


def simulate(scene, index, distance=0.5, constants=SMALL):
    world, T_base_flange = placed(scene, index, distance, constants)
    times = iter(range(1, 10**9, 10**6))
    burst, stereo = world.tof(2, times.__next__), world.stereo(times.__next__)
    state = ArmState(np.zeros(6), T_base_flange, 5)
    return View(scene, index, burst, stereo, state, state, world.nominal_rig(), {}, world.truth())


def true_rig(view):
    return replace(view.rig, T_tof_stereo=view.truth.T_tof_stereo, T_flange_tof=view.truth.T_flange_tof)


def make_sample(view, rig, config=CONFIG, seed=0):
    return sampling.make_sample(view, rig, config, np.random.default_rng(seed), decoder_for(view, rig))


@pytest.fixture(scope="module")
def view():
    return simulate("box", 1)


@pytest.fixture(scope="module")
def sample(view):
    return make_sample(view, true_rig(view))


@pytest.fixture(scope="module")
def fine(view):
    return make_sample(view, true_rig(view), SampleConfig(scales=(1, 2, 4)))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Three scenes of one and two views, and a board view that belongs in no dataset."""
    root = tmp_path_factory.mktemp("recording")
    for scene, indices in (("box", (0, 2)), ("mug", (0,)), ("gear", (1,)), ("calibration", (0,))):
        for i in indices:
            write_view(view_path(root, scene, i), simulate(scene, i))
    (root / "rig.toml").write_text(dumps_rig(true_rig(open_view(view_path(root, "box", 0)))))
    return root


@pytest.mark.parametrize(("scene", "distance"), [("steps", 1.0), ("sphere", 0.6)])
def test_ground_truth_agrees_with_the_truth(scene, distance):
    """With cameras of full size and the true rig, where the mask is 0: median below 0.2 mm, 99 % below 2 mm."""
    seen = simulate(scene, 2, distance, {"render": SMALL["render"]})
    error = pooled([view_error(make_sample(seen, true_rig(seen)), seen)])
    assert error.median_error_mm <= 0.2
    assert error.p99_error_mm <= 2.0
    assert error.coverage > 0.4


def test_every_class_of_the_mask_keeps_its_promise(view, sample):
    """Object and table: half of the pixels right to 0.2 mm, all but 1 % to 2 mm, none shows what is behind; the crop parts them."""
    gt = sample.ground_truth[2]
    for name in ("object", "table"):
        error = class_errors(gt, view.truth)[name]
        assert len(error.errors) > 500
        assert np.median(error.errors) <= 0.0002
        assert np.percentile(error.errors, 99) <= 0.002
        assert error.wrong <= 0.01
        assert error.through == 0
    crop = crop_shares(gt, view.truth)
    assert (
        crop.target_kept >= 0.97 * crop.target
    )  # pixels are 2 mm wide here; benchmarks/ground_truth.py at full size
    assert crop.other_kept <= 0.005 * crop.other


def test_good_pixels_are_the_object(view, sample):
    """What the mask calls good lies on the scene's object; the table is measured but outside."""
    gt, target = sample.ground_truth[2], view.truth.target
    assert ((gt.mask == 0) & ~target).sum() <= 0.005 * (gt.mask == 0).sum()
    assert ((gt.mask == 0) & target).sum() > 0.25 * target.sum()
    table = (gt.mask == MaskBit.OUTSIDE) & np.isfinite(view.truth.depth)
    assert table.sum() > 500
    assert np.median(np.abs(gt.depth - view.truth.depth)[table]) < 0.001


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_depth_normals_and_mask_obey_the_contract(fine, view, scale):
    """Depth is finite exactly where NOT_HIT is unset; normals are unit there, face the camera, and are right in the median."""
    gt, camera = fine.ground_truth[scale], view.rig.tof.scaled(scale)
    hit = (gt.mask & MaskBit.NOT_HIT) == 0
    np.testing.assert_array_equal(np.isfinite(gt.depth), hit)
    np.testing.assert_array_equal(np.isfinite(gt.normals).all(axis=-1), hit)
    assert gt.depth.dtype == gt.normals.dtype == np.float32
    assert np.abs(np.linalg.norm(gt.normals[hit], axis=-1) - 1).max() < 1e-5
    assert (np.einsum("nc,nc->n", gt.normals[hit], camera.rays[hit]) < 0).all()
    if scale == 2:
        good = gt.mask == 0
        cosine = np.einsum("nc,nc->n", gt.normals[good], view.truth.normals[good])
        assert np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) < 3


def test_scales_agree(sample, view):
    """A pixel at 1x lies between its four at 2x."""
    one, two = sample.ground_truth[1], sample.ground_truth[2]
    good = (one.mask & ~np.uint8(MaskBit.OUTSIDE)) == 0
    mean = two.depth.reshape(45, 2, 60, 2).mean(axis=(1, 3))
    assert np.nanpercentile(np.abs(mean - one.depth)[good], 95) < 0.001


def test_four_times_agrees_with_the_exact_depth(fine, sample, view):
    """At 4x the ray caster's own depth at 4x holds the classes to what 2x is held to; 1x and 2x stay what they are."""
    world, T_base_flange = placed("box", 1)
    T_base_tof = T_base_flange @ world.true_rig.T_flange_tof
    exact = exact_view(world.caster()[0], world.constants.tof.scaled(4), T_base_tof)
    truth, gt = replace(view.truth, depth=exact[0], normals=exact[1], target=exact[2]), fine.ground_truth[4]
    for name in ("object", "table"):
        error = class_errors(gt, truth)[name]
        assert len(error.errors) > 2000
        assert np.median(error.errors) <= 0.0002
        assert np.percentile(error.errors, 99) <= 0.002
        assert error.wrong <= 0.01
        assert error.through == 0
    good = gt.mask == 0
    assert (good & truth.target).sum() > 0.25 * truth.target.sum()
    assert np.median(np.einsum("nc,nc->n", gt.normals[good], truth.normals[good])) > np.cos(np.radians(3))
    for scale in (1, 2):
        for name in ("depth", "normals", "mask"):
            a, b = (getattr(s.ground_truth[scale], name) for s in (fine, sample))
            np.testing.assert_array_equal(a, b)


def test_scales_may_be_a_list():
    """As JSON and command lines give them; the config is the same one, and can be a key."""
    assert hash(SampleConfig(scales=[1, 2])) == hash(SampleConfig())
    assert SampleConfig(scales=[1, 2]) == SampleConfig()


def test_only_known_scales_are_made():
    """1 and 2 are always there, and nothing but 4 comes beside them."""
    for scales in ((1, 4), (4, 2, 1), (1, 2, 3), ()):
        with pytest.raises(ConfigError, match="scales"):
            SampleConfig(scales=scales)
    assert SampleConfig(scales=[1, 2, 4]).table()["scales"] == [1, 2, 4]


def test_the_sample_carries_the_view(sample, view):
    """Raw, times and temperatures pass unchanged; the pose is the arm's times the rig's; the decoded burst is near the truth."""
    assert sample.raw is view.tof.raw
    np.testing.assert_array_equal(sample.time_ns, view.tof.time_ns)
    np.testing.assert_allclose(sample.T_base_tof, view.arm_before.T_base_flange @ view.truth.T_flange_tof)
    near = np.abs(sample.tof.depth - sample.ground_truth[1].depth)
    assert np.nanmedian(near) < 0.01
    native = np.isfinite(sample.native_depth)
    np.testing.assert_array_equal(sample.native_depth[native], view.stereo.points[..., 2][native])


def test_without_a_crop_nothing_is_outside(view, sample):
    """A radius of a hundred metres keeps the table in, and changes no depth."""
    rig = true_rig(view)
    whole = make_sample(view, rig, SampleConfig(crop_radius=1000.0), view.index)
    for scale in (1, 2):
        assert not (whole.ground_truth[scale].mask & MaskBit.OUTSIDE).any()
        np.testing.assert_array_equal(whole.ground_truth[scale].depth, sample.ground_truth[scale].depth)
    assert (sample.ground_truth[2].mask & MaskBit.OUTSIDE).any()
    assert np.isfinite(whole.native_depth).sum() > np.isfinite(sample.native_depth).sum()


@pytest.mark.parametrize("with_table", [True, False])
def test_the_mask_is_what_numpy_says(sample, view, with_table):
    """GRAZING and OUTSIDE of the compiled passes follow their rules: 75 degrees for either eye, the crop."""
    rig = true_rig(view)
    camera, gt = rig.tof.scaled(2), sample.ground_truth[2]
    table = Crop(np.array([0.0, 0.0, -1.0]), -0.45, np.array([0.0, 0.0, 0.45]), 0.1, 0.001, 0.5)
    crop = table if with_table else replace(table, normal=np.full(3, np.nan), offset=np.nan, radius=np.inf)
    depth, normals = gt.depth.astype(float), gt.normals.astype(float)
    no = np.zeros(camera.shape, dtype=bool)
    found = masked(Projection(depth, np.zeros((*camera.shape, 2)), normals, no, no), rig, camera, crop).mask
    points = camera.unproject(depth)
    rays = np.stack([points, points - rig.T_tof_stereo[:3, 3]])
    cosine = -(normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    expected = (cosine < np.cos(np.radians(75))).any(axis=0)
    np.testing.assert_array_equal((found & MaskBit.GRAZING) > 0, expected)
    kept = (
        inside(crop, points) if with_table else np.ones(camera.shape, dtype=bool)
    )  # nothing to be outside of
    np.testing.assert_array_equal((found & MaskBit.OUTSIDE) == 0, kept)
    assert 0 < (found == 0).sum() < found.size


def test_the_same_inputs_give_the_same_bytes(sample, view):
    """A sample is a function of view, rig, config and generator state."""
    again = make_sample(view, true_rig(view))
    for scale in (1, 2):
        for name in ("depth", "normals", "mask"):
            a, b = (getattr(s.ground_truth[scale], name) for s in (sample, again))
            assert a.tobytes() == b.tobytes()


def test_a_rig_of_another_camera_is_refused(view):
    """Sizes that disagree are a data error."""
    wrong = replace(true_rig(view), tof=view.rig.tof.scaled(2))
    with pytest.raises(DataError, match="expected ToF images"):
        make_sample(view, wrong, CONFIG)


def test_build_check_and_read(recording, tmp_path):
    """A dataset has a shard per scene, checks out, reads back, and says how good its ground truth is."""
    seen = []
    out = tmp_path / "dataset"
    result = build_dataset([recording], out, jobs=1, progress=lambda *a: seen.append(a))
    assert set(result.scenes) == {"box", "mug", "gear"}
    assert not result.failures
    assert not result.bare
    assert len(seen) == 4
    assert check(out) == []
    assert load_manifest(out).scenes == result.scenes
    assert {"train", "test"} == {e.split for e in result.scenes.values()}
    assert result.gt.p99_error_mm <= 3.0
    assert 0.2 < result.gt.coverage <= 1
    card = (out / "README.md").read_text()
    assert "| train | 2 |" in card
    answers.hold("build", {"gt": result.gt.table(), "config": load_manifest(out).config}, off=0.05)
    described = json.loads((out / "croissant.json").read_text())
    promised = {d["contentUrl"]: d["sha256"] for d in described["distribution"]}
    assert promised.pop("manifest.json") == sha256_of(out / "manifest.json")
    assert set(promised.values()) == {e.sha256 for e in result.scenes.values()}
    with ShardReader(out / "shards/box.h5") as shard:
        assert [shard.index(0), shard.index(1)] == [0, 2]
        assert shard.provenance["gt"]["p99_error_mm"] <= 3.0


def test_four_times_on_demand(recording, tmp_path, capsys):
    """`--scales 1 2 4` builds anew what was there without; it checks out, card and description tell, and the default goes back."""
    out = tmp_path / "dataset"
    command = ["build-dataset", str(recording), "--out", str(out), "--jobs", "1", "--json"]
    before = build_dataset([recording], out, jobs=1)
    for _ in range(2):
        assert main([*command, "--scales", "1", "2", "4"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["skipped"] == ["box", "gear", "mug"]
    assert check(out) == []
    assert load_manifest(out).config["scales"] == [1, 2, 4]
    assert "at 1x, 2x and 4x" in (out / "README.md").read_text()
    with ShardReader(out / "shards/box.h5") as shard:
        assert shard.ground_truth(1, 4).depth.shape == (180, 240)
        assert shard.provenance["config"]["scales"] == [1, 2, 4]
    assert build_dataset([recording], out, jobs=1).scenes == before.scenes


@pytest.mark.parametrize("text", ["", "{}", None])
def test_a_damaged_description_is_found(recording, tmp_path, text):
    """check reads croissant.json and holds its digests against the manifest."""
    out = tmp_path / "dataset"
    build_dataset([recording], out, jobs=1)
    path = out / "croissant.json"
    was = path.read_text()
    path.write_text(
        was.replace(json.loads(was)["distribution"][0]["sha256"], "0" * 64) if text is None else text
    )
    assert [p.path.name for p in check(out)] == ["croissant.json"]


def test_a_second_run_does_nothing_and_a_third_repairs(recording, tmp_path):
    """Finished shards are skipped; a damaged one is built again, with the same bytes; a new config builds all anew."""
    out = tmp_path / "dataset"
    first = build_dataset([recording], out, jobs=1)
    assert set(build_dataset([recording], out, jobs=1).skipped) == {"box", "mug", "gear"}
    shard = out / "shards/mug.h5"
    shard.chmod(0o644)
    os.truncate(shard, 10_000)
    again = build_dataset([recording], out, jobs=1)
    assert set(again.skipped) == {"box", "gear"}
    assert again.scenes == first.scenes
    assert build_dataset([recording], out, jobs=1, config=SampleConfig(far=1.0)).skipped == ()


def test_parallel_is_the_same(recording, tmp_path):
    """Two processes give the bytes of one."""
    one = build_dataset([recording], tmp_path / "one", jobs=1)
    two = build_dataset([recording], tmp_path / "two", jobs=2)
    assert {n: e.sha256 for n, e in one.scenes.items()} == {n: e.sha256 for n, e in two.scenes.items()}


def test_a_damaged_view_fails_its_scene_only(recording, tmp_path):
    """The scene of a damaged view is named, the others are built, nothing half-made remains."""
    copy = shutil.copytree(recording, tmp_path / "recording")
    path = view_path(copy, "box", 2)
    path.chmod(0o644)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    result = build_dataset([copy], tmp_path / "out", jobs=1)
    assert list(result.failures) == ["box"]
    assert "view-002.h5" in result.failures["box"].message
    assert set(result.scenes) == {"mug", "gear"}
    assert check(tmp_path / "out") == []


def blind(view):
    """The view as a stereo camera without light would have given it."""
    return replace(view, stereo=replace(view.stereo, points=np.full_like(view.stereo.points, np.nan)))


def test_a_view_without_stereo_costs_no_scene(recording, tmp_path, capsys):
    """It stays, fully masked, and is named; a scene of nothing else is a failure."""
    copy = shutil.copytree(recording, tmp_path / "recording")
    for scene, index in (("box", 2), ("gear", 1)):
        path = view_path(copy, scene, index)
        seen = open_view(path)
        path.unlink()
        write_view(path, blind(seen))
    out = tmp_path / "out"
    assert main(["build-dataset", str(copy), "--out", str(out), "--jobs", "1"]) == 5
    said = capsys.readouterr().out
    assert "no good ground truth in box: view-002.h5" in said
    assert "FAILED gear: gear: stereo measured nothing" in said
    with ShardReader(out / "shards/box.h5") as shard:
        gt = shard.ground_truth(1, 2)
    assert np.isnan(gt.depth).all()
    assert (gt.mask & MaskBit.NOT_HIT).all()
    assert check(out) == []


def test_a_rig_that_looks_elsewhere_fails_all(recording, tmp_path):
    """With the stereo camera turned about, no scene has ground truth."""
    rig = true_rig(open_view(view_path(recording, "box", 0)))
    path = tmp_path / "rig.toml"
    path.write_text(dumps_rig(replace(rig, T_tof_stereo=np.diag([-1.0, 1.0, -1.0, 1.0]))))
    result = build_dataset([recording], tmp_path / "out", path, jobs=1)
    assert set(result.failures) == {"box", "mug", "gear"}
    assert "any of 2 views" in result.failures["box"].message


def test_an_out_that_cannot_be_written_is_refused_at_once(recording, tmp_path):
    """Below a file there is no folder: that is said before any view is read, with the option to change."""
    (tmp_path / "file").write_text("")
    with pytest.raises(TofError) as caught:
        build_dataset([recording], tmp_path / "file" / "out", jobs=1)
    assert "name another folder: --out" in caught.value.hint
    assert (tmp_path / "file").read_text() == ""


def test_what_cannot_be_built_is_refused(recording, tmp_path):
    """No recording, no scenes, no rig, a scene in two recordings: each says what to do."""
    with pytest.raises(DataError, match="expected a recording"):
        build_dataset([tmp_path], tmp_path / "out")
    (tmp_path / "empty/views/calibration").mkdir(parents=True)
    with pytest.raises(DataError, match="no scene"):
        build_dataset([tmp_path / "empty"], tmp_path / "out")
    with pytest.raises(ConfigError, match="is in"):
        build_dataset([recording, recording], tmp_path / "out")
    copy = shutil.copytree(recording, tmp_path / "copy")
    (copy / "rig.toml").unlink()
    with pytest.raises(ConfigError, match=r"rig\.toml") as caught:
        build_dataset([copy], tmp_path / "out")
    assert caught.value.hint == f"tofcapture align {copy}"
    assert not (tmp_path / "out").exists()


def test_killed_and_run_again_gives_the_same_bytes(recording, tmp_path):
    """SIGKILL while a shard is written: the next run removes the leftovers and ends with the bytes of an undisturbed run."""
    out = tmp_path / "out"
    code = f"""
import os, signal
from pathlib import Path
from tofcapture.dataset.build import build_dataset
def die(scene, done, views):
    if scene == "gear": os.kill(os.getpid(), signal.SIGKILL)
build_dataset([Path({str(recording)!r})], Path({str(out)!r}), jobs=1, progress=die)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == -signal.SIGKILL
    assert list(out.glob("shards/.work-*/gear.h5.partial"))
    assert not (out / "manifest.json").exists()
    resumed = build_dataset([recording], out, jobs=1)
    assert resumed.skipped == ("box",)
    build_dataset([recording], tmp_path / "calm", jobs=1)
    names = [p.relative_to(out) for p in sorted(out.rglob("*")) if p.is_file() and p.name != "README.md"]
    assert not [n for n in names if n.suffix == ".partial" or ".work-" in str(n)]
    for name in names:
        if name.name != "croissant.json":  # it and the card carry the folder's name
            assert sha256_of(out / name) == sha256_of(tmp_path / "calm" / name)


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_sigterm_prints_one_line(recording, tmp_path, jobs):
    """Told to end, alone or with its workers, a build says so in one line and its hint, and leaves no half shard."""
    code = f"""
import os, signal, sys, threading, time
from pathlib import Path
from tofcapture.cli import main
def end():
    while not list(Path({str(tmp_path)!r}).glob("d/shards/.work-*")):
        time.sleep(0.01)
    os.killpg(0, signal.SIGTERM)
if __name__ == "__main__":
    threading.Thread(target=end, daemon=True).start()
    sys.exit(main(["build-dataset", {str(recording)!r}, "--true-rig", "--out", {str(tmp_path / "d")!r}, "--jobs", {jobs!r}]))
"""
    (tmp_path / "run.py").write_text(code)
    command = [sys.executable, tmp_path / "run.py"]
    done = subprocess.run(command, capture_output=True, text=True, start_new_session=True, check=False)
    assert done.returncode == 143
    lines = [line for line in done.stderr.splitlines() if not line.startswith("build")]
    assert lines == ["tofcapture: terminated", "  try: run the same command again to go on"]
    assert not list((tmp_path / "d").glob("shards/*.h5"))


def test_the_command(recording, tmp_path):
    """`tofcapture build-dataset --true-rig --json` states scenes, views and the ground truth's error."""
    args = [
        "build-dataset",
        str(recording),
        "--out",
        str(tmp_path / "out"),
        "--true-rig",
        "--jobs",
        "1",
        "--json",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "tofcapture", *args], capture_output=True, text=True, check=True
    )
    result = json.loads(done.stdout)
    assert (result["scenes"], result["views"]) == (3, 4)
    assert set(result["gt"]) >= {"median_error_mm", "p99_error_mm", "coverage"}
    bad = subprocess.run(
        [sys.executable, "-m", "tofcapture", *args[:-1], "--far", "-1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert bad.returncode == 3
    assert "--far" in bad.stderr
