"""The house: no circle of imports, no crowded folder, and every name that the docs give a reader is there."""

import importlib
import re
import tomllib
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
GROUPS = ("tofcapture.commands", "tofcapture.drivers")  # of entry points
MOST = 12  # modules in a folder, ``__init__`` apart
PAGES = sorted(
    [*(p for p in (ROOT / "docs").rglob("*.md") if "reference" not in p.parts), ROOT / "README.md"]
)
NAME = re.compile(r"`((?:tofcapture|calibration|tofcapture_model)(?:\.\w+)+)`")
FILE = re.compile(r"`((?:tofcapture|calibration|tofcapture_model|tests|benchmarks|examples|docs)/[\w./-]*)`")


def test_no_file_imports_itself_by_way_of_others():
    """The files of each package have an order; two that import each other are one file."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)
    below = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    try:
        TopologicalSorter(below).prepare()
    except CycleError as err:
        pytest.fail(f"a circle of imports: {' -> '.join(err.args[1])}")


def test_no_folder_is_crowded():
    """A folder is one question; a stranger can read its list of files."""
    files = [p for package in PACKAGES for p in (ROOT / package).rglob("*.py") if p.name != "__init__.py"]
    crowded = {folder: n for folder, n in Counter(p.parent for p in files).items() if n > MOST}
    assert crowded == {}


def _there(name: str) -> bool:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part, None)
        return found is not None
    return False


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_names_in_the_docs_exist(page):
    """Modules, functions and files that a page names are where it says."""
    if "reference" in page.parts:
        pytest.skip("generated from the code itself")
    text = page.read_text(encoding="utf-8")
    wrong = [name for name in NAME.findall(text) if name not in GROUPS and not _there(name)]
    wrong += [path for path in FILE.findall(text) if not (ROOT / path).exists()]
    assert wrong == []


def test_the_picture_of_the_rooms_names_each():
    """docs/pictures/rooms.svg has every layer that lint-imports holds."""
    drawn = (ROOT / "docs/pictures/rooms.svg").read_text()
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rooms = {room for c in contracts for layer in c.get("layers", ()) for room in layer.split(" | ")}
    assert [room for room in sorted(rooms - {"__main__"}) if f">{room}</text>" not in drawn] == []
