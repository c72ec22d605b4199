"""Define what an installation holds: ``tofcapture config`` and ``completion``, the station in use, the bundled weights."""

from __future__ import annotations

import argparse
import json
import math
import os
import struct
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command, Outcome
from tofcapture.errors import FormatError

VARIABLES = ("TOFCAPTURE_STATION", "TOFCAPTURE_STATE", "TOFCAPTURE_TRACEBACK", "NO_COLOR", "OMP_NUM_THREADS")
SHELLS = ("bash", "zsh", "tcsh", "fish")
_LONGEST = 1 << 24  # bytes of a header; a file that claims more is no checkpoint


def station_path(flag: Path | None) -> tuple[Path | None, str]:
    """Find the station file that holds, ``None`` for the packaged one, and who named it: ``--station`` is ``flag``."""
    if flag is not None:
        return flag, "--station"
    if given := os.environ.get("TOFCAPTURE_STATION"):
        return Path(given), "$TOFCAPTURE_STATION"
    return None, "built in"


@dataclass(frozen=True)
class BundledWeights:
    """Bundled weights: the file, its size in bytes, the kind of network, how many weights it has."""

    path: Path
    size: int
    kind: str
    weights: int

    def __str__(self) -> str:
        return f"{self.kind}, {self.weights / 1e6:.2f} million weights, {self.size / 1e6:.1f} MB"


def bundled_path() -> Path | None:
    """Find the bundled weights without importing what runs them; ``None`` when there are none."""
    spec = find_spec("tofcapture_model")
    for folder in (spec and spec.submodule_search_locations) or ():
        path = Path(folder) / "weights" / "model.safetensors"
        if path.is_file():
            return path
    return None


def describe_weights(path: Path) -> BundledWeights:
    """Read the header of a checkpoint (safetensors: eight bytes of length, then JSON).

    Raises :class:`FormatError`: it is none, or is cut short.
    """
    try:
        with path.open("rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(min(length, _LONGEST)))
        kind = tomllib.loads(header.pop("__metadata__")["config"])["network"]["kind"]
        end = 8 + length + max(t["data_offsets"][1] for t in header.values())
        count = sum(math.prod(t["shape"]) for t in header.values())
    except (struct.error, ValueError, KeyError, TypeError, AttributeError) as err:
        raise FormatError(f"{path}: not a checkpoint: {err!r}", hint="install tofcapture again") from err
    size = path.stat().st_size
    if size != end:
        raise FormatError(f"{path}: expected {end} bytes, got {size}", hint="install tofcapture again")
    return BundledWeights(path, size, str(kind), count)


def _configure_config(parser: argparse.ArgumentParser) -> None:
    parts = parser.add_subparsers(dest="what", metavar="WHAT", required=True, parser_class=type(parser))
    add = parts.add_parser("show", help="print what holds", description="print what holds").add_argument
    add("--origin", action="store_true", help="say of each value where it comes from")
    station = "station (default: $TOFCAPTURE_STATION, else the simulated one)"
    add("--station", type=Path, metavar="STATION.toml", help=station)
    add("--seed", type=int, metavar="N", help="as record takes it")


def _leaves(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _run_config(args: argparse.Namespace) -> Outcome:
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


def _configure_completion(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=SHELLS, help="bash, zsh, tcsh or fish")


def _run_completion(args: argparse.Namespace) -> Outcome:
    import shtab

    from tofcapture.cli import all_commands, parser

    top = parser(all_commands())
    _complete_paths(top, shtab.FILE)
    text = shtab.complete(top, args.shell)
    return Outcome({"shell": args.shell, "script": text}, text.rstrip())


def _complete_paths(parser: argparse.ArgumentParser, files: Mapping[str, str]) -> None:
    """Have paths completed by the names of files, in every command."""
    for action in parser._actions:  # noqa: SLF001  argparse tells it in no other way
        if action.type is Path:
            action.complete = files  # type: ignore[attr-defined]
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            for sub in action.choices.values():
                _complete_paths(sub, files)


CONFIG = Command(
    help="show the configuration that holds, and where each value comes from",
    example="tofcapture config show --origin",
    configure=_configure_config,
    run=_run_config,
)
COMPLETION = Command(
    help="print a script that completes commands in bash, zsh, tcsh or fish",
    example="tofcapture completion bash",
    configure=_configure_completion,
    run=_run_completion,
)
