"""From a scene to a table on disk: features, closed forms or parameters, and no signals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cgid.errors import InvalidValue
from cgid.files import require_room
from cgid.scene.generation import MOST_SIGNALS
from cgid.scene.plan import Plan
from cgid.scene.provenance import attributes_of
from cgid.scene.synthesis import columns_of
from cgid.store import Rows, TableHeader, check_table_output, table_writer

#: Bytes of a number in the file, at most; in CSV with its comma.
_BYTES, _BYTES_OF_TEXT = 8, 25


@dataclass(frozen=True)
class Tabulated:
    """What was written.

    Attributes
    ----------
    path : Path
    n_signals : int
    n_unmeasured : int
        Rows in which a feature could not be measured and is nan.
    """

    path: Path
    n_signals: int
    n_unmeasured: int


def tabulate(
    asked: Plan,
    output: str | Path,
    n_signals: int,
    seed: int = 0,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Tabulated:
    """Write what a plan asks for as a table, with labels and specimens, and return what was written.

    Memory stays the same however many signals there are: they come in batches of a thousand.

    Parameters
    ----------
    asked : Plan
        For features, closed forms or parameters; see `cgid.scene.plan.plan`.
    output : str or Path
        Ending in .h5, .hdf5, .parquet (with the extra `parquet`) or .csv.
    n_signals, seed : int
    overwrite : bool
        Whether an old file may be replaced.
    progress : callable, optional
        Called with a number of signals whenever so many more are done.

    Raises
    ------
    CannotCreate
        The output exists, or cannot be made, or has no room.
    WriteFailed
        The disk is full; nothing is left behind.
    MissingExtra
        Parquet is asked for, and its library is not installed.
    InvalidValue
        A number breaks its rule, or the plan is one for signals.
    """
    if not 1 <= n_signals <= MOST_SIGNALS:
        raise InvalidValue(f"n_signals must lie between 1 and {MOST_SIGNALS}, got {n_signals}")
    path = check_table_output(output, overwrite)
    next(iter(columns_of(asked, 1, seed)))  # what is wrong with the plan or the seed shows before anything is written
    size = n_signals * (2 + len(asked.column_units)) * (_BYTES_OF_TEXT if path.suffix == ".csv" else _BYTES)
    require_room(path, path.parent, size, "rows", "make room, or fewer signals")
    header = TableHeader(
        kind=asked.kind,
        units=asked.column_units,
        attributes={"n_signals": n_signals} | attributes_of(asked.scene, seed),
    )
    unmeasured = 0
    width = max(len(label.encode()) for label in asked.scene.labels)
    with table_writer(path, header, width, overwrite=overwrite) as writer:
        for columns in columns_of(asked, n_signals, seed):
            writer.add(Rows(labels=columns.labels, specimen=columns.specimen, columns=columns.values))
            unmeasured += columns.n_unmeasured
            if progress is not None:
                progress(len(columns))
    return Tabulated(path, n_signals, unmeasured)
