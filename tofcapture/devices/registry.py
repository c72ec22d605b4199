"""Drivers, found by entry point.

An entry point of the group ``tofcapture.drivers`` has the driver's name in ``station.toml``. It points at a mapping
``DRIVERS: {role: factory}``. A factory takes the device's own table and the station's context, and returns a device
without doing any I/O.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices import Arm, Operator, StereoDevice, TofCamera
from tofcapture.devices.kinematics import ArmModel, dh_model
from tofcapture.devices.urdf import urdf_model
from tofcapture.errors import ConfigError, DeviceError, TofError

GROUP = "tofcapture.drivers"
_PROTOCOLS: dict[str, type] = {"arm": Arm, "tof": TofCamera, "stereo": StereoDevice, "operator": Operator}
ROLES = tuple(_PROTOCOLS)


@dataclass(frozen=True)
class StationContext:
    """All that a driver may know of its station.

    ``shared`` is for what drivers of one station share, such as the simulated world. The station puts every open device
    there under its role. A driver that knows where the cameras sit on the flange puts a nominal ``Rig`` there, under ``rig``.
    """

    config: Mapping[str, Any]  # the whole station.toml
    folder: Path  # where that file lies; relative paths in it start here
    shared: dict[str, Any] = field(default_factory=dict)
    allow_motion: bool = False  # the operator allowed real arms to move, in this run


Factory = Callable[[Mapping[str, Any], StationContext], Any]


def check_keys(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Raise ConfigError for settings that are not known, and name those that are; ``where`` is ``[tof]`` or the like."""
    known = tuple(known)
    if unknown := sorted(table.keys() - set(known)):
        hint = f"it knows {', '.join(known)}" if known else "it takes no settings"
        raise ConfigError(f"{where} does not know {', '.join(unknown)}", hint=hint)


def found_drivers() -> dict[str, EntryPoint]:
    """All registered drivers by name, not yet imported."""
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda e: e.name)}


def load_driver(name: str) -> Mapping[str, Factory]:
    """Import a driver; returns role -> factory.

    Raises :class:`ConfigError`: no such driver, or it does not import, or it is not a mapping of known roles.
    """
    found = found_drivers()
    if name not in found:
        raise ConfigError(
            f"driver: expected one of {', '.join(found) or '(none is installed)'}, got {name!r}",
            hint="tofcapture doctor lists the drivers and what is wrong with them",
        )
    try:
        drivers = found[name].load()
    except TofError:
        raise
    except Exception as err:
        raise ConfigError(f"driver {name!r} ({found[name].value}) does not import: {err}") from err
    if not isinstance(drivers, Mapping) or not drivers or not set(drivers) <= set(ROLES):
        raise ConfigError(
            f"driver {name!r} ({found[name].value}): expected a mapping of roles {ROLES} to factories"
        )
    return drivers


def make_device(role: str, context: StationContext) -> Any:
    """Make the device that the station's table ``[role]`` names, without opening it.

    Raises :class:`ConfigError`: the table is missing or names no driver, the driver is unknown, does not do
    this role, or lacks a method of it.
    """
    table = context.config.get(role)
    if not isinstance(table, Mapping) or not isinstance(table.get("driver"), str):
        hint = "compare with: tofcapture config show"
        raise ConfigError(
            f'station: expected a table [{role}] with driver = "name", got {table!r}', hint=hint
        )
    name = table["driver"]
    drivers = load_driver(name)
    if role not in drivers:
        raise ConfigError(
            f"[{role}] driver {name!r}: expected a driver for {role}, it has {', '.join(sorted(drivers))}"
        )
    own = {k: v for k, v in table.items() if k not in {"driver", "kinematics"}}
    device = drivers[role](own, context)
    if missing := lacking(role, device):
        raise ConfigError(
            f"[{role}] driver {name!r} lacks {', '.join(missing)}",
            hint=f"its class should subclass tofcapture.devices.{_PROTOCOLS[role].__name__}; see docs/drivers.md",
        )
    return device


def lacking(role: str, device: object) -> list[str]:
    """Names of the role's protocol that a device does not have."""
    names = {n for n in dir(_PROTOCOLS[role]) if not n.startswith("_")} | {"__enter__", "__exit__"}
    return sorted(names - set(dir(device)))


def arm_kinematics(arm: Arm, context: StationContext) -> ArmModel:
    """Find an arm's geometry: its driver's, else that of the station's table ``[arm.kinematics]``.

    Raises ConfigError: neither gives it, or both do, or the table is wrong.
    """
    table = context.config.get("arm", {}).get("kinematics")
    try:
        known = arm.kinematics()
    except ConfigError as err:
        if table is not None:
            return _own_model(arm.describe().model, table, context.folder)
        raise ConfigError(
            f"[arm]: nobody knows its kinematics: {err.message}",
            hint="let its driver's kinematics() return them, or add a table [arm.kinematics]; see docs/howto/own-arm.md",
        ) from err
    if table is not None:
        raise ConfigError(
            f"[arm.kinematics]: the driver brings its own, of the {known.name}; leave the table out"
        )
    return known


def _own_model(name: str, table: Any, folder: Path) -> ArmModel:
    """Read ``[arm.kinematics]``; angles are in degrees there, lengths in metres."""
    try:
        check_keys(table, ("urdf", "base", "tip", "dh", "low_deg", "high_deg", "radius"), "[arm.kinematics]")
        limits = {
            k: np.radians(np.array(table[f"{k}_deg"], float)) for k in ("low", "high") if f"{k}_deg" in table
        }
        radius = float(table.get("radius", 0.08))
        if "urdf" in table:
            return urdf_model(folder / table["urdf"], table["base"], table["tip"], radius, **limits)
        rows = np.array(table["dh"], dtype=np.float64) * [1, 1, np.pi / 180, np.pi / 180]
        return dh_model(name, rows, radius=radius, **limits)
    except (AttributeError, KeyError, TypeError, ValueError) as err:
        hint = (
            "it has urdf, base and tip, or dh = [[a, d, alpha_deg, theta_deg], ...] of a row a joint, metres"
        )
        raise ConfigError(f"[arm.kinematics]: {type(err).__name__}: {err}", hint=hint) from err


def make_target(target: str, table: Mapping[str, Any], context: StationContext) -> Any:
    """Import ``module:name`` and call it as a factory, for a driver host; raises DeviceError when it does not import."""
    module, _, name = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as err:
        raise DeviceError(f"driver {target}: {err}") from err
    return factory(table, context)
