"""``tofcapture completion``: a script that completes commands, options and values in bash, zsh or fish."""

from __future__ import annotations

import argparse
from importlib.metadata import entry_points

from tofcapture.command import Command, Outcome

_BASH = """\
_tofcapture() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} words="{commands}"
    if [ "$COMP_CWORD" -gt 1 ]; then
        case ${{COMP_WORDS[1]}} in
{cases}
            *) words="" ;;
        esac
        case $word in -*) ;; *) COMPREPLY=($(compgen -W "$(echo " $words" | sed 's/ -[^ ]*//g')" -- "$word") $(compgen -f -- "$word")); return ;; esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o filenames -F _tofcapture tofcapture
"""
_ZSH = """\
#compdef tofcapture
_tofcapture() {{
    if (( CURRENT == 2 )); then
        local -a commands=({commands})
        _describe command commands
        return
    fi
    case $words[2] in
{cases}
    esac
    _files
}}
if [ "$funcstack[1]" = "_tofcapture" ]; then _tofcapture "$@"; else compdef _tofcapture tofcapture; fi
"""


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="which shell the script is for")


def _commands() -> dict[str, Command]:
    from tofcapture.cli import GROUP

    return {e.name: e.load() for e in sorted(entry_points(group=GROUP), key=lambda e: e.name)}


def _words(command: Command) -> list[str]:
    """Parts of a command that has some, then every long option."""
    parser = argparse.ArgumentParser()
    command.configure(parser)
    words: list[str] = []
    for action in parser._actions:  # noqa: SLF001  argparse tells it in no other way
        if isinstance(action, argparse._SubParsersAction):  # noqa: SLF001
            words += list(action.choices)
            options = [o for sub in action.choices.values() for o in sub._option_string_actions]  # noqa: SLF001
            words += sorted({o for o in options if o.startswith("--")})
        words += [o for o in action.option_strings if o.startswith("--")]
    return list(dict.fromkeys([*words, "--json"]))


def script(shell: str) -> str:
    """Completion script, generated from the parsers of all commands.

    Parameters
    ----------
    shell
        ``bash``, ``zsh`` or ``fish``.
    """
    commands = _commands()
    if shell == "bash":
        cases = "\n".join(f'            {n}) words="{" ".join(_words(c))}" ;;' for n, c in commands.items())
        return _BASH.format(commands=" ".join(commands), cases=cases)
    if shell == "zsh":
        named = " ".join(f"'{n}:{_quoted(c.help)}'" for n, c in commands.items())
        cases = "\n".join(f"        {n}) compadd -- {' '.join(_words(c))} ;;" for n, c in commands.items())
        return _ZSH.format(commands=named, cases=cases)
    lines = ["complete -c tofcapture -n __fish_use_subcommand -f"]
    for name, command in commands.items():
        lines.append(
            f"complete -c tofcapture -n __fish_use_subcommand -a {name} -d '{_quoted(command.help)}'"
        )
        seen = f"complete -c tofcapture -n '__fish_seen_subcommand_from {name}'"
        lines += [f"{seen} -l {w[2:]}" if w.startswith("--") else f"{seen} -a {w}" for w in _words(command)]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    return text.replace("'", "").replace(":", ";")


def _run(args: argparse.Namespace) -> Outcome:
    text = script(args.shell)
    return Outcome({"shell": args.shell, "script": text}, text.rstrip())


COMMAND = Command(
    help="print a script that completes commands in bash, zsh or fish",
    example="tofcapture completion bash",
    configure=_configure,
    run=_run,
)
