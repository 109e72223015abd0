"""Options of the model and of what it decides, its settings, and warnings about it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid.cli.options import MODEL, PATH, SECONDS, options_of
from cgid.cli.output import warn
from cgid.cli.reading import READING, ReadingOptions, beam_words, same_beam_option

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import PredictionSettings
    from cgid.identification.training.manifest import Manifest
    from cgid.recordings.recording import Channel


#: Options for the model and its settings, as arguments of `settings_of`.
answering_options = options_of(
    click.option(
        "--model",
        "model_path",
        type=MODEL,
        help="Use this model: a file, or a shipped one such as default-acceleration; by default chosen by the unit.",
    ),
    click.option(
        "--mass", type=float, help="Set the mass of the accelerated impactor [kg]: force = mass x acceleration."
    ),
    click.option("--drop-height", type=float, help="Set the drop height of the rocks [m], for a model that needs it."),
    click.option(
        "--miss-cost",
        "costs",
        multiple=True,
        metavar="LABEL=COST",
        help="Set the cost of missing this label, by default 1.",
    ),
    click.option(
        "--coverage",
        type=float,
        help="Reject impacts whose prediction set at this coverage (0.9) is not a single label.",
    ),
    click.option(
        "--class-conditional", is_flag=True, help="Guarantee the coverage for each label, not only for their mixture."
    ),
    click.option(
        "--vote",
        "vote_time",
        type=float,
        help="Set the time over which windows vote [s], by default 0.5; with 0, no vote.",
    ),
    click.option(
        "--sensor",
        "sensors",
        multiple=True,
        metavar="NAME",
        help="Name the sensor among those of the model's reference runs; once, or once per channel.",
    ),
    same_beam_option,
    click.option(
        "--lines/--no-lines",
        default=None,
        help="Remove machine tones from accelerations of a beam from the first sample on, or keep them; by default "
        "they are removed once they are detected, after two seconds.",
    ),
    click.option(
        "--window", "share_time", type=float, help="Set the window of the gangue fraction [s], by default 10."
    ),
    click.option(
        "--gangue", multiple=True, metavar="LABEL", help="Count this label as gangue; repeat the option for several."
    ),
    click.option(
        "--dilution-cost",
        type=float,
        help="Set the cost of drawn gangue in units of lost coal, by default 1; it decides when to shut.",
    ),
    click.option(
        "--cost-late",
        type=float,
        help="Set the loss of each second of drawing above the limit, for each unit of fraction above, by default 1.",
    ),
    click.option(
        "--cost-early",
        type=float,
        help="Set the loss of each second shut below the limit, for each unit of fraction below, by default 6.",
    ),
    click.option(
        "--hold", type=float, help="Hold SHUT or OPEN for at least this time [s], by default the length of the window."
    ),
    click.option(
        "--coal-until",
        type=SECONDS,
        metavar="TIME",
        help="State that only coal falls for this long (30s) at the beginning; the gangue fraction is then "
        "that of this seam.",
    ),
    click.option(
        "--cycle-pause",
        type=SECONDS,
        metavar="TIME",
        help="Start a new caving cycle at the first impact after a pause of this length (120s); with --coal-until.",
    ),
    click.option(
        "--labelled",
        type=PATH,
        metavar="TABLE",
        help="Use what this manifest or table of events labels coal in the recording, instead of --coal-until; some "
        "lumps labelled gangue make the fraction sharper, beside either.",
    ),
    click.option(
        "--trained-seam",
        is_flag=True,
        help="State that the seam is like that of the model's training: its coal and gangue, their sizes "
        "and drop heights.",
    ),
    click.option(
        "--blind-after",
        type=float,
        help="Call a support blind, and withdraw its decision, after this long without valid samples [s], "
        "by default 5.",
    ),
    click.option(
        "--give-up", type=float, help="End when no channel has been readable for this long [s]; by default go on."
    ),
)


def settings_with_coal(
    settings: PredictionSettings, labelled: Manifest, recording: str, channels: Sequence[Channel], model: StoredModel
) -> PredictionSettings:
    """Return settings with the spans of a recording that a manifest labels coal, and gangue if the model uses it."""
    from cgid.identification.training.manifest import labelled_in

    names, needs_coal = [channel.name for channel in channels], settings.coal_until is None
    given = labelled, recording, names, model.labels, settings.shares.gangue
    coal, lumps = labelled_in(*given, needs_coal=needs_coal)
    uses_lumps = model.seams is not None and model.seams.sharpened is not None
    return replace(settings, coal=coal, lumps=lumps if uses_lumps else ())


def settings_of(
    reading: ReadingOptions, *, model_path: str | None, costs: tuple[str, ...], **given: Any
) -> tuple[Models, PredictionSettings]:
    """Return the models and the settings; `given` are the other fields of the settings."""
    from cgid.identification.prediction import PredictionSettings

    settings = PredictionSettings(
        costs=dict(_cost(text) for text in costs), dead_time=reading.dead_time, invert=reading.invert, **given
    )
    return Models(model_path, settings), settings


def _cost(text: str) -> tuple[str, float]:
    """Return label and cost of LABEL=COST."""
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--miss-cost must be LABEL=COST such as gangue=3, got {text!r}") from None


def prediction_by(path: Path, model: StoredModel, manifest: Manifest | None, reading: ReadingOptions) -> str:
    """Return the command for predictions by a new model, on a recording that is read like all of its manifest."""
    words, own = [], {**vars(reading), **reading.chain_of("")}
    flags = {"sampling_rate": "rate", "milliseconds": "dead-time", "full_scale": "full-scale"}
    fields = {"channel": "channels", "gain": "recording_gain"}
    rows = [] if manifest is None else [one for one in manifest.annotations if not one.reference]
    for name in READING:
        stated = {getattr(one, fields.get(name, name), None) or getattr(one, name, None) or own[name] for one in rows}
        value = stated.pop() if len(stated) == 1 else None
        for part in value if isinstance(value, tuple) else (value,) if value else ():
            text = f"{part:.12g}" if isinstance(part, float) else f"{part}"
            words += [f"--{flags.get(name, name)}", *([] if part is True else [text])]
    return shlex.join(["cgid", "predict", "FILE", *words, "--model", str(path), *beam_words(model.same_beam)])


class Models:
    """The given model; else the default model of each quantity, loaded when a signal needs it."""

    def __init__(self, path: str | None, settings: PredictionSettings) -> None:
        self._path, self._settings = path, settings
        self._models: dict[str | None, StoredModel] = {}
        self._one_for_all = path is not None or settings.mass is not None or settings.drop_height is not None
        if self._one_for_all:
            self.of(None)

    def of(self, quantity: str | None) -> StoredModel:
        """Return the model for signals of a quantity."""
        key = self.key(quantity)
        if key not in self._models:
            from cgid.identification.prediction.prediction import default_model, read_model

            model = read_model(default_model(key, self._settings) if self._path is None else self._path)
            self._settings.check(model)
            self._models[key] = model
        return self._models[key]

    def key(self, quantity: str | None) -> str | None:
        """Return what signals that share a model have in common: their quantity, unless one model is for all."""
        return None if self._one_for_all else quantity

    @property
    def expects_acceleration(self) -> bool:
        """Whether the given model is one of acceleration."""
        return self._one_for_all and self.of(None).quantity == "acceleration"

    def name(self, model: StoredModel) -> str:
        """Return the file name of a model, or which default model it is."""
        if self._path is not None:
            return Path(self._path).name
        return "default model" + (" that knows the drop height" if model.known else f" of {model.quantity}")


def warn_of_model(
    source: str,
    name: str,
    sampling_rate: float,
    model: StoredModel,
    settings: PredictionSettings,
    channels: Sequence[str] = (),
) -> None:
    """Warn if a model was not trained for the sampling rate [Hz] of a signal, or needs its sensor or its channels."""
    if beams := untold_beams(model, channels, settings.same_beam):
        warn(
            f"{source}: the model was trained with channels of one beam together; give {shlex.join(beams)}, or the "
            "channels that this recording has on one beam"
        )
    if model.sensors and not settings.sensors:
        known = ", ".join(model.sensors)
        warn(
            f"{source}: the model corrects the responses of known sensors only; give --sensor NAME if this is one of "
            f"{known}"
        )
    if model.beam is not None and not model.beam.beam.region.any():
        warn(
            f"{source}: the model is of modes of one place: only impacts there are identified; for impacts anywhere "
            "tap a grid of places (cgid tap --taps places.csv --sensor X,Y), and train on that scene"
        )
    if model.is_of_few:
        warn(
            f"{source}: the model knows few recordings of each label; its probabilities are valid for recordings like "
            "those; expect lower accuracy on another day"
        )
    warn_of_chance(model, f"{source}: ", settings.shares.gangue)
    if not model.covers(sampling_rate):
        warn(f"{name}: sampled at {sampling_rate:g} Hz, the model was trained at {model.rates_text}")


def untold_beams(model: StoredModel, channels: Sequence[str], given: Sequence[Any]) -> list[str]:
    """Return the options that name the channels of a beam, as in the training, where several channels lack them."""
    if given or not model.same_beam or len(channels) < 2:
        return []
    is_known = all(set(beam.split("+")) <= set(channels) for beam in model.same_beam)
    n = min(len(model.same_beam[0].split("+")), len(channels))
    beams = model.same_beam if is_known else ("+".join(str(number) for number in range(1, n + 1)),)
    return beam_words(beams)


def warn_of_chance(model: StoredModel, source: str = "", gangue: Sequence[str] = ("gangue",)) -> None:
    """Warn if a model is not shown to be better than chance."""
    from cgid.identification.prediction.fraction import unproven

    if reason := unproven(model, gangue):
        warn(
            f"{source}the model is not shown to be better than chance, so neither SHUT nor OPEN follows from it: "
            f"{reason}; label impacts of more recordings"
        )
