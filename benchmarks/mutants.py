"""Change the product at random places and see whether the default tests notice.

    python benchmarks/mutants.py [--count 130] [--seed 0] [--jobs 2] [--only calibration/] [--map FILE] [--out FILE]

A mutant is one change to one expression or statement of the three packages: a comparison, an operator, a number, an and/or, a
condition, a dropped call. Lines are drawn evenly over the packages, and one place on each.

First the default tests run once, in a copy of the tree, and it is noted which test executes which line, in its own process or in
one that it starts. A mutant is tried on the tests that execute its line, then on whole test files that execute its file, those that
are most about it first. Both end after ``--most`` seconds of tests, so a mutant that is said to live may die in the full run. A line
that no test executes lives without a trial.

The survivors are printed as diffs. Whoever reads them judges which change no behaviour (a bound that is never met, a log line, a
cache size), and says so beside the figure. ``--again FILE`` tries the survivors of an earlier ``--out`` once more, for instance with
more seconds or after tests were added.

Needs ``coverage`` installed in the interpreter's own site-packages: its start-up hook measures the processes of tests. ``--map``
keeps what the first run measured, with the text of every file: lines that have moved since are found again, and a new line is taken
for one with the line above it.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import importlib
import itertools
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("tofcapture", "calibration", "tofcapture_model")
LEFT_OUT = shutil.ignore_patterns(".*", "build", "__pycache__")
# Loaded once, before tests run in forks; nothing of the product may be among them.
LIBRARIES = ("torch", "numba", "cv2", "h5py", "scipy.optimize", "scipy.ndimage", "scipy.spatial", "scipy.stats",
             "matplotlib.figure")  # fmt: skip
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")  # as the tests' conftest does; a fork may not inherit threads
LIMIT = 900  # s of the clock for one helping of tests
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


_SECONDS: defaultdict[str, float] = defaultdict(float)
_FAILED: set[str] = set()


def _measuring() -> Any:
    import coverage

    return coverage.Coverage.current()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Any:
    """Note the lines that follow under the test's name."""
    if now := _measuring():
        now.switch_context(item.nodeid)
    try:
        return (yield)
    finally:
        if now:
            now.switch_context("")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Add up what each test took and remember those that fail without any mutant."""
    _SECONDS[report.nodeid] += report.duration
    if report.failed:
        _FAILED.add(report.nodeid)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Save the lines of a worker, which ends without leave; write times and failures where the run was told to."""
    if now := _measuring():
        now.stop()
        now.save()
    if not hasattr(session.config, "workerinput") and "MUTANTS_TIMES" in os.environ:
        text = json.dumps({"seconds": _SECONDS, "failed": sorted(_FAILED)})
        Path(os.environ["MUTANTS_TIMES"]).write_text(text, encoding="utf-8")


# --- the map: which test executes which line ---


@dataclass(frozen=True)
class Map:
    """Which tests execute a line, how long each test takes, which ones fail without any mutant."""

    sources: dict[str, str]  # the files as they were measured
    tests: dict[str, dict[str, list[str]]]  # path -> line -> tests; "" where an import executes it
    seconds: dict[str, float]
    failed: list[str]

    @cached_property
    def files(self) -> dict[str, Counter[str]]:
        """Count, for every file of the packages and every test file, the lines of the one that the other executes."""
        return {
            path: Counter(f for t in at.values() for f in {x.partition("::")[0] for x in t if x})
            for path, at in self.tests.items()
        }

    @cached_property
    def totals(self) -> Counter[str]:
        """Count all lines that a test file executes."""
        return sum(self.files.values(), Counter())

    def tests_of(self, path: str, line: int) -> set[str] | None:
        """Find the tests that execute a line of the present file; ``None``: there is none."""
        before, now = self.sources.get(path, "").splitlines(), _text_of(path).splitlines()
        blocks = difflib.SequenceMatcher(None, before, now, autojunk=False).get_matching_blocks()
        at, old, size = max((b.b, b.a, b.size) for b in [difflib.Match(0, 0, 0), *blocks] if b.b < line)
        known, there = self.tests.get(path, {}), old + min(line - at, size)
        if line - at > size:  # a new line
            there = next((n for n in range(there, 0, -1) if str(n) in known), 0)
        return set(known[str(there)]) if str(there) in known else None

    def rounds(self, path: str, line: int, most: float) -> list[list[str]]:
        """Choose what a mutant is tried on: the tests of its line, in two helpings, and then whole files that execute its file.

        Of a line that runs at import only the files are known. What is most about the mutant's file for its seconds comes first: by
        the share that it has of a test file's lines. The last two helpings take at most ``most`` seconds of tests, as measured.
        """
        near: dict[str, list[str]] = {}
        tests = self.tests_of(path, line) or {""}
        if "" not in tests:
            for test in sorted(tests & self.seconds.keys(), key=lambda t: self.seconds[t]):
                near.setdefault(test.partition("::")[0], []).append(test)
        about = self.files.get(path, Counter())
        cost = {file: sum(self._took(t) for t in near.get(file, [file])) for file in about}
        files = sorted(cost, key=lambda file: -about[file] / self.totals[file] / (5 + cost[file]))
        there = [file for file in files if file in near] or files
        first = [t for file in there[:2] for t in near.get(file, [file])]
        rest = [t for file in there[2:] for t in near.get(file, [])]
        return [first, self._within(rest, most), self._within(files if near else files[2:], most)]

    def _took(self, test: str) -> float:
        if test in self.seconds:
            return self.seconds[test]
        return sum(s for t, s in self.seconds.items() if t.startswith(test + "::"))

    def _within(self, tests: list[str], most: float) -> list[str]:
        took = itertools.accumulate(self._took(test) for test in tests)
        return [test for test, sum_ in zip(tests, took, strict=True) if sum_ <= most]


def _text_of(path: str) -> str:
    return (ROOT / path).read_text(encoding="utf-8")


def product() -> list[str]:
    """List the files of the three packages."""
    return sorted(f.relative_to(ROOT).as_posix() for p in PACKAGES for f in (ROOT / p).rglob("*.py"))


def measure(tree: Path, folder: Path, jobs: int) -> dict[str, Any]:
    """Run the default tests of a tree once under coverage; returns what `Map` holds, as JSON does."""
    settings, times = folder / "coverage.ini", folder / "times.json"
    sources = "".join(f"    {tree / p}\n" for p in PACKAGES)
    settings.write_text(SETTINGS + f"data_file = {folder / 'lines'}\nsource =\n{sources}", encoding="utf-8")
    extra = {"COVERAGE_PROCESS_START": str(settings), "MUTANTS_TIMES": str(times)}
    words = f"-m pytest -q -p no:cacheprovider -p benchmarks.mutants -o timeout=1800 -n {jobs}"
    env = {**os.environ, "PYTHONPATH": str(tree), **extra}
    subprocess.run([sys.executable, *words.split()], cwd=tree, env=env, check=False)
    from coverage import CoverageData
    from coverage.exceptions import DataError
    from coverage.numbits import numbits_to_nums

    lines = CoverageData(basename=str(folder / "all"))
    for part in folder.glob("lines.*"):
        other = CoverageData(basename=str(part))
        with suppress(DataError):  # of a process that was killed
            other.read()
            lines.update(other)
    lines.write()
    found: dict[str, dict[int, set[str]]] = {}
    with sqlite3.connect(folder / "all") as db:
        words = "select path, context, numbits from line_bits join file on file.id = file_id "
        rows = db.execute(words + "join context on context.id = context_id")
        for path, context, bits in rows:
            # "static|dynamic"; a process that a test started has the test and its phase in the static half.
            test = re.sub(r" \((call|setup|teardown)\)$", "", context.strip("|"))
            of_file = found.setdefault(Path(path).relative_to(tree).as_posix(), {})
            for line in numbits_to_nums(bits):
                of_file.setdefault(line, set()).add(test)
    tests = {path: {str(n): sorted(t) for n, t in at.items()} for path, at in found.items()}
    return {
        "sources": {p: _text_of(p) for p in product()},
        "tests": tests,
        **json.loads(times.read_text(encoding="utf-8")),
    }


def run(tree: Path, arguments: list[str], limit: float) -> tuple[int, str]:
    """Run pytest in a tree, in a fork that has the libraries in memory; returns its exit status and the first test that failed."""
    said = tree / "said.txt"
    child = multiprocessing.get_context("fork").Process(target=_pytest, args=(tree, arguments, said))
    child.start()
    child.join(limit)
    if child.exitcode is None:
        os.killpg(child.pid or 0, signal.SIGKILL)
        child.join()
        return 1, f"more than {limit} s"
    lines = said.read_text(encoding="utf-8", errors="replace").splitlines()
    return child.exitcode, next((line for line in lines if line.startswith(("FAILED", "ERROR"))), "")


def _pytest(tree: Path, arguments: list[str], said: Path) -> None:
    os.setsid()
    with said.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)
    sys.path[:] = [str(tree), *(p for p in sys.path if not Path(p).is_relative_to(ROOT / "benchmarks"))]
    status = pytest.main(["-q", "--tb=no", "-p", "no:cacheprovider", *arguments])
    sys.stdout.flush()
    os._exit(int(status))


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
        before = _text_of(self.path).splitlines()
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
    sources = {p: _text_of(p) for p in product() if p.startswith(only)}
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
    tree = ast.parse(_text_of(path))
    kernels = [f for f in ast.walk(tree) if isinstance(f, ast.FunctionDef)]
    return any(
        f.lineno <= line <= (f.end_lineno or 0)
        and any("compiled" in ast.unparse(d) for d in f.decorator_list)
        for f in kernels
    )


def trial(mutant: Mutant, tree: Path, known: Map, most: float) -> tuple[str, str]:
    """Return ``dies``, ``lives`` or ``unseen`` (no test executes the line), and the test that noticed."""
    if known.tests_of(mutant.path, mutant.line) is None and not compiled(mutant.path, mutant.line):
        return "unseen", ""
    file, listed = tree / mutant.path, tree / "tests-to-run.txt"
    kept, stamp = file.read_bytes(), file.stat()
    file.write_text(mutant.text, encoding="utf-8")
    try:
        for tests in known.rounds(mutant.path, mutant.line, most):
            listed.write_text("\n".join(tests), encoding="utf-8")
            skip = [f"--deselect={t}" for t in known.failed]
            if not tests:
                continue
            status, said = run(tree, ["-x", "-o", "timeout=300", *skip, f"@{listed}"], LIMIT)
            if status not in (0, 4, 5):  # 4: a test of the map that is gone; its file is run next
                return "dies", said
        return "lives", ""
    finally:
        file.write_bytes(kept)
        os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


_MINE: list[Any] = []  # a worker's tree, the map, and the seconds


def _take(free: Any, known: Map, most: float) -> None:
    _MINE[:] = [free.get(), known, most]


def _one(mutant: Mutant) -> tuple[str, str]:
    start = time.monotonic()
    fate, by = trial(mutant, *_MINE)
    took = f"{time.monotonic() - start:4.0f} s"
    print(f"{fate:6} {took}  {mutant.path}:{mutant.line} {mutant.kind}  {by}", flush=True)
    return fate, by


def main() -> None:
    """Draw, try and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=130)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="paths that begin so")
    parser.add_argument("--map", type=Path, help="file that keeps which test executes which line")
    parser.add_argument(
        "--most", type=float, default=90, help="seconds of further tests for one that lives on (default: 90)"
    )
    parser.add_argument("--again", type=Path, metavar="FILE", help="of this --out, try what lived once more")
    parser.add_argument("--out", type=Path, help="write every mutant and its fate as JSON")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="mutants-"))
    (folder / "shared").symlink_to(ROOT.parent / "shared")
    trees = [Path(shutil.copytree(ROOT, folder / str(job), ignore=LEFT_OUT)) for job in range(args.jobs)]
    kept = args.map or folder / "map.json"
    if not kept.exists():
        kept.write_text(json.dumps(measure(trees[0], folder, args.jobs)), encoding="utf-8")
    known = Map(**json.loads(kept.read_text(encoding="utf-8")))
    known.totals  # noqa: B018  counted once, before the workers fork
    if new := [p for p in product() if p not in known.sources]:
        print(f"No test of these is known, measure anew: {', '.join(new)}")

    for name in LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(name)
    mutants = draw(args.count, args.seed, args.only)
    if args.again:
        lived = {
            (m["path"], m["line"]) for m in json.loads(args.again.read_text("utf-8")) if m["fate"] != "dies"
        }
        mutants = [m for m in mutants if (m.path, m.line) in lived]
    fork = multiprocessing.get_context("fork")
    free = fork.SimpleQueue()
    for tree in trees:
        free.put(tree)
    with ProcessPoolExecutor(
        args.jobs, mp_context=fork, initializer=_take, initargs=(free, known, args.most)
    ) as pool:
        fates = list(pool.map(_one, mutants))
    shutil.rmtree(folder)
    for mutant, (fate, _) in zip(mutants, fates, strict=True):
        if fate != "dies":
            print(f"{fate}\n{mutant.diff()}")
    for package in (*PACKAGES, ""):
        of = Counter(
            f
            for m, (f, _) in zip(mutants, fates, strict=True)
            if m.path.startswith(f"{package}/" if package else "")
        )
        print(
            f"{package or 'all'}: {of['dies']} of {of.total()} die, {of['lives']} live, no test executes {of['unseen']}"
        )
    if args.out:
        rows = [{"path": m.path, "line": m.line, "kind": m.kind, "fate": f, "by": by, "diff": m.diff()}
                for m, (f, by) in zip(mutants, fates, strict=True)]  # fmt: skip
        args.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
