"""Predictions for samples in memory as one table: `load_model` and `predict`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.validation import SAME_RATE
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.model.model import Model, StoredModel, stored
from cgid.identification.prediction.answers import Answer, answer_columns
from cgid.identification.prediction.batches import identify_batches
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.pipeline import Pipeline, answers_with_warnings
from cgid.identification.prediction.settings import BeamGroups, PredictionSettings
from cgid.identification.prediction.telling import warn
from cgid.recordings import is_dataset, open_recording
from cgid.recordings.chain import Chain, Statement
from cgid.recordings.recording import Blocks, Channel, require_one_rate
from cgid.recordings.site import NOWHERE, Site
from cgid.shipped import MODELS, model_path
from cgid.signals import Batch, Signal, require_stated
from cgid.units import quantity_of

if TYPE_CHECKING:
    import pandas

    from cgid.identification.training.training import Training
    from cgid.store.reading import Dataset

#: Names of the channels of each beam with several.
Groups = tuple[tuple[str, ...], ...]


_DEFAULTS = PredictionSettings()


class SupportsArray(Protocol):
    """An array, or an object that NumPy makes one of, such as a DataFrame."""

    def __array__(self, *args: Any, **kwargs: Any) -> Any: ...


#: Samples of one channel, or of one in each column.
Samples = SupportsArray | Sequence[float] | Sequence[Sequence[float]]


def load_model(model: str | Path = "default") -> Model:
    """Load a model from a file, or one that is bundled with cgid.

    Parameters
    ----------
    model : str or Path
        A file, or "default" (pulses of force) or "default-acceleration" (vibrations of a tail beam), or these in a
        version, as "default@2", which raises `NoInput` if this cgid has another; a `Path` is always a file.

    Returns
    -------
    Model

    Raises
    ------
    NoInput
        There is no such model, or the file cannot be read.
    BadData
        The file is not a valid model: its digest or one of its arrays is wrong.

    Examples
    --------
    >>> load_model("default").labels
    ('coal', 'gangue')
    """
    return read_model(model)


def read_model(model: Model | str | Path) -> StoredModel:
    """Return a model by file or name as `load_model`, or as it is, with all that predictions use."""
    if isinstance(model, Model):
        return stored(model)
    return _shipped(model) if isinstance(model, str) and model in MODELS else StoredModel.load(model_path(model))


@cache
def _shipped(name: str) -> StoredModel:
    """Return a shipped model, read once in a process; its arrays cannot be written."""
    return StoredModel.load(model_path(name))


def default_model(quantity: str | None, settings: PredictionSettings) -> str:
    """Return the name of the shipped model for a quantity; a mass implies a force."""
    return "default-acceleration" if quantity == "acceleration" and settings.mass is None else "default"


def predict(  # noqa: PLR0913 - one argument a setting, so that editors complete them
    samples: Samples | Signal | Sequence[Signal] | Batch | Dataset | str | Path,
    sampling_rate: float | None = None,
    unit: str | None = None,
    model: Model | Training | str | Path | None = None,
    *,
    sensitivity: Statement | None = None,
    gain: Statement | None = None,
    full_scale: Statement | None = None,
    site: Site | str | Path | None = None,
    costs: Mapping[str, float] | None = None,
    coverage: float | None = None,
    mass: float | None = None,
    invert: bool | None = None,
    lines: bool | None = None,
    dead_time: float | None = None,
    vote_time: float | None = None,
    same_beam: BeamGroups | None = None,
) -> pandas.DataFrame:
    """Identify the material of every impact in a recording or an array of samples.

    Parameters
    ----------
    samples : str, Path, Signal, list of Signal, Batch, Dataset, or array_like (n_samples,) or (n_samples, n_channels)
        A recording, which is read into memory, or the path of a dataset. Signals are channels of one
        length, with their rate, unit and names. A batch or dataset has one impact a signal. An array is in `unit`; the
        columns of a DataFrame name its channels, else they are numbered from 1. Samples of a recording or an array that
        are not finite are no reading.
    sampling_rate : float, optional
        [Hz]; required for an array, and for a file that does not state it. Where a file states another one, this is
        used, with a warning; one that contradicts an object is refused.
    unit : str, optional
        One of `cgid.units.UNITS`, such as "N", "kN", "g", "m/s^2" or "V"; required likewise.
    model : Model, Training, str or Path, optional
        A model, or an argument of `load_model`; by default the shipped one for this quantity.
    sensitivity, gain, full_scale : str, float, mapping or list, optional
        Conversion of volts, coulombs or integers to the measured quantity, such as ``sensitivity="10.2 mV/g"``; as
        in `cgid.open_recording`. A `full_scale` may include the unit.
    site : Site, str or Path, optional
        A site, or its file, which states what the other arguments do not, the model, and the names of channels.
    costs : mapping of str to float, optional
        Cost of missing each label, by default 1: ``{"gangue": 3.0}``. The label is that of the lowest expected cost.
    coverage : float, optional
        Fraction of prediction sets that contain the truth; the label is "unknown" unless its set is one label.
    mass : float, optional
        Mass of an accelerated impactor [kg], which turns an acceleration into a force.
    invert : bool, optional
        Whether pulses point downwards.
    lines : bool, optional
        Whether tones of machines are taken out, see `cgid.identification.prediction.PredictionSettings`.
    dead_time : float, optional
        Time after an impact in which no other begins [s].
    vote_time : float, optional
        Windows vote over this time [s].
    same_beam : str, or sequence of str or of sequences of str, optional
        Channels of one beam, whose answers for an impact are one row: ``"1+2"``, ``["1+2", "3+4"]``. By default those
        of the site.

    Returns
    -------
    DataFrame
        One row for each impact (or window, by the model), in order of time, with the columns of `cgid predict`:
        `channel`, `time_s`, `label`, one `p_LABEL` for each label of the model, `novelty` (above 1 the label is
        "unknown"), `overlapping`, `clipped`, `cut_off`, `problem`. Windows also have `end_s`, and a coverage adds
        `prediction_set`. Without impacts it has no rows. A batch or dataset has one row for each signal, with its
        `index` instead of a channel, and its label, if known, as `truth`. `attrs["units"]` has the unit of each column,
        and `attrs["findings"]` what was found of the recording, in order of time, with the keys of a line of kind
        `finding` (docs/reference/lines.md).

    Warns
    -----
    FindingWarning
        Each finding that is no note: what is wrong with the recording, a channel or a sensor, once; its record is
        `finding`. The logger "cgid" gets the same lines, and the notes.

    Raises
    ------
    BadData
        No samples are finite, they have another shape, are of another quantity than the model's, Signals differ in
        length or rate, or a file cannot be read as a recording.
    InvalidValue
        The sampling rate, the unit, the sensitivity or a setting is invalid.
    MissingOption
        The sampling rate or the unit is not known, or volts have no sensitivity.
    NoInput
        There is no such file or model.

    Examples
    --------
    An impact of 8 kN, half a sine of 0.4 ms, in 10 ms of noise.

    >>> import numpy as np
    >>> time = np.arange(2000) / 200e3
    >>> blow = 8e3 * np.sin(np.pi * np.clip((time - 4e-3) / 0.4e-3, 0, 1)) ** 1.5
    >>> table = predict(blow + np.random.default_rng(0).normal(0, 50, 2000), 200e3, "N")
    >>> list(table.columns[:5]), len(table), round(float(table["time_s"][0]), 4)
    (['channel', 'time_s', 'label', 'p_coal', 'p_gangue'], 1, 0.004)

    A recording:

    >>> from cgid import shipped
    >>> len(predict(shipped.path_of("datasets", "sample.csv")))
    6
    """
    given: dict[str, Any] = {"costs": costs, "coverage": coverage, "mass": mass, "invert": invert, "lines": lines}
    given |= {"dead_time": dead_time, "vote_time": vote_time, "same_beam": same_beam}
    settings = {name: value for name, value in given.items() if value is not None}
    place = NOWHERE if site is None else Site.of(site)
    stated = {**place.settings, **settings} if site else settings
    applied = PredictionSettings(**stated) if stated else _DEFAULTS
    model = place.get("model") if model is None and site else model
    model = cast("Model | str | Path | None", getattr(model, "model", model))  # of a Training
    if model is not None and not isinstance(model, Model | str | Path):
        raise InvalidValue(f"model must be a Model, a Training or the name or path of a model, got {model!r:.60}")
    if isinstance(samples, str | Path) and is_dataset(samples):
        from cgid.store.reading import Dataset

        samples = Dataset(samples)
    if isinstance(samples, Batch) or hasattr(samples, "batches"):
        require_stated(samples, sampling_rate, unit)
        if any(one is not None for one in (sensitivity, gain, full_scale)):
            raise InvalidValue(
                "sensitivity, gain and full_scale are for recordings, a batch states its unit; leave them out"
            )
        return _of_batches(samples, model, applied)
    if isinstance(samples, str | Path):
        chain: dict[str, Any] = {"sensitivity": sensitivity, "gain": gain, "full_scale": full_scale}
        recording = open_recording(samples, sampling_rate=sampling_rate, unit=unit, site=place, **chain)
        channels, beams, source = [*recording.channels], recording.beams, recording.source
        rate, columns = recording.sampling_rate, recording.samples()
        read = [Finding(kind="reading", fields={"text": one}) for one in recording.messages]
    else:
        stated_rate = place.get("rate") if sampling_rate is None and site else sampling_rate
        chain_of = Chain.of(sensitivity, gain, full_scale)
        channels, columns, rate, source, beams = _measured(samples, stated_rate, unit, chain_of, place)
        read = []
    if "same_beam" not in settings and beams != applied.same_beam:
        applied = replace(applied, same_beam=beams)
    loaded = read_model(default_model(channels[0].quantity, applied) if model is None else model)
    watched = columns.shape[1] / rate >= applied.blinded_after  # in a shorter recording no channel is blind
    pipeline = Pipeline(loaded, channels, rate, applied, source, watched=watched)
    if read:
        warn(pipeline.findings.tell(read), source, len(channels), stacklevel=3)
    answers = list(answers_with_warnings(pipeline, [columns]))
    table = _table(answers, loaded, applied)
    found = pipeline.findings.in_order if pipeline.findings.all else []
    table.attrs["findings"] = [one.content() for one in found if not one.is_of_fraction]
    return table


def _measured(
    samples: Any, sampling_rate: float | None, unit: str | None, chain: Chain, site: Site
) -> tuple[list[Channel], NDArray[Any], float, str, Groups]:
    """Return channels, samples (n_channels, n_samples), rate and source of an array or Signals, and those of each beam.

    Samples are of the measured quantity; those that are not finite are no reading.
    """
    listed = [samples] if isinstance(samples, Signal) else samples
    one = listed[0] if isinstance(listed, list | tuple) and listed else None
    if isinstance(one, Batch | str | Path) or hasattr(one, "batches") or hasattr(listed, "__next__"):
        raise InvalidValue(
            f"samples: a list must be of Signals, got a {type(samples if one is None else one).__name__}; give one "
            "Batch, Dataset or path a call"
        )
    source, largest = "samples", None
    of_signals = isinstance(listed, list | tuple) and any(isinstance(one, Signal) for one in listed)
    if of_signals:
        signals = _require_alike(listed, sampling_rate)
        rate, source, columns = signals[0].sampling_rate, signals[0].source, np.stack([one.samples for one in signals])
        names, units = [one.channel for one in signals], [one.unit for one in signals]
    else:
        rate = validation.require_rate(validation.given_rate(samples, sampling_rate))
        columns, names = _columns(samples)
        units = [None] * len(names)
        unit = site.get("unit") if unit is None and site is not NOWHERE else unit
        if unit is None and chain == Chain():
            raise MissingOption("samples: an array has no unit; give it, as in unit='N' or unit='m/s^2'")
        if columns.dtype.kind != "f":
            from cgid.recordings.variables import full_scale_of

            largest = full_scale_of(columns.dtype)
    contents = Blocks(
        n_channels=len(names),
        read=lambda length, channels: iter(()),
        names=names,
        units=units,
        full_scales=[largest] * len(names),
        integers=[largest is not None] * len(names),
    )
    if not of_signals and site is not NOWHERE:  # Signals were read by a site, or state all of it
        contents, chain = site.applied(contents, chain, source)
        names = [contents.label(k) for k in range(len(names))]
    links = chain.links(contents, range(len(names)), unit, source)
    channels = [Channel(name=name, unit=link.unit) for name, link in zip(names, links, strict=True)]
    columns = columns if columns.dtype in (np.float32, np.float64) else columns.astype(np.float64)
    if any(link.factor != 1 for link in links):
        with np.errstate(over="ignore"):  # what is infinite is no reading
            columns = np.stack([row * link.factor for row, link in zip(columns, links, strict=True)])
    return channels, columns, rate, source, () if site is NOWHERE else site.beams(contents, source)


def _columns(samples: Any) -> tuple[NDArray[Any], list[str]]:
    """Return samples (n_samples,) or (n_samples, n_channels) as (n_channels, n_samples), and the channels' names."""
    names = getattr(samples, "columns", None)
    columns = validation.plain("samples", samples)
    if columns.dtype.kind not in "fiu":
        raise BadData(f"samples must be real numbers, got type {columns.dtype}")
    if columns.ndim == 1:
        columns, names = columns[:, np.newaxis], None
    if columns.ndim != 2 or not columns.size:
        raise BadData(f"samples must be (n_samples,) or (n_samples, n_channels), got shape {columns.shape}")
    if columns.shape[1] > columns.shape[0]:
        raise BadData(
            f"samples must be (n_samples, n_channels), got shape {columns.shape} with more channels than samples; "
            "one impact a row? give a cgid.Batch, which needs no labels; one channel a row? transpose them"
        )
    labels = range(1, columns.shape[1] + 1) if names is None else names
    return np.ascontiguousarray(columns.T), [str(label) for label in labels]


def _require_alike(signals: Sequence[Any], sampling_rate: float | None) -> list[Signal]:
    """Return Signals as channels of one recording; raises `BadData` unless they have one length and rate."""
    for one in signals:
        if not isinstance(one, Signal):
            raise BadData(f"samples must be Signals or an array, got a {type(one).__name__} among Signals")
    first = signals[0]
    rate = first.sampling_rate
    for one in signals:
        require_stated(one, sampling_rate)
        require_one_rate((rate, first.name), (one.sampling_rate, one.name), one.source, SAME_RATE)
        if len(one.samples) != len(first.samples):
            raise BadData(
                f"{one.name}: Signals must be channels of one length, got {len(one.samples)} samples after "
                f"{len(first.samples)} of {first.name}; predict each separately"
            )
    channels = [one.channel for one in signals]
    names = channels if len(set(channels)) == len(channels) else [one.name for one in signals]
    return [replace(one, sampling_rate=rate, channel=name) for one, name in zip(signals, names, strict=True)]


def _of_batches(samples: Any, model: Model | str | Path | None, settings: PredictionSettings) -> pandas.DataFrame:
    """Return one row for each signal of a batch or dataset: its number, answer and true label, but no channel."""
    loaded = read_model(default_model(quantity_of(samples.unit), settings) if model is None else model)
    settings.check(loaded)
    batches = [samples] if isinstance(samples, Batch) else samples.batches()
    answers: list[Answer] = []
    truths: list[str] = []
    for batch, answers_of_batch in identify_batches(batches, loaded, settings, str(getattr(samples, "path", "batch"))):
        answers += answers_of_batch
        truths += batch.labels.tolist()
    table = _table(answers, loaded, settings).drop(columns="channel")
    table.insert(0, "index", np.arange(len(table)))
    if any(truths):
        table["truth"] = np.array(truths, object)
    table.attrs["units"] = {name: table.attrs["units"].get(name, "") for name in table}
    return table


def _table(answers: Sequence[Answer], model: StoredModel, settings: PredictionSettings) -> pandas.DataFrame:
    import pandas as pd

    rows = [one.row for one in answers]
    dtypes, units = {}, {}
    for column in answer_columns(model, settings):
        dtypes[column.title], units[column.title] = column.dtype.replace("string", "object"), column.unit
    table = pd.DataFrame(
        {title: pd.Series([row.get(title) for row in rows], dtype=dtype) for title, dtype in dtypes.items()}
    )
    table.attrs["units"] = units
    return table
