"""The examples of README.md and docs/ run and print what the page shows; the pages are built without warnings.

Every page is run from top to bottom in a fresh folder with copies of `benchmarks/`, `datasets/` and `models/`; a
tutorial in a folder that has nothing of the checkout, whose place is `$CGID`:

* ```` ```sh ```` : bash, ends with exit code 0; setting up and testing (`pip install`, `pytest`) are left out;
* ```` ```console ```` : the lines after `$ ` are commands, the others what they print;
* ```` ```python ```` : one namespace a page, as plain code or as `>>> ` sessions;
* ```` ```text ```` : what the block before has printed, if no more than a paragraph stands between. `...` stands for
  anything, and the width of blanks does not matter.

A comment on the line before a block, `<!-- ... -->` or `% ...`, says more: `not run: REASON`, `exit code: 65`,
`file: NAME` (the block is written to this file). Pages are long tests; the first block of README.md always runs.
"""

from __future__ import annotations

import contextlib
import doctest
import importlib
import importlib.util
import inspect
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

import cgid
from cgid.cli.main import run
from cgid.identification.prediction.answers import COLUMNS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
#: Folders of docs/ that a build writes.
BUILT = [DOCS / name for name in ("_build", "examples", "notebooks", "reference/commands", "reference/api/generated")]
PAGES = [ROOT / "README.md", *sorted(path for path in DOCS.rglob("*.md") if not set(BUILT) & set(path.parents))]

_FENCE = re.compile(r"(?P<fence>`{3,}|:{3,})(?P<language>[\w+-]*|\{.*\}.*) *")
_COMMENT = re.compile(r"(?:<!-- |% )(?P<key>not run|exit code|file): (?P<value>.*?)(?: -->)?")
#: Steps that this environment has behind it, and the tests themselves.
_SETUP = re.compile(
    r"(?:(?:python3?|py) -m venv|(?:\S*/)?pip install|(?:\S*/)?python3? -m (?:pip|pytest)|(?:source|\.) \S*activate"
    r"|git clone|cd cgid\b).*"
)
_OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass
class Block:
    """A fenced block of a page."""

    language: str
    text: str
    line: int
    notes: dict[str, str] = field(default_factory=dict)
    #: Whether at most one paragraph stands between this block and the one before.
    follows: bool = False


def blocks_of(page: str) -> list[Block]:
    found: list[Block] = []
    notes: dict[str, str] = {}
    paragraphs, in_paragraph, other = 0, False, False
    lines = iter(enumerate(page.splitlines(), start=1))
    for number, line in lines:
        fence = _FENCE.fullmatch(line)
        comment = _COMMENT.fullmatch(line.strip())
        if fence is not None:
            body = []
            for _, inner in lines:
                if inner.rstrip() == fence["fence"]:
                    break
                body.append(inner)
            text = "\n".join(body) + "\n"
            found.append(Block(fence["language"], text, number, notes, bool(found) and not other and paragraphs <= 1))
            notes, paragraphs, in_paragraph, other = {}, 0, False, False
        elif comment is not None:
            notes[comment["key"]] = comment["value"]
        elif not line.strip():
            in_paragraph = False
        else:
            other = other or line.startswith(("#", "|", "!["))
            paragraphs += not in_paragraph
            in_paragraph, notes = True, {}
    return found


class Walk:
    """A reader who goes through a page in a folder and does what it states."""

    def __init__(self, folder: Path, foreign: bool = False) -> None:
        self.folder = folder
        self.names: dict[str, Any] = {"__name__": "__main__"}
        for name in () if foreign else ("benchmarks", "datasets", "models"):  # copies: a page may write
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        programs = folder / ".venv" / "bin"
        programs.mkdir(parents=True)
        for name, command in {"cgid": "-P -m cgid", "python": "", "python3": ""}.items():
            program = programs / name
            program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {command} "$@"\n')
            program.chmod(0o755)
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        # One width and no colours, whatever terminal the tests run in.
        self.environment = os.environ | {
            "PATH": os.pathsep.join([str(programs), os.environ.get("PATH", "")]),
            "PYTHONPATH": path,
            "PYTHONUNBUFFERED": "1",
            "CGID": str(ROOT),
            "MPLBACKEND": "agg",
            "COLUMNS": "110",
        }

    def run(self, block: Block) -> list[str]:
        """Do what a block says; return the texts that may be shown as its output."""
        if "file" in block.notes:
            (self.folder / block.notes["file"]).write_text(block.text, encoding="utf-8")
            return []
        if block.language == "sh":
            return self.shell(block.text, int(block.notes.get("exit code", 0)))
        if block.language == "console":
            for command, printed in sessions(block.text):
                compare(printed, self.shell(command, int(block.notes.get("exit code", 0))))
            return []
        if block.text.lstrip().startswith(">>> "):
            return [self.session(block)]
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile("\n" * block.line + block.text, "page", "exec"), self.names)
        return [out.getvalue()]

    def shell(self, text: str, code: int) -> list[str]:
        """Run commands; return what the terminal shows, both streams in the order of their lines."""
        script = "\n".join(filter(None, map(without_setup, joined(text))))
        if not script:
            return []
        done = subprocess.run(
            ["bash", "-c", f"set -e -o pipefail\n{script}"],
            cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, encoding="utf-8", timeout=1200, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"{script}\nended with exit code {done.returncode}, not {code}:\n{done.stdout}"
        return [done.stdout]

    def session(self, block: Block) -> str:
        """Run a session of `>>> ` lines as a doctest."""
        test = doctest.DocTestParser().get_doctest(block.text, self.names, "page", "page", block.line)
        said = io.StringIO()
        runner = doctest.DocTestRunner(optionflags=_OPTIONS, verbose=False)
        runner.run(test, out=said.write, clear_globs=False)
        self.names |= test.globs
        assert not runner.failures, said.getvalue()
        return said.getvalue()


def joined(text: str) -> list[str]:
    """Return the commands of a block, each on one line."""
    return text.replace("\\\n", " ").splitlines()


def without_setup(command: str) -> str:
    """Return a command without the steps that set up an environment."""
    return " && ".join(step for step in command.split(" && ") if not _SETUP.fullmatch(step.strip()))


def sessions(text: str) -> Iterator[tuple[str, str]]:
    """Yield the commands of a console session, each with what it prints."""
    for part in re.split(r"^\$ ", text.replace("\\\n", " "), flags=re.MULTILINE)[1:]:
        command, _, printed = part.partition("\n")
        yield command, printed


def compare(expected: str, printed: list[str]) -> None:
    """Fail if none of the texts is the expected one."""
    checker = doctest.OutputChecker()
    if expected.strip() and not any(checker.check_output(expected, text, _OPTIONS) for text in printed):
        shown = printed[0] if printed else ""
        pytest.fail(f"the page shows\n{expected}\nbut it prints\n{shown}", pytrace=False)


def follow(page: Path, folder: Path, n_blocks: int | None = None) -> None:
    """Go through a page from top to bottom, or through its first blocks."""
    walk = Walk(folder, foreign=page.parent.name == "tutorials")
    last: Block | None = None
    printed: list[str] = []
    for block in blocks_of(page.read_text(encoding="utf-8"))[:n_blocks]:
        runs = block.language in ("sh", "console", "python")
        try:
            if block.language == "text" and block.follows and last is not None and printed:
                compare(block.text, printed)
            elif "not run" not in block.notes and (runs or "file" in block.notes):
                last, printed = block, walk.run(block)
                continue
        except BaseException:
            print(f"{page}:{block.line}:\n{block.text}")
            raise
        last, printed = None, []


def test_the_first_answer_of_the_readme_is_printed(tmp_path: Path) -> None:
    follow(ROOT / "README.md", tmp_path, n_blocks=2)


@pytest.mark.long
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    follow(page, tmp_path)


#: Links that lead somewhere, but are not loaded.
_LINKS = ("canonical", "author", "copyright", "index", "search", "next", "prev")


class Loaded(HTMLParser):
    """What a browser loads to show a page."""

    def __init__(self) -> None:
        super().__init__()
        self.places: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        if tag in ("script", "img", "iframe", "source", "video", "embed"):
            self.places.append(given.get("src") or "")
        if tag == "link" and given.get("rel") not in _LINKS:
            self.places.append(given.get("href") or "")


def test_lines_of_json_have_the_keys_of_their_page(capsys: pytest.CaptureFixture[str]) -> None:
    page = (DOCS / "reference" / "lines.md").read_text(encoding="utf-8")
    rows = {
        kinds: set(re.findall(r"`(\w+)`", keys)) for kinds, keys in re.findall(r"^\| (`.*?) \| (.*) \|$", page, re.M)
    }
    assert run(["predict", "--sample", "--json", "--set", "window=0.06", "--set", "coverage=0.9"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for kind in ("impact", "share", "summary"):
        keys = {key for line in lines if line["kind"] == kind for key in line} - {"version", "kind", "source"}
        stated = next(found for kinds, found in rows.items() if f"`{kind}`" in kinds)
        if kind == "share":  # which holds the record of a support, in a table of its own
            stated = {"from_s", "to_s", "time_s"} | {key for keys in rows for key in re.findall(r"`(\w+)`", keys)}
        assert keys
        assert keys == keys & stated


def test_columns_of_answers_are_described() -> None:
    titles = {column.title.replace("*", "LABEL") for column in COLUMNS.values()}
    assert titles - set(re.findall(r"`(\w+)`", cgid.predict.__doc__ or "")) == set()
    page = (DOCS / "reference" / "lines.md").read_text(encoding="utf-8")
    assert titles - {"p_LABEL"} - set(re.findall(r"`(\w+)`", page)) == set()


def test_named_programs_exist() -> None:
    program = re.compile(r"(?<![\w/])(?:benchmarks|datasets|models|tests)/[\w/]+\.\w+\b")
    named = {(page.name, name) for page in PAGES for name in program.findall(page.read_text(encoding="utf-8"))}
    assert len(named) > 30
    assert not [(page, name) for page, name in named if not (ROOT / name).exists()]


def test_no_document_starts_cgid_so_that_it_imports_from_the_current_folder() -> None:
    """`python -m` does; `cgid` and `python -P -m` do not."""
    starts = re.compile(r"-m\W{1,6}cgid\b")
    written = [*PAGES, *ROOT.glob("*.md"), *(ROOT / "cgid").rglob("*.py"), *DOCS.rglob("*.py")]
    written += ROOT.glob("notebooks/*.ipynb")
    lines = [line for path in written for line in path.read_text(encoding="utf-8").splitlines() if starts.search(line)]
    assert [line for line in lines if not re.search(r"-P\W{1,6}-m", line)] == []


def test_docstrings_of_the_reference_are_complete(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each documented function and class says what it takes or holds, and each function what it returns."""
    pytest.importorskip("sphinx")
    docscrape = pytest.importorskip("numpydoc.docscrape")
    monkeypatch.syspath_prepend(str(DOCS / "_extensions"))
    pages = importlib.import_module("api_pages")
    problems = []
    for _, modules in pages.PAGES.values():
        for module in modules:
            for name in pages.names_of(module):
                found = getattr(importlib.import_module(module), name)
                if not (inspect.isfunction(found) or (inspect.isclass(found) and not issubclass(found, Warning))):
                    continue
                text = docscrape.NumpyDocString(pages.described(found))
                entries = [*text["Parameters"], *text["Attributes"]]
                told = {word.strip() for entry in entries for word in entry.name.split(",")}
                signature = inspect.signature(found)
                kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
                asked = [one.name for one in signature.parameters.values() if one.kind not in kinds]
                if inspect.isclass(found) and issubclass(found, Enum):  # its members say it
                    asked = []
                if name != "RecordingFile":  # users receive it from `open_recording`
                    problems += [f"{module}.{name}: {one} is not described" for one in asked if one not in told]
                returns = inspect.isfunction(found) and signature.return_annotation not in ("None", None)
                if returns and not text["Returns"] and not text["Yields"]:
                    problems.append(f"{module}.{name}: what it returns is not described")
    assert not problems


def test_packages_say_what_is_public(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each package has `__all__`, whose names exist, and the reference describes what has one."""
    pytest.importorskip("numpydoc")
    monkeypatch.syspath_prepend(str(DOCS / "_extensions"))
    described = {module for _, modules in importlib.import_module("api_pages").PAGES.values() for module in modules}
    packages = {f"cgid.{path.parent.name}" for path in ROOT.glob("cgid/[!_]*/__init__.py")}
    for name in sorted(packages | described):
        module = importlib.import_module(name)
        assert module.__all__, name
        if module.__file__.endswith("__init__.py") and module.__name__ in described:
            # That of `cgid` has its modules, too, which tests/test_types.py compares.
            assert {*module.__all__} == {*dir(module)} or (name == "cgid" and {*module.__all__} < {*dir(module)}), name
        for one in module.__all__:
            assert hasattr(module, one) or importlib.util.find_spec(f"{name}.{one}"), f"{name}.{one}"


@pytest.mark.long
def test_pages_are_built_without_warnings_and_without_the_network(tmp_path: Path) -> None:
    """The build also runs the gallery, and ends at the first example that fails."""
    for library in ("sphinx", "myst_parser", "numpydoc", "sphinx_gallery", "sphinx_copybutton", "furo"):
        pytest.importorskip(library)
    source, html = tmp_path / "docs", tmp_path / "html"
    # The checkout stays as it is, and pages show pictures beside docs/.
    for name in ("docs", "benchmarks", "datasets", "models"):
        built = shutil.ignore_patterns("_build", "examples", "commands", "generated", "notebooks")
        shutil.copytree(ROOT / name, tmp_path / name, ignore=built)
    for name in ("cgid", "notebooks", "CHANGELOG.md", "SECURITY.md", "ARCHITECTURE.md"):
        (tmp_path / name).symlink_to(ROOT / name)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(source), str(html)]
    closed = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | closed, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    for page in html.rglob("*.html"):
        loaded = Loaded()
        loaded.feed(page.read_text(encoding="utf-8"))
        foreign = [place for place in loaded.places if place.startswith(("http:", "https:", "//"))]
        assert not foreign, f"{page}: {foreign}"
        curly = re.findall("[\u2013\u2014\u2018\u2019\u201c\u201d]", page.read_text(encoding="utf-8"))
        assert not curly, f"{page}: copied from it, options would not work: {curly}"
    for sheet in html.rglob("*.css"):
        places = re.findall(r"(?:@import|url\()\s*['\"]?((?:https?:)?//[^'\")]+)", sheet.read_text(encoding="utf-8"))
        assert not places, f"{sheet}: {places}"


def test_table_of_the_architecture_names_what_is_there() -> None:
    """Files are there, short names of them beside the file before; names after a file stand in it."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| an? .*$", text.split("## To add something", 1)[1].split("\n## ", 1)[0], re.MULTILINE)
    assert len(rows) >= 12
    checked = 0
    for row in rows:
        file = ROOT
        for word, inside in re.findall(r"`([^`]+)`|\(([^)]*)\)", row.split("|", 2)[2]):
            if word:
                file = ROOT / word if (ROOT / word).exists() else file.parent / word
                assert file.exists(), f"{word} in {row}"
            for name in re.findall(r"`(\w+)`", inside) if file.is_file() else ():
                defined = rf"^(?:    )?(?:class |def )?{name}\b(?:\(|:| =)"
                assert re.search(defined, file.read_text(encoding="utf-8"), re.MULTILINE), f"{name} in {file.name}"
                checked += 1
    assert checked >= 20
