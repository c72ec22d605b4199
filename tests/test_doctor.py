"""The doctor names what is wrong and what to do, and fails only on what nothing works without."""

import json
import os
import subprocess
import sys
from importlib.metadata import requires

import pytest

from tests import PATIENCE
from tofcapture.cli import doctor, main, probe
from tofcapture.cli.probe import Finding
from tofcapture.devices import Arm, TofCamera, registry
from tofcapture.devices.kinematics import MODELS
from tofcapture.errors import DeviceError
from tofcapture.frames import ArmInfo

PLAN = '[operator]\ndriver = "sim"\n[plan]\ntable = -0.5\ntarget = [0.7, 0, -0.4]\nboard = [0.7, 0, -0.2]\nboard_normal = [0, 0, 1]\n'


def _verdicts(findings):
    return {f.what: f.verdict for f in findings}


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
    assert main(["doctor", "--folder", "/no/such/folder"]) == 3


def test_nothing_heavy_in_its_own_process(tmp_path):
    """Vendor libraries, open3d and torch are never imported by the doctor itself."""
    code = (
        f"import sys\nfrom tofcapture.cli import main; main(['doctor', '--folder', {str(tmp_path)!r}])\n"
        "names = ('torch', 'open3d', 'rtde_control', 'nxlib', 'cv2', 'numba', 'scipy', 'aiohttp', 'numpy')\n"
        "print([m for m in names if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip().splitlines()[-1] == "[]"


def test_libraries():
    """Every library of the package is asked for; without a required one it fails, an optional one missing or old warns."""
    installed = {"numpy": "2.1.0", "scipy": "1.9.3", "torch": "2.13.0+cpu"}
    found = list(doctor.check_libraries(installed.get))
    verdicts = _verdicts(found)
    assert verdicts["h5py"] == "FAIL"
    assert verdicts["numpy"] == verdicts["torch"] == "PASS"
    assert verdicts["scipy"] == verdicts["jinja2"] == "WARN"
    assert {f.what: f.advice for f in found}["aiohttp"] == "pip install 'tofcapture[daemon]'"
    assert len(found) == len(verdicts)
    assert any(line.startswith("h5py") for line in requires("tofcapture"))


@pytest.mark.parametrize(
    ("installed", "what", "verdict"),
    [
        ({}, "opencv", "WARN"),
        ({"opencv-python": "5.0"}, "opencv", "PASS"),
        ({"opencv-python": "5.0", "opencv-python-headless": "5.0"}, "opencv", "WARN"),
        ({"torch": "2.6.0+cpu", "torchvision": "0.21.0+cpu"}, "torchvision", "PASS"),
        ({"torch": "2.6.0+cpu", "torchvision": "0.21.0"}, "torchvision", "WARN"),
        ({"torch": "2.7.1", "torchvision": "0.21.0"}, "torchvision", "WARN"),
        ({"torch": "2.7.1", "torchvision": "0.22.1"}, "torchvision", "PASS"),
        ({"torch": "2.7.1"}, "torchvision", None),
    ],
)
def test_wheels_that_spoil_each_other(installed, what, verdict):
    """Two OpenCV wheels, and a torchvision of another build or of another torch, are warnings."""
    assert _verdicts(doctor.check_wheels(installed.get)).get(what) == verdict


@pytest.mark.parametrize("installed", [{}, {"tofcapture": "0.0.1"}])
def test_another_version_is_installed(installed):
    """What runs must be what is installed."""
    assert _verdicts(doctor.check_python(installed.get))["tofcapture"] == "FAIL"


def test_a_check_that_breaks():
    """A check that itself breaks is a FAIL with its error."""

    def check_moon():
        raise OSError("no moon")

    (finding,) = doctor.examine(check_moon)
    assert (finding.what, finding.verdict, finding.found) == ("check_moon", "FAIL", "OSError: no moon")


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
    monkeypatch.setattr(sys, "executable", str(script))
    (finding,) = probe.probe("open3d", timeout=2.0 if "sleep" in code else PATIENCE)
    assert finding.verdict == "FAIL"
    assert words in finding.found
    assert finding.advice


def _station(tmp_path, text, opening=""):
    file = tmp_path / "station.toml"
    file.write_text(text)
    return list(probe.probe_station(str(file), opening))


def test_broken_stations(tmp_path):
    """An unreadable station, an unknown driver and a missing port each fail with their own remedy."""
    assert [f.verdict for f in probe.probe_station(str(tmp_path / "none.toml"))] == ["FAIL"]
    text = '[arm]\ndriver = "sim"\n[stereo]\ndriver = "sim"\n[tof]\ndriver = "moon"\n' + PLAN
    found = _verdicts(_station(tmp_path, text, "open"))
    assert found["tof"] == "FAIL"
    assert found["arm"] == found["stereo"] == "PASS"
    assert "devices" not in found
    text = text.replace('"moon"', f'"tof_serial"\nport = "{tmp_path}/ttyUSB0"')
    (port,) = [f for f in _station(tmp_path, text) if (f.what, f.verdict) == ("tof", "FAIL")]
    assert "plug it in" in port.advice


def test_a_device_that_cannot_be_described_is_told_of_once(monkeypatch, tmp_path):
    """What it is, is not known before it was opened; nothing is said to pass that nobody looked at."""

    class Shy(TofCamera, Arm):
        def describe(self):
            raise DeviceError("not opened yet", hint="open it")

    make = registry.make_device
    monkeypatch.setattr(registry, "make_device", lambda role, c: Shy() if role == "tof" else make(role, c))
    text = "".join(f'[{role}]\ndriver = "sim"\n' for role in ("arm", "tof", "stereo"))
    found = [(f.what, f.verdict, f.found, f.advice) for f in _station(tmp_path, text + PLAN)]
    assert [f for f in found if f[0] == "tof"] == [("tof", "WARN", "not opened yet", "open it")]


def test_a_station_of_real_devices_before_its_first_day(tmp_path):
    """Devices that were never opened are told of, their ports are looked at all the same, and a rig is asked for."""
    text = (
        f'[arm]\ndriver = "sim"\n[tof]\ndriver = "tof_serial"\nport = "{tmp_path}/ttyUSB0"\n'
        '[stereo]\ndriver = "ensenso"\nserial = "1"\n' + PLAN
    )
    found = _station(tmp_path, text, "open")
    wanted = {("tof", "WARN"), ("tof", "FAIL"), ("stereo", "WARN"), ("rig", "FAIL")}
    assert wanted <= {(f.what, f.verdict) for f in found}
    assert all(f.advice for f in found if f.verdict != "PASS")
    assert not any(f.what == "devices" for f in found)


def test_silent_controller(tmp_path):
    """An arm whose controller does not answer fails in the driver's own words."""
    text = (
        '[arm]\ndriver = "ur_rtde"\nhost = "127.250.0.8"\n[tof]\ndriver = "sim"\n[stereo]\ndriver = "sim"\n'
    )
    (finding,) = [f for f in _station(tmp_path, text + PLAN) if f.what == "arm"]
    assert finding.verdict == "FAIL"
    assert "127.250.0.8: RTDE's port 30004" in finding.found
    assert "cable" in finding.advice


@pytest.mark.parametrize(("free", "verdict"), [(5e8, "FAIL"), (2e9, "WARN"), (5e10, "PASS")])
def test_full_disk(monkeypatch, tmp_path, free, verdict):
    """Less than a gigabyte is a FAIL, less than five a WARN."""
    usage = type("Usage", (), {"free": free})()
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage)
    assert _verdicts(doctor.check_folder(tmp_path))["disk"] == verdict


@pytest.mark.parametrize(("kind", "verdict"), [("nfs4", "FAIL"), ("tmpfs", "WARN"), ("ext4", "PASS")])
def test_file_systems(tmp_path, kind, verdict):
    """Network file systems fail, memory warns; of several mounts the nearest counts."""
    mounts = tmp_path / "mounts"
    mounts.write_text(f"/dev/sda1 / xfs rw 0 0\nserver:/x {tmp_path} {kind} rw 0 0\n")
    assert _verdicts(doctor.check_folder(tmp_path, mounts))["file system"] == verdict


def test_slow_disk(tmp_path):
    """A disk that syncs slowly is a warning that says how slow."""
    times = iter(range(100))
    (finding,) = doctor.check_disk_speed(tmp_path, lambda: float(next(times)))
    assert finding.verdict == "WARN"
    assert "1000.0 ms" in finding.found
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("pairs", "verdict"),
    [
        ([(0.0, 2e9), (0.3, 2e9 + 1.3)], "WARN"),
        ([(0.0, 2e9), (0.3, 2e9 + 0.3)], "PASS"),
        ([(0, 1e6)], "FAIL"),
    ],
)
def test_clock(pairs, verdict):
    """A clock that jumps warns, one that was never set fails."""
    left = iter(pairs)
    assert _verdicts(doctor.check_clock(lambda: next(left)))["clock"] == verdict


def test_ports_of_others(monkeypatch, tmp_path):
    """A port that is not ours warns and names the group; no port is nothing wrong."""
    assert _verdicts(doctor.check_ports(tmp_path)) == {"serial ports": "PASS"}
    (tmp_path / "ttyACM0").touch()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (finding,) = doctor.check_ports(tmp_path)
    assert finding.verdict == "WARN"
    assert "usermod -aG" in finding.advice


def test_folder_of_the_daemon(monkeypatch, tmp_path):
    """Too long a path and a folder that others can look into are warnings; none yet is fine."""
    monkeypatch.setenv("TOFCAPTURE_STATE", str(tmp_path / "new"))
    assert list(doctor.check_daemon()) == [
        Finding("daemon folder", "PASS", str(tmp_path / "new")),
        Finding("daemon", "PASS", "none runs"),
    ]
    (tmp_path / "new").mkdir(mode=0o755)
    (tmp_path / "new").chmod(0o755)
    assert "chmod 700" in next(doctor.check_daemon()).advice
    monkeypatch.setenv("TOFCAPTURE_STATE", str(tmp_path / ("x" * 120)))
    assert "TOFCAPTURE_STATE" in next(doctor.check_daemon()).advice


class _Acme(Arm):
    """Somebody's arm, whose driver forgot what it is like."""

    def __init__(self, table, context):
        del table, context

    def describe(self):
        return ArmInfo("acme 6", "1")

    def cautions(self):
        return ["its brakes are not tested"]


class _Entry:
    name, value = "acme", "acme:DRIVERS"

    def load(self):
        return {"arm": _Acme}


def test_what_an_own_arm_lacks_is_said(tmp_path, monkeypatch):
    """Unknown kinematics, a home that is not clear and switched-off checks are found before anything opens; a table mends it."""
    found_by = registry.entry_points
    monkeypatch.setattr(registry, "entry_points", lambda group: [*found_by(group=group), _Entry()])
    devices = '[arm]\ndriver = "acme"\n{more}[tof]\ndriver = "sim"\n[stereo]\ndriver = "sim"\n'
    rows = MODELS["ur5e"].closed
    dh = [[0, rows.d[0], 90, 0], [rows.a[0], 0, 0, 0], [rows.a[1], 0, 0, 0], [0, rows.d[1], 90, 0]]
    dh += [[0, rows.d[2], -90, 0], [0, rows.d[3], 0, 0]]
    table = f"[arm.kinematics]\ndh = {dh}\nradius = 0.05\n"
    for more, plan, verdict, words in (
        ("", PLAN, "FAIL", "nobody knows its kinematics"),
        (table, PLAN, "PASS", "home is clear"),
        (table, PLAN + "home = [3.1, 0.9, 0.9, -1.7, -1.5, 0.0]\n", "FAIL", "home is not clear: table"),
        ("[arm.kinematics]\ndh = [[1, 2, 3]]\n", PLAN, "FAIL", "arm.kinematics"),
    ):
        found = _station(tmp_path, devices.format(more=more) + plan)
        (finding,) = [f for f in found if f.what == "arm kinematics"]
        assert finding.verdict == verdict
        assert words in finding.found
        assert finding.advice or verdict == "PASS"
        assert [f.found for f in found if f.what == "arm caution"] == ["its brakes are not tested"]


def test_taking_control_is_said_first(tmp_path, capsys, monkeypatch):
    """``--open`` says that it takes control of the arm before it does anything."""
    said = []
    monkeypatch.setattr(doctor, "probe", lambda *_: said.append(capsys.readouterr().err) or [])
    file = tmp_path / "lab.toml"
    file.write_text(PLAN)
    main(["doctor", "--station", str(file), "--open", "--folder", str(tmp_path)])
    assert "takes control of" in said[0]
    assert "lab.toml" in said[0]
