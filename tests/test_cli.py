"""The program itself: light, every command explained, every mistake answered in a few lines."""

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests import answers
from tofcapture.cli import GROUP, main, parser
from tofcapture.cli.kit import Command

ROOT = Path(__file__).parent.parent
COMMANDS = {e.name: e.load() for e in entry_points(group=GROUP)}


def test_help_imports_nothing_heavy():
    """``tofcapture --help`` names every command and imports neither torch, open3d, cv2 nor numpy."""
    code = (
        "import sys\ntry:\n    from tofcapture.cli import main; main(['--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('torch', 'open3d', 'cv2', 'scipy', 'matplotlib', 'numpy', 'h5py') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"
    for name in COMMANDS:
        assert re.search(rf"^\s+{name}\b", done.stdout, re.MULTILINE)


def test_installed_commands_are_those_of_the_project_file():
    """The environment and pyproject.toml agree about the commands."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert set(table["project"]["entry-points"][GROUP]) == set(COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_command_has_help_and_an_example_that_parses(name):
    """Help is one line; the example is a command line that the parser accepts."""
    command = COMMANDS[name]
    assert isinstance(command, Command)
    assert command.help
    assert "\n" not in command.help
    words = shlex.split(command.example)
    assert words[:2] == ["tofcapture", name]
    parser({name: command}).parse_args(words[1:])


def test_errors_are_json_when_asked(capsys):
    """With --json an error is one object on stdout."""
    code = main(["check", "/no/such/path", "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert answer["ok"] is False
    assert answer["error"]["exit_code"] == code
    assert answer["error"]["message"]


def test_no_command_prints_help(capsys):
    """``tofcapture`` alone shows the help and succeeds."""
    assert main([]) == 0
    assert "COMMAND" in capsys.readouterr().out


def test_a_file_that_stands_in_the_way_of_a_package_is_named(tmp_path):
    """A foreign calibration.py where the program is started hides ours; it is not a missing library."""
    (tmp_path / "calibration.py").write_text("")
    words = [sys.executable, "-m", "tofcapture", "align", "rec"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert f"{tmp_path / 'calibration.py'} stands in the way" in done.stderr


def _options(parsed: argparse.ArgumentParser):
    for action in parsed._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _options(sub)
        elif action.nargs != 0:
            yield parsed.prog, action


def test_one_thing_has_one_name_in_every_help():
    """Values have a short name in capitals, paths say what they lead to, and defaults are shown in one form."""
    paths = {
        "DIR",
        "FILE",
        "PATH",
        "INPUT",
        "RAW",
        "PAIRS",
        "HAND",
        "TARGET",
        "none",
        "SOURCE",
        "RECORDING",
        "DATASET",
        "WEIGHTS",
        "BOARD",
    }
    for program, action in _options(parser(COMMANDS)):
        where = f"{program} {action.dest}"
        names = action.metavar if isinstance(action.metavar, tuple) else (action.metavar,)
        assert all(names), where
        if action.type is Path:
            for name in re.split(r"[ |]+", " ".join(names)):
                assert name in paths or re.fullmatch(
                    r"[A-Z]+\.(toml|json|h5|npy|svg|dxf|stl|png|html|rrd)", name
                ), where
        assert "efault" not in action.help or re.search(r"\(default: [^()]+\)$", action.help), where


@pytest.mark.parametrize("name", ["", *sorted(COMMANDS)])
def test_help_fits_a_terminal_of_eighty_columns(name, monkeypatch):
    """No line of any help is wider than 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    top = parser(COMMANDS)
    text = (
        next(a for a in top._actions if isinstance(a, argparse._SubParsersAction)).choices[name].format_help()
        if name
        else top.format_help()
    )
    body, _, example = text.partition("example:")
    assert max(map(len, body.splitlines())) <= 80
    assert not name or example


def test_options_are_what_scripts_rely_on():
    """Names, defaults, numbers of values and choices of every option of every command; there may be more of them."""
    answers.hold("options", {name: _taken(parser({name: c})) for name, c in COMMANDS.items()})


def _taken(given):
    """What a parser takes, those of its commands included; its words apart."""
    found = {}
    for action in given._actions:
        if isinstance(action.choices, dict):
            found |= {name: _taken(sub) for name, sub in action.choices.items()}
            continue
        if action.default is argparse.SUPPRESS:  # --help and --version
            continue
        kind = getattr(action.type, "__name__", None)
        told = (action.dest, action.nargs, action.required, action.default, kind, action.choices)
        found[" ".join(action.option_strings) or action.dest] = [
            list(x) if isinstance(x, range | set | tuple) else x for x in told
        ]
    return found


@pytest.mark.parametrize(
    "env",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "latin-1"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    ],
)
def test_any_locale_shows_any_folder(tmp_path, env):
    """A folder with a Greek name is written to and named, whatever the terminal can print."""
    folder = tmp_path / "Größe-δ"
    folder.mkdir()
    command = [sys.executable, "-m", "tofcapture", "config", "show", "--station", str(folder / "none.toml")]
    done = subprocess.run(command, capture_output=True, env={**os.environ, **env}, check=False)
    assert done.returncode == 3
    assert b"none.toml" in done.stderr
    assert b"Traceback" not in done.stderr
    write = "from tofcapture.cli.kit import written; from pathlib import Path; import sys; written({}, '', Path(sys.argv[1]) / 'r.json')"
    subprocess.run([sys.executable, "-c", write, str(folder)], env={**os.environ, **env}, check=True)
    assert (folder / "r.json").exists()


def test_code_that_cannot_be_kept_is_compiled_all_the_same(monkeypatch):
    """A user without a home folder has no place for machine code: it is made anew, and the doctor sees it."""
    from numba.core import caching

    from tofcapture import libraries
    from tofcapture.cli.probe import probe_kernels

    assert libraries.keeps_kernels()
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    assert libraries.compiled(lambda x: x + 1)(2) == 3
    (found,) = probe_kernels()
    assert found.verdict == "WARN"
    assert "NUMBA_CACHE_DIR" in found.advice


def test_no_home_is_named(monkeypatch, tmp_path):
    """Without a home folder, or where it cannot be written, the daemon's folder has to be given."""
    from tofcapture.errors import ConfigError
    from tofcapture.record.daemon import settings

    for name in ("TOFCAPTURE_STATE", "STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def none():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(settings.Path, "home", none)
    with pytest.raises(ConfigError, match="home") as told:
        settings.state_folder(None)
    assert "--state" in told.value.hint
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be made"):
        settings.open_folder(tmp_path / "file" / "st")


def test_a_command_ends_though_its_end_was_told_where_exceptions_are_lost():
    """SIGTERM while an object goes raises what Python ignores; the command ends all the same, and only once."""
    code = """
import os, signal, sys, time
from tofcapture.cli import doctor, main
class Going:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        sum(range(1000))
def slow():
    try:
        Going()
        time.sleep(60)
    finally:
        time.sleep(0.3)
        print("put away")
doctor.check_weights = slow
sys.exit(main(["doctor"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=50
    )
    assert done.returncode == 143
    assert done.stdout == "put away\n"
    assert done.stderr == "tofcapture: terminated\n  try: run the same command again to go on\n"
