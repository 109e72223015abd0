"""The impacts of recordings as a table to be labelled, one row each: what `cgid events` writes."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cgid._lib.spelling import spelled
from cgid._lib.terminal import counted
from cgid.errors import BadData
from cgid.identification.detection.ear import Ear
from cgid.identification.detection.events import SAME_IMPACT, Event
from cgid.identification.model.model import Model
from cgid.identification.prediction.findings import SameBeamWarning
from cgid.identification.training.recordings import measurable, unit_of
from cgid.measure.features.extraction import kind_for
from cgid.measure.features.table import LEAST_SAMPLES, ImpactKind
from cgid.recordings import RecordingFile, open_recording
from cgid.units import quantity_of

if TYPE_CHECKING:
    import pandas

__all__ = ["impact_table"]

#: An interval begins this long before its impact, because channels may measure it at different times [s].
_BEFORE = 2e-3
#: Impacts are found without the channels that lack more than this fraction of their samples.
_MOST_MISSING = 0.01


def impact_table(
    recording: RecordingFile | str | Path, model: Model | str | Path | None = None, *, dead_time: float | None = None
) -> pandas.DataFrame:
    """Return the impacts of a recording, one row each, ready to be labelled, with the predictions of a model.

    `cgid train` and `cgid label` read the table once it is saved by ``table.to_csv(path, index=False)`` in a folder
    from which its column `path` leads to the recording.

    Parameters
    ----------
    recording : RecordingFile, str or Path
        From `cgid.open_recording`, or the name of a file that states rate and unit.
    model : Model, str or Path, optional
        A model of impacts, or an argument of `load_model`; without one there are no predictions.
    dead_time : float, optional
        Shortest time between two impacts [s].

    Returns
    -------
    DataFrame
        `path`, `start_s` and `end_s` of the interval, an empty `label`, `time_s` of the impact, `peak` and `peak_unit`,
        `flags` ("overlapping", "clipped", "cut"), and empty `by` (who labelled it) and `chosen` ("random" if it was
        drawn at random). With a model also `predicted`, one `p_LABEL` for each of its labels, the mean over the
        channels that measure the impact, and `novelty`, the least of them; nan where none could measure it.
        `attrs["units"]` has the unit of each column.

    Raises
    ------
    BadData
        The recording has no impact, or is of another quantity than the model's.
    NoInput
        There is no such recording or model.

    Examples
    --------
    >>> from cgid import shipped
    >>> table = impact_table(shipped.path_of("datasets", "sample.csv"), "default")
    >>> table["predicted"].tolist()
    ['coal', 'gangue', 'coal', 'gangue', 'coal', 'gangue']
    """
    import pandas as pd

    if not isinstance(recording, RecordingFile):
        recording = open_recording(recording)
    unit = unit_of(recording)
    kind = kind_for(quantity_of(unit))
    events = measured_impacts(recording, kind, [recording.sampling_rate], dead_time=dead_time)
    blank = {"path": recording.source, "by": "", "chosen": ""}
    rows = [{**blank, **row} for row in interval_rows([[one] for one in events], unit)]
    order = ["path", "start", "end", "label", "time_s", "peak", "peak_unit", "flags", "by", "chosen"]
    table = pd.DataFrame(rows, columns=order).astype(dict.fromkeys(("start", "end", "time_s", "peak"), float))
    table = table.rename(columns={"start": "start_s", "end": "end_s"})
    table.attrs["units"] = (
        dict.fromkeys(table, "") | dict.fromkeys(("start_s", "end_s", "time_s"), "s") | {"peak": unit}
    )
    if model is None:
        return table
    from cgid.identification.prediction.pipeline import identify_recording
    from cgid.identification.prediction.prediction import read_model
    from cgid.identification.prediction.settings import PredictionSettings

    loaded = read_model(model)
    with warnings.catch_warnings():  # here the channels are taken together
        warnings.simplefilter("ignore", SameBeamWarning)
        heard = identify_recording(recording, loaded, PredictionSettings(dead_time=dead_time))
        answers = [one for one in heard if one.probabilities]
    times = np.array([one.time for one in answers])
    by_time, known = np.argsort(times), np.full((len(events), len(loaded.labels) + 1), np.nan)
    places = np.searchsorted(times[by_time], [[one.time - SAME_IMPACT, one.time + SAME_IMPACT] for one in events])
    for number, (first, last) in enumerate(places.tolist()):
        own = [answers[k] for k in by_time[first:last].tolist()]
        if own:
            known[number, :-1] = np.mean([list(one.probabilities.values()) for one in own], axis=0)
            known[number, -1] = min(one.novelty for one in own)
    best = [loaded.labels[int(row.argmax())] if np.isfinite(row).all() else "" for row in known[:, :-1]]
    table["predicted"] = ["unknown" if one and known[k, -1] > 1 else one for k, one in enumerate(best)]
    found = {f"p_{label}": known[:, k] for k, label in enumerate(loaded.labels)} | {"novelty": known[:, -1]}
    table.attrs["units"] |= dict.fromkeys(("predicted", *found), "")
    return table.assign(**found)


def measured_impacts(
    recording: RecordingFile,
    kind: ImpactKind,
    rates: Sequence[float],
    factor: float = 1.0,
    *,
    dead_time: float | None = None,
    joint: bool = True,
    told: Callable[[str], object] = warnings.warn,
) -> list[Event]:
    """Return the impacts on which a model of recordings of these rates [Hz] can be trained; raises `BadData`.

    `told` gets what is left out, one text at a time.
    """
    found = found_impacts(recording, kind, factor, dead_time=dead_time, joint=joint, told=told)
    events = list(compress(found, measurable(found, kind, sorted(rates))))
    if not events and len(recording.channels) > 1:  # one bad channel is enough, and train can leave it out
        told(
            f"{recording.source}: no impact can be measured on all channels together; name a sound one by "
            f"{spelled('channel')}, "
            "or in the column channel"
        )
        events = found
    if not events:
        raise BadData(
            f"{recording.source}: impacts must be long and clear enough to be measured at {recording.sampling_rate:g} "
            f"Hz, none of {len(found)} is; record faster, or closer to the impact"
        )
    if lost := len(found) - len(events):
        lines = f"{lost} of {counted(len(found), 'impact')} cannot be measured and are left out"
        told(f"{recording.source}: {lines}")
    return events


def interval_rows(rocks: Sequence[Sequence[Event]], unit: str) -> Iterator[dict[str, str]]:
    """Yield the cells of each rock, of which every channel has an event."""
    before = 0.0
    for events, following in zip(rocks, [*rocks[1:], None], strict=True):
        time = events[0].time
        # At low rates a vibration is as long as what is measured of it, which its energy may leave sooner.
        end = max(max(event.end, event.onset + _least(event)) / event.sampling_rate for event in events)
        start = max(time - _BEFORE, (before + time) / 2 if before else 0.0)
        if following is not None:
            end = min(end, max(following[0].time - _BEFORE, (time + following[0].time) / 2))
        before = time
        yield {
            "start": f"{start:.7f}",
            "end": f"{end:.7f}",
            "label": "",
            "time_s": f"{time:.6f}",
            "peak": f"{max(map(peak_of, events)):.5g}",
            "peak_unit": unit,
            "flags": " ".join(
                name for name in ("overlapping", "clipped", "cut") if any(getattr(event, name) for event in events)
            ),
        }


def _least(event: Event) -> int:
    """Return the least length of a row [samples]; the end of a pulse is known."""
    return 0 if event.pre_trigger is None else LEAST_SAMPLES


def found_impacts(
    recording: RecordingFile,
    kind: ImpactKind,
    factor: float = 1.0,
    *,
    dead_time: float | None = None,
    joint: bool = False,
    told: Callable[[str], object] = warnings.warn,
) -> list[Event]:
    """Return the impacts of a recording, whose samples are multiplied first; raises `BadData` if there is none."""
    rows = list(range(len(recording.channels)))
    while True:
        ear = Ear(recording.sampling_rate, len(rows), kind=kind, dead_time=dead_time, joint=joint, factor=factor)
        gaps = recording.gaps(rows, joint=joint)
        blocks = gaps.marked(block[rows] for block in recording.blocks(gaps=True))
        events = [event for heard in ear.heard(blocks) for event in heard.events]
        lacking = gaps.n_samples > _MOST_MISSING * gaps.n_seen
        if not joint or not lacking.any() or lacking.all():
            break
        # A lost channel would end or cut the impacts of all others.
        names = ", ".join(recording.channels[row].name for row in compress(rows, lacking))
        told(f"{recording.source}: channel {names} is left out, it lacks too many samples")
        rows = list(compress(rows, ~lacking))
    gaps.require(recording.source)
    for warning in recording.warnings:
        told(warning)
    if not events:
        raise BadData(f"{recording.source}: {ear.why_silent(unit=recording.channels[0].unit)}")
    return events


def peak_of(event: Event) -> float:
    """Return the largest distance from the baseline, of the channel that measures the impact best."""
    frame = np.atleast_2d(event.samples)
    return float(max(np.abs(row - np.median(row)).max() for row in frame.astype(float)))
