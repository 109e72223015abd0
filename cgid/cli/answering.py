"""Options of the model and of what it decides, and its settings."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid.cli.options import MODEL
from cgid.cli.output import warn
from cgid.cli.reading import ReadingOptions, beam_words
from cgid.cli.site import site_words

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import PredictionSettings
    from cgid.identification.training.manifest import Manifest
    from cgid.recordings.recording import Channel


model_option = click.option(
    "--model", "model_path", type=MODEL, help="Model: a file, or a shipped one; by default chosen by the unit."
)


def settings_with_coal(
    settings: PredictionSettings, labelled: Manifest, recording: str, channels: Sequence[Channel], model: StoredModel
) -> PredictionSettings:
    """Return settings with the spans of a recording that a manifest labels coal, and gangue if the model uses it."""
    from cgid.identification.training.manifest import labelled_in

    names, needs_coal = [channel.name for channel in channels], settings.coal_until is None
    given = labelled, recording, names, model.labels, settings.shares.gangue
    coal, lumps = labelled_in(*given, needs_coal=needs_coal)
    uses_lumps = model.seams is not None
    return replace(settings, coal=coal, lumps=lumps if uses_lumps else ())


def settings_of(reading: ReadingOptions, model_path: str | None, **given: Any) -> tuple[Models, PredictionSettings]:
    """Return the models and the settings, by the line, else by the site; `given` are fields of the settings."""
    from cgid.identification.prediction import PredictionSettings

    stated = {name: value for name, value in given.items() if value is not None}
    settings = PredictionSettings(dead_time=reading.dead_time, **{**reading.site.settings, **stated})
    return Models(model_path or reading.site.get("model"), settings), settings


#: What a row of a manifest states of its recording: the field, and the option or else the key of a site that states it.
_STATED = {
    "sampling_rate": "--rate",
    "unit": "--unit",
    "channels": "--channel",
    "variable": "variable",
    "format": "format",
    "invert": "invert",
    "sensitivity": "--sensitivity",
    "recording_gain": "gain",
    "full_scale": "--full-scale",
}


def prediction_by(path: Path, model: StoredModel, manifest: Manifest | None, reading: ReadingOptions) -> str:
    """Return the command for predictions by a new model, on a recording that is read like all of its manifest."""
    own = {**vars(reading), **reading.chain_of(""), "channels": reading.channel}
    words, rows = site_words()[0], [] if manifest is None else manifest.annotations
    if not reading.site.path and len(sites := {one.site for one in rows}) == 1 and (site := sites.pop()):
        words = ["--site", site, *words]
    for name, stating in _STATED.items():
        stated = {getattr(one, name) or (one.gain if name == "recording_gain" else own.get(name)) for one in rows}
        value = stated.pop() if len(stated) == 1 else None
        for part in value if isinstance(value, tuple) else (value,) if value else ():
            text = f"{part:.12g}" if isinstance(part, float) else f"{part}".replace("True", "true")
            words += [stating, text] if stating.startswith("--") else ["--set", f"{stating}={text}"]
    return shlex.join(["cgid", "predict", "FILE", *words, "--model", str(path), *beam_words(model.same_beam)])


class Models:
    """The given model; else the default model of each quantity, loaded when a signal needs it."""

    def __init__(self, path: str | None, settings: PredictionSettings) -> None:
        self._path, self._settings = path, settings
        self._models: dict[str | None, StoredModel] = {}
        self._one_for_all = path is not None or settings.mass is not None
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
        return f"default model of {model.quantity}"


def warn_of_chance(model: StoredModel, source: str = "", gangue: Sequence[str] = ("gangue",)) -> None:
    """Warn if a model follows what sounds between the rocks, or is not shown to be better than chance."""
    from cgid.identification.prediction.telling import of_chance

    for finding in of_chance(model, gangue):
        warn(f"{source}{finding.what()}; {finding.help()}")
