"""What numbers of poses may mean, and which meaning lets hand and target move rigidly together.

A rigid mount turns hand and camera by the same angle between any two pairs, and moves both equally far along the axis. The angles
are free of units, of inversion and of mirroring: they rank the rotations' readings. What the angles leave is decided by the
likelihood of the whole calibration, the units by the ratio that fits and by what arms and cameras measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from calibration.hand_eye.checks import Cause, HandEyeRefused, thinned
from calibration.hand_eye.closed_form import (
    SCALE,
    distances,
    linear_scale,
    residuals,
    rotation_vectors,
    scaled,
    shah,
)
from calibration.hand_eye.refine import Refined, refined_from_consensus
from tofcapture.errors import DataError, UsageError
from tofcapture.poses import Float64, invert_all

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
LONG = {"mm": "millimetres", "cm": "centimetres", "in": "inches", "m": "metres"}
RARE = {"m": 0.0, "mm": 0.0, "cm": 4.0, "in": 8.0}  # what a unit that no file names is held back by
SIZES = ((0.6, 0.8), (0.6, 0.7))  # hand and target: usual distance in m, and its spread as a logarithm
SLIDE = 0.2  # spread of the logarithm of the ratio of units
# Readings whose ratio is tried; misfit, as a share of the hand's spread, from which none is believed
RATIOS, UNFIT = 12, 0.3
UNSURE = 3.0  # between two choices of units, below which a person is told of the other
ANGLES = (
    "rotvec", "xyz", "ZYX", "XYZ", "zyx", "about-YXZ", "about-YZX", "about-XZY", "about-ZXY", "ZXY", "YXZ", "YZX", "XZY", "zxy", "yxz",
    "yzx", "xzy", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY", "zyz", "zxz", "xyx", "xzx", "yxy", "yzy",
)  # fmt: skip
FLIP = np.diag([1.0, 1.0, -1.0, 1.0])
SHOWN = 40  # pairs by which readings are ranked
# Times the best mismatch of the angles, plus CLOSE_RAD: readings that the likelihood is asked about
CLOSE = 2.0
CLOSE_RAD = 0.002
MOST = 64  # readings that are solved in closed form
RARER = 1.5
FINALISTS = 4
NATS = 10.0  # log-likelihood by which a reading must beat the usual one
ELSEWHERE = (0.002, 0.2)  # m, deg by which another reading must move the answer to matter


@dataclass(frozen=True)
class Readings:
    """Poses as a file may mean them: N translations, N rotations in numbers, and the names of what these may be, the usual first.

    Names: ``xyzw``, ``wxyz`` (quaternions), ``matrix``; ``rotvec deg``, ``ZYX rad`` and so on: Euler angles in the order of the
    letters, about the body's axes (capitals) or fixed ones; ``about-YXZ``: that order, but the numbers are about x, y, z.
    """

    xyz: Float64  #: (N, 3) in units of the file
    turn: Float64  #: (N, 4) quaternion, (N, 3) angles, or (N, 3, 3)
    names: tuple[str, ...]
    seconds: Float64 | None = None  #: (N,)
    unit: str = ""  #: Where the file names it: m, mm, cm, in
    told: bool = True  #: Whether the usual reading is more than a guess
    inverted: bool = False  #: Whether the file's poses are the inverse of what is asked for
    notes: tuple[str, ...] = ()  #: What else was found out about the file's form

    def __len__(self) -> int:
        return len(self.xyz)

    def rotations(self, name: str) -> Float64:
        """Rotations (N, 3, 3) under a reading."""
        from scipy.spatial.transform import Rotation

        kind, _, unit = name.removesuffix(" inverted").partition(" ")
        turn = np.radians(self.turn) if unit == "deg" else self.turn
        if kind == "matrix":
            R = self.turn
        elif kind in {"xyzw", "wxyz"}:
            R = Rotation.from_quat(turn if kind == "xyzw" else np.roll(turn, -1, axis=1)).as_matrix()
        elif kind == "rotvec":
            R = Rotation.from_rotvec(turn).as_matrix()
        else:
            order = kind.removeprefix("about-")
            columns = ["XYZ".index(a) for a in order] if kind != order else [0, 1, 2]
            with np.errstate(all="ignore"):
                R = Rotation.from_euler(order, turn[:, columns]).as_matrix()
        return np.swapaxes(R, 1, 2) if name.endswith(" inverted") else R

    def poses(self, name: str, unit: str) -> Float64:
        """Poses (N, 4, 4), metres, under a reading."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        out[:, :3, :3], out[:, :3, 3] = self.rotations(name), UNITS[unit] * self.xyz
        return invert_all(out) if self.inverted else out

    @property
    def usual(self) -> Float64:
        """(N, 4, 4) of the usual reading, metres if their size allows."""
        unit = self.unit or min(UNITS, key=lambda u: _size_cost(self, u, 0))
        return self.poses(self.names[0], unit)

    def take(self, chosen: NDArray[np.intp]) -> Readings:
        """Return the poses of these indices alone."""
        seconds = None if self.seconds is None else self.seconds[chosen]
        return replace(self, xyz=self.xyz[chosen], turn=self.turn[chosen], seconds=seconds)

    def narrowed(self, words: Sequence[str]) -> Readings:
        """Keep the readings that a user's words allow: a unit, deg or rad, quaternions' or Euler angles' order, ``inverted``."""
        units, rest = (
            [w for w in words if w in UNITS],
            [w for w in words if w not in UNITS and w != "inverted"],
        )
        names = tuple(n for n in self.names if set(rest) <= set(n.split()))
        if not names or len(units) > 1:
            raise UsageError(
                f"--read-as: expected words of {', '.join(UNITS)}, inverted, {', '.join(dict.fromkeys(' '.join(self.names).split()))}; "
                f"got {', '.join(words)}"
            )
        names = tuple(f"{n} inverted" for n in names) if "inverted" in words else names
        return replace(self, names=names, unit=units[0] if units else self.unit, told=self.told or bool(rest))


@dataclass(frozen=True)
class Meant:
    """The readings that were taken of N pairs."""

    hand: str
    target: str
    units: tuple[str, str]
    said: dict[
        str, str
    ]  #: What was decided or converted, in words, by side; empty for metres and the usual readings
    rivals: tuple[str, ...]  #: What fits nearly as well and gives another answer

    def report(self) -> dict[str, object]:
        """Return what a result says of it, as JSON types; empty where there is nothing to say."""
        found = {"read_as": self.said, "rivals": list(self.rivals)}
        return {k: v for k, v in found.items() if v}


def agreed(hand: Readings, target: Readings) -> tuple[Float64, Float64, Meant]:
    """Return the poses (N, 4, 4), metres, of hand and target under the readings that :func:`choose` takes, and these."""
    meant = choose(hand, target)
    return hand.poses(meant.hand, meant.units[0]), target.poses(meant.target, meant.units[1]), meant


def angle_names(turn: Float64, first: str) -> tuple[str, ...]:
    """Names of what three numbers (N, 3) may be, ``first`` before the others; degrees where no radians are as large."""
    largest = float(np.abs(turn).max(initial=0))
    units = (
        ["rad", "deg"] if largest < 2 * np.pi + 0.01 else ["deg", "rad"] if largest < 4 * np.pi else ["deg"]
    )
    order = sorted(ANGLES, key=lambda a: a != first)
    return tuple(f"{a} {u}" for u in units for a in order)


def choose(hand: Readings, target: Readings) -> Meant:
    """Rank all readings of N pairs and take the one that fits best, the usual one unless another is clearly better.

    :class:`HandEyeRefused` where the form of the numbers tells nothing and two readings that fit alike give different answers.
    """
    few = thinned(len(hand), SHOWN)
    hand, target = hand.take(few), target.take(few)
    usual = hand.names[0], target.names[0]
    pairs = _by_angles(hand, target)
    units, other = _units(hand, target, pairs)
    if other:
        raise HandEyeRefused(
            Cause.CONVENTION,
            f"lengths in {_lengths(units)} are as likely as in {_lengths(other)}",
            f"say which: --read-as hand={units[0]} --read-as target={units[1]}, or {other[0]} and {other[1]}",
        )
    tried = {names: _solved(*form) for names, form in _finalists(hand, target, pairs, units).items()}
    if len(few) < 4:
        tried = {usual: tried[usual]}
    likely = {names: f.log_likelihood if f else -np.inf for names, f in tried.items()}
    best = max(likely, key=lambda n: likely[n])
    names = best if likely[best] > likely[usual] + NATS else usual
    near = [
        n
        for n in likely
        if n != names and likely[n] > likely[names] - NATS and _differ(tried[n], tried[names])
    ]
    rivals = [_words(*n) for n in near]
    guessed = [n for n in near if not (hand.told and target.told)]
    if guessed:
        raise HandEyeRefused(
            Cause.CONVENTION,
            f"{_words(*names)} and {'; '.join(rivals)} fit alike, and give different answers",
            "say which with --read-as, such as --read-as hand=ZYX,deg, or turn the hand by larger angles",
        )
    said = {}
    for i, (who, readings) in enumerate((("hand", hand), ("target", target))):
        if words := _said(readings, names[i], units[i]):
            said[who] = words
            if names[i] != usual[i] and np.isfinite(likely[usual]):
                less = np.exp((likely[names] - likely[usual]) / (6 * len(few)))
                said[who] += f" ({less:.1f} times less noise than {_name(usual[i])})"
    return Meant(*names, units, said, tuple(rivals))


def _by_angles(hand: Readings, target: Readings) -> list[tuple[str, str]]:
    """Readings of both sides whose angles between the pairs agree best, best first; the usual one is always among them."""
    turns = [np.stack([_angles(side.rotations(n)) for n in side.names]) for side in (hand, target)]
    mismatch = np.stack([np.median(np.abs(turns[1] - one), axis=1) for one in turns[0]])
    limit = CLOSE * float(mismatch.min()) + CLOSE_RAD
    order = np.stack(np.unravel_index(np.argsort(mismatch, axis=None, kind="stable"), mismatch.shape), axis=1)
    close = [(hand.names[i], target.names[j]) for i, j in order if mismatch[i, j] <= limit]
    # Programs write both sides alike, or in their usual form: of readings that turn equally these are looked at first.
    first = [p for p in close if p[0] == p[1] or hand.names[0] == p[0] or target.names[0] == p[1]]
    return list(dict.fromkeys([*first[:MOST], *close[:MOST], (hand.names[0], target.names[0])]))[: 2 * MOST]


def _angles(R: Float64) -> Float64:
    i, j = np.triu_indices(len(R), 1)
    gap = np.linalg.norm(R[i] - R[j], axis=(1, 2))
    return np.asarray(2 * np.arcsin(np.minimum(gap / np.sqrt(8), 1)))


def _finalists(
    hand: Readings, target: Readings, pairs: list[tuple[str, str]], units: tuple[str, str]
) -> dict[tuple[str, str], tuple[Float64, Float64]]:
    """The usual reading and those that fit best in closed form, rotations inverted as well, each with the pairs of its best form.

    Forms are the two mounts, and one side mirrored: that is refused later, under its right name.
    """
    sides = [
        {n + end: side.poses(n + end, unit) for n in {p[i] for p in pairs} for end in _ends(n)}
        for i, (side, unit) in enumerate(zip((hand, target), units, strict=True))
    ]
    names = [(h + a, t + b) for h, t in pairs for a in _ends(h) for b in _ends(t)]
    A, B = (np.stack([side[n[i]] for n in names]) for i, side in enumerate(sides))
    forms = list(product((A, invert_all(A)), (B, FLIP @ B @ FLIP)))
    cost = np.stack([_misfit(P, seen) for P, seen in forms])
    # A reading that must be inverted or mirrored besides is the rarer one.
    rarer = np.array([RARER if "inverted" in h + t else 1.0 for h, t in names])
    cost *= rarer * np.array([1.0, RARER, 1.0, RARER])[:, None]
    order = [
        names.index((hand.names[0], target.names[0])),
        *np.argsort(cost.min(axis=0))[:FINALISTS].tolist(),
    ]
    best = cost.argmin(axis=0)
    return {names[k]: (forms[best[k]][0][k], forms[best[k]][1][k]) for k in order}


def _ends(name: str) -> tuple[str, ...]:
    return ("",) if name.endswith(" inverted") else ("", " inverted")


def _misfit(P: Float64, B: Float64) -> Float64:
    """Noise (K,) of the better half of K sets of pairs (K, N, 4, 4) in units of a fair station's."""
    metres, radians = distances(residuals(P, B, *shah(P, B)))
    return np.asarray(np.median(np.hypot(metres / SCALE[0], radians / SCALE[1]), axis=1))


def _solved(P: Float64, B: Float64) -> Refined | None:
    """Calibrate pairs (N, 4, 4) of one reading; None where no solution exists."""
    try:
        found = refined_from_consensus(P, B)
    except (DataError, np.linalg.LinAlgError, ValueError):
        return None
    return found if np.isfinite(found.log_likelihood) else None


def _differ(one: Refined | None, other: Refined | None) -> bool:
    if one is None or other is None:
        return False
    metres = float(np.linalg.norm(one.X[:3, 3] - other.X[:3, 3]))
    turned = rotation_vectors((one.X[:3, :3] @ other.X[:3, :3].T)[None])
    return metres > ELSEWHERE[0] or float(np.linalg.norm(turned)) > np.radians(ELSEWHERE[1])


def _units(
    hand: Readings, target: Readings, pairs: list[tuple[str, str]]
) -> tuple[tuple[str, str], tuple[str, str] | None]:
    """Units of both sides by the ratio that fits and by the sizes of arms and views; also others that are nearly as likely."""
    ratio = _ratio(hand, target, pairs)
    choices = list(product([hand.unit] if hand.unit else UNITS, [target.unit] if target.unit else UNITS))
    cost = {}
    for one, two in choices:
        off = np.log(max(ratio * UNITS[one] / UNITS[two], 1e-9)) / SLIDE if np.isfinite(ratio) else 0.0
        cost[one, two] = min(off**2, 60.0) + _size_cost(hand, one, 0) + _size_cost(target, two, 1)
        cost[one, two] -= RARE[one] if one == two else 0.0  # one unit for both is one rarity
    ranked = sorted(choices, key=lambda c: cost[c])
    doubtful = len(ranked) > 1 and cost[ranked[1]] - cost[ranked[0]] < UNSURE
    return ranked[0], ranked[1] if doubtful else None


def _ratio(hand: Readings, target: Readings, pairs: list[tuple[str, str]]) -> float:
    """Find how many units of the hand a unit of the target is, under the reading and mount that fit best; NaN where none fits."""
    ratio, best = (
        np.nan,
        UNFIT * float(np.median(np.linalg.norm(hand.xyz - np.median(hand.xyz, axis=0), axis=1))),
    )
    tried = [(one + a, two + b) for one, two in pairs[:RATIOS] for a in _ends(one) for b in _ends(two)]
    for h, t in tried:
        A, B = hand.poses(h, "m"), target.poses(t, "m")
        for P in (A, invert_all(A)):
            factor = linear_scale(P, B, shah(P, B)[0][:3, :3])
            if factor <= 0:
                continue
            seen = scaled(B, factor)
            misfit = float(np.median(distances(residuals(P, seen, *shah(P, seen)))[0]))
            ratio, best = (factor, misfit) if misfit < best else (ratio, best)
    return ratio


def _size_cost(readings: Readings, unit: str, side: int) -> float:
    size, spread = SIZES[side]
    far = max(float(np.median(np.linalg.norm(readings.xyz, axis=1))) * UNITS[unit], 1e-9)
    return float((np.log(far / size) / spread) ** 2) + (0.0 if readings.unit else RARE[unit])


def _lengths(units: tuple[str, str]) -> str:
    return f"{LONG[units[0]]} (hand) and {LONG[units[1]]} (target)"


def _words(hand: str, target: str) -> str:
    return f"hand as {_name(hand)}, target as {_name(target)}"


def _name(name: str) -> str:
    kind, _, unit = name.removesuffix(" inverted").partition(" ")
    said = {
        "xyzw": "quaternions xyzw",
        "wxyz": "quaternions wxyz",
        "matrix": "matrices",
        "rotvec": "rotation vectors",
    }.get(kind)
    if said is None:
        order = kind.removeprefix("about-")
        said = f"Euler angles {order}, {'fixed axes' if order.islower() else 'turning axes'}"
        said += "" if kind == order else ", given about x, y, z"
    said += ", degrees" if unit == "deg" else ""
    return said + (", rotations inverted (JPL or transposed)" if name.endswith(" inverted") else "")


def _said(readings: Readings, name: str, unit: str) -> str:
    plain = name in {"xyzw", "matrix"} or (name == "rotvec rad" and readings.told)
    words = [] if plain else [_name(name)]
    words += [LONG[unit]] if unit != "m" else []
    words += ["inverted, as was told"] if readings.inverted else []
    words += readings.notes
    return ", ".join(words)
