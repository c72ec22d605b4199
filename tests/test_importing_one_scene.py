"""One scene, written by encoders of the tests in every form that is read, gives the same views: taps, channels, camera, truth, poses."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from tests.test_importing import _matlab
from tests.test_importing_vendors import b0548_rows, luxonis_words
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data

cv2 = pytest.importorskip("cv2")
pytest.importorskip("rosbags")
from tests.test_import_bags import START, Bag, S  # noqa: E402

SHAPE, VIEWS = (480, 640), 2
MHZ, DEG = (80,) * 4 + (100,) * 4, (0, 90, 180, 270) * 2
TOF = {"fx": 500.0, "fy": 505.0, "cx": 321.0, "cy": 236.5, "width": 640, "height": 480}
CHANNELS = {"modulation_mhz": list(MHZ), "phase_deg": list(DEG), "saturation": 1023, "offset": True}


def scene():
    """Taps (views, 8, H, W) of ten bits, depth in whole millimetres, and poses of the camera."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    x, y = (u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"]
    mm = np.rint([900 + 50 * i + 150 * np.sin(4 * x) * np.cos(3 * y + i) for i in range(VIEWS)])
    r = mm[:, None] / 1000 * np.sqrt(1 + x**2 + y**2)
    phi = 4 * np.pi * 1e6 * np.array(MHZ)[:, None, None] / 299_792_458 * r
    raw = np.rint(500 + 300 * np.cos(phi + np.radians(DEG)[:, None, None])).astype(np.uint16)
    return raw, mm.astype(np.uint16), [[0.1 * i, 0.2, 0.3] for i in range(VIEWS)]


def in_files(form, root, raw, mm, places):
    """Arrays, images or a camera's bytes with the depths and a line of TUM for each view; returns what has to be said."""
    lines = [f"{START // S + i}.0 {' '.join(map(str, p))} 0 0 0 1\n" for i, p in enumerate(places)]
    (root / "poses.txt").write_text("".join(lines))
    z, name = (mm / 1000).astype(np.float32), [f"{START // S + i}.000000" for i in range(VIEWS)]
    for i in range(VIEWS):
        taps = {"raw": np.moveaxis(raw[i], 0, -1), "depth": z[i]}
        if form == "npy":
            np.save(root / f"raw_{name[i]}.npy", raw[i])
            np.save(root / f"depth_{name[i]}.npy", z[i])
        elif form == "npz":
            np.savez(root / f"{name[i]}.npz", raw=raw[i], depth=z[i])
        elif form in {"mat", "mat73"}:
            _matlab(root / f"{name[i]}.mat", taps, seven_three=form == "mat73")
        elif form == "hdf5":
            with h5py.File(root / f"{name[i]}.h5", "w") as file:
                file["tof/raw"], file["gt/depth"] = raw[i], z[i]
        elif form == "png":
            for k in range(8):
                cv2.imwrite(str(root / f"raw_{name[i]}_c{k}.png"), raw[i, k])
            cv2.imwrite(str(root / f"depth_{name[i]}.png"), mm[i])
        else:
            (root / f"raw_{name[i]}.raw").write_bytes(LAYOUTS[form][0](raw[i]))
            np.save(root / f"depth_{name[i]}.npy", z[i])
    more = {"layout": form, **LAYOUTS[form][1]} if form in LAYOUTS else {}
    unit = {"unit": "mm"} if form == "png" else {}
    return root, Said(
        scene="wall", tof={**TOF, **CHANNELS}, raw=more, truth=unit, poses={"file": "poses.txt"}
    )


def in_a_bag(form, root, raw, mm, places):
    """Stacked images of 16 bits, depth in metres, CameraInfo, and the poses as tf."""
    bag = Bag(root / "bag", {"ros2": "sqlite3"}.get(form, form))
    for i in range(VIEWS):
        time = START + i * S
        bag.camera("/tof/camera_info", time, SHAPE, tof=TOF)
        bag.image("/tof/raw", time, raw[i].reshape(-1, SHAPE[1]), "mono16")
        bag.image("/tof/depth", time, (mm[i] / 1000).astype(np.float32), "32FC1")
        bag.tf(time, "base", "tof", places[i])
    return bag.write(), Said(scene="wall", tof=CHANNELS)


def words(raw):
    return raw.astype("<u2").tobytes()


LAYOUTS = {  # bytes of a frame of eight images, and what is said of the size
    "arducam-b0548": (lambda raw: b0548_rows(raw).tobytes(), {}),
    "arducam-b0548-double": (lambda raw: b0548_rows(raw, pitch=480).tobytes(), {}),
    "luxonis-oak-tof": (luxonis_words, {}),
    "ti-opt8241": (words, {"shape": list(SHAPE)}),
    "espros": (words, {"shape": list(SHAPE)}),
}
FILES = ("npy", "npz", "mat", "mat73", "hdf5", "png", *LAYOUTS)


@pytest.mark.slow
def test_one_scene_is_the_same_views_in_every_form(tmp_path):
    """Raw bit for bit, channels, intrinsics, stamps' order and poses exact, depth to a float's last bit."""
    raw, mm, places = scene()
    for form in (*FILES, "ros2", "ros1", "mcap", "json"):
        root = tmp_path / form
        root.mkdir()
        source, said = (in_files if form in FILES else in_a_bag)(form, root, raw, mm, places)
        import_data([source], root / "rec", said)
        views = [open_view(p) for p in find_views(root / "rec")["wall"]]
        assert len(views) == VIEWS, form
        for i, view in enumerate(views):
            info = view.tof.info
            np.testing.assert_array_equal(view.tof.raw[0], raw[i], err_msg=form)
            assert view.tof.raw.dtype == np.uint16
            np.testing.assert_allclose(view.stereo.points[..., 2], mm[i] / 1000, rtol=1e-6, err_msg=form)
            np.testing.assert_allclose(info.modulation_hz, 1e6 * np.array(MHZ), err_msg=form)
            np.testing.assert_allclose(info.phase_rad, np.radians(DEG), err_msg=form)
            assert (info.saturation, info.offset) == (1023, True), form
            assert {k: getattr(info.camera, k) for k in TOF} == TOF, form
            np.testing.assert_allclose(view.arm_before.T_base_flange[:3, 3], places[i], err_msg=form)
            assert view.tof.time_ns[0] == START + i * S, form
