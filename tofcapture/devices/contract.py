"""What a driver promises of the data that it hands over: units, shapes, and NaN where nothing was measured.

The recorder holds every view against it, ``tofcapture.testing`` every driver. Each promise is a line: what must hold, the clause,
what came instead, the likely cause.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from tofcapture.errors import ConfigError, TofError
from tofcapture.files.layout import VIEW
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.ops.phase import Decoder

_DEPTH = (0.02, 20.0)  # m; the median of a scene
_WILD = 0.005  # share of points that noise may put beyond
_TURN = 6.5  # rad; farther than any joint of these arms turns
_CLOCKS = 3600 * 10**9  # ns; devices that tell monotonic time are much closer

Promise = tuple[object, str, object, str]


def check_tof_info(info: TofInfo) -> None:
    """Refuse a ToF camera's description whose numbers cannot be in SI units, or that nobody can decode.

    Raises :class:`ConfigError`, as all checks here: the clause, what came instead, and as the hint the likely cause.
    """
    _keep(_of_tof_info(info))
    try:
        Decoder(info)
    except TofError as err:
        hint = f"the likely cause: modulation_hz or phase_rad is not the camera's; {err.hint}".rstrip("; ")
        raise ConfigError(f"[tof] the channels cannot be decoded: {err.message}", hint=hint) from err


def check_burst(burst: Any, info: TofInfo, before: ArmState | None = None) -> None:
    """Refuse a burst that is not what :class:`TofBurst` and ``info`` say; ``before`` is an arm's state just before it."""
    _keep(_of_burst(burst, info, before))


def check_points(frame: Any, info: StereoInfo) -> None:
    """Refuse a point map that is not what :class:`StereoFrame` and ``info`` say; an empty one is another's matter."""
    _keep(_of_points(frame, info))


def check_state(state: Any) -> None:
    """Refuse an arm's state that cannot be in radians and metres."""
    _keep(_of_state(state))


def _keep(promises: Iterable[Promise]) -> None:
    for holds, clause, got, cause in promises:
        if not holds:
            raise ConfigError(f"{clause}; got {got}", hint=f"the likely cause: {cause}")


# fmt: off
def _of_tof_info(info: TofInfo) -> Iterator[Promise]:
    hz, far, turned = np.array(info.modulation_hz), np.abs(info.illuminator).max(), np.abs(info.phase_rad).max()
    yield 1e5 <= hz.min() <= hz.max() <= 1e9, "[tof] modulation_hz is in hertz", hz, "the driver gives MHz or kHz"
    yield turned < 4 * np.pi, "[tof] phase_rad is in radians", turned, "the driver gives degrees"
    yield 1e-7 <= info.exposure <= 0.1, "[tof] exposure is in seconds", info.exposure, "the driver gives us or ms"
    yield far < 1, "[tof] illuminator is in metres", far, "the driver gives millimetres"


def _of_burst(burst: Any, info: TofInfo, before: ArmState | None) -> Iterator[Promise]:
    yield isinstance(burst, TofBurst), "[tof] capture() returns a TofBurst", type(burst), "another object"
    raw, warm, mode = burst.raw, np.asarray(burst.celsius), "another mode of the camera, or axes in another order"
    shape, kinds = (len(info.modulation_hz), *info.camera.shape), VIEW["tof/raw"].dtypes
    yield raw.shape[1:] == shape, f"[tof] raw has the shape (frames, *{shape}) that describe() promises", raw.shape, mode
    yield raw.dtype.name in kinds, f"[tof] raw is {' or '.join(kinds)}, as the sensor gave it", raw.dtype, "a conversion"
    yield np.isfinite(raw).all(), "[tof] raw holds numbers", "NaN or infinity", "the driver marks pixels in raw data"
    yield burst.time_ns.dtype == np.int64, "[tof] time_ns is int64", burst.time_ns.dtype, "seconds as floats"
    yield warm.shape == (len(raw),), "[tof] celsius has one value a frame, NaN for unknown", warm.shape, "one for all"
    cold = warm[~np.isnan(warm) & ((warm < -40) | (warm > 125))]
    yield not cold.size, "[tof] celsius is in degrees Celsius", cold, "kelvin, raw counts, or a number for unknown"
    yield repr(burst.info) == repr(info), "[tof] the burst carries what describe() says", burst.info, mode
    if before is not None and len(raw):
        away = (int(burst.time_ns[0]) - before.time_ns) / 1e9
        clause = "[tof] time_ns is the monotonic clock's, in nanoseconds"
        yield abs(away) < _CLOCKS / 1e9, clause, f"{away:.0f} s from the arm's", "the time of day, or microseconds"


def _of_points(frame: Any, info: StereoInfo) -> Iterator[Promise]:
    yield isinstance(frame, StereoFrame), "[stereo] capture() returns a StereoFrame", type(frame), "another object"
    points, none, metres = frame.points, "[stereo] zero never means missing: NaN does", "[stereo] points are in metres"
    yield points.dtype == np.float32, "[stereo] points are float32", points.dtype, "no conversion in the driver"
    yield repr(frame.info) == repr(info), "[stereo] the frame carries what describe() says", frame.info, "another mode"
    infinite, measured = np.isinf(points).any(axis=-1).sum(), np.isfinite(points).all(axis=-1)
    half, z = (np.isfinite(points).any(axis=-1) & ~measured).sum(), points[..., 2][measured]
    yield infinite == 0, none, f"infinity in {infinite} points", "the driver writes inf for none"
    yield half == 0, "[stereo] a point has three numbers or three NaN", f"{half} half ones", "only z is marked"
    yield (z != 0).all(), none, f"{(z == 0).sum()} points of depth 0", "the driver writes 0 for none"
    cause = "a negative number for none, or z points backwards"
    yield (z > 0).all(), "[stereo] points lie in front of the camera", f"{(z < 0).sum()} behind it", cause
    if z.size:
        middle, beyond = np.median(z), (z > _DEPTH[1]).mean()
        yield middle < _DEPTH[1], metres, f"a median depth of {middle:g}", "the driver gives millimetres"
        yield middle > _DEPTH[0], metres, f"a median depth of {middle:g}", "the driver converts to metres twice"
        yield beyond < _WILD, none, f"{beyond:.1%} beyond {_DEPTH[1]:g} m", "the driver writes a large number for none"


def _of_state(state: Any) -> Iterator[Promise]:
    yield isinstance(state, ArmState), "[arm] state() returns an ArmState", type(state), "another object"
    joints, away = np.asarray(state.joints), np.abs(state.T_base_flange[:3, 3]).max()
    whole = joints.ndim == 1 and len(joints) >= 6 and (np.isfinite(joints).all() or np.isnan(joints).all())
    yield whole, "[arm] joints are finite angles, 6 or more, or NaN where there are none", joints, "another number of axes"
    yield not np.abs(joints).max() >= _TURN, "[arm] joints are in radians", joints, "the driver gives degrees"
    yield away < 5, "[arm] T_base_flange is in metres", f"{away:g}", "the driver gives millimetres"
    yield isinstance(state.time_ns, int), "[arm] time_ns is a whole number", state.time_ns, "seconds as floats"
