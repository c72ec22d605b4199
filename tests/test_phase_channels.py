"""Any camera: one to four frequencies in any ratio, two phases and more at any angles, signed or not, what is refused, and real points."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.camera import Camera
from tofcapture.channels import ambiguity, channels_in_words, frequencies, mismatch, unambiguous, wrap_table
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.light import Light
from tofcapture.devices.sim.sensor import expose, ideal
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.hdf import tof_from, tof_table
from tofcapture.frames import TofFlag, TofInfo
from tofcapture.ops.phase import Decoder, TapNoise, float32, information, radial_to_range, reference, taps
from tofcapture.rig import RangeError, Rig, dumps_rig, image_places, loads_rig, packed_table, radius_px

CAMERA = Camera(40, 30, 33.0, 34.0, 19.2, 15.4)
QUARTERS, THIRDS = tuple(np.pi / 2 * k for k in range(4)), tuple(2 * np.pi / 3 * k for k in range(3))
POINTS = Path(__file__).resolve().parents[2] / "shared/realdata/azure_kinect_phases/nfov.csv"
PRESETS = (
    "paper", "arducam-b0410-far", "arducam-b0548", "ti-opt8241", "real3-45-38", "real3-80-60", "oak-tof", "epc660", "adtf3175",
    "adsd3100-two", "azure-kinect", "femto-bolt", "kinect-v2",
)  # fmt: skip


def camera_of(*each, light=(0.0, 0.0, 0.0), **kwargs):
    """A camera of (MHz, phases) of each frequency."""
    hz = tuple(mhz * 1e6 for mhz, phases in each for _ in phases)
    return TofInfo(
        "camera", "", CAMERA, np.array(light), hz, tuple(p for _, phases in each for p in phases), **kwargs
    )


SETS = {
    "paper": camera_of((20, QUARTERS), (100, QUARTERS), light=(0.007, 0.0, 0.0)),
    "one": camera_of((75, QUARTERS)),
    "I and Q": camera_of((40, (0.0, -np.pi / 2)), (70, (0.0, -np.pi / 2)), offset=False),
    "three of three": camera_of((198, THIRDS), (189, THIRDS), (54, THIRDS)),
    "Kinect v2": camera_of((80, THIRDS), (16, THIRDS), (120, THIRDS)),
    "unequal numbers": camera_of((60, QUARTERS), (80, (0.0, 1.3, 2.5, 3.7, 5.1)), (5, THIRDS)),
    "no ratio at all": camera_of((31.4159, THIRDS), (71.0711, (0.2, 1.9, 4.4))),
    "a clock that is off": camera_of((19.98, QUARTERS), (99.93, QUARTERS)),
    "four": camera_of((10, QUARTERS), (31, QUARTERS), (50, THIRDS), (77.7, QUARTERS), reach=(0.0, 40.0)),
    "far": camera_of((0.625, QUARTERS), (24, QUARTERS), reach=(2.0, 60.0)),
}


def reach_of(info):
    """Least and largest range of a camera."""
    return info.reach or (0.0, unambiguous(frequencies(info.modulation_hz)))


def exposed(info, radial, errors=(), amplitude=400.0, mean=900.0, celsius=45.0):
    """Noise-free taps of distances along the rays."""
    range_ = radial_to_range(radial, info.camera, info.illuminator)
    by_hz, z = {e.modulation_hz: e for e in errors}, []
    for f in frequencies(info.modulation_hz):
        phase = 2 * np.pi * range_ / ambiguity(f)
        wrong = by_hz.get(f, RangeError(f)).at(
            phase, radius_px(info.camera), celsius, image_places(info.camera)
        )
        z.append(amplitude * np.exp(1j * (phase + 2 * np.pi * wrong / ambiguity(f))))
    return taps(
        np.stack(z), np.full((len(z), *radial.shape), mean * info.offset), info.modulation_hz, info.phase_rad
    )


@pytest.mark.parametrize("name", SETS)
def test_exact_taps_decode_to_the_scene(name):
    """Within its reach every set gives every distance back; the reference by brute force says the same."""
    info, rng = SETS[name], np.random.default_rng(3)
    low, high = reach_of(info)
    radial = rng.uniform(low + 0.05 * (high - low), high - 0.02 * (high - low), CAMERA.shape)
    raw = exposed(info, radial)
    maps, signals = Decoder(info).signals(raw)
    np.testing.assert_allclose(maps.depth, CAMERA.radial_to_depth(radial), rtol=2e-6, atol=1e-5)
    slow = reference.decode(raw, info)
    np.testing.assert_allclose(slow.radial, radial, atol=1e-9)
    np.testing.assert_allclose(signals.ranges, slow.ranges, rtol=1e-5, atol=2e-4)
    assert not (maps.flags & (TofFlag.AMBIGUOUS | TofFlag.INCONSISTENT)).any()


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(5.0, 200.0), min_size=1, max_size=3, unique=True),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_any_frequencies_and_phases_decode(mhz, seed, offset):
    """Whatever the frequencies, and whatever phases determine phasors: exact taps give the distance back, in any order of channels."""
    rng = np.random.default_rng(seed)
    each = []
    for f in mhz:
        count = int(rng.integers(3 if offset else 2, 7))
        each.append(
            (
                f,
                np.sort(
                    rng.uniform(-0.2, 0.2, count) + np.arange(count) * np.pi * (2 if offset else 1) / count
                ),
            )
        )
    info = camera_of(*each, offset=offset)
    order = rng.permutation(len(info.phase_rad))
    mixed = replace(
        info,
        modulation_hz=tuple(info.modulation_hz[i] for i in order),
        phase_rad=tuple(info.phase_rad[i] for i in order),
    )
    far = reach_of(info)[1]
    radial = rng.uniform(0.03, 0.97, CAMERA.shape) * far
    found = Decoder(mixed)(exposed(info, radial)[order])
    np.testing.assert_allclose(found.depth, CAMERA.radial_to_depth(radial), rtol=1e-5, atol=3e-4)


@pytest.mark.parametrize("name", ["paper", "I and Q", "three of three", "Kinect v2", "no ratio at all"])
@pytest.mark.parametrize("amplitude", [2.0, 5.0])
def test_wraps_are_those_of_the_likelihood_of_all_vectors(name, amplitude, monkeypatch):
    """Pixel by pixel, with noise: no other vector of wraps in reach is likelier than the one that is chosen."""
    info, rng = SETS[name], np.random.default_rng(8)
    radial = rng.uniform(0.05, 0.95, CAMERA.shape) * reach_of(info)[1]
    raw = exposed(info, radial, amplitude=amplitude, mean=2 * amplitude)
    raw = raw + rng.standard_normal(raw.shape)
    monkeypatch.setattr(float32, "SURE", -np.inf)  # nobody is asked
    decoder = Decoder(info)
    ranges, slow = decoder.signals(raw)[1].ranges, reference.decode(raw, info)
    fused, expected = (np.tensordot(decoder.wraps.lean, r, axes=1) for r in (ranges, slow.ranges))
    period = decoder.wraps.period
    apart = np.mod(fused - expected + period / 2, period) - period / 2
    assert (np.abs(apart) < decoder.wraps.U[-1] / 2).mean() >= 0.999


@pytest.mark.parametrize(
    ("mhz", "metres"),
    [
        ((20, 100), 7.494811), ((40, 70), 14.989623), ((37.65, 45.18), 19.906538), ((60, 80), 7.494811), ((54, 189, 198), 16.655137),
        ((16, 80, 120), 18.737029), ((75,), 1.998616), ((20, 99.9), 7.502), ((19.98, 99.93), 7.5002),
    ],
)  # fmt: skip
def test_what_a_set_tells_apart(mhz, metres):
    """The least common multiple where there is one, and about that where a clock is off."""
    assert unambiguous([f * 1e6 for f in mhz]) == pytest.approx(metres, rel=2e-4)


def test_the_closest_vectors_are_as_far_apart_as_known():
    """Two frequencies in the ratio p to q are 2 pi / sqrt(p^2 + q^2) of noise apart; ranges that agree do not mismatch."""
    for p, q in ((1, 5), (4, 7), (5, 6), (3, 4)):
        assert wrap_table((p * 1e7, q * 1e7), (2, 2)).apart == pytest.approx(2 * np.pi / np.hypot(p, q))
    assert mismatch(np.array([3.0, 3.0]), (2e7, 1e8)) == 0
    assert mismatch(np.array([3.0 + ambiguity(1e8), 3.0]), (2e7, 1e8)) == pytest.approx(
        wrap_table((2e7, 1e8), (2, 2)).apart
    )


def test_one_frequency_near_a_stated_distance():
    """75 MHz at 9 to 10.5 m: the wrap is known, and noise at the ends stays there."""
    info = camera_of((75, QUARTERS), reach=(9.0, 10.5))
    radial = np.linspace(9.0, 10.5, CAMERA.width * CAMERA.height).reshape(CAMERA.shape)
    raw = exposed(info, radial) + np.random.default_rng(0).standard_normal((4, *CAMERA.shape))
    found = CAMERA.depth_to_radial(Decoder(info)(raw).depth)
    assert np.abs(found - radial).max() < 0.02


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"modulation_hz": ()}, "a phase for each of 0 channels"),
        ({"phase_rad": QUARTERS + QUARTERS[:3]}, "a phase for each of 8 channels, at least one, got 7"),
        ({"phase_rad": (0.5,) * 8}, r"20 MHz: the phases \[28.648, .* do not determine a phasor"),
        ({"modulation_hz": (20e6,) * 6 + (100e6,) * 2}, "100 MHz: the phases .* do not determine a phasor"),
        ({"modulation_hz": (20.0,) * 4 + (100.0,) * 4}, "expected frequencies in Hz, got 20"),
        ({"modulation_hz": (-20e6,) * 4 + (100e6,) * 4}, "expected frequencies above 0 Hz"),
        ({"phase_rad": (np.nan,) * 8}, "finite phases"),
        ({"reach": (0.0, 12.0)}, "20, 100 MHz tell ranges apart over 7.495 m only, and the reach is 0 to 12 m"),
        ({"reach": (3.0, 1.0)}, "a reach of two ranges in metres, ascending"),
        ({"saturation": 0.0}, "a saturation above 0"),
        ({"offset": False, "phase_rad": (0.0, np.pi) * 4}, "two phases that are not opposite"),
    ],
)  # fmt: skip
def test_channels_that_nobody_could_decode_are_refused_by_name(change, words):
    """When the camera is described, before anything is recorded; and in a file's description."""
    with pytest.raises(DataError, match=words):
        replace(SETS["paper"], **change)
    table = {
        **tof_table(SETS["paper"]),
        **{k: list(np.atleast_1d(v)) if k != "offset" else v for k, v in change.items()},
    }
    table["saturation"] = float(np.ravel(table["saturation"])[0])
    with pytest.raises(DataError):
        tof_from(table, "file")


def test_a_description_keeps_everything():
    """JSON and back: signed taps, reach, a table of phases; unknown exposure stays unknown."""
    table = packed_table(np.random.default_rng(0).normal(0, 0.1, CAMERA.shape))
    info = replace(
        SETS["I and Q"], exposure=np.nan, reach=(0.3, 9.0), range_errors=(RangeError(40e6, table=table),),
        noise=TapNoise(np.inf, 3.0),
    )  # fmt: skip
    back = tof_from(tof_table(info), "file")
    assert np.isnan(back.exposure)
    assert replace(back, exposure=0.0, illuminator=0) == replace(info, exposure=0.0, illuminator=0)
    rig = Rig(CAMERA, CAMERA, np.eye(4), np.eye(4), range_errors=info.range_errors, reach=(0.3, 9.0))
    assert loads_rig(dumps_rig(rig)).range_errors == rig.range_errors
    assert loads_rig(dumps_rig(rig)).reach == (0.3, 9.0)
    with pytest.raises(ConfigError, match="reach"):
        loads_rig(dumps_rig(rig).replace("reach = [\n    0.3,\n    9.0,\n]", "reach = 3"))
    for noise in (3, {"read": -1.0}, {"electrons_per_unit": 0.0, "read": 1.0}, {"read": "much"}, {}):
        with pytest.raises(DataError, match="noise"):
            tof_from({**tof_table(info), "noise": noise}, "file")
    with pytest.raises(ConfigError, match="table"):
        RangeError(40e6, table="nonsense").pixels(CAMERA)
    with pytest.raises(ConfigError, match=r"expected a table of \(30, 41\) pixels"):
        RangeError(40e6, table=table).pixels(replace(CAMERA, width=41))


def test_phase_tables_and_offsets_of_each_frequency_are_taken_off():
    """A table (P0) of metres beyond a wrap, offsets between the frequencies, a slope over the image: the scene comes back."""
    rng = np.random.default_rng(4)
    errors = (
        RangeError(16e6, 0.2, table=packed_table(rng.normal(0, 3.0, CAMERA.shape))),
        RangeError(80e6, -0.7, table=packed_table(rng.normal(0, 0.5, CAMERA.shape)), image=((1, 0, 0.1),)),
        RangeError(
            120e6, 0.065, harmonics=((3, 0.004, 0.002),), table=packed_table(rng.normal(0, 0.5, CAMERA.shape))
        ),
    )
    info = replace(SETS["Kinect v2"], range_errors=errors)
    radial = rng.uniform(0.5, 9.0, CAMERA.shape)
    raw = exposed(info, radial, errors)
    found = Decoder(info)(raw)
    np.testing.assert_allclose(found.depth, CAMERA.radial_to_depth(radial), atol=2e-5)
    np.testing.assert_allclose(reference.decode(raw, info).radial, radial, atol=1e-6)
    plain = Decoder(replace(info, range_errors=()))(raw).depth
    assert np.median(np.abs(plain - found.depth)) > 0.1


def test_signed_taps_saturate_at_both_ends_and_flags_lie_beyond():
    """-2047 is as full as 2047; 64002 and 64003 of a sensor that writes flags into values are no counts."""
    info = replace(SETS["I and Q"], saturation=2047.0)
    raw = np.rint(exposed(info, np.full(CAMERA.shape, 2.0))).astype(np.int16)
    raw[1, 3, 4], raw[2, 5, 6] = -2047, 2047
    found = Decoder(info)(raw)
    assert np.argwhere(found.flags & TofFlag.SATURATED).tolist() == [[3, 4], [5, 6]]
    burst = Decoder(info).burst(np.stack([raw, np.rint(raw * 0.9).astype(np.int16)]))
    assert np.argwhere(np.isnan(burst.depth)).tolist() == [[3, 4], [5, 6]]
    raw = np.rint(exposed(SETS["paper"], np.full(CAMERA.shape, 2.0))).astype(np.uint16)
    raw[0, 1, 1], raw[5, 2, 2] = 64002, 64003
    assert np.argwhere(np.isnan(Decoder(SETS["paper"])(raw).depth)).tolist() == [[1, 1], [2, 2]]


LARGE = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
RADIAL = 0.5 + 0.9 * np.hypot(*np.mgrid[-60:60, -80:80]) / 100


def noisy_frames(info, factor, rng, frames=1):
    """Whole counts (frames, K, H, W) of a bowl before the camera, at so many times the noise of the paper's sensor."""
    amplitude, mean = 150 / RADIAL**2, 220 / RADIAL**2 + 20
    clean = exposed(info, RADIAL, amplitude=amplitude, mean=mean)
    sigma = factor * np.sqrt(mean / 16 + 1.25**2)
    raw = np.rint(clean + sigma * rng.standard_normal((frames, *clean.shape)))
    return np.clip(raw, 0 if info.offset else -4095, 4095).astype(np.uint16 if info.offset else np.int16)


@pytest.mark.parametrize("factor", [0.25, 1.0, 5.0])
@pytest.mark.parametrize("name", ["paper", "one", "I and Q", "three of three", "unequal numbers"])
def test_a_stuck_tap_is_seen_in_every_pixel_and_a_sound_one_in_none(name, factor):
    """Rows with a tap that always says the same are flagged; elsewhere, and in sound frames, under one in a thousand is, whatever the noise."""
    info, rng = replace(SETS[name], camera=LARGE), np.random.default_rng(7)
    decoder, others = Decoder(info), np.delete(np.arange(120), np.s_[50:70])
    for value in (0, 100, 300, 700, 4000):
        raw = noisy_frames(info, factor, rng, 4)
        sound = decoder(raw[0]).flags, decoder.burst(raw).flags
        raw[:, rng.integers(raw.shape[1]), 50:70] = value
        for flags, before in zip((decoder(raw[0]).flags, decoder.burst(raw).flags), sound, strict=True):
            assert (flags[50:70] & TofFlag.INCONSISTENT > 0).mean() > 0.99
            assert (flags[others] & TofFlag.INCONSISTENT > 0).mean() < 1e-3
            assert (before & TofFlag.INCONSISTENT > 0).mean() < 1e-3


@pytest.mark.parametrize("factor", [0.25, 1.0, 5.0])
@pytest.mark.parametrize("name", ["paper", "I and Q", "three of three"])
def test_the_noise_of_a_frame_is_its_own(name, factor):
    """What is flagged as uncertain is what is: at the flag's edge the range's own noise is 20 mm, for a camera that says nothing of it."""
    info = replace(SETS[name], camera=LARGE)
    raw = noisy_frames(info, factor, np.random.default_rng(3))[0]
    told = replace(info, noise=TapNoise(16 / factor**2, np.hypot(1.25 * factor, 12**-0.5)))
    if not info.offset:  # the amplitude stands for the light, as 150 for 220
        told = replace(told, noise=TapNoise(16 / factor**2 * 150 / 220, np.sqrt(20 / 16 + 1.25**2) * factor))
    own, stated = (Decoder(i)(raw) for i in (info, told))
    differ = (own.flags ^ stated.flags) & TofFlag.LOW_CONFIDENCE > 0
    share = (stated.flags & TofFlag.LOW_CONFIDENCE > 0).mean()
    assert differ.mean() < 0.01 + 0.3 * min(share, 1 - share)
    assert np.nanmean(own.depth != stated.depth) < 0.01


@pytest.mark.parametrize("name", ["paper", "three of three"])
def test_units_and_offsets_of_taps_change_nothing(name):
    """Counts, counts on a pedestal of 30,000 to the end of 16 bits, signed counts, counts scaled to 1 or by 16: depth and flags are the same."""
    info = replace(SETS[name], camera=LARGE, saturation=4094.0)
    raw = noisy_frames(info, 1.0, np.random.default_rng(5))[0].astype(np.int32)
    expected = Decoder(info)(raw.astype(np.uint16))
    for other, limit in (
        ((raw + 30000).astype(np.uint16), 34094), ((raw - 2000).astype(np.int16), 2094), (raw / 4094, 1.0),
        ((raw * 16).astype(np.uint16), 4094 * 16), (raw.astype(np.float32), 4094),
    ):  # fmt: skip
        found = Decoder(replace(info, saturation=float(limit)))(other)
        np.testing.assert_allclose(found.depth, expected.depth, atol=2e-4)
        assert (found.flags != expected.flags).mean() < 0.005


def test_what_is_no_number_or_no_light_has_no_depth_and_spoils_nothing_else():
    """NaN, infinity, zeros and flags of a sensor in some pixels: none of these has a depth, all others keep theirs."""
    for name in ("paper", "three of three", "I and Q"):
        info, rng = replace(SETS[name], camera=LARGE), np.random.default_rng(6)
        raw = noisy_frames(info, 1.0, rng)[0].astype(np.float64)
        expected, spoilt = Decoder(info)(raw), rng.random(LARGE.shape) < 0.1
        for value in (np.nan, np.inf, -np.inf, 0.0, 64003.0):
            bad = np.where(spoilt, value, raw)
            found = Decoder(info)(bad)
            assert np.isnan(found.depth[spoilt]).all()
            assert (found.flags[spoilt] > 0).all()
            kept = np.isfinite(expected.depth) & ~spoilt
            assert (np.abs(found.depth - expected.depth)[kept] < 1e-6).mean() > 0.999


@pytest.mark.parametrize("name", ["paper", "I and Q", "three of three"])
def test_a_clock_that_is_off(name):
    """Half a per cent that the file says costs nothing; a tenth that nobody knows costs a tenth of a per cent of the range."""
    info, rng = SETS[name], np.random.default_rng(1)
    radial = rng.uniform(0.3, 0.9 * reach_of(info)[1], CAMERA.shape)
    there = replace(info, modulation_hz=tuple(1.005 * f for f in info.modulation_hz))
    np.testing.assert_allclose(
        Decoder(there)(exposed(there, radial)).depth, CAMERA.radial_to_depth(radial), atol=2e-5
    )
    fast = replace(info, modulation_hz=tuple(1.001 * f for f in info.modulation_hz))
    found = CAMERA.depth_to_radial(Decoder(info)(exposed(fast, radial)).depth)
    assert np.abs(found - 1.001 * radial).max() < 0.001


def test_a_surface_out_of_reach_is_flagged():
    """Told that nothing is beyond 1.2 m, the decoder does not say of a wall at 2 m that all is well."""
    info = replace(SETS["paper"], reach=(0.2, 1.2), illuminator=np.zeros(3))
    assert (Decoder(info)(exposed(info, np.full(CAMERA.shape, 2.0))).flags & TofFlag.AMBIGUOUS).all()
    assert not (Decoder(info)(exposed(info, np.full(CAMERA.shape, 1.0))).flags & TofFlag.AMBIGUOUS).any()


@pytest.mark.parametrize("name", ["three of three", "I and Q", "Kinect v2"])
def test_neighbours_help_any_set(name):
    """On surfaces at an amplitude of two sigmas under four tenths of the wrong wraps of pixels alone remain."""
    info, rng = SETS[name], np.random.default_rng(2)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    radial = np.where(u < 22, 1.1 + 0.003 * v, 4.6 + 0.01 * u)
    raw = exposed(info, radial, amplitude=2.5, mean=10.0)
    raw = raw + rng.standard_normal(raw.shape)
    wrong = [
        (~(np.abs(found - radial) < 0.3)).mean()
        for found in (
            CAMERA.depth_to_radial(Decoder(info, TapNoise(np.inf, 1.0))(raw).depth),
            reference.decode(raw, info).radial,
        )
    ]
    assert wrong[0] < 0.4 * wrong[1]


def test_the_same_taps_give_the_same_bits():
    """Of every machine and every day: depth and flags of made-up counts, three sets."""
    digest = hashlib.sha256()
    for name in ("paper", "three of three", "one"):
        info = SETS[name]
        count = len(info.phase_rad) * CAMERA.width * CAMERA.height
        raw = (
            (np.arange(count, dtype=np.uint64) ** 2 * 7919 % 3571 + 40)
            .astype(np.uint16)
            .reshape(-1, *CAMERA.shape)
        )
        maps = Decoder(info)(raw)
        digest.update(maps.depth.tobytes() + maps.confidence.tobytes() + maps.flags.tobytes())
    assert digest.hexdigest()[:16] == "05e2a51cd3b16838"


@pytest.mark.realdata
@pytest.mark.skipif(not POINTS.is_file(), reason="the nine measured points are not here")
def test_nine_points_of_a_real_camera_of_three_frequencies():
    """Tape-measured points of an Azure Kinect, with its author's offsets and slopes: every wrap agrees with the tape."""
    U = np.array([2.7980018, 0.7824560, 0.7618528])
    offset, slope = (
        np.array([-0.4306281, 0.5063031, 0.5523268]),
        np.array([-0.0006160847, -0.0021119791, -0.0022633219]),
    )
    rows = np.loadtxt(POINTS, delimiter=",", skiprows=1)
    x, tape, phase = rows[:, 0], rows[:, 1], rows[:, :1:-1]
    camera = Camera(9, 1, 1e9, 1e9, 4.0, 0.0)  # nine rays that are all but one
    hz = [299_792_458 / 2 / u for u in U]
    errors = tuple(
        RangeError(f, table=packed_table(-u * (o + s * x)[None]))
        for f, u, o, s in zip(hz, U, offset, slope, strict=True)
    )
    info = replace(
        camera_of(*((f / 1e6, THIRDS) for f in hz)), camera=camera, range_errors=errors,
        modulation_hz=tuple(f for f in hz for _ in THIRDS),
    )  # fmt: skip
    z = 300 * np.exp(1j * phase.T)[:, None]
    raw = taps(z, np.full(z.shape, 900.0), info.modulation_hz, info.phase_rad)
    assert np.abs(Decoder(info)(raw).depth[0] - tape).max() < 0.05


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_camera_that_decodes_its_own_scene(name):
    """Every camera of the simulator, at a small size, without noise: what its maker knows of its errors is enough."""
    constants = read_constants(
        {"tof": {"preset": name, "width": 40, "height": 30, "fx": 33.0, "fy": 34.0, "cx": 19.2, "cy": 15.4}},
        "world",
    )
    sensor = replace(
        ideal(constants.sensor), range_errors=constants.sensor.range_errors if name == "kinect-v2" else ()
    )
    info = TofInfo(
        name, "", constants.tof, np.zeros(3), sensor.modulation_hz, sensor.phase_rad, saturation=sensor.full_scale,
        range_errors=sensor.range_errors, offset=sensor.offset,
    )  # fmt: skip
    radial = np.random.default_rng(0).uniform(0.5, 1.4, CAMERA.shape)
    hz = frequencies(info.modulation_hz)
    z = np.stack([0.5 * np.exp(2j * np.pi * radial / ambiguity(f)) for f in hz])
    raw, _ = expose(Light(z, np.full(CAMERA.shape, 0.5)), sensor, info, 1, np.random.default_rng(0), 0)
    np.testing.assert_allclose(Decoder(info).burst(raw).depth, CAMERA.radial_to_depth(radial), atol=3e-5)


def test_presets_say_their_sources_and_others_are_refused():
    """A name that is not there is answered with those that are."""
    with pytest.raises(ConfigError, match="no camera 'kinect-v3'") as info:
        read_constants({"tof": {"preset": "kinect-v3"}}, "world")
    assert "kinect-v2" in info.value.hint
    kinect = read_constants({"tof": {"preset": "kinect-v2"}}, "world")
    assert kinect.tof.shape == (424, 512)
    assert all(e.table for e in kinect.sensor.range_errors)
    assert read_constants({"tof": {"preset": "paper"}}, "world").sensor == read_constants({}, "world").sensor


def test_signed_taps_have_the_noise_of_both_wells():
    """I and Q of two wells: no offset, twice the amplitude, the variance of all the light."""
    sensor = replace(
        read_constants({"tof": {"preset": "ti-opt8241"}}, "world").sensor, pixel_offset=0.0, scattering=0.0
    )
    info = replace(SETS["I and Q"], modulation_hz=sensor.modulation_hz, phase_rad=sensor.phase_rad)
    z = np.full((2, *CAMERA.shape), 0.5 + 0j)
    raw, _ = expose(Light(z, np.full(CAMERA.shape, 0.5)), sensor, info, 40, np.random.default_rng(0), 0)
    assert raw.dtype == np.int16
    strength = 0.5 * sensor.signal[0]
    np.testing.assert_allclose(raw[:, 0].mean(), 2 * strength * sensor.contrast[0], rtol=0.01)
    assert abs(raw[:, 1].mean()) < 0.5
    variance = 2 * ((strength + sensor.ambient) / 16 + (sensor.read_noise / 16) ** 2)
    assert raw[:, 1].var() == pytest.approx(variance, rel=0.03)


def test_channels_in_words_and_information():
    """The paper's camera in a sentence; four even phases know twice what a tap's variance says, three a half less."""
    info = SETS["paper"]
    words = channels_in_words(info.modulation_hz, info.phase_rad)
    assert words == "20 MHz at 0, 90, 180, 270 deg, then 100 MHz at 0, 90, 180, 270 deg"
    np.testing.assert_allclose(information(info), 2)
    np.testing.assert_allclose(information(SETS["Kinect v2"]), 1.5)
