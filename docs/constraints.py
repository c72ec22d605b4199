"""Write constraints.txt from what is installed here: ``python docs/constraints.py``, after the tests have passed."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).parent.parent
HEAD = "# Versions that the tests were run with, on Python 3.11, Linux x86-64: pip install -c constraints.txt '.[all]'"
SKIPPED = {"tofcapture", "open3d"}  # itself, and what stands in for open3d-cpu on other systems


def requirements() -> list[str]:
    """Names of all libraries of the project file, sorted."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"].values()
    groups = project["dependency-groups"].values()
    lines = [line for part in (project["project"]["dependencies"], *extras, *groups) for line in part]
    names = {
        re.match(r"[\w.-]+", line)[0].lower().replace("_", "-") for line in lines if isinstance(line, str)
    }  # type: ignore[index]
    return sorted(names - SKIPPED)


def pins() -> list[str]:
    """``name==version`` of those that are installed."""
    out = []
    for name in requirements():
        try:
            out.append(f"{name}=={version(name).partition('+')[0]}")
        except PackageNotFoundError:
            continue
    return out


if __name__ == "__main__":
    (ROOT / "constraints.txt").write_text("\n".join([HEAD, *pins(), ""]), encoding="utf-8")
