"""Which views to take of a scene: spread over directions and distances, reachable, clear of everything, seen by both cameras.

A UR arm reaches far fewer views than one expects. The plan tries thousands of candidates and keeps those that are clear, at
the goal and on the straight way from home, and from which both cameras see enough of an object (``record.sight``). It picks
from them by greedy farthest-point sampling over direction and distance: 10 views are the first 10 of 25, so a recording can
be extended. With a view come other places, for an object of which it shows too little. A person may turn the object.

Each view is held as its way from home and back allows: by the clearance model with room to spare, and by the checks of the arm
itself. So the way by home is always there, and :func:`prove` shows it before anything moves.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.clearance import REASONS, Check, Workcell, is_clear, obstacles, route, workcell_of
from tofcapture.devices.kinematics import ArmModel, forward, inverse_all, wrap
from tofcapture.devices.station import Station
from tofcapture.errors import ConfigError, MotionRefused
from tofcapture.files.view import check_scene_name
from tofcapture.frames import CALIBRATION
from tofcapture.poses import Float64, invert, look_at, rotate_vectors, rotation_exp, transform
from tofcapture.record import sight
from tofcapture.rig import Rig

Bools = NDArray[np.bool_]

REMEDIES = {
    "reach": (
        "beyond the arm's reach",
        "put the object nearer to the arm, or use a larger arm ([plan] target)",
    ),
    "table": ("too near to the table", "raise the object, or lower the table ([plan] table)"),
    "object": (
        "inside the object's keep-out",
        "make the keep-out as small as the object allows ([plan] keep_out_*)",
    ),
    "base": ("too near to the arm's base", "move the object away from the base ([plan] target)"),
    "self": ("where the arm would meet itself", "choose another home ([plan] home)"),
    "mixed": (
        "where each way to hold the arm meets something",
        "make room: table, keep-out and base together",
    ),
    "sight": (
        "where both cameras together see too little of an object",
        "aim them at one point, 0.5 m away; see stereo_box and target of [plan]",
    ),
    "way from home": (
        "not to be reached from home in a straight way that the arm's own checks allow",
        "choose another home ([plan] home); see workspace, keep_out and max_step_deg of [arm]",
    ),
}
"""Why a candidate is no view, in words, and what would help."""
REFUSALS = tuple(REMEDIES)  # the number of a refusal is its place here
_WRIST_WEIGHTS = (0.5, 0.5, 0.25)  # of the last three joints in "close to home"; 1 for those that carry them
_LOG_DISTANCE = 0.6  # rad per e-fold of distance: how much a nearer view counts against a turned one
_FEW = 24  # candidates that each pick of the sampling chooses among
_MOST_TURNS = 36
_PLENTY = 5 * _FEW  # candidates from which on a view's other places are none of the views to come
_WORTH = 0.95  # of what the best candidates show of an object: less is no view
_SPARES = 2  # other places of a view at most
_FARTHER = _LOG_DISTANCE * float(np.log(1.4))  # one of a view's other places is that much farther away
_ALIKE = 0.03  # of an object; rolls that show as much are chosen among by their nearness to home
# m; more room than the checks before a motion ask for: an arm arrives within 0.02 deg, not exactly
_AIR = 0.005


@dataclass(frozen=True)
class PlannedView:
    """One view to take; lengths in metres, angles in radians."""

    index: int  # rank in the sampling, not in the order of travel
    joints: Float64  # (J,) goal
    T_base_flange: Float64  # (4, 4) nominal pose there
    distance: float  # from the ToF camera to the target; NaN, as the next, where a person chooses the place
    direction: Float64  # (3,) unit, from the target to the camera, base frame
    turn: float = 0.0  # of the object about the vertical, counter-clockwise seen from above
    coverage: float = float(
        "nan"
    )  # share of an object that is expected to have good ground truth; NaN: nobody asked
    # The same view from elsewhere, should too little of the object be seen from here.
    spare: PlannedView | None = None

    @property
    def digest(self) -> str:
        """Name the pose of arm and object: a view of another digest is another view."""
        numbers = np.append(self.joints, self.turn) if self.turn else self.joints
        if np.isnan(self.joints).all():
            numbers = np.array([self.index, self.turn])  # the place is whoever's choice
        return hashlib.sha256((np.round(numbers, 6) + 0.0).tobytes()).hexdigest()[:16]

    @property
    def places(self) -> list[str]:
        """Digests of the poses that it may be recorded at, the planned one first."""
        return [self.digest, *(self.spare.places if self.spare else ())]

    def as_json(self) -> dict[str, Any]:
        """Write the view as JSON types."""
        turned = {"index": self.index, "turn_deg": round(float(np.degrees(self.turn)), 6)}
        if np.isnan(self.joints).all():
            return turned
        place = {"distance": self.distance, "direction": self.direction.tolist()}
        seen = {"coverage": round(self.coverage, 3)} if np.isfinite(self.coverage) else {}
        spare = {"spare": self.spare.as_json()} if self.spare else {}
        return {**turned, "joints": self.joints.tolist(), **place, **seen, **spare}


@dataclass(frozen=True)
class Tried:
    """Hold what became of the candidates."""

    spots: Float64  # (C, 3) where the ToF camera would stand, base frame, metres
    refusal: NDArray[np.int8]  # (C,) index into REFUSALS, -1 where nothing stands against it


@dataclass(frozen=True)
class Plan:
    """Views in the order of travel, and why there are not more."""

    views: tuple[PlannedView, ...]
    wanted: int  # how many views were asked for
    candidates: int  # how many were tried
    refused: dict[str, int]  # candidates by refusal; "way from home" counts those that sampling came upon
    tried: Tried | None = field(default=None, repr=False, compare=False)

    @property
    def digest(self) -> str:
        """Name the whole plan, whatever the order of travel."""
        ordered = sorted(self.views, key=lambda v: v.index)
        return hashlib.sha256("".join(v.digest for v in ordered).encode()).hexdigest()[:16]

    def summary(self) -> str:
        """Say in one line how many views there are, and what stood against the other candidates."""
        refused = ", ".join(f"{count} {reason}" for reason, count in self.refused.items() if count)
        shares = [view.coverage for view in self.views if np.isfinite(view.coverage)]
        seen = f" that show {min(shares):.0%} to {max(shares):.0%} of an object" if shares else ""
        return f"{len(self.views)} of {self.wanted} views{seen}; {self.candidates} candidates, refused: {refused or 'none'}"

    def shortfall(self) -> list[str]:
        """Say why there are fewer views than wanted, the commonest reason first; nothing when there are enough."""
        if len(self.views) >= self.wanted:
            return []
        counts = sorted(((n, reason) for reason, n in self.refused.items() if n), reverse=True)
        lines = [
            f"only {len(self.views)} of {self.wanted} views can be taken, of {self.candidates} candidates"
        ]
        lines += [f"  {n} are {REMEDIES[reason][0]}: {REMEDIES[reason][1]}" for n, reason in counts]
        return [*lines, "  or have the object turned between views: --turns 4"]

    def as_json(self) -> dict[str, Any]:
        """Write the plan as JSON types."""
        views = [view.as_json() for view in self.views]
        numbers = {"wanted": self.wanted, "candidates": self.candidates, "refused": self.refused}
        return {"digest": self.digest, **numbers, "views": views}


def plan_scene(station: Station, scene: str, views: int, turns: int = 1) -> Plan:
    """Plan the views of a scene on a station: its arm, its rig, its ``[plan]``, its seed.

    Raises :class:`ConfigError`: the name is no safe file name, no view is wanted, the board shall be turned, or not one view can be reached.
    """
    check_scene_name(scene)
    if views < 1:
        raise ConfigError(f"views: expected at least 1, got {views}")
    board = scene == CALIBRATION
    if not 1 <= turns <= (1 if board else _MOST_TURNS):
        limit = "the board stays as it stands" if board else f"expected 1 to {_MOST_TURNS}"
        raise ConfigError(f"turns: {limit}, got {turns}")
    if station.arm.by_hand:
        return _by_hand(views, turns, fixed=station.arm.fixed)
    workcell, model = workcell_of(station.config), station.arm.kinematics()
    if len(workcell.home) != model.joints:
        raise ConfigError(
            f"[plan] home: expected {model.joints} angles of the {model.name}, got {len(workcell.home)}",
            hint="home = [...] in radians, from which every view is reached",
        )
    digest = hashlib.sha256(f"plan|{station.seed}|{scene}".encode()).digest()
    plan = plan_views(
        model,
        station.rig,
        workcell,
        workcell.board if board else workcell.target,
        board_sampling(workcell) if board else object_sampling(),
        views,
        np.random.default_rng(np.frombuffer(digest, dtype="<u4").tolist()),
        turns,
        station.arm.check_move,
    )
    if not plan.views:
        raise ConfigError(
            f"no view of {scene!r} can be taken: {plan.summary()}",
            hint="move the target, see [plan] of the station",
        )
    return plan


def _by_hand(views: int, turns: int, *, fixed: bool) -> Plan:
    """Plan views whose places a person chooses; a tripod has one, and so one view for each way in which the object stands."""
    count = min(views, turns) if fixed else views
    nowhere, none = np.full(6, np.nan), np.full(3, np.nan)
    angles = [2 * np.pi * (i * turns // count) / turns for i in range(count)]
    planned = [PlannedView(i, nowhere, np.eye(4), np.nan, none, angle) for i, angle in enumerate(angles)]
    return Plan(tuple(planned), views, count, {})


def prove(station: Station, plan: Plan) -> list[list[Float64]]:
    """Go through a plan in thought, from where the arm stands to home, and check every leg as the arm will.

    Returns the goals (J,) of each view's way, and of the way home after the last one.

    Raises :class:`MotionRefused`: a leg is refused; the message names its view.
    """
    workcell, model, here = workcell_of(station.config), station.arm.kinematics(), station.arm.state().joints
    ways = []
    for name, goal in [*((f"view {v.index}", v.joints) for v in plan.views), ("the way home", workcell.home)]:
        try:
            ways.append(route(model, station.rig, workcell, here, goal, station.arm.check_move))
        except MotionRefused as err:
            raise MotionRefused(f"{name}: {err.message}", hint=err.hint) from err
        here = goal
    return ways


def plan_views(
    model: ArmModel,
    rig: Rig,
    workcell: Workcell,
    target: Float64,
    sampling: Sampling,
    views: int,
    rng: np.random.Generator,
    turns: int = 1,
    check: Check | None = None,
) -> Plan:
    """Plan views of a target (3,), base frame, metres; fewer than wanted where the arm reaches no more.

    The same generator gives the same plan. With ``turns`` the object stands in so many ways, a full turn divided by this
    apart; views of one turn follow each other. ``check`` is the arm's own of a motion; see ``Arm.check_move``.
    """
    directions, distances = candidates(sampling, rng)
    T_base_flange = flange_poses(rig, workcell, target, sampling, directions, distances, rng)
    holds, refusal, shares = hold_poses(model, rig, workcell, T_base_flange, both=sampling.both)
    count = len(refusal)
    angles = 2 * np.pi * np.arange(turns) / turns
    seen = np.concatenate([rotate_vectors(_about_vertical(-angle), directions) for angle in angles])
    features = np.column_stack([seen, _LOG_DISTANCE * np.log(np.tile(distances, turns))])
    if sampling.lean:
        lean = sampling.lean * leans(rig, sampling.axis, T_base_flange[:, 0])
        features = np.column_stack([features, np.tile(lean, (turns, 1))])
    held: dict[int, tuple[Float64, float] | None] = {}

    def accept(k: int) -> bool:
        c = k % count
        if c not in held:
            held[c] = next((h for h in holds(c) if _from_home(model, rig, workcell, h[0], check)), None)
            if held[c] is None:
                refusal[c] = REFUSALS.index("way from home")
        return held[c] is not None

    def view(i: int, k: int, spare: PlannedView | None = None) -> PlannedView:
        c, angle = k % count, float(angles[k // count])
        hold = held[c]
        assert hold is not None
        q, share = hold
        place = float(distances[c]), directions[c], angle
        return PlannedView(i, q, forward(model, q), *place, share, spare)

    most = np.tile(shares, turns) if sampling.both else None
    planned = []
    for i, (k, others) in enumerate(_spread(features, np.tile(refusal < 0, turns), views, accept, rng, most)):
        spare = None
        for other in reversed(others):
            # It belongs to the same turn of the object.
            spare = view(i, k - k % count + other % count, spare)
        planned.append(view(i, k, spare))
    refused = {reason: int((refusal == i).sum()) for i, reason in enumerate(REFUSALS)}
    tried = Tried(target + distances[:, None] * directions, refusal)
    return Plan(tuple(_by_travel(planned, workcell.home)), views, count, refused, tried)


def _from_home(model: ArmModel, rig: Rig, workcell: Workcell, joints: Float64, check: Check | None) -> bool:
    """Tell whether the arm goes from home to joints (J,) and back in a straight way."""
    if not is_clear(model, rig, workcell, workcell.home, joints, _AIR):
        return False
    try:
        if check is not None:
            check(workcell.home, joints)
            check(joints, workcell.home)
    except MotionRefused:
        return False
    return True


@dataclass(frozen=True)
class Sampling:
    """Tell where candidates lie; lengths in metres, angles in radians."""

    axis: Float64  # (3,) direction from the target about which views are spread
    tilt: tuple[float, float] = (0.0, float(np.radians(65.0)))  # smallest and largest angle to the axis
    distances: tuple[float, ...] = (0.35, 0.43, 0.53, 0.65, 0.80, 0.98, 1.18, 1.38)
    aim: float = 0.02  # how far from the target the camera may look
    directions: int = 400
    rolls: int = 4  # the one nearest to home is kept
    lean: float = 0.0  # how much it counts that the axis leans in another direction of the image
    both: bool = False  # aim both cameras, and keep the views that show enough of an object to both


def object_sampling() -> Sampling:
    """Sample all around the vertical, 0.35 to 1.5 m away."""
    return Sampling(axis=np.array([0.0, 0.0, 1.0]), both=True)


def board_sampling(workcell: Workcell) -> Sampling:
    """Sample tilts of 15 to 40 deg to the board's normal in all directions, 0.5 to 1 m away.

    Each candidate has one random roll. The roll nearest to home would lean the board the same way in most images.
    """
    tilt, distances = (float(np.radians(15.0)), float(np.radians(40.0))), (0.5, 0.6, 0.72, 0.85, 1.0)
    return Sampling(workcell.board_normal, tilt, distances, aim=0.04, directions=240, rolls=1, lean=0.5)


def candidates(sampling: Sampling, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Spread directions (C, 3) on a Fibonacci spiral, each at all distances (C,), jittered by up to 8 %."""
    n = sampling.directions
    low, high = np.cos(sampling.tilt[0]), np.cos(sampling.tilt[1])
    cosine = low + (high - low) * (np.arange(n) + 0.5) / n
    sine = np.sqrt(1 - cosine**2)
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(n) + rng.uniform(0, 2 * np.pi)
    local = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)
    about_axis = look_at(np.zeros(3), sampling.axis)
    directions = np.repeat(rotate_vectors(about_axis, local), len(sampling.distances), axis=0)
    distances = np.tile(sampling.distances, n) * rng.uniform(1.0, 1.08, n * len(sampling.distances))
    return directions, distances


def flange_poses(
    rig: Rig,
    workcell: Workcell,
    target: Float64,
    sampling: Sampling,
    directions: Float64,
    distances: Float64,
    rng: np.random.Generator,
) -> Float64:
    """Find flange poses (C, rolls, 4, 4) from which the ToF camera looks at the target, or the line between both cameras.

    From afar they look at the foot of what stands there: from aside, the table in the image's middle lies behind it.
    """
    spots = target + rng.uniform(-sampling.aim, sampling.aim, directions.shape)
    if sampling.both:
        spots[:, 2] -= (target[2] - workcell.table) * (1 - distances.min() / distances)
    rolls = 2 * np.pi * (np.arange(sampling.rolls) / sampling.rolls)
    rolls = rolls + rng.uniform(0, 2 * np.pi, (len(spots), 1))
    cameras = np.stack(
        [look_at(spot + r * u, spot) for spot, r, u in zip(spots, distances, directions, strict=True)]
    )
    c, s = np.cos(rolls), np.sin(rolls)
    turns = np.broadcast_to(np.eye(4), (*rolls.shape, 4, 4)).copy()
    turns[..., 0, 0], turns[..., 0, 1], turns[..., 1, 0], turns[..., 1, 1] = c, -s, s, c
    aimed = cameras[:, None] @ turns
    if sampling.both:
        aimed = aimed @ np.stack([_between(rig, workcell, distance) for distance in distances])[:, None]
    return aimed @ invert(rig.T_flange_tof)


def _between(rig: Rig, workcell: Workcell, distance: float) -> Float64:
    """(4, 4) turn of the ToF camera by which what lay on its axis comes to lie between it and the stereo camera's."""
    baseline = 2 * float(workcell.stereo_box[:, 0].mean())
    other = (rig.T_tof_stereo @ [baseline / 2, 0.0, distance, 1.0])[:3]
    middle = (other / max(other[2], 1e-6) * distance + [0.0, 0.0, distance]) / 2
    axis = np.array([middle[1], -middle[0], 0.0])  # middle x z
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, middle[2])
    return transform(rotation_exp(axis / max(sine, 1e-12) * angle), np.zeros(3))


def leans(rig: Rig, axis: Float64, T_base_flange: Float64) -> Float64:
    """Find unit directions (C, 2) in which the axis leans in the ToF image."""
    T_base_tof = T_base_flange @ rig.T_flange_tof
    lean = np.swapaxes(T_base_tof[:, :3, :2], 1, 2) @ axis
    out: Float64 = lean / np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
    return out


def hold_poses(
    model: ArmModel, rig: Rig, workcell: Workcell, T_base_flange: Float64, *, both: bool
) -> tuple[Callable[[int], list[tuple[Float64, float]]], NDArray[np.int8], Float64]:
    """Find joints that hold flange poses (C, rolls, 4, 4) and meet nothing, each joint turned as near to home as it can be.

    Returns a function that gives those of one candidate, (J,) with the share of an object that they show: the most first, of
    alike ones the nearest to home. With it come refusals (C,): indices into :data:`REFUSALS` of what stood in the way, -1 for
    nothing; and the largest shares (C,). Unless ``both`` cameras matter, shares are NaN and refuse nothing.
    """
    count, rolls = T_base_flange.shape[:2]
    q = workcell.home + wrap(inverse_all(model, T_base_flange, workcell.home) - workcell.home)
    # A joint that may not turn that far may still turn the other way round.
    q = np.where(q > model.high, q - 2 * np.pi, np.where(q < model.low, q + 2 * np.pi, q))
    q = q.reshape(count, rolls, -1, model.joints)
    reached: Bools = np.all((q >= model.low) & (q <= model.high), axis=-1)  # NaN is not
    hits = np.zeros((*reached.shape, len(REASONS)), dtype=bool)
    hits[reached] = obstacles(model, rig, workcell, q[reached], _AIR)
    clear: Bools = reached & ~np.any(hits, axis=-1)
    refusal = _refusals(reached.reshape(count, -1), hits.reshape(count, -1, len(REASONS)), clear)
    share = np.full(clear.shape, np.nan)
    if both:
        clear[clear] = ~sight.blocked(model, rig, workcell, q[clear])
        some = clear.any(axis=-1)
        share[some] = sight.expected(rig, workcell, T_base_flange[some])[:, None]
        least = _WORTH * float(np.percentile(share[clear], 95)) if clear.any() else 0.0
        clear &= share >= least
        refusal[(refusal < 0) & ~clear.any(axis=(1, 2))] = REFUSALS.index("sight")
    most = np.where(clear, share, 0.0).max(axis=(1, 2))
    behind = np.floor((most[:, None, None] - np.nan_to_num(share)) / _ALIKE) if both else 0.0
    weights = np.append(np.ones(model.joints - 3), _WRIST_WEIGHTS)
    away = (weights * np.nan_to_num(q - workcell.home) ** 2).sum(axis=-1)
    cost = np.where(clear, away + 1e3 * behind, np.inf).reshape(count, -1)

    def holds(candidate: int) -> list[tuple[Float64, float]]:
        order = np.argsort(cost[candidate], kind="stable")[: int(clear[candidate].sum())]
        # Rounded to a millionth, goals are the same on machines whose last bits differ.
        goals, shown = np.round(q[candidate].reshape(-1, model.joints), 6), share[candidate].reshape(-1)
        return [(goals[n], float(shown[n])) for n in order]

    return holds, refusal, most


def _refusals(reached: Bools, hits: Bools, clear: Bools) -> NDArray[np.int8]:
    """Name for each candidate without a clear solution the first obstacle of all its solutions, else ``mixed``."""
    lost = ~clear.any(axis=(1, 2))
    out = np.where(reached.any(axis=1), -1, REFUSALS.index("reach")).astype(np.int8)
    left = lost & reached.any(axis=1)
    for i, reason in enumerate(REASONS):
        always = left & (hits[..., i] | ~reached).all(axis=1)
        out[always] = REFUSALS.index(reason)
        left &= ~always
    out[left] = REFUSALS.index("mixed")
    return out


def _about_vertical(angle: float) -> Float64:
    """(4, 4) turn about the base's z."""
    out = np.eye(4)
    out[0, 0] = out[1, 1] = np.cos(angle)
    out[1, 0] = np.sin(angle)
    out[0, 1] = -out[1, 0]
    return out


def _spread(
    features: Float64,
    usable: Bools,
    views: int,
    accept: Callable[[int], bool],
    rng: np.random.Generator,
    shares: Float64 | None,
) -> list[tuple[int, list[int]]]:
    """Pick by farthest-point sampling: greedy, so that fewer views are a prefix of more.

    Every pick is the farthest of a few random candidates (Mitchell's best candidate). The farthest of all would put nearly
    every view on the rim of what the arm reaches. Where ``shares`` (C,) tell what candidates show, two others of
    the farther half of those few come with it: that which shows most from a larger distance, and the most different one.
    """
    left = np.flatnonzero(usable)
    gap = np.full(len(features), np.inf)
    chosen: list[tuple[int, list[int]]] = []
    while len(left) and len(chosen) < views:
        few = rng.choice(left, size=min(_FEW, len(left)), replace=False)
        few = few[np.argsort(-gap[few], kind="stable")]
        k = int(few[0])
        left = left[left != k]
        if not accept(k):
            continue
        others: list[int] = []
        if shares is not None:
            half = few[1 : _FEW // 2]
            half = half[np.argsort(-shares[half], kind="stable")]
            # What is too large for the images is seen whole from farther away.
            farther = features[half, 3] > features[k, 3] + _FARTHER
            others = list(islice((int(n) for n in half[farther] if accept(int(n))), 1))
            # What one side hides, another shows.
            apart = np.linalg.norm(features[half] - features[k], axis=1)
            rest = [int(n) for n in half[np.argsort(-apart, kind="stable")] if n not in others]
            others += islice((n for n in rest if accept(n)), _SPARES - len(others))
            # Of few candidates none can be spared.
            if len(left) > _PLENTY:
                left = left[~np.isin(left, others)]
        chosen.append((k, others))
        gap = np.minimum(gap, np.linalg.norm(features - features[k], axis=1))
    return chosen


def _by_travel(views: Sequence[PlannedView], home: Float64) -> list[PlannedView]:
    """Order by turn of the object, then by the nearest neighbour, that is the least turn of the joint with the longest way, from home."""
    left, here, out = list(views), home, []
    while left:
        turn = min(v.turn for v in left)
        costs = [float(np.abs(v.joints - here).max()) if v.turn == turn else np.inf for v in left]
        out.append(left.pop(int(np.argmin(costs))))
        here = out[-1].joints
    return out
