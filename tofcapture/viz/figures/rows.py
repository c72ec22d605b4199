"""Rows of scenes: depth with its errors and clouds, or normals with their angular errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.errors import DataError, UsageError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.maps import GroundTruth
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64
from tofcapture.viz.colours import ESTIMATE, GROUND_TRUTH, SENSOR, paint
from tofcapture.viz.figures.clouds import splat, stage_for
from tofcapture.viz.figures.table import Cell, Column, Scale, draw_table, percentile, round_up
from tofcapture.viz.shots import Panel

Float32 = NDArray[np.float32]
_ASPECT = 4 / 3
_ROOM = 0.12  # of the object's extent, around it
_CUT = 95.0  # percent of the errors that a scale covers


@dataclass(frozen=True)
class Maps:
    """Depth (H, W) in metres and normals (H, W, 3) of one method, at the scale of the ground truth beside them."""

    depth: Float32
    normals: Float32
    truth: GroundTruth

    @property
    def error_mm(self) -> Float64:
        """(H, W) depth minus ground truth where that is good, millimetres."""
        return np.where(
            self.truth.mask == 0, 1e3 * (self.depth.astype(np.float64) - self.truth.depth), np.nan
        )

    @property
    def angle_deg(self) -> Float64:
        """(H, W) angle to the normal of ground truth where that is good, degrees; not more than a few ulp above 180."""
        a, b = self.normals.astype(np.float64), self.truth.normals.astype(np.float64)
        # atan2, since arccos knows no small angles.
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
        return np.where(self.truth.mask == 0, np.degrees(angle), np.nan)


@dataclass(frozen=True)
class Row:
    """One scene.

    Attributes
    ----------
    name
        Scene and number of the view.
    camera
        ToF camera; maps may have twice its resolution.
    T_base_tof
        (4, 4).
    amplitude
        (H, W) raw units.
    sensor
        At the camera's resolution.
    prediction
        At twice the camera's; ``None``: not given.
    truth
        At twice the camera's.
    """

    name: str
    camera: Camera
    T_base_tof: Float64
    amplitude: Float32
    sensor: Maps
    prediction: Maps | None
    truth: GroundTruth


def read_rows(path: Path, scene: str | None, view: int, most: int, prediction: Path | None) -> list[Row]:
    """Read one view of each scene.

    Parameters
    ----------
    path
        Dataset or shard.
    scene
        Only this one; ``None``: as many as there may be, spread evenly.
    view
        Number in the shard.
    most
        Largest number of rows.
    prediction
        Folder of ``predict``, or of such folders by name; ``None``: none.

    Raises
    ------
    DataError
        There is no such scene, view or prediction, or it is of another size.
    UsageError
        One prediction for several scenes.
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
        given = None if prediction is None else _predicted(prediction, shard.scene, view, fine)
        sensor = Maps(tof.depth, shard.tof_normals(view), truth)
        name = f"{shard.scene} {shard.index(view)}"
        return Row(name, shard.camera, shard.T_base_tof(view), tof.confidence, sensor, given, fine)


def _predicted(folder: Path, scene: str, view: int, truth: GroundTruth) -> Maps:
    places = [folder, folder / f"{scene}-{view:03d}", folder / scene]
    found = next((p for p in places if (p / "depth.npy").exists()), None)
    if found is None:
        raise DataError(
            f"{folder}: no prediction of {scene} {view}: no depth.npy in {places[1].name}/ or {scene}/",
            hint=f"tofcapture predict SHARD --view {view} --out {places[1]}",
        )
    try:
        depth, normals = (np.load(found / f"{n}.npy", allow_pickle=False) for n in ("depth", "normals"))
    except (OSError, ValueError) as err:
        raise DataError(
            f"{found}: cannot read the prediction: {err}", hint="run tofcapture predict again"
        ) from err
    if depth.shape != truth.depth.shape or normals.shape != truth.normals.shape:
        raise DataError(
            f"{found}: expected depth of {truth.depth.shape} and normals of {truth.normals.shape}, "
            f"got {depth.shape} and {normals.shape}",
            hint="is it the prediction of another camera?",
        )
    return Maps(depth, normals, truth)


def draw_rows(figure: Any, kind: str, rows: Sequence[Row]) -> str:
    """Draw rows of ``depth`` or ``normals``.

    Parameters
    ----------
    figure
        Of matplotlib.
    kind
        Which.
    rows
        All with a prediction or all without.

    Returns
    -------
    What is on it, in words.
    """
    columns = _depth_columns(rows) if kind == "depth" else _normal_columns(rows)
    scale = (columns[-2] if kind == "depth" else columns[-1]).cells[0].scale
    end = scale.high if scale else 0.0
    errors = f"\N{PLUS-MINUS SIGN}{end:g} mm" if kind == "depth" else f"0 to {end:g} degrees"
    said = f"error is depth minus ground truth, {errors}" if kind == "depth" else f"angular error {errors}"
    title = f"{kind.capitalize()}: {said}; grey: no value or no good ground truth"
    draw_table(figure, title, [row.name for row in rows], columns, _ASPECT)
    return f"{len(rows)} scene{'s' * (len(rows) > 1)}, scale of errors {errors}"


def _methods(rows: Sequence[Row]) -> list[tuple[str, Callable[[Row], Maps]]]:
    methods: list[tuple[str, Callable[[Row], Maps]]] = [("sensor", lambda row: row.sensor)]
    if rows[0].prediction is not None:
        methods.append(("prediction", lambda row: row.prediction or row.sensor))
    return methods


def _depth_columns(rows: Sequence[Row]) -> list[Column]:
    methods = _methods(rows)
    errors = {name: [of(row).error_mm for row in rows] for name, of in methods}
    end = round_up(percentile([np.abs(e) for some in errors.values() for e in some], _CUT, 1.0))
    error = Scale("RdBu_r", -end, end, f"error (mm), \N{PLUS-MINUS SIGN}{end:g}", "both")
    object_depth = [np.where(row.truth.mask == 0, row.truth.depth, np.nan) for row in rows]
    low, high = (percentile(object_depth, share, share / 98) for share in (2, 98))
    depth = Scale("viridis", low, max(high, low + 1e-3), "depth (m)", "both")
    columns = [_amplitude(rows)]
    columns += [_column(f"{n} depth", rows, [of(r).depth for r in rows], depth) for n, of in methods]
    columns += [_column("ground truth", rows, [row.truth.depth for row in rows], depth)]
    for name, _ in methods:
        notes = [
            f"mean |e| {np.nanmean(np.abs(e)):.2f} mm" if np.isfinite(e).any() else "" for e in errors[name]
        ]
        columns.append(_column(f"{name} error", rows, errors[name], error, notes))
    return [*columns, _cloud_column(rows)]


def _normal_columns(rows: Sequence[Row]) -> list[Column]:
    methods = _methods(rows)
    angles = {name: [of(row).angle_deg for row in rows] for name, of in methods}
    end = round_up(percentile([a for some in angles.values() for a in some], _CUT, 1.0))
    scale = Scale("magma", 0.0, end, "angular error (degrees)", "max")
    columns = [_amplitude(rows)]
    columns += [_painted(f"{n} normals", rows, [of(r).normals for r in rows]) for n, of in methods]
    columns += [_painted("ground truth", rows, [row.truth.normals for row in rows])]
    for name, _ in methods:
        notes = [
            f"mean {np.nanmean(a):.1f}\N{DEGREE SIGN}" if np.isfinite(a).any() else "" for a in angles[name]
        ]
        columns.append(_column(f"{name} error", rows, angles[name], scale, notes))
    return columns


def _amplitude(rows: Sequence[Row]) -> Column:
    values = [row.amplitude for row in rows]
    scale = Scale("cividis", 0.0, round_up(percentile(values, 99, 1.0)), "amplitude (raw units)", "max", 0.5)
    return _column("amplitude", rows, values, scale)


def _column(
    title: str, rows: Sequence[Row], values: Sequence[NDArray[Any]], scale: Scale, notes: Sequence[str] = ()
) -> Column:
    notes = notes or [""] * len(rows)
    cells = [
        Cell(v, scale, note, (row.camera.width, row.camera.height), object_window(row))
        for row, v, note in zip(rows, values, notes, strict=True)
    ]
    return Column(title, cells)


def _painted(title: str, rows: Sequence[Row], values: Sequence[Float32]) -> Column:
    cells = [
        Cell(
            paint(Panel(title, "normals", v), 0, 1).image,
            size=(row.camera.width, row.camera.height),
            window=object_window(row),
        )
        for row, v in zip(rows, values, strict=True)
    ]
    words = "red right, green up,\nblue to the camera" if title == "sensor normals" else ""
    return Column(title, cells, words)


def object_window(row: Row) -> tuple[float, float, float, float]:
    """Where the object is: left, right, top, bottom in pixels of the ToF camera, 4 wide to 3 high where it fits."""
    width, height = row.camera.width, row.camera.height
    v, u = np.nonzero(row.sensor.truth.mask == 0)
    if len(v) == 0:
        return 0.0, float(width), 0.0, float(height)
    wide, tall = ((a.max() - a.min() + 1) * (1 + 2 * _ROOM) for a in (u, v))
    tall = min(max(tall, wide / _ASPECT), height, width / _ASPECT)
    wide = tall * _ASPECT
    left = np.clip((u.max() + u.min() + 1 - wide) / 2, 0, width - wide)
    top = np.clip((v.max() + v.min() + 1 - tall) / 2, 0, height - tall)
    return float(left), float(left + wide), float(top), float(top + tall)


def _cloud_column(rows: Sequence[Row]) -> Column:
    title = "sensor" if rows[0].prediction is None else "prediction"
    cells = [Cell(_cloud(row)) for row in rows]
    return Column(
        "clouds from the side",
        cells,
        f"{'orange' if title == 'sensor' else 'green'}: {title}\nblue: ground truth",
    )


def _cloud(row: Row) -> NDArray[np.uint8]:
    """Object alone, of the best that is known of it, over its ground truth."""
    maps, colour = (row.sensor, SENSOR) if row.prediction is None else (row.prediction, ESTIMATE)
    exact = row.camera.scaled(2).unproject(row.truth.depth)[row.truth.mask == 0]
    camera = row.camera if row.prediction is None else row.camera.scaled(2)
    found = camera.unproject(maps.depth)[maps.truth.mask == 0]
    return splat([(exact, GROUND_TRUTH), (found, colour)], stage_for(exact, row.T_base_tof), 400, 3)
