"""`cgid reproduce`: the paper's theoretical figures and tables, and a report on what agrees."""

from __future__ import annotations

import click

from cgid.cli.options import progress_bar
from cgid.cli.saying import say


@click.command(short_help="Compute the paper's figures and tables, and a report.")
@click.option("-o", "--output", required=True, help="Folder for the pictures, the data and report.md.")
@click.option("--overwrite", is_flag=True, help="Replace such files in a folder that is not empty; others stay.")
def reproduce(output: str, overwrite: bool) -> None:
    """Compute the theoretical figures and tables of Yang, Zeng & Wan (2018), and judge what the paper says.

    Each is a picture (PNG, extra plot) and its data (CSV); report.md shows them all and tells what agrees with the
    paper and what does not. The names of the files written go to the standard output.
    """
    from cgid.reproduction import N_STEPS
    from cgid.reproduction import reproduce as reproduce_paper

    with progress_bar(N_STEPS, "pieces") as progress:
        written = reproduce_paper(output, overwrite=overwrite, progress=progress)
    for path in written:
        say(str(path))
