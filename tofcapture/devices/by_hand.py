"""The drivers ``manual`` and ``tripod``: a person moves the rig, or nobody does; see docs/by-hand.md.

::

    [arm]
    driver = "manual"
    poses = "127.0.0.1:45900"       # leave it out when nothing measures the rig's pose
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import Arm
from tofcapture.devices.faults import NotSettled, StopLatch
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError, MotionRefused, MotionStopped
from tofcapture.frames import ArmInfo, ArmState
from tofcapture.poses import Float64, invert, rotation_angle, transform

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_BLOCK = 16  # px; side of the blocks whose mean depths are compared
_WHOLE = 0.8  # share of a block that both maps must have measured
_FEW = 12  # blocks below which nothing is said
_SURFACES = 80.0  # per cent of the blocks lie on surfaces; those at edges flicker by a centimetre
_EDGES = 97.0  # per cent; a shift along a table is seen at the edges of what stands on it
_LEVER = 0.5  # m; how far a point is moved that a turn of one radian carries along
_WINDOW = 0.2  # s over which poses of a stream are averaged
_SILENCE = 2.0  # s without a pose, after which the stream counts as broken
_ELSEWHERE = 0.02  # m; a rig that has moved by less is where the last view was taken
_JOINTS = np.full(6, np.nan)
_DEFAULTS = {"still": 2e-3, "hold": 1.0, "patience": 600.0}


@dataclass(frozen=True)
class Look:
    """Where the rig is, as far as anything tells: the time (host's monotonic ns), a pose (4, 4) or mean depths (h, w), metres."""

    time_ns: int
    seen: Float64
    T_base_flange: Float64


class Clouds:
    """Judge motion by the stereo camera's point maps; no pose is known, and the identity stands for it."""

    serial = "no poses"

    def __init__(self, context: StationContext) -> None:
        self._shared = context.shared

    def look(self) -> Look:
        """Take a point map; blocks (h, w) of 16 x 16 px have their mean depth, NaN where much is missing."""
        frame = self._shared["stereo"].capture()
        return Look(frame.time_ns, _block_means(frame.points[..., 2]), np.eye(4))

    @staticmethod
    def apart(a: Look, b: Look) -> float:
        """Tell by how much most blocks' depths changed at most, or a tenth of it at edges, metres; infinite for nothing in common."""
        surfaces, edges = _changes(a, b)
        return max(surfaces, 0.1 * edges)

    @staticmethod
    def elsewhere(a: Look, b: Look) -> bool:
        """Tell whether these are different views."""
        return _changes(a, b)[1] > _ELSEWHERE

    def close(self) -> None:
        """Leave the stereo camera, which is the station's, as it is."""


class PoseStream:
    """Judge motion by poses of the flange in a base frame that a tracker sends.

    A datagram of UDP holds one pose as text, a line of the TUM format: ``time x y z qx qy qz qw``, metres. Its time is not used.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ConfigError(f'[arm] poses: expected "127.0.0.1:45900", got {address!r}')
        self.serial = f"poses at {address}"
        self._address = (host, int(port))
        self._socket: socket.socket | None = None

    def _open(self) -> socket.socket:
        if self._socket is None:
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                opened.bind(self._address)
            except OSError as err:
                opened.close()
                where = ":".join(map(str, self._address))
                raise DeviceError(
                    f"[arm] poses: {where}: {err}", hint="does another program listen?"
                ) from err
            self._socket = opened
        return self._socket

    def look(self) -> Look:
        """Average the poses of 0.2 s, those that waited left out.

        Raises
        ------
        DeviceError
            None came for two seconds, or one that is no pose.
        """
        link = self._open()
        link.settimeout(0.0)
        while _received(link) is not None:
            pass  # older than now
        link.settimeout(_SILENCE)
        if (first := _received(link)) is None:
            raise DeviceError(
                f"[arm] {self.serial}: no pose for {_SILENCE:g} s",
                hint="does the tracker run, and see the rig?",
            )
        poses, end = [_parse(first)], time.monotonic() + _WINDOW
        while (left := end - time.monotonic()) > 0:
            link.settimeout(left)
            if (more := _received(link)) is not None:
                poses.append(_parse(more))
        mean = _mean_pose(np.array(poses))
        return Look(time.monotonic_ns(), mean, mean)

    @staticmethod
    def apart(a: Look, b: Look) -> float:
        """Tell how far the rig moved, metres; one radian counts as half a metre."""
        T = invert(a.seen) @ b.seen
        return float(np.linalg.norm(T[:3, 3])) + _LEVER * rotation_angle(T)

    def elsewhere(self, a: Look, b: Look) -> bool:
        """Tell whether these are different views."""
        return self.apart(a, b) > _ELSEWHERE

    def close(self) -> None:
        """Listen no longer."""
        link, self._socket = self._socket, None
        if link is not None:
            link.close()


class ByHand(Arm):
    """A rig that a person carries.

    Parameters
    ----------
    table
        ``poses`` (where a tracker sends them; the point maps judge without); ``still`` (metres that count as motion, default
        2 mm), ``hold`` (seconds that the rig must stand still, default 1), ``patience`` (seconds for a view, default 600).
    context
        The station, whose stereo camera looks.
    """

    by_hand = True

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        check_keys(table, ("poses", *_DEFAULTS), "[arm]")
        numbers = {**_DEFAULTS, **{k: v for k, v in table.items() if k in _DEFAULTS}}
        wrong = [k for k, v in numbers.items() if not isinstance(v, int | float) or not 0 < v < math.inf]
        if wrong:
            raise ConfigError(f"[arm] {wrong[0]}: expected a number above 0, got {numbers[wrong[0]]!r}")
        self._still, self._hold, self._patience = (float(numbers[k]) for k in _DEFAULTS)
        self._eyes: PoseStream | Clouds = (
            PoseStream(str(table["poses"])) if "poses" in table else Clouds(context)
        )
        self._taken: tuple[int, Look] | None = None  # the view it stands at, and what was seen there
        self._open = False
        self._latch = StopLatch()

    def __enter__(self) -> Self:
        self._open, self._taken, self._latch = True, None, StopLatch()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open = False
        self._eyes.close()

    def describe(self) -> ArmInfo:
        """Say that it is no arm, and who knows its poses."""
        return ArmInfo("tripod" if self.fixed else "by hand", self._eyes.serial)

    def state(self) -> ArmState:
        """Tell where the rig is, joints NaN, and see that it stands still where it was brought.

        Raises
        ------
        NotSettled
            It has moved since it stood still.
        DeviceError
            It is not open, or nothing tells where it is.
        """
        self._need_open()
        now = self._look()
        if self._taken and (far := self._eyes.apart(self._taken[1], now)) > self._still:
            raise NotSettled(
                f"the rig moved by {far * 1e3:.1f} mm during the view", hint="hold it still, or set it down"
            )
        return ArmState(_JOINTS.copy(), now.T_base_flange, now.time_ns)

    def move_to(self, joints: Float64) -> ArmState:
        """Refuse: it has no motors."""
        del joints
        raise MotionRefused("this rig is moved by hand", hint="tofcapture record asks for each view")

    def await_view(self, index: int) -> ArmState:
        """Wait until the rig stands still, and elsewhere than at the view before; the same view again may stay.

        Raises
        ------
        MotionStopped
            Somebody said stop, or nobody brought it to rest in time.
        """
        self._need_open()
        token = self._latch.token
        start = since = self._look()
        while True:
            self._latch.check(token)
            now = self._look()
            if self._eyes.apart(since, now) > self._still:
                since = now
            if now.time_ns - since.time_ns >= self._hold * 1e9 and self._elsewhere(index, now):
                self._taken = (index, now)
                return ArmState(_JOINTS.copy(), now.T_base_flange, now.time_ns)
            if now.time_ns - start.time_ns > self._patience * 1e9:
                trouble = "stand still" if since is now else "leave the place of the view before"
                raise MotionStopped(
                    f"view {index}: the rig did not {trouble} within {self._patience:g} s",
                    hint="ask for the same scene again to go on; set it down, or raise [arm] still or patience",
                )

    def stop(self) -> None:
        """End the waiting; the person has to stop by themself."""
        self._latch.stop()

    def resume(self) -> None:
        """Wait again when asked."""
        self._latch.resume(self._latch.token)

    def _elsewhere(self, index: int, now: Look) -> bool:
        if self.fixed or self._taken is None or self._taken[0] == index:
            return True
        return self._eyes.elsewhere(self._taken[1], now)

    def _look(self) -> Look:
        try:
            return self._eyes.look()
        except KeyError as err:
            raise DeviceError("the rig's stereo camera is not open", hint="open the whole station") from err

    def _need_open(self) -> None:
        if not self._open:
            raise DeviceError("the rig is not open", hint="use the station as a context manager")


class Tripod(ByHand):
    """A rig that stands on a tripod: nobody moves it between views, the object may be turned."""

    fixed = True


def _changes(a: Look, b: Look) -> tuple[float, float]:
    """Find the largest change of depth, metres, of blocks on surfaces, and of nearly all."""
    change = np.abs(a.seen - b.seen)
    change = change[np.isfinite(change)]
    if len(change) < _FEW:
        return math.inf, math.inf
    surfaces, edges = np.percentile(change, (_SURFACES, _EDGES))
    return float(surfaces), float(edges)


def _block_means(depth: NDArray[np.float32]) -> Float64:
    """Average depth (H, W) over blocks; NaN where much of one is missing."""
    rows, columns = depth.shape[0] // _BLOCK, depth.shape[1] // _BLOCK
    blocks = depth[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    there = np.isfinite(blocks)
    count = there.sum(axis=(1, 3))
    total = np.where(there, blocks, 0).sum(axis=(1, 3), dtype=np.float64)
    return np.where(count >= _WHOLE * _BLOCK**2, total / np.maximum(count, 1), np.nan)


def _received(link: socket.socket) -> bytes | None:
    """Take one datagram; ``None`` when there is none in time."""
    try:
        return link.recv(4096)
    except (BlockingIOError, TimeoutError):
        return None


def _parse(line: bytes) -> list[float]:
    """Read a line of the TUM format into ``x y z qx qy qz qw``."""
    try:
        _, *numbers = map(float, line.decode("ascii").split())
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not np.isfinite(numbers).all() or abs(math.hypot(*numbers[3:]) - 1) > 0.01:
        raise DeviceError(
            f"[arm] poses: expected 'time x y z qx qy qz qw' with a unit quaternion, got {line[:80]!r}",
            hint="metres; one pose in each datagram",
        )
    return numbers


def _mean_pose(poses: Float64) -> Float64:
    """Average poses (N, 7) that are near each other into (4, 4)."""
    from scipy.spatial.transform import Rotation

    return transform(Rotation.from_quat(poses[:, 3:]).mean().as_matrix(), poses[:, :3].mean(axis=0))


MANUAL = {"arm": ByHand}
TRIPOD = {"arm": Tripod}
