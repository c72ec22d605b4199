"""Tell whether a view is any good, while the rig still stands there and another try can mend it.

Every check is one number and a limit (:data:`LIMITS`). What is done about it depends on what a second try can do:

``note``
    A second try would show the same (a dark object, a mirror): the view is kept, the note goes into its file.
``retake``
    A disturbance that may have passed (a lamp, a lost frame): taken again, three times in all, then kept with the note.
``refuse``
    The data are not of this pose, or not there: taken again, three times in all, then the view is given up.
``elsewhere``
    The object hides too much from here: taken from the view's other places as well, until one is good; the best is kept.

Of board views it also says what they cover so far, told from the arm's poses and where the station says the board is. Nothing is
detected; ``tofcapture calibrate coverage`` says more afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import SPEED_OF_LIGHT, frequencies, mismatch, unambiguous
from tofcapture.frames import ArmState, StereoFrame, TofBurst, TofInfo
from tofcapture.meshes import inside
from tofcapture.ops.phase import Complex128, Decoder, mean_phasors
from tofcapture.poses import Float64, invert, rotation_angle, transform, transform_points
from tofcapture.record.sight import covered
from tofcapture.rig import Rig

NOTE, RETAKE, REFUSE, ELSEWHERE = "note", "retake", "refuse", "elsewhere"

DARK = 10.0  # raw units; the mean of ten frames knows the range of such a pixel to some 20 mm
_CELLS = (18, 24)  # of the ToF image, in which overlap is counted
_COLUMNS = 640  # of the stereo grid are enough for that, and for surfaces that it sees from aside
_BLOCK = 20  # px; side of the blocks whose means are compared between frames
_CLOCKS = 50_000_000  # ns; how far a device's idea of the host's clock may be off
_FAR, _NEAR = (
    0.1,
    0.03,
)  # m; median distance from the stereo camera's depths that no rig off by a drawing explains, and one of sound depths
_BRIGHT = 50.0  # raw units; noise plays no part in how taps fit each other, and the other camera
_FEW = 500  # bright pixels, or points that both cameras see, below which nothing is said of that
# rad; better than that multipath and edges let no phase agree with the stereo camera's distances
_SPREAD = 0.05
_FAINT = 50.0  # raw units; changes of fainter blocks are told in parts of this


@dataclass(frozen=True)
class Limit:
    """Largest good value of a number of a view, or smallest where ``least``.

    ``action`` is ``note``, ``retake``, ``refuse`` or ``elsewhere``. ``words`` say what is wrong, with the number as ``{0}``, ``hint`` what
    to do about it. ``name`` is the number's key, in the file too.
    """

    name: str
    value: float
    action: str
    words: str
    hint: str
    least: bool = False

    def broken_by(self, number: float) -> bool:
        """Tell whether a number is on the wrong side; NaN is not."""
        return number < self.value if self.least else number > self.value

    def sentence(self, numbers: dict[str, float]) -> str:
        """Say what is wrong with a view of these numbers."""
        return self.words.format(numbers[self.name], **numbers)


_SETTLE = "let it settle longer; look for vibration"
_LINK = "look at the link and the load of this machine"
_BUFFERS = "the camera hands out old buffers: open the station anew"
_PROJECTOR = "is its projector on, and the scene within its range?"
_RANGE = "is the rig right, and the distance within the stereo camera's range?"
_DULL = "lengthen the exposure, come nearer, or leave such objects out"
_ORDER = (
    "frequencies swapped, or phases in another order or sign: tofcapture calibrate phase-order finds them"
)
_OFFSET = "nobody calibrated it: tofcapture calibrate range, once there are views of the board"
_REACH = "come nearer, state the camera's reach, or use one more or a lower frequency"
# fmt: off
LIMITS = (
    Limit("motion_m", 0.2e-3, REFUSE, "the arm moved by {0:.2g} m during the exposures", _SETTLE),
    Limit("motion_deg", 0.02, REFUSE, "the arm moved by {0:.2g} deg during the exposures", _SETTLE),
    Limit("missing_frames", 0, REFUSE, "{0:.0f} frames of the burst are missing", _LINK),
    Limit("stale_frames", 0, REFUSE, "{0:.0f} frames are older than the pose, out of order or repeated", _BUFFERS),
    Limit("unlit", 0.98, REFUSE, "{0:.0%} of the ToF image got no light back", "is the illumination on, the lens cap off?"),
    Limit("stereo_coverage", 0.02, REFUSE, "the stereo camera measured {0:.1%} of its image", _PROJECTOR, least=True),
    Limit("misfit", 0.25, REFUSE, "the taps fit no cosine of the phases that the driver states: {0:.0%} of the amplitude is left over", _ORDER),
    Limit("misread", 2.0, REFUSE, "the phases fit the stereo camera's depths {0:.1f} times better with other frequencies or signs", _ORDER),
    Limit("exchanged", 3.0, REFUSE, "with its frequencies exchanged the ToF camera is {0:.0f} times nearer to the stereo camera's depths", _ORDER),
    Limit("out_of_reach", 0.5, REFUSE, "{0:.0%} of the scene lies where the ToF frequencies cannot tell its distance", _REACH),
    Limit("frame_drops", 0, RETAKE, "{0:.0f} frames were dropped within the burst", _LINK),
    Limit("flicker", 0.03, RETAKE, "the light changed by {0:.1%} between the frames", "keep people and lamps out of sight; shade the sun"),
    Limit("object_coverage", 0.70, ELSEWHERE, "both cameras see {0:.0%} of the object well", "come nearer, or see it more from aside", least=True),
    Limit("saturated", 0.05, NOTE, "{0:.0%} of the ToF pixels are saturated", "shorten the exposure; dull what shines"),
    Limit("offset", 0.08, NOTE, "the frequencies' ranges differ by {offset_m:.3f} m, {0:.0%} of what another wrap makes", _OFFSET),
    Limit("dark", 0.5, NOTE, "{0:.0%} of the ToF pixels are too dark for 20 mm", _DULL),
    Limit("overlap", 0.3, NOTE, "the stereo camera covers {0:.0%} of the ToF image", _RANGE, least=True),
)
# fmt: on


def measure(
    tof: TofBurst,
    stereo: StereoFrame,
    before: ArmState,
    after: ArmState,
    rig: Rig,
    frames: int,
    *,
    table: bool = False,
) -> dict[str, float]:
    """Find the number of each of :data:`LIMITS`, by name, and ``offset_m``.

    There is ``flicker`` only of three frames or more, and ``object_coverage`` only where an object stands on a ``table``.
    ``before`` and ``after`` are the arm's states before the first and after the last exposure, ``rig`` counts the overlap,
    ``frames`` ToF frames were asked for.
    """
    info = tof.info
    phasor = mean_phasors(tof.raw, info.modulation_hz, info.phase_rad, offset=info.offset)
    amplitude = np.abs(phasor).min(axis=0)
    shift, turn = moved(before.T_base_flange, after.T_base_flange)
    dark = float((amplitude < DARK).mean())
    times = np.asarray(tof.time_ns, dtype=np.int64)
    points, pixels = _in_tof_image(stereo, rig)
    depth, decoded = _decoded(tof, points, pixels, rig)
    found = {
        "motion_m": shift,
        "motion_deg": float(np.degrees(turn)),
        "missing_frames": float(max(frames - len(tof.raw), 0)),
        "stale_frames": float(_stale(tof, before.time_ns) + (stereo.time_ns < before.time_ns - _CLOCKS)),
        "frame_drops": float(_drops(times)),
        "saturated": float(info.saturated(tof.raw).any(axis=(0, 1)).mean()),
        "dark": dark,
        "unlit": dark,
        "stereo_coverage": float(np.isfinite(stereo.points[..., 2]).mean()),
        "overlap": _overlap(pixels, rig.tof),
        "misfit": _misfit(tof, phasor),
        **decoded,
        **_against_stereo(phasor, info, points, pixels, rig.tof),
    }
    if len(tof.raw) >= 3:
        found["flicker"] = _flicker(tof.raw)
    if table and depth.shape == rig.tof.shape:
        share = covered(depth, points, rig.tof, before.T_base_flange @ rig.T_flange_tof)
        found |= {} if np.isnan(share) else {"object_coverage": share}
    return {name: round(value, 7) for name, value in found.items()}


def broken_limits(numbers: dict[str, float]) -> list[Limit]:
    """List the limits that numbers break, the gravest first."""
    broken = [limit for limit in LIMITS if limit.name in numbers and limit.broken_by(numbers[limit.name])]
    return sorted(broken, key=lambda limit: (REFUSE, RETAKE, ELSEWHERE, NOTE).index(limit.action))


def quality_table(numbers: dict[str, float]) -> dict[str, Any]:
    """Write numbers for the view's file, with a sentence and the action of each broken limit."""
    notes = [
        {"check": limit.name, "action": limit.action, "words": limit.sentence(numbers)}
        for limit in broken_limits(numbers)
    ]
    return {**numbers, "notes": notes}


def moved(a: Float64, b: Float64) -> tuple[float, float]:
    """Tell how far apart two poses (4, 4) are, in metres and radians."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), rotation_angle(invert(a) @ b)


def _stale(tof: TofBurst, since: int) -> int:
    """Count frames that were exposed before the arm stood still, go back in time, or are the one before once more."""
    times = np.asarray(tof.time_ns, dtype=np.int64)
    old = times < since - _CLOCKS
    old[1:] |= np.diff(times) <= 0
    if np.issubdtype(tof.raw.dtype, np.integer):
        # Noise never repeats; only an ideal simulated sensor has none, and its raw is no integer.
        old[1:] |= (tof.raw[1:] == tof.raw[:-1]).all(axis=(1, 2, 3))
    return int(old.sum())


def _drops(times: NDArray[np.int64]) -> int:
    """Frames missing within a burst: what its gaps are longer than the usual one."""
    gaps = np.diff(times).astype(np.float64)
    usual = float(np.median(gaps)) if len(gaps) else 0.0
    return int(np.maximum(np.round(gaps / usual) - 1, 0).sum()) if usual > 0 else 0


def _in_tof_image(stereo: StereoFrame, rig: Rig) -> tuple[Float64, Float64]:
    """Return stereo points (N, 3), ToF frame, that lie in the ToF image, and their pixels (N, 2)."""
    step = max(1, stereo.points.shape[1] // _COLUMNS)
    points = stereo.points[::step, ::step].reshape(-1, 3).astype(np.float64)
    points = transform_points(rig.T_tof_stereo, points[np.isfinite(points).all(axis=1)])
    pixels = rig.tof.project(points)[0]
    within = ((pixels > -0.5) & (pixels < [rig.tof.width - 0.5, rig.tof.height - 0.5])).all(axis=1)
    return points[within], pixels[within]


def _overlap(pixels: Float64, camera: Camera) -> float:
    """Share of the ToF image's cells into which a stereo point falls."""
    u, v = pixels.T
    cells = (min(_CELLS[0], camera.height), min(_CELLS[1], camera.width))
    edges = ((-0.5, camera.height - 0.5), (-0.5, camera.width - 0.5))
    hit = np.histogram2d(v, u, bins=cells, range=edges)[0]
    return float((hit > 0).mean())


def _misfit(tof: TofBurst, phasor: Complex128) -> float:
    """Median of what lit pixels' taps leave beside offset and phasor, over the amplitude: 0 where three phases leave nothing to see."""
    info, mean = tof.info, tof.raw.mean(axis=0, dtype=np.float64)
    left = [0.0]
    for z, f in zip(phasor, frequencies(info.modulation_hz), strict=True):
        k = np.flatnonzero(np.equal(info.modulation_hz, f))
        rest = mean[k] - (z * np.exp(1j * np.array(info.phase_rad)[k])[:, None, None]).real
        rest = rest - rest.mean(axis=0) * info.offset
        lit = (np.abs(z) > _BRIGHT) & ~info.saturated(tof.raw).any(axis=(0, 1))
        if len(k) > 2 + info.offset and lit.sum() > _FEW:
            left.append(float(np.median(np.sqrt(np.square(rest).mean(axis=0))[lit] / np.abs(z)[lit])))
    return max(left)


def _decoded(
    tof: TofBurst, points: Float64, pixels: Float64, rig: Rig
) -> tuple[NDArray[np.float32], dict[str, float]]:
    """Find depth (H, W), and what ranges of the frequencies differ by, beyond what rig or camera know: metres, and a share of the closest wraps' distance.

    ``exchanged`` is how much nearer depths come to the stereo camera's when frequencies are exchanged; 0 where those stated are near.
    """
    info = replace(tof.info, range_errors=rig.range_errors or tof.info.range_errors)
    decoder, hz = Decoder(info, min_amplitude=_BRIGHT), frequencies(info.modulation_hz)
    raw, celsius = tof.raw.mean(axis=0, dtype=np.float64), float(np.mean(tof.celsius))
    maps, signals = decoder.signals(raw, celsius)
    share = float(mismatch(signals.offsets, hz)) / decoder.wraps.apart
    found = {"offset": share, "offset_m": float(np.abs(signals.offsets).max()), "exchanged": 0.0}
    if maps.depth.shape == rig.tof.shape and (away := _from_stereo(maps.depth, points, pixels)) > _FAR:
        others = [_exchange(info, dict(zip(hz, other, strict=True))) for other in permutations(hz)][1:]
        depths = (Decoder(each, min_amplitude=_BRIGHT)(raw, celsius).depth for each in others)
        least = min((_from_stereo(depth, points, pixels) for depth in depths), default=np.inf)
        found["exchanged"] = away / max(least, _NEAR / 10) if least < _NEAR else 0.0
    return maps.depth, found


def _exchange(info: TofInfo, other: dict[float, float]) -> TofInfo:
    """Describe a camera whose channels have other frequencies; range errors belong to those that were stated."""
    return replace(info, modulation_hz=tuple(other[f] for f in info.modulation_hz), range_errors=())


def _from_stereo(depth: NDArray[np.float32], points: Float64, pixels: Float64) -> float:
    """Median distance of depths from the stereo camera's, metres; 0 where too few are told."""
    u, v = np.rint(pixels).astype(np.intp).T
    apart = np.abs(depth[v, u] - points[:, 2])
    told = np.isfinite(apart)
    return float(np.median(apart[told])) if told.sum() >= _FEW else 0.0


def _against_stereo(
    phasor: Complex128, info: TofInfo, points: Float64, pixels: Float64, camera: Camera
) -> dict[str, float]:
    """Hold phases against the stereo camera's distances, whatever constant lies between them, and distances against the reach.

    ``misread`` is by how much another frequency of the camera, or the other sign, makes the phases agree better; 0 where they agree.
    """
    if len(points) < _FEW or phasor.shape[1:] != camera.shape:
        return {"misread": 0.0, "out_of_reach": 0.0}
    u, v = np.rint(pixels).astype(np.intp).T
    range_ = (np.linalg.norm(points, axis=1) + np.linalg.norm(points - info.illuminator, axis=1)) / 2
    z = phasor[:, v, u]
    lit = np.abs(z).min(axis=0) > _BRIGHT
    hz = frequencies(info.modulation_hz)
    low, high = info.reach or (0.0, unambiguous(hz))
    beyond = float(((range_ < low) | (range_ > high)).mean())
    if lit.sum() < _FEW:
        return {"misread": 0.0, "out_of_reach": beyond}
    unit = z[:, lit] / np.abs(z[:, lit])
    back = [np.exp(-4j * np.pi / SPEED_OF_LIGHT * f * range_[lit]) for f in hz]
    worse = [0.0]
    for i, own in enumerate(unit):
        spread = [[_spread(each * b) for b in back] for each in (own, own.conj())]
        stated, best = spread[0][i], min(map(min, spread))
        # Of a flat scene anything agrees with anything.
        told = stated > 4 * _SPREAD and 2 * best < _spread(own)
        worse.append(stated / max(best, _SPREAD) if told else 0.0)
    return {"misread": max(worse), "out_of_reach": beyond}


def _spread(unit: Complex128) -> float:
    """Return the circular standard deviation of unit phasors, radians."""
    return float(np.sqrt(-2 * np.log(np.clip(np.abs(unit.mean()), 1e-9, 1 - 1e-9))))


def _flicker(raw: NDArray[Any]) -> float:
    """Largest change of a block's mean from the median frame, as a share of it."""
    F, K, H, W = raw.shape
    rows, columns = max(1, H // _BLOCK), max(1, W // _BLOCK)
    h, w = H // rows, W // columns
    cut = raw[:, :, : rows * h, : columns * w].reshape(F, K, rows, h, columns, w)
    means = cut.mean(axis=(1, 3, 5), dtype=np.float64)
    usual = np.median(means, axis=0)
    return float((np.abs(means - usual) / np.maximum(usual, _FAINT)).max())


SECTORS = ("right", "lower right", "below", "lower left", "left", "upper left", "above", "upper right")
TILTS = (0.0, 8.0, 15.0, 25.0, 40.0, 90.0)  # deg
TILTED = 8.0  # deg; a board less tilted leans in no direction
CELLS = (9, 12)  # of the image
_TURN = np.linspace(0, 2 * np.pi, 48, endpoint=False)
# m; the outline that stands for the board's while recording
DISC = 0.2 * np.column_stack([np.cos(_TURN), np.sin(_TURN)])


def board_pose(centre: Float64, normal: Float64) -> Float64:
    """Build ``T_base_board`` (4, 4) of a board whose front has that normal (3,) and whose x is level.

    The turn in its plane does not matter for a tilt, and little for the image.
    """
    z = normal / np.linalg.norm(normal)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y = y / np.linalg.norm(y) if np.linalg.norm(y) > 1e-6 else np.array([0.0, 1.0, 0.0])
    return transform(np.stack([np.cross(y, z), y, z], axis=1), centre)


def coverage(poses: Sequence[Float64], camera: Camera, outline: Float64 = DISC) -> dict[str, Any]:
    """Say what board views cover.

    The poses (4, 4) are ``T_tof_board``: the board's origin and, along its z, the normal of its front. The outline is (M, 2),
    metres, or (N, M, 2), one for each view.

    The answer is JSON: ``views``; ``tilt_deg`` (to the line of sight), ``lean_deg`` (of the normal in the image, x right, y down)
    and ``distance_m`` of each view; ``tilt_histogram`` (counts between ``tilt_edges_deg``); ``sectors`` (counts by the direction
    in which the front leans); ``image`` (9 x 12 counts) and ``image_share``.
    """
    T = np.reshape(poses, (-1, 4, 4))
    distance = np.linalg.norm(T[:, :3, 3], axis=1)
    sight = -T[:, :3, 3] / np.maximum(distance, 1e-12)[:, None]
    cosine = (T[:, :3, 2] * sight).sum(axis=1)
    tilt = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    lean = T[:, :2, 2] - cosine[:, None] * sight[:, :2]
    angle = np.degrees(np.arctan2(lean[:, 1], lean[:, 0]))
    sector = np.round(angle[tilt >= TILTED] / 45.0).astype(int) % len(SECTORS)
    outlines = np.broadcast_to(outline, (len(T), *np.shape(outline)[-2:]))
    grid = sum((_seen(*each, camera) for each in zip(T, outlines, strict=True)), np.zeros(CELLS, dtype=int))
    return {
        "views": len(T),
        "tilt_deg": tilt.tolist(),
        "lean_deg": angle.tolist(),
        "distance_m": distance.tolist(),
        "tilt_edges_deg": list(TILTS),
        "tilt_histogram": np.histogram(tilt, TILTS)[0].tolist(),
        "sectors": dict(zip(SECTORS, np.bincount(sector, minlength=len(SECTORS)).tolist(), strict=True)),
        "image": grid.tolist(),
        "image_share": float((grid > 0).mean()),
    }


def meter(found: dict[str, Any]) -> str:
    """Lay out tilts, directions, distances and the share of the image of a coverage, in three lines."""
    if not found["views"]:
        return "no board views yet"
    far, edges = found["distance_m"], found["tilt_edges_deg"]
    tilts = zip(edges[:-1], edges[1:], found["tilt_histogram"], strict=True)
    share = f"image {100 * found['image_share']:.0f} % covered"
    return "\n".join(
        [
            f"{found['views']} board views, {min(far):.2f} to {max(far):.2f} m, {share}",
            f"  tilts  {'  '.join(f'{a:g}-{b:g} deg {n}' for a, b, n in tilts)}",
            f"  faces  {'  '.join(f'{name} {n}' for name, n in found['sectors'].items())}",
        ]
    )


def _seen(T_tof_board: Float64, outline: Float64, camera: Camera) -> NDArray[np.int64]:
    """Which cells of the image (9, 12) have their centre on the board, as 0 and 1."""
    corners = np.column_stack([outline, np.zeros(len(outline))])
    pixels, depth = camera.project(transform_points(T_tof_board, corners))
    if not (depth > 0).all():
        return np.zeros(CELLS, dtype=np.int64)
    v = (np.arange(CELLS[0]) + 0.5) * camera.height / CELLS[0] - 0.5
    u = (np.arange(CELLS[1]) + 0.5) * camera.width / CELLS[1] - 0.5
    return inside(pixels, np.stack(np.meshgrid(u, v), axis=-1)).astype(np.int64)
