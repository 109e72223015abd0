"""One way from a recording to its answers, for files, pipes, arrays and live streams.

Blocks -> gaps -> the unit of the model -> watch of the sensors -> impacts or windows -> answers, fractions, decisions.
The command line and Python only print or collect the steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from cgid.identification.model.model import Model, StoredModel, stored
from cgid.identification.prediction.answers import Answer, factor_to
from cgid.identification.prediction.diagnosis import Diagnosis
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.same_beam import answering_channels, rows_of
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import STRATEGIES, Step, identify_blocks
from cgid.identification.prediction.support import CavingWatch, SupportReport
from cgid.identification.prediction.telling import Telling, of_model, warn
from cgid.recordings import Channel, RecordingFile, open_recording
from cgid.recordings.chain import scaled
from cgid.recordings.gaps import Gaps
from cgid.recordings.soundness import SensorWatch
from cgid.signals import channel_name

if TYPE_CHECKING:
    from cgid.identification.prediction.pasts import Pasts

#: Blocks in, the same blocks out, looked at on the way.
Look = Callable[[Iterable[NDArray[Any]]], Iterable[NDArray[Any]]]


class Pipeline:
    """Predict the impacts or windows of a recording: `steps` of its blocks, then `finish`, then `require`.

    Parameters
    ----------
    model : Model
    channels : sequence of Channel
        With their names and units; all in the quantity of the model, or converted to it by the settings.
    sampling_rate : float [Hz]
    settings : PredictionSettings
    source : str
        Name of the recording in messages.
    say : callable, optional
        Gets each line on missing samples, without the source; it is a finding, too.
    live : bool
        Whether the samples arrive now: gaps are told when they begin, and each channel is judged by its latest impacts.
    watched : bool
        Whether fractions, grounds and decisions are followed.
    pasts : Pasts, optional
        The channels' own references, of earlier runs.
    """

    def __init__(
        self,
        model: StoredModel,
        channels: Sequence[Channel],
        sampling_rate: float,
        settings: PredictionSettings,
        source: str,
        say: Callable[[str], object] | None = None,
        *,
        live: bool = False,
        watched: bool = True,
        pasts: Pasts | None = None,
    ) -> None:
        self.model, self.settings, self.source, self.sampling_rate = model, settings, source, sampling_rate
        self.names, self.live = [channel.name for channel in channels], live
        # To the unit of the model, negative to invert.
        self._factors = [
            (-1.0 if settings.invert else 1.0)
            * factor_to(model, one.unit, channel_name(source, one.name), settings.mass)
            for one in channels
        ]
        joint = model.together > 1 and not settings.same_beam
        give_up = math.inf if settings.give_up is None else settings.give_up
        #: All that is found, told in order of time.
        self.findings = Telling(model, settings)
        self._found: list[Finding] = []  # not yet told
        self._of_parts: list[Finding] = []

        def missing(text: str) -> None:
            self._found.append(Finding(kind="missing", fields={"text": text}))
            if say is not None:
                say(text)

        self._gaps = Gaps(channels, sampling_rate, missing, give_up=give_up, joint=joint, at_once=live)
        needs_sensors = watched or math.isfinite(give_up)
        self._sensors = SensorWatch(len(channels), sampling_rate, give_up) if needs_sensors else None
        #: Names of the channels of the predictions; channels that are used together have one name.
        rows = rows_of(model, self.names, settings.same_beam)
        self.supports = answering_channels(rows, self.names)
        self._pasts = pasts
        self.diagnosis = Diagnosis(model, sampling_rate, watched=watched, pasts=pasts)
        self.watch: CavingWatch | None = None
        if watched:
            self.watch = CavingWatch(
                model,
                self.supports,
                settings,
                STRATEGIES[model.subject].weight(model, settings),
                sensors=self._sensors,
                channels=self.names,
                rows=rows,
                diagnosis=self.diagnosis,
            )

    @property
    def n_seen(self) -> int:
        """Number of samples of each channel so far."""
        return self._gaps.n_seen

    @property
    def duration(self) -> float:
        """Duration of the samples so far [s]."""
        return self._gaps.n_seen / self.sampling_rate

    def steps(
        self, blocks: Iterable[NDArray[Any]], *, marked: Look | None = None, measured: Look | None = None
    ) -> Iterator[Step]:
        """Yield the steps of blocks (n_channels, n_samples) in the units of the channels.

        `marked` looks at these once gaps are nan, and `measured` at those in the unit of the model.
        """
        blocks = self._gaps.marked(blocks)
        if marked is not None:
            blocks = marked(blocks)
        blocks = scaled(blocks, self._factors)
        if self._sensors is not None:
            blocks = self._sensors.watching(blocks)
        if measured is not None:
            blocks = measured(blocks)
        # First, since it refuses rates: of these nothing else is said.
        steps = identify_blocks(blocks, self.sampling_rate, self.model, self.names, self.settings, self.source)
        decides = self.watch is not None
        if known := of_model(self.model, self.sampling_rate, self.settings, self.names, decides=decides):
            yield Step([], 0.0, found=self.findings.tell(known))
        for step in steps:
            self._found += step.found
            if self.watch is None:
                self.diagnosis.add(step.answers)
            else:
                step = replace(step, reports=self.watch.feed(step.answers, step.until, step.heard))
                self._of_watch(self.watch, step.reports)
            yield replace(step, found=self._told()) if self._found or self._pasts is not None else step

    def _of_watch(self, watch: CavingWatch, reports: Sequence[SupportReport]) -> None:
        """Take what a watch has found; of a file, parts of channels are told at its end."""
        found = watch.take_changes()
        for one in self.findings.of_reports(reports, watch):
            (found if one.is_explained else self._found).append(one)
        (self._found if self.live else self._of_parts).extend(found)

    def _told(self) -> list[Finding]:
        found, self._found = self._found, []
        if self._pasts is not None:
            found += self._pasts.take_told()
        return self.findings.tell(found)

    def finish(self) -> Step:
        """Return the last step, of a recording that ends here, and say what is missing and wrong in it."""
        self._gaps.finish()
        reports: list[SupportReport] = []
        if self.watch is not None:
            reports = self.watch.finish(self.duration)
            self._of_watch(self.watch, reports)
            self._found += self.findings.at_end(self.duration, self.watch)
        if not self.live:
            self._found += self._of_whole() if self._of_parts else self.diagnosis.findings()
        return Step([], self.duration, reports=reports, found=self._told() if self._found else ())

    def _of_whole(self) -> list[Finding]:
        """Return what is wrong with a file as a whole, and with parts of channels of which nothing else is told."""
        whole = self.diagnosis.findings()
        known = {name for one in (*whole, *self.findings.all) if one.moves for name in one.channels}
        begun, last = dict[tuple[Any, ...], Finding](), dict[tuple[Any, ...], Finding]()
        for one in self._of_parts:
            if known.isdisjoint(one.channels):
                begun.setdefault((one.kind, one.channels), one)
                last[one.kind, one.channels] = one
        explained = {name for one in begun.values() if not one.is_explained for name in one.channels}
        parts = [one for one in begun.values() if not one.is_explained or explained.isdisjoint(one.channels)]
        return [
            *whole,
            *parts,
            *(last[one.kind, one.channels] for one in parts if last[one.kind, one.channels].is_over),
        ]

    def stopped(self, reason: str) -> Step:
        """Return what is known of a stream whose samples have stopped; the next ones take it up again."""
        reports = [] if self.watch is None else self.watch.stopped(reason)
        if self.watch is not None:
            self._of_watch(self.watch, reports)
        return Step([], self.duration, reports=reports, found=self._told())

    def require(self) -> None:
        """Raise `BadData` if the recording was given up, or had no sample that a sensor can give."""
        self._gaps.require(self.source)
        if self._sensors is not None:
            self._sensors.require(self.source)


def identify_recording(
    recording: RecordingFile | str | Path, model: Model, settings: PredictionSettings | None = None
) -> Iterator[Answer]:
    """Yield the predictions for a recording, in order of time; it is read block by block.

    Parameters
    ----------
    recording : RecordingFile, str or Path
        From `cgid.open_recording`, or the path of a file that states all of it; all channels in the quantity of the
        model.
    model : Model
    settings : PredictionSettings, optional

    Yields
    ------
    Answer

    Warns
    -----
    UserWarning
        As `cgid.predict`; missing samples are in `recording.warnings`, too.

    Raises
    ------
    BadData
        The recording is damaged, or of another quantity than the model's.
    MissingOption
        The unit of a channel is not given.
    """
    recording = recording if isinstance(recording, RecordingFile) else open_recording(recording)
    settings = settings or PredictionSettings()
    settings = replace(settings, same_beam=recording.named(settings.same_beam, "same_beam"))
    channels, rate, source = recording.channels, recording.sampling_rate, recording.source
    pipeline = Pipeline(stored(model), channels, rate, settings, source, recording.note)
    yield from answers_with_warnings(pipeline, recording.blocks(gaps=True))


def answers_with_warnings(pipeline: Pipeline, blocks: Iterable[NDArray[Any]]) -> Iterator[Answer]:
    """Yield the answers of blocks in order of time; what is wrong with the channels is a `UserWarning`."""
    for step in chain(pipeline.steps(blocks), map(Pipeline.finish, [pipeline])):
        yield from step.answers
        if step.found:
            warn(step.found, pipeline.source, len(pipeline.names), stacklevel=4)
    pipeline.require()
