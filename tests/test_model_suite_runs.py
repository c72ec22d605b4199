"""The command evaluate over several runs: what it refuses at once, what it keeps, which scenes it counts, how its tables rank and escape."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

import json
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tofcapture.cli import main
from tofcapture.files.manifest import load_manifest, write_manifest
from tofcapture_model.config import preset
from tofcapture_model.evaluation import evaluate, suite
from tofcapture_model.evaluation.tables import SUITES, Column, Suite, cells, write_tables
from tofcapture_model.networks import build_model
from tofcapture_model.networks.checkpoint import find_model, learned_from, save_model

COLUMN = Column("mm", ("mae",))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A training scene, and two test scenes of which one holds the same object."""
    told = (["mug"], ["mug"], ["plate"])
    folder = tmp_path_factory.mktemp("suite-runs") / "dataset"
    return make_dataset(folder, views=1, scale=4, splits=("train", "test", "test"), objects=told)


@pytest.fixture(scope="module")
def weights(dataset, tmp_path_factory):
    """Three untrained networks that remember the training scene."""
    folder = tmp_path_factory.mktemp("suite-runs")
    for name, seed in (("one", 1), ("two", 2), ("three", 3)):
        torch.manual_seed(seed)
        base = preset("demo")
        config = replace(base, network=replace(base.network, width=4, levels=2))
        model = build_model(config)
        for p in model.parameters():
            torch.nn.init.normal_(p, std=0.01)  # heads start at zero, where all networks are one
        known = {"steps": seed, "minutes": 1.0, "learned": learned_from([dataset])}
        save_model(folder / name / "model.safetensors", model, config, known)
    return folder


def evaluated(dataset, out, *words):
    """Run the command; its exit code."""
    return main(["evaluate", str(dataset), "--out", str(out), *map(str, words)])


def two_runs(weights):
    """Options of a suite of two networks."""
    return "--suite", "main", "--weights", f"one={weights / 'one'}", f"two={weights / 'two'}"


@pytest.fixture
def nothing_is_measured(monkeypatch):
    """Fail as soon as something is measured."""

    def measured(*_):
        raise AssertionError

    monkeypatch.setattr(suite, "measure", measured)
    monkeypatch.setattr(evaluate, "score", measured)


@pytest.fixture
def measured(monkeypatch):
    """Names of what is measured, in its order."""
    names, measure = [], suite.measure

    def listed(data, methods, *rest):
        names.append(", ".join(methods))
        return measure(data, methods, *rest)

    monkeypatch.setattr(suite, "measure", listed)
    return names


@pytest.mark.usefixtures("nothing_is_measured")
@pytest.mark.parametrize("words", [(), ("--suite", "main")], ids=["one", "suite"])
def test_an_out_that_cannot_be_written_is_refused_before_measuring(dataset, weights, tmp_path, capsys, words):
    """A folder, and a file below a file."""
    given = ("--weights", f"one={weights / 'one'}" if words else weights / "one")
    assert evaluated(dataset, tmp_path, *words, *given) == 3
    assert "is a folder" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert evaluated(dataset, tmp_path / "file" / "r.json", *words, *given) == 3
    assert "cannot be written" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.usefixtures("nothing_is_measured")
def test_damaged_weights_are_told_before_measuring(dataset, weights, tmp_path, capsys):
    """The second of two networks lacks its end."""
    whole = (weights / "two" / "model.safetensors").read_bytes()
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(whole[:-1000])
    words = ("--suite", "main", "--weights", f"one={weights / 'one'}", f"wrong={cut}")
    assert evaluated(dataset, tmp_path / "r.json", *words) == 5
    assert str(cut) in capsys.readouterr().err


def test_an_interrupted_suite_goes_on(dataset, weights, tmp_path, capsys, measured, monkeypatch):
    """What was measured is not measured again, is said, and the results are those of a call that nobody interrupted."""
    out, words = tmp_path / "r.json", two_runs(weights)
    listed = suite.measure

    def impatient(data, methods, *rest):
        if "two" in methods:
            raise KeyboardInterrupt
        return listed(data, methods, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(suite, "measure", impatient)
        assert evaluated(dataset, out, *words) == 130
    assert measured == ["sensor, lf2", "one"]
    assert not out.exists()
    measured.clear()
    capsys.readouterr()
    assert evaluated(dataset, out, *words) == 0
    assert measured == ["two"]
    said = capsys.readouterr().err
    assert f"sensor, lf2: measured before, taken from {tmp_path / 'r.runs.json'}" in said
    assert "one: measured before" in said
    assert "two: measured before" not in said
    assert evaluated(dataset, tmp_path / "whole.json", *words) == 0
    assert json.loads(out.read_text()) == json.loads((tmp_path / "whole.json").read_text())


def test_runs_of_other_conditions_are_measured_anew(dataset, weights, tmp_path, measured, monkeypatch):
    """Other frames, scenes, manifest, code or weights under the same name; what is damaged counts as nothing."""
    out, words = tmp_path / "r.json", two_runs(weights)
    every = ["sensor, lf2", "one", "two"]

    def again(*changes):
        measured.clear()
        assert evaluated(dataset, out, *words, *changes) == 0
        return list(measured)

    assert again() == every
    assert again() == []
    assert again("--weights", f"one={weights / 'two'}", f"two={weights / 'three'}") == ["two"]
    assert again("--frames", "1") == every
    assert again("--frames", "1", "--scenes", "scene-2") == every
    assert again("--frames", "1", "--scenes", "scene-2") == []
    monkeypatch.setattr(suite, "_code_digest", lambda: "other")
    assert again("--frames", "1", "--scenes", "scene-2") == every
    (tmp_path / "r.runs.json").write_text('{"rows": ')
    assert again("--frames", "1", "--scenes", "scene-2") == every
    manifest = load_manifest(dataset)
    write_manifest(dataset, replace(manifest, versions={"numpy": "another"}))
    try:
        assert again("--frames", "1", "--scenes", "scene-2") == every
    finally:
        write_manifest(dataset, manifest)


def test_an_interrupted_evaluation_of_one_network_promises_nothing(
    dataset, weights, tmp_path, capsys, monkeypatch
):
    """It keeps nothing, and says so."""

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "score", interrupted)
    assert evaluated(dataset, tmp_path / "r.json", "--weights", weights / "one") == 130
    said = capsys.readouterr().err
    assert "go on" not in said
    assert "begins anew" in said


def test_only_scenes_that_are_measured_count_as_not_new(dataset, weights, tmp_path, capsys):
    """Of two test scenes one is known: it is told where it is measured, and nowhere else, with a suite and without."""
    for words in (("--weights", weights / "one"), two_runs(weights)):
        for scene, found in (("scene-1", {"scene-1": "object mug"}), ("scene-2", {})):
            out = tmp_path / "r.json"
            assert evaluated(dataset, out, *words, "--scenes", scene) == 0
            results = json.loads(out.read_text())
            assert (results["scenes"], results["views"]) == ([scene], 1)
            run = results["runs"]["one#0"] if "runs" in results else results
            assert run["not_new"] == found
            assert ("1 of 1 scenes are not new" in capsys.readouterr().out) == bool(found)


def test_scenes_and_names_are_never_ignored(dataset, weights, tmp_path, capsys):
    """Without a suite no scene of the prefix is an error, too, and so is a name; a path may hold the sign."""
    one = weights / "one"
    assert evaluated(dataset, tmp_path / "r.json", "--weights", one, "--scenes", "kitchen") == 3
    assert "no scene of the split test begins so" in capsys.readouterr().err
    assert evaluated(dataset, tmp_path / "r.json", "--weights", f"one={one}") == 3
    assert "need a --suite" in capsys.readouterr().err
    (tmp_path / "rate=1").symlink_to(one)
    assert evaluated(dataset, tmp_path / "r.json", "--weights", tmp_path / "rate=1") == 0


def test_the_right_sigma_is_the_best_not_the_largest():
    """68.27 % of the errors lie within a sigma that is right; an infinite one holds all."""
    shares = {"narrow": 0.6, "right": 0.709, "wide": 0.754, "infinite": 1.0}
    results = {"methods": {name: {"extra": {"coverage_1sigma": v}} for name, v in shares.items()}}
    at = [c.words for c in SUITES["main"].columns].index("within 1 sigma %")
    assert [name for name, row in cells(results, SUITES["main"]) if row[at][1]] == ["right"]


def test_names_are_escaped_in_every_kind_of_table(tmp_path, monkeypatch):
    """Whatever somebody calls a run, LaTeX and Markdown print it."""
    monkeypatch.setattr("tofcapture_model.evaluation.tables.SUITES", {"main": Suite("Title", (COLUMN,))})
    name = r"a&b#1${x}~y^z\w_5%|c"
    write_tables(tmp_path / "r.json", {"methods": {name: {"mae": 0.001}, "other": {"mae": 0.002}}}, ["main"])
    tex = r"a\&b\#1\$\{x\}\textasciitilde{}y\textasciicircum{}z\textbackslash{}w\_5\%\textbar{}c"
    assert tex + r" & \textbf{1.00} \\" in (tmp_path / "tables.tex").read_text()
    assert r"| a&b#1${x}~y^z\w_5%\|c | **1.00** |" in (tmp_path / "tables.md").read_text()


def test_a_suite_without_weights_measures_the_bundled_network(dataset, tmp_path):
    """As the help says; by name it is the same."""
    assert evaluated(dataset, tmp_path / "a.json", "--suite", "main") == 0
    results = json.loads((tmp_path / "a.json").read_text())
    assert list(results["methods"]) == ["sensor", "lf2", "bundled"]
    assert results["runs"]["bundled#0"]["weights"] == str(find_model(None))
    assert "| bundled |" in (tmp_path / "tables.md").read_text()
    assert evaluated(dataset, tmp_path / "b.json", "--suite", "main", "--weights", "bundled=bundled") == 0
    assert json.loads((tmp_path / "b.json").read_text())["methods"] == results["methods"]
