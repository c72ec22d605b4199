"""Define what devices hand over, and a view: everything captured at one pose of one scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.channels import Reach, TapNoise, check_channels
from tofcapture.errors import DataError
from tofcapture.poses import Float64, check_transform
from tofcapture.rig import RangeError, Rig

PAPER_MODULATION_HZ = (20e6,) * 4 + (100e6,) * 4
PAPER_PHASE_RAD = tuple(float(k) * np.pi / 2 for k in range(4)) * 2
NO_TRUTH = "none"
"""Model of the stereo camera of a view without one: its point map is empty, on the ToF camera's grid."""
CALIBRATION = "calibration"
"""Name of the scene that is the calibration board."""


class TofFlag(IntFlag):
    """Why a decoded ToF pixel should not be trusted; 0 is a good pixel. :data:`TOF_FLAG_DOCS` says what each means."""

    SATURATED = 1
    FLYING = 2
    LOW_CONFIDENCE = 4
    AMBIGUOUS = 8
    INCONSISTENT = 16


TOF_FLAG_DOCS = {
    TofFlag.SATURATED: "a tap reached saturation, of either sign; there is no depth",
    TofFlag.FLYING: "a mixed pixel: on both sides depth jumps beyond 80 degrees",
    TofFlag.LOW_CONFIDENCE: "noise makes the depth uncertain by more than 20 mm (one sigma)",
    TofFlag.AMBIGUOUS: "other wraps fit almost as well, or the frequencies disagree",
    TofFlag.INCONSISTENT: "taps fit no cosine: a stuck or swapped tap, motion",
}


@dataclass(frozen=True)
class TofInfo:
    """Hold what a ToF driver says of its camera without opening it."""

    model: str
    serial: str
    camera: Camera
    illuminator: Float64  #: (3,) light source in the ToF frame, metres.
    modulation_hz: tuple[float, ...] = PAPER_MODULATION_HZ  #: (K,) frequency of each raw channel.
    phase_rad: tuple[float, ...] = PAPER_PHASE_RAD  #: (K,) ``C_k = B + A cos(phi + phase_rad[k])``.
    exposure: float = 400e-6  #: Integration time of one phase image, seconds; NaN: unknown.
    #: Raw value from which a tap is saturated, of either sign; flags that a sensor writes into values lie beyond it.
    saturation: float = 4095.0
    #: The camera's factory calibration, one per frequency; empty when it has none.
    range_errors: tuple[RangeError, ...] = ()
    offset: bool = (
        True  #: Taps carry the offset ``B``; I and Q alone do not, and two phases are enough for them.
    )
    #: Least and largest range of a surface, metres; among these wraps are chosen. ``None``: all that the frequencies tell apart.
    reach: Reach | None = None
    #: Of one tap of one frame; ``None``: measured on every frame.
    noise: TapNoise | None = None

    def __post_init__(self) -> None:
        where = self.model or "ToF camera"
        check_channels(self.modulation_hz, self.phase_rad, offset=self.offset, reach=self.reach, where=where)
        if not self.saturation > 0:
            raise DataError(f"{where}: expected a saturation above 0, got {self.saturation:g}")

    def saturated(self, raw: NDArray[Any]) -> NDArray[np.bool_]:
        """Tell which taps, any shape, reached saturation, of either sign, or hold a flag beyond it."""
        # Integers are compared with an integer: not one of them is converted.
        limit = self.saturation if raw.dtype.kind == "f" else math.ceil(self.saturation)
        above = np.asarray(raw >= limit)
        return above if raw.dtype.kind == "u" else above | np.asarray(raw <= -limit)


@dataclass(frozen=True)
class TofBurst:
    """Raw phase images of one static burst."""

    #: (frames, K, H, W): uint16 or int16 as the sensor gave it (float64 only from an ideal simulation).
    raw: NDArray[Any]
    time_ns: NDArray[np.int64]  #: (frames,) int64, monotonic clock.
    celsius: Float64  #: (frames,) float64 sensor temperature, NaN when the sensor does not say.
    info: TofInfo  #: The camera that took it.

    def __post_init__(self) -> None:
        shape = (len(self.time_ns), len(self.info.modulation_hz), *self.info.camera.shape)
        if self.raw.shape != shape:
            raise DataError(f"ToF burst: expected raw of shape {shape}, got {self.raw.shape}")


@dataclass(frozen=True)
class StereoInfo:
    """Hold what a stereo driver says of its camera: model, serial, intrinsics of the point map's grid."""

    model: str
    serial: str
    camera: Camera

    def __post_init__(self) -> None:
        self.camera.pinhole("stereo camera (a point map's grid is rectified)")


@dataclass(frozen=True)
class StereoFrame:
    """One organised point map."""

    points: NDArray[np.float32]  #: (H, W, 3) float32, stereo frame, metres; NaN where nothing was measured.
    time_ns: int  #: int, monotonic clock.
    info: StereoInfo  #: The camera that took it.

    def __post_init__(self) -> None:
        expected = (*self.info.camera.shape, 3)
        if self.points.shape != expected:
            raise DataError(f"stereo frame: expected points of shape {expected}, got {self.points.shape}")


@dataclass(frozen=True)
class ArmInfo:
    """Hold what an arm driver says of its arm: model (``ur10e`` ...) and serial."""

    model: str
    serial: str


@dataclass(frozen=True)
class ArmState:
    """Tell where the arm says it is."""

    joints: Float64  #: (J,) measured joint angles, radians, as many as the arm has; NaN: there is no arm, somebody else says the pose.
    T_base_flange: Float64  #: (4, 4), from the measured joints.
    time_ns: int  #: int, monotonic clock.

    def __post_init__(self) -> None:
        check_transform(self.T_base_flange, "arm state: T_base_flange")


@dataclass(frozen=True)
class Truth:
    """Hold what only a simulator knows of a view."""

    #: (2H, 2W) float32, exact depth at the pixel centres of the ToF plane at twice its resolution, metres;
    #: NaN for rays that hit nothing.
    depth: NDArray[np.float32]
    #: (2H, 2W, 3) float32, geometric normals in the ToF frame, unit, facing the camera.
    normals: NDArray[np.float32]
    target: NDArray[np.bool_]  #: (2H, 2W) the ray hits the scene's object (not table or background).
    T_tof_stereo: Float64  #: (4, 4) of the true rig, as is the next.
    T_flange_tof: Float64


@dataclass(frozen=True)
class View:
    """Everything captured at one pose of one scene."""

    scene: str  #: ``calibration`` for board views.
    index: int  #: Number of the view, from 0.
    tof: TofBurst
    stereo: StereoFrame
    arm_before: ArmState  #: Before the first exposure.
    arm_after: ArmState  #: After the last exposure.
    rig: Rig  #: The rig as it was known when the view was taken.
    #: Strings and numbers: versions, seed, plan digest, UTC time ...
    provenance: Mapping[str, Any] = field(default_factory=dict)
    truth: Truth | None = None  #: Only from a simulator.

    def __repr__(self) -> str:
        frames, *sizes = self.tof.raw.shape
        shapes = " x ".join(map(str, sizes)), " x ".join(map(str, self.stereo.points.shape[:2]))
        return f"View({self.scene} {self.index}: {frames} frames of {shapes[0]}, stereo {shapes[1]})"

    @property
    def has_arm(self) -> bool:
        """Whether an arm says where the view was taken, so that the base's z is up."""
        return bool(np.isfinite(self.arm_before.joints).all())
