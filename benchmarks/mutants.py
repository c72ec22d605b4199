"""Change the product at random places and see whether the default tests notice.

    python benchmarks/mutants.py [--count 130] [--seed 0] [--jobs 2] [--only calibration/] [--map FILE] [--out FILE]

A mutant is one change to one expression or statement of the three packages: a comparison, an operator, a number, an and/or, a
condition, a dropped call. Lines are drawn evenly over the packages, and one place on each. First the default tests run once, in a copy of the tree, and it is noted which test
executes which line, in its own process or in one that it starts. A mutant is tried on the tests that execute its line, then on the
whole test files that execute any line of its file (what numba compiles has no other trace). A line that no test executes lives
without a trial. The survivors are printed as diffs: whoever reads them judges which change no behaviour (a bound that is never met,
a log line, a cache size), and says so beside the figure.

Needs ``coverage``. ``--map`` keeps what the first run measured; it holds as long as the three packages stay as they are.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
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
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
LEFT_OUT = shutil.ignore_patterns(".*", "build", "__pycache__")
LIMIT = 900  # s for the tests of one mutant
COMPARE = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
           ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is}  # fmt: skip
OPERATE = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
           ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}  # fmt: skip
# What the plugin below and the interpreters that a test starts read. PYTEST_CURRENT_TEST names the test that started them.
SETTINGS = """[run]
parallel = true
concurrency = multiprocessing, thread
patch = _exit
sigterm = true
disable_warnings = module-not-measured, no-data-collected
context = ${PYTEST_CURRENT_TEST-}
"""


# --- the plugin for pytest: which test runs now, and what came of it ---


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Any:
    """Note the lines that follow under the test's name."""
    import coverage

    now = coverage.Coverage.current()
    if now is not None:
        now.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        if now is not None:
            now.switch_context("")


def pytest_sessionfinish() -> None:
    """Save the lines of a worker, which ends without leave."""
    import coverage

    now = coverage.Coverage.current()
    if now is not None:
        now.stop()
        now.save()


_SECONDS: Counter[str] = Counter()
_FAILED: set[str] = set()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up what each test took and remember those that fail without any mutant."""
    _SECONDS[report.nodeid] += report.duration
    if report.failed:
        _FAILED.add(report.nodeid)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Write times and failures where the run was told to."""
    if not hasattr(config, "workerinput") and "MUTANTS_TIMES" in os.environ:
        text = json.dumps({"seconds": _SECONDS, "failed": sorted(_FAILED)})
        Path(os.environ["MUTANTS_TIMES"]).write_text(text, encoding="utf-8")


# --- the map: which test executes which line ---


@dataclass(frozen=True)
class Map:
    """Which tests execute a line, how long each test takes, which ones fail anyway."""

    digest: str
    tests: dict[str, dict[int, set[str]]]  # path -> line -> tests; an import belongs to no test
    seconds: dict[str, float]
    failed: list[str]

    def near(self, path: str, line: int) -> list[str]:
        """List the tests that execute a line, file by file, the quickest first."""
        known = self.tests.get(path, {}).get(line, set()) & self.seconds.keys()
        return sorted(known, key=lambda t: (self._file(t), self.seconds[t]))

    def far(self, path: str) -> list[str]:
        """List the test files that execute any line of a file, the quickest first."""
        tests = set().union(*self.tests.get(path, {}).values()) & self.seconds.keys()
        return sorted({t.partition("::")[0] for t in tests}, key=self._file)

    def _file(self, test: str) -> tuple[float, str]:
        file = test.partition("::")[0]
        return sum(s for t, s in self.seconds.items() if t.startswith(file + "::")), file


def digest() -> str:
    """Return what tells one state of the packages from another."""
    return hashlib.sha256(b"".join((ROOT / p).read_bytes() for p in product())).hexdigest()


def product() -> list[str]:
    """List the files of the three packages."""
    return sorted(f.relative_to(ROOT).as_posix() for p in PACKAGES for f in (ROOT / p).rglob("*.py"))


def measure(tree: Path, folder: Path, jobs: int) -> dict[str, Any]:
    """Run the default tests of a tree once under coverage; returns what `Map` holds, as JSON does."""
    settings, times = folder / "coverage.ini", folder / "times.json"
    sources = "".join(f"    {tree / p}\n" for p in PACKAGES)
    settings.write_text(SETTINGS + f"data_file = {folder / 'lines'}\nsource =\n{sources}", encoding="utf-8")
    extra = {"COVERAGE_PROCESS_START": str(settings), "MUTANTS_TIMES": str(times)}
    run(tree, ["-n", str(jobs), "-p", "benchmarks.mutants", "-o", "timeout=1800"], extra)
    from coverage import CoverageData
    from coverage.numbits import numbits_to_nums

    lines = CoverageData(basename=str(folder / "all"))
    for part in folder.glob("lines.*"):
        other = CoverageData(basename=str(part))
        other.read()
        lines.update(other)
    lines.write()
    found: dict[str, dict[int, set[str]]] = {}
    with sqlite3.connect(folder / "all") as db:
        rows = db.execute(
            "select path, context, numbits from line_bits join file on file.id = file_id join context on context.id = context_id"
        )
        for path, context, bits in rows:
            # "static|dynamic"; a process that a test started has the test and its phase in the static half.
            test = (
                context.strip("|")
                .removesuffix(" (call)")
                .removesuffix(" (setup)")
                .removesuffix(" (teardown)")
            )
            of_file = found.setdefault(Path(path).relative_to(tree).as_posix(), {})
            for line in numbits_to_nums(bits):
                of_file.setdefault(line, set()).update({test} - {""})
    tests = {path: {str(n): sorted(t) for n, t in at.items()} for path, at in found.items()}
    return {"digest": digest(), "tests": tests, **json.loads(times.read_text(encoding="utf-8"))}


def run(
    tree: Path, arguments: list[str], extra: dict[str, str], limit: float | None = None
) -> tuple[int, str]:
    """Run pytest in a tree; returns its exit status and the first test that failed."""
    env = {**os.environ, "PYTHONPATH": str(tree), **extra}
    command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "-p", "no:cacheprovider", *arguments]
    try:
        done = subprocess.run(
            command, cwd=tree, env=env, capture_output=True, text=True, timeout=limit, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"more than {limit} s"
    said = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode, (said or [""])[0]


# --- the mutants ---


@dataclass(frozen=True)
class Mutant:
    """One change: where, of which kind, and the whole text of the changed file."""

    path: str
    line: int
    kind: str
    text: str

    def diff(self) -> str:
        """Return the change as a reader wants it."""
        before = (ROOT / self.path).read_text(encoding="utf-8").splitlines()
        return "\n".join(
            difflib.unified_diff(before, self.text.splitlines(), self.path, self.kind, lineterm="", n=2)
        )


def places(tree: ast.Module) -> list[tuple[Any, str]]:
    """List the nodes that can be changed, annotations and decorators apart."""
    skip = {id(n) for a in ast.walk(tree) for n in _annotations(a)}
    found: list[tuple[Any, str]] = []
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
            found.append((node.test, "condition"))
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
            found.append((node, "number"))
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            found.append((node, "dropped call"))
    return found


def _annotations(node: Any) -> list[ast.AST]:
    inside = [getattr(node, name, None) for name in ("annotation", "returns")] + getattr(
        node, "decorator_list", []
    )
    return [n for part in inside if part is not None for n in ast.walk(part)]


def _text(node: ast.BinOp) -> bool:
    return any(
        isinstance(n, ast.JoinedStr) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )


def instead(node: Any, kind: str) -> str:
    """Return the text that stands in a node's place."""
    if kind == "dropped call":
        return "pass"
    if kind == "condition":
        return f"(not ({ast.unparse(node)}))"
    if isinstance(node, ast.Compare):
        new: ast.expr = ast.Compare(
            node.left, [COMPARE[type(node.ops[0])](), *node.ops[1:]], node.comparators
        )
    elif isinstance(node, ast.BinOp):
        new = ast.BinOp(node.left, OPERATE[type(node.op)](), node.right)
    elif isinstance(node, ast.BoolOp):
        new = ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
    elif isinstance(node.value, bool):
        new = ast.Constant(not node.value)
    else:
        new = ast.Constant(node.value + 1 if isinstance(node.value, int) else node.value * 1.5 or 1e-3)
    return f"({ast.unparse(new)})"


def source_after(source: str, node: Any, kind: str) -> str:
    """Return the file's text with one node changed; the rest stays as it is, to the letter."""
    lines = source.encode().splitlines(keepends=True)
    first, last = node.lineno - 1, node.end_lineno - 1
    head, tail = lines[first][: node.col_offset], lines[last][node.end_col_offset :]
    return b"".join([*lines[:first], head + instead(node, kind).encode() + tail, *lines[last + 1 :]]).decode()


def draw(count: int, seed: int, only: str) -> list[Mutant]:
    """Draw lines evenly over those that can be changed, and one place on each."""
    by_line: dict[tuple[str, int], list[tuple[Any, str]]] = {}
    sources = {p: (ROOT / p).read_text(encoding="utf-8") for p in product() if p.startswith(only)}
    for path, source in sources.items():
        for node, kind in places(ast.parse(source)):
            by_line.setdefault((path, node.lineno), []).append((node, kind))
    rng, lines = random.Random(seed), sorted(by_line)
    rng.shuffle(lines)
    mutants: list[Mutant] = []
    for path, line in lines:
        if len(mutants) >= count:
            break
        node, kind = rng.choice(by_line[path, line])
        text = source_after(sources[path], node, kind)
        try:
            ast.parse(text)
        except SyntaxError:  # a number inside an f-string, whose place the parser does not know
            continue
        mutants.append(Mutant(path, line, kind, text))
    return mutants


def compiled(path: str, line: int) -> bool:
    """Tell whether a line is in a function that numba compiles, where coverage sees nothing."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    kernels = [f for f in ast.walk(tree) if isinstance(f, ast.FunctionDef)]
    return any(
        f.lineno <= line <= (f.end_lineno or 0)
        and any("compiled" in ast.unparse(d) for d in f.decorator_list)
        for f in kernels
    )


def trial(mutant: Mutant, tree: Path, known: Map) -> tuple[str, str]:
    """Return ``dies``, ``lives`` or ``unseen`` (no test executes the line), and the test that noticed."""
    if mutant.line not in known.tests.get(mutant.path, {}) and not compiled(mutant.path, mutant.line):
        return "unseen", ""
    file, listed = tree / mutant.path, tree / "tests-to-run.txt"
    kept, stamp = file.read_bytes(), file.stat()
    file.write_text(mutant.text, encoding="utf-8")
    try:
        for tests in (known.near(mutant.path, mutant.line), known.far(mutant.path)):
            listed.write_text("\n".join(tests), encoding="utf-8")
            skip = [f"--deselect={t}" for t in known.failed]
            status, said = (
                run(tree, ["-x", "-o", "timeout=300", *skip, f"@{listed}"], {}, LIMIT) if tests else (5, "")
            )
            if status not in (0, 4, 5):  # 4: a test of the map that is gone; its file is run next
                return "dies", said
        return "lives", ""
    finally:
        file.write_bytes(kept)
        os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def main() -> None:
    """Draw, try and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=130)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="paths that begin so")
    parser.add_argument("--map", type=Path, help="file that keeps which test executes which line")
    parser.add_argument("--out", type=Path, help="write every mutant and its fate as JSON")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="mutants-"))
    (folder / "shared").symlink_to(ROOT.parent / "shared")
    trees: SimpleQueue[Path] = SimpleQueue()
    for job in range(args.jobs):
        trees.put(shutil.copytree(ROOT, folder / str(job), ignore=LEFT_OUT))
    kept = args.map or folder / "map.json"
    if not kept.exists():
        kept.write_text(json.dumps(measure(folder / "0", folder, args.jobs)), encoding="utf-8")
    read = json.loads(kept.read_text(encoding="utf-8"))
    read["tests"] = {p: {int(n): set(t) for n, t in at.items()} for p, at in read["tests"].items()}
    known = Map(**read)
    if known.digest != digest():
        parser.error(f"{kept} was measured on other sources: measure again (another --map)")

    def one(mutant: Mutant) -> tuple[str, str]:
        tree, start = trees.get(), time.monotonic()
        try:
            fate, said = trial(mutant, tree, known)
        finally:
            trees.put(tree)
        took = f"{time.monotonic() - start:4.0f} s"
        print(f"{fate:6} {took}  {mutant.path}:{mutant.line} {mutant.kind}  {said}", flush=True)
        if fate != "dies":
            print(mutant.diff(), flush=True)
        return fate, said

    mutants = draw(args.count, args.seed, args.only)
    with ThreadPoolExecutor(args.jobs) as pool:
        fates = list(pool.map(one, mutants))
    shutil.rmtree(folder)
    for package in (*PACKAGES, ""):
        of = Counter(f for m, (f, _) in zip(mutants, fates, strict=True) if m.path.startswith(package))
        print(
            f"{package or 'all'}: {of['dies']} of {of.total()} die, {of['lives']} live, no test executes {of['unseen']}"
        )
    if args.out:
        rows = [{"path": m.path, "line": m.line, "kind": m.kind, "fate": f, "by": by, "diff": m.diff()}
                for m, (f, by) in zip(mutants, fates, strict=True)]  # fmt: skip
        args.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
