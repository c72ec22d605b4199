"""The formats as data: what a view file and a shard hold, and what it means.

Writers create what is listed here, readers fetch it, :mod:`tofcapture.files.check` compares a file with it, and
``python -m tofcapture.files.layout > docs/formats.md`` prints it. Changing a layout means raising its version.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import IntFlag
from importlib.resources import files

from tofcapture.frames import TOF_FLAG_DOCS, TofFlag

BOARD_SCENE = "calibration"  # views of the board; never part of a dataset
SPLITS = ("train", "val", "test")


class MaskBit(IntFlag):
    """Tell why a ground-truth pixel should not be trusted; 0 is good ground truth. :data:`MASK_DOCS` says what each means."""

    NOT_HIT = 1
    OCCLUDED = 2
    GRAZING = 4
    EDGE = 8
    OUTSIDE = 16


MASK_DOCS = {
    MaskBit.NOT_HIT: "the ray hits no measured surface; depth and normal are NaN",
    MaskBit.OCCLUDED: "the ray first crosses space that the stereo camera cannot see",
    MaskBit.GRAZING: "either camera sees the surface at more than 75 degrees",
    MaskBit.EDGE: "near a depth edge or a hole (1x pixel), or doubtfully fused",
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
        ``SH SW`` the stereo grid, ``J`` joints of the arm, or a number.
    units
        Stored as the dataset's attribute ``units``; ``1`` is a plain number.
    chunk
        Shape of a chunk: ``1`` or the whole of each dim. ``None`` stores small data contiguously and unfiltered.
    optional
        May be absent, with all other optional datasets of its group.
    doc
        What it means, stored as the attribute ``description``.
    """

    path: str
    dtypes: tuple[str, ...]
    dims: tuple[str, ...]
    units: str
    chunk: tuple[bool, ...] | None
    optional: bool
    doc: str

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape for given sizes of ``N F K H W SH SW``."""
        return tuple(_size(dim, sizes) for dim in self.dims)

    def chunks(self, shape: tuple[int, ...]) -> tuple[int, ...] | None:
        """Shape of a chunk of a dataset of this shape."""
        if self.chunk is None:
            return None
        return tuple(n if whole else 1 for n, whole in zip(shape, self.chunk, strict=True))


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


def _rows(table: str) -> Iterator[tuple[str, ...]]:
    for line in table.strip().splitlines():
        yield tuple(cell.strip() for cell in line.split("|"))


def _field(row: tuple[str, ...]) -> Field:
    """Read a row of a table: path, dtypes, dims, chunk (``1`` and ``*`` for whole, ``-`` for none), units, meaning."""
    path, dtypes, dims, chunk, units, doc = row
    chunks = None if chunk == "-" else tuple(c == "*" for c in chunk.split())
    name, optional = path.rstrip("?"), path.endswith("?")
    return Field(name, tuple(dtypes.split()), tuple(dims.split()), units, chunks, optional, doc)


def _layout(name: str, version: int, title: str, fields: str, attrs: str) -> Layout:
    first = f"format | text | `{name}`\nversion | int | {version}\n{attrs.strip()}\n{_DESCRIPTIONS}"
    texts = tuple((key, kind, doc) for key, kind, doc in _rows(first))
    return Layout(name, version, title, tuple(map(_field, _rows(fields))), texts)


_DESCRIPTIONS = """\
units       | text | always "m"; seconds, radians and hertz elsewhere
rig         | TOML | the rig, see rig.toml below
tof_info    | JSON | what the driver says of the camera: intrinsics, channels, range errors
stereo_info | JSON | model, serial, intrinsics of the point map's grid
provenance  | JSON | versions, digests of inputs, seeds, UTC time
"""
_ARM = """\
arm/{0}/joints        | float64 | J   | - | rad | measured joint angles {0} the exposures; NaN: no arm
arm/{0}/T_base_flange | float64 | 4 4 | - | m   | flange to base, {0} the exposures
arm/{0}/time_ns       | int64   |     | - | ns  | monotonic clock
"""
_PROJECTED = """\
gt/depth_{0}x{1}   | float32 | N {2}H {2}W   | 1 * *   | m | ground-truth depth on the ToF plane at {0}x; NaN: not hit
gt/normals_{0}x{1} | float32 | N {2}H {2}W 3 | 1 * * * | 1 | ground-truth normals, ToF frame, unit, facing the camera
gt/mask_{0}x{1}    | uint8   | N {2}H {2}W   | 1 * *   | 1 | mask bits, see below; 0: good ground truth
"""
_FUSED = """\
fused/sigma_{0}x? | float32 | N {1}H {1}W | 1 * * | m | standard deviation of that depth; NaN: not known
fused/views_{0}x? | int8 | N {1}H {1}W | 1 * * | 1 | views it is made of; negative: without its own; 0: none
"""
# One coordinate of the point map per chunk: x, y and z each pack better alone, and depth is read without the others.
VIEW = _layout(
    "tofcapture-view",
    1,
    "View file `RECORDING/views/<scene>/view-007.h5`",
    f"""
tof/raw             | uint16 int16 float64 | F K H W | 1 * * * | DN   | phase images of the static burst, as the sensor gave them
tof/time_ns         | int64          | F       | -       | ns   | monotonic clock
tof/celsius         | float64        | F       | -       | degC | sensor temperature; NaN: not told
stereo/points       | float32        | SH SW 3 | * * 1   | m    | organised point map, stereo frame; NaN: not measured
stereo/time_ns      | int64          |         | -       | ns   | monotonic clock
{_ARM.format("before")}{_ARM.format("after")}\
truth/depth?        | float32        | 2H 2W   | * *     | m    | exact depth on the ToF plane at 2x; NaN: nothing there
truth/normals?      | float32        | 2H 2W 3 | * * *   | 1    | exact geometric normals, ToF frame, facing the camera
truth/target?       | bool           | 2H 2W   | * *     | 1    | the ray hits the scene's object
truth/T_tof_stereo? | float64        | 4 4     | -       | m    | stereo to ToF of the true rig
truth/T_flange_tof? | float64        | 4 4     | -       | m    | ToF to flange of the true rig
""",
    """
scene | text | name of the scene; `calibration` for views of the board
index | int  | number of the view, from 0
""",
)
SHARD = _layout(
    "tofcapture-shard",
    1,
    "Shard `DATASET/shards/<scene>.h5`",
    f"""
tof/raw           | uint16 int16 float64 | N F K H W | 1 1 * * * | DN   | phase images, as the sensor gave them
tof/celsius       | float64        | N F       | -         | degC | sensor temperature; NaN: not told
tof/time_ns       | int64          | N F       | -         | ns   | monotonic clock
tof/depth         | float32        | N H W     | 1 * *     | m    | depth decoded from the burst's mean I and Q; NaN: none
tof/confidence    | float32        | N H W     | 1 * *     | DN   | amplitude of the highest frequency, burst mean
tof/flags         | uint8          | N H W     | 1 * *     | 1    | flag bits, see below; 0: a good pixel
gt/native_depth   | float32        | N SH SW   | 1 * *     | m    | cropped and denoised stereo depth (z), stereo frame; NaN: none
{_PROJECTED.format(1, "", "")}{_PROJECTED.format(2, "", 2)}{_PROJECTED.format(4, "?", 4)}\
{_FUSED.format(1, "")}{_FUSED.format(2, 2)}{_FUSED.format(4, 4)}\
views/T_base_tof  | float64        | N 4 4     | -         | m    | ToF to base, from the measured joints and the rig
views/index       | int64          | N         | -         | 1    | number of the view in its recording
truth/depth_2x?   | float32        | N 2H 2W   | 1 * *     | m    | exact depth at 2x (simulated recordings)
truth/normals_2x? | float32        | N 2H 2W 3 | 1 * * *   | 1    | exact normals at 2x (simulated recordings)
""",
    "scene | text | name of the scene",
)
LAYOUTS = {layout.format: layout for layout in (VIEW, SHARD)}


def _table(header: str, rows: list[str]) -> str:
    return "\n".join([header, "|---" * (header.count("|") - 1) + "|", *rows, ""])


_AS_ABOVE = re.compile("^arm/after|_4x$|^fused.*_1x$")  # the page says of these that they are as others


def _section(layout: Layout) -> str:
    fields = [
        f"| `/{f.path}`{'?' * f.optional} | {' or '.join(f.dtypes)} | ({', '.join(f.dims)}) | {f.units} | {f.doc} |"
        for f in layout
        if not _AS_ABOVE.search(f.path)
    ]
    shared = set(_rows(_DESCRIPTIONS))
    own = [f"`{name}` ({doc})" for name, kind, doc in layout.attrs[2:] if (name, kind, doc) not in shared]
    return "\n".join(
        [
            f"## {layout.title}\n",
            f'`format = "{layout.format}"`, `version = {layout.version}`, {", ".join(own)}.\n',
            _table("| dataset | dtype | shape | units | meaning |", fields),
        ]
    )


def _bits(docs: Mapping[MaskBit, str] | Mapping[TofFlag, str]) -> str:
    return _table(
        "| bit | name | meaning |", [f"| {b.value} | `{b.name}` | {doc} |" for b, doc in docs.items()]
    )


def formats_markdown() -> str:
    """Print ``docs/formats.md`` from the layouts."""
    page = files("tofcapture.files").joinpath("formats.md").read_text(encoding="utf-8")
    attrs = [f"| `{name}` | {kind} | {doc} |" for name, kind, doc in _rows(_DESCRIPTIONS)]
    return page.format(
        layouts="\n".join(map(_section, (VIEW, SHARD))),
        attrs=_table("| attribute | kind | meaning |", attrs),
        mask=_bits(MASK_DOCS),
        flags=_bits(TOF_FLAG_DOCS),
    )


if __name__ == "__main__":
    print(formats_markdown(), end="")
