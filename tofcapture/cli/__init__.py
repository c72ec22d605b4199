"""The one program, ``tofcapture``.

Commands are found in the entry-point group ``tofcapture.commands``; a sibling package adds its own and is imported only when
asked for. Results go to stdout, progress and errors to stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points

from tofcapture import __version__
from tofcapture.cli.kit import Command, Outcome
from tofcapture.errors import ConfigError, TofError, UsageError

GROUP = "tofcapture.commands"
EXIT_CODES = "exit codes: 0 ok, 1 unexpected, 2 usage, 3 config, 4 device, 5 data, 6 quality gate, 7 busy, 130 interrupted"
DESCRIPTION = "Capture paired ToF raw data and stereo ground truth on a robot arm, build datasets, train networks on them."
# fmt: off
ORDER = (
    "demo", "doctor", "record", "daemon", "status", "stop", "simulate", "simulate-dataset", "align", "calibrate",
    "build-dataset", "check", "stats", "view", "figure", "pack", "export-dataset",
    "train", "evaluate", "predict", "export", "report", "config", "completion",
)
# fmt: on
"""Commands in the order in which they are listed; those of other packages come last."""


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises, so that ``--json`` covers usage errors too."""

    def error(self, message: str) -> None:  # type: ignore[override]
        raise UsageError(message, hint=f"{self.prog} --help")


def _found() -> dict[str, EntryPoint]:
    found = {e.name: e for e in entry_points(group=GROUP)}
    if not found:
        raise ConfigError("no commands are registered", hint="install the package: pip install '.[all]'")
    names = sorted(found, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))
    return {name: found[name] for name in names}


def _load(entry: EntryPoint) -> Command:
    command = entry.load()
    if not isinstance(command, Command):
        raise ConfigError(
            f"{entry.value}: expected a tofcapture.cli.kit.Command, got {type(command).__name__}"
        )
    return command


def all_commands() -> dict[str, Command]:
    """Load every command, in the order of the help."""
    return {name: _load(entry) for name, entry in _found().items()}


def parser(commands: dict[str, Command], *, named: bool = True) -> argparse.ArgumentParser:
    """Build the parser of the given commands, by name.

    Not ``named``, only the list of commands is of use: no command declares arguments, for some import numpy for that.
    """
    top = _Parser(prog="tofcapture", description=DESCRIPTION, epilog=EXIT_CODES)
    top.add_argument("--version", action="version", version=f"tofcapture {__version__}")
    subs = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, command in commands.items():
        sub = subs.add_parser(
            name,
            help=command.help,
            description=command.help,
            epilog=f"example:\n  {command.example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if named:
            command.configure(sub)
        sub.add_argument("--json", action="store_true", help="print the result as one JSON object")
    return top


def _run(argv: Sequence[str]) -> Outcome:
    entries = _found()
    named = next((a for a in argv if not a.startswith("-")), None)
    wanted = {named: entries[named]} if named in entries else entries
    top = parser({name: _load(entry) for name, entry in wanted.items()}, named=named in entries)
    args = top.parse_args(argv)
    if args.command is None:
        return Outcome(text=top.format_help().rstrip())
    return _load(entries[args.command]).run(args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every expected error becomes at most a few lines on stderr."""
    argv = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in argv
    try:
        outcome = _run(argv)
    except TofError as err:
        return _failed(type(err).__name__, err.message, err.hint, err.exit_code, as_json=as_json)
    except KeyboardInterrupt:
        hint = "run the same command again to go on"
        return _failed("Interrupted", "interrupted", hint, 130, as_json=as_json)
    except (ModuleNotFoundError, OSError) as err:
        if os.environ.get("TOFCAPTURE_TRACEBACK"):
            raise
        if isinstance(err, ModuleNotFoundError):
            hint = "pip install 'tofcapture[all]'"
            return _failed("Missing", f"the library {err.name} is missing", hint, 3, as_json=as_json)
        hint = "set TOFCAPTURE_TRACEBACK=1 to see where"
        return _failed(type(err).__name__, str(err), hint, 1, as_json=as_json)
    _tell(json.dumps(outcome.data, allow_nan=False, default=str) if as_json else outcome.text)
    return outcome.exit_code


def _tell(text: str) -> None:
    """Print a result; whoever closes the pipe early (``| head``) has read enough."""
    if not text:
        return
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # Else the interpreter complains as it ends, when it flushes what is left.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _failed(kind: str, message: str, hint: str, code: int, *, as_json: bool) -> int:
    if as_json:
        error = {"kind": kind, "message": message, "hint": hint, "exit_code": code}
        print(json.dumps({"ok": False, "error": error}))
        return code
    print(f"tofcapture: {message}", file=sys.stderr)
    if hint:
        print(f"  try: {hint}", file=sys.stderr)
    return code
