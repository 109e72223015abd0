"""Options of the plant outputs of `cgid monitor`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from cgid.cli.options import OUTPUT, bundle

if TYPE_CHECKING:
    pass


#: Plant outputs; the command receives the given ones as `outputs`, arguments of `PlantOutputs`.
plant_options = bundle(
    "outputs",
    lambda **given: {name: value for name, value in given.items() if value is not None},
    {
        "mqtt": click.option(
            "--mqtt", metavar="URL", help="Publish each line below mqtt://HOST[:PORT]/TOPIC (mqtts: TLS)."
        ),
        "modbus": click.option(
            "--modbus", metavar="HOST:PORT", help="Serve state, gangue fraction and counts as Modbus TCP registers."
        ),
        "prometheus": click.option("--prometheus", metavar="[HOST]:PORT", help="Serve metrics at /metrics."),
        "live": click.option(
            "--live",
            type=OUTPUT,
            metavar="[HOST]:PORT|FILE",
            help="Show waveform, gangue fraction and decision on a page, or in FILE.html.",
        ),
        "on_shut": click.option(
            "--on-shut", metavar="COMMAND", help="Run this command at each SHUT; it gets the line on stdin."
        ),
        "on_open": click.option("--on-open", metavar="COMMAND", help="Run this command at each OPEN."),
        "on_blind": click.option(
            "--on-blind",
            metavar="COMMAND",
            help="Run this command when a support is blind, or the stream stops without its end.",
        ),
    },
)
