"""The figures of README and of the pages in docs/benchmarks: where each comes from, and whether it still holds.

    python -m benchmarks.claims                   # compare the pages with claims.toml, one line a difference
    python -m benchmarks.claims --write           # write what claims.toml says into the pages
    python -m benchmarks.claims --quick           # measure again what takes two minutes together: no times
    python -m benchmarks.claims --all --write     # measure all again; what was found goes into claims.toml and pages
    python -m benchmarks.claims --only NAME ...   # measure some again: what each finds, and whether it holds

Without --write, tables and pictures of the repository that a command writes are put back as they were.

A claim of `claims.toml` is what one command says:

    name, command, commit and date of its last run
    tolerance   of a new run: 0.01, or "20 %" of each figure, or "20 % or 1e-9", the larger of both
    table       what the command prints, a Markdown table or lines of text, cut to `rows` (a regular expression) and to
                the titles in `columns`; `ignore` names titles whose figures are not compared, as times; `which` is
                the number of the table where a command prints several, from 0. `page` has it between <!-- NAME -->
                and <!-- end of NAME -->, or the part that `shown` (a regular expression of rows) and `titles` leave;
                without a page the table is only kept and compared
    says        sentences and rows of pages; each {} is one of `values`, and `from` says where it is found: a row and a
                title of the table, or a regular expression with a group for what the command prints

`given` are sentences whose figures nobody measures. Any other figure of README and of docs/benchmarks outside of code
fails (`tests/test_claims.py`); other pages have the figures that a claim says of them.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import shlex
import subprocess
import sys
import textwrap
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "benchmarks" / "claims.toml"
_DIGITS = r"(?:\d+(?:,\d{3})*(?:\.\d+)?|\.\d+)(?:e[-+]?\d+)?"
_NUMBER = re.compile(rf"(?<![\w.])[-+]?{_DIGITS}")
#: What is no text: code, comments, targets of links, roles of Sphinx.
_CODE = re.compile(r"^(`{3,}|:{3,}).*?^\1|<!--.*?-->|^% .*?$|\{\w+\}`[^`]*`|`[^`]*`|\]\([^)]*\)", re.S | re.M)


class ClaimError(Exception):
    """Claims that cannot be read, or a command that does not say what a claim needs."""


@dataclass(frozen=True)
class Said:
    """A sentence or row of pages, with its figures."""

    pages: list[str]
    text: str
    values: list[str] = field(default_factory=list)
    source: list[Any] = field(default_factory=list)

    def rendered(self) -> str:
        """Return the text with its figures."""
        values = iter(self.values)
        return re.sub(r"\{\}", lambda _: next(values), self.text)

    def on(self, page: str, values: bool = True) -> list[re.Match[str]]:
        """Return where the text stands on a page, whose lines break anywhere: with its figures, or with any."""
        text = re.escape(self.rendered() if values else self.text)
        text = re.sub(r"(?:\\ )+", r"\\s+", text.replace(r"\{\}", f"([-+]?{_DIGITS})"))
        return list(re.finditer(text, page))

    def put(self, page: str) -> str:
        """Return a page where the text has these figures."""
        for found in reversed(self.on(page, values=False)):
            for k, value in reversed(list(enumerate(self.values, 1))):
                page = page[: found.start(k)] + value + page[found.end(k) :]
        return page


@dataclass(frozen=True)
class Claim:
    """What one command says."""

    name: str
    command: str
    commit: str
    date: datetime.date
    tolerance: float | str
    quick: bool = False
    page: str = ""
    which: int = 0
    rows: str = ""
    columns: list[str] = field(default_factory=list)
    ignore: list[str] = field(default_factory=list)
    shown: str = ""
    titles: list[str] = field(default_factory=list)
    table: str = ""
    says: list[Said] = field(default_factory=list)

    def block(self) -> str:
        """Return what the page has between the marks of this claim."""
        made = f"Made by `{self.command}` at commit {self.commit}, {self.date}."
        lines, heads = self.table.splitlines(), 2 * self.table.startswith("|")
        shown = [*lines[:heads], *(line for line in lines[heads:] if re.search(self.shown, line))]
        table = "\n".join(with_columns(shown, self.titles, self.name) if heads else ["```text", *shown, "```"])
        return f"<!-- {self.name} -->\n{made}\n\n{table}\n<!-- end of {self.name} -->"

    def marks(self) -> re.Pattern[str]:
        """Return the regular expression of that block."""
        return re.compile(rf"<!-- {self.name} -->.*?<!-- end of {self.name} -->", re.S)


def read(path: Path = TABLE) -> tuple[list[Claim], list[Said]]:
    """Return the claims and what is given; a claim that says too little is an error."""
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, OSError) as error:
        raise ClaimError(f"{path}: {error}") from None
    claims = []
    for row in stated.get("claim", []):
        name = row.get("name", "without a name")
        for key in ("name", "command", "commit", "date", "tolerance"):
            if not row.get(key):
                raise ClaimError(f"{name}: {key} must be given, got {row.get(key)!r}; without it nobody can repeat it")
        if not row["command"].startswith("python "):
            raise ClaimError(f"{name}: command must begin with python, got {row['command']!r}")
        if unknown := set(row) - {one.name for one in fields(Claim)}:
            raise ClaimError(f"{name}: {min(unknown)} is no key of a claim; see benchmarks/claims.py")
        allowed(row["tolerance"], 1.0, name)
        if row.get("page") and not row.get("table"):
            raise ClaimError(f"{name}: table must be given for its page")
        claims.append(Claim(**row | {"says": [_said(one, name) for one in row.get("says", [])]}))
    if len({one.name for one in claims}) < len(claims):
        raise ClaimError("names of claims must differ")
    return claims, [_said(one, "given") for one in stated.get("given", [])]


def _said(row: dict[str, Any], name: str) -> Said:
    if not row.get("pages") or not row.get("text"):
        raise ClaimError(f"{name}: pages and text must be given for what it says, got {row}")
    said = Said(row["pages"], row["text"], row.get("values", []), row.get("from", []))
    if not said.text.count("{}") == len(said.values) == len(said.source):
        raise ClaimError(f"{name}: {said.text!r} must have as many values and sources as {{}}")
    return said


def allowed(tolerance: float | str, value: float, name: str = "") -> float:
    """Return how far a figure may be from a value."""
    if isinstance(tolerance, float) and tolerance > 0:
        return tolerance
    if isinstance(tolerance, str) and (found := re.fullmatch(r"(\d+) %(?: or (\d\S*))?", tolerance)):
        return max(abs(value) * int(found[1]) / 100, float(found[2] or 1e-300))
    raise ClaimError(f'{name}: tolerance must be a positive number such as 0.01, or "20 %", got {tolerance!r}')


def pages_of(root: Path = ROOT) -> dict[str, str]:
    paths = [root / "README.md", *sorted(root.glob("docs/*/*.md"))]
    return {path.relative_to(root).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def problems(claims: Sequence[Claim], given: Sequence[Said], pages: Mapping[str, str]) -> Iterator[str]:
    """Yield what of the pages no claim says, and what of the claims no page or other figure of it says."""
    known: dict[str, list[tuple[int, int]]] = {page: [] for page in pages}
    for claim in claims:
        if claim.page:
            found = claim.marks().search(pages.get(claim.page, ""))
            if found is None or found[0] != claim.block():
                yield f"{claim.page}: {claim.name}: must be what {TABLE.name} says; python -m benchmarks.claims --write"
            known.setdefault(claim.page, []).extend([found.span()] if found else [])
        for said in claim.says:
            for value, source in zip(said.values, said.source, strict=True):
                if claim.table and not isinstance(source, str):
                    cell = cell_of(claim, source)
                    if like(value, cell) != value:
                        yield f"{claim.name}: {said.text!r}: must be {like(value, cell)} as in the table, got {value}"
    for said in [*(said for claim in claims for said in claim.says), *given]:
        for page in said.pages:
            spans = [found.span() for found in said.on(pages.get(page, ""))]
            if not spans:
                yield f"{page}: must have {said.rendered()!r} as {TABLE.name}; python -m benchmarks.claims --write"
            known.setdefault(page, []).extend(spans)
    for page, text in pages.items():
        if not page.startswith(("README", "docs/benchmarks/")):
            continue
        blank = _CODE.sub(lambda code: re.sub(r"\S", " ", code[0]), text)
        for figure in _NUMBER.finditer(blank):
            if not any(begin <= figure.start() and figure.end() <= end for begin, end in known[page]):
                line = text.count("\n", 0, figure.start()) + 1
                yield f"{page}:{line}: {figure[0]} is a figure without a claim; add it to {TABLE.name}"


def cells_of(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def cell_of(claim: Claim, source: Sequence[str]) -> float:
    """Return the first figure in the cell of a row, named by its first cells, and of a title."""
    row, title = source
    head, _, *lines = claim.table.splitlines()
    chosen = [line for line in lines if " | ".join(cells_of(line)).startswith(row)]
    if not chosen or title not in cells_of(head):
        raise ClaimError(f"{claim.name}: the table has no row {row!r}, or no column {title!r}")
    return number(cells_of(chosen[0])[cells_of(head).index(title)], claim.name)


def with_columns(lines: list[str], titles: Sequence[str], name: str) -> list[str]:
    """Return the lines of a table with some of its columns, or with all."""
    if not titles:
        return lines
    if missing := set(titles) - set(cells_of(lines[0])):
        raise ClaimError(f"{name}: the table has no column {min(missing)!r}")
    places = [cells_of(lines[0]).index(title) for title in titles]
    return ["| " + " | ".join(cells_of(line)[place] for place in places) + " |" for line in lines]


def number(text: str, name: str) -> float:
    found = _NUMBER.search(text)
    if found is None:
        raise ClaimError(f"{name}: {text!r} has no figure")
    return float(found[0].replace(",", ""))


def like(stated: str, value: float) -> str:
    """Return a value as a stated figure is written: digits after the point, exponent, zero before it, sign, commas."""
    digits, _, exponent = stated.partition("e")
    decimals = len(digits.partition(".")[2])
    text = f"{value:.{decimals}{'e' if exponent else 'f'}}"
    if exponent:
        text = re.sub(r"e([-+])0*(\d)", lambda found: f"e{found[1].replace('+', '')}{found[2]}", text)
    elif "," in stated:
        text = f"{value:,.{decimals}f}"
    if digits.lstrip("+-").startswith("."):
        text = re.sub(r"^(-?)0\.", r"\1.", text)
    return "+" + text if stated.startswith("+") and value >= 0 else text


def tables_in(printed: str) -> list[list[str]]:
    """Return the Markdown tables of a text, each with a line of dashes below its titles."""
    found: list[list[str]] = [[]]
    for line in printed.splitlines():
        if line.startswith("|"):
            found[-1].append(line.strip())
        elif found[-1]:
            found.append([])
    tables = [lines for lines in found if len(lines) > 1]
    for lines in tables:
        if not re.fullmatch(r"[|\s:-]+", lines[1]):
            lines.insert(1, "|" + "---|" * len(cells_of(lines[0])))
    return tables


def measured(claim: Claim, printed: str) -> Claim:
    """Return a claim with the table and the values of what its command printed."""
    if claim.table:
        head, lines = [], printed.rstrip().splitlines()
        if claim.table.startswith("|"):
            tables = tables_in(printed)
            if len(tables) <= claim.which:
                raise ClaimError(f"{claim.name}: the command printed no such table")
            head, lines = tables[claim.which][:2], tables[claim.which][2:]
        kept = [*head, *(line.rstrip() for line in lines if re.search(claim.rows, line))]
        claim = replace(claim, table="\n".join(with_columns(kept, claim.columns, claim.name)) + "\n")
    says = []
    for said in claim.says:
        values = []
        for value, source in zip(said.values, said.source, strict=True):
            if isinstance(source, str):
                found = re.search(source, printed, re.M)
                if found is None:
                    raise ClaimError(f"{claim.name}: {source!r} is not in what the command printed")
                values.append(like(value, number(found[1], claim.name)))
            else:
                values.append(like(value, cell_of(claim, source)))
        says.append(replace(said, values=values))
    return replace(claim, says=says)


def differences(old: Claim, new: Claim) -> Iterator[str]:
    """Yield where a new run is farther from the last one than the tolerance."""
    for before, after in zip(old.says, new.says, strict=True):
        for value, found in zip(before.values, after.values, strict=True):
            if abs(number(value, "") - number(found, "")) > allowed(old.tolerance, number(value, "")):
                yield f"{old.name}: {before.text!r}: stated {value}, found {found}, tolerance {old.tolerance}"
    rows, found_rows = old.table.splitlines(), new.table.splitlines()
    is_table = old.table.startswith("|")
    if len(rows) != len(found_rows) or (is_table and rows[0] != found_rows[0]):
        yield f"{old.name}: the command prints other rows or titles than the table has"
        return
    titles = cells_of(rows[0]) if is_table else [""]
    for line, found_line in zip(rows, found_rows, strict=True):
        for title, cell, found_cell in zip(titles, cells_of(line), cells_of(found_line), strict=False):
            pair = [[float(one.replace(",", "")) for one in _NUMBER.findall(text)] for text in (cell, found_cell)]
            far = len(pair[0]) != len(pair[1]) or any(
                abs(a - b) > allowed(old.tolerance, a) for a, b in zip(*pair, strict=True)
            )
            if far and title not in old.ignore:
                where = f"{cells_of(line)[0]!r}, {title!r}" if is_table else "a line"
                yield f"{old.name}: {where}: stated {cell}, found {found_cell}, tolerance {old.tolerance}"


def run(command: str) -> str:
    """Return what a command prints on stdout."""
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    done = subprocess.run(
        [sys.executable, *shlex.split(command)[1:]],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, encoding="utf-8", check=False,
    )  # fmt: skip
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing on stderr"])[-1]
        raise ClaimError(f"{command}: ended with exit code {done.returncode}: {last}")
    return done.stdout


@contextmanager
def put_back(wanted: bool) -> Iterator[None]:
    """Put tables and pictures that git tracks back as they were; commands write some."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "*.csv", "*.png"], cwd=ROOT, capture_output=True, encoding="utf-8", check=True
    ).stdout.split("\0")
    before = {ROOT / name: (ROOT / name).read_bytes() for name in listed if (ROOT / name).is_file() and wanted}
    try:
        yield
    finally:
        for path, content in before.items():
            if not path.is_file() or path.read_bytes() != content:
                path.write_bytes(content)


def again(claims: Sequence[Claim], chosen: Sequence[Claim]) -> tuple[list[Claim], list[str], list[str]]:
    """Run the commands of the chosen claims; return all claims as found now, what differs, and what failed."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=ROOT, capture_output=True, encoding="utf-8", check=True
    ).stdout.strip()
    new: dict[str, Claim] = {one.name: one for one in claims}
    changed, failed = [], []
    for command in dict.fromkeys(one.command for one in chosen):
        begun = time.perf_counter()
        try:
            printed = run(command)
            for claim in (one for one in chosen if one.command == command):
                found = replace(measured(claim, printed), commit=commit, date=datetime.date.today())
                differ = [*differences(claim, found)]
                print(f"{claim.name}: {'differs' if differ else 'holds'}; found:")
                print(*(said.rendered() for said in found.says), found.table, sep="\n", end="")
                changed += differ
                new[claim.name] = found
        except ClaimError as error:
            failed.append(str(error))
        print(f"{time.perf_counter() - begun:6.1f} s  {command}", flush=True)
    return list(new.values()), changed, failed


def toml(claims: Sequence[Claim], given: Sequence[Said], head: str) -> str:
    """Return the text of claims.toml."""
    text = [head.rstrip()]
    for said in given:
        text.append(f"\n[[given]]\npages = {_toml(said.pages)}\ntext = {_toml(said.text)}")
    for claim in claims:
        text.append("\n[[claim]]")
        for one in fields(Claim):
            value = getattr(claim, one.name)
            if value and one.name != "says":
                text.append(f"{one.name} = {_toml(value)}")
        if claim.says:
            rows = (
                f"  {{ pages = {_toml(said.pages)}, text = {_toml(said.text)}"
                + (f", values = {_toml(said.values)}, from = {_toml(said.source)}" if said.values else "")
                + " },"
                for said in claim.says
            )
            text.append("\n".join(["says = [", *rows, "]"]))
    return "\n".join(text) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool | float | int):
        return str(value).lower()
    if isinstance(value, datetime.date):
        return value.isoformat()
    if "\n" in value:
        return f"'''\n{value}'''"
    return f"'{value}'" if "'" not in value else json.dumps(value, ensure_ascii=False)


def filled(claims: Sequence[Claim], pages: Mapping[str, str]) -> dict[str, str]:
    """Return the pages with the tables and figures of the claims."""
    new = dict(pages)
    for claim in claims:
        if claim.page in new:
            new[claim.page] = claim.marks().sub(lambda _, one=claim: one.block(), new[claim.page])
        for said in claim.says:
            for page in set(said.pages) & set(new):
                new[page] = said.put(new[page])
    return new


def main(words: Sequence[str] | None = None) -> int:
    try:
        claims, given = read()
    except ClaimError as error:
        print(f"benchmarks.claims: error: {error}", file=sys.stderr)
        return 1
    every = ", ".join(one.name for one in claims)
    parser = argparse.ArgumentParser(
        prog="benchmarks.claims",
        description=(__doc__ or "").partition("\n")[0],
        epilog=textwrap.fill(f"names: {every}", 100, break_on_hyphens=False),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--quick", action="store_true", help="measure again what takes two minutes together")
    which.add_argument("--all", action="store_true", help="measure all again, which takes hours")
    which.add_argument("--only", nargs="+", metavar="NAME", help="measure these claims again")
    parser.add_argument("--write", action="store_true", help="write claims.toml and the pages")
    chosen = parser.parse_args(words)
    try:
        names = chosen.only or [one.name for one in claims if chosen.all or (chosen.quick and one.quick)]
        if unknown := set(names) - {one.name for one in claims}:
            raise ClaimError(f"--only: {min(unknown)} is no claim; they are {every}")
        wrong: list[str] = []
        if names:
            with put_back(not chosen.write):
                claims, changed, wrong = again(claims, [one for one in claims if one.name in names])
            if chosen.write:
                print("\n".join(f"changed: {line}" for line in changed))
            else:
                wrong = changed + wrong
        if chosen.write:
            head = TABLE.read_text(encoding="utf-8").partition("\n[[")[0]
            TABLE.write_text(toml(claims, given, head), encoding="utf-8")
            for page, text in filled(claims, before := pages_of()).items():
                if text != before[page]:
                    (ROOT / page).write_text(text, encoding="utf-8")
        if chosen.write or not names:  # what was measured and not written stays beside what the pages say
            wrong += problems(claims, given, pages_of())
    except ClaimError as error:
        wrong = [str(error)]
    for line in wrong:
        print(f"benchmarks.claims: error: {line}", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
