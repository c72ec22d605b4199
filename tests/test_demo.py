"""The demo: which commands it runs, with and without bundled weights; the commands themselves are tested elsewhere."""

import json
import struct
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tofcapture.cli import demo, doctor, main, setup
from tofcapture.cli.setup import bundled_path, describe_weights
from tofcapture.errors import FormatError

ANSWERS = {
    "align": {"rotation_error_deg": 0.02, "translation_error_mm": 0.3},
    "build-dataset": {"gt": {"median_error_mm": 0.1, "p99_error_mm": 0.4}},
}
METHOD = {
    "depth": {"pixel": {"mae": 0.004, "rmse": 0.006, "median": 0.002}},
    "normal": {"pixel": {"mean_deg": 9.0}},
}


@pytest.fixture
def typed(monkeypatch):
    """Command lines that the demo ran; each is answered as the command would, at once."""
    lines = []

    def run(words, **_):
        line = words[words.index("tofcapture") + 1 : -1]
        lines.append(line)
        answer = ANSWERS.get(line[0], {})
        if line[0] == "evaluate":
            split, out = line[line.index("--split") + 1], line[line.index("--out") + 1]
            scenes = ["bottle"] if split == "test" else ["random-15", "random-8"]
            table = {"scenes": scenes, "methods": {"sensor": METHOD, "model": METHOD}}
            with open(out, "w", encoding="utf-8") as file:
                json.dump(table, file)
        return SimpleNamespace(returncode=0, stdout=json.dumps(answer))

    monkeypatch.setattr(subprocess, "run", run)
    return lines


def ran(lines, name):
    """Arguments of every run of a command."""
    return [line[1:] for line in lines if line[0] == name]


def test_bundled_weights_need_no_training(typed, tmp_path, monkeypatch, capsys):
    """Predict, evaluate and report name no weights, every recorded scene is measured, and nothing is trained."""
    monkeypatch.setattr(demo, "bundled_path", lambda: tmp_path / "model.safetensors")
    assert main(["demo", "--out", str(tmp_path / "out"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["network"] == "bundled"
    assert set(answer["scenes"]) == {"bottle", "random-15, random-8"}
    assert answer["model"] == answer["scenes"]["bottle"]["model"]
    assert not ran(typed, "train")
    assert len(ran(typed, "record")) == 1 + len(demo.SCENES)
    used = [line for name in ("evaluate", "predict", "report") for line in ran(typed, name)]
    assert len(used) == 4
    assert not any("--weights" in line for line in used)


@pytest.mark.parametrize("asked", [True, False])
def test_the_demo_trains_when_asked_or_when_nothing_is_bundled(asked, typed, tmp_path, monkeypatch, capsys):
    """One training, whose weights all that follows takes; measured on the held-out scene alone; a missing file is told."""
    monkeypatch.setattr(demo, "bundled_path", lambda: tmp_path / "model.safetensors" if asked else None)
    assert main(["demo", "--out", str(tmp_path / "out"), *(["--train"] if asked else [])]) == 0
    said = capsys.readouterr()
    assert ("no trained network comes with this installation" in said.err) == (not asked)
    assert "small network" in said.out
    (trained,) = ran(typed, "train")
    model = trained[trained.index("--out") + 1]
    (evaluated,) = ran(typed, "evaluate")
    for line in (evaluated, *ran(typed, "predict"), *ran(typed, "report")):
        assert line[line.index("--weights") + 1] == model
    assert evaluated[evaluated.index("--split") + 1] == "test"


def test_what_the_demo_types_are_real_commands(typed, tmp_path, monkeypatch):
    """Every line parses as its command's arguments."""
    import argparse
    from importlib.metadata import entry_points

    monkeypatch.setattr(demo, "bundled_path", lambda: None)
    main(["demo", "--out", str(tmp_path / "out")])
    for name, *words in typed:
        parser = argparse.ArgumentParser(exit_on_error=False)
        next(e for e in entry_points(group="tofcapture.commands") if e.name == name).load().configure(parser)
        parser.parse_args(words)


def checkpoint(path, *, cut=0):
    """Write a safetensors file of one (3, 2) float16 tensor by hand."""
    header = {
        "__metadata__": {"config": '[network]\nkind = "compact"\n'},
        "a": {"dtype": "F16", "shape": [3, 2], "data_offsets": [0, 12]},
    }
    text = json.dumps(header).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(struct.pack("<Q", len(text)) + text + bytes(12 - cut))
    return path


def test_weights_are_described_without_the_libraries_that_run_them(tmp_path):
    """Kind and count come from the header; a file that is cut short, or another, is refused."""
    found = describe_weights(checkpoint(tmp_path / "model.safetensors"))
    assert (found.kind, found.weights, found.size) == ("compact", 6, found.path.stat().st_size)
    of_millions = replace(found, weights=1_250_000, size=2_500_000)
    assert str(of_millions) == "compact, 1.25 million weights, 2.5 MB"
    with pytest.raises(FormatError, match="bytes, got"):
        describe_weights(checkpoint(tmp_path / "cut.safetensors", cut=1))
    for junk in (b"", b"junk", b"version https://git-lfs.github.com/spec/v1\noid sha256:0"):
        (tmp_path / "junk").write_bytes(junk)
        with pytest.raises(FormatError, match="not a checkpoint"):
            describe_weights(tmp_path / "junk")


def test_the_doctor_says_what_is_bundled(tmp_path, monkeypatch):
    """There, missing, or damaged; none of it is a failure, for only prediction needs it."""
    package = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    monkeypatch.setattr(setup, "find_spec", lambda _: package)
    assert bundled_path() is None
    (finding,) = doctor.check_weights()
    assert (finding.verdict, bool(finding.advice)) == ("WARN", True)
    path = checkpoint(tmp_path / "weights" / "model.safetensors")
    assert bundled_path() == path
    (finding,) = doctor.check_weights()
    assert finding.verdict == "PASS"
    assert "compact" in finding.found
    checkpoint(path, cut=1)
    assert next(doctor.check_weights()).verdict == "WARN"
    monkeypatch.setattr(setup, "find_spec", lambda _: None)
    assert bundled_path() is None
