"""Writes every figure and table, as PNG and CSV, and the report into a folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from cgid.errors import CannotCreate, InvalidValue
from cgid.files import looking_at, write_together
from cgid.physics import HertzRangeWarning
from cgid.plots import require_matplotlib
from cgid.reproduction.drawing import PaperFigure, csv_title, draw, draw_table
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.finite_element_figures import SIMULATED_FIGURES
from cgid.reproduction.report import write_report
from cgid.reproduction.study import N_CASES, STUDY_FILE, Study, packed, run_study, shipped_study, unpacked
from cgid.reproduction.tables import TABLES, PaperTable, table_3

REPORT = "report.md"
_N_WRITTEN = len(TABLES) + 1 + len(FIGURES) + len(SIMULATED_FIGURES) + 1


def n_steps(*, finite_element: bool = False) -> int:
    """Return how many steps `reproduce` reports to `progress`."""
    return _N_WRITTEN + (N_CASES if finite_element else 0)


def reproduce(
    folder: str | Path,
    *,
    overwrite: bool = False,
    finite_element: bool = False,
    jobs: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> list[Path]:
    """Write the paper's figures and tables and a report on them.

    What the paper simulated comes from finite elements: the results that are shipped, or computed anew.

    Parameters
    ----------
    folder : str or Path
        Where to write; made if it is not there, but not the folder above it.
    overwrite : bool, optional
        Replace files of these names in a folder that is not empty; other files stay.
    finite_element : bool, optional
        Compute the finite-element study anew, which takes minutes, and write its data file, too.
    jobs : int, optional
        Processes that do so; as many as there are cores if not given.
    progress : callable, optional
        Called with 1 after each of `n_steps` steps.

    Returns
    -------
    list of Path
        The files written, the report last.

    Raises
    ------
    CannotCreate
        The folder is not empty and `overwrite` is not given, or it cannot be made.
    InvalidValue
        `jobs` is below 1, or given for nothing.
    MissingExtra
        matplotlib is not installed. Nothing is written then.
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
    # Read back from the file, which is rounded: its copy in the package repeats every figure byte for byte.
    study = shipped_study() if data is None else unpacked(data)
    with warnings.catch_warnings():
        # The report says which figures leave Hertz's range.
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
    """Make a folder if it is not there; one that was made goes again if what it is for fails."""
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
    """Return every file by name; all is made before anything is written."""
    contents, tables, figures = {}, [], []
    made_tables: dict[str, Callable[[], PaperTable]] = {**TABLES, "table_3": lambda: table_3(study)}
    for _, make_table in sorted(made_tables.items()):
        table = make_table()
        tables.append(table)
        contents[f"{table.name}.csv"] = _csv(table.data)
        contents[f"{table.name}.png"] = draw_table(table.heads, table.cells)
        progress(1)
    simulated: dict[str, Callable[[], PaperFigure]] = {
        name: partial(make, study) for name, make in SIMULATED_FIGURES.items()
    }
    for _, make_figure in sorted({**FIGURES, **simulated}.items()):
        figure = make_figure()
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
