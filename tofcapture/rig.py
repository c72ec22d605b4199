"""The calibrated constants of a rig and their TOML file, ``rig.toml``.

A rig is a ToF camera and a stereo camera, rigid on the arm's flange.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, check_transform, invert

SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact


@dataclass(frozen=True)
class RangeError:
    """Systematic range error of one modulation frequency: what the sensor measures too long.

    ``error = offset + scale r + sum_m (a_m cos m phi + b_m sin m phi) + per_pixel_radius * px + per_kelvin * (T - T_ref)``
    with r the range in metres, phi = 4 pi f r / c, px the pixel's distance to the principal point (docs: method 0.4).

    Attributes
    ----------
    modulation_hz
        The frequency it belongs to.
    offset
        Metres.
    scale
        Metres per metre.
    harmonics
        ``(m, a_m, b_m)``: order, cosine and sine amplitude in metres ("wiggling").
    per_pixel_radius
        Metres per pixel of distance to the principal point.
    per_kelvin
        Metres per kelvin away from ``reference_celsius``.
    """

    modulation_hz: float
    offset: float = 0.0
    scale: float = 0.0
    harmonics: tuple[tuple[int, float, float], ...] = ()
    per_pixel_radius: float = 0.0
    per_kelvin: float = 0.0
    reference_celsius: float = 45.0

    def at(
        self, phase: NDArray[np.floating], radius_px: NDArray[np.floating] | float, celsius: float
    ) -> Float64:
        """Error in metres.

        Parameters
        ----------
        phase
            Any shape, radians, of the modulation at this frequency; unwrapped where a scale term matters.
        radius_px
            Broadcastable to ``phase``: distance to the principal point in pixels.
        celsius
            Sensor temperature.
        """
        phase = np.asarray(phase, dtype=np.float64)
        r = phase * SPEED_OF_LIGHT / (4 * np.pi * self.modulation_hz)
        error = self.offset + self.scale * r + self.per_kelvin * (celsius - self.reference_celsius)
        for m, a, b in self.harmonics:
            error = error + a * np.cos(m * phase) + b * np.sin(m * phase)
        out: Float64 = error + self.per_pixel_radius * np.asarray(radius_px, dtype=np.float64)
        return out


@dataclass(frozen=True)
class Rig:
    """Calibrated constants.

    Attributes
    ----------
    tof, stereo
        Intrinsics.
    illuminator
        (3,) position of the ToF camera's light source in the ToF frame, metres.
    T_tof_stereo
        (4, 4) stereo frame to ToF frame.
    T_flange_tof
        (4, 4) ToF frame to flange frame.
    range_errors
        One per modulation frequency; empty when nothing is known.
    """

    tof: Camera
    stereo: Camera
    T_tof_stereo: Float64
    T_flange_tof: Float64
    illuminator: Float64 = field(default_factory=lambda: np.zeros(3))
    range_errors: tuple[RangeError, ...] = ()

    def __post_init__(self) -> None:
        check_transform(self.T_tof_stereo, "rig.T_tof_stereo")
        check_transform(self.T_flange_tof, "rig.T_flange_tof")

    @property
    def T_stereo_tof(self) -> Float64:
        """(4, 4) ToF frame to stereo frame."""
        return invert(self.T_tof_stereo)

    @property
    def T_flange_stereo(self) -> Float64:
        """(4, 4) stereo frame to flange frame."""
        return self.T_flange_tof @ self.T_tof_stereo


def _camera_from(table: Mapping[str, Any], where: str) -> Camera:
    known = {"width", "height", "fx", "fy", "cx", "cy"}
    missing = known - table.keys()
    if missing:
        raise ConfigError(f"{where}: missing {', '.join(sorted(missing))}")
    return Camera(
        int(table["width"]), int(table["height"]), *(float(table[k]) for k in ("fx", "fy", "cx", "cy"))
    )


def camera_table(camera: Camera) -> dict[str, int | float]:
    """Write a camera as a TOML table."""
    return {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}


def range_error_from(table: Mapping[str, Any]) -> RangeError:
    """Read one ``[[range_error]]`` table."""
    values = dict(table)
    harmonics = tuple((int(m), float(a), float(b)) for m, a, b in values.pop("harmonics", []))
    try:
        return RangeError(harmonics=harmonics, **values)
    except TypeError as err:
        raise ConfigError(f"range_error: {err}", hint="see docs/formats.md, rig.toml") from err


def range_error_table(error: RangeError) -> dict[str, Any]:
    """Write a range error as a TOML table."""
    table = {k: getattr(error, k) for k in RangeError.__dataclass_fields__}
    table["harmonics"] = [list(h) for h in error.harmonics]
    return table


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """Return the rig as plain TOML types."""
    return {
        "format": "tofcapture-rig",
        "version": 1,
        "units": "m",
        "tof": {**camera_table(rig.tof), "illuminator": [float(x) for x in rig.illuminator]},
        "stereo": camera_table(rig.stereo),
        "T_tof_stereo": rig.T_tof_stereo.tolist(),
        "T_flange_tof": rig.T_flange_tof.tolist(),
        "range_error": [range_error_table(e) for e in rig.range_errors],
    }


def rig_from_dict(table: Mapping[str, Any], where: str = "rig") -> Rig:
    """Read a rig from plain TOML types.

    Raises
    ------
    ConfigError
        Unknown or missing keys, units other than metres, transforms that are not rigid.
    """
    known = {"format", "version", "units", "tof", "stereo", "T_tof_stereo", "T_flange_tof", "range_error"}
    unknown = table.keys() - known
    if unknown:
        raise ConfigError(
            f"{where}: unknown key {', '.join(sorted(unknown))}", hint="see docs/formats.md, rig.toml"
        )
    if table.get("units") != "m":
        raise ConfigError(f'{where}: expected units = "m", got {table.get("units")!r}')
    for key in ("tof", "stereo", "T_tof_stereo", "T_flange_tof"):
        if key not in table:
            raise ConfigError(f"{where}: missing {key}")
    errors: Sequence[Mapping[str, Any]] = table.get("range_error", [])
    return Rig(
        tof=_camera_from(table["tof"], f"{where}: [tof]"),
        stereo=_camera_from(table["stereo"], f"{where}: [stereo]"),
        T_tof_stereo=check_transform(table["T_tof_stereo"], f"{where}: T_tof_stereo"),
        T_flange_tof=check_transform(table["T_flange_tof"], f"{where}: T_flange_tof"),
        illuminator=np.asarray(table["tof"].get("illuminator", [0, 0, 0]), dtype=np.float64),
        range_errors=tuple(range_error_from(e) for e in errors),
    )


def dumps_rig(rig: Rig) -> str:
    """Write the text of ``rig.toml``; floats keep every bit."""
    import tomli_w

    return str(tomli_w.dumps(rig_to_dict(rig)))


def loads_rig(text: str, where: str = "rig") -> Rig:
    """Read the text of a ``rig.toml``."""
    try:
        return rig_from_dict(tomllib.loads(text), where)
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{where}: not TOML: {err}") from err


def load_rig(path: Path) -> Rig:
    """Read ``rig.toml``.

    Raises
    ------
    ConfigError
        Missing, not TOML, or not a rig.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read the rig: {err}", hint="tofcapture align RECORDING writes one"
        ) from err
    return loads_rig(text, str(path))
