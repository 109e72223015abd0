"""A dataset of any size as one plain file: what other tools open, and what cgid reads as a dataset, too.

It is laid out as a shard is (`cgid.store.shard`), without compression, but goes to the disk as it comes: memory does
not grow with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from cgid.errors import BadData, CannotCreate
from cgid.files import check_new, clear_half_written, require_room, whole_file
from cgid.signals import Batch
from cgid.store.dataset import Dataset
from cgid.store.disk import hdf5_on_disk
from cgid.store.shard import ShardPlan, lay_out, say_kind
from cgid.store.writing import SUFFIXES


def export(
    data: Dataset | str | Path,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset as one HDF5 file and return its path; memory stays the same however many signals there are.

    Parameters
    ----------
    data : Dataset, str or Path
        A dataset, or where it lies: a folder, or a file of any compression.
    output : str or Path
        Ending in .h5 or .hdf5.
    overwrite : bool
        Whether an old file may be replaced.
    progress : callable, optional
        Called with a number of signals whenever so many more are done.

    Raises
    ------
    NoInput, BadData
        There is no dataset, or it is damaged.
    CannotCreate
        The output exists, or cannot be made, or has no room.
    WriteFailed
        The disk is full; nothing is left behind, an old file is untouched.
    """
    dataset = data if isinstance(data, Dataset) else Dataset(data)
    path = check_new(Path(output), "an exported dataset", SUFFIXES, overwrite=overwrite)
    if dataset.path.resolve() in (path.resolve(), path.resolve().parent):
        raise CannotCreate(f"{path}: must not be part of what it is made from; choose another name")
    clear_half_written(path)
    plan = ShardPlan(
        n_samples=dataset.header.n_samples,
        dtype=dataset.header.dtype,
        label_width=dataset.header.label_width,
        parameter_units=dataset.header.parameter_units,
        attributes={name: value for name, value in dataset.header.attributes.items() if name != "first_signal"},
    )
    first = dataset.header.attributes.get("first_signal", 0)
    require_room(path, path.parent, plan.size(len(dataset)), "signals", "make room")
    with whole_file(path, overwrite=overwrite) as temporary:
        write_dataset(temporary, plan, first, len(dataset), dataset.batches(check_sums=True), progress)
    return path


def write_dataset(
    path: Path,
    plan: ShardPlan,
    first: int,
    n_signals: int,
    batches: Iterable[Batch],
    progress: Callable[[int], object] | None = None,
) -> None:
    """Write the signals of a dataset to an empty file, batch by batch; within `cgid.files.whole_file`.

    Parameters
    ----------
    path : Path
        It exists and is empty.
    plan : ShardPlan
        Its compression is passed over.
    first, n_signals : int
        Number of the first signal, and how many there are.
    batches : iterable of Batch
        All of them, in order.
    progress : callable, optional
        As of `export`.

    Raises
    ------
    OSError
        The disk is full or broken.
    BadData
        The batches hold less than `n_signals`.
    """
    done, plain = 0, replace(plan, compression="none")
    with hdf5_on_disk(path) as output:
        for batch in batches:
            with output.step() as file:
                if not done:
                    say_kind(lay_out(file, plain, first, n_signals), batch)
                _put(file, batch, done)
            done += len(batch)
            if progress is not None:
                progress(len(batch))
        if done != n_signals:
            raise BadData(f"a dataset of {n_signals} signals was given {done}")


def _put(file: h5py.File, batch: Batch, first: int) -> None:
    """Write the signals of a batch and what is known of them, from row `first` on."""
    rows = slice(first, first + len(batch))
    file["signals"][rows] = batch.signals
    file["labels"][rows] = np.char.encode(batch.labels, "utf-8")
    file["specimen"][rows] = batch.specimen
    for name, values in batch.parameters.items():
        file[f"parameters/{name}"][rows] = values
