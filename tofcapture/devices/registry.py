"""Drivers, found by entry point.

An entry point of the group ``tofcapture.drivers`` is named as the driver is in ``station.toml`` and points at a mapping
``DRIVERS: {role: factory}``. A factory takes the device's own table and the station's context and returns a device; like
every constructor of a driver it does no I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError, TofError

GROUP = "tofcapture.drivers"
ROLES = ("arm", "tof", "stereo", "operator")


@dataclass(frozen=True)
class StationContext:
    """What every driver of one station may know.

    Attributes
    ----------
    config
        The whole ``station.toml``.
    folder
        Where that file lies; relative paths in it start here.
    shared
        Drivers that belong together keep what they share here, for instance the simulated world. The station puts every
        device here, under its role, as soon as it is open.
    allow_motion
        The operator allowed real arms to move, in this run.
    """

    config: Mapping[str, Any]
    folder: Path
    shared: dict[str, Any] = field(default_factory=dict)
    allow_motion: bool = False


Factory = Callable[[Mapping[str, Any], StationContext], Any]


def found_drivers() -> dict[str, EntryPoint]:
    """All registered drivers by name, not yet imported."""
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP), key=lambda e: e.name)}


def load_driver(name: str) -> Mapping[str, Factory]:
    """Import a driver.

    Returns
    -------
    Mapping
        Role -> factory.

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
        The table is missing or names no driver, the driver is unknown or does not do this role.
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
    return drivers[role]({k: v for k, v in table.items() if k != "driver"}, context)
