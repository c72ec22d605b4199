"""Draw example views as groups of pictures with common scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import NORMAL_WORDS, Scale, percentile, scale_for
from tofcapture.poses import Float64
from tofcapture.viz.figures.clouds import eye_for, splat
from tofcapture.viz.page import Picture, map_picture, mask_legend, mask_picture, normal_picture, picture
from tofcapture_model.report.examples import Example

METHOD_TITLES = {"sensor": "ToF sensor", "model": "network"}
_MARGIN = 1.25  # of the object's radius: what of its surroundings a point cloud shows
_WIDTH, _GROUND = 480, 28  # pixels of a cloud's picture; its grey


@dataclass(frozen=True)
class Group:
    """Pictures side by side, with the scales they share as (words, scale)."""

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


def panels(examples: Sequence[Example]) -> list[Panel]:
    """Draw all examples; errors of all of them are on one scale."""
    error = scale_for("error", [e.methods["sensor"].error_mm for e in examples])
    return [
        Panel(
            e.name,
            [_seen(e), _depths(e), _errors(e, error), _normals(e), _clouds(e, error)],
            mask_legend(e.truth.mask),
        )
        for e in examples
    ]


def _seen(e: Example) -> Group:
    amplitude, confidence = (scale_for("amplitude", [image]) for image in (e.amplitude, e.confidence))
    title, note = "ground-truth mask", "frame: what is shown below"
    pictures = [
        map_picture("amplitude, one frame", e.amplitude, amplitude, "amplitude image of the ToF camera"),
        map_picture("confidence, burst", e.confidence, confidence, "confidence map of the ToF camera"),
        mask_picture(title, e.truth.mask, "mask of the ground truth", note, e.window),
    ]
    scales = [("amplitude, lowest frequency", amplitude), ("confidence, highest frequency", confidence)]
    return Group("What the ToF camera saw, and where ground truth is sound", "", pictures, scales)


def _depths(e: Example) -> Group:
    scale = scale_for("depth", [1e3 * e.truth.depth], [e.good], "mm")
    pictures = [
        map_picture("ToF depth, one frame", e.shown(1e3 * e.tof_depth), scale, "depth of the ToF sensor")
    ]
    if "model" in e.methods:
        depth = e.shown(1e3 * e.methods["model"].depth)
        pictures.append(map_picture("depth, network, same frame", depth, scale, "depth of the network"))
    truth = e.shown(1e3 * e.truth.depth)
    pictures.append(map_picture("depth, ground truth", truth, scale, "depth of the ground truth"))
    return Group("Depth", "Grey: no value.", pictures, [("depth", scale)])


def _errors(e: Example, scale: Scale) -> Group:
    pictures, scales = [], [("answer minus ground truth", scale)]
    for name, maps in e.methods.items():
        method = METHOD_TITLES[name]
        shown = e.shown(maps.error_where(e.surface))
        note = _mean("MAE {:.1f} mm on the object", np.abs(maps.error_mm))
        pictures.append(
            map_picture(f"error, {method}", shown, scale, f"signed depth error of the {method}", note)
        )
    if e.expected_error is not None:
        values = 1e3 * e.expected_error
        expected = scale_for("expected", [e.shown(values)])
        note = _mean("mean {:.1f} mm on the object", values[e.good])
        title = "error that the network expects"
        pictures.append(map_picture(title, e.shown(values), expected, "expected error", note))
        scales.append(("expected absolute error", expected))
    words = "Red: too far, blue: too near, grey: no sound ground truth."
    return Group("Depth error", words, pictures, scales)


def _mean(form: str, values: NDArray[np.floating]) -> str:
    finite = values[np.isfinite(values)].astype(np.float64)
    return form.format(finite.mean()) if finite.size else "no good pixel"


def _normals(e: Example) -> Group:
    pictures: list[Picture] = []
    for name, maps in e.methods.items():
        note = _mean("mean angle {:.1f} degrees on the object", maps.angle_deg)
        method = METHOD_TITLES[name]
        title, alt = f"normals, {method}", f"normals of the {method}"
        pictures.append(normal_picture(title, e.shown(maps.normals), alt, note))
    truth = e.shown(e.truth.normals)
    pictures.append(normal_picture("normals, ground truth", truth, "normals of the ground truth"))
    return Group("Normals", f"{NORMAL_WORDS.capitalize()}.", pictures, [])


def _clouds(e: Example, scale: Scale) -> Group:
    """Draw sensor, network and ground truth from the side: the object and what is near it."""
    title, fine = "Points from the side", e.camera.scaled(2)
    truth = fine.unproject(e.truth.depth)
    if not e.good.any():
        return Group(title, "No good pixel in this view.", [], [])
    centre = np.median(truth[e.good], axis=0)
    radius = _MARGIN * percentile([np.linalg.norm(truth[e.good] - centre, axis=1)], 99, 0.0)
    drawn: list[tuple[str, Float64, NDArray[Any]]] = [
        (
            METHOD_TITLES[name],
            fine.unproject(maps.depth),
            maps.error_where(e.surface),
        )
        for name, maps in e.methods.items()
    ]
    drawn.append(("ground truth", truth, np.zeros(e.truth.depth.shape)))
    eye = eye_for(truth[_near(truth, centre, radius)], e.T_base_tof, e.camera.width / e.camera.height)
    spacing = float(centre[2]) / fine.fx / float(eye.high[0] - eye.low[0]) * _WIDTH
    size = int(np.clip(np.ceil(1.4 * spacing) + 1, 2, 7))
    pictures = []
    for name, points, error in drawn:
        near = _near(points, centre, radius)
        image = splat([(points[near], scale.paint(error)[near])], eye, _WIDTH, size, _GROUND)
        pictures.append(picture(f"points, {name}", image, f"points of the {name} from the side"))
    note = "All points near the object, from the side and above; colours of the error maps, grey without ground truth."
    return Group(title, note, pictures, [])


def _near(points: Float64, centre: Float64, radius: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        out: NDArray[np.bool_] = np.linalg.norm(points - centre, axis=-1) < radius
    return out
