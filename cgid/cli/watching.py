"""Options of the decision and of the plant outputs of `cgid monitor`."""

from __future__ import annotations

import click

from cgid.cli.options import OUTPUT, PATH, SECONDS, bundle
from cgid.cli.site import the_site

coal_option = click.option(
    "--coal-until", type=SECONDS, metavar="TIME", help="Only coal falls so long at the beginning, such as 30s."
)
labelled_option = click.option(
    "--labelled", type=PATH, metavar="TABLE", help="Coal that this manifest or table of events labels, instead."
)
#: Plant outputs; the command receives the given ones as `outputs`, arguments of `PlantOutputs`.
_PLANT = {
    "mqtt": click.option("--mqtt", metavar="URL", help="Publish each line below mqtt://HOST[:PORT]/TOPIC."),
    "modbus": click.option("--modbus", metavar="HOST:PORT", help="Serve state and counts as Modbus TCP registers."),
    "prometheus": click.option("--prometheus", metavar="[HOST]:PORT", help="Serve metrics at /metrics."),
    "live": click.option("--live", type=OUTPUT, metavar="[HOST]:PORT|FILE", help="Show a page, or write FILE.html."),
    "on_shut": click.option("--on-shut", metavar="COMMAND", help="Run this at each SHUT, with the line on stdin."),
    "on_open": click.option("--on-open", metavar="COMMAND", help="Run this at each OPEN."),
    "on_blind": click.option("--on-blind", metavar="COMMAND", help="Run this when a support is blind, or all stops."),
}
plant_options = bundle(
    "outputs",
    lambda **given: {
        name: value
        for name, line in given.items()
        if (value := the_site().get(name) if line is None else line) is not None
    },
    _PLANT,
)
