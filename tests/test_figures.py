"""Figures: each kind from small data in each format, the same bytes each run, scales that are said, errors by name."""

import re
import shutil
import subprocess
import sys

import numpy as np
import pytest

from tests import pictures
from tests.test_dataset_build import make_sample, simulate, true_rig
from tests.test_files_shard import write
from tofcapture.cli import main
from tofcapture.colours import percentile, round_up
from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.files.shard import GroundTruth
from tofcapture.files.view import view_path, write_view
from tofcapture.poses import look_at
from tofcapture.rig import dumps_rig
from tofcapture.viz import open_source
from tofcapture.viz.figures.preprocessing import gap, preprocess
from tofcapture.viz.figures.scenes import Maps, read_rows
from tofcapture.viz.shots import eye_for, splat
from tofcapture.viz.sources import scene_views

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def view():
    return simulate("box", 1)


@pytest.fixture(scope="module")
def recording(view, tmp_path_factory):
    """A scene of two views, a board view, and the true rig."""
    root = tmp_path_factory.mktemp("recording")
    for scene, indices in (("box", (1, 2)), ("calibration", (0,))):
        for i in indices:
            found = view if (scene, i) == ("box", 1) else simulate("box" if i else scene, i)
            write_view(view_path(root, scene, i), found)
    (root / "rig.toml").write_text(dumps_rig(true_rig(view)))
    (root / "station.toml").write_text('[arm]\nmodel = "ur10e"\n')
    return root


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two small shards, their manifest, and a prediction of each scene that is its ground truth."""
    folder, entries = tmp_path_factory.mktemp("made") / "data", {}
    (folder / "shards").mkdir(parents=True)
    for scene in ("mug", "box"):
        digest = write(folder / "shards" / f"{scene}.h5", scene=scene)
        entries[scene] = SceneEntry(f"shards/{scene}.h5", digest, 2, "train")
    write_manifest(folder, Manifest(entries))
    for row in read_rows(folder, None, 0, 2, None):
        place = folder.parent / "predictions" / f"{row.name.split()[0]}-000"
        place.mkdir(parents=True)
        np.save(place / "depth.npy", row.truth.depth)
        np.save(place / "normals.npy", row.truth.normals)
    return folder


def _size(data):
    return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])


@pytest.mark.parametrize("kind", ["acquisition", "preprocessing"])
def test_recordings_become_figures(kind, recording, drawn, tmp_path, capsys):
    """1200 pixels wide, the same bytes twice, as it always looked, and the answer says what is on it."""
    outs = [tmp_path / f"{i}.png" for i in (1, 2)]
    for out in outs:
        assert main(["figure", kind, str(recording), "--out", str(out)]) == 0
    data = outs[0].read_bytes()
    assert data == outs[1].read_bytes()
    assert _size(data)[0] == 1200
    pictures.hold(kind, drawn[:1])
    said = capsys.readouterr().out
    assert ("2 arm poses" if kind == "acquisition" else "after alignment") in said


@pytest.mark.parametrize("kind", ["depth", "normals"])
def test_datasets_become_figures(kind, dataset, drawn, tmp_path, capsys):
    """With a prediction and without; a prediction changes the picture, which looks as it did."""
    words = ["figure", kind, str(dataset), "--out"]
    outs = [tmp_path / f"{i}.png" for i in (1, 2)]
    given = ["--prediction", str(dataset.parent / "predictions")]
    for out, more in zip(outs, ([], given), strict=True):
        assert main([*words, str(out), *more]) == 0
    data = [out.read_bytes() for out in outs]
    assert data[0] != data[1]
    assert {_size(d)[0] for d in data} == {1200}
    pictures.hold(kind, drawn)
    assert "2 scenes, scale of errors" in capsys.readouterr().out


@pytest.mark.parametrize(("form", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_files_are_the_same_each_run(form, start, dataset, tmp_path):
    """No date and no random mark; somebody's matplotlibrc changes nothing."""
    import matplotlib as mpl

    shard = str(dataset / "shards" / "mug.h5")
    out = tmp_path / f"x.{form}"
    made = []
    for size in (10.0, 20.0):
        with mpl.rc_context({"font.size": size, "lines.linewidth": size}):
            assert main(["figure", "depth", shard, "--out", str(out)]) == 0
            assert mpl.rcParams["font.size"] == size
        made.append(out.read_bytes())
    assert made[0].startswith(start)
    assert made[0] == made[1]


def test_help_does_not_import_matplotlib():
    """Neither the command nor its help loads matplotlib or h5py."""
    code = (
        "import sys\ntry:\n    from tofcapture.cli import main; main(['figure', '--help'])\n"
        "except SystemExit:\n    pass\n"
        "print([m for m in ('matplotlib', 'h5py', 'numpy') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


def test_errors_are_those_of_good_ground_truth_only():
    """Signed millimetres and degrees where the mask is 0, nothing elsewhere; small angles are exact."""
    depth = np.array([[1.0, 1.0, np.nan]], np.float32)
    truth_normals = np.broadcast_to(np.float32([0, 0, -1]), (1, 3, 3))
    mask = np.array([[0, MaskBit.EDGE, 0]], np.uint8)
    angle = np.radians(0.01)
    normals = np.broadcast_to(np.float32([np.sin(angle), 0, -np.cos(angle)]), (1, 3, 3))
    maps = Maps(depth - np.float32(0.002), normals, GroundTruth(depth, truth_normals, mask))
    assert maps.error_mm[0, 0] == pytest.approx(-2, abs=1e-3)
    assert np.isnan(maps.error_mm[0, 1:]).all()
    assert maps.angle_deg[0, 0] == pytest.approx(0.01, rel=1e-4)
    assert np.isnan(maps.angle_deg[0, 1])


def test_a_perfect_prediction_has_no_error(dataset):
    """Predictions are found by scene and compared with ground truth at twice the resolution."""
    rows = read_rows(dataset, None, 0, 2, dataset.parent / "predictions")
    assert [row.name.split()[0] for row in rows] == ["box", "mug"]
    for row in rows:
        assert np.nanmax(np.abs(row.methods["prediction"].error_mm)) == 0
        rows, columns = row.window
        inside = np.zeros(row.truth.mask.shape, bool)
        inside[rows, columns] = True
        assert inside[row.truth.mask == 0].mean() > 0.95
        assert row.shown(row.amplitude).shape == tuple((s.stop - s.start) // 2 for s in (rows, columns))


def test_scales_end_at_round_numbers():
    """The next of a short list; never below the value; something for nothing."""
    for value in (1e-3, 0.9, 1.0, 1.01, 7.6, 123.0):
        assert value <= round_up(value) <= 1.7 * value
    assert round_up(0.0) == round_up(float("nan")) == 1.0
    assert percentile([np.array([np.nan])], 50, 3.0) == 3.0


def test_a_recording_of_the_board_alone_is_drawn(recording, tmp_path):
    """Where no scene is, the board is what there is to see."""
    copied = tmp_path / "board"
    shutil.copytree(recording / "views/calibration", copied / "views/calibration")
    assert [p.name for p in scene_views(copied)] == ["view-000.h5"]
    assert main(["figure", "acquisition", str(copied), "--out", str(tmp_path / "x.png")]) == 0
    kinds = [(panel.title, panel.kind) for panel in open_source(copied).load(0).panels]
    assert kinds == [
        ("ToF amplitude", "amplitude"),
        ("ToF depth", "depth"),
        ("stereo depth", "depth"),
        ("exact depth (simulated)", "depth"),
    ]


def test_nearer_points_cover_farther_ones():
    """The eye sees the cloud in front, whatever order clouds come in; nothing is drawn for no points."""
    T = look_at(np.array([0.5, 0.0, 1.0]), np.zeros(3))
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 80), np.linspace(-0.1, 0.1, 80))
    sheet = np.stack([x, y, np.full_like(x, 1.1)], axis=-1).reshape(-1, 3)
    eye = eye_for(sheet, T)
    away = np.linalg.inv(eye.T_eye_tof)[:3, 2]
    near, far = (sheet, (255, 0, 0)), (sheet + 0.05 * away, (0, 0, 255))
    for clouds in ([near, far], [far, near]):
        image = splat(clouds, eye, 60, 3)
        middle = image[20:26, 27:33].reshape(-1, 3)
        assert (middle[:, 0] > 0).all()
        assert (middle[:, 2] == 0).all()
    assert (splat([(np.full((3, 3), np.nan), (0, 0, 0))], eye, 60) == 255).all()


def test_up_is_up():
    """What is higher in the base frame is higher in the picture, and left stays left of the eye's own axes."""
    T = look_at(np.array([0.5, 0.2, 1.0]), np.zeros(3))
    eye = eye_for(np.zeros((1, 3)), T)
    up_eye = eye.T_eye_tof[:3, :3] @ T[:3, :3].T @ [0, 0, 1]
    assert up_eye[1] < -0.9
    assert up_eye[0] == pytest.approx(0, abs=1e-12)
    assert np.linalg.det(eye.T_eye_tof[:3, :3]) == pytest.approx(1)


def test_preprocessing_is_what_the_dataset_keeps(view):
    """The denoised cloud is the native ground truth of the sample, and alignment brings the clouds together."""
    rig = true_rig(view)
    steps = preprocess(view, rig)
    sample = make_sample(view, rig)
    native = int(np.isfinite(sample.native_depth).sum())
    assert abs(len(steps.kept) - native) <= 0.02 * native
    assert 0 < len(steps.removed) < len(steps.kept)
    assert steps.after < steps.before
    tof = rig.tof.unproject(np.full(rig.tof.shape, 0.5))
    assert gap(tof.reshape(-1, 3), tof[..., 2] + 0.01, rig) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["depth", "{data}", "--out", "x.gif"], 2, ".png, .pdf or .svg"),
        (["depth", "{data}", "--out", "x.png", "--rig", "rig.toml"], 2, "--rig: only for preprocessing"),
        (["acquisition", "{rec}", "--out", "x.png", "--rows", "2"], 2, "--rows: only for depth"),
        (["depth", "{data}", "--out", "x.png", "--rows", "0"], 2, "--rows"),
        (["flowers", "{data}", "--out", "x.png"], 2, "flowers"),
        (["depth", "{data}", "--out", "x.png", "--scene", "cup"], 5, "no scene cup"),
        (["depth", "{data}", "--out", "x.png", "--view", "9"], 5, "expected a view of 0 to 1"),
        (["depth", "{rec}", "--out", "x.png"], 5, "expected a dataset or a shard"),
        (["depth", "{tmp}/none", "--out", "x.png"], 5, "no such file"),
        (["depth", "{data}", "--out", "x.png", "--prediction", "{tmp}"], 5, "no prediction of box 0"),
        (
            ["depth", "{data}", "--out", "x.png", "--prediction", "{data}/../predictions/box-000"],
            2,
            "--scene",
        ),
        (["acquisition", "{data}", "--out", "x.png"], 5, "expected a recording"),
        (["acquisition", "{rec}/views/box/view-001.h5", "--out", "x.png"], 5, "got a file"),
        (["preprocessing", "{rec}", "--out", "x.png", "--view", "7"], 5, "no view 7"),
        (["preprocessing", "{rec}", "--out", "x.png", "--scene", "cup"], 5, "no scene cup"),
        (["preprocessing", "{rec}", "--out", "x.png", "--rig", "{tmp}/no.toml"], 5, "no.toml does not exist"),
    ],
)
def test_mistakes_are_said(words, code, said, recording, dataset, tmp_path, capsys, monkeypatch):
    """A sentence that names the mistake, a hint, the right exit code, and no file."""
    monkeypatch.chdir(tmp_path)
    places = {"rec": recording, "data": dataset, "tmp": tmp_path}
    assert main(["figure", *(w.format(**places) for w in words)]) == code
    err = capsys.readouterr().err
    assert said in err
    assert len(err.splitlines()) <= 5
    assert not list(tmp_path.glob("x.*"))


def test_predictions_of_another_camera_are_refused(dataset, tmp_path, capsys):
    """Both shapes are named; what was there before stays."""
    shutil.copytree(dataset.parent / "predictions", tmp_path / "predictions")
    np.save(tmp_path / "predictions" / "box-000" / "depth.npy", np.ones((3, 3), np.float32))
    out = tmp_path / "x.png"
    out.write_bytes(b"before")
    words = [
        "figure",
        "depth",
        str(dataset),
        "--prediction",
        str(tmp_path / "predictions"),
        "--out",
        str(out),
    ]
    assert main(words) == 5
    assert re.search(r"expected depth of \(12, 16\).*got \(3, 3\)", capsys.readouterr().err)
    assert out.read_bytes() == b"before"
