"""Data of others become a recording: any file form gives the same views, and what cannot be right is named with the remedy."""

from __future__ import annotations

import json
import struct

import h5py
import numpy as np
import pytest

from tofcapture.cli import main
from tofcapture.errors import TofError
from tofcapture.files.check import check
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.poses import read_poses
from tofcapture.importing.said import Said
from tofcapture.importing.views import UNFINISHED, import_data
from tofcapture.poses import exp

SHAPE = (30, 40)
TOF = {"fx": 45.0, "fy": 46.0, "cx": 19.0, "cy": 15.5}
HZ = np.repeat([20e6, 100e6], 4)
THETA = np.tile(np.arange(4) * np.pi / 2, 2)


def scene(seed=0, shape=SHAPE):
    """Raw taps (8, H, W) uint16 and depth (H, W) of a slanted wall with a box before it."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = (u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"]
    z = 1 / (1 / (0.9 + 0.1 * rng.random()) + 0.5 * x - 0.3 * y)
    z[8:18, 6:22] -= 0.15
    phi = 4 * np.pi * HZ[:, None, None] / 299_792_458 * z * np.sqrt(1 + x**2 + y**2)
    raw = 1500 + 400 / z**2 * np.cos(phi + THETA[:, None, None]) + rng.normal(0, 3, (8, *shape))
    return np.rint(raw).astype(np.uint16), z.astype(np.float32)


def scenes(views=3):
    """(N, 8, H, W) and (N, H, W)."""
    raw, depth = zip(*(scene(i) for i in range(views)), strict=True)
    return np.stack(raw), np.stack(depth)


def imported(source, out, **said):
    """Views that a source becomes, in order."""
    import_data([source], out, Said(**{"tof": TOF, **said}))
    return [open_view(p) for views in find_views(out).values() for p in views]


def test_a_folder_of_arrays_becomes_a_recording(tmp_path):
    """Numbered arrays pair with numbered depths; views are whole, exact, and the recording is without problems."""
    raw, depth = scenes()
    for i in range(3):
        np.save(tmp_path / f"raw_{i}.npy", raw[i])
        np.save(tmp_path / f"depth_{i}.npy", depth[i])
    words = ["import", str(tmp_path), "--out", str(tmp_path / "rec"), "--camera", "45,46,19,15.5"]
    assert main(words) == 0
    views = [open_view(p) for p in find_views(tmp_path / "rec")[tmp_path.name]]
    for i, view in enumerate(views):
        np.testing.assert_array_equal(view.tof.raw[0], raw[i])
        np.testing.assert_array_equal(view.stereo.points[..., 2], depth[i])
        assert not view.has_arm
    assert check(tmp_path / "rec") == []
    assert not (tmp_path / "rec" / UNFINISHED).exists()


def test_again_does_nothing_and_other_data_are_refused(tmp_path):
    """The same import is finished at once; another source of that name is refused and changes nothing."""
    raw, depth = scenes(2)
    source = tmp_path / "mug"
    source.mkdir()
    np.save(source / "raw.npy", raw[:, None])
    np.save(source / "depth.npy", depth)
    first = imported(source, tmp_path / "rec")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "rec").rglob("*.h5")}
    again = import_data([source], tmp_path / "rec", Said(tof=TOF))
    assert again.skipped == ["mug"]
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "rec").rglob("*.h5")} == before
    np.save(source / "raw.npy", raw[::-1, None])
    with pytest.raises(TofError, match="is not of these data"):
        import_data([source], tmp_path / "rec", Said(tof=TOF))
    assert len(first) == 2


def _matlab(path, arrays, *, seven_three=False):
    """Write arrays as MATLAB does: rows, columns, then the rest; version 7.3 is HDF5 with axes in reverse."""
    if not seven_three:
        pytest.importorskip("scipy.io").savemat(path, arrays)
        return
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = array.T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116))


def _images(folder, raw, depth, suffix):
    """One 16-bit image a channel, and depths in millimetres."""
    cv2 = pytest.importorskip("cv2")
    for i, (taps, z) in enumerate(zip(raw, depth, strict=True)):
        for k, tap in enumerate(taps):
            cv2.imwrite(str(folder / f"view{i:02d}_c{k}{suffix}"), tap)
        np.save(folder / f"view{i:02d}_depth.npy", z)


def _write(form, folder, raw, depth):
    """Write one scene of N views in a form; returns what has to be said of it."""
    if form == "npy":
        for i in range(len(raw)):
            np.save(folder / f"raw_{i}.npy", raw[i])
            np.save(folder / f"depth_{i}.npy", depth[i])
    elif form == "big-endian":
        np.save(folder / "raw.npy", raw[:, None].astype(">u2"))
        np.save(folder / "gt.npy", depth.astype(">f8"))
    elif form == "npz":
        for i in range(len(raw)):
            np.savez(folder / f"{i:04d}.npz", raw=raw[i], depth=depth[i])
    elif form == "npz-scene":
        np.savez(folder / "mug.npz", raw=raw[:, None], depth=depth, modulation_hz=HZ, phase_rad=THETA)
    elif form in ("mat", "mat73"):
        for i in range(len(raw)):
            arrays = {"raw": np.moveaxis(raw[i], 0, -1), "depth": depth[i]}
            _matlab(folder / f"view{i}.mat", arrays, seven_three=form == "mat73")
    elif form == "mat-struct":
        for i in range(len(raw)):
            held = {"raw": np.moveaxis(raw[i], 0, -1), "depth": depth[i]}
            _matlab(folder / f"view{i}.mat", {"data": held})
    elif form == "mat-cells":
        cells = {n: np.empty(len(raw), object) for n in ("raw", "depth")}
        for i in range(len(raw)):
            cells["raw"][i], cells["depth"][i] = np.moveaxis(raw[i], 0, -1), depth[i]
        _matlab(folder / "mug.mat", cells)
    elif form == "mat73-cells":
        _matlab(folder / "mug.mat", {}, seven_three=True)
        with h5py.File(folder / "mug.mat", "r+") as file:
            for name, held in (("raw", [np.moveaxis(r, 0, -1) for r in raw]), ("depth", depth)):
                refs = [file.create_dataset(f"#refs#/{name}{i}", data=x.T).ref for i, x in enumerate(held)]
                file.create_dataset(name, (len(refs), 1), h5py.ref_dtype)[:, 0] = refs
    elif form == "pages":
        cv2 = pytest.importorskip("cv2")
        for i in range(len(raw)):
            cv2.imwritemulti(str(folder / f"raw{i}.tiff"), list(raw[i]))
        np.save(folder / "depth.npy", depth)
    elif form == "organised":
        head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        head += f"WIDTH {SHAPE[1]}\nHEIGHT {SHAPE[0]}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {SHAPE[0] * SHAPE[1]}\nDATA ascii\n"
        for i in range(len(raw)):
            np.save(folder / f"raw_{i}.npy", raw[i])
            points = depth[i][..., None].astype(float) * _rays(points=True)
            with (folder / f"cloud_{i}.pcd").open("w") as file:
                file.write(head)
                np.savetxt(file, points.reshape(-1, 3), fmt="%.9g")
        return {"truth": {"T_tof_truth": np.eye(4).tolist()}}
    elif form == "mat-scene":
        _matlab(
            folder / "mug.mat", {"raw": np.moveaxis(raw, (0, 1), (3, 2)), "depth": np.moveaxis(depth, 0, -1)}
        )
    elif form == "hdf5":
        with h5py.File(folder / "mug.h5", "w") as file:
            file["tof/raw"], file["gt/depth"] = raw[:, None], depth
    elif form in (".png", ".tif"):
        _images(folder, raw, depth, form)
    elif form == "millimetres":
        for i in range(len(raw)):
            np.save(folder / f"raw_{i}.npy", raw[i])
            np.save(folder / f"depth_{i}.npy", np.float64(1000) * depth[i])
        return {"truth": {"unit": "mm"}}
    elif form == "turned":
        np.save(folder / "raw.npy", np.swapaxes(raw[:, None], 3, 4))
        for i in range(len(raw)):
            np.save(folder / f"depth_{i}.npy", depth[i].T)
        return {"raw": {"axes": "NFKWH"}, "truth": {"axes": "WH"}}
    elif form == "folders":
        for i in range(len(raw)):
            (folder / "tof" / f"{i:03d}").mkdir(parents=True)
            for k in range(8):
                np.save(folder / "tof" / f"{i:03d}" / f"{k}.npy", raw[i, k])
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{i:03d}.npy", depth[i])
    elif form == "words":
        for i in range(len(raw)):
            (folder / f"raw{i}.raw").write_bytes(raw[i].astype(">u2").tobytes())
            np.save(folder / f"depth{i}.npy", depth[i])
        return {"raw": {"shape": list(SHAPE)}}
    elif form == "words-interleaved":
        for i in range(len(raw)):
            (folder / f"raw{i}.raw").write_bytes(np.moveaxis(raw[i], 0, -1).astype("<u2").tobytes())
            np.save(folder / f"depth{i}.npy", depth[i])
        return {"raw": {"shape": [*SHAPE, 8]}}
    elif form == "words-of-floats":
        for i in range(len(raw)):
            (folder / f"raw{i}.bin").write_bytes(raw[i].astype("<u2").tobytes())
            (folder / f"depth{i}.bin").write_bytes(depth[i].astype("<f4").tobytes())
        return {"raw": {"shape": list(SHAPE)}}
    elif form == "channels-first":
        np.save(folder / "raw.npy", np.moveaxis(raw, 0, -1))
        np.save(folder / "depth.npy", np.moveaxis(depth, 0, -1))
    elif form == "frequencies-and-phases":
        np.savez(folder / "mug.npz", raw=raw.reshape(-1, 2, 4, *SHAPE), depth=depth)
    elif form == "frequencies-apart":
        with h5py.File(folder / "mug.h5", "w") as file:
            file["raw/20MHz"], file["raw/100MHz"], file["depth"] = raw[:, :4], raw[:, 4:], 1000.0 * depth
            file["depth"].attrs["units"] = "millimetres"
    elif form == "channels-apart":
        taps = {f"I{k}": raw[:, k] for k in range(8)}
        np.savez(folder / "mug.npz", **taps, depth_mm=np.float64(1000) * depth)
    elif form == "told-apart":
        np.savez(folder / "mug.npz", x=raw, y=depth)
        return {"scene": "mug", "raw": {"files": "*:x"}, "truth": {"files": "*:y"}}
    elif form == "points":
        v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
        rays = np.stack([(u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"], 1 + 0 * u], axis=-1)
        np.save(folder / "raw.npy", raw[:, None])
        np.save(folder / "xyz.npy", depth[..., None].astype(float) * rays)
        return {"truth": {"T_tof_truth": np.eye(4).tolist()}}
    return {}


FORMS = (
    "npy", "big-endian", "npz", "npz-scene", "mat", "mat73", "mat-scene", "mat-struct", "mat-cells", "mat73-cells", "pages", "organised", "hdf5", ".png", ".tif", "millimetres", "words-interleaved", "words-of-floats", "channels-first", "frequencies-and-phases", "frequencies-apart", "channels-apart", "told-apart", "turned", "folders", "words", "points",
)  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_one_scene_is_the_same_views_in_every_form(form, tmp_path):
    """Taps come back exactly, ground truth to a float's last bits, as one scene of three views."""
    raw, depth = scenes()
    folder = tmp_path / "mug"
    folder.mkdir()
    views = imported(folder, tmp_path / "rec", **_write(form, folder, raw, depth))
    assert len(views) == 3
    for i, view in enumerate(views):
        assert view.tof.raw.dtype == np.uint16
        np.testing.assert_array_equal(view.tof.raw[0], raw[i])
        np.testing.assert_allclose(view.stereo.points[..., 2], depth[i], rtol=3e-7)
        assert view.scene == "mug"
    assert check(tmp_path / "rec") == []


def none(*_):
    """Return what spoils without saying anything."""


def wrong(folder):
    """Give functions that spoil a source, what is said about it then, and the word of the remedy."""
    raw, depth = scenes()

    def put(r=raw, d=depth, **more):
        for i in range(len(r)):
            np.save(folder / f"raw_{i}.npy", r[i])
        for i in range(len(d) if d is not None else 0):
            np.save(folder / f"depth_{i}.npy", d[i])
        return more

    def bytes_of(name, data):
        put()
        (folder / name).write_bytes(data)

    size = {"width": SHAPE[1], "height": SHAPE[0]}
    order = [0, 2, 1, 3, 4, 6, 5, 7]
    colours = np.repeat((depth[0] * 50)[..., None], 3, -1).astype(np.uint8)
    colours[..., 1] = 0
    noise = np.random.default_rng(0).integers(0, 4000, raw.shape).astype(np.uint16)
    T_far = np.eye(4)
    T_far[0, 3] = 50.0
    T_left = np.diag([-1.0, 1, 1, 1])
    identity = np.eye(4).tolist()
    camera2 = {"width": 20, "height": 15, "fx": 22.0, "fy": 22.0, "cx": 9.5, "cy": 7.0}
    return {
        "nothing there": (lambda: None, "found an empty folder", "np.save"),
        "only text": (lambda: none((folder / "notes.txt").write_text("x")), "found notes.txt", "np.save"),
        "depth in mm": (lambda: put(d=depth * 1000), "depths of 0.02 to 30 m", 'unit = "mm"'),
        "depth in cm": (lambda: put(d=depth * 100), "depths of 0.02 to 30 m", "unit"),
        "metres called mm": (lambda: put(truth={"unit": "mm"}), "as mm say", 'unit = "m"'),
        "a unit of nobody": (lambda: put(truth={"unit": "in"}), "unit among", ""),
        "rows and columns swapped": (lambda: put(np.swapaxes(raw, 2, 3), tof={**TOF, **size}), "expected 30 x 40", "axes"),
        "swapped, size not said": (
            lambda: put(np.swapaxes(raw, 2, 3), np.swapaxes(depth, 1, 2), tof={**TOF, "cx": 35.0}), "principal point", "axes"
        ),
        "taps scaled to one": (lambda: put(raw / 4095.0), "values up to", "4095"),
        "not a number": (lambda: put(np.where(raw == raw.max(), np.nan, raw / 1.5)), "finite numbers", "saturation"),
        "eight bits": (lambda: put((raw >> 4).astype(np.uint8)), "more than 8 bits", "16 bits"),
        "seven channels": (lambda: put(raw[:, :7]), "of 8 channels", "modulation_mhz"),
        "three channels of colour": (
            lambda: none(put(), _png(folder / "depth_0.png", colours), (folder / "depth_0.npy").unlink()), "colours", "grey"
        ),
        "a depth of 8 bits": (lambda: put(d=(depth * 100).astype(np.uint8)), "expected depths, got uint8", "16 bits"),
        "half the depths missing": (lambda: put(d=depth[:1]), "ground truth for each of 3 views", "none"),
        "the last depth missing": (lambda: put(d=depth[:2]), "there is none for 2", "copy"),
        "the last raw array missing": (lambda: put(raw[:2]), "none for depth_2.npy", "copy the missing raw"),
        "channels in another order": (lambda: put(raw[:, order]), "do not add up", "phase-order"),
        "frequencies swapped": (lambda: put(np.roll(raw, 4, axis=1)), "", "phase-order"),
        "noise": (lambda: put(noise), "", "phase-order"),
        "no light": (lambda: put(0 * raw), "no light", ""),
        "all saturated": (lambda: put(np.full_like(raw, 4095)), "100% of the pixels", "expose"),
        "more bits than said": (lambda: put(raw * 4), "saturates at 4095", "--saturation"),
        "depth mirrored": (lambda: put(d=depth[:, :, ::-1]), "agrees with the ToF image", "fliplr"),
        "depth upside down": (lambda: put(d=depth[:, ::-1]), "agrees with the ToF image", "flipud"),
        "depth turned by half": (lambda: put(d=depth[:, ::-1, ::-1]), "agrees with the ToF image", "rot90"),
        "depth turned": (lambda: put(d=np.swapaxes(depth, 1, 2)), "turned", '[truth] axes = "WH"'),
        "depth of another size": (lambda: put(d=depth[:, ::2, ::2]), "depth in the ToF image", "truth.camera"),
        "depth behind the camera": (lambda: put(d=-depth), "behind it", "OpenGL"),
        "depth all zero": (lambda: put(d=0 * depth), "every pixel is missing", "leave"),
        "second camera, no pose": (
            lambda: put(d=depth[:, ::2, ::2], truth={"camera": camera2}), "missing [truth] T_tof_truth", "(4, 4)"
        ),
        "second camera far away": (
            lambda: put(d=depth[:, ::2, ::2], truth={"camera": camera2, "T_tof_truth": T_far.tolist()}), "covers 0.0%", "metres"
        ),
        "left-handed": (
            lambda: put(d=depth[:, ::2, ::2], truth={"camera": camera2, "T_tof_truth": T_left.tolist()}), "right-handed", ""
        ),
        "points without a grid": (lambda: put(d=depth[:, None, None, :, :1]), "", ""),
        "points of no pinhole": (
            lambda: put(d=np.random.default_rng(0).random((3, *SHAPE, 3)) + 0.5, truth={"T_tof_truth": identity}), "pinhole", "z forward"
        ),
        "no intrinsics": (lambda: put(tof={}), "missing [tof] fx, [tof] fy, [tof] cx, [tof] cy", "--camera"),
        "a phase too few": (lambda: put(tof={**TOF, "modulation_mhz": [20] * 8, "phase_deg": [0] * 7}), "8 and 7", "phase_deg"),
        "hertz as megahertz": (
            lambda: put(tof={**TOF, "modulation_mhz": [20e-6] * 8, "phase_deg": [0, 90, 180, 270] * 2}), "Hz", "20e6"
        ),
        "a cut file": (lambda: bytes_of("raw_1.npy", (folder / "x").name.encode()), "raw_1.npy", "again"),
        "pickled": (lambda: none(put(), np.save(folder / "raw_1.npy", np.array([{}]), allow_pickle=True)), "raw_1.npy", "np.save"),
        "a size too small": (lambda: none(put(), np.save(folder / "raw_1.npy", raw[1, :, :20])), "", ""),
        "words without a size": (lambda: none((folder / "raw.raw").write_bytes(b"\0\1" * 999)), "does not say its size", "--shape"),
        "words after a header": (
            lambda: (folder / "raw.raw").write_bytes(b"\0\1" * 9607) and {"raw": {"shape": [30, 40]}}, "multiple of 30 x 40", "header of 14 bytes"
        ),
        "words of another size": (
            lambda: (folder / "raw.raw").write_bytes(b"\0\1" * 999) and {"raw": {"shape": [30, 40]}}, "multiple of 30 x 40", "rows"
        ),
        "axes of nobody": (lambda: put(raw_={"axes": "XYZ"}), "axes that name", "HWK"),
        "bytes in the other order": (lambda: put(raw.byteswap()), "", "byteswap"),
        "a constant image": (lambda: put(np.full_like(raw, 1500)), "no modulated light", ""),
        "complex phasors": (lambda: put(raw[:, :4] + 1j * raw[:, 4:]), "got complex", "z.imag"),
        "true and false": (lambda: put(raw > 1500), "more than 8 bits", "16 bits"),
        "a channel's file missing": (
            lambda: none(*(np.save(folder / f"v{i}_c{k}.npy", raw[i, k]) for i in range(3) for k in range(8) if (i, k) != (1, 3))),
            "none numbered 1-3", "missing"
        ),
        "half of the channels' files": (
            lambda: none(*(np.save(folder / f"v{i}_c{k}.npy", raw[i, k]) for i in range(3) for k in range(0, 8, 2))),
            "multiple of 8 images", "missing"
        ),
        "one image of all channels": (lambda: none(*(np.save(folder / f"raw_{i}.npy", r.reshape(-1, SHAPE[1])) for i, r in enumerate(raw))), "multiple of 8", "part them"),
        "other numbers": (lambda: none(put(), (folder / "raw_1.npy").unlink(), (folder / "depth_2.npy").unlink()), "not in step: raw has 2 alone, ground truth 1", "partner"),
        "a cut PNG": (lambda: none(put(), _png(folder / "depth_1.png", (depth[1] * 1000).astype(np.uint16)), _cut(folder / "depth_1.png"), (folder / "depth_1.npy").unlink()), "depth_1.png", "again"),
        "depth as JPEG": (lambda: none(put(d=None), (folder / "depth_0.jpg").write_bytes(b"\xff\xd8")), "got depth_0.jpg", "JPEG loses"),
        "depth as EXR": (lambda: none(put(d=None), (folder / "depth_0.exr").write_bytes(b"v/1")), "got depth_0.exr", "np.save"),
        "depth marked by -1": (lambda: put(d=np.where(depth > 1, -1, depth)), "behind it", "missing = [-1]"),
        "depth along the rays": (lambda: put(d=depth * _rays()), "mm off", 'kind = "radial"'),
        "depth in steps of 0.2 mm": (lambda: put(d=np.rint(5000 * depth), truth={"unit": "mm"}), "mm off", "steps of 0.2 mm"),
        "depth in feet": (lambda: put(d=depth / 0.3048), "mm off", "inches or feet"),
        "points with y up": (
            lambda: put(d=depth[..., None] * _rays(points=True) * [1, -1, 1], truth={"T_tof_truth": identity}), "fy -46", "y runs the other way"
        ),
        "a MAT of text": (lambda: none((folder / "raw.mat").write_text("# Created by Octave\n# name: raw\n")), "raw.mat", "again"),
        "a MAT of words": (lambda: none(_matlab(folder / "raw.mat", {"name": "mug"})), "raw.mat without arrays", "np.save"),
        "poses of NaN": (lambda: _poses(folder, put, "0 0 0 0 0 0 1\n" + "nan " * 7 + "\n0 0 0 0 0 0 1\n"), "pose 2: expected finite", "lost"),
        "left-handed poses": (lambda: _poses(folder, put, "1 0 0 0 0 1 0 0 0 0 -1 0\n" * 3), "right-handed", ""),
        "poses in mm": (lambda: _poses(folder, put, "".join(f"{300 * i} 0 0 0 0 0 1\n" for i in range(3))), "lie 600 m apart", 'unit = "mm"'),
        "poses of another clock": (
            lambda: none(*(np.save(folder / f"raw_{1700000000 + i}.500000.npy", r) for i, r in enumerate(raw)))
            or _poses(folder, none, "".join(f"{i} 0 0 0 0 0 0 1\n" for i in range(3))), "within 0.1 s", "time_offset_s"
        ),
        "poses of angles": (lambda: _poses(folder, put, "x,y,z,roll,pitch,yaw\n" + "0,0,0,0,0,0\n" * 3), "got x, y, z, roll", "from_euler"),
        "poses in short lines": (lambda: _poses(folder, put, "0 0 0\n" * 3), "lines of 7, 12 or 16", "one pose a line"),
        "a layout of nobody": (lambda: put(raw_={"layout": "acme"}), "arducam-b0410", ""),
        "depth as text": (lambda: none(put(d=None), np.savetxt(folder / "depth_0.txt", np.tile(depth[0], (2, 1)))), "got depth_0.txt", "np.loadtxt"),
        "depth pickled": (lambda: none(put(d=None), (folder / "depth_0.pkl").write_bytes(b"")), "got depth_0.pkl", "np.save"),
        "a packed bag": (lambda: none((folder / "mug.db3.zstd").write_bytes(b"")), "found mug.db3.zstd", "zstd -d"),
        "a bag that was being recorded": (lambda: none((folder / "mug.bag.active").write_bytes(b"")), "mug.bag.active", "reindex"),
        "words of another suffix": (lambda: none(put(), (folder / "raw_3.dat").write_bytes(b"")), "got raw_3.dat", "--shape"),
        "disparities": (lambda: none(put(d=None), np.save(folder / "disparity_0.npy", 40 / depth[0])), "got disparities", "baseline"),
        "names of nobody": (lambda: np.savez(folder / "mug.npz", x=raw, y=depth), "names that say which", '[truth] files = "*:y"'),
        "channels that are words": (
            lambda: none(put(raw[:0]), *(np.save(folder / f"{w}_{i}.npy", raw[i, s]) for i in range(3) for w, s in (("hf", slice(4)), ("lf", slice(4, 8))))),
            "only one of them for hf, lf", "020MHz"
        ),
        "a TIFF that OpenCV does not read": (lambda: none(put(d=None), (folder / "depth_0.tif").write_bytes(b"II*\0")), "depth_0.tif", "np.save"),
        "phases begun half a turn later": (lambda: put(3000 - raw), "agrees with the ToF image", "phase_deg = [180.0, 270.0, 0.0, 90.0, 180.0"),
        "hertz": (lambda: put(tof={**TOF, "modulation_mhz": [20e6] * 8, "phase_deg": [0, 90, 180, 270] * 2}), "expected megahertz", "write 20"),
        "phases in radians": (lambda: put(tof={**TOF, "modulation_mhz": [20] * 8, "phase_deg": list(THETA)}), "expected degrees", "90.0, 180.0"),
        "a camera that is no camera": (lambda: put(truth={"camera": [45, 46, 19, 15]}), "expected a table", "FILE#NAME"),
        "a pattern of other names": (lambda: put(raw_={"files": "tof_*.npy"}), "files = 'tof_*.npy'", "raw_*.npy"),
        "a transposed transform": (lambda: put(truth={"T_tof_truth": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.1, 0, 0, 1]]}), "last row", "transposed"),
        "poses that are not there": (lambda: put(poses={"file": "gt.txt"}), "no such file of poses", "SOURCE"),
        "a kind of nobody": (lambda: put(truth={"kind": "disparity"}), "kind", ""),
        "poses too few": (lambda: _poses(folder, put, "0 0 0 0 0 0 1\n"), "a pose for each of 3 views, got 1", "one line"),
        "quaternion that is none": (lambda: _poses(folder, put, "0 0 0 1 2 3 4\n" * 3), "pose 1: expected a unit quaternion", "order"),
        "poses that are words": (lambda: _poses(folder, put, "0 0 0 a b c d\n" * 3), "line 1", ""),
    }  # fmt: skip


def _png(path, image):
    pytest.importorskip("cv2").imwrite(str(path), image)


def _poses(folder, put, text):
    put()
    (folder / "poses.txt").write_text(text)
    return {"poses": {"file": "poses.txt"}}


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _rays(*, points=False):
    """Lengths (H, W) of the pixels' rays, or the rays."""
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    rays = np.stack([(u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"], 1.0 + 0 * u], axis=-1)
    return rays if points else np.linalg.norm(rays, axis=-1)


NAMES = list(wrong(None))


def test_frames_that_are_copies_are_told(tmp_path):
    """A driver that stood still gives the same frame again: it is imported, and named."""
    raw, depth = scenes()
    np.save(tmp_path / "raw.npy", raw[[0, 1, 0]][:, None])
    np.save(tmp_path / "depth.npy", depth[[0, 1, 0]])
    found = import_data([tmp_path], tmp_path / "rec", Said(tof=TOF))
    assert [w.split(": ")[1] for w in found.warnings] == ["view 2, frame 0 is view 0, frame 0, bit for bit"]


def test_one_frequency_does_not_tell_which_way_its_phases_run(tmp_path):
    """Ground truth tells; without it the doubt is told."""
    raw, depth = scenes(1)
    np.save(tmp_path / "raw_0.npy", raw[0, :4])
    turned = {**TOF, "modulation_mhz": [20] * 4, "phase_deg": [0, 270, 180, 90]}
    found = import_data([tmp_path], tmp_path / "alone", Said(tof=turned))
    assert any("which way its phases run" in w for w in found.warnings)
    np.save(tmp_path / "depth_0.npy", depth[0])
    with pytest.raises(TofError, match="mm off") as info:
        import_data([tmp_path], tmp_path / "rec", Said(tof=turned))
    assert "phase_deg = [0.0, 90.0, 180.0, 270.0]" in info.value.hint
    right = {**turned, "phase_deg": [0, 90, 180, 270]}
    assert import_data([tmp_path], tmp_path / "rec", Said(tof=right)).warnings == []


FIELD = {  # as tools of the field name and keep their files
    "stamps of a camera's recorder": lambda i: (f"Phase{{k}}_{1700000000123.456 + 33.3 * i:.12f}.png", f"Depth_{1700000000123.456 + 33.3 * i:.12f}.png"),
    "a stamp for each image": lambda i: (f"Phase{{k}}_{{{1700000000123 + 1000 * i} + 3 * k}}.png", f"Depth_{1700000000123 + 1000 * i}.png"),
    "a running number": lambda i: (f"frame_{{{8 * i} + k:06d}}.png", f"depth_{8 * i:06d}.png"),
    "a running number, depths by frame": lambda i: (f"frame_{{{8 * i} + k:06d}}.png", f"depth_{i}.png"),
    "frequency and phase": lambda i: (f"img{i:03d}_{{20 + 80 * (k // 4)}}MHz_{{90 * (k % 4)}}deg.png", f"img{i:03d}_depth.png"),
    "one tall image": lambda i: (f"raw_{i:04d}.png", f"depth_{i:04d}.png"),
}  # fmt: skip


@pytest.mark.parametrize("name", FIELD)
def test_names_of_the_field_are_understood(tmp_path, name):
    """Views, channels and their depths come together as they were taken."""
    raw, depth = scenes()
    folder = tmp_path / "mug"
    folder.mkdir()
    for i in range(3):
        taps, z = FIELD[name](i)
        for k in range(8):
            image = raw[i].reshape(-1, SHAPE[1]) if "tall" in name else raw[i, k]
            _png(folder / eval(f"f{taps!r}", {"k": k}), image)  # noqa: S307
        _png(folder / z, np.rint(1000 * depth[i]).astype(np.uint16))
    size = {"width": SHAPE[1], "height": SHAPE[0]}
    views = imported(folder, tmp_path / "rec", tof={**TOF, **size}, truth={"unit": "mm"})
    assert len(views) == 3
    for i, view in enumerate(views):
        np.testing.assert_array_equal(view.tof.raw[0], raw[i])
        np.testing.assert_allclose(view.stereo.points[..., 2], depth[i], atol=6e-4)


@pytest.mark.parametrize("unit", [1, 1000, 10**9])
def test_a_trajectory_of_stamps_places_views_by_the_stamps_of_their_names(tmp_path, unit):
    """TUM at 50 Hz in seconds, milliseconds or nanoseconds, interpolated; a header may change the columns' order."""
    raw, depth = scenes()
    for i in range(3):
        np.save(tmp_path / f"raw_{1700000000 + i}.505000.npy", raw[i])
        np.save(tmp_path / f"depth_{i}.npy", depth[i])
    lines = [f"{unit * (1700000000 * 50 + i) // 50},1,0,0,0,{0.02 * i},0,0\n" for i in range(200)]
    (tmp_path / "poses.csv").write_text(
        "t,qw,qx,qy,qz,x,y,z\n" + "".join(lines)
        if unit > 1
        else "stamp px py pz qx qy qz qw\n"
        + "".join(f"{1700000000 + 0.02 * i:.2f} {0.02 * i} 0 0 0 0 0 1\n" for i in range(200))
    )
    views = imported(tmp_path, tmp_path / "rec", poses={"file": "poses.csv"})
    np.testing.assert_allclose(
        [v.arm_before.T_base_flange[0, 3] for v in views], [0.505, 1.505, 2.505], atol=1e-6
    )


def _trajectories(T, q):
    """Files of two poses (2, 4, 4) with quaternions x y z w, as tools write them."""
    p, w, rows, back = T[:, :3, 3], np.roll(q, 1, axis=1), T.reshape(2, 16), np.linalg.inv(T)
    turned, gl = np.roll(q * [-1, -1, -1, 1], 1, axis=1), T @ np.diag([1.0, -1, -1, 1])

    def lines(*columns, head="", sep=","):
        return head + "".join(sep.join(map(str, r)) + "\n" for r in np.column_stack(columns).tolist())

    def blocks(n, head=""):
        return "\n".join(head + "\n".join(" ".join(map(str, r)) for r in one[:n].tolist()) for one in T)

    euroc = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]\n"
    ros = (
        "%time,"
        + ",".join(
            f"field.pose.{n}"
            for n in ("position.x", "position.y", "position.z", *(f"orientation.{c}" for c in "xyzw"))
        )
        + "\n"
    )
    return {
        "tum.txt": lines([1, 2], p, q, head="# timestamp tx ty tz qx qy qz qw\n", sep=" "),
        "kitti.txt": lines(rows[:, :12], sep=" "),
        "euroc.csv": lines([1, 2], p, w, [9, 9], head=euroc),
        "ros.csv": lines([1, 2], p, q, head=ros),
        "units.csv": lines([1, 2], 1000 * p, q, head="time [s],x [mm],y [mm],z [mm],qx,qy,qz,qw\n"),
        "index.csv": lines([7, 8], [1, 2], p, q, head=",timestamp,x,y,z,qx,qy,qz,qw\n"),
        "german.csv": lines([1, 2], p, q, head="t;x;y;z;qx;qy;qz;qw\n", sep=";").replace(".", ","),
        "named.csv": "file,x,y,z,qx,qy,qz,qw\n" + "".join(f"a{i}.png,{lines(p[i : i + 1], q[i : i + 1])}" for i in (0, 1)),
        "blocks.txt": blocks(4), "blocks-3.txt": blocks(3), "redwood.log": blocks(4, "0 0 1\n"),
        "images.txt": "".join(f"{i} {lines(turned[i : i + 1], back[i : i + 1, :3, 3], sep=' ').strip()} 1 a{i}.png\n1 2 -1\n" for i in (1, 0)),
        "list.json": json.dumps(T.tolist()), "names.json": json.dumps({f"{i}": {"T": one.tolist()} for i, one in enumerate(T)}),
        "nerf.json": json.dumps({"frames": [{"file_path": f"{i}.png", "transform_matrix": gl[i].tolist()} for i in (1, 0)]}),
        "a.npy": T, "b.npy": T[:, :3], "c.npy": np.column_stack([p, q]), "d.npz": {"K": np.eye(3), "poses": T}, "e.mat": {"T": np.moveaxis(T, 0, -1)},
    }  # fmt: skip


def test_poses_of_every_tool_are_the_same(tmp_path):
    """Order of columns, units and names come from headers; COLMAP's are inverted, nerfstudio's turned; a folder has a file each."""
    T = np.stack([exp([0.3, -0.2, 0.1, 0.4, 0.1, -0.7]), exp([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])])
    q = np.stack(
        [
            pytest.importorskip("scipy.spatial").transform.Rotation.from_matrix(R).as_quat()
            for R in T[:, :3, :3]
        ]
    )
    forms = {"utf-16.txt": _trajectories(T, q)["tum.txt"], **_trajectories(T, q)}
    for name, held in forms.items():
        path = tmp_path / name
        if isinstance(held, str):
            path.write_text(held, encoding="utf-16" if name.startswith("utf") else "utf-8")
        elif name.endswith(".mat"):
            _matlab(path, held)
        else:
            np.savez(path, **held) if isinstance(held, dict) else np.save(path, held)
        np.testing.assert_allclose(read_poses(path, Said())[1], T, atol=1e-9, err_msg=name)
    (tmp_path / "sparse").mkdir()
    back, turned = np.linalg.inv(T), np.roll(q * [-1, -1, -1, 1], 1, axis=1)
    rows = [
        struct.pack("<I7dI", i, *turned[i], *back[i, :3, 3], 1)
        + f"a{i}.png".encode()
        + b"\0"
        + struct.pack("<Q2dq", 1, 0, 0, -1)
        for i in (1, 0)
    ]
    (tmp_path / "sparse/images.bin").write_bytes(struct.pack("<Q", 2) + b"".join(rows))
    (tmp_path / "sparse/cameras.bin").write_bytes(b"")
    np.testing.assert_allclose(read_poses(tmp_path / "sparse", Said())[1], T, atol=1e-9)
    (tmp_path / "each").mkdir()
    for i in (0, 1):
        np.savetxt(tmp_path / f"each/{i}.txt", T[i])
    np.testing.assert_allclose(read_poses(tmp_path / "each", Said())[1], T, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_wrong_is_named_with_the_remedy(name, tmp_path):
    """The message says what was expected, the hint what to do; no scene appears, and check does not call the rest whole."""
    folder = tmp_path / "mug"
    folder.mkdir()
    spoil, says, remedy = wrong(folder)[name]
    said = spoil() or {}
    if "raw_" in said:
        said["raw"] = said.pop("raw_")
    with pytest.raises(TofError) as caught:
        imported(folder, tmp_path / "rec", **said)
    assert says in caught.value.message, caught.value.message
    assert remedy in f"{caught.value.hint} {caught.value.message}", caught.value.hint
    assert not list((tmp_path / "rec").glob("views/**/*.h5"))
    assert check(tmp_path / "rec") != []
