"""The report: one file that stands alone, says every number in millimetres, and tolerates missing parts."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

import h5py
import torch

from tests import answers, pictures
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, ShardWriter, TofMaps
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.phase import taps
from tofcapture.poses import look_at
from tofcapture.rig import SPEED_OF_LIGHT, Rig
from tofcapture_model.config import preset
from tofcapture_model.evaluation.evaluate import VERSION as RESULTS_VERSION
from tofcapture_model.networks import build_model
from tofcapture_model.networks.checkpoint import save_model
from tofcapture_model.report import write_report
from tofcapture_model.report.content import POOLS, headline, loss_curve, origin_of, tables, tiles
from tofcapture_model.report.examples import choose
from tofcapture_model.training import read_metrics

CAMERA = Camera(64, 48, 50.0, 52.0, 31.0, 24.5)
SECTIONS = ("numbers", "examples", "alignment", "rig", "made", "limits")
EVIL = "<b>mug</b>&\"'"


def ball_on_wall(index):
    """Depth, normals and mask at 2x of a ball before a wall, seen straight on; the ball is the object."""
    fine = CAMERA.scaled(2)
    rays = fine.rays / fine.ray_lengths[..., None]
    centre, radius = np.array([0.01 * index, 0.0, 0.7]), 0.12
    b = rays @ centre
    inside = b**2 - centre @ centre + radius**2
    hit = inside > 0
    t = np.where(hit, b - np.sqrt(np.maximum(inside, 0)), 0.9 / rays[..., 2])
    normals = np.where(hit[..., None], (t[..., None] * rays - centre) / radius, [0.0, 0.0, -1.0])
    mask = np.where(hit, 0, 16).astype(np.uint8)
    mask[:, :6] |= 1
    depth = np.where(mask & 1, np.nan, t * rays[..., 2]).astype(np.float32)
    normals = np.where((mask & 1)[..., None], np.nan, normals).astype(np.float32)
    return depth, normals, mask, t


def sample(index, frames=2):
    """One view as the shard writer takes it."""
    depth, normals, mask, radial = ball_on_wall(index)
    info = TofInfo("synthetic", "0", CAMERA, np.zeros(3))
    hz = np.unique(info.modulation_hz)[:, None, None]
    z = 500 * np.exp(1j * 4 * np.pi * hz * radial[::2, ::2] / SPEED_OF_LIGHT)
    clean = taps(z, np.full(z.shape, 900.0), info.modulation_hz, info.phase_rad)
    noise = np.random.default_rng(index).normal(0, 8, (frames, *clean.shape))
    coarse = GroundTruth(depth[::2, ::2], normals[::2, ::2], mask[::2, ::2])
    maps = TofMaps(depth[::2, ::2], np.full(CAMERA.shape, 500, np.float32), np.zeros(CAMERA.shape, bool))
    return Sample(
        index=index,
        raw=np.clip(np.rint(clean + noise), 0, 4095).astype(np.uint16),
        celsius=np.full(frames, 45.0),
        time_ns=np.arange(frames),
        tof=maps,
        native_depth=np.full((8, 10), np.nan, np.float32),
        ground_truth={1: coarse, 2: GroundTruth(depth, normals, mask)},
        T_base_tof=look_at([0.5, 0.3, 0.6], [0, 0, 0.05]),
        truth=ExactMaps(depth, normals),
    )


def write_dataset(folder, scene="ball", views=2, model="synthetic"):
    """A dataset of one test scene."""
    stereo = StereoInfo("none", "0", Camera(10, 8, 10, 10, 4.5, 3.5))
    T_tof_stereo = np.eye(4)
    T_tof_stereo[0, 3] = 0.0615
    rig = Rig(CAMERA, stereo.camera, T_tof_stereo, np.eye(4))
    info = TofInfo(model, "0", CAMERA, np.zeros(3))
    path = folder / "shards/one.h5"
    path.parent.mkdir(parents=True)
    gt = {"median_error_mm": 0.42, "p99_error_mm": 2.5, "pixels": 9, "target_pixels": 10, "coverage": 0.9}
    with ShardWriter(path, scene, rig, info, stereo, views) as shard:
        for view in range(views):
            shard.add(sample(view))
        digest = shard.seal({"gt": gt})
    write_manifest(
        folder, Manifest({scene: SceneEntry("shards/one.h5", digest, views, "test")}, {}, {"numpy": "2"})
    )
    return folder


def results_table(scene="ball", provenance=None):
    """A results.json with easily found numbers."""

    def method(mae, angle):
        depth = {
            "mae": mae,
            "median": mae / 2,
            "rmse": 2 * mae,
            "bias": -mae / 4,
            "within_10mm": 0.5,
            "pixels": 7,
        }
        normal = {"mean_deg": angle, "within_20deg": 0.75, "pixels": 7}
        return {"depth": {"pixel": depth, "image": depth}, "normal": {"pixel": normal, "image": normal}}

    return {
        "format": "tofcapture-results",
        "version": RESULTS_VERSION,
        "dataset": "d",
        "split": "test",
        "scenes": [scene],
        "views": 2,
        "frames": 2,
        "units": "m",
        "training": provenance,
        "methods": {"sensor": method(0.0123456, 20.5), "model": method(0.0034567, 7.25)},
    }


def suite_table(scene="ball", **runs):
    """A results.json of a suite: the sensor, a method without parameters, networks by the names of their runs."""
    table = results_table(scene)
    del table["training"]
    sensor, model = table["methods"].values()
    worse = json.loads(json.dumps(model))
    worse["depth"]["pixel"]["mae"] = 0.02
    names = dict.fromkeys(key.rpartition("#")[0] for key in runs)
    methods = {"sensor": sensor, "lf2": sensor} | dict(zip(names, (model, worse), strict=False))
    return table | {"suite": "main", "runs": runs, "methods": methods, "spread": {}}


def evidence_table(**changes):
    """An evidence.json of three good pairs and a refused one."""

    def pair(i, reason=""):
        far = None if reason else 0.02
        return {
            "view": f"views/calibration/view-{i:03}.h5",
            "accepted": not reason,
            "reason": reason,
            "rmse_mm": 1.5 + i,
            "inliers": 4000,
            "fitness": 0.8,
            "condition": 120.0,
            "rotation_from_mean_deg": far,
            "translation_from_mean_mm": far,
        }

    def check(*words):
        return dict(zip(("words", "value", "limits", "verdict"), words, strict=True)) | {"cause": ""}

    T = np.eye(4)
    T[0, 3] = 0.0615
    small = {"rotation_deg": 0.02, "translation_mm": 0.2}
    return {
        "format": "tofcapture-evidence",
        "version": 1,
        "backend": "open3d",
        "views": 4,
        "used": 3,
        "T_tof_stereo": T.tolist(),
        "initial_T_tof_stereo": np.eye(4).tolist(),
        "spread": small,
        "standard_error": small,
        "pairs": [*(pair(i) for i in range(3)), pair(3, "planar-degenerate")],
        "truth": {"rotation_error_deg": 0.031, "translation_error_mm": 0.77},
        "verdict": "WARN",
        "checks": [
            check("board views used", "3", "PASS from 8, WARN from 3", "WARN"),
            check("against the true rig, a point at 0.8 m", "0.770 mm", "PASS to 1, WARN to 3 mm", "PASS"),
        ],
    } | changes


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Dataset, results, evidence and weights on disk."""
    folder = tmp_path_factory.mktemp("report")
    torch.manual_seed(0)
    config = replace(preset("demo"), network=replace(preset("demo").network, width=4, windows=(2,)))
    provenance = {"steps": 3}
    save_model(folder / "model/model.safetensors", build_model(config), config, provenance)
    rows = [{"step": s, "stage": "joint", "total": 5.0 / s} for s in (1, 21, 41)]
    rows.append({"step": 41, "stage": "joint", "val_mae": 0.00876, "val_angle_deg": 9.5})
    (folder / "model/metrics.jsonl").write_text(
        "".join(json.dumps(r) + "\n" for r in rows) + '{"step": 61, "tot'
    )
    (folder / "results.json").write_text(json.dumps(results_table(provenance=provenance)))
    (folder / "evidence.json").write_text(json.dumps(evidence_table()))
    write_dataset(folder / "dataset")
    return {
        "dataset": folder / "dataset",
        "results": folder / "results.json",
        "evidence": folder / "evidence.json",
        "weights": folder / "model",
    }


@pytest.fixture(scope="module")
def charts():
    """Pixels of the charts of the whole page."""
    return []


@pytest.fixture(scope="module")
def page(parts, charts, tmp_path_factory):
    """The whole page."""
    out = tmp_path_factory.mktemp("out") / "report.html"
    with pytest.MonkeyPatch.context() as patch:
        seen = pictures.watch_matplotlib(patch)
        write_report(**parts, out=out)
    charts += seen
    return out.read_text(encoding="utf-8")


def test_page_looks_as_it_did(page, charts):
    """Charts of rig and loss, every picture of the sensor and of ground truth, and its words and numbers."""
    torch_here = [(torch.__version__, "TORCH")]  # its build is said too: +cpu, +cu130
    answers.hold("report-page", answers.of_page(page), off=0.02, least=1e-3, names=torch_here)
    pictures.hold("report", charts)
    pictures.hold("report-views", pictures.of_page(page))


class Tags(HTMLParser):
    """Collects tags, and checks that they are nested well."""

    VOID = frozenset({"meta", "img", "br"})

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.seen = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_stands_alone(page):
    """No script, no handler, no address but data and anchors of the page itself, well-nested tags."""
    tags = Tags(page)
    assert tags.open == []
    assert not {tag for tag, _ in tags.seen} & {"script", "link", "iframe", "object", "embed", "base"}
    for _, attrs in tags.seen:
        assert not [name for name in attrs if name.startswith("on")]
        for name in ("src", "href", "srcset", "data", "action"):
            assert attrs.get(name, "#").startswith(("data:image/png;base64,", "#"))
    assert not re.search(r"https?:|url\((?!#)|@import", re.sub(r"base64,[\w+/=]+", "", page))


def test_page_holds_every_section_and_its_anchors_lead_somewhere(page):
    """All sections are there, and every link of the page has its target."""
    tags = Tags(page).seen
    ids = {attrs["id"] for _, attrs in tags if "id" in attrs}
    assert set(SECTIONS) <= ids
    assert {attrs["href"][1:] for tag, attrs in tags if tag == "a"} <= ids
    assert "Absent" not in page
    assert len(_pictures(page)) == 2 * 15  # two views, five groups of three
    assert page.count('<svg class="chart"') == 3  # the rig from two sides, the loss


def _pictures(page):
    """Alternative texts and sizes of the pictures of views."""
    return [attrs for tag, attrs in Tags(page).seen if tag == "img" and attrs.get("alt")]


def test_numbers_are_millimetres(page):
    """What results, evidence, ground truth and validation say in metres stands there in millimetres."""
    for text in (
        "12.35",
        "3.46",
        "20.50",
        "7.25",
        "72 % less",
        "0.42 mm",
        "8.76",
        "0.770 mm",
        "0.061500",
        "(61.50, 0.00, 0.00) mm",
    ):
        assert text in page
    assert "0.0034567" not in page
    assert "simulated station" in page


def test_pictures_have_words(page):
    """Every picture of a view has an alternative text that names the view, and a size."""
    figures = _pictures(page)
    assert all("ball, view" in f["alt"] and int(f["width"]) > 0 and int(f["height"]) > 0 for f in figures)


def test_page_is_small(page):
    """Two views of a small camera take far less than the eight megabytes of a whole report."""
    assert len(page) < 1_500_000


def test_same_inputs_same_bytes(parts, page, tmp_path):
    """Nothing but the inputs gets into the page: no clock, no temporary name, no number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(3 - min(before, 2))
    again = write_report(**parts, out=tmp_path / "b" / "b.html")
    assert torch.get_num_threads() == 3 - min(before, 2)
    torch.set_num_threads(before)
    assert again.read_text(encoding="utf-8") == page


def test_names_are_escaped(tmp_path):
    """Markup in a scene's name, a camera's model or a refusal's reason shows as text, from whatever file it comes."""
    dataset = write_dataset(tmp_path / "d", views=1, model="<i>camera</i>")
    shard = dataset / "shards/one.h5"
    shard.chmod(0o644)
    with h5py.File(shard, "r+") as file:
        file.attrs["scene"] = EVIL
    write_manifest(dataset, Manifest({EVIL: SceneEntry("shards/one.h5", sha256_of(shard), 1, "test")}))
    (tmp_path / "r.json").write_text(json.dumps(results_table(EVIL)))
    evidence = evidence_table()
    evidence["pairs"][3]["reason"] = "<u>because</u>"
    (tmp_path / "e.json").write_text(json.dumps(evidence))
    out = write_report(
        dataset, tmp_path / "r.json", tmp_path / "e.json", tmp_path / "none", tmp_path / "o.html"
    )
    page = out.read_text()
    assert not re.search("<b>mug|<i>camera|<u>because", page)
    for text in ("&lt;b&gt;mug&lt;/b&gt;&amp;", "&lt;i&gt;camera", "&lt;u&gt;because"):
        assert text in page
    assert Tags(page).open == []


@pytest.mark.parametrize("missing", ["dataset", "results", "evidence"])
def test_missing_parts_are_named(parts, tmp_path, missing):
    """Without a part its section says so; all sections are there all the same."""
    page = write_report(**{**parts, missing: None}, out=tmp_path / "o.html", views=1).read_text()
    assert "Absent" in page
    assert f"--{missing}" in page
    assert set(SECTIONS) <= {attrs.get("id") for _, attrs in Tags(page).seen}


def test_missing_files_are_named(parts, tmp_path):
    """Evidence and weights that are not where they should be are reported, and the sensor is shown alone."""
    gone = {"evidence": tmp_path / "gone.json", "weights": tmp_path / "gone"}
    page = write_report(**{**parts, **gone}, out=tmp_path / "o.html", views=1).read_text()
    assert "gone.json" in page
    assert "there is no checkpoint at" in page
    assert len(_pictures(page)) == 3 + 2 + 1 + 2 + 2


def test_damage_is_an_error(parts, tmp_path):
    """Nothing to report, results that are not there, and files of another format are refused."""
    with pytest.raises(ConfigError, match="nothing to report"):
        write_report(None, None, None, None, tmp_path / "o.html")
    with pytest.raises(DataError, match="no such file"):
        write_report(None, tmp_path / "gone.json", None, None, tmp_path / "o.html")
    with pytest.raises(FormatError, match="tofcapture-results"):
        write_report(None, parts["evidence"], None, parts["weights"], tmp_path / "o.html")
    (tmp_path / "half.json").write_text('{"format": "tofcapture-evidence"')
    with pytest.raises(FormatError, match="not JSON"):
        write_report(**{**parts, "evidence": tmp_path / "half.json"}, out=tmp_path / "o.html")
    assert not (tmp_path / "o.html").exists()


def test_doubts_are_told(parts, tmp_path):
    """Results of other weights, and of other scenes than the dataset holds, put a warning on the page."""
    (tmp_path / "r.json").write_text(json.dumps(results_table("another", {"steps": 99})))
    page = write_report(
        **{**parts, "results": tmp_path / "r.json"}, out=tmp_path / "o.html", views=1
    ).read_text()
    assert "other weights than the table" in page
    assert "other scenes than" in page


def test_a_suite_s_networks_have_a_sentence_each_and_the_best_has_the_tiles():
    """By their names, the mean of runs as one; without any network the other method is told, and a lone sensor has no tiles."""
    runs = {"ours#0": {}, "ours#1": {}, "a#b#0": {}}
    results = suite_table(**runs)
    text = headline(results)
    assert "ours (mean of 2 runs) is 3.46 mm off in depth on average" in text
    assert "72 % less" in text
    assert "a#b is 20.00 mm off in depth" in text
    assert "62 % more" in text
    assert "lf2" not in text
    assert tiles(results)[0] == ("depth error, mean", "3.46 mm", "ours, best of 2; sensor 12.35 mm")
    assert tiles(suite_table(**{"ours#0": {}}))[0][2] == "ours; sensor 12.35 mm"
    assert "lf2 is 12.35 mm off in depth" in headline(suite_table())
    assert tiles({"methods": {"sensor": {}}, "runs": {}}) == []


def test_doubts_about_a_suite_s_runs_are_told(parts, tmp_path):
    """Every run that knows a scene or does not tell, and pictures by weights of none of them; nothing where one has made them."""
    seen = {"ball": "object ball"}
    runs = {
        "new#0": {"training": {"steps": 1}, "not_new": {}},
        "new#1": {"training": {"steps": 2}, "not_new": seen},
        "old#0": {"training": {"steps": 4}, "not_new": None},
    }

    def page(table):
        (tmp_path / "r.json").write_text(json.dumps(table))
        given = {**parts, "results": tmp_path / "r.json"}
        return write_report(**given, out=tmp_path / "o.html", views=1).read_text()

    text = page(suite_table(**runs))
    assert "new#1: 1 of 1 scenes are not new to it: ball (object ball)." in text
    assert "old#0: its checkpoint does not tell" in text
    assert "new#0" not in text
    assert "other weights than the table" in text
    assert "nothing to compare" not in text
    assert "other weights" in page(suite_table())
    runs["new#0"]["training"] = {"steps": 3}
    assert "other weights" not in page(suite_table(**runs))


def test_a_table_of_some_scenes_is_told(parts, tmp_path):
    """Scenes of the split that were left out are no other scenes."""
    dataset = tmp_path / "two"
    manifest = load_manifest(parts["dataset"])
    (entry,) = manifest.scenes.values()
    (dataset / "shards").mkdir(parents=True)
    (dataset / entry.path).symlink_to(parts["dataset"] / entry.path)
    write_manifest(dataset, replace(manifest, scenes={"ball": entry, "box": entry}))
    page = write_report(**{**parts, "dataset": dataset}, out=tmp_path / "o.html", views=1).read_text()
    assert "measured on 1 of the 2 scenes of this dataset" in page
    assert "other scenes than" not in page


def test_command_writes_the_page(parts, tmp_path, capsys):
    """The command line reaches it, and --json tells where the page is."""
    out = tmp_path / "o.html"
    words = [
        w for name in ("dataset", "results", "evidence", "weights") for w in (f"--{name}", str(parts[name]))
    ]
    assert main(["report", *words, "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["report"], answer["bytes"]) == (str(out), out.stat().st_size)


def test_better_value_is_marked():
    """Less is better for errors, more for shares, nearer to zero for the bias; equal print is no win."""
    results = results_table()
    results["methods"]["sensor"]["depth"]["pixel"]["bias"] = -0.0001
    rows = {words: [best for _, best in cells] for table in tables(results) for words, cells in table.rows}
    assert rows["MAE (mean absolute error), mm"] == [False, True, False, True]
    assert rows["mean signed error, mm"][:2] == [True, False]
    assert not any(rows["within 10 mm, %"])


def test_headline_says_when_the_network_is_worse():
    """The sentence does not flatter."""
    results = results_table()
    results["methods"] = dict(zip(("model", "sensor"), results["methods"].values(), strict=True))
    assert "257 % more" in headline(results)
    empty = results_table() | {"methods": {"sensor": {"depth": {"pixel": {"pixels": 0}}}}}
    assert "nothing to compare" in headline(empty)


def test_the_verdict_is_that_of_the_evidence(parts, page, tmp_path):
    """The page shows what align has judged, row by row, and a refused view; older evidence is told apart."""
    for check in evidence_table()["checks"]:
        cells = (check["words"], check["value"], check["verdict"], check["limits"])
        row = next(r for r in re.findall("<tr>.*?</tr>", page) if f">{check['words']}<" in r)
        assert re.findall("<td[^>]*>(.*?)</td>", row) == list(cells)
    assert '<b class="WARN">WARN</b><span>3 of 4 board views</span>' in page
    assert "refused: planar-degenerate" in page
    old = evidence_table()
    del old["checks"], old["verdict"]
    (tmp_path / "e.json").write_text(json.dumps(old))
    page = write_report(
        **{**parts, "evidence": tmp_path / "e.json"}, out=tmp_path / "o.html", views=1
    ).read_text()
    assert "run tofcapture align again" in page
    assert "not judged" in page


def test_rig_of_another_alignment_is_told():
    """A dataset that was built with another transform than the evidence describes says by how much."""
    T = np.eye(4)
    T[0, 3] = 0.0615
    rig = Rig(CAMERA, CAMERA, T, np.eye(4))
    assert origin_of(rig, evidence_table()).startswith("calibrated")
    other = evidence_table(T_tof_stereo=np.eye(4).tolist())
    assert "61.50 mm apart" in origin_of(rig, other)


def test_training_curve_survives_a_cut_line(parts):
    """A line that a kill cut short is skipped; a curve needs two points."""
    rows = read_metrics(parts["weights"] / "metrics.jsonl")
    assert [r["step"] for r in rows] == [1, 21, 41, 41]
    curve, words = loss_curve(rows)
    assert curve == {"stage joint": ([1, 21, 41], [5.0, 5.0 / 21, 5.0 / 41])}
    assert words == "from 5 at step 1 to 0.122 at step 41"
    assert loss_curve(rows[:1]) == ({}, "")
    assert read_metrics(parts["weights"] / "none.jsonl") == []


def test_views_are_taken_evenly():
    """The choice covers the split and does not depend on anything but names and counts."""
    entry = SceneEntry("shards/a.h5", "0", 4, "test")
    manifest = Manifest({"b": entry, "a": entry, "c": SceneEntry("shards/c.h5", "0", 4, "train")})
    assert choose(manifest, "test", 4) == [("a", 0), ("a", 2), ("b", 0), ("b", 2)]
    assert len(choose(manifest, "test", 99)) == 8
    assert choose(manifest, "val", 3) == []


METRICS = {
    "MAE (mean absolute error), mm": ("mae", 1000),
    "median absolute error, mm": ("median", 1000),
    "RMSE (root mean square), mm": ("rmse", 1000),
    "mean signed error, mm": ("bias", 1000),
    "within 10 mm, %": ("within_10mm", 100),
}


def test_pools_stand_over_their_numbers():
    """Pixels first, images second, in millimetres and percent."""
    results = results_table()
    depth = results["methods"]["model"]["depth"]
    depth["image"] = {key: 1.5 * value for key, value in depth["pixel"].items()}
    table = tables(results)[0]
    assert list(POOLS) == ["pixel", "image"]
    at = table.methods.index("network")
    assert [words for words, _ in table.rows] == list(METRICS)
    for words, cells in table.rows:
        key, factor = METRICS[words]
        for k, pool in enumerate(POOLS):
            text, _ = cells[k * len(table.methods) + at]
            assert float(text) == pytest.approx(factor * depth[pool][key], abs=0.005)


def test_tiles_show_what_they_say():
    """The share within 10 mm is no other share."""
    results = results_table()
    for k, method in enumerate(results["methods"].values()):
        method["depth"]["pixel"] |= {f"within_{mm}mm": (mm + k) / 100 for mm in (5, 10, 20, 50)}
    _, number, beside = next(tile for tile in tiles(results) if tile[0] == "depth within 10 mm")
    assert number == "11.0 %"
    assert beside.endswith("sensor 10.0 %")
