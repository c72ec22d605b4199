"""The one program, ``tofcapture``.

Commands are found in the entry-point group ``tofcapture.commands``; a sibling package adds its own and is imported only when
asked for. Results go to stdout, progress and errors to stderr.
"""

from __future__ import annotations

import argparse
import difflib
import io
import itertools
import json
import os
import re
import signal
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from tofcapture import __version__
from tofcapture.cli.kit import Command, Outcome, at_work
from tofcapture.errors import ConfigError, PassedOver, TofError, UsageError

GROUP = "tofcapture.commands"
_AGAIN = 0.05  # s, until SIGTERM is raised once more
EXIT_CODES = "exit codes: 0 ok, 1 unexpected, 2 usage, 3 config, 4 device, 5 data, 6 quality gate, 7 busy, 130 interrupted"
DESCRIPTION = "Capture paired ToF raw data and stereo ground truth on a robot arm, build datasets, train networks on them."
GROUPS = {
    "begin": ("demo", "doctor", "config", "completion"),
    "record": ("record", "daemon", "status", "stop", "import", "simulate", "simulate-dataset"),
    "calibrate": ("align", "calibrate", "rig"),
    "datasets": ("build-dataset", "check", "stats", "view", "figure", "pack", "export-dataset"),
    "network": ("train", "evaluate", "predict", "export", "report"),
}
"""Commands under the headings of the help; those of other packages stand last, under a heading of their own."""
WIDTH = 79


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises, so that ``--json`` covers usage errors too, and says what was meant instead."""

    def __init__(self, **more: Any) -> None:
        super().__init__(**more, allow_abbrev=False)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse a misspelt option before argparse misses what it would have brought."""
        known = self._option_string_actions
        if not self._subparsers:  # else the options belong to a command
            for word in itertools.takewhile(lambda word: word != "--", args or ()):
                name = word.partition("=")[0]
                if name.startswith("--") and name not in known:
                    raise UsageError(f"no option {name} in {self.prog}", hint=_meant(name, known, self.prog))
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> None:  # type: ignore[override]
        if message.startswith("unrecognized arguments: "):
            word = message.split()[2]
            hint = _meant(word, self._option_string_actions, self.prog) if word.startswith("-") else ""
            raise UsageError(f"nothing is expected after these arguments, got {word!r}", hint=hint)
        chosen = _INVALID_CHOICE.search(message)
        if chosen is None:
            told = _INVALID_VALUE.sub(_expected, message.removeprefix("argument "))
            raise UsageError(told, hint=f"{self.prog} --help")
        where, got, choices = chosen[1], chosen[2], re.findall(r"[\w.-]+", chosen[3])
        known = f"one of {', '.join(choices)}"
        raise UsageError(f"{where}: expected {known}, got {got!r}", hint=_meant(got, choices, self.prog))


_INVALID_CHOICE = re.compile(r"argument (.+): invalid choice: '?(.*?)'? \(choose from (.+)\)")
_INVALID_VALUE = re.compile(r"invalid (.+) value: (.+)")


def _expected(said: re.Match[str]) -> str:
    kind = {"int": "a whole number", "float": "a number"}.get(said[1], said[1])
    return f"expected {kind}, got {said[2]}"


def _meant(got: str, known: Iterable[str], program: str) -> str:
    """Name what is spelt most like ``got``, or where to look."""
    words = {word.lstrip("-"): word for word in known}  # dashes are not what makes two names alike
    near = difflib.get_close_matches(got.lstrip("-"), words, n=1, cutoff=0.7)
    return f"{words[near[0]]} instead; {program} --help lists all" if near else f"{program} --help"


class _Program(_Parser):
    """The parser above all commands; its help lists them in groups."""

    commands: dict[str, Command]

    def format_help(self) -> str:
        groups = {title: [n for n in names if n in self.commands] for title, names in GROUPS.items()}
        groups["more"] = sorted(set(self.commands).difference(*GROUPS.values()))
        lines = ["usage: tofcapture COMMAND ...", "", *textwrap.wrap(DESCRIPTION, WIDTH)]
        for title, names in groups.items():
            lines += ["", f"{title}:"] if names else []
            lines += [line for name in names for line in _wrapped(name, self.commands[name].help)]
        lines += ["", "Every command has --help, with an example, and --json. See also --version."]
        return "\n".join([*lines, *textwrap.wrap(EXIT_CODES, WIDTH, subsequent_indent="  "), ""])


def _wrapped(name: str, text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=f"  {name:<17} ", subsequent_indent=" " * 20)


def _found() -> dict[str, EntryPoint]:
    found = {e.name: e for e in entry_points(group=GROUP)}
    if not found:
        raise ConfigError("no commands are registered", hint="install the package: pip install '.[all]'")
    order = [name for names in GROUPS.values() for name in names]
    names = sorted(found, key=lambda name: (order.index(name) if name in order else len(order), name))
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
    top = _Program(prog="tofcapture")
    top.commands = commands
    top.add_argument("--version", action="version", version=f"tofcapture {__version__}")
    subs = top.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, command in commands.items():
        sub = subs.add_parser(
            name,
            help=command.help,
            description=textwrap.fill(command.help, WIDTH),
            epilog=f"example:\n  {command.example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if named:
            command.configure(sub)
        for each in (sub, *_parts(sub)):
            each.add_argument("--json", action="store_true", help="print the result as one JSON object")
    return top


def _parts(sub: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """List the parsers of a command's parts, as of ``rig show``."""
    chosen = (a.choices for a in sub._actions if isinstance(a, argparse._SubParsersAction))  # noqa: SLF001  argparse tells no other way
    return [part for choices in chosen for part in choices.values()]


def _run(argv: Sequence[str]) -> Outcome:
    entries = _found()
    named = next((a for a in argv if not a.startswith("-")), None)
    if named is not None and named not in entries:
        raise UsageError(f"no command {named!r}", hint=_meant(named, entries, "tofcapture"))
    if named is None:
        top = parser({name: _load(entry) for name, entry in entries.items()}, named=False)
        top.parse_args(argv)
        return Outcome(text=top.format_help().rstrip())
    with at_work(named):
        command = _load(entries[named])
        return command.run(parser({named: command}).parse_args(argv))


class _Terminated(KeyboardInterrupt):
    """SIGTERM came: everything is put away as after Ctrl-C."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Let SIGTERM end a command as Ctrl-C does; commands that have their own way, as the daemon, replace it.

    What is raised in a callback of a library, or while an object goes, Python ignores, which nobody needs to
    read: it is raised again until it is on its way.
    """

    def end(number: int, _: object) -> None:
        signal.signal(number, signal.SIG_IGN)  # the second one must not break into the putting away
        signal.signal(signal.SIGALRM, again)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
        raise _Terminated

    def again(*_: object) -> None:
        error = sys.exc_info()[1]
        while error is not None and not isinstance(error, _Terminated):
            error = error.__context__
        if error is None:
            raise _Terminated

    def unraisable(what: Any) -> None:
        if not issubclass(what.exc_type, _Terminated):
            usual(what)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGALRM, signal.SIGTERM)}
    usual, sys.unraisablehook = sys.unraisablehook, unraisable
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        sys.unraisablehook = usual
        if signal.getsignal(signal.SIGALRM) is again:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _notes_on_one_line() -> Iterator[None]:
    """Name the files that are passed over as other messages are told."""
    usual = warnings.showwarning

    def show(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, PassedOver):
            usual(message, category, *where, **more)
        else:
            print(f"tofcapture: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("default", PassedOver)
        warnings.showwarning = show
        yield


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every expected error becomes at most a few lines on stderr."""
    argv = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A latin-1 terminal shows a Greek folder all the same
            stream.reconfigure(errors="backslashreplace")
    try:
        with _notes_on_one_line(), _terminable():
            outcome = _run(argv)
    except TofError as err:
        command = [word for word in argv if not word.startswith("-")][:1]
        hint = err.hint or " ".join(["tofcapture", *command, "--help"])
        return _failed(type(err).__name__, err.message, hint, err.exit_code, as_json=as_json)
    except _Terminated:
        hint = "run the same command again to go on"
        return _failed("Terminated", "terminated", hint, 143, as_json=as_json)
    except KeyboardInterrupt:
        hint = "run the same command again to go on"
        return _failed("Interrupted", "interrupted", hint, 130, as_json=as_json)
    except (ModuleNotFoundError, OSError) as err:
        if os.environ.get("TOFCAPTURE_TRACEBACK"):
            raise
        if isinstance(err, ModuleNotFoundError):
            return _failed("Missing", *_missing(err), 3, as_json=as_json)
        if isinstance(err, FileNotFoundError):
            hint = "look at the path; it begins in the folder where you are"
            return _failed("DataError", f"{err.filename}: no such file or folder", hint, 5, as_json=as_json)
        if isinstance(err, NotADirectoryError | FileExistsError):
            said = f"{err.filename}: expected a folder, got a file on the way"
            return _failed("ConfigError", said, "name another folder", 3, as_json=as_json)
        from tofcapture.files.disk import is_full

        full = "free some space, then run the same command again"
        hint = full if is_full(err) else "set TOFCAPTURE_TRACEBACK=1 to see where"
        return _failed(type(err).__name__, str(err), hint, 1, as_json=as_json)
    told = f"\n  next: {outcome.following}" if outcome.following and outcome.exit_code == 0 else ""
    _tell(json.dumps(outcome.data, allow_nan=False, default=str) if as_json else outcome.text + told)
    return outcome.exit_code


def _missing(err: ModuleNotFoundError) -> tuple[str, str]:
    """Say which library is missing, or which file of somebody else stands in the place of a package of ours."""
    package = str(err.name).partition(".")[0]
    place = getattr(sys.modules.get(package), "__file__", None)
    if package in {"tofcapture", "calibration", "tofcapture_model"} and place:
        return (
            f"{place} stands in the way of tofcapture's own {package}",
            "rename it, or run in another folder",
        )
    return f"the library {err.name} is missing", "pip install 'tofcapture[all]'"


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
