"""`cgid features`: measure the impacts in recordings, one row for each impact."""

from __future__ import annotations

from typing import Any

import click

from cgid.cli.options import PATH, Reading, printing_options, reading_options
from cgid.cli.output import each_file, print_json, say

#: Up to this many unmeasurable impacts or channels are reported one by one.
_MOST_REPORTED = 3


@click.command(short_help="Measure the impacts in recordings: one row each.")
@click.argument("files", type=PATH, nargs=-1, metavar="FILE...")
@click.option(
    "--list", "as_list", is_flag=True, help="Print the table of features and banks: unit, definition, source, kind."
)
@click.option("--features", "names", help="Only these features or banks, separated by commas.")
@click.option("--keep-baseline", is_flag=True, help="Do not subtract the mean before touch.")
@reading_options
@printing_options
def features(
    files: tuple[str, ...],
    as_list: bool,
    names: str | None,
    keep_baseline: bool,
    as_json: bool,
    strict: bool,
    reading: Reading,
) -> int:
    """Print the features of every impact in FILEs, tab-separated, in the unit of the file; - is stdin.

    Without --features these are the features of a vibration for motion and sound (acceleration, velocity, displacement,
    pressure, level), those of a pulse for all else.
    """
    from cgid.errors import BadData
    from cgid.measure.features import choose

    if as_list:
        _print_table()
        return 0
    if not files:
        raise click.UsageError("give at least one FILE, or --list for the table of features")
    chosen = None if names is None else choose([name.strip() for name in names.split(",")])
    gap = reading.dead_time

    def treat(path: str) -> None:
        if reading.wants_whole_dataset(path):
            _print_dataset(path, chosen, not keep_baseline, as_json, reading.invert)
            return
        signals = reading.signals(path)
        for warning in signals[0].warnings:
            say(f"cgid: warning: {warning}", err=True)
        errors: list[BadData] = []
        for signal in signals:
            try:
                _print(signal, chosen, not keep_baseline, gap, as_json)
            except BadData as error:
                errors.append(error)
        if len(errors) == len(signals):
            raise errors[0]
        # A channel without impacts must not hide the others.
        _warn([str(error) for error in errors], path, "channels")

    return each_file(files, treat, strict=strict)


def _warn(problems: list[str], source: str, what: str) -> None:
    """Print the first problems, and how many more impacts or channels have one."""
    for problem in problems[:_MOST_REPORTED]:
        say(f"cgid: warning: {problem}", err=True)
    more = len(problems) - _MOST_REPORTED
    if more > 0:
        say(f"cgid: warning: {source}: and {more} more {what} cannot be measured", err=True)


def _print_table() -> None:
    """Print one row for each feature and each bank."""
    from cgid.measure.features import FEATURES
    from cgid.measure.table import Bank

    for entry in FEATURES.entries:
        definition = entry.definition
        if isinstance(entry, Bank):
            definition += f" (* is one of {len(entry.labels)} from {entry.labels[0]} to {entry.labels[-1]})"
        say("\t".join([entry.name, entry.unit, definition, entry.source, entry.kind]))


def _print(
    signal: Any, names: tuple[str, ...] | None, remove_baseline: bool, dead_time: float | None, as_json: bool
) -> None:
    """Print the impacts of one channel; unmeasurable ones have a reason instead of numbers."""
    from cgid.errors import BadData, InvalidValue
    from cgid.identification.detection import find_impacts
    from cgid.measure.features import extract_array, kind_for, kind_of
    from cgid.recordings.chain import require_measured

    require_measured(signal.unit, signal.name)
    kind = kind_for(signal.quantity) if names is None else kind_of(names)
    if kind == "window":
        raise InvalidValue(
            f"{signal.name}: features must be those of impacts, got those of windows; choose others by --features, "
            "the last column of cgid features --list is the kind of each one"
        )
    events = find_impacts(signal, kind=kind, dead_time=dead_time)
    # All frames of a recording allow the same features, except the first, which may be shorter.
    chosen = _chosen(names, kind, signal.sampling_rate, min(event.signal.samples.size for event in events))
    columns = _Columns(signal.quantity, signal.unit, chosen, as_json)
    columns.title(signal.name, signal.sampling_rate, len(events), remove_baseline)
    problems = []
    for number, event in enumerate(events, start=1):
        part, problem = event.signal, None
        try:
            if event.problem:
                raise BadData(event.problem)
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
        about = {"sampling_rate_hz": signal.sampling_rate, "baseline_removed": remove_baseline, "problem": problem}
        columns.row(signal.name, number, event.time, values, about)
    _warn([f"{signal.name}: {problem}" for problem in problems], signal.name, "impacts")
    if len(problems) == len(events):
        raise BadData(f"{signal.name}: none of its {len(events)} impacts can be measured; the first: {problems[0]}")


def _chosen(names: tuple[str, ...] | None, kind: Any, sampling_rate: float, n_samples: int) -> tuple[str, ...]:
    """Return the given features, by default all of the kind that the sampling rate and the frames allow."""
    from cgid.measure.features import choose, require_supported, supported

    if names is not None:
        return names
    every = choose(None, kind)
    found = supported(every, sampling_rate, n_samples)
    if not found:
        require_supported(every[:1], sampling_rate, n_samples)
    return found


def _print_dataset(
    path: str, names: tuple[str, ...] | None, remove_baseline: bool, as_json: bool, invert: bool
) -> None:
    """Print one row for each signal of a dataset, batch by batch."""
    from cgid.measure.features import extract_array, kind_for
    from cgid.store import Dataset

    dataset = Dataset(path)
    chosen = _chosen(names, kind_for(dataset.quantity), dataset.sampling_rate, dataset.header.n_samples)
    columns = _Columns(dataset.quantity, dataset.unit, chosen, as_json)
    columns.title(path, dataset.sampling_rate, len(dataset), remove_baseline)
    number = unmeasured = 0
    for batch in dataset.batches():
        table = extract_array(
            -batch.signals if invert else batch.signals,
            batch.sampling_rate,
            chosen,
            pre_trigger=batch.pre_trigger,
            remove_baseline=remove_baseline,
            invalid="nan",
        )
        for values, label in zip(table.tolist(), batch.labels.tolist(), strict=True):
            about = {"sampling_rate_hz": batch.sampling_rate, "baseline_removed": remove_baseline, "label": label}
            columns.row(f"{path} index {number}", 1, batch.pre_trigger / batch.sampling_rate, values, about)
            number += 1
            unmeasured += any(value != value for value in values)
    if unmeasured:
        say(f"cgid: warning: {path}: {unmeasured} of {len(dataset)} signals cannot be measured", err=True)


class _Columns:
    """The columns of the table, in the unit of the signal."""

    def __init__(self, quantity: str | None, unit: str | None, chosen: tuple[str, ...], as_json: bool) -> None:
        from cgid.measure.features import FEATURES

        self.titles = [name.replace("peak_force", f"peak_{quantity or 'signal'}") for name in chosen]
        self.units = [FEATURES[name].unit_for(unit or "U") for name in chosen]
        self.as_json = as_json

    def title(self, name: str, rate: float, n_impacts: int, remove_baseline: bool) -> None:
        """Print the title and the head of the table."""
        if self.as_json:
            return
        baseline = "baseline removed" if remove_baseline else "baseline kept"
        say(f"# {name}: {rate:.8g} Hz, impacts: {n_impacts}, {baseline}")
        titles = (f"{title} [{unit}]" for title, unit in zip(self.titles, self.units, strict=True))
        say("\t".join(["time [s]", *titles]))

    def row(self, source: str, number: int, time: float, values: list[float], about: dict[str, Any]) -> None:
        """Print the row of one impact."""
        if not self.as_json:
            say("\t".join([f"{time:.6f}", *("-" if value != value else f"{value:.6g}" for value in values)]))
            return
        features, units = (dict(zip(self.titles, column, strict=True)) for column in (values, self.units))
        head = {"source": source, "impact": number, "time_s": time}
        print_json(head | about | {"features": features, "units": units})
