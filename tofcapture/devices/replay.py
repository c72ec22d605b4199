"""The driver ``replay``: a recording's files as arm, ToF camera, stereo camera and operator; see docs/replay.md.

::

    python -m tofcapture.devices.replay RECORDING FOLDER      # writes FOLDER/station.toml and FOLDER/rig.toml
    tofcapture record --station FOLDER/station.toml --scene mug --out again
"""

from __future__ import annotations

import sys
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from tofcapture.devices import Arm, Device, Operator, StereoDevice, TofCamera
from tofcapture.devices.faults import StopLatch
from tofcapture.devices.kinematics import HOME, MODELS, ArmModel, check_joints, forward
from tofcapture.devices.registry import ROLES, StationContext, check_keys
from tofcapture.errors import ConfigError, DataError, DeviceError
from tofcapture.files.view import check_scene_name, find_views, open_view, view_number, view_path
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth, View
from tofcapture.poses import Float64
from tofcapture.rig import dumps_rig

ORDERS = ("joints", "file")
_NEAR = 0.02  # rad; farther from every recorded view, there is nothing to serve


class Replay:
    """One recording and where its replay stands; shared by the devices of one station.

    The order ``"joints"`` serves the view recorded nearest to where the arm is sent; ``"file"`` serves a scene's views by
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
        views = find_views(self.recording)
        found = {scene: [view_number(p) or 0 for p in paths] for scene, paths in views.items()}
        if not found:
            raise ConfigError(
                f"{self.recording}: expected a recording with views", hint="see [arm] recording"
            )
        return found

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
        self.index = (
            self._after(numbers) if self.order == "file" else self._nearest(self.scene, numbers, goal)
        )
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

    def _nearest(self, scene: str, numbers: list[int], goal: Float64) -> int | None:
        known = self._joints.setdefault(scene, {})
        for number in numbers:
            if number not in known:
                known[number] = self._read(scene, number).arm_before.joints
        far = {number: float(np.abs(known[number] - goal).max()) for number in numbers}
        best = min(numbers, key=lambda n: (far[n], n))
        return best if far[best] <= _NEAR else None

    def _read(self, scene: str, index: int) -> View:
        path = view_path(self.recording, scene, index)
        if self._cached is None or self._cached[0] != path:
            try:
                self._cached = (path, open_view(path))
            except DataError as err:
                raise DeviceError(f"replay: {err.message}", hint=err.hint) from err
        return self._cached[1]


def _shared_replay(context: StationContext) -> Replay:
    """Return the replay that a station's devices share; ``recording`` stands in one or more of their tables.

    Raises ConfigError when no table names a recording, or they disagree.
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


class _Replayed(Device):
    """Opens by finding the recording; there is nothing to close."""

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        check_keys(table, ("recording", "order"), "replay")
        self._context = context

    @property
    def _replay(self) -> Replay:
        return _shared_replay(self._context)

    def __enter__(self) -> Self:
        self._replay.scenes()
        return self


class ReplayArm(_Replayed, Arm):
    """The recorded arm: at a recorded view it says what was measured there, elsewhere what it was told."""

    simulated = True

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        super().__init__(table, context)
        self._between: Float64 = HOME.copy()
        self._at_view = self._open = False
        self._latch = StopLatch()

    def __enter__(self) -> Self:
        super().__enter__()
        self._open, self._latch = True, StopLatch()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False

    def describe(self) -> ArmInfo:
        """Say what arm the recording was made with."""
        said = self._replay.first().provenance.get("arm", {})
        return ArmInfo(str(said.get("model", "ur10e")), str(said.get("serial", "replay")))

    def state(self) -> ArmState:
        """Return the recorded state: before the exposures until they were served, after them from then on."""
        if not self._open:
            raise DeviceError("the replayed arm is not open", hint="use the station as a context manager")
        replay = self._replay
        if self._at_view and replay.index is not None:
            view = replay.view()
            return view.arm_after if replay.captured else view.arm_before
        return ArmState(self._between.copy(), forward(self._model(), self._between), time.monotonic_ns())

    def move_to(self, joints: Float64) -> ArmState:
        """Go to the view recorded there (or the next by number), at once.

        Raises :class:`MotionRefused`: not as many finite angles as it has joints, within the arm's limits; :class:`DeviceError`: by
        number, and there is no further view.
        """
        self._latch.check(self._latch.token)
        self._between = check_joints(self._model(), joints)
        self._at_view = self._replay.go(self._between) is not None
        return self.state()

    def _model(self) -> ArmModel:
        return MODELS.get(self.describe().model, MODELS["ur10e"])

    def stop(self) -> None:
        """Refuse every further move: a replayed one is over when it returns."""
        self._latch.stop()

    def resume(self) -> None:
        """Move again when asked."""
        self._latch.resume(self._latch.token)


class ReplayTof(_Replayed, TofCamera):
    """The recorded ToF camera."""

    def describe(self) -> TofInfo:
        """Say what camera the recording was made with."""
        return self._replay.first().tof.info

    def capture(self, frames: int) -> TofBurst:
        """Give the first ``frames`` frames of the recorded burst.

        Raises :class:`DeviceError`: no view is here, or its burst is shorter.
        """
        burst = self._replay.view().tof
        if not 1 <= frames <= len(burst.raw):
            raise DeviceError(
                f"replay: expected 1 to {len(burst.raw)} frames, which the recording has, got {frames}",
                hint=f"record with --frames {len(burst.raw)}",
            )
        self._replay.captured = True
        return TofBurst(burst.raw[:frames], burst.time_ns[:frames], burst.celsius[:frames], burst.info)


class ReplayStereo(_Replayed, StereoDevice):
    """The recorded stereo camera."""

    def describe(self) -> StereoInfo:
        """Say what camera the recording was made with."""
        return self._replay.first().stereo.info

    def capture(self) -> StereoFrame:
        """Give the recorded point map."""
        frame = self._replay.view().stereo
        self._replay.captured = True
        return frame


class ReplayOperator(_Replayed, Operator):
    """The operator who placed the recorded scenes."""

    def place(self, scene: str) -> None:
        """Go to a recorded scene."""
        self._replay.place(scene)

    def truth(self) -> Truth | None:
        """Return what the recording knows of the present view, if it was simulated."""
        return self._replay.view().truth


DRIVERS = {"arm": ReplayArm, "tof": ReplayTof, "stereo": ReplayStereo, "operator": ReplayOperator}


def write_station(recording: Path, folder: Path, order: str = "joints") -> Path:
    """Write a station that replays a recording with the plan, the seed and the rig that it was made with.

    ``station.toml`` and ``rig.toml`` go into ``folder``, made when missing; for ``order`` see :class:`Replay`. Returns the
    path of the station.
    """
    import tomli_w

    try:
        made_with = tomllib.loads((recording / "station.toml").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(f"{recording}: expected a recording with station.toml: {err}") from err
    station: dict[str, Any] = {k: made_with[k] for k in ("plan", "sim") if k in made_with}
    for role in ROLES:
        station[role] = {"driver": "replay"}
    station["arm"] |= {"recording": str(recording.resolve()), "order": order}
    station["rig"] = {"path": "rig.toml"}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(dumps_rig(Replay(recording, order).first().rig), encoding="utf-8")
    (folder / "station.toml").write_text(tomli_w.dumps(station), encoding="utf-8")
    return folder / "station.toml"


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(f"usage: {sys.executable} -m tofcapture.devices.replay RECORDING FOLDER")
    print(write_station(Path(sys.argv[1]), Path(sys.argv[2])))
