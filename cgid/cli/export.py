"""`cgid export` and `export-model`: write a dataset or a model as one plain file for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from cgid.cli.help import Command
from cgid.cli.options import MODEL, OUTPUT, PATH, overwrite_option
from cgid.cli.output import progress_bar, say


@click.command(
    cls=Command,
    short_help="Write a dataset as one plain HDF5 file.",
    example="cgid generate reference -n 1000 -o data\ncgid export data -o data.h5",
)
@click.argument("data", type=PATH)
@click.option("-o", "--output", type=OUTPUT, required=True, help="Write this file, ending in .h5 or .hdf5.")
@overwrite_option
def export(data: str, output: str, overwrite: bool) -> None:
    """Write the dataset DATA, a folder or a file, as one HDF5 file that h5dump, h5py or MATLAB open as it is.

    It contains signals, labels, specimen, parameters and all attributes, uncompressed and with checksums. cgid reads it
    as a dataset.
    """
    from cgid.store import Dataset
    from cgid.store.dataset import export as export_dataset

    dataset = Dataset(data)
    with progress_bar(len(dataset), "signals", "exporting") as progress:
        path = export_dataset(dataset, output, overwrite=overwrite, progress=progress)
    say(f"{path}: {path.stat().st_size / 1e6:.4g} MB", err=True)


@click.command(
    cls=Command,
    short_help="Write a model as C or ONNX for machines without Python.",
    example="cgid export-model default --to c -o model.c",
)
@click.argument("model", type=MODEL)
@click.option(
    "--to", type=click.Choice(["c", "onnx"]), required=True, help="Choose the format: one C99 file, or an ONNX graph."
)
@click.option("-o", "--output", type=OUTPUT, required=True, help="Write this file, ending in .c or .onnx.")
@overwrite_option
def export_model(model: str, to: str, output: str, overwrite: bool) -> None:
    """Write MODEL, a file or default or default-acceleration, for machines without Python.

    The result maps features to probabilities, novelty and label, as cgid predict does; it does not measure them. The
    head of the C file lists the required values, their order and units, and how to compile it. ONNX needs the extra
    onnx.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.export import c_source
    from cgid.export.onnx import onnx_bytes
    from cgid.identification.prediction.prediction import read_model

    path = check_new(Path(output), f"a model in {to.upper()}", (f".{to}",), overwrite=overwrite)
    loaded = read_model(model)
    content = c_source(loaded).encode("ascii") if to == "c" else onnx_bytes(loaded)
    write_whole(path, content, overwrite=overwrite)
    say(f"{path}: {len(content) / 1e3:.4g} kB", err=True)
