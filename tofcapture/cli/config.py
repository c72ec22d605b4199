"""``tofcapture config show``: the configuration that holds, and where each value comes from."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tofcapture.command import Command, Outcome

VARIABLES = ("TOFCAPTURE_STATION", "TOFCAPTURE_STATE", "TOFCAPTURE_TRACEBACK", "NO_COLOR", "OMP_NUM_THREADS")


def _configure(parser: argparse.ArgumentParser) -> None:
    parts = parser.add_subparsers(dest="what", metavar="WHAT", required=True, parser_class=type(parser))
    show = parts.add_parser("show", help="print what holds", description="print what holds")
    show.add_argument("--origin", action="store_true", help="say of each value where it comes from")
    show.add_argument(
        "--station",
        type=Path,
        metavar="TOML",
        help="station (default: $TOFCAPTURE_STATION, else the simulated one)",
    )
    show.add_argument("--seed", type=int, help="as record takes it")
    show.add_argument("--json", action="store_true", help="print the result as one JSON object")


def station_path(flag: Path | None) -> tuple[Path | None, str]:
    """Station file that holds, ``None`` for the packaged one, and who named it.

    Parameters
    ----------
    flag
        What ``--station`` says.
    """
    if flag is not None:
        return flag, "--station"
    if given := os.environ.get("TOFCAPTURE_STATION"):
        return Path(given), "$TOFCAPTURE_STATION"
    return None, "built in"


def _leaves(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import DEFAULT, read_station

    path, who = station_path(args.station)
    where = f"{path or DEFAULT} ({who})"
    rows = [(name, value, where) for name, value in _leaves(read_station(path))]
    if args.seed is not None:
        read_station(path, args.seed)  # refuses a seed that record refuses
        rows = [row for row in rows if row[0] != "sim.seed"] + [("sim.seed", args.seed, "--seed")]
    rows += [(name, os.environ[name], "environment") for name in VARIABLES if name in os.environ]
    lines = [
        f"{name} = {value!r}" + (f"    # {origin}" if args.origin else "") for name, value, origin in rows
    ]
    data = {"values": [{"name": n, "value": v, "origin": o} for n, v, o in rows]}
    return Outcome(data, "\n".join(lines))


COMMAND = Command(
    help="show the configuration that holds, and where each value comes from",
    example="tofcapture config show --origin",
    configure=_configure,
    run=_run,
)
