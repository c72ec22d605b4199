"""Hold what files know of their arrays, and what ``import.toml`` says that they do not."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.camera import Camera
from tofcapture.channels import parse_reach
from tofcapture.errors import ConfigError
from tofcapture.frames import PAPER_MODULATION_HZ, PAPER_PHASE_RAD, TofInfo
from tofcapture.importing.rules import SATURATION
from tofcapture.meshes import metres_per
from tofcapture.poses import Float64, check_transform, printed
from tofcapture.rig import camera_from, camera_table

_FASTEST = 10e9  # Hz, beyond which nobody modulates light
KINDS = ("depth", "radial", "points", "mesh", "none")
NAME = "import.toml"
_TOF = (
    "width", "height", "fx", "fy", "cx", "cy", "distortion", "modulation_mhz", "phase_deg", "saturation", "offset", "illuminator", "reach",
)  # fmt: skip
_RAW = ("files", "layout", "axes", "shape", "dtype", "celsius", "stamps")
_TRUTH = (
    "files",
    "kind",
    "unit",
    "missing",
    "axes",
    "frame",
    "camera",
    "T_tof_truth",
    "T_world_truth",
    "time_offset_s",
)
_POSES = ("file", "unit", "maps", "time_offset_s")
_KEYS = {"tof": _TOF, "raw": _RAW, "truth": _TRUTH, "poses": _POSES}


@dataclass(frozen=True)
class Facts:
    """Hold what a file knows of its array; what ``import.toml`` says goes before it."""

    camera: Camera | None = None  #: Intrinsics of the image.
    modulation_hz: tuple[float, ...] = ()  #: (K,) of raw channels.
    phase_rad: tuple[float, ...] = ()  #: (K,) of raw channels.
    saturation: float | None = None  #: Counts.
    offset: bool | None = None  #: Taps carry an offset.
    axes: str = (
        ""  #: Letters of the array's axes: N views, F frames, K channels, H rows, W columns, 3 coordinates.
    )
    unit: str = ""  #: Of a depth or of points: m, cm or mm.
    celsius: float | None = None  #: Sensor temperature.
    model: str = ""  #: Of the camera.

    def over(self, other: Facts) -> Facts:
        """Take what is known here, and the rest of ``other``."""
        mine = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(other, **{k: v for k, v in mine.items() if v not in (None, "", ())})


@dataclass(frozen=True)
class Said:
    """Hold what was said of a source; empty or ``None`` where nothing was."""

    where: str = "import.toml"  #: Name for messages.
    scene: str = ""  #: Name of the scene.
    tof: Mapping[str, Any] = None  # type: ignore[assignment]  #: Intrinsics, channels, saturation, light source.
    raw: Mapping[str, Any] = None  # type: ignore[assignment]  #: Which arrays, axes, layout of bytes.
    truth: Mapping[str, Any] = None  # type: ignore[assignment]  #: Which arrays, kind, unit, axes, camera.
    poses: Mapping[str, Any] = None  # type: ignore[assignment]  #: Which file, unit, direction, clock.

    def __post_init__(self) -> None:
        for name in _KEYS:
            object.__setattr__(self, name, dict(getattr(self, name) or {}))
        kind = self.truth.get("kind", "depth")
        if kind not in KINDS:
            raise ConfigError(f"{self.where}: [truth] kind: expected one of {', '.join(KINDS)}, got {kind!r}")
        for table in ("truth", "poses"):
            metres_per(getattr(self, table).get("unit", "m"), f"{self.where}: [{table}]")

    def channels(self, facts: Facts) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return frequencies and phases (K,) of the channels, Hz and radians: as said, else as the files know, else the paper's."""
        hz = self.tuple_of("tof", "modulation_mhz", 1e6) or facts.modulation_hz
        phases = self.tuple_of("tof", "phase_deg", np.pi / 180) or facts.phase_rad
        if not hz and not phases:
            return PAPER_MODULATION_HZ, PAPER_PHASE_RAD
        if len(hz) == 1:
            hz *= len(phases)
        if len(hz) != len(phases):
            raise ConfigError(
                f"{self.where}: [tof]: expected a phase for each modulation frequency, got {len(hz)} and {len(phases)}",
                hint="modulation_mhz = [20, 20, 20, 20], phase_deg = [0, 90, 180, 270]",
            )
        if max(hz) > _FASTEST:
            raise ConfigError(
                f"{self.where}: [tof] modulation_mhz: expected megahertz, got {max(hz) / 1e6:g}",
                hint=f"of hertz write {max(hz) / 1e12:g}",
            )
        if 0 < max(self.tuple_of("tof", "phase_deg"), default=0.0) <= 2 * np.pi:
            raise ConfigError(
                f"{self.where}: [tof] phase_deg: expected degrees, got {self.tof['phase_deg']}",
                hint=f"of radians write {[round(float(d), 3) for d in np.degrees(self.tof['phase_deg'])]}",
            )
        return hz, phases

    def size(self, facts: Facts) -> tuple[int, int] | None:
        """Return (H, W) of the ToF image; ``None`` when nobody says."""
        if {"width", "height"} <= self.tof.keys():
            return int(self.tof["height"]), int(self.tof["width"])
        return facts.camera.shape if facts.camera else None

    def tof_info(self, facts: Facts, size: tuple[int, int]) -> TofInfo:
        """Describe the ToF camera of images of ``size`` (H, W); :class:`ConfigError` names all keys that nobody says."""
        known = camera_table(facts.camera) if facts.camera else {}
        table = {**known, "height": size[0], "width": size[1], **self.tof}
        if missing := [f"[tof] {k}" for k in ("fx", "fy", "cx", "cy") if k not in table]:
            raise ConfigError(
                f"{self.where}: the ToF camera's intrinsics are not known: missing {', '.join(missing)}",
                hint="--camera fx,fy,cx,cy[,k1,k2,p1,p2,k3], or --camera FILE; pixels, of the raw image",
            )
        camera = camera_from(table, f"{self.where}: [tof]")
        _expect_centred(camera, self.where)
        hz, phases = self.channels(facts)
        saturation, offset = (
            self.tof.get("saturation", facts.saturation),
            self.tof.get("offset", facts.offset),
        )
        model = str(self.raw.get("layout", "")) or facts.model or "imported"
        return TofInfo(
            model, "", camera,
            np.asarray(self.tuple_of("tof", "illuminator") or (0.0, 0.0, 0.0)),
            hz, phases,
            exposure=float("nan"),
            saturation=SATURATION if saturation is None else float(saturation),
            offset=True if offset is None else bool(offset),
            reach=parse_reach(self.tof.get("reach"), f"{self.where}: [tof]"),
        )  # fmt: skip

    def transform(self, name: str) -> Float64 | None:
        """Read a transform of ``[truth]``; ``None`` when it is not said."""
        said = self.truth.get(name)
        return None if said is None else check_transform(printed(said), f"{self.where}: [truth] {name}")

    def truth_camera(self) -> Camera | None:
        """Read ``[truth.camera]``; ``None`` when it is not said."""
        said = self.truth.get("camera")
        if said is not None and not isinstance(said, Mapping):
            raise ConfigError(
                f"{self.where}: [truth] camera: expected a table, got {said!r}",
                hint='camera = "fx,fy,cx,cy", "FILE#NAME" as of --camera, or { width = 640, height = 480, fx = 600, ... }',
            )
        return None if said is None else camera_from(said, f"{self.where}: [truth.camera]")

    def tuple_of(self, table: str, key: str, scale: float = 1.0) -> tuple[float, ...]:
        """Read numbers of a table, times ``scale``; empty when they are not said."""
        said = getattr(self, table).get(key, ())
        try:
            return tuple(float(x) * scale for x in np.atleast_1d(np.asarray(said, dtype=np.float64)).tolist())
        except (TypeError, ValueError) as err:
            raise ConfigError(f"{self.where}: [{table}] {key}: expected numbers, got {said!r}") from err


def read_said(path: Path) -> Said:
    """Read an ``import.toml``; :class:`ConfigError` for one that cannot be read, or has keys that nobody knows."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read it: {err}",
            hint="save it as UTF-8"
            if isinstance(err, UnicodeDecodeError)
            else "tofcapture import --guess SOURCE writes one",
        ) from err
    _known(table, (*_KEYS, "scene"), str(path))
    for name, known in _KEYS.items():
        if not isinstance(table.get(name, {}), dict):
            raise ConfigError(f"{path}: expected a table [{name}], got {table[name]!r}")
        _known(table.get(name, {}), known, f"{path}: [{name}]")
    return Said(where=str(path), scene=str(table.get("scene", "")), **{n: table.get(n, {}) for n in _KEYS})


def _expect_centred(camera: Camera, where: str) -> None:
    """Refuse a principal point far from the middle: rows and columns have changed places, or the image was scaled."""
    off = max(abs((camera.cx + 0.5) / camera.width - 0.5), abs((camera.cy + 0.5) / camera.height - 0.5))
    if off > 0.25:
        raise ConfigError(
            f"{where}: expected a principal point near the middle of {camera.width} x {camera.height} pixels, "
            f"got ({camera.cx:g}, {camera.cy:g})",
            hint="have rows and columns changed places ([raw] axes), or are the intrinsics those of another size?",
        )


def _known(table: Mapping[str, Any], known: tuple[str, ...], where: str) -> None:
    if unknown := [key for key in table if key not in known]:
        near = difflib.get_close_matches(unknown[0], known, n=1)
        raise ConfigError(
            f"{where}: unknown {', '.join(unknown)}",
            hint=f"{near[0]} instead" if near else f"it may have {', '.join(known)}",
        )
