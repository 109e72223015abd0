"""`cgid features`: measure the impacts in recordings, one row for each impact."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import click

from cgid._lib.terminal import counted
from cgid.cli.help import Command
from cgid.cli.options import PATH, json_option
from cgid.cli.output import FileErrors, print_json, say, warn
from cgid.cli.reading import ReadingOptions, reading_options
from cgid.cli.table import TableOutput, output_options
from cgid.errors import BadData, InvalidValue
from cgid.signals import Signal
from cgid.units import Column, numbers, times

#: Version of the lines of --json; see `cgid.cli.answer_rows`.
FEATURES_VERSION = 2
#: Maximum number of unmeasurable impacts or channels, and left-out columns, that are named one by one.
_MAX_REPORTED = 3


@click.command(
    cls=Command,
    short_help="Measure the impacts in recordings: one row each.",
    example="cgid features datasets/sample.csv --features peak_force,width_50",
)
@click.argument("files", type=PATH, nargs=-1, metavar="FILE...")
@click.option(
    "--list", "as_list", is_flag=True, help="Print the table of features and banks: unit, definition, source, kind."
)
@click.option("--features", "names", help="Measure only these features or banks, separated by commas.")
@output_options
@reading_options("same_beam")
@json_option
def features(
    files: tuple[str, ...],
    as_list: bool,
    names: str | None,
    output: str | None,
    overwrite: bool,
    as_json: bool,
    reading: ReadingOptions,
) -> int:
    """Print the features of every impact in FILEs as one CSV table, in the unit of the file; - is stdin.

    Without --features these are the features of a vibration for motion and sound (acceleration, velocity, displacement,
    pressure, level), those of a pulse for everything else. The first file sets the columns. With --same-beam a row is a
    rock, with the features of each channel of its beam.
    """
    from cgid.measure.features import choose
    from cgid.recordings import is_dataset

    if not (files or as_list):
        raise click.UsageError("give at least one FILE, or --list for the table of features")
    selected = None if names is None else choose([name.strip() for name in names.split(",")])
    table = TableOutput(output, overwrite=overwrite, as_json=as_json)
    rows = _FeatureRows(table, as_json, selected, datasets=any(map(is_dataset, files)))

    errors = FileErrors(one_output=True)
    with table:
        if as_list:
            rows.of_features()
            return 0
        for path in errors.each(files):
            with errors:
                if reading.wants_complete_dataset(path):
                    rows.dataset(path, bool(reading.site.get("invert")))
                else:
                    rows.signals(path, reading)
    return errors.code


def _warn(problems: list[str], source: str, what: str) -> None:
    """Print the first problems, and the number of others."""
    for problem in problems[:_MAX_REPORTED]:
        warn(problem)
    more = len(problems) - _MAX_REPORTED
    if more > 0:
        warn(f"{source}: and {counted(more, f'more {what}')} cannot be measured")


#: Time of an impact [s], its values, and the reason if it has none.
_Impact = tuple[float, list[float], str]


@dataclass(frozen=True)
class _FeatureRows:
    """Measure and print the impacts of files, with the same settings for all."""

    table: TableOutput
    as_json: bool
    names: tuple[str, ...] | None
    datasets: bool

    def of_features(self) -> None:
        """Print one row for each feature and each bank."""
        from cgid.measure.features import FEATURES
        from cgid.measure.features.own import outside_features
        from cgid.measure.features.table import Bank

        names = ("name", "unit", "definition", "source", "kind")
        if not self.as_json:
            self.table.begin(map(Column, names))
        for entry in (*FEATURES.entries, *outside_features().values()):
            row = {name: getattr(entry, name) for name in names}
            if isinstance(entry, Bank):
                row["definition"] += f" (* is one of {len(entry.labels)} from {entry.labels[0]} to {entry.labels[-1]})"
            if self.as_json:
                print_json(row, version=FEATURES_VERSION)
            else:
                self.table.add(row)

    def signals(self, path: str, reading: ReadingOptions) -> None:
        """Print the impacts of all channels of a recording, or of one signal of a dataset."""
        from cgid.recordings import is_dataset

        errors: list[BadData] = []
        recording = None if is_dataset(path) else reading.recording(path)
        signals = reading.signals(path, errors, recording)
        n_channels = len(signals) + len(errors)
        for warning in signals[0].warnings:
            warn(warning)
        results: list[tuple[Signal, list[Column], list[_Impact]]] = []
        for signal in signals:
            try:
                results.append((signal, *self._measured(signal, reading.dead_time)))
            except BadData as error:
                errors.append(error)
        if recording is not None and (beams := reading.beams(recording)):
            results = list(_rocks(results, beams))
        columns = [column for _, its_columns, _ in results for column in its_columns]
        if columns or not self.table.columns:
            self._begin(path, columns or self._expected(signals[0]))
        for signal, its_columns, impacts in results:
            try:
                self._print_channel(
                    signal, its_columns, impacts, {} if reading.index is None else {"index": reading.index}
                )
            except BadData as error:
                errors.append(error)
        if len(errors) == n_channels:
            raise errors[0]
        # A channel without impacts must not hide the others.
        _warn([str(error) for error in errors], path, "channel")

    def dataset(self, path: str, invert: bool) -> None:
        """Print one row for each signal of a dataset, batch by batch."""
        from cgid.measure.features.extraction import FEATURES, any_through_beam, extract_array, kind_for
        from cgid.store import Dataset

        dataset = Dataset(path)
        kind = kind_for(dataset.quantity)
        selected = _selected_features(self.names, kind, dataset.sampling_rate, dataset.header.n_samples)
        through = None
        if any_through_beam(self.names or ()) or (self.names is None and kind == "vibration"):
            from cgid.identification.inversion.through_beam import ThroughBeam
            from cgid.scene.synthesis.through_beam import shared_beam

            beam, why = shared_beam([dataset])
            more = () if beam is None or self.names else tuple(name for name in FEATURES if FEATURES[name].beam)
            selected, through = selected + more, None if beam is None else ThroughBeam(beam)
            if not self.as_json and self.names is None:
                say(f"{path}: features of the samples{' and of the contact force' * bool(more)}, {why}", err=True)
        columns = _columns(dataset.quantity, dataset.unit, selected)
        self._begin(path, columns)
        self._report(path, dataset.sampling_rate, counted(len(dataset), "signal"))
        number = unmeasured = 0
        for batch in dataset.batches():
            values = extract_array(
                -batch.signals if invert else batch.signals,
                batch.sampling_rate,
                selected,
                pre_trigger=batch.pre_trigger,
                invalid="nan",
                beam=through,
            )
            about = {"time_s": batch.pre_trigger / batch.sampling_rate, "sampling_rate_hz": batch.sampling_rate}
            for row, label in zip(values.tolist(), batch.labels.tolist(), strict=True):
                self._print(path, columns, row, about | {"impact": 1, "index": number, "label": label})
                number += 1
                unmeasured += any(value != value for value in row)
        if unmeasured:
            warn(f"{path}: {unmeasured} of {counted(len(dataset), 'signal')} cannot be measured")

    def _expected(self, signal: Signal) -> list[Column]:
        """Return the columns that impacts of a signal would have."""
        from cgid.measure.features.extraction import choose, kind_for, supported

        every = choose(None, kind_for(signal.quantity))
        return _columns(
            signal.quantity, signal.unit, self.names or supported(every, signal.sampling_rate, len(signal.samples))
        )

    def _measured(self, signal: Signal, dead_time: float | None) -> tuple[list[Column], list[_Impact]]:
        """Return the measured impacts of one channel."""
        from cgid.identification.detection import find_impacts
        from cgid.measure.features.extraction import extract_array, kind_for, kind_of
        from cgid.recordings.chain import require_measured

        require_measured(signal.unit, signal.name)
        kind = kind_for(signal.quantity) if self.names is None else kind_of(self.names)
        if kind == "window":
            raise InvalidValue(
                f"{signal.name}: features must be those of impacts, got those of windows; choose others by --features, "
                "the last column of cgid features --list is the kind of each one"
            )
        events = find_impacts(signal, kind=kind, dead_time=dead_time)
        # All frames of a recording allow the same features, except the first, which may be shorter.
        shortest = min(event.signal.samples.size for event in events)
        selected = _selected_features(self.names, kind, signal.sampling_rate, shortest)
        impacts = []
        for event in events:
            part, problem = event.signal, event.problem
            values = [float("nan")] * len(selected)
            try:
                if not problem:
                    values = extract_array(
                        part.samples,
                        part.sampling_rate,
                        selected,
                        pre_trigger=part.pre_trigger,
                        detection_limit=event.detection_limit,
                    )[0].tolist()
            except BadData as error:
                problem = str(error)
            impacts.append((event.time, values, problem))
        return _columns(signal.quantity, signal.unit, selected), impacts

    def _print_channel(
        self, signal: Signal, columns: list[Column], impacts: list[_Impact], index: dict[str, int]
    ) -> None:
        """Print the impacts of a channel; raises `BadData` if none of them could be measured."""
        found = counted(len(impacts), "impact")
        self._report(signal.name, signal.sampling_rate, found)
        failed = []
        for number, (time, values, problem) in enumerate(impacts, start=1):
            about = {"impact": number, "time_s": time, "sampling_rate_hz": signal.sampling_rate}
            self._print(signal.source, columns, values, {"channel": signal.channel, **about, **index}, problem)
            if problem:
                failed.append(f"impact {number} at {time:.6f} s: {problem}")
        _warn([f"{signal.name}: {problem}" for problem in failed], signal.name, "impact")
        if len(failed) == len(impacts):
            raise BadData(f"{signal.name}: none of its {found} can be measured; the first: {failed[0]}")

    def _begin(self, source: str, columns: list[Column]) -> None:
        """Set the columns of the table; additional ones of later files are skipped with a warning."""
        if self.as_json:
            return
        new_columns = tuple(dict.fromkeys(columns))
        of_datasets = [Column("index", dtype="int64"), Column("label")] * self.datasets
        head = (Column("source"), Column("channel"), times("time"))
        lacking = [column.title for column in self.table.begin((*head, *new_columns, Column("problem"), *of_datasets))]
        if len(lacking) == len(new_columns):
            raise BadData(
                f"{source}: its features must be among those of the first file, which has no {lacking[0]}; run it "
                "separately, or with --json"
            )
        if lacking:
            more = "" if len(lacking) <= _MAX_REPORTED else f" and {len(lacking) - _MAX_REPORTED} more"
            warn(
                f"{source}: the first file does not have {', '.join(lacking[:_MAX_REPORTED])}{more}; skipped, a "
                "separate run has all"
            )

    def _report(self, name: str, sampling_rate: float, what: str) -> None:
        if not self.as_json:
            say(f"{name}: {sampling_rate:.8g} Hz, {what}, baseline removed", err=True)

    def _print(
        self, source: str, columns: list[Column], values: list[float], about: dict[str, Any], problem: str = ""
    ) -> None:
        """Print the row of one impact."""
        row = {"source": source, "channel": "1", **about, "problem": problem or None}
        if self.as_json:
            by_name = {column.name: value for column, value in zip(columns, values, strict=True)}
            row["features"] = by_name
            print_json(row | {"units": {column.name: column.unit for column in columns}}, version=FEATURES_VERSION)
        else:
            by_name = {column.title: value for column, value in zip(columns, values, strict=True)}
            self.table.add(row | {"time_s": about["time_s"]} | by_name)


class _Heard(NamedTuple):
    """An impact that a channel hears at a sample."""

    channel: int
    onset: int
    impact: _Impact


_Results = Sequence[tuple[Signal, list[Column], list[_Impact]]]


def _rocks(results: _Results, beams: Sequence[Sequence[str]]) -> Iterator[tuple[Signal, list[Column], list[_Impact]]]:
    """Yield the rocks of each beam, and of each other channel, with the values of its channels, nan of one without."""
    from cgid.identification.prediction.same_beam import RockAssigner, grouped

    names, rate = [signal.channel for signal, _, _ in results], results[0][0].sampling_rate
    groups = grouped(names, beams)
    heard = [
        _Heard(row, round(impact[0] * rate), impact)
        for row, (_, _, impacts) in enumerate(results)
        for impact in impacts
    ]
    rocks = RockAssigner[_Heard](groups, rate).feed(sorted(heard, key=lambda one: one.onset), float("inf"))
    for rows in groups:
        columns = [
            replace(column, name=f"{column.name} of channel {k}")
            for k, row in enumerate(rows, 1)
            for column in results[row][1]
        ]
        impacts = []
        for rock in (rock for rock in rocks if rock[0].channel in rows):
            own = {one.channel: one.impact for one in rock}
            values = [own[row][1] if row in own else [float("nan")] * len(results[row][1]) for row in rows]
            problems = [problem for _, _, problem in own.values()]
            impacts.append((rock[0].impact[0], [value for part in values for value in part], min(problems)))
        yield replace(results[rows[0]][0], channel="+".join(names[row] for row in rows)), columns, impacts


def _columns(quantity: str | None, unit: str | None, selected: tuple[str, ...]) -> list[Column]:
    """Return the columns of features of a signal, in its unit."""
    from cgid.measure.features import FEATURES

    # The peak of the samples has their quantity; one inverted through a beam is a force.
    titles = (
        name if FEATURES[name].beam else name.replace("peak_force", f"peak_{quantity or 'signal'}") for name in selected
    )
    return [numbers(title, FEATURES[name].unit_for(unit or "U")) for title, name in zip(titles, selected, strict=True)]


def _selected_features(
    names: tuple[str, ...] | None, kind: Any, sampling_rate: float, n_samples: int
) -> tuple[str, ...]:
    """Return the given features, by default all of the kind that the sampling rate and the frames allow."""
    from cgid.measure.features.extraction import choose, require_supported, supported

    if names is not None:
        return names
    every = choose(None, kind)
    available = supported(every, sampling_rate, n_samples)
    if not available:
        require_supported(every[:1], sampling_rate, n_samples)
    return available
