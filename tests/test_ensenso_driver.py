"""The driver ensenso: the real nxlib package on a fake shared library that knows the order of commands."""

from collections import deque

import numpy as np
import pytest

pytest.importorskip("nxlib")


from tests.fake_nxlib import FakeCamera, FakeNxLib, installed
from tofcapture.devices import registry
from tofcapture.devices.registry import StationContext
from tofcapture.devices.stereo.ensenso import CaptureTimeoutError, Ensenso, metres
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.testing import check_stereo

SERIAL = "171197"
ME = {"Cameras": SERIAL}
SETUP = [
    "Initialize",
    ("Open", ME),
    ("Set", "Parameters/Capture/TriggerMode", "Software"),
    ("Set", "Parameters/Capture/FlexView", 8),
    ("Set", "Parameters/Capture/AutoExposure", True),
]
SHOT = [("Capture", {**ME, "Timeout": 5000})]
FREEZE = [("Set", "Parameters/Capture/AutoExposure", False), ("Set", "Parameters/Capture/Exposure", 7.25)]
COMPUTE = [("ComputeDisparityMap", ME), ("ComputePointMap", ME)]
END = [("Close", ME), "Finalize"]


def small(**changes):
    rng = np.random.default_rng(0)
    points = rng.uniform(400, 900, (6, 8, 3)).astype(np.float32)
    points[2, 3] = np.nan
    points[4, 5, 1] = np.inf
    return FakeCamera(SERIAL, **{"points_mm": points, **changes})


@pytest.fixture
def fake():
    """Install a fake SDK with one small camera."""
    with installed(FakeNxLib(small())) as sdk:
        yield sdk


def device(folder, **table):
    return Ensenso({"serial": SERIAL, **table}, StationContext({}, folder))


def test_registered_under_its_name():
    """The registry finds the driver, and making it loads no SDK."""
    assert registry.load_driver("ensenso").keys() == {"stereo"}


def test_exact_commands(fake, tmp_path):
    """Open, two captures and close give these commands, no more, in this order; exposure is held after the first."""
    with device(tmp_path) as stereo:
        stereo.capture()
        stereo.capture()
    stereo.close()
    assert fake.log == [*SETUP, *SHOT, *FREEZE, *COMPUTE, *SHOT, *COMPUTE, *END]


def test_metres_and_holes(fake, tmp_path):
    """Millimetres become metres; a point with any coordinate missing is missing altogether."""
    with device(tmp_path) as stereo:
        frame = stereo.capture()
    given = fake.cameras[SERIAL].points_mm
    hole = ~np.isfinite(given).all(axis=-1)
    assert hole.sum() == 2
    assert np.isnan(frame.points[hole]).all()
    assert frame.points.dtype == np.float32
    np.testing.assert_allclose(frame.points[~hole], given[~hole] / 1000, rtol=1e-6)
    assert isinstance(frame.time_ns, int)


def test_full_size(tmp_path):
    """A full 1280 x 1024 point map comes through."""
    with installed(FakeNxLib(FakeCamera(SERIAL))), device(tmp_path) as stereo:
        points = stereo.capture().points
    assert points.shape == (1024, 1280, 3)
    assert np.nanmax(points[..., 2]) == pytest.approx(0.8)
    assert np.isnan(points).all(axis=-1).mean() == pytest.approx(1 / 64)


def test_described_unopened_after_the_first_contact(fake, tmp_path):
    """Before the first contact the description is missing or the table's; afterwards it is the camera's own."""
    with pytest.raises(ConfigError, match="model, camera"):
        device(tmp_path).describe()
    camera = {"width": 8, "height": 6, "fx": 7.0, "fy": 7.0, "cx": 3.5, "cy": 2.5}
    assert device(tmp_path, model="N35", camera=camera).describe().camera.fx == 7.0
    with device(tmp_path) as stereo:
        opened = stereo.describe()
    assert device(tmp_path).describe() == opened
    assert opened.camera.shape == (6, 8)
    assert (opened.camera.fx, opened.camera.cx, opened.camera.cy) == (pytest.approx(7.2), 3.5, 2.5)
    assert opened.serial == SERIAL


def test_new_calibration_is_refused(fake, tmp_path):
    """A camera whose calibration changed since the first contact is refused."""
    with device(tmp_path):
        pass
    fake.tree["Cameras"][SERIAL]["Calibration"]["Stereo"]["Left"]["Camera"][0][0] += 1
    with pytest.raises(DeviceError, match="its calibration is not the one"):
        device(tmp_path).__enter__()
    assert fake.log[-2:] == END


@pytest.mark.parametrize(
    "link",
    [
        {"Target": "Workspace"},
        {"Target": "", "Rotation": {"Angle": 0.1, "Axis": [0, 0, 1]}, "Translation": [0, 0, 0]},
        {"Target": "", "Rotation": {"Angle": 0.0, "Axis": [0, 0, 1]}, "Translation": [0, 5.0, 0]},
    ],
)
def test_link_is_refused_or_cleared(fake, tmp_path, link):
    """A link that moves points into another frame is refused, and nothing is captured; or cleared when asked."""
    tree = fake.tree["Cameras"][SERIAL]
    tree["Link"] = {"Rotation": {"Angle": 0.0, "Axis": [0, 0, 1]}, "Translation": [0, 0, 0], **link}
    with pytest.raises(DeviceError, match="not in its own frame"):
        device(tmp_path).__enter__()
    assert fake.log == ["Initialize", ("Open", ME), *END]
    with device(tmp_path, link="clear") as stereo:
        stereo.capture()
    assert tree["Link"]["Target"] == ""
    assert tree["Link"]["Rotation"]["Angle"] == 0
    assert tree["Link"]["Translation"] == [0, 0, 0]


def test_no_link_at_all_is_fine(fake, tmp_path):
    """An absent or null link is no link."""
    for link in (None, {}):
        fake.tree["Cameras"][SERIAL]["Link"] = link
        with device(tmp_path) as stereo:
            stereo.capture()


def test_one_timeout_is_tried_again(fake, tmp_path):
    """One timeout costs one more capture and nothing else."""
    fake.cameras[SERIAL].fail["Capture"] = deque(["CaptureTimeout"])
    with device(tmp_path) as stereo:
        stereo.capture()
    assert fake.log == [*SETUP, *SHOT, *SHOT, *FREEZE, *COMPUTE, *END]


def test_two_timeouts_reopen(fake, tmp_path):
    """Two timeouts close and open the camera; an exposure that was held stays held."""
    with device(tmp_path) as stereo:
        stereo.capture()
        fake.cameras[SERIAL].fail["Capture"] = deque(["CaptureTimeout"] * 2)
        fake.log.clear()
        stereo.capture()
    again = [*SETUP[:4], *FREEZE]
    assert fake.log == [*SHOT, *SHOT, *END, *again, *SHOT, *COMPUTE, *END]


def test_three_timeouts_fail_the_view_and_the_next_opens_anew(fake, tmp_path):
    """Three timeouts are an error that says what to look at; a later capture works."""
    fake.cameras[SERIAL].fail["Capture"] = deque(["CaptureTimeout"] * 3)
    with device(tmp_path) as stereo:
        with pytest.raises(CaptureTimeoutError, match="capturing: CaptureTimeout") as caught:
            stereo.capture()
        assert "jumbo frames" in caught.value.hint
        assert fake.log.count("Initialize") == 2
        assert fake.log[-2:] == END
        assert stereo.capture().points.shape == (6, 8, 3)


def test_other_errors_are_not_tried_again(fake, tmp_path):
    """Any other failure is an error at once, with the SDK's own symbol and words."""
    fake.cameras[SERIAL].fail["ComputeDisparityMap"] = deque(["LicenseMissing"])
    with (
        device(tmp_path) as stereo,
        pytest.raises(DeviceError, match="LicenseMissing in ComputeDisparityMap"),
    ):
        stereo.capture()
    assert sum(entry == SHOT[0] for entry in fake.log) == 1
    assert fake.log[-2:] == END


def test_fixed_exposure_and_no_flexview(fake, tmp_path):
    """A named exposure is set in milliseconds and automatic exposure stays off; FlexView 0 is off."""
    with device(tmp_path, exposure=0.004, flexview=0, timeout=2.5) as stereo:
        stereo.capture()
    assert ("Set", "Parameters/Capture/FlexView", False) in fake.log
    assert fake.log[4:6] == [
        ("Set", "Parameters/Capture/AutoExposure", False),
        ("Set", "Parameters/Capture/Exposure", 4.0),
    ]
    assert fake.log[6] == ("Capture", {**ME, "Timeout": 2500})
    assert FREEZE[1] not in fake.log


def test_missing_camera_kind_and_busy(tmp_path):
    """No such camera, the wrong kind, and one that another program holds are told apart, and the SDK is closed."""
    with installed(FakeNxLib(FakeCamera("1", points_mm=small().points_mm))) as sdk:
        with pytest.raises(DeviceError, match="no Ensenso camera 171197; there are: 1"):
            device(tmp_path).__enter__()
        assert sdk.log == ["Initialize", "Finalize"]
    with installed(FakeNxLib(small(kind="Monocular"))), pytest.raises(DeviceError, match="Monocular"):
        device(tmp_path).__enter__()
    with installed(FakeNxLib(small())) as sdk:
        sdk.tree["Cameras"][SERIAL]["Status"]["Available"] = False
        with pytest.raises(DeviceError, match="cannot be opened"):
            device(tmp_path).__enter__()


def test_sdk_missing_names_what_to_install(tmp_path, monkeypatch):
    """Without the shared library, and without the package, the error says what to install."""
    monkeypatch.setenv("NXLIB_LIBRARY_PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"SDK is not installed.*libNxLib64") as caught:
        device(tmp_path).__enter__()
    assert "ensenso.com" in caught.value.hint
    monkeypatch.setitem(__import__("sys").modules, "nxlib", None)
    with pytest.raises(ConfigError, match="Python package nxlib") as caught:
        device(tmp_path).__enter__()
    assert caught.value.hint == "pip install nxlib"


def test_empty_and_foreign_point_maps(tmp_path):
    """A point map without a point, or of another shape or type, is an error and no view."""
    empty = np.full((6, 8, 3), np.nan, np.float32)
    with pytest.raises(DeviceError, match="has no point"):
        metres(empty, (6, 8), SERIAL)
    for wrong in (empty[:5], empty.astype(np.float64)):
        with pytest.raises(DeviceError, match="point map: expected"):
            metres(wrong, (6, 8), SERIAL)


@pytest.mark.parametrize(
    ("table", "match"),
    [({"serial": 171197}, "serial"), ({"flexview": 1}, "flexview"), ({"flexview": 99}, "flexview"),
     ({"link": "ignore"}, "link"), ({"flexview2": 3}, "does not know flexview2")],
)  # fmt: skip
def test_wrong_tables(tmp_path, table, match):
    """Settings that make no sense are refused when the driver is made."""
    with pytest.raises(ConfigError, match=match):
        device(tmp_path, **table)


def test_keeps_the_contract(fake, tmp_path):
    """The driver passes the conformance suite of stereo cameras."""
    with device(tmp_path):
        pass
    check_stereo(lambda: device(tmp_path, exposure=0.004))


def test_missing_sdk_is_named_across_the_process(tmp_path, monkeypatch):
    """In its own process too, a missing SDK is a configuration error that says what to install."""
    monkeypatch.setenv("NXLIB_LIBRARY_PATH", str(tmp_path))
    hosted = registry.load_driver("ensenso")["stereo"]({"serial": SERIAL}, StationContext({}, tmp_path))
    with pytest.raises(ConfigError, match="SDK is not installed"):
        hosted.__enter__()
    hosted.__exit__(None, None, None)
