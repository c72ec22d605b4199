"""The generated pages: every command from its own help, every format from its layout, every module from its docstrings.

``python docs/generate.py`` writes them into docs/reference; the site's build does it by itself. They are not kept under version
control.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
from importlib.metadata import entry_points
from pathlib import Path

from tofcapture.cli import GROUP, ORDER
from tofcapture.cli.kit import Command

ROOT = Path(__file__).parent.parent
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
WIDTH = "96"  # columns of help texts
_HEAVY = (
    "open3d", "kiss_icp", "cv2", "scipy", "torch", "numba", "matplotlib", "rich", "tomli_w", "jinja2", "safetensors", "small_gicp",
    "aiohttp", "distributed", "serial", "nxlib", "rerun", "tensorboard", "threadpoolctl", "rtde_control", "rtde_receive", "ArducamDepthCamera",
    "triton",
)  # fmt: skip
ABSENT = [name for name in _HEAVY if importlib.util.find_spec(name) is None]


def commands() -> dict[str, Command]:
    """Every command by name, in the order of ``tofcapture --help``."""
    found = {e.name: e.load() for e in entry_points(group=GROUP)}
    return {n: found[n] for n in sorted(found, key=lambda n: (ORDER.index(n) if n in ORDER else 99, n))}


def _parts(parser: argparse.ArgumentParser) -> list[tuple[str, argparse.ArgumentParser]]:
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]  # noqa: SLF001  argparse has no other way
    return [(name, sub) for group in groups for name, sub in group.choices.items()]


def _help(parser: argparse.ArgumentParser) -> str:
    text = parser.format_help()
    return f"```text\n{text.rstrip()}\n```\n"


def commands_page() -> str:
    """``reference/commands.md``."""
    os.environ.update(COLUMNS=WIDTH, NO_COLOR="1")
    lines = [
        "# Commands\n\nGenerated from the commands' own help. Every command takes `--json` and prints one object then; results go to",
        "stdout, progress and errors to stderr. Exit codes: 0 ok, 1 unexpected, 2 usage, 3 config, 4 device, 5 data, 6 quality gate,",
        "7 busy, 130 interrupted.\n",
    ]
    for name, command in commands().items():
        parser = argparse.ArgumentParser(
            prog=f"tofcapture {name}",
            description=command.help,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.configure(parser)
        parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
        lines.append(
            f"## {name}\n\n{command.help[0].upper()}{command.help[1:]}.\n\n```sh\n{command.example}\n```\n\n{_help(parser)}"
        )
        lines += [f"### {name} {part}\n\n{_help(sub)}" for part, sub in _parts(parser)]
    return "\n".join(lines)


def options_of(command: Command) -> set[str]:
    """Every long option of a command and of its parts."""
    parser = argparse.ArgumentParser()
    command.configure(parser)
    parsers = [parser, *(sub for _, sub in _parts(parser))]
    return {o for p in parsers for o in p._option_string_actions if o.startswith("--")} | {"--json"}  # noqa: SLF001


def modules() -> dict[str, list[str]]:
    """Public modules of each package: those with a public name of their own, in order."""
    found: dict[str, list[str]] = {}
    for package in PACKAGES:
        paths = sorted((ROOT / package).rglob("*.py"))
        names = [".".join(p.relative_to(ROOT).with_suffix("").parts) for p in paths if _documented(p)]
        found[package] = [n.removesuffix(".__init__") for n in names]
    return found


def _documented(path: Path) -> bool:
    parts = path.relative_to(ROOT).parts
    if path.name == "__main__.py" or "cli" in parts or "templates" in parts:
        return False
    return bool(re.search(r"^(def|class) [a-z A-Z]", path.read_text(encoding="utf-8"), re.MULTILINE))


def api_pages() -> dict[str, str]:
    """``reference/api-*.md``, one a package, and their index."""
    pages = {}
    for package, names in modules().items():
        parts = [f"# `{package}`\n\nPublic names of every module, from their docstrings.\n"]
        parts += [
            f"## {name}\n\n```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```\n" for name in names
        ]
        pages[f"api-{package}.md"] = "\n".join(parts)
    return pages


def write_all(folder: Path) -> None:
    """Write all generated pages; one whose text is the same is left alone, so that Sphinx need not read it again."""
    folder.mkdir(exist_ok=True)
    for name, text in {"commands.md": commands_page(), **api_pages()}.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_all(Path(__file__).parent / "reference")
