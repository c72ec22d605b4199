"""Example views as groups of pictures with common scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.files.layout import MaskBit
from tofcapture.poses import Float64
from tofcapture_model.evaluation.metrics import angles_deg
from tofcapture_model.report.clouds import SIZE, render, shaded_palette, side_view
from tofcapture_model.report.examples import Answer, Example
from tofcapture_model.report.pictures import (
    Picture,
    Scale,
    UInt8,
    indexed_picture,
    normal_picture,
    scalar_picture,
)

METHOD_TITLES = {"sensor": "ToF sensor", "model": "network"}
ERROR_COLOURS = "RdBu_r"
_NICE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # mm, ends of error scales
_MARGIN = 1.25  # of the object's radius: what of its surroundings a point cloud shows

GOOD_COLOUR = (0, 158, 115)
MASK_COLOURS = {
    MaskBit.NOT_HIT: (20, 20, 20),
    MaskBit.OCCLUDED: (213, 94, 0),
    MaskBit.GRAZING: (240, 228, 66),
    MaskBit.EDGE: (86, 180, 233),
    MaskBit.OUTSIDE: (170, 170, 170),
}
"""Okabe and Ito's colours; a pixel with several bits has the colour of the first."""

MASK_WORDS = {
    MaskBit.NOT_HIT: "not hit: no measured surface on this ray",
    MaskBit.OCCLUDED: "occluded for the stereo camera",
    MaskBit.GRAZING: "seen at more than 75 degrees",
    MaskBit.EDGE: "at a depth edge",
    MaskBit.OUTSIDE: "outside the object crop",
}


@dataclass(frozen=True)
class Group:
    """Pictures side by side, with the scales they share."""

    title: str
    note: str
    pictures: list[Picture]
    scales: list[tuple[str, Scale]]


@dataclass(frozen=True)
class Panel:
    """One example view: its title, its groups, and the legend of its mask as (colour, words, share of pixels)."""

    title: str
    groups: list[Group]
    legend: list[tuple[str, str, str]]


def nice_limit(values_mm: NDArray[np.floating], percentile: float) -> float:
    """Smallest round number of millimetres that covers a percentile of absolute values; 10 without values."""
    finite = np.abs(values_mm[np.isfinite(values_mm)])
    if finite.size == 0:
        return 10.0
    wanted = np.percentile(finite, percentile)
    return float(next((n for n in _NICE if n >= wanted), _NICE[-1]))


def panels(examples: Sequence[Example]) -> list[Panel]:
    """Draw all examples; errors of all of them are on one scale."""
    errors = [1e3 * e.depth_error(e.sensor, e.good).ravel() for e in examples]
    limit = nice_limit(np.concatenate([*errors, np.zeros(0)]), 90)
    return [_panel(example, limit) for example in examples]


def _panel(example: Example, limit: float) -> Panel:
    error = Scale(ERROR_COLOURS, -limit, limit, "mm")
    groups = [
        _seen(example),
        _depths(example),
        _errors(example, error),
        _normals(example),
        _clouds(example, limit),
    ]
    return Panel(f"{example.scene}, view {example.index}", groups, mask_legend(example.ground_truth.mask))


def _seen(example: Example) -> Group:
    amplitude = Scale("gray", 0, _top(example.amplitude), "raw units at the lowest frequency", 2)
    confidence = Scale("cividis", 0, _top(example.confidence), "raw units at the highest frequency", 2)
    pictures = [
        scalar_picture(
            "amplitude, one frame", example.amplitude, amplitude, "amplitude image of the ToF camera"
        ),
        scalar_picture(
            "confidence, burst", example.confidence, confidence, "confidence map of the ToF camera"
        ),
        mask_picture(example.ground_truth.mask, example.window),
    ]
    scales = [("amplitude", amplitude), ("confidence", confidence)]
    return Group("What the ToF camera saw, and where ground truth is sound", "", pictures, scales)


def _framed(indices: UInt8, window: tuple[slice, slice], colour: int) -> UInt8:
    """Draw the rim of a window, two pixels wide."""
    inside = np.zeros(indices.shape, bool)
    inside[window] = True
    rows, columns = window
    inside[rows.start + 2 : rows.stop - 2, columns.start + 2 : columns.stop - 2] = False
    return np.where(inside, np.uint8(colour), indices)


def _top(image: NDArray[np.floating]) -> float:
    """Upper end of a scale: bright spots may clip."""
    finite = image[np.isfinite(image)]
    return max(float(np.percentile(finite, 99.5)) if finite.size else 0.0, 1.0)


def mask_indices(mask: UInt8) -> UInt8:
    """0 for good pixels, otherwise 1 + the position of the first bit that is set."""
    out = np.zeros(mask.shape, np.uint8)
    for i, bit in reversed(list(enumerate(MASK_COLOURS, start=1))):
        out[(mask & bit) > 0] = i
    return out


def mask_picture(mask: UInt8, window: tuple[slice, slice]) -> Picture:
    """Picture of the mask's bits, with the window that the other pictures show."""
    colours = np.full((256, 3), 255, np.uint8)
    colours[: 1 + len(MASK_COLOURS)] = [GOOD_COLOUR, *MASK_COLOURS.values()]
    indices = _framed(mask_indices(mask), window, colour=255)
    return indexed_picture(
        "ground-truth mask", indices, colours, "mask of the ground truth", "frame: what is shown below"
    )


def mask_legend(mask: UInt8) -> list[tuple[str, str, str]]:
    """(CSS colour, words, share of the pixels) of every colour of the mask."""
    shares = np.bincount(mask_indices(mask).ravel(), minlength=1 + len(MASK_COLOURS)) / max(mask.size, 1)
    words = ["0: good, metrics are taken here", *(f"{int(bit)}: {MASK_WORDS[bit]}" for bit in MASK_COLOURS)]
    colours = [f"rgb{c}" for c in (GOOD_COLOUR, *MASK_COLOURS.values())]
    return [
        (c, w, f"{100 * s:.1f}\N{NO-BREAK SPACE}%") for c, w, s in zip(colours, words, shares, strict=True)
    ]


def _depths(example: Example) -> Group:
    truth, half = example.ground_truth.depth[example.window], _halved(example.window)
    known = truth[np.isfinite(truth)]
    known = known if known.size else example.sensor.depth.ravel()
    low, high = (1e3 * float(x) for x in np.percentile(known, [0.5, 99.5]))
    scale = Scale("viridis", np.floor(low / 10) * 10, np.ceil(high / 10) * 10, "mm")
    pictures = [
        scalar_picture(
            "ToF depth, one frame", 1e3 * example.tof_depth[half], scale, "depth of the ToF sensor"
        )
    ]
    if example.model:
        depth = 1e3 * example.model.depth[example.window]
        pictures.append(scalar_picture("depth, network, same frame", depth, scale, "depth of the network"))
    pictures.append(scalar_picture("depth, ground truth", 1e3 * truth, scale, "depth of the ground truth"))
    return Group("Depth", "Grey: no value.", pictures, [("depth", scale)])


def _halved(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """Return the same window on the sensor's own grid."""
    rows, columns = (slice(s.start // 2, (s.stop + 1) // 2) for s in window)
    return rows, columns


def _errors(example: Example, scale: Scale) -> Group:
    pictures, scales = [], [("answer minus ground truth", scale)]
    for name, answer in example.answers.items():
        values = 1e3 * example.depth_error(answer, example.surface)[example.window]
        mean = 1e3 * _mean(np.abs(example.depth_error(answer, example.good)))
        title = f"error, {METHOD_TITLES[name]}"
        note = f"MAE {mean:.1f} mm on the object" if np.isfinite(mean) else "no good pixel"
        pictures.append(
            scalar_picture(title, values, scale, f"signed depth error of the {METHOD_TITLES[name]}", note)
        )
    if example.model and example.model.expected_error is not None:
        values = 1e3 * example.model.expected_error[example.window]
        expected = Scale("magma", 0, nice_limit(values, 99), "mm")
        note = f"mean {1e3 * _mean(example.model.expected_error[example.good]):.1f} mm on the object"
        pictures.append(
            scalar_picture("error that the network expects", values, expected, "expected error", note)
        )
        scales.append(("expected absolute error", expected))
    return Group(
        "Depth error", "Red: too far, blue: too near, grey: no sound ground truth.", pictures, scales
    )


def _mean(values: NDArray[np.floating]) -> float:
    finite = values[np.isfinite(values)].astype(np.float64)
    return float(finite.mean()) if finite.size else float("nan")


def mean_angle_deg(example: Example, answer: Answer) -> float:
    """Mean angle to the ground truth's normals over the good pixels, degrees; NaN without any."""
    known = example.good & np.isfinite(example.ground_truth.normals).all(axis=-1)
    pair = (
        torch.from_numpy(np.ascontiguousarray(n[known].T))
        for n in (answer.normals, example.ground_truth.normals)
    )
    return float(angles_deg(*pair).mean()) if known.any() else float("nan")


def _normals(example: Example) -> Group:
    pictures = []
    for name, answer in example.answers.items():
        angle = mean_angle_deg(example, answer)
        note = f"mean angle {angle:.1f} degrees on the object" if np.isfinite(angle) else "no good pixel"
        title = f"normals, {METHOD_TITLES[name]}"
        pictures.append(
            normal_picture(
                title, answer.normals[example.window], f"normals of the {METHOD_TITLES[name]}", note
            )
        )
    truth = example.ground_truth.normals[example.window]
    pictures.append(normal_picture("normals, ground truth", truth, "normals of the ground truth"))
    return Group("Normals", "Redder to the right, greener upwards, bluer towards the camera.", pictures, [])


def _clouds(example: Example, limit: float) -> Group:
    """Sensor, network and ground truth from the side: the object and what is near it."""
    truth = example.camera.unproject(example.ground_truth.depth)
    object_points = truth[example.good]
    if len(object_points) == 0:
        return Group("Points from the side", "No good pixel in this view.", [], [])
    centre = np.median(object_points, axis=0)
    radius = _MARGIN * float(np.percentile(np.linalg.norm(object_points - centre, axis=1), 99))
    colours, pictures = shaded_palette(ERROR_COLOURS), []
    for name, answer in {**example.answers, "truth": None}.items():
        depth = example.ground_truth.depth if answer is None else answer.depth
        normals = example.ground_truth.normals if answer is None else answer.normals
        error = (
            np.zeros(depth.shape) if answer is None else 1e3 * example.depth_error(answer, example.surface)
        )
        points = truth if answer is None else example.camera.unproject(depth)
        indices = _cloud(example, points, normals, 0.5 + error / (2 * limit), centre, radius)
        title = "ground truth" if answer is None else METHOD_TITLES[name]
        pictures.append(
            indexed_picture(f"points, {title}", indices, colours, f"points of the {title} from the side")
        )
    note = "All points near the object, from the side and above; colours of the error maps, grey without ground truth."
    return Group("Points from the side", note, pictures, [])


def _cloud(
    example: Example,
    points: Float64,
    normals: NDArray[np.floating],
    values: NDArray[np.floating],
    centre: Float64,
    radius: float,
) -> UInt8:
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(points - centre, axis=-1) < radius
    metres_per_pixel = 2.3 * radius / SIZE[1]
    spacing = float(np.median(points[near][:, 2])) / example.camera.fx if near.any() else 0.0
    dot = int(np.clip(np.ceil(1.4 * spacing / metres_per_pixel) + 1, 2, 7))
    eye = side_view(example.T_base_tof, centre)
    return render(points[near], normals[near], values[near], eye, metres_per_pixel, dot)
