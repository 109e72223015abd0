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
from cgid.errors import BadData

if TYPE_CHECKING:
    from cgid._lib.validation import Floats
    from cgid.identification.inversion.recovered import RecoveredForce

#: An earlier impact is heard for this time [s].
_RINGS = 2.0


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
@click.option(
    "--band", nargs=2, type=float, metavar="LOW HIGH", help="Use LOW to HIGH [Hz], instead of the range of all modes."
)
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
    from cgid.calibration.taps import events_in, hammer_force, is_clipped
    from cgid.identification.inversion.recovered import recover_force
    from cgid.measure.modal.modes import read_modes

    path = None if output is None else check_new(Path(output), "a table of forces", (".csv",), overwrite=overwrite)
    modes = [read_modes(table) for table in tables]
    spans, rate, quantity = read_with_hammer(recording, hammer, reading, 2 * _RINGS)
    rows: list[dict[str, Any]] = []
    text: list[str] = []
    done, silent = 0, None
    for first, response, force, last in spans:
        try:
            if force is None:
                measured, events = None, events_in(response, rate, recording, apart=False)
            else:
                measured, events = hammer_force(force, rate, recording)
        except BadData as error:
            silent = error
            continue
        # The vibration of the last impacts goes on in the next stretch, which also begins with them.
        end = response.shape[1] - (0 if last else round(_RINGS * rate))
        onsets = [event.onset / rate for event in events if event.onset < end]
        options: dict[str, Any] = {"quantity": quantity, "band": band or None, "contact": contact * 1e-3}
        for event, one in zip(events, recover_force(response, rate, modes, onsets, **options), strict=False):
            if first + event.onset < done:
                continue
            row = _row(one, measured, rate)
            part = slice(round(event.onset), round(one.time[-1] * rate) + round(_RINGS * rate))
            row["clipped"] = is_clipped(response[:, part], response.max(axis=1), response.min(axis=1))
            rows.append({**row, "time": row["time"] + first / rate})
            if path is not None:
                text += _lines(len(rows), one, measured, rate, first)
        done = first + end
    if not rows:
        raise silent or BadData(f"{recording}: must contain an impact, got none; record longer")
    for row in rows:
        if row["clipped"]:
            warn(f"impact at {row['time']:.4g} s: the response is clipped, its force is wrong; use a larger range")
        if row["peak"] <= 0:
            warn(f"impact at {row['time']:.4g} s: the force pulls; is the signal inverted (--invert), or elsewhere?")
    if path is not None:
        title = "impact,time [s],force [N],deviation [N]" + ("" if hammer is None else ",measured [N]")
        write_whole(path, "\n".join([title, *text, ""]).encode(), overwrite=overwrite)
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
            errors_text = ", ".join(f"{name} {100 * value:+.2g} %" for name, value in errors.items())
            say(f"{'':>10}  beside the measured force, {1e3 * late:+.2g} ms later: {errors_text}")


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


def _lines(number: int, found: RecoveredForce, measured: Floats | None, rate: float, first: int) -> list[str]:
    """Return the rows of a table of forces, one for each sample; the stretch begins at sample `first`."""
    columns = [found.time + first / rate, found.force, found.deviation]
    if measured is not None:
        begin = round(found.time[0] * rate)
        columns.append(measured[begin : begin + found.time.size])
    return [f"{number}," + ",".join(f"{float(value):.9g}" for value in row) for row in zip(*columns, strict=True)]
