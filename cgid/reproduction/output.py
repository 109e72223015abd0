"""Writes every figure and table, as PNG and CSV, and the report into a folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cgid.errors import CannotCreate
from cgid.files import looking_at
from cgid.impact import HertzRangeWarning
from cgid.plots import require_matplotlib
from cgid.reproduction.drawing import draw, draw_table
from cgid.reproduction.figures import FIGURES
from cgid.reproduction.quantities import csv_title
from cgid.reproduction.report import write_report
from cgid.reproduction.tables import TABLES
from cgid.together import write_together

REPORT = "report.md"
#: Steps that `reproduce` reports to `progress`.
N_STEPS = len(TABLES) + len(FIGURES) + 1


def reproduce(
    folder: str | Path, *, overwrite: bool = False, progress: Callable[[int], object] | None = None
) -> list[Path]:
    """Write the paper's theoretical figures and tables and a report on them.

    Parameters
    ----------
    folder : str or Path
        Where to write; made if it is not there, but not the folder above it.
    overwrite : bool, optional
        Replace files of these names in a folder that is not empty; other files stay.
    progress : callable, optional
        Called with 1 after each of `N_STEPS` steps.

    Returns
    -------
    list of Path
        The files written, the report last.

    Raises
    ------
    CannotCreate
        The folder is not empty and `overwrite` is not given, or it cannot be made.
    MissingExtra
        matplotlib is not installed. Nothing is written then.
    WriteFailed
        The disk is full or broken.
    """
    require_matplotlib()
    path = _checked(Path(folder), overwrite)
    with warnings.catch_warnings():
        # The report says which figures leave Hertz's range.
        warnings.simplefilter("ignore", HertzRangeWarning)
        contents = _contents(progress or (lambda _: None))
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


def _contents(progress: Callable[[int], object]) -> dict[str, bytes]:
    """Return every file by name; all is made before anything is written."""
    contents, tables, figures = {}, [], []
    for make_table in TABLES.values():
        table = make_table()
        tables.append(table)
        contents[f"{table.name}.csv"] = _csv(table.data)
        contents[f"{table.name}.png"] = draw_table(table.heads, table.cells)
        progress(1)
    for make_figure in FIGURES.values():
        figure = make_figure()
        figures.append(figure)
        contents[f"{figure.name}.csv"] = _csv(figure.data)
        contents[f"{figure.name}.png"] = draw(figure.data, figure.panels, figure.columns)
        progress(1)
    contents[REPORT] = write_report(figures, tables).encode()
    progress(1)
    return contents


def _csv(data: Any) -> bytes:
    titled = data.rename(columns=csv_title)
    return str(titled.to_csv(index=False, float_format="%.12g", lineterminator="\n")).encode()
