"""The driver contract of cameras; see :mod:`contract`."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from tofcapture.frames import StereoFrame, StereoInfo, TofBurst, TofInfo
from tofcapture.testing.contract import (
    Make,
    Prepare,
    check_describe,
    made,
    nothing,
    only_named_errors,
    require,
)

_FAR = 20.0  # m; points beyond are millimetres


def check_tof(make: Make, prepare: Prepare = nothing, frames: int = 2) -> None:
    """Put a ToF camera through the contract.

    Parameters
    ----------
    make
        Makes a new, unopened camera.
    prepare
        Is called with every open camera before it captures.
    frames
        Length of the bursts.

    Raises
    ------
    ContractError
        The clause that is broken.
    """
    camera = made(make, "tof")
    info = check_describe(camera, TofInfo)
    only_named_errors(
        lambda: camera.capture(1), "capture() of a camera that is not open raises TofErrors only"
    )
    last = None
    for _ in range(2):
        with camera as opened:
            prepare(opened)
            require(opened is camera, "__enter__ returns the device")
            for _ in range(2):
                burst = camera.capture(frames)
                _check_burst(burst, info, frames)
                first = int(burst.time_ns[0])
                require(last is None or first > last, "the frames of a later burst are later")
                last = int(burst.time_ns[-1])
            only_named_errors(partial(camera.capture, -1), "capture(-1) raises TofErrors only")
        # A device that was closed can be opened again; a new one starts no earlier.
        camera = make()


def _check_burst(burst: Any, info: TofInfo, frames: int) -> None:
    require(isinstance(burst, TofBurst), "capture() returns a TofBurst", type(burst))
    shape = (frames, len(info.modulation_hz), *info.camera.shape)
    require(burst.raw.shape == shape, f"raw has the shape {shape} that describe() promises", burst.raw.shape)
    require(burst.raw.dtype == np.uint16, "raw is uint16, as the sensor gave it", burst.raw.dtype)
    require(burst.time_ns.dtype == np.int64, "time_ns is int64", burst.time_ns.dtype)
    require((np.diff(burst.time_ns) > 0).all(), "the times of a burst increase")
    require(
        burst.celsius.shape == (frames,),
        "celsius has one value a frame, NaN for unknown",
        burst.celsius.shape,
    )
    require(repr(burst.info) == repr(info), "the burst carries what describe() says")


def check_stereo(make: Make, prepare: Prepare = nothing) -> None:
    """Put a stereo camera through the contract.

    Parameters
    ----------
    make
        Makes a new, unopened camera.
    prepare
        Is called with every open camera before it captures.

    Raises
    ------
    ContractError
        The clause that is broken.
    """
    camera = made(make, "stereo")
    info = check_describe(camera, StereoInfo)
    only_named_errors(camera.capture, "capture() of a camera that is not open raises TofErrors only")
    last = None
    for _ in range(2):
        with camera as opened:
            prepare(opened)
            require(opened is camera, "__enter__ returns the device")
            for _ in range(2):
                frame = camera.capture()
                _check_points(frame, info)
                require(last is None or frame.time_ns > last, "a later point map is later")
                last = frame.time_ns
        camera = make()


def _check_points(frame: Any, info: StereoInfo) -> None:
    require(isinstance(frame, StereoFrame), "capture() returns a StereoFrame", type(frame))
    require(frame.points.dtype == np.float32, "points are float32", frame.points.dtype)
    measured = np.isfinite(frame.points).all(axis=-1)
    require(
        (np.isfinite(frame.points).any(axis=-1) == measured).all(), "a point has three numbers or three NaN"
    )
    require(not (frame.points[measured] == 0).all(axis=-1).any(), "zero never means missing: NaN does")
    depths = frame.points[..., 2][measured]
    require(depths.size, "the point map of a scene is not empty")
    require((depths > 0).all(), "points lie in front of the camera")
    median = float(np.median(depths))
    require(median < _FAR, "points are in metres", median)
    require(repr(frame.info) == repr(info), "the frame carries what describe() says")
