"""`cgid features`: the feature table, one row for each impact."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.options import each_file, print_json, read_signals, recording_options


@click.command(short_help="Measure the impacts in recordings: one row each.")
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option("--features", "names", help="Only these, with commas between them.")
@click.option("--keep-baseline", is_flag=True, help="Do not subtract the mean before touch.")
@recording_options
def features(
    files: tuple[str, ...],
    names: str | None,
    keep_baseline: bool,
    as_json: bool,
    dead_time: float,
    **reading: Any,
) -> int:
    """Print the features of every impact in FILEs, tab-separated, in the unit of the file; - is stdin."""
    from cgid.features import choose

    chosen = choose(None if names is None else [name.strip() for name in names.split(",")])

    def treat(path: str) -> None:
        for signal in read_signals(path, **reading):
            _print(signal, chosen, not keep_baseline, dead_time * 1e-3, as_json)

    return each_file(files, treat)


def _print(signal: Any, chosen: tuple[str, ...], remove_baseline: bool, dead_time: float, as_json: bool) -> None:
    from cgid.errors import BadData
    from cgid.features import FEATURES, extract_array
    from cgid.identification.events import find_impacts

    quantity, unit = signal.quantity or "signal", signal.unit or "U"
    titles = [name.replace("peak_force", f"peak_{quantity}") for name in chosen]
    units = [FEATURES[name].unit_for(unit) for name in chosen]
    events = find_impacts(signal, dead_time=dead_time)
    if not as_json:
        baseline = "baseline removed" if remove_baseline else "baseline kept"
        click.echo(f"# {signal.name}: {signal.sampling_rate:.8g} Hz, {len(events)} impacts, {baseline}")
        click.echo("\t".join(["time [s]", *(f"{t} [{u}]" for t, u in zip(titles, units, strict=True))]))
    problems = []
    for number, event in enumerate(events, start=1):
        part, problem = event.signal, None
        try:
            values = extract_array(
                part.samples,
                part.sampling_rate,
                chosen,
                pre_trigger=part.pre_trigger,
                remove_baseline=remove_baseline,
                detection_limit=event.detection_limit,
            )[0].tolist()
        except BadData as error:
            values, problem = [float("nan")] * len(chosen), str(error)
            problems.append(f"impact {number} at {event.time:.6f} s: {problem}")
        if as_json:
            print_json(
                {
                    "source": signal.name,
                    "impact": number,
                    "time_s": event.time,
                    "sampling_rate_hz": signal.sampling_rate,
                    "baseline_removed": remove_baseline,
                    "features": dict(zip(titles, values, strict=True)),
                    "units": dict(zip(titles, units, strict=True)),
                    "problem": problem,
                }
            )
        else:
            click.echo("\t".join([f"{event.time:.6f}", *("-" if v != v else f"{v:.6g}" for v in values)]))
    for problem in problems[:3]:
        click.echo(f"cgid: warning: {signal.name}: {problem}", err=True)
    if len(problems) > 3:
        click.echo(f"cgid: warning: {signal.name}: and {len(problems) - 3} more impacts cannot be measured", err=True)
    if len(problems) == len(events):
        raise BadData(f"{signal.name}: none of its {len(events)} impacts can be measured; the first: {problems[0]}")
