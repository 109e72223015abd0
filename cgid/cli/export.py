"""`cgid export`: write a dataset as one plain file for other tools."""

from __future__ import annotations

import click

from cgid.cli.help import Command
from cgid.cli.options import PATH
from cgid.cli.output import progress_bar, say


@click.command(
    cls=Command,
    short_help="Write a dataset as one plain HDF5 file.",
    example="cgid generate reference -n 1000 -o data\ncgid export data -o data.h5",
)
@click.argument("data", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Write this file, ending in .h5 or .hdf5.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def export(data: str, output: str, overwrite: bool) -> None:
    """Write the dataset DATA, a folder or a file, as one HDF5 file that h5dump, h5py or MATLAB open as it is.

    It holds signals, labels, specimen, parameters and all attributes, uncompressed and with checksums. cgid reads it as
    a dataset.
    """
    from cgid.store import Dataset
    from cgid.store.dataset import export as export_dataset

    dataset = Dataset(data)
    with progress_bar(len(dataset), "signals") as progress:
        path = export_dataset(dataset, output, overwrite=overwrite, progress=progress)
    say(f"{path}: {path.stat().st_size / 1e6:.4g} MB", err=True)
