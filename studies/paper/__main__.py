"""Write every figure and table as PNG and CSV, and a page that shows them, to a folder."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cgid._lib.files import looking_at, write_together
from cgid.errors import CannotCreate
from cgid.physics import HertzRangeWarning
from cgid.plots.figure import require_matplotlib
from studies import run
from studies.paper.drawing import csv_title, draw, draw_table
from studies.paper.figures import FIGURES
from studies.paper.simulated import SIMULATED_FIGURES
from studies.paper.study import N_CASES, STUDY_FILE, Study, packed, run_study, shipped_study, unpacked
from studies.paper.tables import TABLES

PAGE = "index.md"


def write(
    folder: Path, *, overwrite: bool = False, finite_element: bool = False, jobs: int | None = None
) -> list[Path]:
    """Write the figures and tables, and return the files, the page last.

    The finite-element study is the shipped one, or computed anew (minutes) and written, too. Nothing is written before
    everything is computed.
    """
    require_matplotlib()
    with looking_at(folder):
        if folder.is_dir() and any(folder.iterdir()) and not overwrite:
            raise CannotCreate(f"{folder}: is a folder with files in it; choose another name or say --overwrite")
    contents, study = {}, shipped_study()
    if finite_element:
        with tqdm(total=N_CASES, unit=" impacts", file=sys.stderr) as progress:
            contents[STUDY_FILE] = packed(run_study(jobs, progress.update))
        # The file rounds the time series. Reading it back gives the same output as the shipped copy.
        study = unpacked(contents[STUDY_FILE])
    contents |= _contents(study)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise CannotCreate(f"{folder}: the folder cannot be made ({error.strerror}); choose another name") from None
    files = {folder / name: content for name, content in contents.items()}
    write_together(files, overwrite=overwrite)
    return list(files)


def _contents(study: Study) -> dict[str, bytes]:
    contents: dict[str, bytes] = {}
    page = ["# The figures and tables of Yang, Zeng & Wan (2018), recomputed", ""]
    for make_table in TABLES.values():
        table = make_table(study)
        contents[f"{table.name}.csv"] = _csv(table.data)
        contents[f"{table.name}.png"] = draw_table(table.heads, table.cells)
        page += _entry(table.name, table.title, table.note)
    for name in sorted([*FIGURES, *SIMULATED_FIGURES]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HertzRangeWarning)
            figure = FIGURES[name]() if name in FIGURES else SIMULATED_FIGURES[name](study)
        contents[f"{figure.name}.csv"] = _csv(figure.data)
        contents[f"{figure.name}.png"] = draw(figure)
        page += _entry(name, figure.title, figure.note)
    contents[PAGE] = "\n".join(page).encode()
    return contents


def _csv(data: Any) -> bytes:
    titled = data.rename(columns=csv_title)
    return str(titled.to_csv(index=False, float_format="%.12g", lineterminator="\n")).encode()


def _entry(name: str, title: str, note: str) -> list[str]:
    return [f"## {name}: {title}", "", f"{note} ([data]({name}.csv))".strip(), "", f"![{title}]({name}.png)", ""]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m studies.paper", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder; its parent must exist")
    parser.add_argument("--overwrite", action="store_true", help="replace files of these names in the folder")
    parser.add_argument("--finite-element", action="store_true", help=f"solve all impacts anew, and write {STUDY_FILE}")
    parser.add_argument("--jobs", type=int, help="processes for --finite-element, by default one a core")
    given = parser.parse_args(arguments)

    def study() -> None:
        written = write(given.output, overwrite=given.overwrite, finite_element=given.finite_element, jobs=given.jobs)
        print(*written, sep="\n")

    return run(study)


if __name__ == "__main__":
    sys.exit(main())
