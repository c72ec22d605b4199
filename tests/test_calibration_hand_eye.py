"""Hand-eye: oracles on made and published data, and every refusal by its name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.hand_eye import clocks
from calibration.hand_eye.checks import Cause, HandEyeRefused
from calibration.hand_eye.closed_form import park_martin, residuals, rotation_bound, shah
from calibration.hand_eye.files import read_pairs, read_poses
from calibration.hand_eye.pairs import make_stream, stream_pairs
from calibration.hand_eye.readings import agreed
from calibration.hand_eye.refine import jacobian, refined_from_consensus
from calibration.hand_eye.solve import solve_hand_eye, to_dict
from tests.hand_eye import apart, station, streams
from tofcapture.errors import DataError
from tofcapture.poses import exp, invert, invert_all, rotation_exp, rotation_log, transform

REAL = Path(__file__).resolve().parents[2] / "shared" / "realdata"
MOVEIT = REAL / "hand_eye_moveit" / "pose_samples.json"
ETH = REAL / "hand_eye_ethz" / "robot_arm"
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=10)


def refused(hand, target, **how):
    with pytest.raises(HandEyeRefused) as caught:
        solve_hand_eye(hand, target, **how)
    assert str(caught.value.cause) in str(caught.value)
    return caught.value.cause


@given(seed=seeds, eye_to_hand=st.booleans())
@few
def test_exact_pairs_give_the_exact_answer(seed, eye_to_hand):
    """Without noise every method finds X, and the refined one with it."""
    A, B, X = station(seed, 8, 0, 0, eye_to_hand)
    result = solve_hand_eye(A, B, eye_to_hand=eye_to_hand)
    for answer in (result.X, *result.closed_forms.values()):
        turned, moved = apart(answer, X)
        assert turned < 1e-6
        assert moved < 1e-6


@pytest.mark.parametrize("method", [park_martin, lambda P, B: shah(P, B)[0]])
@given(seed=seeds)
@few
def test_closed_forms_do_not_see_the_base(method, seed):
    """Another base frame changes no camera on the flange."""
    A, B, _ = station(seed, 6, 0.001, 0.003)
    base = exp(np.random.default_rng(seed).normal(0, 0.5, 6))
    turned, moved = apart(method(base @ A, B), method(A, B))
    assert turned < 1e-6
    assert moved < 1e-6


def test_jacobian_is_the_derivative():
    """The analytic derivative of the residual agrees with finite differences."""
    A, B, X = station(1, 5)
    Z = A[0] @ X @ B[0]
    J, h = jacobian(A, X, Z), 1e-6
    for k in range(12):
        step = np.zeros(12)
        step[k] = h
        moved = [
            residuals(
                A,
                B,
                transform(rotation_exp(s * step[3:6]) @ X[:3, :3], X[:3, 3] + s * step[:3]),
                transform(rotation_exp(s * step[9:]) @ Z[:3, :3], Z[:3, 3] + s * step[6:9]),
            )
            for s in (1, -1)
        ]
        np.testing.assert_allclose((moved[0] - moved[1]) / (2 * h), J[..., k], atol=2e-3)


def test_refined_beats_closed_forms_and_knows_its_error():
    """Over 12 stations of 40 poses with a camera noisy along its axis, refinement halves the translation error and 1 sigma covers."""
    ours, best, covered = [], [], []
    for seed in range(12):
        A, B, X = station(seed, 40, np.array([0.0003, 0.0003, 0.002]), 0.004)
        start = refined_from_consensus(A, B)
        ours.append(apart(start.X, X))
        best.append(
            np.min([apart(method(A, B), X) for method in (park_martin, lambda A, B: shah(A, B)[0])], axis=0)
        )
        off = np.r_[start.X[:3, 3] - X[:3, 3], rotation_log(start.X[:3, :3] @ X[:3, :3].T)]
        covered.append(np.abs(off) <= np.sqrt(np.diag(start.covariance)[:6]))
    assert (np.median(ours, axis=0) < [1, 0.6] * np.median(best, axis=0)).all()
    assert 0.5 < np.mean(covered) < 0.85


def test_leaving_one_out_is_solving_without_it():
    """The one-step left-out residual is that of a solution that never saw the pair."""
    A, B, _ = station(2, 20)
    result = solve_hand_eye(A, B)
    rest = np.arange(20) != 7
    without = refined_from_consensus(A[rest], B[rest])
    expected = residuals(A[7:8], B[7:8], without.X, without.Z)[0]
    assert np.abs(result.left_out[7] - expected).max() < 0.1 * np.abs(expected).max()
    assert result.leave_one_out[0] > np.sqrt(np.mean(np.sum(result.residual[:, :3] ** 2, axis=1)))


def test_outliers_lose_their_vote():
    """Two exchanged target poses among 25 are named and move the answer by less than its error bar."""
    A, B, X = station(4)
    B[[3, 11]] = B[[11, 3]]
    result = solve_hand_eye(A, B)
    assert np.flatnonzero(result.outliers).tolist() == [3, 11]
    assert "[3, 11]" in result.warnings[0]
    assert apart(result.X, X)[1] < 4 * result.sigma[0]


def test_motion_without_rotation_is_refused():
    """Pure translation, a single axis, tiny rotations and too few pairs are each refused by name, with arm and camera noise."""
    rng = np.random.default_rng(0)
    X, Z = exp([0.05, 0.02, 0.08, 0.3, -0.5, 0.8]), exp([0.6, 0, 0, 0, 0, 0.4])

    def pairs(twists):
        A = np.stack([exp(t) @ exp([0.4, 0, 0.5, 2, 1, 0]) for t in twists])
        B = np.stack([invert(X) @ invert(a) @ Z @ exp(rng.normal(0, 1e-3, 6)) for a in A])
        return A @ np.stack([exp(rng.normal(0, 3e-4, 6)) for _ in A]), B

    place = rng.normal(0, 0.2, (20, 3))
    axis = np.outer(rng.uniform(-1, 1, 20), [0.2, -0.4, 0.9])
    assert refused(*pairs(np.c_[place, 0 * place])) == Cause.PURE_TRANSLATION
    assert refused(*pairs(np.c_[place, axis])) == Cause.SINGLE_AXIS
    assert refused(*pairs(np.c_[place, rng.normal(0, 0.012, (20, 3))])) == Cause.SMALL_ROTATIONS
    A, B, _ = station()
    assert refused(A[:2], B[:2]) == Cause.TOO_FEW
    assert refused(A[:0], B[:0]) == Cause.TOO_FEW
    assert refused(A, np.repeat(B[:1], len(B), axis=0)) == Cause.SHUFFLED


S = np.diag([1.0, -1.0, 1.0, 1.0])


def scaled(T, factor):
    out = T.copy()
    out[:, :3, 3] *= factor
    return out


def reordered(T):
    from scipy.spatial.transform import Rotation

    out = T.copy()
    out[:, :3, :3] = Rotation.from_quat(
        np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(), 1, axis=1)
    ).as_matrix()
    return out


MISTAKES = {
    "shuffled": (
        lambda A, B: (A, np.roll(B, 7, axis=0)[np.random.default_rng(0).permutation(25)]),
        Cause.SHUFFLED,
    ),
    "half shuffled": (lambda A, B: (A, np.r_[B[12:0:-1], B[:1], B[13:]]), Cause.SHUFFLED),
    "one missing": (lambda A, B: (A[1:], B[:-1]), Cause.SHIFTED),
    "hand inverted": (lambda A, B: (invert_all(A), B), Cause.EYE_CONFUSED),
    "columns swapped": (lambda A, B: (B, A), Cause.SWAPPED),
    "target in mm": (lambda A, B: (A, scaled(B, 1000)), Cause.WRONG_UNITS),
    "hand in mm": (lambda A, B: (scaled(A, 1000), B), Cause.WRONG_UNITS),
    "target in inches": (lambda A, B: (A, scaled(B, 1 / 0.0254)), Cause.WRONG_UNITS),
    "target mirrored": (lambda A, B: (A, S @ B @ S), Cause.MIRRORED),
    "hand mirrored": (lambda A, B: (S @ A @ S, B), Cause.MIRRORED),
    "y of the hand reversed": (lambda A, B: (scaled(A, np.array([1, -1, 1])), B), Cause.MIRRORED),
    "x of the target reversed": (lambda A, B: (A, scaled(B, np.array([-1, 1, 1]))), Cause.MIRRORED),
    "quaternions w first": (lambda A, B: (A, reordered(B)), Cause.QUATERNION_ORDER),
    "two boards": (
        lambda A, B: (
            A,
            np.where((np.arange(len(B)) % 2)[:, None, None], B @ exp([0.1, 0.05, 0, 0, 0, 3]), B),
        ),
        Cause.TWO_BOARDS,
    ),
    "board moved": (lambda A, B: (A, np.r_[B[:14], B[14:] @ exp([0.1, 0.05, 0, 0, 0, 0.5])]), Cause.MOVED),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(mistake):
    """Every common mistake is refused, in the hand and beside the arm, by its cause and with a hint."""
    make, cause = MISTAKES[mistake]
    A, B, _ = station(5)
    assert refused(*make(A, B)) == cause


@pytest.mark.parametrize("eye_to_hand", [False, True])
def test_the_other_mount_is_named(eye_to_hand):
    """Eye-in-hand data solved as eye-to-hand, and the reverse, are refused as confused."""
    A, B, _ = station(6, eye_to_hand=eye_to_hand)
    assert refused(A, B, eye_to_hand=not eye_to_hand) == Cause.EYE_CONFUSED


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda T: np.where(np.arange(25)[:, None, None] == 3, np.nan, T), "NaN or infinity in pair 3"),
        (lambda T: T @ S, "left-handed"),
        (lambda T: T * 2, "no rotation"),
        (lambda T: np.swapaxes(T, 1, 2), "last row"),
        (lambda T: T[:, :3], "shape"),
        (lambda T: T[:-1], "as many target poses"),
    ],
)
def test_damaged_poses_are_data_errors(spoil, says):
    """NaN, mirrored, scaled and transposed matrices and unequal lists are said to be what they are."""
    A, B, _ = station()
    with pytest.raises(DataError, match=says):
        solve_hand_eye(A, spoil(B))


@pytest.mark.realdata
@pytest.mark.skipif(not MOVEIT.exists(), reason="needs ../shared/realdata")
def test_moveit_gives_the_published_answer():
    """MoveIt's real pairs give its published translation within 1 % and rotation within 1 %; eye-in-hand fails by name."""
    hand, target, _ = agreed(*read_pairs(MOVEIT))
    result = solve_hand_eye(hand, target, eye_to_hand=True)
    rx, ry, rz = (rotation_exp(a * e) for a, e in zip((0.230, -2.540, 1.950), np.eye(3), strict=True))
    truth = transform(rx @ ry @ rz, [0.659, -0.249, 0.830])
    np.testing.assert_allclose(result.X[:3, 3], truth[:3, 3], rtol=0.01)
    assert np.abs(result.X - truth).max() < 0.01
    assert not result.outliers.any()
    assert refused(hand, target) == Cause.EYE_CONFUSED
    assert refused(hand, np.random.default_rng(0).permutation(target), eye_to_hand=True) == Cause.SHUFFLED


@pytest.mark.realdata
@pytest.mark.skipif(not ETH.exists(), reason="needs ../shared/realdata")
def test_eth_streams_repeat():
    """A real arm's two halves of a stream agree within a centimetre and 0.3 degrees; its target poses are named inverted."""
    hand, seen = (read_poses(next(ETH.glob(name))) for name in ("*hinge.csv", "*target_ir.csv"))
    target = make_stream(seen.seconds, invert_all(seen.usual), "target")
    A, B, _ = stream_pairs(make_stream(hand.seconds, hand.usual, "hand"), target, -0.0157)
    one, two = (solve_hand_eye(A[s], B[s]) for s in (slice(0, 100), slice(100, 200)))
    turned, moved = apart(one.X, two.X)
    assert moved < 0.01
    assert turned < np.radians(0.3)
    assert refused(A, invert_all(B)) == Cause.TARGET_INVERTED


CLOCKS = {
    "nanoseconds of an epoch": (lambda t: np.round(1e9 * (t + 1.7e9)), 1.7e9, "ns,"),
    "a zero among wall-clock times": (
        lambda t: np.where(np.arange(len(t)) == 500, 0, t + 1.7e9),
        1.7e9,
        "stray",
    ),
    "steps back": (lambda t: np.where(np.arange(len(t)) < 1400, t, t - 5), 0.0, "steps back"),
}


@pytest.mark.slow
@pytest.mark.parametrize("clock", CLOCKS)
def test_time_offset_is_found(clock):
    """Clocks of any unit and origin, with stray stamps or a step, are brought together to a millisecond, and what they had is said."""
    change, origin, says = CLOCKS[clock]
    hand, target, X = streams(0.137)
    hand = make_stream(change(hand.seconds), hand.poses, "hand")
    A, B, found = stream_pairs(hand, target)
    assert abs(found["time_offset_s"] - 0.137 - origin) < 0.001
    assert found["time_offset_sigma_s"] < 0.001
    assert says in "; ".join(found["clocks"]["hand"])
    assert apart(solve_hand_eye(A, B).X, X)[1] < 0.002


@pytest.mark.parametrize("unit", clocks.SECONDS)
@pytest.mark.parametrize("origin", [0.0, 1e6, 1.76e9])
def test_stamps_tell_their_unit(unit, origin):
    """Nano- to whole seconds are told by their step, whatever the origin; a permutation of the rows is put in order."""
    rng = np.random.default_rng(0)
    t = origin + 0.02 * np.arange(300)
    R = np.stack([exp([0, 0, 0, 0.3 * np.sin(x), 0.2 * np.cos(x), 0])[:3, :3] for x in 0.02 * np.arange(300)])
    mixed = rng.permutation(300)
    found = clocks.read_clock(t[mixed] / clocks.SECONDS[unit], R[mixed], "hand")
    assert found.unit == unit
    np.testing.assert_array_equal(mixed[found.kept], np.arange(300))
    np.testing.assert_allclose(found.seconds, t, atol=1e-5)
    with pytest.raises(DataError, match="at least 10 poses"):
        clocks.read_clock(np.zeros(300), R, "hand")


def test_time_offset_of_foreign_or_periodic_streams_is_refused():
    """Streams of different motions, motion that repeats itself, and streams that never overlap have no offset."""
    hand, target, _ = streams(0.1, period=2.0)
    other = streams(0.1, seed=9)[1]
    for second, offset in ((target, None), (other, None), (target, 1e4)):
        with pytest.raises(HandEyeRefused) as caught:
            stream_pairs(hand, second, offset)
        assert caught.value.cause == Cause.TIME_OFFSET


@pytest.mark.parametrize(("factor", "eye_to_hand"), [(1.01, False), (1.06, True), (3.0, False)])
def test_a_wrong_target_size_is_solved_for_and_fails(factor, eye_to_hand):
    """A target measured too large or too small gives the right X, within its error bar, and a verdict that nobody overlooks."""
    A, B, X = station(7, 40, eye_to_hand=eye_to_hand)
    for size in (factor, 1 / factor):
        result = solve_hand_eye(A, scaled(B, size), eye_to_hand=eye_to_hand)
        assert abs(result.scale[0] * size - 1) < 4 * result.scale[1]
        assert apart(result.X, X)[1] < 3 * result.sigma[0]
        assert result.verdict == ("FAIL" if factor > 1.015 else result.verdict)
        assert result.verdict != "PASS"
        assert any(Cause.TARGET_SCALE in text for text in result.failures + result.warnings)
        accepted = solve_hand_eye(A, scaled(B, size), eye_to_hand=eye_to_hand, free_scale=True)
        np.testing.assert_allclose(accepted.X, result.X, atol=1e-6)
        assert not accepted.failures


def test_a_right_target_size_is_believed():
    """Of six stations with the right size one at most is solved with another, and none fails; a given factor is obeyed."""
    results = [solve_hand_eye(*station(seed, 25)[:2]) for seed in range(6)]
    assert sum(r.scale_used != 1 for r in results) <= 1
    assert not any(r.failures for r in results)
    A, B, X = station(3, 25)
    obeyed = solve_hand_eye(A, scaled(B, 1.05), target_scale=1.0)
    assert obeyed.scale_used == 1
    assert obeyed.verdict == "WARN"
    assert apart(obeyed.X, X)[1] > 0.005
    assert apart(solve_hand_eye(A, scaled(B, 1.05), target_scale=1 / 1.05).X, X)[1] < 0.002


@pytest.mark.parametrize("jitter", [0.0, 1e-5])
def test_repeated_pairs_count_once(jitter):
    """Every pair three times, in any order, gives the error bar of every pair once; six pairs five times are six pairs."""
    A, B, X = station(5, 20)
    rng = np.random.default_rng(0)
    again = rng.permutation(np.repeat(np.arange(20), 3))
    shaken = np.stack([T @ exp(rng.normal(0, jitter, 6)) for T in B[again]])
    one, three = solve_hand_eye(A, B), solve_hand_eye(A[again], shaken)
    assert three.repeats == 40
    assert three.residual.shape == (60, 6)
    np.testing.assert_allclose(three.sigma, one.sigma, rtol=0.02)
    assert apart(three.X, one.X)[1] < 1e-4
    six = solve_hand_eye(np.repeat(A[:6], 5, axis=0), np.repeat(B[:6], 5, axis=0))
    assert apart(six.X, X)[1] < 3 * six.sigma[0]
    assert any("24 pairs repeat" in text for text in six.warnings)
    with pytest.raises(HandEyeRefused, match="got 2 and 8 that repeat them"):
        solve_hand_eye(np.repeat(A[:2], 5, axis=0), np.repeat(B[:2], 5, axis=0))


def test_the_optimum_is_certified():
    """The certificate covers the truth, grows with the noise, and says nothing about rotations that are not the best."""
    bounds = []
    for noise in (1e-4, 1e-3, 5e-3):
        A, B, X = station(9, 25, noise_rad=noise)
        result = solve_hand_eye(A, B)
        assert result.starts[0] == result.starts[1]
        assert apart(result.X, X)[0] < result.certified
        bounds.append(result.certified)
    assert bounds == sorted(bounds)
    assert bounds[-1] < np.radians(3)
    off = rotation_bound(A, B, result.X @ exp([0, 0, 0, 0.5, 0, 0]), result.Z, np.ones(25))
    assert off > np.radians(28)


@pytest.mark.parametrize("kind", ["Gaussian", "heavy tails"])
def test_error_bars_cover_the_truth(kind):
    """One sigma of each axis covers 60 to 80 % of 30 stations of 25 pairs, whatever the tails; two sigma more than 90 %."""
    ratios = []
    for seed in range(30):
        A, B, X = station(seed, 25, 0.0, 0.0)
        rng = np.random.default_rng(seed)
        tail = np.ones(25) if kind == "Gaussian" else np.sqrt(3 / rng.chisquare(3, 25))
        steps = tail[:, None] * rng.normal(0, [4e-4, 4e-4, 1e-3, 1.5e-3, 1.5e-3, 1.5e-3], (25, 6))
        B = np.stack(
            [
                transform(rotation_exp(s[3:]) @ b[:3, :3], b[:3, 3] + s[:3])
                for s, b in zip(steps, B, strict=True)
            ]
        )
        found = refined_from_consensus(A, B)
        off = np.r_[found.X[:3, 3] - X[:3, 3], rotation_log(found.X[:3, :3] @ X[:3, :3].T)]
        ratios.append(np.abs(off) / np.sqrt(np.diag(found.covariance)[:6]))
    assert 0.6 < np.mean(np.array(ratios) < 1) < 0.8
    assert np.mean(np.array(ratios) < 2) > 0.9


def test_result_is_json(tmp_path):
    """A result of three pairs, with nothing to leave out, is still valid JSON."""
    A, B, _ = station(8, 3)
    data = to_dict(solve_hand_eye(A, B))
    assert json.loads(json.dumps(data, allow_nan=False))["pairs"] == 3
    assert any("only 3 pairs" in text for text in data["warnings"])
