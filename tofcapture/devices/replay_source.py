"""What a replay serves: a recording's views, by joints or by number; shared by the devices of one station."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tofcapture.errors import ConfigError, DataError, DeviceError
from tofcapture.files.view import check_scene_name, read_view, view_path
from tofcapture.frames import View
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

ORDERS = ("joints", "file")
_NEAR = 0.02  # rad; farther from every recorded view, there is nothing to serve
_NUMBER = re.compile(r"view-(\d+)\.h5")


class Replay:
    """One recording and where its replay stands; shared by the devices of one station.

    Parameters
    ----------
    recording
        The recording's folder.
    order
        ``"joints"`` serves the view recorded nearest to where the arm is sent; ``"file"`` serves a scene's views by
        number, one after the other, wherever the arm is sent.
    """

    def __init__(self, recording: Path, order: str) -> None:
        self.recording, self.order = recording, order
        self.scene: str | None = None
        self.index: int | None = None
        self.captured = False
        self._joints: dict[str, dict[int, Float64]] = {}
        self._cached: tuple[Path, View] | None = None

    def scenes(self) -> dict[str, list[int]]:
        """Views of each scene, by number."""
        found: dict[str, list[int]] = {}
        for path in sorted((self.recording / "views").glob("*/view-*.h5")):
            if match := _NUMBER.fullmatch(path.name):
                found.setdefault(path.parent.name, []).append(int(match[1]))
        if not found:
            raise ConfigError(
                f"{self.recording}: expected a recording with views", hint="see [arm] recording"
            )
        return {scene: sorted(numbers) for scene, numbers in found.items()}

    def first(self) -> View:
        """Any view: all of a recording's were taken with the same devices."""
        scene, numbers = next(iter(self.scenes().items()))
        return self._read(scene, numbers[0])

    def place(self, scene: str) -> None:
        """Go to a scene; the same again does nothing."""
        check_scene_name(scene)
        if scene == self.scene:
            return
        if scene not in self.scenes():
            raise DeviceError(
                f"{self.recording}: no scene {scene!r} was recorded",
                hint=f"there are: {', '.join(self.scenes())}",
            )
        self.scene, self.index, self.captured = scene, None, False

    def view(self) -> View:
        """Give the view that the arm stands at."""
        if self.scene is None or self.index is None:
            raise DeviceError(
                "replay: no recorded view is where the arm stands",
                hint='place a scene and move to a recorded pose, or use order = "file"',
            )
        return self._read(self.scene, self.index)

    def go(self, goal: Float64) -> View | None:
        """Move to joints; returns the view that stands there, ``None`` between views."""
        if self.scene is None:
            return None
        numbers = self.scenes()[self.scene]
        if self.order == "file":
            self.index = self._after(numbers)
        else:
            self.index = self._nearest(numbers, goal)
        self.captured = False
        return None if self.index is None else self.view()

    def _after(self, numbers: list[int]) -> int:
        """Next view by number; one that was not captured yet is not passed over."""
        if self.index is None:
            return numbers[0]
        if not self.captured:
            return self.index
        later = [n for n in numbers if n > self.index]
        if not later:
            raise DeviceError(f"replay: {self.scene!r} has no view after {self.index}")
        return later[0]

    def _nearest(self, numbers: list[int], goal: Float64) -> int | None:
        assert self.scene is not None
        known = self._joints.setdefault(self.scene, {})
        for number in numbers:
            if number not in known:
                known[number] = self._read(self.scene, number).arm_before.joints
        far = {number: float(np.abs(known[number] - goal).max()) for number in numbers}
        best = min(numbers, key=lambda n: (far[n], n))
        return best if far[best] <= _NEAR else None

    def _read(self, scene: str, index: int) -> View:
        path = view_path(self.recording, scene, index)
        if self._cached is None or self._cached[0] != path:
            try:
                self._cached = (path, read_view(path))
            except DataError as err:
                raise DeviceError(f"replay: {err.message}", hint=err.hint) from err
        return self._cached[1]


def shared_replay(context: StationContext) -> Replay:
    """Return the replay that a station's devices share; ``recording`` stands in one or more of their tables.

    Raises
    ------
    ConfigError
        No table names a recording, or they disagree.
    """
    if "replay" not in context.shared:
        tables = [
            t for t in context.config.values() if isinstance(t, Mapping) and t.get("driver") == "replay"
        ]
        found = {key: {str(t[key]) for t in tables if key in t} for key in ("recording", "order")}
        if len(found["recording"]) != 1:
            raise ConfigError(
                f'replay: expected one recording = "folder" in the tables of driver "replay", got {sorted(found["recording"])}'
            )
        orders = found["order"] or {"joints"}
        if len(orders) != 1 or not orders <= set(ORDERS):
            raise ConfigError(f"replay: expected order to be one of {ORDERS}, got {sorted(orders)}")
        context.shared["replay"] = Replay(context.folder / found["recording"].pop(), orders.pop())
    replay: Replay = context.shared["replay"]
    return replay
