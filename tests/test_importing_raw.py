"""Raw frames of other makes: file forms, byte orders, imperfections of real sensors; the order is found or refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.phase_order.find import find_phase_order
from tests.test_calibration_phase_order import SHAPE, made, same
from tofcapture.errors import DataError, FormatError
from tofcapture.importing.raw import read_raw
from tofcapture.importing.rules import signed, without_metadata

HZ = (20e6, 100e6)


def frames(seed=11, hz_of=HZ, **more):
    """uint16 frames, and what their channels are."""
    raw, _, hz, theta = made(seed, hz_of, **more)
    return np.rint(raw + 200).astype(np.uint16), hz, theta


def spoilt(raw, seed=0):
    """Vignetting, dark and hot pixels, a pedestal that differs by column, gain by channel pair, and a row of metadata at both ends."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    out = raw.astype(float) * (1 - 0.6 * (u**2 + v**2) / 2) + rng.normal(0, 8, SHAPE[1])
    out[..., rng.random(SHAPE) < 0.02] = 3
    out[..., rng.random(SHAPE) < 0.005] = 4095
    out = np.clip(np.rint(out), 0, 4095).astype(np.uint16)
    extra = rng.integers(0, 4095, (*out.shape[:-2], 1, SHAPE[1]), dtype=np.uint16)
    return np.concatenate([extra, out, extra[..., ::-1]], axis=-2)


@pytest.mark.parametrize("seed", range(4))
def test_real_imperfections_do_not_hide_the_order(tmp_path, seed):
    """Vignetted frames with dead pixels, fixed pattern and metadata rows are read and their order is found."""
    raw, hz, theta = frames(seed)
    np.save(tmp_path / "raw.npy", spoilt(raw, seed))
    back = read_raw(tmp_path / "raw.npy", [8])
    assert back.shape[-2] == SHAPE[0]
    assert same(find_phase_order(back, HZ), hz, theta)


def test_every_form_is_the_same_frames(tmp_path):
    """NPY of either byte order, NPZ, HDF5, channels last, alternating frequencies, a folder of images and raw words agree."""
    h5py = pytest.importorskip("h5py")
    cv2 = pytest.importorskip("cv2")
    raw, *_ = frames()
    np.save(tmp_path / "big.npy", raw.astype(">u2"))
    np.save(tmp_path / "last.npy", np.moveaxis(raw, 1, -1))
    np.save(tmp_path / "turns.npy", raw.reshape(-1, 4, *SHAPE))
    np.savez(tmp_path / "some.npz", raw=raw, times=np.arange(3))
    with h5py.File(tmp_path / "some.h5", "w") as file:
        file["camera/raw"] = raw
        file["camera/other"] = np.zeros((5, 5, 5))
    folder = tmp_path / "images"
    folder.mkdir()
    for i, image in enumerate(raw.reshape(-1, *SHAPE)):
        cv2.imwrite(str(folder / f"frame{i}.png"), image)
    (tmp_path / "words.raw").write_bytes(raw.astype(">u2").tobytes())
    for name in ("big.npy", "last.npy", "turns.npy", "some.npz", "some.h5", "images", "words.raw"):
        found = read_raw(tmp_path / name, [8], SHAPE)
        assert found.dtype.isnative
        np.testing.assert_array_equal(found, raw, err_msg=name)


def test_signs_in_twelve_bits_come_back(tmp_path):
    """Differences of taps stored as 12-bit two's complement in uint16 are given back their sign, and their order is found."""
    raw, _, hz, theta = made(5, (30e6,), bipolar=True)
    stored = (np.rint(raw).astype(np.int64) & 0xFFF).astype(np.uint16)
    np.testing.assert_array_equal(signed(stored), np.rint(raw))
    np.save(tmp_path / "raw.npy", stored)
    assert same(find_phase_order(read_raw(tmp_path / "raw.npy", [4]), (30e6,)), hz, theta)


def test_an_image_without_metadata_is_whole():
    """Nothing is cut from frames whose first and last rows are image."""
    raw, *_ = frames()
    assert without_metadata(raw).shape == raw.shape


def broken(tmp_path):
    """Files that hold no raw frames: what is written, the error, and what it says."""
    raw, *_ = frames()
    grey = raw[0, 0].astype(np.uint8)
    cv2 = pytest.importorskip("cv2")
    h5py = pytest.importorskip("h5py")

    def folder(name, *images):
        (tmp_path / name).mkdir()
        for i, image in enumerate(images):
            cv2.imwrite(str(tmp_path / name / f"{i}.png"), image)
        return name

    np.save(tmp_path / "seven.npy", raw[0, :7])
    np.save(tmp_path / "words.npy", np.full((8, 4, 4), "a"))
    np.save(tmp_path / "pickled.npy", np.array([{}]), allow_pickle=True)
    np.savez(tmp_path / "two.npz", a=raw, b=raw)
    with h5py.File(tmp_path / "flat.h5", "w") as file:
        file["raw"] = np.zeros((5, 5))
    (tmp_path / "cut.h5").write_bytes((tmp_path / "flat.h5").read_bytes()[:100])
    (tmp_path / "words.raw").write_bytes(b"\0" * 1000)
    (tmp_path / "page.pdf").write_bytes(b"%PDF")
    dead = folder("dead")
    (tmp_path / dead / "0.png").write_bytes(b"no image")
    colours = np.stack([grey, grey, 255 - grey], axis=-1)
    return {
        "none.npy": (DataError, "no such file"),
        "seven.npy": (DataError, "K of 8"),
        "words.npy": (DataError, "numbers"),
        "pickled.npy": (FormatError, "npy"),
        "two.npz": (FormatError, "one array"),
        "flat.h5": (FormatError, "one a channel"),
        "cut.h5": (FormatError, "HDF5"),
        "words.raw": (FormatError, "size"),
        "page.pdf": (DataError, r"page\.pdf"),
        folder("empty"): (DataError, "images"),
        dead: (FormatError, "an image"),
        folder("colour", *[colours] * 8): (FormatError, "colours"),
        folder("sizes", *[grey] * 7, grey[:-1]): (FormatError, "one size"),
    }


def test_what_is_no_raw_has_a_name(tmp_path):
    """Missing and damaged files, words, other counts of images, two arrays, colours and files without a size each say so."""
    for name, (kind, says) in broken(tmp_path).items():
        with pytest.raises(kind, match=says) as caught:
            read_raw(tmp_path / name, [8])
        assert name in str(caught.value)
    with pytest.raises(FormatError, match="multiple"):
        read_raw(tmp_path / "words.raw", [8], SHAPE)
