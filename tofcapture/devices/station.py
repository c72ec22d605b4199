"""A station: one arm, one ToF camera, one stereo camera, one operator, opened together.

::

    with open_station(Path("station.toml")) as station:
        station.arm.move_to(joints)
"""

from __future__ import annotations

import contextlib
import sys
import threading
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.devices import Arm, Operator, StereoDevice, TofCamera
from tofcapture.devices.faults import StopLatch
from tofcapture.devices.kinematics import ArmModel
from tofcapture.devices.registry import ROLES, StationContext, arm_kinematics, make_device
from tofcapture.errors import ConfigError, DeviceError, MotionRefused, TofError
from tofcapture.files.hdf import stereo_table, tof_table
from tofcapture.frames import ArmState
from tofcapture.poses import Float64
from tofcapture.rig import Rig, load_rig

_TABLES = (*ROLES, "sim", "plan", "rig")
DEFAULT = Path(__file__).with_name("station.toml")


@dataclass(frozen=True)
class Station:
    """Open devices."""

    arm: Arm
    tof: TofCamera
    stereo: StereoDevice
    operator: Operator
    rig: Rig  # as known before alignment: a drawing, or an earlier rig.toml
    config: Mapping[str, Any]  # the effective station.toml

    @property
    def seed(self) -> int:
        """Seed of the simulated world and of the view plan."""
        return int(self.config.get("sim", {}).get("seed", 0))

    @property
    def world(self) -> dict[str, Any]:
        """Tell what a simulated world is made of; faults on demand come and go without making it another."""
        return {key: value for key, value in self.config.get("sim", {}).items() if key != "faults"}

    @property
    def simulated(self) -> bool:
        """True when no real arm moves."""
        return self.arm.simulated

    def describe(self) -> dict[str, Any]:
        """Say which devices these are, as JSON types; equal for the same devices."""
        arm = self.arm.describe()
        return {
            "arm": {"model": arm.model, "serial": arm.serial},
            "tof": tof_table(self.tof.describe()),
            "stereo": stereo_table(self.stereo.describe()),
        }


def read_station(path: Path | None, seed: int | None = None) -> dict[str, Any]:
    """Read ``station.toml``, or the embedded simulated station, and check its tables; ``seed`` replaces ``[sim] seed``.

    Raises :class:`ConfigError`: unreadable, not TOML, unknown or misplaced tables.
    """
    where = path or DEFAULT
    try:
        config = tomllib.loads(where.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(
            f"{where}: cannot read the station: {err}", hint="leave --station out for the simulated one"
        ) from err
    wrong = [key for key, table in config.items() if key not in _TABLES or not isinstance(table, Mapping)]
    if wrong:
        raise ConfigError(
            f"{where}: expected the tables {', '.join(_TABLES)}, got {', '.join(wrong)}",
            hint=f"compare with {DEFAULT}",
        )
    if seed is not None:
        config["sim"] = {**config.get("sim", {}), "seed": seed}
    found = config.get("sim", {}).get("seed", 0)
    if not isinstance(found, int) or found < 0:
        raise ConfigError(f"{where}: [sim] seed: expected a whole number from 0 on, got {found!r}")
    return config


@contextmanager
def open_station(
    path: Path | None = None, seed: int | None = None, *, allow_motion: bool = False
) -> Iterator[Station]:
    """Open every device of a station; on leaving, stop the arm after an error, and close all in reverse order.

    Raises :class:`ConfigError`: the file is wrong; :class:`DeviceError`: devices do not open; the message
    names all of them.

    Parameters
    ----------
    path
        ``station.toml``; ``None`` for the embedded simulated station.
    seed
        Replaces ``[sim] seed``.
    allow_motion
        Let a real arm move. Without it ``station.arm`` refuses every ``move_to``; simulated arms always move.
    """
    config = read_station(path, seed)
    folder = (path or DEFAULT).resolve().parent
    context = StationContext(config=config, folder=folder, allow_motion=allow_motion)
    with ExitStack() as stack:
        devices = _open_all(context, stack)
        rig = _rig(context)
        arm: Arm = devices["arm"]
        arm.equip(rig)
        for caution in arm.cautions():
            print(f"tofcapture: caution: {caution}", file=sys.stderr, flush=True)
        model = None if arm.by_hand else arm_kinematics(arm, context)
        devices["arm"] = StationArm(arm, model, allowed=allow_motion or arm.simulated)
        station = Station(**devices, rig=rig, config=config)
        try:
            yield station
        except BaseException:
            station.arm.stop()
            raise


class StationArm:
    """The arm of an open station: it moves only in a run that allows it, and after a stop only when the operator resumes.

    That holds whatever its driver does. All else is the driver's.
    """

    def __init__(self, arm: Arm, model: ArmModel | None, *, allowed: bool) -> None:
        self._arm, self._model, self._allowed = arm, model, allowed
        self._latch = StopLatch()
        self._moves: set[object] = set()  # those that run

    def __getattr__(self, name: str) -> Any:
        return getattr(self._arm, name)

    def kinematics(self) -> ArmModel:
        """Give the arm's geometry: the driver's, or the station's; ConfigError where a person is the arm."""
        if self._model is None:
            raise ConfigError("a rig that is moved by hand has no kinematics")
        return self._model

    def move_to(self, joints: Float64) -> ArmState:
        """Move there, if this run allows it and nobody has said stop; raises MotionRefused."""
        if not self._allowed:
            raise MotionRefused(
                f"the arm {self._arm.describe().model} is real and motion was not allowed in this run",
                hint="look at --dry-run, clear the workspace, then add --allow-motion",
            )
        token, move = self._latch.token, object()
        self._moves.add(move)  # before the check: a stop that comes after it sees that something moves
        try:
            self._latch.check(token)
            state = self._arm.move_to(joints)
            self._latch.check(token)
            return state
        finally:
            self._moves.discard(move)

    def stop(self) -> None:
        """Stop moving now, and stay so; a driver that begins a move nevertheless is told again and again."""
        self._latch.stop()
        if moves := set(self._moves):
            threading.Thread(target=self._insist, args=(moves,), daemon=True).start()
        self._arm.stop()

    def _insist(self, moves: set[object]) -> None:
        """Tell the driver to stop until these moves are over."""
        while moves & self._moves:
            with contextlib.suppress(Exception):  # whatever it raises: it is told again
                self._arm.interrupt()
                self._arm.stop()
            threading.Event().wait(0.02)

    def resume(self) -> None:
        """Let the arm move again after a stop."""
        token = self._latch.token
        self._arm.resume()
        self._latch.resume(token)


def _open_all(context: StationContext, stack: ExitStack) -> dict[str, Any]:
    """Make and open each device; one error that names every device that failed."""
    devices: dict[str, Any] = {}
    failures: list[tuple[str, TofError]] = []
    for role in ROLES:
        try:
            devices[role] = stack.enter_context(make_device(role, context))
            context.shared[role] = devices[role]
        except TofError as err:
            failures.append((role, err))
        except Exception as err:
            failures.append((role, DeviceError(f"{type(err).__name__}: {err}")))
    if failures:
        _refuse(failures)
    return devices


def _refuse(failures: list[tuple[str, TofError]]) -> None:
    """Raise all failures as one; those of one kind, as an arm's protective stop, keep it."""
    kinds = {type(err) for _, err in failures}
    kind: type[TofError] = kinds.pop() if len(kinds) == 1 else DeviceError
    text = "; ".join(f"{role}: {err.message}" for role, err in failures)
    hints = dict.fromkeys(err.hint for _, err in failures if err.hint)
    raise kind(f"{len(failures)} of {len(ROLES)} devices do not open: {text}", hint="; ".join(hints))


def _rig(context: StationContext) -> Rig:
    """Load the named rig, or take the nominal one of a driver that knows it."""
    if path := context.config.get("rig", {}).get("path"):
        return load_rig(context.folder / str(path))
    if "rig" not in context.shared:
        raise ConfigError(
            'station: expected [rig] path = "rig.toml"',
            hint="the bracket's drawing does for a start; see docs/formats.md",
        )
    rig: Rig = context.shared["rig"]
    return rig
