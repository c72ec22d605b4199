"""Draw rows of scenes: depth with its errors and clouds, or normals with their angular errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.colours import ESTIMATE, GROUND_TRUTH, SENSOR, Scale, UInt8, paint_normals, scale_for
from tofcapture.errors import DataError, UsageError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.shard import GroundTruth, ShardReader
from tofcapture.poses import Float64
from tofcapture.viz.sheet import DEPTH_KEY, NORMAL_KEY, Cell, Column, draw_table
from tofcapture.viz.shots import eye_for, splat
from tofcapture.viz.sources import read_maps

Float32 = NDArray[np.float32]
_ROOM = 1.3  # of the window about the object, relative to the object
_LEAST = 0.2  # of the image's sides that a window shows at least


@dataclass(frozen=True)
class Maps:
    """Depth (H, W) in metres and normals (H, W, 3) of one method, at the scale of the ground truth beside them."""

    depth: Float32
    normals: Float32
    truth: GroundTruth

    @property
    def good(self) -> NDArray[np.bool_]:
        """(H, W) where ground truth is good: the object."""
        out: NDArray[np.bool_] = self.truth.mask == 0
        return out

    @property
    def error_mm(self) -> Float64:
        """(H, W) depth minus ground truth where that is good, millimetres."""
        return self.error_where(self.good)

    def error_where(self, where: NDArray[np.bool_]) -> Float64:
        """(H, W) depth minus ground truth, millimetres; NaN elsewhere."""
        return np.where(where, 1e3 * (self.depth.astype(np.float64) - self.truth.depth), np.nan)

    @property
    def angle_deg(self) -> Float64:
        """(H, W) angle to the normal of ground truth where that is good, degrees."""
        a, b = self.normals.astype(np.float64), self.truth.normals.astype(np.float64)
        # atan2, since arccos knows no small angles.
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
        return np.where(self.good, np.degrees(angle), np.nan)


@dataclass(frozen=True)
class Row:
    """One view: amplitude (H, W) in raw units, maps by method at the camera's size or twice it, truth at twice it."""

    name: str
    camera: Camera
    T_base_tof: Float64
    amplitude: Float32
    methods: dict[str, Maps]
    truth: GroundTruth

    @property
    def good(self) -> NDArray[np.bool_]:
        """(2H, 2W) where ground truth is good: the object."""
        out: NDArray[np.bool_] = self.truth.mask == 0
        return out

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the (2H, 2W) grid about the object."""
        return object_window(self.good)

    def shown(self, image: NDArray[Any]) -> NDArray[Any]:
        """Cut an image at either resolution to the window about the object."""
        if len(image) == len(self.good):
            return image[self.window]
        return image[tuple(slice(s.start // 2, (s.stop + 1) // 2) for s in self.window)]

    def cell(self, values: NDArray[Any], scale: Scale, note: str = "") -> Cell:
        """Paint what is shown of a map."""
        return Cell(scale.paint(self.shown(values)), scale, note)


def object_window(on_object: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns about an object (2H, 2W), in the image's proportions, starts and ends even; all without any."""
    rows, columns = np.nonzero(on_object)
    height, width = on_object.shape
    if len(rows) == 0:
        return slice(0, height), slice(0, width)
    ends = [np.percentile(at, (1, 99)) for at in (rows, columns)]
    share = _ROOM * max(float(np.ptp(e)) / size for e, size in zip(ends, (height, width), strict=True))

    def span(middle: float, size: int) -> slice:
        length = 2 * round(min(max(share, _LEAST), 1.0) * size / 2)
        start = min(max(round(middle) - length // 2, 0), size - length) // 2 * 2
        return slice(start, start + length)

    return span(float(ends[0].mean()), height), span(float(ends[1].mean()), width)


def read_rows(path: Path, scene: str | None, view: int, most: int, prediction: Path | None) -> list[Row]:
    """Read one view of each scene of a dataset, or of a shard; without a ``scene`` at most so many, spread evenly.

    Raises :class:`DataError`: there is no such scene, view or prediction, or it is of another size;
    :class:`UsageError`: one prediction for several scenes.
    """
    paths = _shards(path, scene, most)
    if prediction is not None and (prediction / "depth.npy").exists() and len(paths) > 1:
        raise UsageError(
            f"--prediction {prediction}: one prediction, but {len(paths)} scenes",
            hint="say which with --scene, or give a folder with one prediction a scene",
        )
    return [_row(p, view, prediction) for p in paths]


def _shards(path: Path, scene: str | None, most: int) -> list[Path]:
    if not path.exists():
        raise DataError(f"{path}: no such file or folder", hint="give a dataset or a shard")
    if path.is_file():
        with ShardReader(path) as shard:
            found = {shard.scene: path}
    elif (path / "manifest.json").exists():
        found = {name: path / entry.path for name, entry in sorted(load_manifest(path).scenes.items())}
    else:
        raise DataError(
            f"{path}: expected a dataset or a shard", hint="tofcapture build-dataset RECORDING --out DATASET"
        )
    if scene is not None and scene not in found:
        raise DataError(f"{path}: no scene {scene}", hint=f"it has {', '.join(found) or 'none'}")
    names = list(found) if scene is None else [scene]
    if not names:
        raise DataError(f"{path}: expected at least one scene, found none")
    some = sorted({round(i) for i in np.linspace(0, len(names) - 1, min(most, len(names)))})
    return [found[names[i]] for i in some]


def _row(path: Path, view: int, prediction: Path | None) -> Row:
    with ShardReader(path) as shard:
        if not 0 <= view < shard.views:
            raise DataError(f"{path}: expected a view of 0 to {shard.views - 1}, got {view}", hint="--view 0")
        tof, truth, fine = shard.tof(view), shard.ground_truth(view, 1), shard.ground_truth(view, 2)
        methods = {"sensor": Maps(tof.depth, shard.tof_normals(view), truth)}
        if prediction is not None:
            methods["prediction"] = _predicted(prediction, shard.scene, view, fine)
        name = f"{shard.scene} {shard.index(view)}"
        return Row(name, shard.camera, shard.T_base_tof(view), tof.confidence, methods, fine)


def _predicted(folder: Path, scene: str, view: int, truth: GroundTruth) -> Maps:
    places = [folder, folder / f"{scene}-{view:03d}", folder / scene]
    found = next((p for p in places if (p / "depth.npy").exists()), None)
    if found is None:
        raise DataError(
            f"{folder}: no prediction of {scene} {view}: no depth.npy in {places[1].name}/ or {scene}/",
            hint=f"tofcapture predict SHARD --view {view} --out {places[1]}",
        )
    depth, normals = read_maps(found)
    if depth.shape != truth.depth.shape or normals.shape != truth.normals.shape:
        raise DataError(
            f"{found}: expected depth of {truth.depth.shape} and normals of {truth.normals.shape}, "
            f"got {depth.shape} and {normals.shape}",
            hint="is it the prediction of another camera?",
        )
    return Maps(depth, normals, truth)


def draw_rows(figure: Any, kind: str, rows: Sequence[Row]) -> str:
    """Draw rows of ``depth`` or ``normals``, all with a prediction or all without; returns what is on it, in words."""
    amplitude = scale_for("amplitude", [row.amplitude for row in rows])
    first = Column("amplitude", [row.cell(row.amplitude, amplitude) for row in rows])
    columns, error = (_depth_columns if kind == "depth" else _normal_columns)(rows)
    title = f"{'Depth' if kind == 'depth' else 'Normals'} against ground truth"
    aspect = rows[0].camera.width / rows[0].camera.height
    draw_table(figure, title, [row.name for row in rows], [first, *columns], aspect)
    sign, several = "±" if kind == "depth" else "0 to ", "s" if len(rows) > 1 else ""
    return f"{len(rows)} scene{several}, scale of errors {sign}{error.high:g} {error.unit}"


def _depth_columns(rows: Sequence[Row]) -> tuple[list[Column], Scale]:
    scaled = [(row, _depth_scale(row)) for row in rows]
    error = scale_for("error", [maps.error_mm for row in rows for maps in row.methods.values()])
    columns, errors = [], []
    for name in rows[0].methods:
        cells = [row.cell(row.methods[name].depth, depth, depth.words) for row, depth in scaled]
        columns.append(Column(f"{name} depth", cells, DEPTH_KEY))
        mm = [(row, row.methods[name].error_mm) for row in rows]
        cells = [row.cell(e, error, _note("mean |e| {:.2f} mm", np.abs(e))) for row, e in mm]
        errors.append(Column(f"{name} error", cells))
    columns.append(Column("ground truth", [row.cell(row.truth.depth, d, d.words) for row, d in scaled]))
    name, colour = _best(rows[0])
    key = ((colour, name), (GROUND_TRUTH, "ground truth"))
    return [*columns, *errors, Column("from the side", [Cell(_cloud(row)) for row in rows], key)], error


def _depth_scale(row: Row) -> Scale:
    """Scale that shows the object of one row."""
    maps = [(m.depth, m.good) for m in row.methods.values()] + [(row.truth.depth, row.good)]
    return scale_for("depth", [depth for depth, _ in maps], [good for _, good in maps])


def _normal_columns(rows: Sequence[Row]) -> tuple[list[Column], Scale]:
    angle = scale_for("angle", [maps.angle_deg for row in rows for maps in row.methods.values()])
    columns, errors = [], []
    for name in rows[0].methods:
        cells = [Cell(paint_normals(row.shown(row.methods[name].normals))) for row in rows]
        columns.append(Column(f"{name} normals", cells, NORMAL_KEY))
        degrees = [(row, row.methods[name].angle_deg) for row in rows]
        cells = [row.cell(a, angle, _note("mean {:.1f}\N{DEGREE SIGN}", a)) for row, a in degrees]
        errors.append(Column(f"{name} error", cells))
    columns.append(
        Column("ground truth", [Cell(paint_normals(row.shown(row.truth.normals))) for row in rows])
    )
    return [*columns, *errors], angle


def _note(form: str, values: Float64) -> str:
    return form.format(np.nanmean(values)) if np.isfinite(values).any() else ""


def _best(row: Row) -> tuple[str, tuple[int, int, int]]:
    return ("prediction", ESTIMATE) if "prediction" in row.methods else ("sensor", SENSOR)


def _cloud(row: Row) -> UInt8:
    """Draw the object alone, of the best that is known of it, over its ground truth."""
    name, colour = _best(row)
    maps, fine = row.methods[name], row.camera.scaled(2)
    exact = fine.unproject(row.truth.depth)[row.good]
    found = (fine if len(maps.depth) == fine.height else row.camera).unproject(maps.depth)[maps.good]
    aspect = row.camera.width / row.camera.height
    return splat([(exact, GROUND_TRUTH), (found, colour)], eye_for(exact, row.T_base_tof, aspect), 400, 3)
