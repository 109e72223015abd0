"""`cgid reproduce`: the paper's figures and tables, and a report on what agrees."""

from __future__ import annotations

import click

from cgid.cli.options import PATH, progress_bar
from cgid.cli.output import say


@click.command(short_help="Compute the paper's figures and tables, and a report.")
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the pictures, the data and report.md.")
@click.option("--overwrite", is_flag=True, help="Replace such files in a folder that is not empty; others stay.")
@click.option(
    "--finite-element", is_flag=True, help="Simulate all impacts anew (minutes), and write finite_element.npz, too."
)
@click.option("--jobs", type=int, help="Worker processes of --finite-element.  [default: all cores]")
def reproduce(output: str, overwrite: bool, finite_element: bool, jobs: int | None) -> None:
    """Compute the figures and tables of Yang, Zeng & Wan (2018), and judge what the paper says.

    Each is a picture (PNG, extra plot) and its data (CSV); report.md shows them all and tells what agrees with the
    paper and what does not. What the paper simulated is shown from finite-element results that come with cgid, or
    with --finite-element from new ones. The names of the files written go to the standard output.
    """
    from cgid.reproduction import n_steps
    from cgid.reproduction import reproduce as reproduce_paper

    with progress_bar(n_steps(finite_element=finite_element), "pieces") as progress:
        written = reproduce_paper(
            output, overwrite=overwrite, finite_element=finite_element, jobs=jobs, progress=progress
        )
    for path in written:
        say(str(path))
