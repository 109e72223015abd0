"""Figures of README and of the benchmark pages are those of `benchmarks/claims.toml`, each with a command."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import claims
from benchmarks.claims import ClaimError, Said, differences, filled, like, measured, pages_of, problems, read, toml

CLAIMS, GIVEN = read()
PAGES = pages_of()


def found(pages: dict[str, str]) -> list[str]:
    return list(problems(CLAIMS, GIVEN, pages))


def test_pages_have_the_figures_of_the_claims() -> None:
    assert not found(PAGES)


def test_a_figure_changed_by_hand_is_found_and_written_again() -> None:
    """In each table, in each sentence, and one that nobody stated."""
    tried = 0
    for claim in CLAIMS:
        wrong = []
        if claim.page:
            shown = claim.block().splitlines()[3:]
            line = next(one for one in reversed(shown) if re.search(r"\d", one))
            wrong.append(PAGES | {claim.page: PAGES[claim.page].replace(line, _other(line))})
        for said in claim.says:
            if said.values:
                other = replace(said, values=[*said.values[:-1], _other(said.values[-1])])
                wrong += [PAGES | {page: other.put(PAGES[page])} for page in said.pages]
        for pages in wrong:
            assert pages != PAGES, claim.name
            assert found(pages), claim.name
            assert filled(CLAIMS, pages) == PAGES, claim.name
            tried += 1
    assert tried > 70
    assert found(PAGES | {"README.md": PAGES["README.md"] + "\nIt is right in .93.\n"})


def _other(text: str) -> str:
    """Return a text whose last digit is another one."""
    last = max(one.start() for one in re.finditer(r"\d", text))
    return f"{text[:last]}{(int(text[last]) + 1) % 10}{text[last + 1 :]}"


def test_two_pages_cannot_have_two_values() -> None:
    """Figures that stand on several pages are one value of one claim, and a sentence is the table's."""
    number, claim = next((k, one) for k, one in enumerate(CLAIMS) if one.table and any(s.values for s in one.says))
    said = next(one for one in claim.says if one.values)
    other = replace(said, values=[_other(said.values[0]), *said.values[1:]])
    wrong = [*CLAIMS[:number], replace(claim, says=[other]), *CLAIMS[number + 1 :]]
    told = [line for line in problems(wrong, GIVEN, PAGES) if claim.name in line]
    assert told
    assert other.values[0] in told[0]


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ("", "command"),
        ("command = 'rm x'\ncommit = '1234567'\ndate = 2026-01-01\ntolerance = 0.1", "command"),
        ("command = 'python x.py'", "commit"),
        ("command = 'python x.py'\ncommit = '1234567'\ndate = 2026-01-01", "tolerance"),
        ("command = 'python x.py'\ncommit = '1234567'\ndate = 2026-01-01\ntolerance = 'some'", "tolerance"),
        ("command = 'python x.py'\ncommit = '1234567'\ndate = 2026-01-01\ntolerance = 0.1\nspeed = 1", "speed"),
        ("command = 'python x.py'\ncommit = '1'\ndate = 2026-01-01\ntolerance = 0.1\nsays = [{text = 'a'}]", "pages"),
        ("command = 'python x.py'\ncommit = '1'\ndate = 2026-01-01\ntolerance = 0.1\npage = 'a'", "table"),
    ],
)
def test_a_claim_that_says_too_little_is_refused(changed: str, named: str, tmp_path: Path) -> None:
    path = tmp_path / "claims.toml"
    path.write_text(f"[[claim]]\nname = 'one'\n{changed}\n", encoding="utf-8")
    with pytest.raises(ClaimError, match=rf"^one: {named}"):
        read(path)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "claims.toml"
    path.write_text(toml(CLAIMS, GIVEN, "# head"), encoding="utf-8")
    assert read(path) == (CLAIMS, GIVEN)


def test_a_new_run_replaces_table_and_figures() -> None:
    table = "| what | right | s |\n|---|---|---|\n| coal | 0.90 | 3 |\n| rock | 0.85 | 1 |\n"
    said = Said(["README.md"], "right in {}, {} of them", [".85", "1,200"], [["rock", "right"], r"of (\d+) rows"])
    old = replace(
        CLAIMS[0], name="one", table=table, tolerance=0.01, ignore=["s"], says=[said], rows="", columns=[], which=0
    )
    printed = "of 1200 rows\n" + table.replace("3 |", "5 |")
    assert not list(differences(old, measured(old, printed)))
    new = measured(old, "of 1304 rows\n" + table.replace("0.85", "0.70"))
    assert new.says[0].values == [".70", "1,304"]
    assert "0.70" in new.table
    assert [line for line in differences(old, new) if "'rock', 'right'" in line]
    assert [line for line in differences(old, new) if "found .70" in line]
    with pytest.raises(ClaimError, match="is not in what the command printed"):
        measured(old, table)
    with pytest.raises(ClaimError, match="no such table"):
        measured(old, "nothing")


@pytest.mark.parametrize(
    ("tolerance", "value", "most"), [(0.01, 5.0, 0.01), ("20 %", -5.0, 1.0), ("20 % or 1e-9", 1e-12, 1e-9)]
)
def test_a_tolerance_is_a_number_a_share_or_both(tolerance: float | str, value: float, most: float) -> None:
    assert claims.allowed(tolerance, value) == pytest.approx(most)


@pytest.mark.parametrize(
    ("stated", "value", "written"),
    [(".84", 0.8461, ".85"), ("0.84", 0.8461, "0.85"), ("1.5e-14", 1.62e-14, "1.6e-14"), ("1,007", 2034.2, "2,034"),
     ("+.03", 0.0511, "+.05"), ("-.03", -0.0511, "-.05"), ("93", 92.8, "93")],
)  # fmt: skip
def test_a_figure_is_written_as_the_one_before(stated: str, value: float, written: str) -> None:
    assert like(stated, value) == written


def test_quick_claims_have_no_times() -> None:
    quick = [one for one in CLAIMS if one.quick]
    assert {"README.md", "docs/benchmarks/accuracy.md"} <= {
        page for one in quick for pages in ([one.page], *(said.pages for said in one.says)) for page in pages
    }
    for claim in quick:
        times = [
            title
            for title in claims.cells_of(claim.table.partition("\n")[0])
            if re.search(r"\[s\]|\b[um]?s\b|time$", title)
        ]
        assert set(times) <= set(claim.ignore), claim.name


def test_a_run_says_what_holds_and_leaves_the_files_of_the_repository(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    claim = next(one for one in CLAIMS if one.name == "open-entries")
    table = tmp_path / "table.csv"
    table.write_bytes(b"as committed")
    author = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    for words in (("init", "-q"), ("add", "table.csv"), (*author, "commit", "-qm", "Table")):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.setattr(claims, "ROOT", tmp_path)

    def run(command: str) -> str:
        table.write_bytes(b"another")
        return claim.table

    monkeypatch.setattr(claims, "run", run)
    assert claims.main(["--only", claim.name]) == 0
    assert table.read_bytes() == b"as committed"
    out = capsys.readouterr().out
    assert f"{claim.name}: holds" in out and claim.table in out
    with pytest.raises(SystemExit):
        claims.main(["--help"])
    assert claim.name in capsys.readouterr().out
