"""What a driver promises of the data that it hands over: units, shapes, and NaN where nothing was measured.

The recorder holds every view against it, ``tofcapture.testing`` every driver.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, TofError
from tofcapture.files.layout import VIEW
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.ops.phase import Decoder

_MODULATION = (1e5, 1e9)  # Hz
_EXPOSURE = (1e-7, 0.1)  # s
_CELSIUS = (-40.0, 125.0)  # what electronics survive
_DEPTH = (0.02, 20.0)  # m; the median of a scene
_FAR_SHARE = 0.005  # of the points may be wild
_REACH = 5.0  # m; from an arm's base to its flange
_TURNS = 6.5  # rad; more than a turn: no joint of these arms goes there
_CLOCKS = 3600 * 10**9  # ns; devices that tell monotonic time are much closer


def require(holds: object, clause: str, got: object, cause: str) -> None:
    """Raise :class:`ConfigError` unless something holds: the clause, what came instead, the likely cause."""
    if not holds:
        raise ConfigError(f"{clause}; got {got}", hint=f"the likely cause: {cause}")


def check_tof_info(info: TofInfo) -> None:
    """Refuse a ToF camera's description whose numbers cannot be in SI units, or that nobody can decode.

    Raises :class:`ConfigError`, as all checks here.
    """
    lowest, highest = min(info.modulation_hz), max(info.modulation_hz)
    given = f"{lowest:g} to {highest:g}"
    inside = _MODULATION[0] <= lowest and highest <= _MODULATION[1]
    require(inside, "[tof] modulation_hz is in hertz", given, "the driver gives MHz or kHz")
    phases = float(np.abs(info.phase_rad).max())
    require(phases < 4 * np.pi, "[tof] phase_rad is in radians", f"{phases:g}", "the driver gives degrees")
    exposed = _EXPOSURE[0] <= info.exposure <= _EXPOSURE[1]
    require(
        exposed, "[tof] exposure is in seconds", f"{info.exposure:g}", "the driver gives microseconds or ms"
    )
    away = float(np.abs(info.illuminator).max())
    require(away < 1.0, "[tof] illuminator is in metres", f"{away:g}", "the driver gives millimetres")
    try:
        Decoder(info)
    except TofError as err:
        raise ConfigError(
            f"[tof] the channels cannot be decoded: {err.message}",
            hint=f"the likely cause: modulation_hz or phase_rad is not the camera's; {err.hint}".rstrip("; "),
        ) from err


def check_burst(burst: Any, info: TofInfo, before: ArmState | None = None) -> None:
    """Refuse a burst that is not what :class:`TofBurst` and ``info`` say; ``before`` is an arm's state just before it."""
    require(isinstance(burst, TofBurst), "[tof] capture() returns a TofBurst", type(burst), "another object")
    shape = (len(info.modulation_hz), *info.camera.shape)
    what = f"[tof] raw has the shape (frames, {', '.join(map(str, shape))}) that describe() promises"
    require(burst.raw.shape[1:] == shape, what, burst.raw.shape, "another mode, or axes in another order")
    kind, kinds = burst.raw.dtype.name, VIEW["tof/raw"].dtypes
    cause = "a conversion in the driver"
    require(kind in kinds, f"[tof] raw is {' or '.join(kinds)}, as the sensor gave it", kind, cause)
    finite = np.isfinite(burst.raw).all()
    require(finite, "[tof] raw holds numbers", "NaN or infinity", "the driver marks pixels in raw data")
    require(
        burst.time_ns.dtype == np.int64, "[tof] time_ns is int64", burst.time_ns.dtype, "seconds as floats"
    )
    one_each = np.shape(burst.celsius) == (len(burst.raw),)
    require(
        one_each,
        "[tof] celsius has one value a frame, NaN for unknown",
        np.shape(burst.celsius),
        "one for all",
    )
    warm = np.asarray(burst.celsius, dtype=np.float64)
    outside = warm[~(np.isnan(warm) | ((warm >= _CELSIUS[0]) & (warm <= _CELSIUS[1])))]
    require(
        not outside.size,
        "[tof] celsius is in degrees Celsius",
        outside[:1],
        "kelvin, raw counts, or 0 K for none",
    )
    require(
        repr(burst.info) == repr(info),
        "[tof] the burst carries what describe() says",
        "another",
        "a second mode",
    )
    if before is not None and len(burst.time_ns):
        away = int(burst.time_ns[0]) - before.time_ns
        require(
            abs(away) < _CLOCKS,
            "[tof] time_ns is the monotonic clock's, in nanoseconds",
            f"{away / 1e9:.0f} s from the arm's",
            "the time of day, or microseconds",
        )


def check_points(frame: Any, info: StereoInfo) -> None:
    """Refuse a point map that is not what :class:`StereoFrame` and ``info`` say; an empty one is another's matter."""
    made = isinstance(frame, StereoFrame)
    require(made, "[stereo] capture() returns a StereoFrame", type(frame), "another object")
    points: NDArray[Any] = frame.points
    require(
        points.dtype == np.float32, "[stereo] points are float32", points.dtype, "no conversion in the driver"
    )
    same = repr(frame.info) == repr(info)
    require(same, "[stereo] the frame carries what describe() says", "another", "a second mode")
    infinite = int(np.isinf(points).any(axis=-1).sum())
    none = "zero never means missing: NaN does"
    require(
        not infinite, f"[stereo] {none}", f"infinity in {infinite} points", "the driver writes inf for none"
    )
    measured = np.isfinite(points).all(axis=-1)
    half = int((np.isfinite(points).any(axis=-1) & ~measured).sum())
    require(
        not half, "[stereo] a point has three numbers or three NaN", f"{half} half points", "only z is marked"
    )
    depths = points[..., 2][measured]
    zero = int((depths == 0).sum())
    require(not zero, f"[stereo] {none}", f"{zero} points of depth 0", "the driver writes 0 for none")
    behind = int((depths < 0).sum())
    cause = "a negative number for none, or z points backwards"
    require(not behind, "[stereo] points lie in front of the camera", f"{behind} behind it", cause)
    if not depths.size:
        return
    median = float(np.median(depths))
    metres = "[stereo] points are in metres"
    require(median < _DEPTH[1], metres, f"a median depth of {median:g}", "the driver gives millimetres")
    require(
        median > _DEPTH[0], metres, f"a median depth of {median:g}", "the driver converts to metres twice"
    )
    far = float((depths > _DEPTH[1]).mean())
    require(
        far < _FAR_SHARE, f"[stereo] {none}", f"{far:.1%} beyond {_DEPTH[1]:g} m", "a large number for none"
    )


def check_state(state: Any) -> None:
    """Refuse an arm's state that cannot be in radians and metres."""
    require(isinstance(state, ArmState), "[arm] state() returns an ArmState", type(state), "another object")
    joints = np.asarray(state.joints, dtype=np.float64)
    whole = joints.shape == (6,) and bool(np.isfinite(joints).all())
    require(whole, "[arm] joints are 6 finite angles", joints, "another number of axes")
    largest = float(np.abs(joints).max())
    require(largest < _TURNS, "[arm] joints are in radians", f"{largest:g}", "the driver gives degrees")
    away = float(np.abs(state.T_base_flange[:3, 3]).max())
    require(away < _REACH, "[arm] T_base_flange is in metres", f"{away:g}", "the driver gives millimetres")
    whole = isinstance(state.time_ns, int)
    require(whole, "[arm] time_ns is a whole number", repr(state.time_ns), "seconds as floats")
