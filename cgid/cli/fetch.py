"""`cgid fetch`: public recordings of real impacts, by name."""

from __future__ import annotations

import click

from cgid.cli.help import Command
from cgid.cli.options import PATH
from cgid.cli.output import progress_bar, say


@click.command(cls=Command, short_help="Download public recordings of real impacts.", example="cgid fetch")
@click.argument("name", required=False)
@click.option("-o", "--output", type=PATH, default=".", show_default=True, help="Make the folder NAME in this one.")
@click.option("--mirror", metavar="URL", help="Download from this copy of the data instead.")
def fetch(name: str | None, output: str, mirror: str | None) -> None:
    """Download the public dataset NAME, or list all of them without a NAME.

    Each file is checked by its size and SHA-256. Existing files are kept. No other command downloads anything.
    """
    from cgid.recordings import public

    if name is None:
        for one in public.PUBLIC.values():
            say(f"{one.name}: {one.content}")
            size = f"{len(one.files)} files, {one.size / 1e6:.1f} MB"
            say(f"    {size}, {one.licence}, github.com/{one.repository}")
            say(f"    for {one.good_for}")
        return
    total = public.PUBLIC[name].size if name in public.PUBLIC else None
    with progress_bar(total, "B", "fetching") as move:
        folder = public.fetch(name, output, mirror=mirror, progress=move)
    say(f"wrote {folder}", err=True)
