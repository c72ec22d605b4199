"""The generated pages: every command from its own help, every format from its layout, every module from its docstrings.

``python docs/generate.py`` writes them into docs/reference; the site's build does it by itself. They are not kept under version
control.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import re
from pathlib import Path

from tofcapture.cli import EXIT_CODES, GROUPS, all_commands, parser

ROOT = Path(__file__).parent.parent
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
_HEAVY = (
    "open3d", "kiss_icp", "cv2", "scipy", "torch", "numba", "matplotlib", "tomli_w", "jinja2", "safetensors", "small_gicp",
    "aiohttp", "distributed", "serial", "nxlib", "rerun", "tensorboard", "threadpoolctl", "rtde_control", "rtde_receive", "ArducamDepthCamera",
    "triton",
)  # fmt: skip
ABSENT = [name for name in _HEAVY if importlib.util.find_spec(name) is None]


def _parts(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]  # noqa: SLF001  argparse has no other way
    return {name: sub for group in groups for name, sub in group.choices.items()}


def _parsers() -> dict[str, argparse.ArgumentParser]:
    """Return every command's own parser, and those of its parts, by what is typed."""
    tops = _parts(parser(all_commands()))
    found = {}
    for name, top in tops.items():
        found |= {name: top, **{f"{name} {part}": sub for part, sub in _parts(top).items()}}
    return found


def commands_page() -> str:
    """``reference/commands.md``: the groups of ``tofcapture --help``, each command with its help."""
    os.environ.update(COLUMNS="80", NO_COLOR="1")
    found, commands = _parsers(), all_commands()
    lines = [
        "# Commands",
        "",
        "Every command has `--help` and `--json`; results go to stdout, progress and errors to stderr.",
        "",
        EXIT_CODES[0].upper() + EXIT_CODES[1:] + ".",
        "",
    ]
    for title, names in GROUPS.items():
        lines += [f"## {title.capitalize()}", ""]
        for name in (n for n in found if n.partition(" ")[0] in names):
            example = [] if " " in name else ["```sh", commands[name].example, "```", ""]
            body = found[name].format_help().partition("\nexample:")[0].rstrip()
            lines += [f"### {name}", "", *example, "```text", body, "```", ""]
    return "\n".join(lines)


def options_of(name: str) -> set[str]:
    """Every long option of a command and of its parts."""
    parsers = [p for typed, p in _parsers().items() if typed.partition(" ")[0] == name]
    return {o for p in parsers for o in p._option_string_actions if o.startswith("--")}  # noqa: SLF001


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
    """``reference/api-*.md``: an index of each package, with the first line of each module, and a page a module."""
    pages = {}
    for package, names in modules().items():
        lines = [f"# `{package}`", "", "| module | what it does |", "|---|---|"]
        lines += [f"| [{name}](api/{name}.md) | {_first_line(name)} |" for name in names]
        pages[f"api-{package}.md"] = "\n".join([*lines, ""])
        for name in names:
            # An orphan: a sidebar of every module on every page would be half of the site's build.
            up = f"---\norphan: true\n---\n\n[`{package}`](../api-{package}.md)\n"
            body = f"```{{eval-rst}}\n.. automodule:: {name}\n   :members:\n```\n"
            title = name.replace(".", ".\u200b")  # a narrow page breaks it there
            pages[f"api/{name}.md"] = f"{up}\n# {title}\n\n{body}"
    return pages


def _first_line(module: str) -> str:
    path = ROOT / module.replace(".", "/")
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    line = re.sub(r":\w+:`", "`", text.partition("\n")[0])
    return line.replace("``", "`").replace("|", "\\|")


def write_all(folder: Path) -> None:
    """Write all generated pages; one whose text is the same is left alone, so that Sphinx need not read it again."""
    (folder / "api").mkdir(parents=True, exist_ok=True)
    pages = {"commands.md": commands_page(), **api_pages()}
    for old in folder.rglob("*.md"):
        if str(old.relative_to(folder)) not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_all(Path(__file__).parent / "reference")
