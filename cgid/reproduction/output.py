"""Write every figure and table as PNG and CSV, and the report, to a folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cgid.errors import CannotCreate, InvalidValue
from cgid.files import looking_at, write_together
from cgid.physics import HertzRangeWarning
from cgid.plots import require_matplotlib
from cgid.reproduction.drawing import csv_title, draw, draw_table
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.finite_element_figures import SIMULATED_FIGURES
from cgid.reproduction.report import write_report
from cgid.reproduction.study import N_CASES, STUDY_FILE, Study, packed, run_study, shipped_study, unpacked
from cgid.reproduction.tables import TABLES

REPORT = "report.md"
_N_WRITTEN = len(TABLES) + len(FIGURES) + len(SIMULATED_FIGURES) + 1


def n_steps(*, finite_element: bool = False) -> int:
    """Return the number of steps that `reproduce` reports to `progress`."""
    return _N_WRITTEN + (N_CASES if finite_element else 0)


def reproduce(
    folder: str | Path,
    *,
    overwrite: bool = False,
    finite_element: bool = False,
    jobs: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> list[Path]:
    """Write the paper's figures and tables, and a report on them.

    Simulated results come from the shipped finite-element study unless it is computed anew.

    Parameters
    ----------
    folder : str or Path
        Created if missing; its parent must exist.
    overwrite : bool, optional
        Replace files with these names in a non-empty folder; other files stay.
    finite_element : bool, optional
        Recompute the finite-element study, which takes minutes, and write its data file too.
    jobs : int, optional
        Number of processes for the study; by default one per core.
    progress : callable, optional
        Called with 1 after each of `n_steps` steps.

    Returns
    -------
    list of Path
        The written files, the report last.

    Raises
    ------
    CannotCreate
        The folder is not empty and `overwrite` is not set, or it cannot be made.
    InvalidValue
        `jobs` is below 1, or given without `finite_element`.
    MissingExtra
        matplotlib is not installed. Nothing is written.
    WriteFailed
        The disk is full or broken.
    """
    if jobs is not None and not finite_element:
        raise InvalidValue(
            f"jobs are for the finite-element study, got {jobs} without it; ask for it or leave jobs out"
        )
    require_matplotlib()
    path = _checked(Path(folder), overwrite)
    progress = progress or (lambda _: None)
    data = packed(run_study(jobs, progress)) if finite_element else None
    # The file rounds the time series. Reading it back gives the same output as the shipped copy.
    study = shipped_study() if data is None else unpacked(data)
    with warnings.catch_warnings():
        # The report lists the figures beyond Hertz's range.
        warnings.simplefilter("ignore", HertzRangeWarning)
        contents = _contents(study, progress)
    if data is not None:
        contents = {STUDY_FILE: data, **contents}
    with _folder(path):
        files = {path / name: content for name, content in contents.items()}
        write_together(files, overwrite=overwrite)
    return list(files)


@contextmanager
def _folder(path: Path) -> Iterator[None]:
    """Create the folder if it is missing; remove a new folder if writing to it fails."""
    is_new = not path.is_dir()
    try:
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise CannotCreate(f"{path}: the folder cannot be made ({error.strerror}); choose another name") from None
        yield
    except BaseException:
        if is_new:
            with suppress(OSError):
                path.rmdir()
        raise


def _checked(path: Path, overwrite: bool) -> Path:
    with looking_at(path):
        if not path.parent.is_dir():
            raise CannotCreate(f"{path}: the folder {path.parent} must exist; make it first")
        if path.exists() and not path.is_dir():
            raise CannotCreate(f"{path}: is a file; choose another name for the folder")
        if path.is_dir() and any(path.iterdir()) and not overwrite:
            raise CannotCreate(f"{path}: is a folder with files in it; choose another name or say --overwrite")
    return path


def _contents(study: Study, progress: Callable[[int], object]) -> dict[str, bytes]:
    """Return the content of every file by name. Everything is computed before anything is written."""
    contents, tables, figures = {}, [], []
    for make_table in TABLES.values():
        table = make_table(study)
        tables.append(table)
        contents[f"{table.name}.csv"] = _csv(table.data)
        contents[f"{table.name}.png"] = draw_table(table.heads, table.cells)
        progress(1)
    for name in sorted([*FIGURES, *SIMULATED_FIGURES]):
        figure = FIGURES[name]() if name in FIGURES else SIMULATED_FIGURES[name](study)
        figures.append(figure)
        contents[f"{figure.name}.csv"] = _csv(figure.data)
        contents[f"{figure.name}.png"] = draw(figure)
        progress(1)
    contents[REPORT] = write_report(figures, tables, study).encode()
    progress(1)
    return contents


def _csv(data: Any) -> bytes:
    titled = data.rename(columns=csv_title)
    return str(titled.to_csv(index=False, float_format="%.12g", lineterminator="\n")).encode()
