"""The package: what is in the wheel, what it needs to read, and how each mistake is answered from the command line."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
import venv
import zipfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests import PATIENCE, until
from tests.test_files_shard import RIG, write
from tofcapture.cli import main
from tofcapture.rig import dumps_rig

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def _installed(name):
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


def test_constraints_name_what_the_project_needs():
    """Each library of the project file that is installed here has a tested version that satisfies its floor."""
    pins = dict(
        line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    )
    project = PROJECT["project"]
    extras = project["optional-dependencies"].values()
    for requirement in (*project["dependencies"], *(line for extra in extras for line in extra)):
        name = re.match(r"[\w.-]+", requirement)[0].lower().replace("_", "-")
        if name not in {"tofcapture", "open3d"} and _installed(name):
            assert name in pins, f"{name}: run python docs/constraints.py"
            floor = re.search(r">=([\d.]+)", requirement)
            tested = [int(n) for n in re.findall(r"\d+", pins[name])]
            assert floor is None or tested >= [int(n) for n in floor[1].split(".")], requirement


def test_importing_the_package_is_light():
    """``import tofcapture`` and reading a shard need numpy and h5py and nothing else."""
    code = (
        "import sys, tofcapture, tofcapture.files.shard, tofcapture.files.view, tofcapture.ops.phase\n"
        "import tofcapture.ops.crop, tofcapture.ops.project, tofcapture.meshes, tofcapture.devices.sim.drivers\n"
        "heavy = {'torch', 'open3d', 'scipy', 'cv2', 'matplotlib', 'numba', 'trimesh', 'rerun', 'kiss_icp'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of the tree."""
    out = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(out), str(ROOT)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.whl"))


@pytest.mark.slow
def test_wheel_holds_the_packages_and_nothing_else(wheel):
    """Templates, presets, weights, boards and the station are in it; tests, docs and benchmarks are not."""
    names = zipfile.ZipFile(wheel).namelist()
    tops = {n.split("/")[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {
        "tofcapture",
        "tofcapture_model",
        "calibration",
    }
    shipped = [
        p
        for g in ("*.toml", "*.j2", "*.js", "*.json", "*.css", "*.html", "*.service", "py.typed")
        for p in (ROOT / "tofcapture").rglob(g)
    ]
    shipped += [
        *(ROOT / "tofcapture_model/weights").iterdir(),
        *(ROOT / "tofcapture_model/presets").iterdir(),
    ]
    for path in shipped:
        assert str(path.relative_to(ROOT)) in names


@pytest.mark.slow
def test_sdist_builds_the_same_wheel(tmp_path, wheel):
    """The source distribution holds all that a wheel is made of."""
    pytest.importorskip("build")
    words = [sys.executable, "-m", "build", "-q", "--outdir", str(tmp_path), str(ROOT)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    made = next(tmp_path.glob("*.whl"))
    assert set(zipfile.ZipFile(made).namelist()) == set(zipfile.ZipFile(wheel).namelist())


@pytest.mark.slow
def test_wheel_reads_a_shard_with_numpy_and_h5py_only(tmp_path, wheel):
    """An environment of its own, without extras: a shard is read, check passes, and other commands say which extra they need."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / "bin" / "python"
    done = subprocess.run(
        [python, "-m", "pip", "install", "-q", str(wheel)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format=json"], capture_output=True, text=True, check=True
    )
    assert {p["name"] for p in json.loads(listed.stdout)} - {"pip", "setuptools"} == {
        "numpy",
        "h5py",
        "tofcapture",
    }
    write(tmp_path / "mug.h5")
    code = "from tofcapture.files.shard import ShardReader; print(ShardReader('mug.h5').raw(0, 0).shape)"
    run = {"cwd": tmp_path, "capture_output": True, "text": True}
    assert subprocess.run([python, "-c", code], check=False, **run).stdout.startswith("(8, ")
    assert subprocess.run([python, "-m", "tofcapture", "check", "mug.h5"], check=False, **run).returncode == 0
    for line in (
        ["view", "mug.h5", "--png", "x.png"],
        ["train", ".", "--out", "m"],
        ["record", "--scene", "mug", "--out", "r"],
    ):
        done = subprocess.run([python, "-m", "tofcapture", *line], check=False, **run)
        assert done.returncode in {3, 5}, done.stderr
        assert "pip install" in done.stderr or done.returncode == 5
        assert len(done.stderr.splitlines()) <= 5


@pytest.mark.slow
def test_installed_wheel_predicts_with_its_own_weights(tmp_path, wheel):
    """Installed elsewhere, an array and nothing else gives depth: the weights that answer are those of the wheel."""
    pytest.importorskip("torch")
    if not (ROOT / "tofcapture_model/weights/model.safetensors").exists():
        pytest.skip("no weights are bundled in this tree")
    from tests.test_model_predict import table_top
    from tofcapture_model.data.raw_input import NOMINAL_CAMERA

    words = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", tmp_path / "site", wheel]
    subprocess.run([str(w) for w in words], check=True, capture_output=True)
    raw, depth = table_top(NOMINAL_CAMERA)
    np.save(tmp_path / "raw.npy", raw)
    done = subprocess.run(
        [sys.executable, "-m", "tofcapture", "predict", "raw.npy", "--out", "out", "--json"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["weights"].startswith(str(tmp_path / "site"))
    found = np.load(tmp_path / "out" / "depth.npy")
    assert np.median(np.abs(found - np.kron(depth, np.ones((2, 2))))) < 0.05
    assert wheel.stat().st_size < 12e6


# What goes wrong, from the command line: (make the case, command line, exit code, words that must be said).
def _text(path, text):
    path.write_text(text)
    return path


def _wrong_file(p):
    return ["check", _text(p / "notes.h5", "no HDF5")]


def _wrong_unit(p):
    return [
        "view",
        _text(p / "rig.toml", dumps_rig(RIG).replace('units = "m"', 'units = "mm"')),
        "--png",
        p / "x.png",
    ]


def _millimetres(p):
    big = dumps_rig(RIG).replace("0.0,\n    ],\n    [\n", "850.0,\n    ],\n    [\n", 1)
    return ["view", _text(p / "rig.toml", big), "--png", p / "x.png"]


def _missing_device(p):
    station = '[arm]\ndriver = "sim"\n[tof]\ndriver = "tof_serial"\nport = "/dev/no-such-port"\n[stereo]\ndriver = "sim"\n[operator]\ndriver = "sim"\n'
    return ["record", "--scene", "mug", "--out", p / "r", "--station", _text(p / "station.toml", station)]


def _unknown_driver(p):
    station = '[arm]\ndriver = "robbie"\n[tof]\ndriver = "sim"\n[stereo]\ndriver = "sim"\n[operator]\ndriver = "sim"\n'
    return ["record", "--scene", "mug", "--out", p / "r", "--station", _text(p / "station.toml", station)]


def _other_version(p, version):
    write(p / "mug.h5")
    (p / "mug.h5").chmod(0o644)
    (p / "mug.sha256").unlink()
    with h5py.File(p / "mug.h5", "r+") as file:
        file.attrs["version"] = np.int64(version)
    return ["view", p / "mug.h5", "--png", p / "x.png"]


def _full(p):
    """A disk of 16 kB; only root may make one."""
    disk = p / "disk"
    disk.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", str(disk)], capture_output=True, check=False
    ).returncode:
        pytest.skip("only root can make a small disk")
    write(p / "mug.h5")
    return ["view", p / "mug.h5", "--png", disk / "x.png"]


CASES = {
    "wrong file": (_wrong_file, 5, "HDF5"),
    "wrong unit": (_wrong_unit, 3, "m"),
    "missing device": (_missing_device, (3, 4), "tof|port|serial"),
    "unknown driver": (_unknown_driver, 3, "robbie"),
    "newer format": (lambda p: _other_version(p, 99), 5, "version"),
    "no permission": (
        lambda p: ["record", "--scene", "mug", "--views", "1", "--out", "/proc/nowhere/rec"],
        (1, 3, 4, 5),
        "nowhere|proc",
    ),
    "full disk": (_full, 1, "[Nn]o space"),
}


@pytest.mark.parametrize("case", sorted(CASES))
def test_mistakes_are_answered_in_five_lines(case, tmp_path, capsys):
    """Each case of docs/howto/errors.md: what is wrong, where, what to try; the right exit code; no traceback."""
    make, codes, words = CASES[case]
    if case == "full disk":
        pytest.importorskip("matplotlib")
    try:
        code = main([str(w) for w in make(tmp_path)])
    finally:
        if case == "full disk":
            subprocess.run(["umount", str(tmp_path / "disk")], capture_output=True, check=False)
    out = capsys.readouterr()
    said = out.err + out.out
    assert code in (codes if isinstance(codes, tuple) else (codes,)), said
    assert re.search(words, said), said
    assert "Traceback" not in said
    assert len(said.splitlines()) <= 5, said


def test_missing_extra_names_itself(tmp_path, monkeypatch, capsys):
    """A library that is not installed is named, with the line that installs it."""
    write(tmp_path / "mug.h5")
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", str(tmp_path / "mug.h5"), "--save", str(tmp_path / "x.rrd")]) == 3
    assert "pip install 'tofcapture[view]'" in capsys.readouterr().err


def test_every_mistake_stands_in_the_docs():
    """The errors page has a row for each tested case."""
    page = (ROOT / "docs" / "howto" / "errors.md").read_text()
    for case in {*CASES, "missing extra"}:
        assert f"| {case} |" in page, case


def test_no_colour_when_asked(tmp_path):
    """NO_COLOR: not one escape sequence, on either stream."""
    env = {**os.environ, "NO_COLOR": "1", "FORCE_COLOR": "", "TERM": "xterm-256color"}
    done = subprocess.run(
        [sys.executable, "-m", "tofcapture", "doctor"], capture_output=True, env=env, check=False
    )
    assert b"\x1b[" not in done.stdout + done.stderr


def test_ctrl_c_is_clean(tmp_path):
    """An interrupted command says so in two lines, exits with 130 and leaves no half-written file."""
    words = [sys.executable, "-m", "tofcapture", "record", "--calibration", "--out", str(tmp_path / "rec")]
    run = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    until((tmp_path / "rec" / "journal.sqlite").exists)
    run.send_signal(signal.SIGINT)
    said = run.communicate(timeout=PATIENCE)[1]
    assert run.returncode == 130, said
    assert "interrupted" in said
    assert "Traceback" not in said
    assert not list(tmp_path.rglob("*.partial"))
