"""Change the product at random places and see whether the default tests notice.

    python benchmarks/mutants.py [--count 130] [--seed 0] [--jobs 2] [--only calibration/] [--out mutants.json]

Each mutant is one change to one expression or statement of the three packages: a comparison, an operator, a number, a condition,
a dropped call. Places are drawn evenly over the lines that some test or some process of a test executes; what numba compiles or
no test reaches is left out, and the share of files' lines that is reached is printed first. A mutant is tried on the tests that execute its line, quickest first; one that lives on is tried on
every test that executes any line of its file, and on those that start the commands as processes. Tests run with ``-x`` in a copy of
the tree. What is left is printed as a diff: whoever reads it judges which of them change no behaviour (a bound that is never met, a
log line, a cache size) and says so beside the figure.

Needs ``coverage`` and ``pytest-cov``. The first run takes the default suite's time twice over; ``--map`` keeps what it found.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).parents[1]
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
PROCESSES = (
    "tests/test_end_to_end.py",
    "tests/test_demo.py",
    "tests/test_packaging.py",
    "tests/test_daemon_api.py",
)
LIMIT = 900  # s for the tests of one mutant
COMPARE = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
           ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
OPERATE = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
           ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change: where, of which kind, and the whole text of the changed file."""

    path: str
    line: int
    kind: str
    text: str


def places(tree: ast.Module) -> list[tuple[ast.AST, str]]:
    """List the nodes that can be changed, annotations and decorators apart."""
    skip = {id(n) for a in ast.walk(tree) for n in _annotations(a)}
    found: list[tuple[ast.AST, str]] = []
    for node in ast.walk(tree):
        if id(node) in skip:
            continue
        if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARE:
            found.append((node, "comparison"))
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATE and not _text(node):
            found.append((node, "operator"))
        elif isinstance(node, ast.BoolOp):
            found.append((node, "and/or"))
        elif isinstance(node, (ast.If, ast.IfExp, ast.While)):
            found.append((node, "condition"))
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
            found.append((node, "number"))
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            found.append((node, "dropped call"))
    return found


def _annotations(node: ast.AST) -> list[ast.AST]:
    inside = [getattr(node, name, None) for name in ("annotation", "returns")] + getattr(
        node, "decorator_list", []
    )
    return [n for part in inside if part is not None for n in ast.walk(part)]


def _text(node: ast.BinOp) -> bool:
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )


def change(node: ast.AST) -> ast.AST:
    """Return what stands in the node's place."""
    if isinstance(node, ast.Compare):
        return ast.Compare(node.left, [COMPARE[type(node.ops[0])](), *node.ops[1:]], node.comparators)
    if isinstance(node, ast.BinOp):
        return ast.BinOp(node.left, OPERATE[type(node.op)](), node.right)
    if isinstance(node, ast.BoolOp):
        return ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    if isinstance(node, ast.IfExp):
        return ast.IfExp(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
    if isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            return ast.Constant(not node.value)
        return ast.Constant(
            node.value + 1 if isinstance(node.value, int) else node.value * 1.5 + 1e-3 * (node.value == 0)
        )
    raise TypeError(type(node).__name__)


def source_after(source: str, node: ast.AST, kind: str) -> str:
    """Return the file's text with one node changed; the rest stays as it is, to the letter."""
    lines = source.splitlines(keepends=True)
    if kind == "dropped call":
        target, new = node, "pass"
    elif isinstance(node, (ast.If, ast.While)):
        target, new = node.test, f"not ({ast.unparse(node.test)})"
    else:
        target, new = node, f"({ast.unparse(change(node))})"
    encoded = [line.encode() for line in lines]
    first, last = target.lineno - 1, target.end_lineno - 1  # type: ignore[attr-defined]
    head, tail = encoded[first][: target.col_offset], encoded[last][target.end_col_offset :]  # type: ignore[attr-defined]
    return b"".join([*encoded[:first], head + new.encode() + tail, *encoded[last + 1 :]]).decode()


def tests_by_line(database: Path) -> dict[str, dict[int, set[str]]]:
    """Read which test executed which line from coverage's database."""
    from coverage.numbits import numbits_to_nums

    found: dict[str, dict[int, set[str]]] = {}
    with sqlite3.connect(database) as db:
        contexts = dict(db.execute("select id, context from context"))
        files = dict(db.execute("select id, path from file"))
        for file, context, bits in db.execute("select file_id, context_id, numbits from line_bits"):
            path = Path(files[file])
            if not path.is_relative_to(ROOT):
                continue
            test = contexts[context].partition("|")[0]
            lines = found.setdefault(path.relative_to(ROOT).as_posix(), {})
            for line in numbits_to_nums(bits):
                lines.setdefault(line, set()).update({test} - {""})
    return found


def measure(database: Path) -> dict[str, float]:
    """Run the default tests once under coverage; returns the seconds that each took."""
    settings = database.with_suffix(".rc")
    settings.write_text(
        "[run]\npatch = subprocess\nparallel = true\nconcurrency = multiprocessing, thread\nsource =\n"
        + "".join(f"    {p}\n" for p in PACKAGES)
        + f"data_file = {database}\n"
    )
    times = database.with_suffix(".xml")
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "2", f"--cov-config={settings}", "--cov", "--cov-context=test",
         "--cov-report=", f"--junitxml={times}", "-o", "timeout=1800"],
        cwd=ROOT, check=False,
    )  # fmt: skip
    from xml.etree import ElementTree as ET

    seconds: dict[str, float] = {}
    for case in ET.parse(times).iter("testcase"):  # noqa: S314  our own file
        name = case.get("classname", "").replace(".", "/") + ".py::" + case.get("name", "")
        seconds[name] = float(case.get("time", "0"))
    return seconds


def draw(count: int, seed: int, only: str, covered: dict[str, dict[int, set[str]]]) -> list[Mutant]:
    """Draw places evenly over the executed lines that hold one."""
    rng = random.Random(seed)
    pool = []
    for path in sorted(covered):
        if not path.startswith(only):
            continue
        source = (ROOT / path).read_text(encoding="utf-8")
        for node, kind in places(ast.parse(source)):
            if node.lineno in covered[path]:  # type: ignore[attr-defined]
                pool.append((path, source, node, kind))
    mutants = []
    for path, source, node, kind in rng.sample(pool, len(pool)):
        text = source_after(source, node, kind)
        try:
            same = ast.dump(ast.parse(text)) == ast.dump(ast.parse(source))
        except SyntaxError:
            continue
        if not same:
            mutants.append(Mutant(path, node.lineno, kind, text))  # type: ignore[attr-defined]
        if len(mutants) == count:
            break
    return mutants


def notices(tree: Path, tests: list[str]) -> bool:
    """Tell whether one of the tests fails in that tree."""
    if not tests:
        return False
    listed = tree / "mutant-tests.txt"
    listed.write_text("\n".join(tests))
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-o",
        "timeout=300",
        f"@{listed}",
    ]
    try:
        done = subprocess.run(
            command,
            cwd=tree,
            capture_output=True,
            timeout=LIMIT,
            check=False,
            env={**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"},
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode not in (0, 5)


def trial(
    mutant: Mutant, tree: Path, covered: dict[str, dict[int, set[str]]], seconds: dict[str, float]
) -> bool:
    """Tell whether the default tests notice a mutant."""
    at = covered[mutant.path]
    near = sorted(at.get(mutant.line, set()), key=lambda t: seconds.get(t, 1.0))
    far = sorted(set().union(*at.values()) - set(near), key=lambda t: seconds.get(t, 1.0))
    kept = (tree / mutant.path).read_text(encoding="utf-8")
    (tree / mutant.path).write_text(mutant.text, encoding="utf-8")
    try:
        return notices(tree, near) or notices(tree, [*far, *PROCESSES])
    finally:
        (tree / mutant.path).write_text(kept, encoding="utf-8")


def main() -> None:
    """Draw, try and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=130)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="paths that begin so")
    parser.add_argument("--map", type=Path, help="where the coverage database lies or is kept")
    parser.add_argument("--out", type=Path, help="write every mutant and its fate as JSON")
    args = parser.parse_args()
    database = (args.map or Path(tempfile.mkdtemp()) / "mutants.coverage").absolute()
    times = database.with_suffix(".json")
    if not database.exists():
        times.write_text(json.dumps(measure(database)))
    covered, seconds = tests_by_line(database), json.loads(times.read_text())
    mutants = draw(args.count, args.seed, args.only, covered)
    trees: SimpleQueue[Path] = SimpleQueue()
    folder = Path(tempfile.mkdtemp(prefix="mutants-"))
    for job in range(args.jobs):
        tree = folder / str(job)
        shutil.copytree(
            ROOT, tree, ignore=shutil.ignore_patterns(".git", ".venv", "build", "*cache*", "__pycache__")
        )
        trees.put(tree)
    (folder / "shared").symlink_to(ROOT.parent / "shared")

    def one(mutant: Mutant) -> bool:
        tree = trees.get()
        try:
            start = time.monotonic()
            dies = trial(mutant, tree, covered, seconds)
            word = "dies " if dies else "LIVES"
            print(
                f"{word} {time.monotonic() - start:5.0f} s  {mutant.path}:{mutant.line} {mutant.kind}",
                flush=True,
            )
            return dies
        finally:
            trees.put(tree)

    with ThreadPoolExecutor(args.jobs) as pool:
        fates = list(pool.map(one, mutants))
    shutil.rmtree(folder)
    for mutant, dies in zip(mutants, fates, strict=True):
        if not dies:
            before = (ROOT / mutant.path).read_text(encoding="utf-8").splitlines()
            print(
                "\n".join(
                    difflib.unified_diff(
                        before, mutant.text.splitlines(), mutant.path, mutant.kind, lineterm="", n=1
                    )
                )
            )
    rooms = (
        Counter(m.path.split("/")[0] for m in mutants),
        Counter(m.path.split("/")[0] for m, d in zip(mutants, fates, strict=True) if d),
    )
    for room in rooms[0]:
        print(f"{room}: {rooms[1][room]} of {rooms[0][room]} die")
    print(f"{sum(fates)} of {len(mutants)} mutants die, {100 * sum(fates) / len(mutants):.0f} %")
    if args.out:
        rows = [
            {"path": m.path, "line": m.line, "kind": m.kind, "dies": d}
            for m, d in zip(mutants, fates, strict=True)
        ]
        args.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
