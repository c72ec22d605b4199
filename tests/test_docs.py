"""The docs: every command with its example, every function explained, what is executed runs, the site builds without a warning."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.test_files_shard import write
from tofcapture.cli import GROUP, main

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
COMMANDS = {e.name: e.load() for e in entry_points(group=GROUP)}
PACKAGES = ("tofcapture", "tofcapture_model", "calibration")
PAGES = sorted(p for p in DOCS.rglob("*.md") if "reference" not in p.parts)
sys.path.insert(0, str(DOCS))

import generate  # noqa: E402


def test_every_command_stands_in_the_docs_with_its_example():
    """The generated reference has each command's help and example."""
    page = generate.commands_page()
    for name, command in COMMANDS.items():
        assert f"### {name}\n" in page
        assert command.example in page
        assert f"usage: tofcapture {name}" in page
    for typed, parser in generate._parsers().items():
        assert "--json" in parser._option_string_actions, typed


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(DOCS)))
def test_command_lines_in_the_docs_parse(page):
    """Every line of a shell block that starts with tofcapture names a command and options that exist."""
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            for name, rest in re.findall(r"(?:^|&& |\| )\s*tofcapture ([a-z-]+)([^#|&>]*)", line):
                assert name in COMMANDS, line
                known = generate.options_of(name)
                assert set(re.findall(r"(?<!\S)--[a-z-]+", rest)) <= known | {"--help"}, line


def _public(package):
    """(module, qualified name, node) of every public function and method."""

    def walk(node, path, above):
        for child in node.body:
            if isinstance(child, ast.ClassDef) and not child.name.startswith("_"):
                yield from walk(child, path, f"{above}{child.name}.")
            elif isinstance(child, ast.FunctionDef) and not child.name.startswith("_"):
                yield path, above + child.name, child

    for path in sorted((ROOT / package).rglob("*.py")):
        yield from walk(ast.parse(path.read_text()), path.relative_to(ROOT), "")


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_function_is_explained(package):
    """A docstring each; where there is a section of parameters, it names all of them."""
    wrong = []
    for path, name, node in _public(package):
        text = ast.get_docstring(node) or ""
        section = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-+\n|\Z)", text, re.DOTALL | re.MULTILINE)
        given = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
        named = set(re.findall(r"\w+", section[1])) if section else set(given)
        missing = [a for a in given if a not in {"self", "cls"} and a not in named]
        if not text or missing:
            wrong.append(f"{path}: {name} lacks {missing or 'a docstring'}")
    assert wrong == []


def test_reading_example_runs_without_our_code(tmp_path):
    """The numpy example of "read the data" prints an error in millimetres and does not import this package."""
    text = (DOCS / "howto" / "read-the-data.md").read_text()
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    assert "tofcapture." not in code
    write(tmp_path / "mug.h5")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"error [\d.]+ mm on [1-9]\d* pixels", done.stdout)


@pytest.mark.slow
def test_cpp_example_agrees_with_numpy(tmp_path):
    """The C++ example compiles and prints what numpy prints."""
    import shutil

    if shutil.which("h5c++") is None:
        pytest.skip("there is no h5c++: apt install libhdf5-dev")
    text = (DOCS / "howto" / "read-the-data.md").read_text()
    source = str(ROOT / "examples" / "read.cpp")
    subprocess.run(["h5c++", source, "-o", "read"], cwd=tmp_path, check=True, capture_output=True)
    write(tmp_path / "mug.h5")
    said = subprocess.run(
        ["./read", "mug.h5"], cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]
    other = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True
    ).stdout
    assert said.split()[0] in other


def test_links_lead_somewhere():
    """Every relative link and picture of every page, and of README, exists."""
    generated = {"commands.md", *(f"api-{p}.md" for p in PACKAGES)}
    for page in (*PAGES, ROOT / "README.md"):
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target and Path(target).name not in generated:
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)}: {target}"


def _sentences(text):
    """Words of each sentence, its number of words; code, tables, headings and pictures are no sentences."""
    text = re.sub(r"```.*?```|<!--.*?-->", "\n\n", text, flags=re.DOTALL)
    lines = ["" if re.match(r"\s*[|#!]|    \S", line) else line for line in text.splitlines()]
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", "\n".join(lines))
    for paragraph in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", text):
        for sentence in re.split(r"(?<=[.?!:;])\*{0,2}\s+", paragraph):
            yield sum(bool(re.search(r"\w", word)) for word in sentence.split()), sentence


def test_pages_are_short_and_plain():
    """20,000 words in all, README 600, a decision 400; a sentence 25, a cell of a table 12."""
    texts = {p: p.read_text() for p in (*PAGES, ROOT / "README.md")}
    assert sum(len(text.split()) for text in texts.values()) <= 20_000
    assert len(texts[ROOT / "README.md"].split()) <= 600
    for page, text in texts.items():
        assert page.parent.name != "decisions" or len(text.split()) <= 400, page
        assert [said for words, said in _sentences(text) if words > 25] == [], page
        cells = [cell for line in text.splitlines() if line.startswith("|") for cell in line.split("|")]
        assert [cell for cell in cells if len(cell.split()) > 12] == [], page


def test_extras_are_documented_and_complete():
    """Each extra stands in the table of sizes, and ``all`` leads to every one of them that it is not said of."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    page = (DOCS / "install.md").read_text()
    for name in extras:
        assert f"`{name}`" in page, name
    reached, todo = set(), ["all"]
    while todo:
        name = todo.pop()
        reached.add(name)
        more = {
            e
            for line in extras[name]
            for g in re.findall(r"^tofcapture\[([\w,-]+)\]", line)
            for e in g.split(",")
        }
        todo += more - reached
    assert reached | set(re.findall(r"`(\w+)` \(not in `all`\)", page)) == set(extras)


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh", "fish"])
def test_completion_knows_every_command(shell, capsys):
    """The generated scripts name all commands and their options."""
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for name in COMMANDS:
        assert name in script
    assert "calibration" in script


def test_bash_completes(capsys, tmp_path):
    """Bash itself offers commands, parts and options."""
    assert main(["completion", "bash"]) == 0
    (tmp_path / "c").write_text(capsys.readouterr().out)
    for words, expected in (
        ("tofcapture simu", "simulate-dataset"),
        ("tofcapture view --p", "--png"),
        ("tofcapture calibrate ha", "hand-eye"),
    ):
        line = f'source c; COMP_WORDS=({words}); COMP_CWORD={len(words.split()) - 1}; _shtab_tofcapture; echo "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert expected in done.stdout.split(), words


def test_config_says_where_values_come_from(tmp_path, monkeypatch, capsys):
    """A flag beats the environment, the environment beats what is built in; each value says who gave it."""
    monkeypatch.delenv("TOFCAPTURE_STATION", raising=False)
    assert main(["config", "show", "--origin"]) == 0
    assert "(built in)" in capsys.readouterr().out
    mine = tmp_path / "mine.toml"
    mine.write_text("[sim]\nseed = 3\n")
    monkeypatch.setenv("TOFCAPTURE_STATION", str(mine))
    assert main(["config", "show", "--origin"]) == 0
    assert "sim.seed = 3    # " + f"{mine} ($TOFCAPTURE_STATION)" in capsys.readouterr().out
    assert main(["config", "show", "--origin", "--seed", "5"]) == 0
    assert "sim.seed = 5    # --seed" in capsys.readouterr().out
    assert main(["config", "show", "--station", str(tmp_path / "none.toml")]) == 3


@pytest.mark.slow
def test_site_builds_without_a_warning(tmp_path):
    """Sphinx, with warnings as errors."""
    pytest.importorskip("sphinx")
    words = [
        sys.executable,
        "-m",
        "sphinx",
        "-q",
        "-W",
        "--keep-going",
        "-b",
        "html",
        str(DOCS),
        str(tmp_path),
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    assert (tmp_path / "index.html").is_file()
