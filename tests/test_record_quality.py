"""Quality at capture: every check fires on what it is for and on nothing else; what a retake can mend is taken again."""

import io
from dataclasses import replace

import numpy as np
import pytest

from tests.test_recorder import VIEWS, Bench, _few_candidates, _record, rows
from tofcapture.camera import Camera
from tofcapture.channels import ambiguity
from tofcapture.devices.console import ConsoleOperator
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.files.view import open_view, view_path
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.poses import invert, look_at, rotation_exp, transform, transform_points
from tofcapture.record import plan as plans
from tofcapture.record import recorder
from tofcapture.record.plan import object_sampling, plan_scene
from tofcapture.record.quality import (
    ELSEWHERE,
    LIMITS,
    NOTE,
    REFUSE,
    RETAKE,
    board_pose,
    broken_limits,
    coverage,
    measure,
    meter,
    quality_table,
)
from tofcapture.record.sight import covered
from tofcapture.rig import SPEED_OF_LIGHT, RangeError, Rig

__all__ = ["_few_candidates"]  # applies here too

TOF, STEREO = Camera(48, 36, 40.0, 40.0, 23.5, 17.5), Camera(64, 52, 50.0, 50.0, 31.5, 25.5)
RIG = Rig(TOF, STEREO, transform(np.eye(3), [-0.05, 0.08, 0.0]), transform(np.eye(3), [0.0, -0.035, 0.08]))
MS = 1_000_000
FRAMES = 5


def _good(**change):
    """A good view's parts: a wall 0.8 m away, noise, five frames 33 ms apart."""
    rng = np.random.default_rng(1)
    info = TofInfo("fake", "1", TOF, np.zeros(3))
    phase = np.asarray(info.phase_rad)
    turn = 4 * np.pi / SPEED_OF_LIGHT * np.array(info.modulation_hz)[:, None, None] * 0.8 * TOF.ray_lengths
    clean = 600 + 200 * np.cos(turn + phase[:, None, None])
    raw = np.round(clean + rng.normal(0, 4, (FRAMES, *clean.shape))).astype(np.uint16)
    u, v = np.meshgrid(np.arange(64.0), np.arange(52.0))
    points = 0.8 * np.stack([(u - 31.5) / 50, (v - 25.5) / 50, np.ones_like(u)], axis=-1)
    parts = {
        "tof": TofBurst(raw, 1000 * MS + np.arange(FRAMES) * 33 * MS, np.full(FRAMES, 40.0), info),
        "stereo": StereoFrame(points.astype(np.float32), 1300 * MS, StereoInfo("fake", "1", STEREO)),
        "before": ArmState(np.zeros(6), np.eye(4), 990 * MS),
        "after": ArmState(np.zeros(6), np.eye(4), 1400 * MS),
        "rig": RIG,
        "frames": FRAMES,
    }
    return {**parts, **change}


def _raw(tof, change):
    raw = tof.raw.copy()
    change(raw)
    return replace(tof, raw=raw)


def _failing(parts):
    return {check.name for check in broken_limits(measure(**parts))}


def test_a_good_view_passes():
    """Nothing is said about a good view, and every check has a number."""
    numbers = measure(**_good())
    assert broken_limits(numbers) == []
    assert set(numbers) == {check.name for check in LIMITS} - {"object_coverage"} | {"offset_m"}
    assert quality_table(numbers)["notes"] == []


def _flash(raw):
    raw[2, :, :20, :20] += 60


def _set(where, value):
    def change(raw):
        raw[where] = value

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (
            "motion_m",
            lambda p: {"after": ArmState(np.zeros(6), transform(np.eye(3), [0, 0, 3e-4]), 2000 * MS)},
        ),
        (
            "motion_deg",
            lambda p: {
                "after": ArmState(np.zeros(6), transform(rotation_exp([0, 0, 4e-4]), np.zeros(3)), 2000 * MS)
            },
        ),
        ("missing_frames", lambda p: {"frames": FRAMES + 1}),
        ("stale_frames", lambda p: {"tof": replace(p["tof"], time_ns=p["tof"].time_ns - 200 * MS)}),
        ("stale_frames", lambda p: {"tof": _raw(p["tof"], lambda raw: raw.__setitem__(3, raw[2]))}),
        ("stale_frames", lambda p: {"stereo": replace(p["stereo"], time_ns=500 * MS)}),
        (
            "frame_drops",
            lambda p: {"tof": replace(p["tof"], time_ns=p["tof"].time_ns + 33 * MS * (np.arange(5) > 2))},
        ),
        ("flicker", lambda p: {"tof": _raw(p["tof"], _flash)}),
        ("saturated", lambda p: {"tof": _raw(p["tof"], _set((slice(None), slice(None), slice(0, 3)), 4095))}),
        (
            "stereo_coverage",
            lambda p: {"stereo": replace(p["stereo"], points=np.full_like(p["stereo"].points, np.nan))},
        ),
        ("overlap", lambda p: {"rig": replace(RIG, T_tof_stereo=transform(np.eye(3), [0.75, 0.0, 0.0]))}),
    ],
)
def test_each_check_fires_on_what_it_is_for(name, change):
    """One thing is wrong, and that thing alone is named."""
    parts = _good()
    failing = _failing({**parts, **change(parts)})
    assert name in failing
    assert failing <= {name, *(("overlap",) if name == "stereo_coverage" else ())}


def _slanted(hz=(20e6, 100e6), near=0.5, far=1.5, delay=2.0, **stated):
    """A wall from near to far as channels of ``hz`` see it, described by a driver that may state something else."""
    parts = _good()
    u = np.linspace(0, 1, 64)
    z = np.broadcast_to(near + (far - near) * u, (52, 64))
    points = STEREO.unproject(z)
    true = TofInfo(
        "fake",
        "1",
        TOF,
        np.zeros(3),
        tuple(np.repeat(hz, 4)),
        tuple(np.tile(np.arange(4) * np.pi / 2, len(hz))),
    )
    seen = transform_points(RIG.T_tof_stereo, points.reshape(-1, 3))
    at = np.rint(TOF.project(seen)[0]).astype(int)
    range_ = np.full(TOF.shape, np.nan)
    good = ((at >= 0) & (at < [48, 36])).all(axis=1)
    range_[at[good, 1], at[good, 0]] = np.linalg.norm(seen[good], axis=1)
    range_ = np.where(np.isnan(range_), np.nanmean(range_), range_)
    phase = 4 * np.pi / SPEED_OF_LIGHT * np.array(true.modulation_hz)[:, None, None] * range_ + delay
    clean = 600 + 200 * np.cos(phase + np.array(true.phase_rad)[:, None, None])
    raw = np.round(clean + np.random.default_rng(0).normal(0, 4, (FRAMES, *clean.shape))).astype(np.uint16)
    info = replace(
        true,
        **{
            k: tuple(np.asarray(getattr(true, k))[v]) if isinstance(v, list) else v for k, v in stated.items()
        },
    )
    stereo = replace(parts["stereo"], points=points.astype(np.float32))
    return {**parts, "stereo": stereo, "tof": replace(parts["tof"], raw=raw, info=info)}


@pytest.mark.parametrize("hz", [(20e6, 100e6), (60.24e6, 80.32e6)])
def test_channels_that_are_not_what_the_driver_states_are_refused(hz):
    """Frequencies swapped, taps in another order, another sign: each is named at the first view; a sensor's own delay is none of them.

    Only that the frequencies' ranges differ by it is noted.
    """
    assert _failing(_slanted(hz)) == {"offset"}
    swapped = [4, 5, 6, 7, 0, 1, 2, 3]
    assert "misread" in _failing(_slanted(hz, modulation_hz=swapped))
    assert "misread" in _failing(_slanted(hz, phase_rad=[0, 3, 2, 1, 4, 7, 6, 5]))
    assert "misfit" in _failing(_slanted(hz, phase_rad=[1, 0, 2, 3, 4, 5, 6, 7]))


@pytest.mark.parametrize("hz", [(20e6, 100e6), (60.24e6, 80.32e6), (40e6, 70e6), (54e6, 189e6, 198e6)])
@pytest.mark.parametrize("depth", [0.62, 0.8, 1.13])
def test_exchanged_frequencies_are_refused_before_a_wall_too(hz, depth):
    """Of a flat scene phases say little; that the depths are the stereo camera's with the frequencies exchanged says all."""
    wall = (depth, depth + 0.01)
    assert _failing(_slanted(hz, *wall, delay=0.0)) == set()
    turned = [k for f in reversed(range(len(hz))) for k in range(4 * f, 4 * f + 4)]
    assert _failing(_slanted(hz, *wall, delay=0.0, modulation_hz=turned)) & {"exchanged", "misread"}


def test_an_offset_between_the_frequencies_is_measured():
    """What nobody calibrated between 40 and 70 MHz is said to a millimetre; what the camera says of itself is none."""
    delay = (
        2.0 * (ambiguity(40e6) - ambiguity(70e6)) / (2 * np.pi)
    )  # of both phases alike; less the nearest wraps
    apart = ambiguity(70e6) / 4
    parts = _slanted((40e6, 70e6))
    found = measure(**parts)
    assert found["offset_m"] == pytest.approx(abs(delay - apart * np.rint(delay / apart)), abs=0.001)
    info = parts["tof"].info
    known = replace(
        info, range_errors=tuple(RangeError(f, 2.0 * ambiguity(f) / (2 * np.pi)) for f in (40e6, 70e6))
    )
    parts["tof"] = replace(parts["tof"], info=known)
    assert measure(**parts)["offset_m"] < 0.001


def test_a_scene_out_of_reach_is_refused():
    """75 MHz repeats after 2 m: a wall from 1.8 to 3 m is told at the first view, one near a stated distance is not."""
    assert _failing(_slanted((75e6,), 0.4, 1.6)) == set()
    assert _failing(_slanted((75e6,), 1.8, 3.0)) == {"out_of_reach"}
    assert _failing(_slanted((75e6,), 1.8, 3.0, reach=(1.5, 3.4))) == set()


def test_dark_is_noted_and_unlit_is_refused():
    """A dark object is no reason for a retake; an image without any light is no image."""
    parts = _good()
    rng = np.random.default_rng(2)
    faint = np.round(600 + rng.normal(0, 4, parts["tof"].raw.shape)).astype(np.uint16)
    some = parts["tof"].raw.copy()
    some[..., :20, :] = faint[..., :20, :]
    assert _failing({**parts, "tof": replace(parts["tof"], raw=some)}) == {"dark"}
    found = broken_limits(measure(**{**parts, "tof": replace(parts["tof"], raw=faint)}))
    assert [check.action for check in found] == [REFUSE, NOTE]


def test_refusals_come_first_and_speak():
    """The gravest failure is first; each has a sentence and a remedy."""
    numbers = {check.name: 0.0 if check.least else 1e3 for check in LIMITS} | {"offset_m": 1.0}
    failed = broken_limits(numbers)
    assert len(failed) == len(LIMITS)
    order = [check.action for check in failed]
    assert order == sorted(order, key=(REFUSE, RETAKE, ELSEWHERE, NOTE).index)
    assert all(check.sentence(numbers) and check.hint for check in failed)


class Lamp(Bench):
    """A bench whose ToF burst has a dropped frame in the first ``bad`` bursts."""

    def __init__(self, bad):
        super().__init__()
        self.bad = bad

    def station(self):
        station = super().station()
        real = station.tof.capture

        def capture(frames):
            burst = real(frames)
            self.bad -= 1
            times = np.arange(frames) * 33 * MS + np.where(
                np.arange(frames) > 2, 33 * MS * (self.bad >= 0), 0
            )
            steady = np.repeat(burst.raw[:1] // 2, frames, axis=0)
            steady[:, 0, 0, 0] = np.arange(frames)
            return replace(burst, raw=steady, time_ns=times)

        station.tof.capture = capture
        return station


@pytest.mark.parametrize(("bad", "attempts", "noted"), [(1, 2, 0), (3, 3, 1)])
def test_dropped_frames_are_retaken_then_noted(tmp_path, bad, attempts, noted):
    """A dropped frame is taken again; the third time the view is kept, with a note in its file and in the result."""
    result = _record(tmp_path, Lamp(bad), views=1, frames=6)
    assert result.recorded == (0,)
    assert all(note.startswith("view 0: ") for note in result.notes)
    assert sum("dropped" in note for note in result.notes) == noted
    assert [row.attempts for row in rows(tmp_path)] == [attempts]
    quality = open_view(view_path(tmp_path, "mug", 0)).provenance["quality"]
    assert sum(note["check"] == "frame_drops" for note in quality["notes"]) == noted
    assert quality["frame_drops"] == noted


def test_an_empty_point_map_is_never_sealed(tmp_path):
    """Without one stereo point a view is given up after three attempts, with its reason."""
    bench = Bench()
    station = bench.station()
    real, count = station.stereo.capture, iter(range(3))

    def capture():
        frame = real()
        return (
            replace(frame, points=np.full_like(frame.points, np.nan))
            if next(count, None) is not None
            else frame
        )

    station.stereo.capture = capture
    bench.station = lambda: station
    result = _record(tmp_path, bench)
    assert len(result.failed) == 1
    assert "0.0% of its image" in result.reasons[0]
    assert len(result.recorded) == VIEWS - 1


def test_quality_is_in_every_file(tmp_path):
    """The numbers are in the view files as JSON types."""
    _record(tmp_path)
    for i in range(VIEWS):
        quality = open_view(view_path(tmp_path, "mug", i)).provenance["quality"]
        assert {"saturated", "dark", "overlap", "motion_m", "frame_drops", "notes"} <= quality.keys()


class Turner(Bench):
    """A bench whose operator turns the object."""

    def station(self):
        station = super().station()
        station.operator.can_turn = True
        station.operator.turn = lambda scene, angle: self._step(f"turn {round(np.degrees(angle))}")
        return station


def test_turns_are_asked_for_once_each(tmp_path):
    """Views of one turn are taken together; each turn is asked for once, the first too; a resumed run asks again."""
    bench = Turner()
    _record(tmp_path, bench, views=8, turns=3)
    asked = [step for step in bench.steps if step.startswith("turn")]
    assert asked == ["turn 0", "turn 120", "turn 240"]
    angles = {open_view(view_path(tmp_path, "mug", i)).provenance["turn_deg"] for i in range(8)}
    assert angles == {0.0, 120.0, 240.0}
    again = Turner()
    assert _record(tmp_path, again, views=8, turns=3).kept == tuple(range(8))
    assert again.steps == []
    with pytest.raises(ConfigError, match="view"):
        _record(tmp_path, Bench(), views=8)


def test_a_person_at_the_console_turns_it():
    """The console asks for the angle in degrees and waits; when nobody can answer it says so."""
    asked = io.StringIO()
    operator = ConsoleOperator({}, None, asked, io.StringIO("\n\n"))
    operator.place("mug")
    operator.turn("mug", np.pi / 2)
    assert "Turn 'mug' to 90 deg" in asked.getvalue()
    with pytest.raises(DeviceError, match="ended"):
        operator.turn("mug", np.pi)


def test_nobody_can_turn_it(tmp_path):
    """Turns are refused before anything moves where the operator cannot turn objects, and for the board."""
    bench = Bench()
    with pytest.raises(ConfigError, match="cannot turn"):
        _record(tmp_path, bench, views=8, turns=3)
    with pytest.raises(ConfigError, match="the board stays"):
        _record(tmp_path, bench, scene="calibration", turns=2)
    assert bench.steps == []


def test_a_burst_of_one_frame():
    """One frame has no gaps and nothing to flicker against; the rest is looked at."""
    parts = _good()
    tof = parts["tof"]
    one = replace(tof, raw=tof.raw[:1], time_ns=tof.time_ns[:1], celsius=tof.celsius[:1])
    numbers = measure(**{**parts, "tof": one, "frames": 1})
    assert broken_limits(numbers) == []
    assert set(numbers) == {check.name for check in LIMITS} - {"flicker", "object_coverage"} | {"offset_m"}


# What a view shows of its object, and another place for it.
def test_what_is_covered_of_an_object():
    """A block on the table, seen from straight above: all but its rim, half of that, and nothing is told of no block and of no table."""
    T = look_at([0.0, 0.0, 0.66], np.zeros(3))
    depth = np.full(TOF.shape, 0.66)
    depth[12:24, 16:32] = 0.5
    points = TOF.unproject(depth)
    points = points.reshape(-1, 3)
    shares = [covered(depth, p, TOF, T) for p in (points, points[points[:, 0] > 0])]
    assert shares == pytest.approx([10 * 14 / (12 * 16), 10 * 6 / (12 * 16)])
    bare = np.full(TOF.shape, 0.66)
    assert np.isnan(covered(bare, TOF.unproject(bare).reshape(-1, 3), TOF, T))
    assert np.isnan(covered(depth, points[:0], TOF, T))


@pytest.mark.parametrize(
    ("shares", "kept"),
    [
        ((0.7, 0.9, 0.9), 0),
        ((0.3, 0.7, 0.9), 1),
        ((0.3, 0.4, 0.7), 2),
        ((0.3, 0.4, 0.2), 1),
        ((0.3, None, 0.2), 0),
        ((0.3, None, 0.5), 2),
    ],
)
def test_a_view_that_shows_too_little_is_taken_from_elsewhere(tmp_path, monkeypatch, shares, kept):
    """Until one shows enough; the best is kept, its pose in file and journal; what fails elsewhere costs nothing; a rerun keeps it all."""
    few = replace(object_sampling(), directions=40, distances=(0.5, 0.6))
    monkeypatch.setattr(plans, "object_sampling", lambda: few)
    bench = Bench()
    station = bench.station()
    (planned,) = plan_scene(station, "mug", 1).views
    places = [planned, planned.spare, planned.spare.spare]
    taken = []

    def look(*_, table):
        assert table
        (here,) = (i for i, place in enumerate(places) if np.allclose(bench.joints, place.joints))
        taken.append(here)
        if shares[here] is None:
            raise DeviceError("the lamp broke")
        return {"object_coverage": shares[here]}

    monkeypatch.setattr(recorder, "measure", look)
    bench.station = lambda: station
    result = _record(tmp_path, bench, views=1)
    assert (result.recorded, result.failed) == ((0,), ())
    assert max(taken) == next((i for i, share in enumerate(shares) if (share or 0) >= 0.7), 2)
    view = open_view(view_path(tmp_path, "mug", 0))
    pose = places[kept].digest
    (row,) = rows(tmp_path)
    assert row.pose == view.provenance["pose"] == pose
    words = [note["words"] for note in view.provenance["quality"]["notes"]]
    assert result.notes == tuple(f"view 0: {w}" for w in words)
    assert len(words) == (shares[0] < 0.7)
    assert (f"{shares[kept]:.0%}" in row.reason) == (kept > 0)
    if shares[1] is None:
        assert "the lamp broke" in words[0]
    assert _record(tmp_path, bench, views=1).kept == (0,)


# What the board views cover so far, from the arm's poses alone.
METER = Camera(240, 180, 190.0, 200.0, 119.5, 89.5)
BOARD, NORMAL = np.array([0.7, 0.0, -0.2]), np.array([0.0, 0.0, 1.0])


def _board_view(tilt, turn, distance=0.7, roll=0.0):
    tilt, turn = np.radians([tilt, turn])
    way = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    return look_at(BOARD + distance * way, BOARD, roll=roll)


def _covered(*views):
    return coverage([invert(T) @ board_pose(BOARD, NORMAL) for T in views], METER)


def test_meter_counts_what_was_seen():
    """Two views, of 20 and 30 degrees, 0.5 and 0.9 m away, are counted in their bins."""
    text = meter(_covered(_board_view(20, 0, 0.5), _board_view(30, 90, 0.9)))
    assert "2 board views, 0.50 to 0.90 m" in text
    assert "15-25 deg 1" in text
    assert "25-40 deg 1" in text
    assert meter(_covered()) == "no board views yet"


def test_roll_turns_the_lean():
    """A camera turned by a quarter about its axis sees the board lean a quarter further."""
    first, second = _covered(*(_board_view(30, 40, roll=r) for r in (0.0, np.pi / 2)))["lean_deg"]
    assert (first - second) % 360 == pytest.approx(90)


def test_a_board_that_stands_upright_in_the_image_faces_up_or_down():
    """Seen from a tilt without roll, the front leans down the image: its upper edge is farther away."""
    text = meter(_covered(_board_view(30, 10)))
    assert "below 1" in text or "above 1" in text
