"""`cgid invert`: the force of impacts at the place of a table of modes, from the motion of the beam."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import OUTPUT, PATH, ReadingOptions, json_option, overwrite_option, reading_options
from cgid.cli.output import print_json, say, warn
from cgid.cli.tap import read_with_hammer

if TYPE_CHECKING:
    from cgid._lib.validation import Floats
    from cgid.identification.inversion.recovered import RecoveredForce

#: A measured force belongs to an impact whose onset is this near [s].
_NEAR = 5e-3


@click.command(
    cls=Command,
    short_help="Recover the force of impacts from the motion of a beam.",
    example="cgid tap taps.csv --channel 1 --hammer 2 --band 60 2000 -o modes.csv\n"
    "cgid invert taps.csv --channel 1 --hammer 2 --modes modes.csv -o forces.csv",
)
@click.argument("recording", type=PATH)
@click.option(
    "--modes",
    "tables",
    type=PATH,
    multiple=True,
    required=True,
    help="Use this table of cgid tap --hammer; repeat the option for each channel.",
)
@click.option("-o", "--output", type=OUTPUT, help="Write force and standard deviation over time to this table (.csv).")
@click.option("--hammer", metavar="CHANNEL", help="Compare with the force measured in this channel.")
@click.option("--band", nargs=2, type=float, metavar="LOW HIGH", help="Use LOW to HIGH [Hz], not all modes' range.")
@click.option(
    "--contact", type=float, default=6.0, show_default=True, help="Look for contacts of at most this time [ms]."
)
@overwrite_option
@json_option
@reading_options
def invert(
    recording: str,
    tables: tuple[str, ...],
    output: str | None,
    hammer: str | None,
    band: tuple[float, float] | None,
    contact: float,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> None:
    """Recover the contact force of each impact in a RECORDING, at the place where a beam was tapped.

    The table of cgid tap holds the modes of one place: only impacts there can be inverted. Where impacts fall anywhere,
    train a model on the beam; cgid predict looks for their places.
    """
    from cgid._lib.files import check_new, write_whole
    from cgid.calibration.taps import events_in, hammer_force
    from cgid.identification.inversion.recovered import recover_force
    from cgid.measure.modal.modes import read_modes

    path = None if output is None else check_new(Path(output), "a table of forces", (".csv",), overwrite=overwrite)
    modes = [read_modes(table) for table in tables]
    response, force, rate, quantity = read_with_hammer(recording, hammer, reading)
    if force is None:
        measured, events = None, events_in(response, rate, recording)
    else:
        measured, events = hammer_force(force, rate, recording)
    onsets = [event.onset / rate for event in events]
    found = recover_force(response, rate, modes, onsets, quantity=quantity, band=band or None, contact=contact * 1e-3)
    rows = [_row(one, measured, rate) for one in found]
    for row in rows:
        if row["peak"] <= 0:
            warn(f"impact at {row['time']:.4g} s: the force pulls; is the signal inverted (--invert), or elsewhere?")
    if path is not None:
        write_whole(path, _table(found, measured, rate).encode(), overwrite=overwrite)
    if as_json:
        print_json({"output": output, "impacts": rows})
        return
    say(f"{recording}: {counted(len(rows), 'impact')}")
    say(f"{'time [s]':>10}{'peak [N]':>24}{'duration [ms]':>15}{'impulse [N s]':>26}{'unexplained [%]':>17}")
    for row in rows:
        say(
            f"{row['time']:>10.5g}{row['peak']:>12.5g} +- {row['peak_deviation']:<8.2g}{1e3 * row['duration']:>15.4g}"
            f"{row['impulse']:>14.4g} +- {row['impulse_deviation']:<8.2g}{100 * row['unexplained']:>17.3g}"
        )
        if "errors" in row:
            errors = dict(row["errors"])
            late = errors.pop("delay")
            text = ", ".join(f"{name} {100 * value:+.2g} %" for name, value in errors.items())
            say(f"{'':>10}  beside the measured force, {1e3 * late:+.2g} ms later: {text}")


def _row(found: RecoveredForce, measured: Floats | None, rate: float) -> dict[str, Any]:
    """Return the numbers of one impact, with errors where the force was measured."""
    peak, impulse = found.peak, found.impulse
    row: dict[str, Any] = {
        "time": float(found.time[0]),
        "peak": peak[0],
        "peak_deviation": peak[1],
        "duration": found.duration,
        "impulse": impulse[0],
        "impulse_deviation": impulse[1],
        "unexplained": found.unexplained,
    }
    if measured is not None:
        from cgid.identification.inversion.recovered import errors_of

        row["errors"] = errors_of(found, measured, rate)
    return row


def _table(found: list[RecoveredForce], measured: Floats | None, rate: float) -> str:
    """Return the forces as text, a row for each sample."""
    lines = ["impact,time [s],force [N],deviation [N]" + ("" if measured is None else ",measured [N]")]
    for number, one in enumerate(found, 1):
        columns = [one.time, one.force, one.deviation]
        if measured is not None:
            first = round(one.time[0] * rate)
            columns.append(measured[first : first + one.time.size])
        lines += [f"{number}," + ",".join(f"{float(value):.9g}" for value in row) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"
