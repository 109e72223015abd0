"""Writing a dataset: one file, a folder of shards, or an existing dataset as one plain file for other tools."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from cgid._lib.files import check_new, clear_half_written, require_room, whole_file
from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.signals import Batch
from cgid.store.description import DIGEST, FORMAT, MAX_SHARD_SIZE, PLAIN
from cgid.store.disk import hdf5_on_disk
from cgid.store.folder import MAX_FILES, Description, describe
from cgid.store.hdf5 import ShardBuilder, ShardMemory, ShardPlan, lay_out, say_kind
from cgid.store.reading import Dataset
from cgid.store.run import SUFFIXES, is_single_file

__all__ = ["export"]


def describe_dataset(output: Path, plan: ShardPlan, n_signals: int, shard_signals: int) -> Description:
    """Return the description of a dataset: one file, or a folder with `shard_signals` in each shard."""
    single = is_single_file(output)
    shard_signals = n_signals if single else min(shard_signals, n_signals)
    size, n_shards = plan.size(shard_signals), -(-n_signals // shard_signals)
    if size > MAX_SHARD_SIZE:
        hint = "give a name that does not end in .h5, for a folder" if single else "ask for smaller"
        raise InvalidValue(
            f"a shard must be at most {MAX_SHARD_SIZE >> 30} GiB, {shard_signals} signals make "
            f"{size / 2**30:.3g} GiB: {hint}"
        )
    if n_shards > MAX_FILES:
        raise InvalidValue(
            f"shard_signals must be at least {-(-n_signals // MAX_FILES)} for {n_signals} signals, got "
            f"{shard_signals}: a folder has at most {MAX_FILES} shards"
        )
    return describe(
        FORMAT,
        plan.attributes,
        n_signals=n_signals,
        shard_signals=shard_signals,
        n_samples=plan.n_samples,
        dtype=plan.dtype,
        compression=PLAIN,
    )


def shard_content(
    plan: ShardPlan, first: int, n_signals: int, batches: Iterable[Batch], memory: ShardMemory
) -> memoryview:
    """Return the content of the file of a shard, valid until another is made in the same memory."""
    builder = ShardBuilder(plan, first, n_signals, memory)
    for batch in batches:
        builder.add(batch)
    return builder.image()


# ---- export ----------------------------------------------------------------------------------------------------------


def export(
    data: Dataset | str | Path,
    output: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Write a dataset as one plain HDF5 file and return its path.

    Memory does not grow with the number of signals.

    Parameters
    ----------
    data : Dataset, str or Path
    output : str or Path
        A name that ends in .h5 or .hdf5.
    overwrite : bool
        Whether to replace an existing file, which remains until the new one is complete.
    progress : callable, optional
        Called with the number of signals written since the last call.

    Returns
    -------
    Path
        The output.

    Raises
    ------
    NoInput, BadData
        The dataset does not exist, or is damaged.
    CannotCreate
        The output exists, cannot be created or does not fit on the disk.
    WriteFailed
        The disk is full.
    """
    dataset = data if isinstance(data, Dataset) else Dataset(data)
    path = check_new(Path(output), "an exported dataset", SUFFIXES, overwrite=overwrite)
    if dataset.path.resolve() in (path.resolve(), path.resolve().parent):
        raise CannotCreate(f"{path}: must not be part of the dataset that is exported; choose another name")
    clear_half_written(path)
    plan = ShardPlan(
        n_samples=dataset.header.n_samples,
        dtype=dataset.header.dtype,
        label_width=dataset.header.label_width,
        parameter_units=dataset.header.parameter_units,
        attributes={
            name: value for name, value in dataset.header.attributes.items() if name not in ("first_signal", DIGEST)
        },
    )
    first = dataset.header.attributes.get("first_signal", 0)
    require_room(path, path.parent, plan.size(len(dataset)), "signals", "make room")
    with whole_file(path, overwrite=overwrite) as temporary:
        write_dataset(temporary, plan, first, len(dataset), dataset.batches(), progress)
    return path


def write_dataset(
    path: Path,
    plan: ShardPlan,
    first: int,
    n_signals: int,
    batches: Iterable[Batch],
    progress: Callable[[int], object] | None = None,
) -> None:
    """Write a dataset into an empty file; used within `cgid._lib.files.whole_file`."""
    done = 0
    with hdf5_on_disk(path) as output:
        for batch in batches:
            with output.step() as file:
                if not done:
                    say_kind(lay_out(file, plan, first, n_signals), batch)
                rows = slice(done, done + len(batch))
                file["signals"][rows] = batch.signals
                file["labels"][rows] = np.char.encode(batch.labels, "utf-8")
                file["specimen"][rows] = batch.specimen
                for name, values in batch.parameters.items():
                    file[f"parameters/{name}"][rows] = values
            done += len(batch)
            if progress is not None:
                progress(len(batch))
        if done != n_signals:
            raise BadData(f"a dataset of {n_signals} signals was given {done}")
