"""The commands that help with a finding."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cgid._lib.validation import rates_agree
from cgid.cli.reading import as_keys, beam_words
from cgid.identification.prediction.diagnosis import Diagnosis, spellings
from cgid.identification.prediction.findings import Finding, InWords, words
from cgid.units import UNITS

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel

#: The shipped scene with a beam, and its sampling rate [Hz], which recordings for its calibration must have.
SCENE, SCENE_RATE = "tail_beam", 25_600.0
#: The scene with the same beam where rocks bounce and ring into each other, as where fewer impacts than this are alone.
STREAM_SCENE, _ALONE = "caving", 0.8
#: Name of a scene that the user has to write first.
OWN_SCENE = "YOUR_BEAM.toml"
#: Minimum number of impacts to calibrate a scene, and to train on one recording (in blocks of its time, with two
#: labels).
CALIBRATED, _TRAINED = 20, 16
#: Tolerance of an amplitude for a unit [decades]: it is estimated to a third of a decade.
_SAME_UNIT = 0.35
#: Factor from which on a unit may be the cause.
_FAR = 3.0


class NextSteps:
    """Add the commands that help to findings of a recording."""

    # `source` is the file as the next commands name it; `options` are those that all commands need to read it,
    # `answering` those of `cgid predict` alone, such as `--model mine.npz`; `channels` are all of the recording, and
    # `labelled`: whether the file is a dataset.

    def __init__(
        self,
        diagnosis: Diagnosis,
        sampling_rate: float,
        source: str,
        options: Sequence[str] = (),
        answering: Sequence[str] = (),
        *,
        channels: Sequence[str] = (),
        labelled: bool = False,
    ) -> None:
        self._diagnosis, self._rate, self._source = diagnosis, sampling_rate, source
        self._options, self._answering = tuple(options), tuple(answering)
        self._labelled, self._all_channels = labelled, tuple(channels)
        #: The options that name the channels of a beam.
        self._beams = [word for pair in pairwise(answering) if pair[0] == "--same-beam" for word in pair]

    @property
    def model(self) -> StoredModel:
        """The model of the predictions."""
        return self._diagnosis.model

    def of(self, finding: Finding) -> Finding:
        """Return a finding with the commands that help, the first way and an alternative."""
        named = () if finding.is_over else words()[finding.kind].get("ways", ())
        ways = [getattr(self, f"_{way}")(finding) for way in named]
        first, second = ([way for way in ways if way] + [(), ()])[:2]
        is_enough = not ways or first or self.model.subject == "window" or self._has_usable(CALIBRATED, finding)
        fields = {
            **finding.fields,
            "correct_rate": self._correction("--rate"),
            "lacking": "" if is_enough else f"; record {CALIBRATED} clear impacts or more for that",
        }
        return replace(finding, commands=first, instead=second, fields=fields)

    # -- ways -------------------------------------------------------------------------------------------

    def _same_beam(self, finding: Finding) -> tuple[str, ...]:
        return (self._predict(*beam_words(finding.fields["beam"].splitlines())),)

    def _rate_of(self, finding: Finding) -> tuple[str, ...]:
        return () if self._labelled else (self._predict("--rate", f"{finding.fields['true_rate']:g}"),)

    def _coal(self, _: Finding) -> tuple[str, ...]:
        """Return the command that states coal, shorter than recordings with so many impacts."""
        stated = {"--coal-until", "--labelled"} & {*self._answering}
        return () if stated else (self._predict("--coal-until", "10s"),)

    def _calibration(self, finding: Finding) -> tuple[str, ...]:
        return self._calibrated(finding, is_of_scene=False)

    def _calibration_of_beam(self, finding: Finding) -> tuple[str, ...]:
        is_of_beam = self.model.beam is not None and not self._labelled
        return self._calibration(finding) if is_of_beam else ()

    def _calibration_of_scene(self, finding: Finding) -> tuple[str, ...]:
        return self._calibrated(finding, is_of_scene=self._is_of_shipped_beam)

    @property
    def _is_of_shipped_beam(self) -> bool:
        """Whether the modes of the model are near those of the shipped one, and so its scene suits."""
        from cgid.identification.prediction.prediction import read_model

        beams = [one.beam for one in (self.model, read_model("default-acceleration"))]
        own, shipped = (np.empty(0) if one is None else one.beam.modes.frequency for one in beams)
        return own.shape == shipped.shape and bool(np.allclose(own, shipped, rtol=0.03))

    def _predict(self, *more: str) -> str:
        options = _without([*self._options, *self._answering], more)
        return shlex.join(["cgid", "predict", self._source, *options, *more])

    def _predict_with(self, model: str, finding: Finding) -> str:
        """Return the command for a model made here, without options for the former one."""
        is_for_all = self.model.together > 1 or self._diagnosis.channels.keys() >= set(self._all_channels)
        options = self._options if is_for_all else self._for_rows(finding)  # others may be of another quantity
        return shlex.join(["cgid", "predict", self._source, *options, *self._beams, "--model", model])

    def _invert(self, finding: Finding) -> tuple[str, ...]:
        """Return the command that inverts the signal, for the channels that need it."""
        options = [*self._options, *self._answering]
        channels = self._diagnosis.channels
        if channels.keys() - set(finding.channels) and self.model.together == 1:
            names = [name for name in channels if name in finding.channels]
            options = _without(options, ("--channel",)) + [word for name in names for word in ("--channel", name)]
        turn = ("--set", "invert=true")
        places = [at for at, pair in enumerate(pairwise(options)) if pair == turn]
        words = [] if places else [*turn]
        for at in places:
            options = [*options[:at], *options[at + 2 :]]
        return (shlex.join(["cgid", "predict", self._source, *options, *words]),)

    def _unit(self, finding: Finding) -> tuple[str, ...]:
        """Return the command with the unit that undoes the factor of the scale; none if no unit does."""
        given = dict(pairwise(self._options)).get("--unit", "")
        units = UNITS[self.model.quantity]
        is_far = max(finding.factor, 1 / finding.factor) >= _FAR
        if given not in units or self._is_converted("--unit") or not is_far:
            return ()
        wanted = units[given] / finding.factor
        away = {unit: abs(np.log10(wanted / units[unit])) for unit in spellings(self.model.quantity)}
        nearest = min(away, key=lambda unit: away[unit])
        return (self._predict("--unit", nearest),) if away[nearest] < _SAME_UNIT else ()

    def _correction(self, flag: str) -> str:
        """Return how to correct a value: by the option, or in the file, whose unit no option may contradict."""
        if self._is_converted(flag):
            flag = "--sensitivity"
        is_open = flag in self._options or (flag == "--rate" and not self._labelled)
        return f"correct it with {flag}" if is_open else "correct it in the file"

    def _is_converted(self, flag: str) -> bool:
        """Return whether a flag is the unit of volts, which a sensitivity converts."""
        return flag == "--unit" and "--sensitivity" in self._options

    def _for_rows(self, finding: Finding) -> tuple[str, ...]:
        """Return the options to read what gives one row: channels of a beam that were named, else one channel."""
        return self._options if self._beams else self._for_one(finding)

    def _for_one(self, finding: Finding) -> tuple[str, ...]:
        """Return the options to read one channel, of those of a finding: that with the most usable impacts."""
        if len(self._all_channels) < 2:
            return self._options
        best = self._best(finding)
        # Channels used together have one name.
        name = next((one for one in self._all_channels if best == one or best.startswith(f"{one}+")), best)
        return (*_without(self._options, ("--channel",)), "--channel", name)

    def _best(self, finding: Finding) -> str:
        channels = self._diagnosis.channels
        own = [name for name in channels if finding.concerns(name)] or channels
        return max(own, key=lambda name: channels[name].n_usable)

    def _has_usable(self, n_impacts: int, finding: Finding) -> bool:
        return self._labelled or self._diagnosis.channels[self._best(finding)].n_usable >= n_impacts

    def _training(self, finding: Finding) -> tuple[str, ...]:
        """Return the steps to train a model on this recording; none if it is too short."""
        if self.model.subject == "window" and not self._labelled:
            return self._training_on_windows(finding)
        if not self._has_usable(_TRAINED, finding):
            return ()
        model = _unused("mine", ".npz")
        if self._labelled:
            return (shlex.join(["cgid", "train", self._source, "-o", model]), self._predict_with(model, finding))
        options, table = list(self._for_rows(finding)), _unused("events", ".csv")
        if self.model.quantity == "level" and "--unit" not in options:
            options += ["--unit", "FS"]
        kept = ("--site", "--set")
        stated = [word for pair in pairwise(options) if pair[0] in kept for word in pair]
        return (
            shlex.join(["cgid", "events", self._source, *options, *self._beams, "-o", table]),
            InWords(f"fill in the label column of {table}"),
            shlex.join(["cgid", "train", table, *stated, "-o", model]),
            self._predict_with(model, finding),
        )

    def _training_on_windows(self, finding: Finding) -> tuple[str, ...]:
        """Return the steps to train a model on parts of this recording; none if train cannot read it."""
        table, model = _unused("parts", ".csv"), _unused("mine", ".npz")
        return (
            InWords(
                f"write {table} with the columns path, start_s, end_s and label, a row for each part of the recording"
            ),
            shlex.join(["cgid", "train", table, *as_keys(self._options, self._source), "--by", "window", "-o", model]),
            self._predict_with(model, finding),
        )

    def _calibrated(self, finding: Finding, *, is_of_scene: bool) -> tuple[str, ...]:
        """Return the steps to calibrate this recording's beam; none if the shipped scene does not suit."""
        if not self._has_usable(CALIBRATED, finding) or not rates_agree(self._rate, SCENE_RATE):
            return ()
        name = _unused("site", ".toml", "-modes.csv", ".npz")
        # From another beam the modes of the shipped one are sought for minutes in vain.
        channels = self._diagnosis.channels.values()
        alone = sum(one.n_usable for one in channels) >= _ALONE * sum(one.n_answers for one in channels)
        scene = OWN_SCENE if not is_of_scene else SCENE if alone else STREAM_SCENE
        given = as_keys(self._for_one(finding), self._source)
        return (
            *(() if is_of_scene else [InWords(f"write {scene}, a scene with the size and sensor of your beam")]),
            shlex.join(["cgid", "calibrate", self._source, *given, "--scene", scene, "-o", f"{name}.toml"]),
            f"cgid train {name}.toml -o {name}.npz",
            self._predict_with(f"{name}.npz", finding),
        )


def _unused(stem: str, *endings: str) -> str:
    """Return an unused file name, or one for several files without suffixes."""
    names = chain([stem], (f"{stem}_{number}" for number in count(2)))
    name = next(one for one in names if not any(Path(one + ending).exists() for ending in endings))
    return name + endings[0] if len(endings) == 1 else name


def _without(options: Sequence[str], dropped: Sequence[str]) -> list[str]:
    """Return the options, pairs of flag and value or flags alone, without the flags in `dropped`."""
    remaining: list[str] = []
    flag = ""
    for option in options:
        flag = option if option.startswith("--") else flag
        if flag not in dropped:
            remaining.append(option)
    return remaining
