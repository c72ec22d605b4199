"""Phase order of raw frames: every permutation, both signs and all starts are found or refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from calibration.phase_order.find import PhaseOrderRefused, find_phase_order
from tests import answers
from tests.commands import calibrate
from tofcapture.camera import Camera
from tofcapture.errors import DataError, FormatError, UsageError
from tofcapture.ops.phase import mean_phasors, taps
from tofcapture.rig import SPEED_OF_LIGHT

SHAPE = (60, 80)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=6)


def scene(rng):
    """Distances of a tilted wall with a box before it, and patches of albedo."""
    camera = Camera(SHAPE[1], SHAPE[0], 70, 70, 39.5, 29.5)
    normal = np.array([0.5, 0.2, 1]) / np.linalg.norm([0.5, 0.2, 1])
    z = 0.9 / (camera.rays @ normal)
    z[20:40, 30:50] = 0.5
    albedo = rng.uniform(0.4, 0.8, (6, 8)).repeat(10, 0).repeat(10, 1)
    return camera.depth_to_radial(z), albedo


def made(seed, hz_of, *, bipolar=False, noise=2.0, offset=0.1, phases=None):
    """Raw frames of channels in random order, sign and start, with what they truly are."""
    rng = np.random.default_rng(seed)
    radial, albedo = scene(rng)
    amplitude = 300 * albedo / radial**2
    sign, hz, theta = rng.choice([-1, 1]), [], []
    for f, n in zip(hz_of, phases or [4] * len(hz_of), strict=True):
        around = max(n, 4 if n == 2 else n)  # I and Q are a quarter of the turn apart
        hz += [f] * n
        theta += list(np.mod(sign * np.arange(n) + rng.integers(around), around) * 2 * np.pi / around)
    order = rng.permutation(len(hz))
    hz, theta = np.array(hz)[order], np.array(theta)[order]
    phasor = np.stack(
        [amplitude * np.exp(1j * (4 * np.pi * f * radial / SPEED_OF_LIGHT + offset)) for f in sorted(hz_of)]
    )
    mean = (
        np.zeros(phasor.shape)
        if bipolar or (phases and min(phases) == 2)
        else np.stack([amplitude / 0.7 + 20] * len(hz_of))
    )
    clean = taps(phasor, mean, hz, theta)
    return clean + rng.normal(0, noise, (3, *clean.shape)), radial, hz, theta


def same(order, hz, theta):
    """Whether this is the order; where the start is only assumed, up to one turn for all taps of a frequency."""
    turned = np.exp(1j * (np.array(order.phase_rad) - theta))
    if not order.start_known:
        firsts = {f: turned[list(hz).index(f)] for f in hz}
        turned = turned / np.array([firsts[f] for f in hz])
    return order.modulation_hz == tuple(hz) and np.abs(np.angle(turned)).max() < 1e-9


CAMERAS = [
    ((30e6,), (4,)),
    ((20e6, 100e6), (4, 4)),
    ((60e6,), (3,)),
    ((75e6,), (4,)),
    ((12e6,), (5,)),
    ((24e6,), (6,)),
    ((40e6, 70e6), (2, 2)),
    ((80.32e6, 60.24e6), (4, 4)),
    ((80e6, 16e6), (3, 3)),
    ((80e6, 16e6), (3, 4)),
    ((80e6, 16e6, 120e6), (3, 3, 3)),
]


@pytest.mark.parametrize(("hz_of", "phases"), CAMERAS)
@given(seed=seeds, bipolar=st.booleans(), reference=st.booleans())
@example(seed=4954, bipolar=False, reference=False)
@few
def test_order_is_found(hz_of, phases, seed, bipolar, reference):
    """Any order, sign and start of unipolar or bipolar taps is found, with a reference depth; without one never the start."""
    raw, radial, hz, theta = made(seed, hz_of, bipolar=bipolar, phases=phases)
    try:
        order = find_phase_order(raw, hz_of, radial if reference else None, phases)
    except PhaseOrderRefused:
        assert not (len(hz_of) == 1 and reference)
        assert min(phases) < 4  # the offsets of bipolar taps tell less
        return
    assert same(order, hz, theta)
    assert 0 < order.confidence <= 1
    assert order.harmonics < 0.03
    assert order.start_known == reference
    if reference:
        np.testing.assert_allclose(order.offset_rad, 0.1, atol=0.02)
    else:
        firsts = [order.phase_rad[order.modulation_hz.index(f)] for f in hz_of]
        assert firsts == [0.0] * len(firsts)


@pytest.mark.parametrize("phases", [(3, 3, 3), (4, 4, 4)])
def test_near_frequencies_are_taken_as_they_were_given(phases):
    """Over a metre 192 and 197 MHz look alike from noisy phases at 54: the blocks stand as given, and that is said."""
    hz_of = (197e6, 192e6, 54e6)
    raw, radial, hz, theta = made(3, hz_of, phases=phases)
    order = [k for f in hz_of for k in range(len(hz)) if hz[k] == f]
    found = find_phase_order(raw[:, order], hz_of, radial)
    assert same(found, hz[order], theta[order])
    assert found.blocks_from in {"data", "order given"}


def test_decoding_by_the_found_order_gives_the_range():
    """Phases decoded by what was found, and the phase that the reference leaves over, are the distance."""
    raw, radial, *_ = made(1, (20e6, 100e6), offset=0.4)
    order = find_phase_order(raw, (20e6, 100e6), radial)
    z = mean_phasors(raw, order.modulation_hz, order.phase_rad)[0] * np.exp(-1j * order.offset_rad[0])
    np.testing.assert_allclose(np.angle(z) * SPEED_OF_LIGHT / (4 * np.pi * 20e6), radial, atol=0.05)


def test_brightness_is_not_asked_where_a_reference_is():
    """Light that grows with distance fools brightness, not a reference depth."""
    raw, radial, hz, theta = made(2, (20e6,))
    raw = raw * radial**4
    assert same(find_phase_order(raw, (20e6,), radial), hz, theta)
    assert not same(find_phase_order(raw, (20e6,)), hz, theta)


def flat(seed):
    raw, *_ = made(seed, (20e6, 100e6))
    return np.repeat(np.repeat(raw[..., 30:31, 40:41], 60, axis=-2), 80, axis=-1) + np.random.default_rng(
        0
    ).normal(0, 1, (3, 8, *SHAPE))


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (np.random.default_rng(0).normal(500, 20, (3, 4, *SHAPE)), "structure of 4|ambiguous"),
        (np.full((3, 4, *SHAPE), 100.0), "modulated pixels"),
        (np.full((3, 4, *SHAPE), np.nan), "modulated pixels"),
    ],
)
def test_frames_without_phases_are_refused(raw, says):
    """Noise, constant frames and NaN are refused by name."""
    with pytest.raises(PhaseOrderRefused, match=says):
        find_phase_order(raw, (20e6,))


def test_one_distance_is_ambiguous():
    """A scene of a single distance cannot tell low from high frequency, nor sign: refused."""
    with pytest.raises(PhaseOrderRefused, match="ambiguous"):
        find_phase_order(flat(0), (20e6, 100e6))


def test_foreign_reference_is_refused():
    """A reference depth that has nothing to do with the scene does not settle the sign."""
    raw, radial, *_ = made(4, (20e6, 100e6))
    with pytest.raises(PhaseOrderRefused, match="sign"):
        find_phase_order(
            raw, (20e6, 100e6), 10 * np.random.default_rng(0).permutation(radial.ravel()).reshape(SHAPE)
        )
    with pytest.raises(DataError, match="shape"):
        find_phase_order(raw, (20e6, 100e6), radial[:-1])


@pytest.mark.parametrize("shape", [(3, 5, 6, 7), (8, 8), (3, 11, 6, 7)])
def test_wrong_shapes_are_data_errors(shape):
    """Channel counts that the frequencies cannot share are named."""
    with pytest.raises(DataError, match="raw"):
        find_phase_order(np.zeros(shape), (20e6, 100e6) if shape[1] != 11 else (1e6, 2e6, 3e6))


def test_command_finds_and_writes(tmp_path):
    """calibrate phase-order reads .npy, prints one line per channel and writes JSON; damaged files and words are named."""
    raw, radial, hz, theta = made(5, (20e6, 100e6))
    np.save(tmp_path / "raw.npy", raw)
    np.save(tmp_path / "radial.npy", radial)
    reference, out = ("--reference", tmp_path / "radial.npy"), tmp_path / "order.json"
    outcome = calibrate("phase-order", tmp_path / "raw.npy", *reference, "--out", out)
    written = json.loads(out.read_text())
    assert written["modulation_hz"] == hz.tolist()
    np.testing.assert_allclose(written["phase_rad"], theta)
    for k, line in enumerate(outcome.text.splitlines()[1:9]):
        assert [float(x) for x in line.split()] == [k, hz[k] / 1e6, round(np.degrees(theta[k]))]
    answers.hold("phase-order", {"data": written, "text": outcome.text}, names=[(tmp_path, "FOLDER")])
    three, far, *_ = made(6, (60e6,), phases=(3,))
    np.savez(tmp_path / "three.npz", **{f"phase{k}": three[:, k] for k in range(3)})
    np.save(tmp_path / "far.npy", far)
    found = calibrate(
        "phase-order", tmp_path / "three.npz", "--mhz", "60", "--reference", tmp_path / "far.npy"
    )
    assert sorted(np.degrees(found.data["phase_rad"]).round()) == [0, 120, 240]
    alone = calibrate("phase-order", tmp_path / "raw.npy")
    assert "not known" in alone.text
    assert alone.data["offset_rad"] == [None, None]
    (tmp_path / "bad.npy").write_text("no array")
    for words, kind, says in (
        (("bad.npy",), FormatError, "npy"),
        (("none.npy",), DataError, "no such file"),
        (("raw.npy", "--reference", tmp_path / "none.npy"), DataError, "no such file"),
        (("raw.npy", "--reference", tmp_path / "bad.npy"), FormatError, "npy"),
        (("raw.npy", "--mhz", "fast"), UsageError, "--mhz"),
        (("raw.npy", "--phases", "few"), UsageError, "--phases"),
        (("raw.npy", "--phases", "3"), DataError, "K of 6"),
        (("raw.npy", "--shape", "180"), UsageError, "--shape"),
    ):
        with pytest.raises(kind, match=says):
            calibrate("phase-order", tmp_path / words[0], *words[1:])
