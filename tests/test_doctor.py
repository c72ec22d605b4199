"""The doctor names what is wrong and what to do, and fails only on what nothing works without."""

import json

import pytest

from tofcapture.cli import doctor, main


@pytest.fixture
def installed(monkeypatch):
    """A pretended set of installed packages."""
    packages = {}
    monkeypatch.setattr(doctor, "_installed", packages.get)
    return packages


def test_here(capsys):
    """On this machine the command runs, finds the simulated drivers, and its exit code says whether anything failed."""
    code = main(["doctor", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] == (code == 0)
    assert any(f["what"] == "driver sim" and f["verdict"] == "PASS" for f in result["findings"])


def test_missing_and_old_libraries(installed):
    """A missing required library fails, a missing or old optional one warns."""
    installed.update({"numpy": "2.1.0", "scipy": "1.9.3", "torch": "2.13.0+cpu"})
    verdicts = {f.what: f.verdict for f in doctor.check_libraries()}
    assert verdicts["h5py"] == "FAIL"
    assert verdicts["numpy"] == verdicts["torch"] == "PASS"
    assert verdicts["scipy"] == verdicts["rich"] == "WARN"


def test_two_opencvs(installed):
    """Two OpenCV wheels that overwrite each other are a warning."""
    installed.update({"opencv-python": "5.0", "opencv-python-headless": "5.0"})
    (finding,) = doctor.check_opencv()
    assert finding.verdict == "WARN"
    assert "uninstall" in finding.advice


@pytest.mark.parametrize(
    ("torch", "vision", "verdict"),
    [
        ("2.6.0+cpu", "0.21.0+cpu", "PASS"),
        ("2.6.0+cpu", "0.21.0", "WARN"),
        ("2.7.1", "0.21.0", "WARN"),
        ("2.7.1", "0.22.1", "PASS"),
    ],
)
def test_torchvision(installed, torch, vision, verdict):
    """A torchvision of another build or of another torch is a warning."""
    installed.update({"torch": torch, "torchvision": vision})
    assert [f.verdict for f in doctor.check_torch()] == [verdict]


def test_a_check_that_breaks(monkeypatch, capsys):
    """A check that itself breaks is a FAIL with its error, and the exit code is not 0."""

    def check_moon():
        raise OSError("no moon")

    monkeypatch.setattr(doctor, "CHECKS", (check_moon,))
    assert main(["doctor"]) == 1
    assert "FAIL  check_moon  OSError: no moon" in capsys.readouterr().out


def test_full_disk(monkeypatch, tmp_path):
    """Less than a gigabyte is a FAIL, less than five a WARN."""
    for free, verdict in ((5e8, "FAIL"), (2e9, "WARN"), (5e10, "PASS")):
        monkeypatch.setattr(
            doctor.shutil, "disk_usage", lambda path, free=free: type("Usage", (), {"free": free})()
        )
        assert doctor.check_disk(tmp_path)[0].verdict == verdict
