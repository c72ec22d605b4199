"""The calibrated constants of a rig, two cameras rigid on the arm's flange, and their TOML file ``rig.toml``."""

from __future__ import annotations

import base64
import io
import tomllib
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import LENS_NAMES, Camera
from tofcapture.channels import SPEED_OF_LIGHT, Reach, parse_reach
from tofcapture.errors import ConfigError
from tofcapture.poses import Float64, check_transform, invert


@dataclass(frozen=True)
class RangeError:
    """Systematic range error of one modulation frequency: what the sensor measures too long.

    ``error = offset + scale r + sum_m (a_m cos m phi + b_m sin m phi) + per_pixel_radius * px + sum_ij c_ij x^i y^j +
    per_kelvin * (T - T_ref) + per_inverse_amplitude / A + table`` with r the range in metres, phi = 4 pi f r / c, px the pixel's distance
    to the principal point, x and y the pixel's place from -1 to 1 across the image, A the amplitude (docs: method 0.4).
    """

    modulation_hz: float  #: The frequency it belongs to.
    offset: float = 0.0  #: Metres.
    scale: float = 0.0  #: Metres per metre.
    #: ``(m, a_m, b_m)``: order, cosine and sine amplitude in metres ("wiggling").
    harmonics: tuple[tuple[int, float, float], ...] = ()
    per_pixel_radius: float = 0.0  #: Metres per pixel of distance to the principal point.
    per_kelvin: float = 0.0  #: Metres per kelvin away from ``reference_celsius``.
    reference_celsius: float = 45.0
    #: ``(i, j, c_ij)``: powers of x and y, and metres; what a pixel measures too long for its place.
    image: tuple[tuple[int, int, float], ...] = ()
    per_inverse_amplitude: float = 0.0  #: Metres times raw units: what dark surfaces are measured too far.
    #: Metres that each pixel measures too long, (H, W), as :func:`packed_table` writes it; a camera's phase table (P0) is one.
    table: str = ""
    fitted_m: tuple[float, float] | None = None  #: Ranges that it was fitted on; beyond them it is a guess.

    def at(
        self, phase: NDArray[np.floating], radius_px: NDArray[np.floating] | float, celsius: float,
        place: NDArray[np.floating] | None = None, amplitude: NDArray[np.floating] | None = None,
    ) -> Float64:  # fmt: skip
        """Compute the error, metres.

        Raises :class:`ConfigError` when a term lacks what it depends on.

        Parameters
        ----------
        phase
            Any shape, radians, of the modulation at this frequency; unwrapped where a scale term matters.
        radius_px, celsius
            Distance to the principal point, broadcastable to ``phase``; sensor temperature.
        place, amplitude
            (..., 2) of :func:`image_places`, and raw units; needed where there are ``image`` terms, or ``per_inverse_amplitude``.
        """
        phase = np.asarray(phase, dtype=np.float64)
        r = phase * SPEED_OF_LIGHT / (4 * np.pi * self.modulation_hz)
        error = self.offset + self.scale * r + self.per_kelvin * (celsius - self.reference_celsius)
        for m, a, b in self.harmonics:
            error = error + a * np.cos(m * phase) + b * np.sin(m * phase)
        error = error + self.per_pixel_radius * np.asarray(radius_px, dtype=np.float64)
        out: Float64 = error + self._of_place(place) + self._of_amplitude(amplitude)
        return out

    def pixels(self, camera: Camera) -> Float64:
        """Compute the part that depends on the pixel alone, offset included: (H, W) metres."""
        if self.table and (found := unpacked_table(self.table).shape) != camera.shape:
            raise ConfigError(
                f"range error of {self.modulation_hz / 1e6:g} MHz: expected a table of {camera.shape} pixels, got {found}"
            )
        fixed = self.offset + self.per_pixel_radius * radius_px(camera)
        out: Float64 = fixed + self._of_place(image_places(camera))
        return out

    def _of_place(self, place: NDArray[np.floating] | None) -> Float64 | float:
        if not (self.image or self.table):
            return 0.0
        if place is None:
            raise ConfigError("range error: terms over the image need the pixel's place", "see image_places")
        x, y = place[..., 0], place[..., 1]
        smooth = np.asarray(sum(c * x**i * y**j for i, j, c in self.image), dtype=np.float64)
        if not self.table:
            return smooth
        table = unpacked_table(self.table)
        H, W = table.shape
        rows, columns = (np.rint((s + 1) / 2 * (n - 1)).astype(np.intp) for s, n in ((y, H), (x, W)))
        return np.asarray(smooth + table[rows, columns])

    def _of_amplitude(self, amplitude: NDArray[np.floating] | None) -> Float64 | float:
        if not self.per_inverse_amplitude:
            return 0.0
        if amplitude is None:
            raise ConfigError("range error: the term of dark surfaces needs amplitudes")
        A = np.asarray(amplitude, dtype=np.float64)
        return np.divide(self.per_inverse_amplitude, A, out=np.zeros_like(A), where=A > 0)


def packed_table(table: NDArray[np.floating]) -> str:
    """Write metres (H, W) as text for a rig: base64 of a zlib-compressed float32 ``.npy``."""
    held = io.BytesIO()
    np.save(held, np.asarray(table, dtype="<f4"), allow_pickle=False)
    return base64.b64encode(zlib.compress(held.getvalue(), 6)).decode()


@lru_cache(maxsize=8)
def unpacked_table(text: str) -> Float64:
    """Read what :func:`packed_table` wrote; :class:`ConfigError` for anything but finite metres (H, W)."""
    try:
        held = io.BytesIO(zlib.decompress(base64.b64decode(text, validate=True)))
        table: Float64 = np.load(held, allow_pickle=False).astype(np.float64)
    except (ValueError, zlib.error, EOFError, OSError) as err:
        raise ConfigError(f"range_error: table: expected base64 of a compressed .npy: {err}") from err
    if table.ndim != 2 or not np.isfinite(table).all():
        raise ConfigError(f"range_error: table: expected finite metres (H, W), got shape {table.shape}")
    return table


def radius_px(camera: Camera) -> Float64:
    """Measure the distance (H, W) of each pixel to the principal point, pixels."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    out: Float64 = np.hypot(u - camera.cx, v - camera.cy)
    return out


def image_places(camera: Camera) -> Float64:
    """Place every pixel (H, W, 2) in x and y, -1 to 1 from the first pixel's centre to the last one's."""
    x, y = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in (camera.width, camera.height))
    out: Float64 = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
    return out


@dataclass(frozen=True)
class Rig:
    """Calibrated constants."""

    tof: Camera  #: Intrinsics.
    stereo: Camera
    T_tof_stereo: Float64  #: (4, 4) stereo frame to ToF frame.
    T_flange_tof: Float64  #: (4, 4) ToF frame to flange frame.
    #: (3,) position of the ToF camera's light source in the ToF frame, metres.
    illuminator: Float64 = field(default_factory=lambda: np.zeros(3))
    range_errors: tuple[RangeError, ...] = ()  #: One per modulation frequency; empty when nothing is known.
    reach: Reach | None = (
        None  #: Least and largest range of a surface of this station, metres; ``None``: not stated.
    )

    def __post_init__(self) -> None:
        self.stereo.pinhole("rig.stereo (a point map's grid is rectified)")
        check_transform(self.T_tof_stereo, "rig.T_tof_stereo")
        check_transform(self.T_flange_tof, "rig.T_flange_tof")

    @property
    def T_stereo_tof(self) -> Float64:
        """Map the ToF frame to the stereo frame: (4, 4)."""
        return invert(self.T_tof_stereo)

    @property
    def T_flange_stereo(self) -> Float64:
        """Map the stereo frame to the flange frame: (4, 4)."""
        return self.T_flange_tof @ self.T_tof_stereo


def camera_from(table: Mapping[str, Any], where: str) -> Camera:
    """Read a camera's table; :class:`ConfigError` names what is missing."""
    if missing := [k for k in _CAMERA if k not in table]:
        raise ConfigError(f"{where}: missing {', '.join(missing)}")
    fx, fy, cx, cy = (float(table[k]) for k in ("fx", "fy", "cx", "cy"))
    lens = table.get("distortion", ())
    if isinstance(lens, Mapping):
        if unknown := lens.keys() - set(LENS_NAMES):
            raise ConfigError(
                f"{where}: distortion has {', '.join(LENS_NAMES)}, got {', '.join(sorted(unknown))}"
            )
        lens = [lens.get(k, 0.0) for k in LENS_NAMES]
    return Camera(int(table["width"]), int(table["height"]), fx, fy, cx, cy, tuple(lens))


def camera_table(camera: Camera) -> dict[str, Any]:
    """Write a camera as a TOML table; a pinhole's has no ``distortion``."""
    table = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**table, "distortion": list(camera.distortion)} if camera.distortion else table


def range_error_from(table: Mapping[str, Any]) -> RangeError:
    """Read one ``[[range_error]]`` table."""
    values = dict(table)
    try:
        harmonics = tuple((int(m), float(a), float(b)) for m, a, b in values.pop("harmonics", []))
        image = tuple((int(i), int(j), float(c)) for i, j, c in values.pop("image", []))
        fitted_m = parse_reach(values.pop("fitted_m", None), "range_error: fitted_m")
        return RangeError(harmonics=harmonics, image=image, fitted_m=fitted_m, **values)
    except (TypeError, ValueError) as err:
        raise ConfigError(f"range_error: {err}", hint="see docs/formats.md, rig.toml") from err


def range_error_table(error: RangeError) -> dict[str, Any]:
    """Write a range error as a TOML table."""
    table = {k: getattr(error, k) for k in RangeError.__dataclass_fields__}
    table["harmonics"] = [list(h) for h in error.harmonics]
    # Later terms are written where there are any: cameras without them keep the bytes of their files.
    if image := table.pop("image"):
        table["image"] = [list(c) for c in image]
    if fitted := table.pop("fitted_m"):
        table["fitted_m"] = list(fitted)
    for name in ("per_inverse_amplitude", "table"):
        if not table[name]:
            del table[name]
    return table


def rig_to_dict(rig: Rig) -> dict[str, Any]:
    """Return the rig as plain TOML types."""
    return {
        "format": "tofcapture-rig",
        "version": 1,
        "units": "m",
        "tof": {
            **camera_table(rig.tof),
            "illuminator": [float(x) for x in rig.illuminator],
            **({"reach": [float(r) for r in rig.reach]} if rig.reach else {}),
        },
        "stereo": camera_table(rig.stereo),
        "T_tof_stereo": rig.T_tof_stereo.tolist(),
        "T_flange_tof": rig.T_flange_tof.tolist(),
        "range_error": [range_error_table(e) for e in rig.range_errors],
    }


def loads_rig(text: str, where: str = "rig", *, tof_only: bool = False) -> Rig:
    """Read the text of a ``rig.toml``; where ``tof_only`` is enough, what is missing besides ``[tof]`` is neutral.

    Raises :class:`ConfigError`: not TOML, unknown or missing keys, units other than metres, transforms that are not rigid.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{where}: not TOML: {err}") from err
    if unknown := table.keys() - {*_NEEDED, "format", "version", "units", "range_error"}:
        hint = "see docs/formats.md, rig.toml"
        raise ConfigError(f"{where}: unknown key {', '.join(sorted(unknown))}", hint)
    if table.get("units", "m" if tof_only else None) != "m":
        raise ConfigError(f'{where}: expected units = "m", got {table.get("units")!r}')
    if missing := _missing(table, ("tof",) if tof_only else _NEEDED):
        hint = "tofcapture rig init --camera fx,fy,cx,cy --size H,W writes [tof]"
        hint += (
            ""
            if missing[0].startswith("[tof]")
            else ", which predict needs alone; tofcapture align measures the rest"
        )
        raise ConfigError(f"{where}: missing {', '.join(missing)}", hint)
    tof = camera_from(table["tof"], f"{where}: [tof]")
    neutral = replace(tof, distortion=())
    errors: Sequence[Mapping[str, Any]] = table.get("range_error", [])
    return Rig(
        tof=tof,
        stereo=camera_from(table["stereo"], f"{where}: [stereo]") if "stereo" in table else neutral,
        T_tof_stereo=check_transform(table.get("T_tof_stereo", np.eye(4)), f"{where}: T_tof_stereo"),
        T_flange_tof=check_transform(table.get("T_flange_tof", np.eye(4)), f"{where}: T_flange_tof"),
        illuminator=np.asarray(table["tof"].get("illuminator", [0, 0, 0]), dtype=np.float64),
        range_errors=tuple(range_error_from(e) for e in errors),
        reach=parse_reach(table["tof"].get("reach"), f"{where}: [tof]"),
    )


_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")
_NEEDED = ("tof", "stereo", "T_tof_stereo", "T_flange_tof")


def _missing(table: Mapping[str, Any], needed: Sequence[str]) -> list[str]:
    """Name everything that a rig lacks, keys of its cameras included."""
    out = list[str]()
    for name in needed:
        if name not in table:
            out.append(f"[{name}] {', '.join(_CAMERA)}" if name in {"tof", "stereo"} else name)
        elif isinstance(table[name], Mapping) and (lacks := [k for k in _CAMERA if k not in table[name]]):
            out.append(f"[{name}] {', '.join(lacks)}")
    return out


def dumps_rig(rig: Rig) -> str:
    """Write the text of ``rig.toml``; floats keep every bit."""
    import tomli_w

    return str(tomli_w.dumps(rig_to_dict(rig)))


def load_rig(path: str | Path, *, tof_only: bool = False) -> Rig:
    """Read ``rig.toml``; where ``tof_only`` is enough, what is missing besides ``[tof]`` is neutral.

    Raises :class:`ConfigError`: missing, not TOML, or not a rig.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as err:
        hint = "tofcapture align RECORDING writes one"
        raise ConfigError(f"{path}: cannot read the rig: {err}", hint) from err
    return loads_rig(text, str(path), tof_only=tof_only)
