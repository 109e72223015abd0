"""`cgid models`: the models that come with cgid."""

from __future__ import annotations

import click

from cgid import shipped
from cgid.cli.help import Command
from cgid.cli.options import json_option
from cgid.cli.output import print_json
from cgid.cli.table import TableOutput
from cgid.units import Column


@click.command(cls=Command, short_help="List the models that come with cgid.", example="cgid models")
@json_option
def models(as_json: bool) -> None:
    """List the models that come with cgid: name, version, date, quantity and unit, size, card and SHA-256.

    A version of a model never changes. Commands take it as NAME@VERSION, and refuse it if this cgid has another one, so
    that an update does not change answers unnoticed.
    """
    from cgid.identification.model.model import StoredModel

    rows = []
    for row in shipped.model_versions():
        path = shipped.path_of("models", f"{row['name']}.npz")
        model = StoredModel.load(path)
        rows.append(
            {
                "name": row["name"],
                "version": int(row["version"]),
                "date": row["date"],
                "quantity": model.quantity,
                "unit": model.unit,
                "size_bytes": path.stat().st_size,
                "card": str(path.with_suffix(".md")),
                "sha256": row["sha256"],
            }
        )
    if as_json:
        for one in rows:
            print_json(one)
        return
    with TableOutput() as table:
        table.begin([Column(name) for name in rows[0]])
        for one in rows:
            table.add(one)
