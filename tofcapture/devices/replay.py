"""The driver ``replay``: a recording's files as arm, ToF camera, stereo camera and operator; see docs/replay.md.

::

    python -m tofcapture.devices.replay_station RECORDING FOLDER      # writes FOLDER/station.toml and FOLDER/rig.toml
    tofcapture record --station FOLDER/station.toml --scene mug --out again
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tofcapture.devices.kinematics import HOME, MODELS, ArmModel, forward
from tofcapture.devices.replay_source import Replay, shared_replay
from tofcapture.errors import ConfigError, DeviceError, MotionRefused
from tofcapture.frames import ArmInfo, ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth
from tofcapture.poses import Float64

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext


class _Replayed:
    """Opens by finding the recording; there is nothing to close."""

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        unknown = table.keys() - {"recording", "order"}
        if unknown:
            raise ConfigError(
                f"replay does not know {', '.join(sorted(unknown))}", hint="it knows recording and order"
            )
        self._context = context

    @property
    def _replay(self) -> Replay:
        return shared_replay(self._context)

    def __enter__(self) -> Self:
        self._replay.scenes()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None


class ReplayArm(_Replayed):
    """The recorded arm: at a recorded view it says what was measured there, elsewhere what it was told."""

    simulated = True  # moves nothing that could hurt anyone

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        super().__init__(table, context)
        self._between: Float64 = HOME.copy()
        self._at_view = self._open = False

    def __enter__(self) -> Self:
        super().__enter__()
        self._open = True
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

        Raises
        ------
        MotionRefused
            Not six finite angles within the arm's limits.
        DeviceError
            By number, and there is no further view.
        """
        goal = np.array(joints, dtype=np.float64)
        limit = self._model().limit
        if goal.shape != (6,) or not np.isfinite(goal).all() or np.abs(goal).max() > limit:
            raise MotionRefused(
                f"move: expected 6 finite joint angles within +-{limit:.3f} rad, got {goal.tolist()}"
            )
        self._between = goal
        self._at_view = self._replay.go(goal) is not None
        return self.state()

    def _model(self) -> ArmModel:
        return MODELS.get(self.describe().model, MODELS["ur10e"])

    def stop(self) -> None:
        """Do nothing: a replayed move is over when it returns."""


class ReplayTof(_Replayed):
    """The recorded ToF camera."""

    def describe(self) -> TofInfo:
        """Say what camera the recording was made with."""
        return self._replay.first().tof.info

    def capture(self, frames: int) -> TofBurst:
        """Give the first ``frames`` frames of the recorded burst.

        Raises
        ------
        DeviceError
            No view is here, or its burst is shorter.
        """
        burst = self._replay.view().tof
        if not 1 <= frames <= len(burst.raw):
            raise DeviceError(
                f"replay: expected 1 to {len(burst.raw)} frames, which the recording has, got {frames}",
                hint=f"record with --frames {len(burst.raw)}",
            )
        self._replay.captured = True
        return TofBurst(burst.raw[:frames], burst.time_ns[:frames], burst.celsius[:frames], burst.info)


class ReplayStereo(_Replayed):
    """The recorded stereo camera."""

    def describe(self) -> StereoInfo:
        """Say what camera the recording was made with."""
        return self._replay.first().stereo.info

    def capture(self) -> StereoFrame:
        """Give the recorded point map."""
        frame = self._replay.view().stereo
        self._replay.captured = True
        return frame


class ReplayOperator(_Replayed):
    """Who placed the recorded scenes."""

    def place(self, scene: str) -> None:
        """Go to a recorded scene."""
        self._replay.place(scene)

    def truth(self) -> Truth | None:
        """Return what the recording knows of the present view, if it was simulated."""
        return self._replay.view().truth


DRIVERS = {"arm": ReplayArm, "tof": ReplayTof, "stereo": ReplayStereo, "operator": ReplayOperator}
