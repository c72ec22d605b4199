"""Sphinx's configuration: ``make docs`` builds the site into build/docs with warnings as errors.

The reference pages of commands, formats and functions are generated at the start of the build from the code itself, see
docs/generate.py.
"""

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import generate  # noqa: E402
from sphinx.domains.python import PyObject  # noqa: E402

import tofcapture  # noqa: E402

project = "tofcapture"
author = "The tofcapture maintainers"
copyright = "the tofcapture maintainers, Apache-2.0"  # noqa: A001  Sphinx's name for it
release = tofcapture.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
autodoc_typehints = "signature"  # the docstrings say shapes and units
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
# What the reference imports must not need: the libraries of the extras.
autodoc_mock_imports = generate.ABSENT

exclude_patterns = ["_build"]
nitpicky = False
# An error that another module hands on is offered under both names; either leads there.
suppress_warnings = ["ref.python"]

smartquotes = False  # a command with its quotes can be copied

html_theme = "furo"
html_title = f"tofcapture {release}"
html_static_path = []
html_extra_path = []
html_copy_source = False
html_show_sourcelink = False

generate.write_all(HERE / "reference")


_COLON = "\ue000"


def _keep_colons(
    _app: object, what: str, _name: str, _thing: object, _options: object, lines: list[str]
) -> None:
    """Hide the colons of attributes from napoleon, which takes the words before the first for a type."""
    if what in {"attribute", "data", "property"}:
        lines[:] = [line.replace(":", _COLON) for line in lines]


def _escape(_app: object, _what: str, _name: str, _thing: object, _options: object, lines: list[str]) -> None:
    """In our docstrings ``|x|`` is a length or a number's size, never reStructuredText's substitution."""
    for i, line in enumerate(line.replace(_COLON, ":") for line in lines):
        parts = re.split(r"(``.*?``)", line)
        plain = "".join(p if p.startswith("``") else p.replace("|", r"\|") for p in parts)
        # ``low, high`` are two names; Sphinx would take the first for the type of the second.
        lines[i] = re.sub(r"^:(?:ivar|param) [\w, ]+:", lambda field: field[0].replace(", ", ","), plain)


def _inside(_app: object, name: str, source: list[str]) -> None:
    """Links into the source tree are for readers of the repository; on the site they stand as plain words."""
    if "/" not in name:
        source[0] = re.sub(r"(?<!!)\[([^\]]+)\]\(\.\./[^)]*\)", r"\1", source[0])


def setup(app: object) -> None:
    """Sphinx calls this."""
    for field in PyObject.doc_field_types:
        if field.name == "variable":
            field.rolename = ""  # a class's own attribute is no link to one of the same name elsewhere
    app.connect("autodoc-process-docstring", _keep_colons, priority=400)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", _escape)  # type: ignore[attr-defined]
    app.connect("source-read", _inside)  # type: ignore[attr-defined]
