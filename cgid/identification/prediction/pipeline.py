"""One way from a recording to its answers, for files, pipes, arrays and live streams.

Blocks -> gaps -> the unit of the model -> watch of the sensors -> impacts or windows -> answers, fractions, decisions.
The command line and Python only print or collect the steps.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from cgid.identification.model.model import Model, StoredModel, stored
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.diagnosis import Diagnosis, misfit_text, scale_warning, sizes_outside
from cgid.identification.prediction.same_beam import SameBeamWarning, rows_of
from cgid.identification.prediction.settings import PredictionSettings
from cgid.identification.prediction.stream import STRATEGIES, Step, answering_channels, factors_for, identify_blocks
from cgid.identification.prediction.support import CavingWatch, Ground
from cgid.recordings import Channel, RecordingFile, open_recording
from cgid.recordings.chain import scaled
from cgid.recordings.gaps import Gaps
from cgid.recordings.soundness import SensorWatch

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
    say : callable
        Gets each line on missing samples, without the source.
    live : bool
        Whether the samples arrive now: gaps are told when they begin, and each channel is judged by its latest impacts.
    diagnosis : Diagnosis, optional
        Gets the predictions; by default one of its own.
    watched : bool
        Whether fractions, grounds and decisions are followed.
    """

    def __init__(
        self,
        model: StoredModel,
        channels: Sequence[Channel],
        sampling_rate: float,
        settings: PredictionSettings,
        source: str,
        say: Callable[[str], object],
        *,
        live: bool = False,
        diagnosis: Diagnosis | None = None,
        watched: bool = True,
    ) -> None:
        self.model, self.settings, self.source, self.sampling_rate = model, settings, source, sampling_rate
        self.names, self.live = [channel.name for channel in channels], live
        self._factors = factors_for(model, channels, settings, source)
        joint = model.together > 1 and not settings.same_beam
        give_up = math.inf if settings.give_up is None else settings.give_up
        self._gaps = Gaps(channels, sampling_rate, say, give_up=give_up, joint=joint, at_once=live)
        needs_sensors = watched or math.isfinite(give_up)
        self._sensors = SensorWatch(len(channels), sampling_rate, give_up) if needs_sensors else None
        #: Names of the channels of the predictions; channels that are used together have one name.
        self.supports = answering_channels(model, self.names, settings.same_beam)
        self.diagnosis = Diagnosis(model, live=live) if diagnosis is None else diagnosis
        self.watch: CavingWatch | None = None
        if watched:
            self.watch = CavingWatch(
                model,
                self.supports,
                settings,
                STRATEGIES[model.subject].weight(model, settings),
                sensors=self._sensors,
                channels=self.names,
                rows=rows_of(model, self.names, settings.same_beam),
                diagnosis=self.diagnosis if live else None,
            )

    @property
    def n_seen(self) -> int:
        """Number of samples of each channel so far."""
        return self._gaps.n_seen

    @property
    def duration(self) -> float:
        """Duration of the samples so far [s]."""
        return self.n_seen / self.sampling_rate

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
        for step in identify_blocks(blocks, self.sampling_rate, self.model, self.names, self.settings, self.source):
            if not self.live:
                self.diagnosis.add(step.answers, step.upside_down)
            if self.watch is not None:
                reports = self.watch.feed(step.answers, step.until, step.heard)
                step = replace(step, reports=reports, changes=self.watch.take_changes())
            yield step

    def finish(self) -> Step:
        """Return the last step, of a recording that ends here, and say what is missing in it."""
        self._gaps.finish()
        if self.watch is None:
            return Step([], self.duration)
        reports = self.watch.finish(self.duration)
        return Step([], self.duration, reports=reports, changes=self.watch.take_changes())

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
        As `cgid.predict`, except that missing samples are in `recording.warnings`.

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

    def warned(text: str, category: type[Warning] = UserWarning) -> None:
        warnings.warn(text, category, stacklevel=4)

    source = pipeline.source
    for step in chain(pipeline.steps(blocks), map(Pipeline.finish, [pipeline])):
        yield from step.answers
        for text in (*step.silent, *step.warnings):
            warned(text)
        for text in step.wrong_beams:
            warned(text, SameBeamWarning)
        for report in step.reports:
            if report.kind == "state" and report.state.ground == Ground.BLIND:
                warned(f"{source}: blind since {report.state.since:.6g} s: {report.state.reason}")
    pipeline.require()
    diagnosis = pipeline.diagnosis
    texts = {
        name: scale_warning(factor, pipeline.model)
        for name, factor in (diagnosis.wrong_scales() | sizes_outside(diagnosis)).items()
    }
    foreign = {name: misfit_text(misfit, pipeline.model) for name, misfit in diagnosis.misfits.items()}
    for name, text in (foreign | texts).items():
        where = f"channel {name}: " if len(diagnosis.channels) > 1 else ""
        warned(f"{source}: {where}{text}")
