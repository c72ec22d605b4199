"""Decoding on the network's device gives the frame that the processor's decoder gives."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tests.test_model_predict import table_top
from tofcapture.camera import Camera
from tofcapture.errors import DataError
from tofcapture.frames import TofInfo
from tofcapture.ops.phase import taps as taps_of
from tofcapture.rig import SPEED_OF_LIGHT, RangeError
from tofcapture_model.data import batched, make_frame
from tofcapture_model.data.raw_input import NOMINAL_RANGE_ERRORS
from tofcapture_model.geometry import decoder as torch_decoder
from tofcapture_model.geometry.decoder import TorchDecoder, fill_nearest

CAMERA = Camera(60, 45, 48.0, 49.0, 28.6, 23.1)
LENS = replace(CAMERA, distortion=(-0.2, 0.05, 0.001, -0.002, 0.0))
THREE = ((15e6,) * 3 + (75e6,) * 3, tuple(2 * np.pi * k / 3 for k in range(3)) * 2)
HERE = torch.device("cpu")
INFOS = {
    "ideal": TofInfo("ideal", "", CAMERA, np.zeros(3)),
    "nominal": TofInfo(
        "nominal", "", CAMERA, np.array([0.007, 0.0, 0.0]), range_errors=NOMINAL_RANGE_ERRORS
    ),
    "lens": TofInfo("lens", "", LENS, np.array([-0.01, 0.004, 0.002])),
    "three phases": TofInfo(
        "three",
        "",
        CAMERA,
        np.array([0.02, 0.0, 0.0]),
        *THREE,
        range_errors=(
            RangeError(15e6, 0.02, harmonics=((3, 0.012, -0.008),), per_kelvin=1e-3),
            RangeError(
                75e6, 0.3, scale=0.01, harmonics=((3, -0.005, 0.002),), image=((2, 0, 0.004), (1, 1, 0.002)),
                per_inverse_amplitude=0.3, per_kelvin=-4e-4,
            ),
        ),
    ),
    "one frequency": TofInfo("one", "", CAMERA, np.zeros(3), (75e6,) * 4, tuple(np.pi / 2 * k for k in range(4)), reach=(0.4, 2.3)),
    "no whole ratio": TofInfo(
        "three frequencies", "", CAMERA, np.zeros(3), (198e6,) * 3 + (189e6,) * 3 + (54e6,) * 4,
        tuple(2 * np.pi * k / 3 for k in range(3)) * 2 + (0.0, 1.0, 2.6, 4.4),
    ),
}  # fmt: skip


def frame_of(info, seed=0):
    """Counts of a table with a block, saturated, dark and far pixels among them."""
    rng = np.random.default_rng(seed)
    _, depth = table_top(info.camera, seed)
    depth = np.where(np.hypot(*np.mgrid[-12:33, -40:20]) < 6, 6.2, depth)  # beyond what counts as measured
    ranges = depth * info.camera.ray_lengths
    hz = np.array(sorted(set(info.modulation_hz)))[:, None, None]
    z = rng.uniform(150, 500, depth.shape) * np.exp(4j * np.pi * hz * ranges / SPEED_OF_LIGHT)
    raw = rng.normal(taps_of(z, np.full(z.shape, 700.0), info.modulation_hz, info.phase_rad), 3)
    raw = np.clip(np.rint(raw), 0, 4095)
    raw[:, rng.random(depth.shape) < 0.05] = 4095
    raw[0, rng.random(depth.shape) < 0.03] = 4095
    if len(raw) > 4:
        raw[2, rng.random(depth.shape) < 0.03] = 90  # stuck
    raw[1, :, 7] = 1500
    if (
        len(raw) == 8
    ):  # no modulated light at all; with thirds as weights it would be whatever rounding leaves
        raw[:, 30:36, 40:52] = 300
    return raw.astype(np.uint16)


@pytest.mark.parametrize("name", INFOS)
@pytest.mark.parametrize("celsius", [float("nan"), float("inf"), 31.5])
def test_it_decodes_as_the_processor_does(name, celsius):
    """Range errors of every kind, lamp, lens, temperature, saturation, darkness: every field of the frame but for rounding."""
    info, raw = INFOS[name], frame_of(INFOS[name])
    expected = batched(make_frame(raw, info, info.camera, celsius))
    decoder = TorchDecoder(info, info.camera, HERE)
    found = decoder(decoder.taps(raw, celsius))
    assert torch.equal(found.valid, expected.valid)
    assert 0.5 < found.valid.mean() < 0.95
    seen = expected.valid > 0
    assert (found.depth - expected.depth)[seen].abs().max() < 1e-5
    assert (found.gap - expected.gap).abs().max() < 5e-5  # float32 of ranges up to 10 m
    for field in ("raw", "phasor", "confidence"):
        torch.testing.assert_close(getattr(found, field), getattr(expected, field), atol=2e-7, rtol=1e-5)
    for field in ("modulation", "intrinsics", "demodulation"):
        assert torch.equal(getattr(found, field), getattr(expected, field))


def test_a_stuck_tap_measures_nothing():
    """Where four taps fit no cosine there is no depth, in single pixels and in a column that always says the same."""
    info, raw = INFOS["ideal"], frame_of(INFOS["ideal"], 1)
    stuck = raw[2] == 90
    frame = make_frame(raw, info, info.camera)
    assert frame.valid[0][stuck].mean() < 0.05
    assert not frame.valid[0, :, 7].any()


def test_a_mean_and_integers_are_taken_alike():
    """Floats of a mean are decoded as the counts that they are the mean of."""
    info, raw = INFOS["nominal"], frame_of(INFOS["nominal"])
    decoder = TorchDecoder(info, info.camera, HERE)
    counts, mean = (decoder(decoder.taps(r, 40.0)) for r in (raw, raw.astype(np.float64)))
    assert torch.equal(counts.depth, mean.depth)


def test_what_is_nearer_than_the_lamp_allows_is_no_depth():
    """A light 30 cm beside the lens: no range below 15 cm is one, though the formula gives a depth for it."""
    info = replace(INFOS["ideal"], illuminator=np.array([0.3, 0.0, 0.0]))
    hz, ranges = np.array([20e6, 100e6])[:, None, None], np.full(CAMERA.shape, 0.12)
    ranges[:, 30:] = 0.6
    z = 300 * np.exp(4j * np.pi * hz * ranges / SPEED_OF_LIGHT)
    raw = np.rint(taps_of(z, np.full(z.shape, 700.0), info.modulation_hz, info.phase_rad))
    expected = batched(make_frame(raw, info, CAMERA))
    decoder = TorchDecoder(info, CAMERA, HERE)
    found = decoder(decoder.taps(raw, 40.0))
    assert torch.equal(found.valid, expected.valid)
    assert found.valid[..., 30:].all()
    assert not found.valid[..., :30].any()


class Largest(TorchDispatchMode):
    """Elements of the largest tensor that any operation makes."""

    most = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        found = function(*args, **(kwargs or {}))
        self.most = max([self.most, *(x.numel() for x in tree_leaves(found) if isinstance(x, torch.Tensor))])
        return found


def test_some_rows_at_a_time_are_filled_alike(monkeypatch):
    """Large images: the table of distances is made in parts, no larger than is held at once."""
    rng = np.random.default_rng(2)
    image, valid = torch.tensor(rng.random((31, 40))), torch.tensor(rng.random((31, 40)) < 0.02)
    whole = fill_nearest(image, valid)
    monkeypatch.setattr(torch_decoder, "_HELD", 40 * 40 * 4)
    with Largest() as seen:
        assert torch.equal(fill_nearest(image, valid), whole)
    assert seen.most == 40 * 40 * 4


def test_what_cannot_be_decoded_is_refused():
    """As by the processor's decoder: another shape."""
    info = INFOS["ideal"]
    with pytest.raises(DataError, match=r"expected raw of shape \(8, 45, 60\), got \(8, 45, 61\)"):
        TorchDecoder(info, info.camera, HERE).taps(np.zeros((8, 45, 61)), 40.0)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 23), st.integers(1, 31), st.floats(0.001, 1))
def test_holes_get_the_value_of_a_nearest_pixel(seed, height, width, share):
    """As far away as scipy's exact distance says; of several equally near any one will do."""
    rng = np.random.default_rng(seed)
    valid = rng.random((height, width)) < share
    image = np.arange(height * width, dtype=np.float32).reshape(height, width)  # every pixel's own number
    found = fill_nearest(torch.from_numpy(image), torch.from_numpy(valid)).numpy()
    if not valid.any():
        assert (found == 1).all()
        return
    whose = found.astype(int)
    assert valid.flatten()[whose].all()
    v, u = np.mgrid[:height, :width]
    apart = np.hypot(v - whose // width, u - whose % width)
    np.testing.assert_allclose(apart, distance_transform_edt(~valid), atol=1e-6)
