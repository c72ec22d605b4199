"""Define what a prediction is, and the files that hold one."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.colours import paint_normals, png_bytes, scale_for
from tofcapture.files.disk import full_disk_named
from tofcapture.files.seal import replacing, write_text

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Prediction:
    """Hold what a prediction is, at twice the sensor's resolution.

    Attributes
    ----------
    depth
        (2H, 2W) float32 metres: z.
    error
        (2H, 2W) float32 metres: expected absolute error of the depth; ``None`` from a network that predicts none.
    normals
        (2H, 2W, 3) float32, unit, ToF frame, facing the camera.
    measured
        (2H, 2W) bool: the sensor measured at this pixel; elsewhere the network started from the nearest pixel that did.
    camera
        Intrinsics of the (2H, 2W) grid.
    network
        Kind of network that answered.
    sensor
        (H, W) float32 metres: the sensor's own depth of the same frame; NaN: none.
    trust
        (H, W) float32: 1 where all that the network read is like what it learned from, 0 where the sensor's depth, smoothed, stands
        instead; ``None`` from a network that does not know.
    outside
        What of the camera or the light the network has not seen in training, in words; empty: nothing, as far as it is known.
    inference_ms
        Median time of the network, after loading and decoding; on a GPU with that of decoding and of the physical cues; NaN: not timed.
    decode_ms
        Median time of decoding the raw frame, after the camera's tables are built, and of the physical cues; on a GPU of the taps' way
        there; NaN: not timed.
    """

    depth: Float32
    error: Float32 | None
    normals: Float32
    measured: NDArray[np.bool_]
    camera: Camera
    network: str
    sensor: Float32
    trust: Float32 | None = None
    outside: str = ""
    inference_ms: float = math.nan
    decode_ms: float = math.nan


def _npy_bytes(array: NDArray[Any]) -> bytes:
    """Encode an array; numpy, writing it to a full disk by itself, would not say why it fails."""
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def ply_bytes(prediction: Prediction) -> bytes:
    """Encode points, normals and, where there is one, expected error as binary PLY, metres, ToF frame."""
    columns: list[NDArray[Any]] = [prediction.camera.unproject(prediction.depth), prediction.normals]
    names = ["x", "y", "z", "nx", "ny", "nz"]
    if prediction.error is not None:
        columns.append(prediction.error[..., None])
        names.append("expected_error")
    rows = np.concatenate(columns, axis=-1).reshape(-1, len(names))
    header = ["ply", "format binary_little_endian 1.0", "comment units m", f"element vertex {len(rows)}"]
    header += [*(f"property float {n}" for n in names), "end_header", ""]
    return "\n".join(header).encode() + rows.astype("<f4").tobytes()


def side_by_side(prediction: Prediction) -> tuple[NDArray[np.uint8], str]:
    """Paint the sensor's depth, the network's and its normals: (2H, 6W, 3) colours, and the scale of depth in words."""
    sensor = prediction.sensor.repeat(2, axis=0).repeat(2, axis=1)
    scale = scale_for("depth", [prediction.depth, sensor])
    images = scale.paint(sensor), scale.paint(prediction.depth), paint_normals(prediction.normals)
    return np.concatenate(images, axis=1), scale.words


def write_prediction(prediction: Prediction, out: Path) -> dict[str, str]:
    """Write a prediction into a folder.

    ``depth.npy``, ``error.npy`` (float32 metres), ``normals.npy``, ``measured.npy`` (bool), ``cloud.ply``, ``depth.png`` (16 bit,
    unit 0.1 mm, so up to 6.5535 m), ``normals.png`` (8 bit, ``(n + 1) / 2`` with y and z towards the viewer), ``sensor.npy`` (the
    sensor's own depth, float32 metres, NaN: none), ``picture.png`` (the sensor's depth, the network's in the same colours, normals),
    ``trust.npy``, ``units.txt``. From a network that predicts no error there is no ``error.npy`` and no ``trust.npy``; those of an
    earlier prediction are removed.

    Returns
    -------
    Path of every file by its name.

    Raises
    ------
    DiskFull
        The disk takes no more; no file under its final name is cut short.
    """
    with full_disk_named(out):
        return _write(prediction, out)


def _write(prediction: Prediction, out: Path) -> dict[str, str]:
    out.mkdir(parents=True, exist_ok=True)
    for name in ("error.npy", "trust.npy"):
        (out / name).unlink(missing_ok=True)
    arrays = {
        f"{name}.npy": array
        for name in ("depth", "normals", "error", "measured", "sensor", "trust")
        if (array := getattr(prediction, name)) is not None
    }
    tenth_mm = np.clip(np.rint(prediction.depth * 1e4), 0, 65535).astype(np.uint16)
    picture, scale = side_by_side(prediction)
    made = {name: _npy_bytes(array) for name, array in arrays.items()}
    made |= {
        "depth.png": png_bytes(tenth_mm),
        "normals.png": png_bytes(paint_normals(prediction.normals)),
        "picture.png": png_bytes(picture, {"depth": scale}),
        "cloud.ply": ply_bytes(prediction),
    }
    for name, data in made.items():
        with replacing(out / name) as partial:
            partial.write_bytes(data)
    write_text(
        out / "units.txt",
        "npy, ply: metres, ToF frame (x right, y down, z forward)\n"
        "measured.npy: bool, true where the depth stands on a measurement, false where the sensor had none and it was filled\n"
        "sensor.npy: metres, the sensor's own depth of the frame at its own resolution, NaN where it had none\n"
        "trust.npy: 1 where the frame is like what the network learned from, 0 where the sensor's depth, smoothed, stands instead\n"
        "depth.png: 0.1 mm per count\n"
        f"picture.png: the sensor's depth, the network's depth, both {scale} from violet to yellow, and its normals\n",
    )
    return {name: str(out / name) for name in (*made, "units.txt")}
