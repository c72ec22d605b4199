"""The picture of a plan: well formed, every view twice, every reason told; the command that writes it."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from tests import pictures
from tests.test_plan import RIG, STAGE, UR10E
from tofcapture.cli import main
from tofcapture.errors import BusyError, DeviceError
from tofcapture.record.daemon import client
from tofcapture.record.plan import REFUSALS, REMEDIES, object_sampling, plan_views
from tofcapture.viz.plan import write_plan

SVG = "{http://www.w3.org/2000/svg}"


def _plan(views=9, turns=1, stage=STAGE, distances=(0.4, 0.7, 1.2), tilt=(0.0, 1.1)):
    sampling = replace(object_sampling(), directions=80, distances=distances, tilt=tilt)
    rng = np.random.default_rng(3)
    return plan_views(UR10E, RIG, stage, stage.target, sampling, views, rng, turns)


def _drawn(plan, tmp_path, stage=STAGE, title="mug <1>"):
    out = tmp_path / "plan.svg"
    write_plan(plan, stage, RIG, stage.target, title, out)
    return ET.fromstring(out.read_text())  # noqa: S314  ours


def test_every_view_and_every_reason_is_drawn(drawn, tmp_path):
    """Each view stands in both panels with its number, place and words; the counts of the legend are those of the plan."""
    plan = _plan(turns=2)
    root = _drawn(plan, tmp_path)
    views = [g for g in root.iter(f"{SVG}g") if g.get("class") == "view"]
    titles = sorted(g.find(f"{SVG}title").text for g in views)
    said = [
        f"view {v.index}: {v.distance:.2f} m, object turned by {np.degrees(v.turn):.0f} deg, {v.coverage:.0%} of it covered"
        for v in plan.views
    ]
    assert titles == sorted(2 * said)
    words = [t.text or "" for t in root.iter(f"{SVG}text")]
    assert any("mug <1>" in w and plan.summary() in w for w in words)
    for view in plan.views:
        assert words.count(f"{view.index}") == 2
    for reason, count in plan.refused.items():
        assert (f"{count} {REMEDIES[reason][0]}" in words) == (count > 0)
    assert {"object turned by 0 deg", "object turned by 180 deg"} <= set(words)
    pictures.hold("plan", drawn)


def test_views_are_drawn_to_scale(tmp_path):
    """The cameras stand in the picture from above as they stand in the room: x to the right, y up, one scale."""
    plan = _plan()
    groups = [g for g in _drawn(plan, tmp_path).iter(f"{SVG}g") if g.get("class") == "view"][
        : len(plan.views)
    ]
    pixels = np.array([_start(g) for g in groups])
    room = np.stack([(v.T_base_flange @ RIG.T_flange_tof)[:2, 3] for v in plan.views])
    (right, _), (up, _) = (np.polyfit(room[:, k], pixels[:, k], 1) for k in (0, 1))
    assert right > 0
    assert up == pytest.approx(-right, rel=1e-4)
    np.testing.assert_allclose(np.diff(pixels, axis=0), np.diff(room, axis=0) * [right, up], atol=0.01)


def _start(group):
    """First point of a view's line: the camera itself."""
    return [float(x) for x in group.find(f"{SVG}path").get("d").split()[1:3]]


def test_refusals_and_counts_agree():
    """What became of the candidates adds up to the counts, and no view stands where something stood against it."""
    plan = _plan()
    refusal = plan.tried.refusal
    assert {name: int((refusal == i).sum()) for i, name in enumerate(REFUSALS)} == plan.refused
    assert len(refusal) == plan.candidates == 240
    free = plan.tried.spots[refusal < 0]
    for view in plan.views:
        spot = STAGE.target + view.distance * view.direction
        assert np.linalg.norm(free - spot, axis=1).min() < 1e-9


def test_an_empty_plan_is_drawn_and_explained(tmp_path):
    """Where nothing can be reached the picture still says why, and the words name reason and remedy."""
    far = replace(STAGE, target=np.array([4.0, 0.0, -0.4]))
    plan = _plan(stage=far)
    assert not [g for g in _drawn(plan, tmp_path, far).iter(f"{SVG}g") if g.get("class") == "view"]
    lines = plan.shortfall()
    assert "only 0 of 9 views" in lines[0]
    assert "240 are beyond the arm's reach" in lines[1]
    assert "--turns" in lines[-1]
    assert _plan().shortfall() == []


def _widest_gap(plan):
    """Largest angle about the object without a view, as the object sees it, radians."""
    around = np.sort(
        np.mod([np.arctan2(v.direction[1], v.direction[0]) - v.turn for v in plan.views], 2 * np.pi)
    )
    return np.diff(np.append(around, around[0] + 2 * np.pi)).max()


def test_turns_give_views_from_all_sides():
    """With four turns the object is seen from more sides than the arm can go to, and travel takes one turn after the other."""
    far = {"distances": (1.1, 1.2), "tilt": (0.6, 1.1)}
    plan = _plan(25, turns=4, **far)
    turns = [view.turn for view in plan.views]
    assert turns == sorted(turns)
    assert len(set(turns)) == 4
    assert _widest_gap(plan) < 0.5 * _widest_gap(_plan(25, **far))
    assert len({view.digest for view in plan.views}) == 25
    shorter = _plan(7, turns=4, **far)
    assert {v.index: v.digest for v in shorter.views}.items() <= {
        v.index: v.digest for v in plan.views
    }.items()


def test_dry_run_draws_beside_the_recording(tmp_path, capsys):
    """``--dry-run`` shows a table, names its picture, and makes no recording."""
    out = tmp_path / "r"
    words = ["record", "--scene", "mug", "--views", "3", "--turns", "2", "--out", str(out), "--dry-run"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "3 of 3 views" in said
    assert "tilt" in said
    assert not out.exists()
    assert (tmp_path / "r-mug-plan.svg").read_text().startswith("<?xml")
    assert main([*words, "--picture", str(tmp_path / "p" / "x.svg"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["picture"].endswith("x.svg")
    assert {v["turn_deg"] for v in data["plan"]["views"]} <= {0.0, 180.0}


@pytest.fixture
def daemon(monkeypatch, tmp_path):
    """A pretended daemon that keeps the recordings of ``tmp_path``."""
    heard = []

    def ask(method, path, body=None, state=None):
        heard.append((method, path, body))
        return {"root": str(tmp_path)} if method == "GET" else {"id": 7, "state": "queued"}

    monkeypatch.setattr(client, "ask", ask)
    return heard


def test_a_daemon_gets_the_work(daemon, tmp_path, capsys):
    """Work on a recording of a running daemon is handed over, word for word, and nothing is opened here."""
    words = ["record", "--scene", "mug", "--views", "2", "--frames", "3", "--seed", "5"]
    assert main([*words, "--out", str(tmp_path / "r")]) == 0
    assert "job 7" in capsys.readouterr().out
    request = {"scene": "mug", "views": 2, "frames": 3, "seed": 5, "recording": "r", "clear": False}
    assert daemon[-1] == ("POST", "/v1/jobs", request)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    "more", [["--foreground"], ["--dry-run"], ["--turns", "2"], ["--station", "/no/such.toml"]]
)
def test_what_stays_here(daemon, tmp_path, more):
    """A dry run, turns, a station of one's own and ``--foreground`` are no matter for the daemon."""
    main(["record", "--scene", "mug", "--views", "0", "--out", str(tmp_path / "r"), *more])
    assert daemon == []


def test_recordings_elsewhere_and_refusals(daemon, tmp_path, monkeypatch):
    """A recording elsewhere is recorded here; what the daemon refuses is not done here behind its back."""
    assert main(["record", "--scene", "mug", "--views", "0", "--out", str(tmp_path / "a" / "r")]) == 3
    assert [verb for verb, *_ in daemon] == ["GET"]

    def refuse(method, path, body=None, state=None):
        if method == "GET":
            return {"root": str(tmp_path)}
        raise BusyError("the queue is full")

    monkeypatch.setattr(client, "ask", refuse)
    assert main(["record", "--scene", "mug", "--out", str(tmp_path / "r")]) == 7

    def absent(method, path, body=None, state=None):
        raise DeviceError("no daemon answers")

    monkeypatch.setattr(client, "ask", absent)
    assert main(["record", "--scene", "mug", "--views", "0", "--out", str(tmp_path / "r")]) == 3


def test_leave_to_move_reaches_the_station(monkeypatch, tmp_path):
    """``--allow-motion`` is handed to the station, and only when it was given."""
    given = []

    def opened(path, seed, *, allow_motion=False):
        given.append(allow_motion)
        raise DeviceError("enough")

    monkeypatch.setattr("tofcapture.devices.station.open_station", opened)
    words = ["record", "--scene", "mug", "--out", str(tmp_path / "r"), "--foreground"]
    assert main(words) == main([*words, "--allow-motion"]) == 4
    assert given == [False, True]
