"""Training, checkpoints, evaluation, prediction and the commands, on small analytic scenes."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.cache import pack
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, TofMaps
from tofcapture.files.shard_writer import ShardWriter
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.phase import decode, mean_phasors, taps
from tofcapture.poses import look_at
from tofcapture.rig import SPEED_OF_LIGHT, Rig
from tofcapture_model.checkpoint import load_model, load_resume
from tofcapture_model.config import Network, Stage, preset
from tofcapture_model.data import FrameDataset, SampleId, batched, collate, epoch_batches, mirror
from tofcapture_model.evaluate import evaluate
from tofcapture_model.geometry import depth_to_normals, scale_intrinsics
from tofcapture_model.predict import png_bytes, predict
from tofcapture_model.train import train

HZ = (20e6, 100e6)


def hit_sphere(origin, rays, centre, radius):
    """Distance along rays and outward normals of a sphere; infinity where it is missed."""
    to = origin - centre
    b = (rays * to).sum(-1)
    disc = b**2 - (to @ to - radius**2)
    t = -b - np.sqrt(np.maximum(disc, 0))
    normal = (origin + t[..., None] * rays - centre) / radius
    return np.where((disc > 0) & (t > 0), t, np.inf), normal


def hit_box(origin, rays, centre, half):
    """Distance along rays and outward normals of an axis-aligned box; infinity where it is missed."""
    safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    near, far = np.sort(np.stack([(centre - half - origin) / safe, (centre + half - origin) / safe]), axis=0)
    axis = near.argmax(-1)
    t = near.max(-1)
    normal = np.eye(3)[axis] * -np.sign(np.take_along_axis(rays, axis[..., None], -1))
    return np.where((t < far.min(-1)) & (t > 0), t, np.inf), normal


def scene_shapes(seed):
    """A table and a few random spheres and boxes with albedos; the table comes first."""
    rng = np.random.default_rng(seed)
    shapes = [(hit_box, np.array([0, 0, -0.05]), np.array([0.6, 0.5, 0.05]), rng.uniform(0.3, 0.8))]
    for _ in range(rng.integers(2, 5)):
        size = rng.uniform(0.03, 0.12)
        where = np.array([*rng.uniform(-0.15, 0.15, 2), size])
        box = rng.random() < 0.5
        extent = np.array([*rng.uniform(0.03, 0.12, 2), size]) if box else size
        shapes.append((hit_box if box else hit_sphere, where, extent, rng.uniform(0.2, 0.9)))
    return shapes


def cast(shapes, camera, T_world_camera):
    """Radial distance, depth, camera-frame normals, albedo and object index of every pixel."""
    rays = camera.rays / camera.ray_lengths[..., None]
    R, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
    world = rays @ R.T
    best, normals = np.full(camera.shape, np.inf), np.zeros((*camera.shape, 3))
    albedo, which = np.zeros(camera.shape), np.full(camera.shape, -1)
    for i, (hit, where, extent, rho) in enumerate(shapes):
        t, n = hit(origin, world, where, extent)
        closer = t < best
        best, albedo, which = (
            np.where(closer, t, best),
            np.where(closer, rho, albedo),
            np.where(closer, i, which),
        )
        normals = np.where(closer[..., None], n, normals)
    return best, best / camera.ray_lengths, normals @ R, albedo, which


def expose(radial, cosine, albedo, rng, frames):
    """Raw taps of a burst: sub-pixel mixing, wiggling, scattering, shot and read noise, 12 bits."""
    from scipy.ndimage import gaussian_filter

    radial = np.where(np.isfinite(radial), radial, 3.0)
    strength = 400 * albedo * np.clip(cosine, 0.05, 1) / radial**2
    phasor = []
    for hz in HZ:
        phase = 4 * np.pi * hz * radial / SPEED_OF_LIGHT
        wiggled = phase + 4 * np.pi * hz / SPEED_OF_LIGHT * 0.003 * np.sin(2 * phase + 0.5)
        z = strength * np.exp(1j * wiggled)
        z = z.reshape(z.shape[0] // 2, 2, z.shape[1] // 2, 2).mean((1, 3))
        phasor.append(z + 0.05 * (gaussian_filter(z.real, 15) + 1j * gaussian_filter(z.imag, 15)))
    z = np.stack(phasor)
    offset = np.abs(z) * 1.3 + 60
    info = TofInfo("", "", Camera(1, 1, 1, 1, 0, 0), np.zeros(3))
    clean = taps(z, offset, info.modulation_hz, info.phase_rad)
    electrons = rng.poisson(np.broadcast_to(clean * 12, (frames, *clean.shape))) / 12
    noisy = electrons + rng.normal(0, 4, electrons.shape)
    return np.clip(np.rint(noisy), 0, 4095).astype(np.uint16)


def edges(depth):
    """Pixels within two of a depth step."""
    from scipy.ndimage import maximum_filter, minimum_filter

    filled = np.where(np.isfinite(depth), depth, 9)
    return maximum_filter(filled, 5) - minimum_filter(filled, 5) > 0.03


def shoot(shapes, camera, index, seed, frames):
    """One view as a shard sample."""
    rng = np.random.default_rng([seed, index])
    direction = np.array([rng.normal(), rng.normal(), 1.2])
    eye = direction / np.linalg.norm(direction) * rng.uniform(0.4, 1.2)
    T = look_at(eye, np.array([0, 0, 0.04]), roll=rng.uniform(-3, 3))
    fine = camera.scaled(2)
    radial, depth, normals, albedo, which = cast(shapes, fine, T)
    cosine = -(normals * fine.rays).sum(-1) / fine.ray_lengths
    raw = expose(radial, cosine, albedo, rng, frames)
    hit = np.isfinite(depth)
    mask = np.where(hit, 0, 1).astype(np.uint8)
    mask |= np.where(hit & (cosine < np.cos(np.radians(75))), 4, 0).astype(np.uint8)
    mask |= np.where(edges(depth), 8, 0).astype(np.uint8) | np.where(which < 1, 16, 0).astype(np.uint8)
    depth = np.where(hit, depth, np.nan).astype(np.float32)
    normals = np.where(hit[..., None], normals, np.nan).astype(np.float32)
    info = TofInfo("", "", camera, np.zeros(3))
    found = decode(
        mean_phasors(raw, info.modulation_hz, info.phase_rad), info.modulation_hz, camera, np.zeros(3)
    )
    gt = {
        s: GroundTruth(depth[:: 3 - s, :: 3 - s], normals[:: 3 - s, :: 3 - s], mask[:: 3 - s, :: 3 - s])
        for s in (1, 2)
    }
    return Sample(
        index=index,
        raw=raw,
        celsius=np.full(frames, 45.0),
        time_ns=np.arange(frames),
        tof=TofMaps(
            camera.radial_to_depth(found.radial).astype(np.float32),
            found.confidence.astype(np.float32),
            found.saturated,
        ),
        native_depth=np.full((8, 10), np.nan, np.float32),
        ground_truth=gt,
        T_base_tof=T,
        truth=ExactMaps(depth, normals),
    )


def make_dataset(folder, *, views=3, frames=2, scale=1, splits=("train", "train", "test"), seed=0):
    """Write a dataset of analytic scenes; ``scale`` divides the sensor's resolution."""
    camera = Camera(240 // scale, 180 // scale, 190.6 / scale, 200.8 / scale, 116.8 / scale, 101.5 / scale)
    info = TofInfo("analytic", "0", camera, np.zeros(3))
    stereo = StereoInfo("none", "0", Camera(10, 8, 10, 10, 4.5, 3.5))
    rig = Rig(camera, stereo.camera, np.eye(4), np.eye(4))
    (folder / "shards").mkdir(parents=True)
    scenes = {}
    for i, split in enumerate(splits):
        name = f"scene-{i}"
        path = f"shards/{name}.h5"
        with ShardWriter(folder / path, name, rig, info, stereo, views) as shard:
            shapes = scene_shapes(seed + i)
            for view in range(views):
                shard.add(shoot(shapes, camera, view, seed + i, frames))
            scenes[name] = SceneEntry(path, shard.seal({}), views, split)
    write_manifest(folder, Manifest(scenes))
    return folder


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two training scenes and a test scene at half the sensor's resolution."""
    return make_dataset(tmp_path_factory.mktemp("data") / "dataset", scale=2)


@pytest.fixture(scope="module")
def tiny():
    """A demo preset that trains in no time."""
    base = preset("demo")
    return replace(
        base,
        network=replace(base.network, width=4, levels=2),
        training=replace(base.training, batch=3, crop=(48, 64)),
        stages=(Stage("joint", 2, 1e-2),),
    )


@pytest.fixture(scope="module")
def trained(dataset, tiny, tmp_path_factory):
    """A run of two epochs: eight steps."""
    out = tmp_path_factory.mktemp("run")
    return out, train(tiny, dataset, out)


def test_items_line_up_with_the_camera(dataset):
    """Depth and doubled ground truth of the same item agree up to noise; the crop moves the principal point."""
    data = FrameDataset(dataset, "train", (48, 64), seed=1)
    frame, target = data[(0, 0)]
    assert frame.depth.shape == (1, 48, 64)
    assert target.depth.shape == (1, 96, 128)
    coarse = torch.nn.functional.avg_pool2d(target.depth, 2)
    inside = torch.nn.functional.avg_pool2d((target.good | target.context).float(), 2) == 1
    assert (frame.depth - coarse)[inside].abs().median() < 0.012
    assert frame.intrinsics[2] <= data.readers["scene-0"].camera.cx


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
    assert all(torch.allclose(a, b) for a, b in zip(frame, twice[0], strict=True))
    k = scale_intrinsics(once[0].intrinsics[None], 2)
    fitted = depth_to_normals(once[1].depth[None], once[1].good[None].float() + 1e-6, k, radius=1)[0]
    cosine = (fitted * once[1].normals).sum(0)[once[1].good[0]]
    assert cosine.median() > 0.999


def test_processes_share_an_epoch_without_overlap():
    """Two ranks take different samples and equally many batches."""
    one, two = (epoch_batches(21, 4, 0, 1, rank, 2) for rank in (0, 1))
    assert len(one) == len(two) == 2
    assert not {k for b in one for k in b} & {k for b in two for k in b}
    assert len(epoch_batches(3, 4, 0, 0)) == 1


def test_training_lowers_the_loss(dataset, tiny, tmp_path):
    """A dozen steps on two frames: the model learns."""
    config = replace(tiny, stages=(Stage("joint", 10, 1e-2),))
    train(config, dataset, tmp_path / "run")
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["total"] < lines[0]["total"]
    assert list((tmp_path / "run" / "tensorboard").iterdir())


def test_a_stopped_run_goes_on_to_the_same_bits(dataset, tiny, trained, tmp_path):
    """Three steps, a stop in mid-epoch, and the rest give the very weights of an unbroken run."""
    out = tmp_path / "run"
    stopped = train(tiny, dataset, out, stop_after=3)
    assert (stopped.steps, stopped.finished) == (3, False)
    resumed = train(tiny, dataset, out)
    assert resumed.steps == trained[1].steps
    for a, b in zip(
        load_model(out)[0].state_dict().values(), load_model(trained[0])[0].state_dict().values(), strict=True
    ):
        assert torch.equal(a, b)
    again = train(tiny, dataset, out)
    assert again.finished
    assert again.steps == resumed.steps


def test_another_configuration_does_not_continue_a_run(dataset, tiny, trained):
    """A run folder belongs to one configuration."""
    with pytest.raises(ConfigError, match="another configuration"):
        train(replace(tiny, losses=replace(tiny.losses, delta=0.01)), dataset, trained[0])


def test_fine_tuning_starts_from_weights(dataset, tiny, trained, tmp_path):
    """The first step has the loss of the given weights; weights of another network are refused; the origin is told."""
    config = replace(tiny, training=replace(tiny.training, seed=3))
    train(config, dataset, tmp_path / "new", stop_after=1)
    train(config, dataset, tmp_path / "on", start=trained[1].path)
    first = [
        json.loads((tmp_path / name / "metrics.jsonl").read_text().splitlines()[0])["total"]
        for name in ("new", "on")
    ]
    assert first[1] < first[0]
    provenance = load_model(tmp_path / "on")[2]
    assert provenance["start_sha256"] == sha256_of(trained[1].path)
    other = replace(tiny, network=replace(tiny.network, width=5))
    with pytest.raises(ConfigError, match="expected weights of the configuration's network"):
        train(other, dataset, tmp_path / "other", start=trained[1].path)


def test_a_packed_cache_gives_the_same_weights(dataset, tiny, trained, tmp_path):
    """Training from the flat files of `tofcapture pack` takes the very same steps."""
    pack(dataset, "train", tmp_path / "cache")
    train(tiny, dataset, tmp_path / "run", cache=tmp_path / "cache")
    a, b = (load_model(out)[0].state_dict() for out in (tmp_path / "run", trained[0]))
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_drawn_noise_is_another_one_at_every_step_and_resumes_to_the_same_bits(dataset, tiny, tmp_path):
    """One item a view; a stopped and resumed run has the weights of an unbroken one, other seeds have others."""
    drawn = replace(tiny, training=replace(tiny.training, noise="drawn"))
    train(drawn, dataset, tmp_path / "one")
    train(drawn, dataset, tmp_path / "two", stop_after=1)
    train(drawn, dataset, tmp_path / "two")
    train(replace(drawn, training=replace(drawn.training, seed=1)), dataset, tmp_path / "other")
    one, two, other = (load_model(tmp_path / n)[0].state_dict() for n in ("one", "two", "other"))
    assert all(torch.equal(one[k], two[k]) for k in one)
    assert not all(torch.equal(one[k], other[k]) for k in one)
    data = FrameDataset(dataset, "train", mean=True)
    assert len(data) == 6
    assert data.averaged == 2


def test_a_loss_that_is_not_finite_stops_before_it_spoils_anything(dataset, tiny, tmp_path):
    """An absurd learning rate: a clear error, and the last resume point is finite."""
    config = replace(tiny, stages=(Stage("joint", 50, 1e30),))
    with pytest.raises(DataError, match="finite loss"):
        train(config, dataset, tmp_path / "run")


def test_the_paper_s_stages_run_in_order(dataset, tiny, tmp_path):
    """Depth, normal and refinement train one after the other, with the Chamfer loss, and the budget is shared."""
    paper = preset("paper")
    config = replace(
        paper,
        network=Network(width=2, levels=3, refine_iterations=1),
        training=replace(tiny.training, schedule="constant"),
        stages=(Stage("depth", 1), Stage("normal", 1), Stage("refine", 1)),
    )
    done = train(config, dataset, tmp_path / "run")
    assert done.finished
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[0]["stage"] == "depth"
    assert sum(rows[0]["winners"]) == 3
    state = load_resume(tmp_path / "run" / "resume.safetensors")[2]
    assert state["stage"] == 3
    last = {row["stage"]: row["seconds"] for row in rows if "seconds" in row}
    assert state["before"] >= sum(
        last.values()
    )  # the clock starts anew with each stage; the run's minutes are all of them
    assert load_model(tmp_path / "run")[2]["minutes"] == round(state["before"] / 60, 2)


def test_a_time_budget_ends_a_run(dataset, tiny, tmp_path):
    """A budget shorter than a step still takes one step and finishes."""
    done = train(tiny, dataset, tmp_path / "run", minutes=1e-6)
    assert done.finished
    assert done.steps == 1


def test_checkpoints_are_strict_and_carry_their_configuration(trained, tiny, tmp_path):
    """Weights load with their configuration; a foreign file, and weights that do not fit, are refused."""
    model, config, provenance = load_model(trained[0])
    assert config == tiny
    assert provenance["steps"] == trained[1].steps
    assert not model.training
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    with pytest.raises(FormatError, match="cannot read"):
        load_model(tmp_path / "junk.safetensors")
    with pytest.raises(FormatError, match="expected tofcapture-model"):
        load_model(trained[0] / "resume.safetensors")


def test_evaluation_writes_the_agreed_results(dataset, trained, tmp_path):
    """Both methods, both quantities, both poolings, in metres, on the test split."""
    results = evaluate(dataset, trained[0], tmp_path / "results.json", frames=0)
    assert json.loads((tmp_path / "results.json").read_text()) == results
    assert (results["format"], results["version"], results["split"]) == ("tofcapture-results", 1, "test")
    assert (results["views"], results["frames"], results["scenes"]) == (3, 6, ["scene-2"])
    for method in ("sensor", "model"):
        table = results["methods"][method]
        assert table["depth"]["pixel"]["pixels"] == table["normal"]["pixel"]["pixels"] > 0
        assert 0 < table["depth"]["image"]["mae"] < 0.1
        assert 0 < table["normal"]["pixel"]["mean_deg"] < 90


def test_an_empty_split_is_an_error(dataset):
    """There is no validation scene here."""
    with pytest.raises(DataError, match="split val is empty"):
        FrameDataset(dataset, "val")


def test_predict_writes_every_file_from_a_shard_and_from_an_array(dataset, trained, tmp_path):
    """A shard's frame gives depth, normals, error, PLY and PNG; the same taps as .npy need a rig of their size."""
    shard = dataset / "shards" / "scene-2.h5"
    result = predict(shard, tmp_path / "out", weights=trained[0], view=1, frame=1)
    assert result["shape"] == [180, 240]
    assert result["inference_ms"] > 0
    depth, normals = np.load(tmp_path / "out/depth.npy"), np.load(tmp_path / "out/normals.npy")
    assert depth.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert (tmp_path / "out/cloud.ply").stat().st_size > 28 * depth.size
    reader = FrameDataset(dataset, "test").readers["scene-2"]
    np.save(tmp_path / "raw.npy", reader.raw(1, 1))
    with pytest.raises(DataError, match="expected numbers of shape"):
        predict(tmp_path / "raw.npy", tmp_path / "npy", weights=trained[0])
    from tofcapture.rig import dumps_rig

    (tmp_path / "rig.toml").write_text(dumps_rig(reader.rig))
    predict(tmp_path / "raw.npy", tmp_path / "npy", weights=trained[0], rig=tmp_path / "rig.toml")
    np.testing.assert_allclose(np.load(tmp_path / "npy/depth.npy"), depth, atol=1e-4)
    with pytest.raises(ConfigError, match="frame of 0 to 1"):
        predict(shard, tmp_path / "out", weights=trained[0], frame=7)
    with pytest.raises(DataError, match="no such file"):
        predict(tmp_path / "nothing.npy", tmp_path / "out", weights=trained[0])


def test_png_is_what_a_decoder_reads():
    """16-bit grey and 8-bit colour survive another library's decoder."""
    cv2 = pytest.importorskip("cv2")
    grey = np.random.default_rng(0).integers(0, 65536, (7, 5), dtype=np.uint16)
    colour = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    for image, back in ((grey, slice(None)), (colour, (..., slice(None, None, -1)))):
        data = np.frombuffer(png_bytes(image), np.uint8)
        assert (cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[back] == image).all()


def test_the_commands_run_and_answer_in_json(dataset, trained, tmp_path, capsys):
    """evaluate and predict print one JSON object; a missing device is a configuration error."""
    assert (
        main(
            [
                "evaluate",
                str(dataset),
                "--weights",
                str(trained[0]),
                "--out",
                str(tmp_path / "r.json"),
                "--json",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["methods"].keys() == {"sensor", "model"}
    shard = str(dataset / "shards" / "scene-2.h5")
    assert (
        main(
            [
                "predict",
                shard,
                "--weights",
                str(trained[0]),
                "--out",
                str(tmp_path / "p"),
                "--average",
                "--json",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["inference_ms"] > 0
    assert main(["evaluate", str(dataset), "--weights", str(trained[0]), "--device", "cuda:7"]) == 3
    assert (
        main(["train", str(tmp_path / "no"), "--out", str(tmp_path / "t"), "--preset", "demo", "--seed", "1"])
        == 5
    )


def test_holes_do_not_reach_the_output(dataset, trained):
    """A frame whose middle is saturated still gives a finite answer everywhere."""
    data = FrameDataset(dataset, "test")
    raw = data.readers["scene-2"].raw(0, 0).copy()
    raw[:, 30:50, 40:60] = 4095
    from tofcapture_model.data import make_frame

    reader = data.readers["scene-2"]
    frame = make_frame(raw, reader.info, reader.camera)
    assert frame.valid[0, 35, 45] == 0
    with torch.inference_mode():
        found = load_model(trained[0])[0](batched(frame))
    assert all(torch.isfinite(x).all() for x in found)


def test_whole_frames_and_crops_collate(dataset):
    """Batches keep names, shapes and channels-last order."""
    data = FrameDataset(dataset, "train", (48, 64))
    frame, target = collate([data[(0, i)] for i in range(2)])
    assert frame.raw.shape == (2, 8, 48, 64)
    assert frame.raw.is_contiguous(memory_format=torch.channels_last)
    assert target.good.dtype == torch.bool
    assert data.frame(SampleId("scene-0", 0, 0)) is data.frame(SampleId("scene-0", 0, 0))


@pytest.mark.slow
def test_two_processes_train_together(dataset, tmp_path):
    """torchrun with two CPU processes: one checkpoint, both ranks take part."""
    code = (
        "import sys; from pathlib import Path; from dataclasses import replace\n"
        "from tofcapture_model.config import preset, Stage; from tofcapture_model.train import train\n"
        "c = preset('demo'); c = replace(c, network=replace(c.network, width=2, levels=2), stages=(Stage('joint', 1),),"
        " training=replace(c.training, batch=2, crop=(48, 64)))\n"
        "print(train(c, Path(sys.argv[1]), Path(sys.argv[2])).steps)\n"
    )
    script = tmp_path / "go.py"
    script.write_text(code)
    base = os.environ | {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(29000 + os.getpid() % 900),
        "OMP_NUM_THREADS": "1",
    }
    ranks = [
        subprocess.Popen(
            [sys.executable, str(script), str(dataset), str(tmp_path / "run")],
            env=base | {"RANK": str(r), "LOCAL_RANK": str(r)},
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[1],
        )
        for r in range(2)
    ]
    said = [r.communicate(timeout=120)[0] for r in ranks]
    assert [r.returncode for r in ranks] == [0, 0]
    assert {s.split()[-1] for s in said} == {"3"}
    assert (tmp_path / "run" / "model.safetensors").exists()
