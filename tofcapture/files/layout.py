"""The formats as data: what a view file and a shard hold, and what it means.

Writers create what is listed here, readers fetch it, :mod:`tofcapture.files.check` compares a file with it and
``python -m tofcapture.files.page > docs/formats.md`` prints it. Changing a layout means raising its version.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntFlag

from tofcapture.frames import TOF_FLAG_DOCS, TofFlag

__all__ = [
    "BOARD_SCENE",
    "LAYOUTS",
    "MASK_DOCS",
    "SHARD",
    "SHARD_1",
    "SPLITS",
    "TOF_FLAG_DOCS",
    "VIEW",
    "Field",
    "Layout",
    "MaskBit",
    "TofFlag",
]

BOARD_SCENE = "calibration"  # views of the board; never part of a dataset
SPLITS = ("train", "val", "test")


class MaskBit(IntFlag):
    """Why a ground-truth pixel should not be trusted; 0 is good ground truth. :data:`MASK_DOCS` says what each means."""

    NOT_HIT = 1
    OCCLUDED = 2
    GRAZING = 4
    EDGE = 8
    OUTSIDE = 16


MASK_DOCS = {
    MaskBit.NOT_HIT: "the ray hits no measured surface; depth and normal are NaN, elsewhere they are finite",
    MaskBit.OCCLUDED: "the ray crosses space that the stereo camera could not see before it hits",
    MaskBit.GRAZING: "the surface is seen at more than 75 degrees from its normal by either camera",
    MaskBit.EDGE: "within one pixel of the 1x grid of a depth edge or of a pixel that is not hit",
    MaskBit.OUTSIDE: "outside the crop around the scene's object: table and background",
}


@dataclass(frozen=True)
class Field:
    """One dataset of a file.

    Attributes
    ----------
    path
        Inside the file.
    dtypes
        Allowed numpy dtypes.
    dims
        Its shape in words: ``N`` views, ``F`` frames, ``K`` raw channels, ``H W`` the ToF image, ``2H 2W`` twice that,
        ``SH SW`` the stereo grid, or a number.
    units
        Stored as the dataset's attribute ``units``; ``1`` is a plain number.
    doc
        What it means, stored as the attribute ``description``.
    chunk
        Number of leading dims with one entry per chunk; ``None`` stores small data contiguously and unfiltered.
    optional
        May be absent, with all other optional datasets of its group.
    """

    path: str
    dtypes: tuple[str, ...]
    dims: tuple[str, ...]
    units: str
    doc: str
    chunk: int | None = None
    optional: bool = False

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape for given sizes of ``N F K H W SH SW``."""
        return tuple(_size(dim, sizes) for dim in self.dims)


@dataclass(frozen=True)
class Layout:
    """A file format: name, version, datasets and attributes of the root (name, kind, meaning)."""

    format: str
    version: int
    title: str
    fields: tuple[Field, ...]
    attrs: tuple[tuple[str, str, str], ...]

    def __getitem__(self, path: str) -> Field:
        return next(f for f in self.fields if f.path == path)

    def __iter__(self) -> Iterator[Field]:
        return iter(self.fields)


def _size(dim: str, sizes: Mapping[str, int]) -> int:
    if dim.isdigit():
        return int(dim)
    digits = dim[: len(dim) - len(dim.lstrip("0123456789"))]
    return int(digits or 1) * sizes[dim[len(digits) :]]


_DESCRIPTION_ATTRS = (
    ("units", "text", 'always "m"; seconds, radians and hertz elsewhere'),
    ("rig", "TOML", "the rig, see rig.toml below"),
    (
        "tof_info",
        "JSON",
        "model, serial, intrinsics, illuminator, modulation_hz, phase_rad, exposure, saturation, range_errors",
    ),
    ("stereo_info", "JSON", "model, serial, intrinsics of the point map's grid"),
    ("provenance", "JSON", "versions, digests of inputs, seeds, UTC time"),
)
_RAW = ("uint16", "float64")
_F32, _F64, _I64, _BOOL = ("float32",), ("float64",), ("int64",), ("bool",)


def _arm(when: str) -> tuple[Field, ...]:
    return (
        Field(f"arm/{when}/joints", _F64, ("6",), "rad", f"measured joint angles {when} the exposures"),
        Field(f"arm/{when}/T_base_flange", _F64, ("4", "4"), "m", f"flange to base, {when} the exposures"),
        Field(f"arm/{when}/time_ns", _I64, (), "ns", "monotonic clock"),
    )


VIEW = Layout(
    format="tofcapture-view",
    version=1,
    title="View file `RECORDING/views/<scene>/view-007.h5`",
    fields=(
        Field(
            "tof/raw",
            _RAW,
            ("F", "K", "H", "W"),
            "DN",
            "phase images of the static burst, as the sensor gave them",
            1,
        ),
        Field("tof/time_ns", _I64, ("F",), "ns", "monotonic clock"),
        Field("tof/celsius", _F64, ("F",), "degC", "sensor temperature; NaN: not told"),
        Field(
            "stereo/points",
            _F32,
            ("SH", "SW", "3"),
            "m",
            "organised point map, stereo frame; NaN: not measured",
            0,
        ),
        Field("stereo/time_ns", _I64, (), "ns", "monotonic clock"),
        *_arm("before"),
        *_arm("after"),
        Field(
            "truth/depth",
            _F32,
            ("2H", "2W"),
            "m",
            "exact depth on the ToF plane at 2x; NaN: nothing there",
            0,
            optional=True,
        ),
        Field(
            "truth/normals",
            _F32,
            ("2H", "2W", "3"),
            "1",
            "exact geometric normals, ToF frame, facing the camera",
            0,
            optional=True,
        ),
        Field("truth/target", _BOOL, ("2H", "2W"), "1", "the ray hits the scene's object", 0, optional=True),
        Field("truth/T_tof_stereo", _F64, ("4", "4"), "m", "stereo to ToF of the true rig", optional=True),
        Field("truth/T_flange_tof", _F64, ("4", "4"), "m", "ToF to flange of the true rig", optional=True),
    ),
    attrs=(
        ("format", "text", "`tofcapture-view`"),
        ("version", "int", "1"),
        ("scene", "text", "name of the scene; `calibration` for views of the board"),
        ("index", "int", "number of the view, from 0"),
        *_DESCRIPTION_ATTRS,
    ),
)


def _projected(scale: int) -> tuple[Field, ...]:
    s = "" if scale == 1 else str(scale)
    H, W = f"{s}H", f"{s}W"
    return (
        Field(
            f"gt/depth_{scale}x",
            _F32,
            ("N", H, W),
            "m",
            f"ground-truth depth on the ToF plane at {scale}x; NaN: not hit",
            1,
        ),
        Field(
            f"gt/normals_{scale}x",
            _F32,
            ("N", H, W, "3"),
            "1",
            "ground-truth normals, ToF frame, unit, facing the camera",
            1,
        ),
        Field(
            f"gt/mask_{scale}x", ("uint8",), ("N", H, W), "1", "mask bits, see below; 0: good ground truth", 1
        ),
    )


SHARD = Layout(
    format="tofcapture-shard",
    version=2,
    title="Shard `DATASET/shards/<scene>.h5`",
    fields=(
        Field("tof/raw", _RAW, ("N", "F", "K", "H", "W"), "DN", "phase images, as the sensor gave them", 2),
        Field("tof/celsius", _F64, ("N", "F"), "degC", "sensor temperature; NaN: not told"),
        Field("tof/time_ns", _I64, ("N", "F"), "ns", "monotonic clock"),
        Field(
            "tof/depth",
            _F32,
            ("N", "H", "W"),
            "m",
            "depth decoded from the burst's mean I and Q; NaN: none",
            1,
        ),
        Field(
            "tof/confidence", _F32, ("N", "H", "W"), "DN", "amplitude of the highest frequency, burst mean", 1
        ),
        Field("tof/flags", ("uint8",), ("N", "H", "W"), "1", "flag bits, see below; 0: a good pixel", 1),
        Field(
            "gt/native_depth",
            _F32,
            ("N", "SH", "SW"),
            "m",
            "cropped and denoised stereo depth (z), stereo frame; NaN: none",
            1,
        ),
        *_projected(1),
        *_projected(2),
        *(replace(field, optional=True) for field in _projected(4)),
        Field(
            "views/T_base_tof",
            _F64,
            ("N", "4", "4"),
            "m",
            "ToF to base, from the measured joints and the rig",
        ),
        Field("views/index", _I64, ("N",), "1", "number of the view in its recording"),
        Field(
            "truth/depth_2x",
            _F32,
            ("N", "2H", "2W"),
            "m",
            "exact depth at 2x (simulated recordings)",
            1,
            optional=True,
        ),
        Field(
            "truth/normals_2x",
            _F32,
            ("N", "2H", "2W", "3"),
            "1",
            "exact normals at 2x (simulated recordings)",
            1,
            optional=True,
        ),
    ),
    attrs=(
        ("format", "text", "`tofcapture-shard`"),
        ("version", "int", "2"),
        ("scene", "text", "name of the scene"),
        *_DESCRIPTION_ATTRS,
    ),
)

# Version 1 had one bit of the flags as an array of its own; readers still take it, `tofcapture migrate` rewrites it.
SHARD_1 = replace(
    SHARD,
    version=1,
    fields=tuple(
        Field("tof/saturated", _BOOL, ("N", "H", "W"), "1", "a tap of a frame reached saturation", 1)
        if f.path == "tof/flags"
        else f
        for f in SHARD.fields
    ),
)

LAYOUTS = {layout.format: layout for layout in (VIEW, SHARD)}
