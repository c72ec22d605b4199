"""The doctor names what is wrong and what to do, and fails only on what nothing works without."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tofcapture.cli import doctor, doctor_machine, doctor_probe, doctor_station, main
from tofcapture.cli.doctor_probe import Finding


@pytest.fixture
def installed(monkeypatch):
    """A pretended set of installed packages."""
    packages = {}
    monkeypatch.setattr(doctor, "_installed", packages.get)
    return packages


def test_here(capsys, tmp_path):
    """On this machine the command runs, finds the simulated drivers, and its exit code says whether anything failed."""
    code = main(["doctor", "--json", "--folder", str(tmp_path)])
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] == (code == 0)
    verdicts = {f["what"]: f["verdict"] for f in result["findings"]}
    assert verdicts["driver sim"] == verdicts["commands"] == verdicts["station"] == verdicts["arm"] == "PASS"
    assert {"open3d", "ur-rtde", "nxlib", "disk speed", "clock", "daemon folder"} <= verdicts.keys()
    assert all(f["advice"] for f in result["findings"] if f["verdict"] != "PASS")
    assert not list(tmp_path.iterdir())


def test_nothing_heavy_in_its_own_process(tmp_path):
    """Vendor libraries, open3d and torch are never imported by the doctor itself."""
    code = (
        f"import sys\nfrom tofcapture.cli import main; main(['doctor', '--folder', {str(tmp_path)!r}])\n"
        "names = ('torch', 'open3d', 'rtde_control', 'nxlib', 'cv2', 'numba', 'scipy', 'aiohttp', 'numpy')\n"
        "print([m for m in names if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip().splitlines()[-1] == "[]"


def test_libraries_are_those_of_the_project_file():
    """The doctor asks for the versions that the project file asks for."""
    table = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
    wishes = {}
    for name, lines in {"": table["dependencies"], **table["optional-dependencies"]}.items():
        for line in lines:
            package, _, least = line.partition(";")[0].strip().partition(">=")
            wishes.setdefault(package, set()).add((least, name))
    for name, least in doctor.REQUIRED.items():
        assert (least, "") in wishes[name]
    for name, (least, extra) in doctor.OPTIONAL.items():
        assert (least, extra) in wishes[name], name


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


def test_another_version_is_installed(installed):
    """What runs must be what is installed."""
    installed["tofcapture"] = "0.0.1"
    assert [f.verdict for f in doctor.check_python() if f.what == "tofcapture"] == ["FAIL"]
    del installed["tofcapture"]
    assert [f.verdict for f in doctor.check_python() if f.what == "tofcapture"] == ["FAIL"]


def test_a_check_that_breaks(monkeypatch, capsys):
    """A check that itself breaks is a FAIL with its error, and the exit code is not 0."""

    def check_moon():
        raise OSError("no moon")

    monkeypatch.setattr(doctor, "CHECKS", (check_moon,))
    monkeypatch.setattr(doctor, "PROBES", ())
    monkeypatch.setattr(doctor, "probe", lambda *args, **more: [])
    monkeypatch.setattr(doctor, "machine_checks", lambda folder: [])
    assert main(["doctor"]) == 1
    assert "FAIL  check_moon  OSError: no moon" in capsys.readouterr().out
    assert main(["doctor", "--folder", "/no/such/folder"]) == 3


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import time; time.sleep(60)", "no answer within"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "crashed with SIGSEGV"),
        ("raise OSError('libmoon.so')", "ended with 1: OSError: libmoon.so"),
        ("print('hello')", "ended with 0"),
    ],
)
def test_a_library_that_hangs_or_crashes(monkeypatch, tmp_path, code, words):
    """A probe that hangs, crashes, fails or chatters is a finding with a remedy, and the doctor lives on."""
    script = tmp_path / "python"
    script.write_text(f"#!{sys.executable}\n{code}\n")
    script.chmod(0o755)
    monkeypatch.setattr(doctor_probe.sys, "executable", str(script))
    (finding,) = doctor_probe.probe("open3d", timeout=2.0 if "sleep" in code else 30.0)
    assert finding.verdict == "FAIL"
    assert words in finding.found
    assert finding.advice


def test_broken_stations(tmp_path):
    """An unreadable station, an unknown driver and a missing port each fail with their own remedy."""
    file = tmp_path / "station.toml"
    assert [f.verdict for f in doctor_station.look_at_station(str(file))] == ["FAIL"]
    file.write_text(
        '[arm]\ndriver = "sim"\n[tof]\ndriver = "moon"\n[stereo]\ndriver = "sim"\n[operator]\ndriver = "sim"\n'
        "[plan]\ntable = -0.5\ntarget = [0.7, 0, -0.4]\nboard = [0.7, 0, -0.2]\nboard_normal = [0, 0, 1]\n"
    )
    found = {f.what: f for f in doctor_station.look_at_station(str(file), "open")}
    assert found["tof"].verdict == "FAIL"
    assert found["arm"].verdict == found["stereo"].verdict == "PASS"
    assert "devices" not in found
    file.write_text(
        file.read_text().replace('driver = "moon"', f'driver = "tof_serial"\nport = "{tmp_path}/ttyUSB0"')
    )
    (port,) = [f for f in doctor_station.look_at_station(str(file)) if (f.what, f.verdict) == ("tof", "FAIL")]
    assert "plug it in" in port.advice


def test_a_station_of_real_devices_before_its_first_day(tmp_path):
    """Devices that were never opened are told of, their ports are looked at all the same, and a rig is asked for."""
    file = tmp_path / "station.toml"
    file.write_text(
        f'[arm]\ndriver = "sim"\n[tof]\ndriver = "tof_serial"\nport = "{tmp_path}/ttyUSB0"\n'
        '[stereo]\ndriver = "ensenso"\nserial = "1"\n[operator]\ndriver = "console"\n'
        "[plan]\ntable = -0.5\ntarget = [0.7, 0, -0.4]\nboard = [0.7, 0, -0.2]\nboard_normal = [0, 0, 1]\n"
    )
    found = doctor_station.look_at_station(str(file), "open")
    verdicts = [(f.what, f.verdict) for f in found]
    assert ("tof", "WARN") in verdicts
    assert ("tof", "FAIL") in verdicts
    assert ("stereo", "WARN") in verdicts
    assert ("rig", "FAIL") in verdicts
    assert all(f.advice for f in found if f.verdict != "PASS")
    assert not any(f.what == "devices" for f in found)


def test_silent_controller(tmp_path):
    """An arm whose controller does not answer fails in the driver's own words."""
    file = tmp_path / "station.toml"
    file.write_text(
        '[arm]\ndriver = "ur_rtde"\nhost = "127.250.0.8"\n[tof]\ndriver = "sim"\n[stereo]\ndriver = "sim"\n'
        '[operator]\ndriver = "sim"\n[plan]\ntable = -0.5\ntarget = [0.7, 0, -0.4]\nboard = [0.7, 0, -0.2]\n'
        "board_normal = [0, 0, 1]\n"
    )
    (finding,) = [f for f in doctor_station.look_at_station(str(file)) if f.what == "arm"]
    assert finding.verdict == "FAIL"
    assert "127.250.0.8: RTDE's port 30004" in finding.found
    assert "cable" in finding.advice


def test_full_disk(monkeypatch, tmp_path):
    """Less than a gigabyte is a FAIL, less than five a WARN."""
    monkeypatch.setattr(doctor_machine, "_speed", lambda folder: [])
    for free, verdict in ((5e8, "FAIL"), (2e9, "WARN"), (5e10, "PASS")):
        monkeypatch.setattr(
            doctor_machine.shutil, "disk_usage", lambda path, free=free: type("Usage", (), {"free": free})()
        )
        assert doctor_machine.check_disk(tmp_path)[0].verdict == verdict


@pytest.mark.parametrize(("kind", "verdict"), [("nfs4", "FAIL"), ("tmpfs", "WARN"), ("ext4", "PASS")])
def test_file_systems(monkeypatch, tmp_path, kind, verdict):
    """Network file systems fail, memory warns."""
    monkeypatch.setattr(doctor_machine, "filesystem", lambda folder: kind)
    assert [f.verdict for f in doctor_machine._kind(tmp_path)] == [verdict]


def test_slow_disk(monkeypatch, tmp_path):
    """A disk that syncs slowly is a warning that says how slow."""
    times = iter(range(100))
    monkeypatch.setattr(doctor_machine.time, "monotonic", lambda: float(next(times)))
    (finding,) = doctor_machine._speed(tmp_path)
    assert finding.verdict == "WARN"
    assert "1000.0 ms" in finding.found


def test_clock(monkeypatch):
    """A clock that jumps warns, one that was never set fails."""
    pairs = iter([(0.0, 100.0), (0.3, 101.3)])
    with monkeypatch.context() as patch:
        patch.setattr(doctor_machine, "_clocks", lambda: next(pairs))
        assert doctor_machine.check_clock()[0].verdict == "WARN"
    monkeypatch.setattr(doctor_machine.time, "time", lambda: 1e6)
    assert doctor_machine.check_clock()[0].verdict == "FAIL"


def test_ports_of_others(monkeypatch, tmp_path):
    """A port that is not ours warns and names the group; no port is nothing wrong."""
    assert [f.verdict for f in doctor_machine.check_ports(tmp_path)] == ["PASS"]
    (tmp_path / "ttyACM0").touch()
    monkeypatch.setattr(doctor_machine.os, "access", lambda path, mode: False)
    (finding,) = doctor_machine.check_ports(tmp_path)
    assert finding.verdict == "WARN"
    assert "usermod -aG" in finding.advice


def test_folder_of_the_daemon(monkeypatch, tmp_path):
    """Too long a path and a folder that others can look into are warnings; none yet is fine."""
    monkeypatch.setenv("TOFCAPTURE_STATE", str(tmp_path / "new"))
    assert doctor_machine.check_daemon() == [
        Finding("daemon folder", "PASS", str(tmp_path / "new")),
        Finding("daemon", "PASS", "none runs"),
    ]
    (tmp_path / "new").mkdir(mode=0o755)
    (tmp_path / "new").chmod(0o755)
    assert "chmod 700" in doctor_machine.check_daemon()[0].advice
    monkeypatch.setenv("TOFCAPTURE_STATE", str(tmp_path / ("x" * 120)))
    assert "TOFCAPTURE_STATE" in doctor_machine.check_daemon()[0].advice
