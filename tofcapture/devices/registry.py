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

from tofcapture.devices import Arm, Operator, StereoDevice, TofCamera
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

    Raises
    ------
    ConfigError
        No such driver, or it does not import, or it is not a mapping of known roles.
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

    Raises
    ------
    ConfigError
        The table is missing or names no driver, the driver is unknown, does not do this role, or lacks a method of it.
    """
    table = context.config.get(role)
    if not isinstance(table, Mapping) or not isinstance(table.get("driver"), str):
        raise ConfigError(f'station: expected a table [{role}] with driver = "name", got {table!r}')
    name = table["driver"]
    drivers = load_driver(name)
    if role not in drivers:
        raise ConfigError(
            f"[{role}] driver {name!r}: expected a driver for {role}, it has {', '.join(sorted(drivers))}"
        )
    device = drivers[role]({k: v for k, v in table.items() if k != "driver"}, context)
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


def make_target(target: str, table: Mapping[str, Any], context: StationContext) -> Any:
    """Import ``module:name`` and call it as a factory, for a driver host; raises DeviceError when it does not import."""
    module, _, name = target.partition(":")
    try:
        factory = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as err:
        raise DeviceError(f"driver {target}: {err}") from err
    return factory(table, context)
