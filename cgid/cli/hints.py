"""What to do if most impacts are unknown, the beam has changed or the scale is wrong: commands and texts."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain, count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cgid._lib.validation import rates_agree
from cgid.cli.answering import untold_beams
from cgid.cli.reading import as_keys
from cgid.identification.model.world import Misfit, MisfitPart
from cgid.identification.prediction.diagnosis import (
    CauseKind,
    Diagnosis,
    Hint,
    InWords,
    misfit_text,
    scale_warning,
    times,
)
from cgid.units import UNITS

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.diagnosis import ChannelFinding

#: The shipped scene with a beam, and its sampling rate [Hz], which recordings for its calibration must have.
SCENE, SCENE_RATE = "tail_beam", 25_600.0
#: The scene with the same beam where rocks bounce and ring into each other, as where fewer impacts than this are alone.
STREAM_SCENE, _ALONE = "caving", 0.8
#: Name of a scene that the user has to write first.
OWN_SCENE = "YOUR_BEAM.toml"
#: Minimum number of impacts to calibrate a scene, and to train on one recording (in blocks of its time, with two
#: labels).
CALIBRATED, _TRAINED = 20, 16
#: Tolerance of an amplitude for a unit [decades]: it is estimated to a quarter of a decade.
_SAME_UNIT = 0.3


class Hints(Diagnosis):
    """Diagnose the predictions of a recording, and suggest commands."""

    # `source` is the file as the next commands name it; `options` are those that all commands need to read it,
    # `answering` those of `cgid predict` alone, such as `--model mine.npz`; `labelled`: whether the file is a dataset.

    def __init__(
        self,
        model: StoredModel,
        sampling_rate: float,
        source: str,
        options: Sequence[str] = (),
        answering: Sequence[str] = (),
        *,
        channels: Sequence[str] = (),
        labelled: bool = False,
        live: bool = False,
    ) -> None:
        super().__init__(model, live=live)
        self._rate, self._source = sampling_rate, source
        self._options, self._answering = tuple(options), tuple(answering)
        self._labelled, self._all_channels = labelled, tuple(channels)
        self._kind = "signal" if labelled else model.subject
        #: The options that name the channels of a beam: those given, and those of the training that were not.
        self._beams = [word for pair in pairwise(answering) if pair[0] == "--same-beam" for word in pair]
        self._untold = untold_beams(model, channels, self._beams)

    def hints(self, names: Iterable[str] | None = None) -> list[Hint]:
        """Return a hint for each cause, by default of all channels; none where none has a finding."""
        return [self._hint(self._of_scale(finding)) for finding in self.findings(names)]

    def level_warning(self, factor: float) -> str:
        """Return one line on levels that differ from those of the training by a factor."""
        return scale_warning(factor, self.model)

    def misfit_warning(self, misfit: Misfit) -> str:
        """Return one line on a recording that is not like those of the training, and the command that helps first."""
        stated, steps = {"--coal-until", "--labelled"} & {*self._answering}, self._training()
        advice = "label impacts and train on them"
        match misfit.part:
            case MisfitPart.SCALE:
                advice = (
                    "check unit, sensitivity, gain and full scale; if they are right, label impacts and train on them"
                )
            case MisfitPart.BEAM if self._is_of_beam:
                advice = "learn the modes of this beam with a scene of its size, or label impacts and train on them"
            case MisfitPart.SIZES | MisfitPart.SEAM if self.model.seams is not None and not stated:
                advice = "say how long coal alone falls at first, and the gangue fraction is that of this seam"
                steps = (self._predict("--coal-until", "10s"),)  # shorter than recordings with so many impacts
            case MisfitPart.SIZES | MisfitPart.SEAM if self.model.seams is not None:
                advice = "the gangue fraction is that of this seam; for single impacts, label some and train on them"
        return f"{misfit_text(misfit, self.model)}; {advice}" + (f": {steps[0]}" if steps else "")

    def _hint(self, finding: ChannelFinding) -> Hint:
        commands, instead = self._steps(finding)
        reason, advice = self._words(finding, bool(commands or instead))
        where = (
            f"{finding.n_unknown} of {finding.n_answers} {self._kind}{'' if finding.n_answers == 1 else 's'} unknown"
        )
        return Hint(
            cause=finding.cause,
            reason=reason if finding.cause in (CauseKind.BEAM, CauseKind.CHAIN) else f"{where}: {reason}",
            advice=advice,
            commands=commands,
            instead=instead,
            channels=finding.channels,
            n_unknown=finding.n_unknown,
            n_answers=finding.n_answers,
        )

    def _of_scale(self, finding: ChannelFinding) -> ChannelFinding:
        """Return a finding, as one of amplitude if the levels of all its channels are far from the training."""
        factors = [self.far_scale(name) for name in finding.channels or self.channels]
        if finding.cause is not CauseKind.FEATURES or 1 in factors:
            return finding
        return replace(finding, cause=CauseKind.AMPLITUDE, value=float(np.median(factors)))

    # -- texts ----------------------------------------------------------------------------------------

    def _words(self, finding: ChannelFinding, has_steps: bool) -> tuple[str, str]:
        """Return reason and advice."""
        import tomllib

        model, value = self.model, finding.value
        is_enough = self._kind == "window" or self._has_usable(CALIBRATED)
        within = not finding.name or not np.isfinite(value) or finding.low <= value <= finding.high
        fields = {
            **vars(finding),
            "kind": self._kind,
            "what": "parts of recordings" if self._kind == "window" else "impacts",
            "rate": self._rate,
            "times": times(value),
            "units": ", ".join(_spellings(model.quantity)),
            "correct_rate": self._correction("--rate"),
            "correct_unit": self._correction("--unit"),
            "lacking": "" if has_steps or is_enough else f"; record {CALIBRATED} clear impacts or more for that",
            "or_order": ", or the channels are in another order" if model.together > 1 else "",
            "other_rate": ""
            if model.covers(self._rate)
            else f"; and sampled at {self._rate:g} Hz, not {model.rates_text}",
            "range": ""
            if within
            else f" (mainly {finding.name}: {value:.3g}, in the training {finding.low:.3g} to {finding.high:.3g})",
            "usual": f", {model.unexplained:.2g} % in the training" if model.unexplained else "",
        }
        key: str = finding.cause
        if finding.cause is CauseKind.NOISE and np.isnan(value):
            key = "hidden"
        elif finding.cause is CauseKind.SHAPE and self._is_of_beam:
            key = "other_beam"
        elif finding.cause is CauseKind.AMPLITUDE and finding.name:
            key = "scale"
        elif finding.cause is CauseKind.FEATURES and self._untold:
            key = "same_beam"
        found = tomllib.loads(Path(__file__).with_name("hints.toml").read_text(encoding="utf-8"))[key]
        return found["reason"].format(**fields).removesuffix(" ()"), found["advice"].format(**fields)

    @property
    def _is_of_beam(self) -> bool:
        return self.model.beam is not None and not self._labelled

    @property
    def _is_of_shipped_beam(self) -> bool:
        """Whether the modes of the model are near those of the shipped one, and so its scene suits."""
        from cgid.identification.prediction.prediction import read_model

        beams = [one.beam for one in (self.model, read_model("default-acceleration"))]
        own, shipped = (np.empty(0) if one is None else one.beam.modes.frequency for one in beams)
        return own.shape == shipped.shape and bool(np.allclose(own, shipped, rtol=0.03))

    # -- steps ----------------------------------------------------------------------------------------

    def _steps(self, finding: ChannelFinding) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the next steps, and alternatives."""
        ways: list[tuple[str, ...]]
        match finding.cause:
            case CauseKind.FEATURES if self._untold:
                ways = [(self._predict(*self._untold),)]
            case CauseKind.UPSIDE_DOWN:
                ways = [self._turned()]
            case CauseKind.SAMPLING_RATE:
                ways = [() if self._labelled else (self._predict("--rate", f"{finding.value:g}"),)]
            case CauseKind.AMPLITUDE:
                ways = [self._in_other_unit(finding.value)]
            case CauseKind.CHAIN:
                ways = [self._calibration(is_of_scene=self._is_of_shipped_beam)]
            case CauseKind.VIBRATION:
                ways = [self._as_acceleration(), self._training()]
            case CauseKind.BEAM | CauseKind.SHAPE if self._is_of_beam:
                ways = [self._training(), self._calibration(is_of_scene=False)]
            case CauseKind.SHAPE | CauseKind.FEATURES:
                ways = [self._training()]
            case _:
                ways = []
        first, second = ([way for way in ways if way] + [(), ()])[:2]
        return first, second

    def _predict(self, *more: str) -> str:
        options = _without([*self._options, *self._answering], more)
        return shlex.join(["cgid", "predict", self._source, *options, *more])

    def _predict_with(self, model: str) -> str:
        """Return the command for a model made here, without options for the former one."""
        is_for_all = self.model.together > 1 or self.channels.keys() >= set(self._all_channels)
        options = self._options if is_for_all else self._for_rows()  # others may be of another quantity
        return shlex.join(["cgid", "predict", self._source, *options, *self._beams, "--model", model])

    def _turned(self) -> tuple[str, ...]:
        """Return the command that inverts the signal, for the channels that need it."""
        options = [*self._options, *self._answering]
        turned, channels = self.upside_down, self.channels
        if channels.keys() - turned and self.model.together == 1:
            names = [name for name in channels if name in turned]
            options = _without(options, ("--channel",)) + [word for name in names for word in ("--channel", name)]
        turn = ("--set", "invert=true")
        places = [at for at, pair in enumerate(pairwise(options)) if pair == turn]
        words = [] if places else [*turn]
        for at in places:
            options = [*options[:at], *options[at + 2 :]]
        return (shlex.join(["cgid", "predict", self._source, *options, *words]),)

    def _as_acceleration(self) -> tuple[str, ...]:
        if "--unit" not in self._options or self._is_converted("--unit"):
            return ()
        options = [*_without(self._options, ("--unit",)), "--unit", "m/s^2"]
        return (shlex.join(["cgid", "predict", self._source, *options]),)

    def _in_other_unit(self, factor: float) -> tuple[str, ...]:
        """Return the command with the unit that scales the signal by this factor; none if no unit does."""
        given = dict(pairwise(self._options)).get("--unit", "")
        units = UNITS[self.model.quantity]
        if given not in units or self._is_converted("--unit"):
            return ()
        away = {unit: abs(np.log10(units[given] / units[unit] / factor)) for unit in _spellings(self.model.quantity)}
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

    def _for_rows(self) -> tuple[str, ...]:
        """Return the options to read what gives one row: channels of a beam that were named, else one channel."""
        return self._options if self._beams else self._for_one()

    def _for_one(self) -> tuple[str, ...]:
        """Return the options to read one channel: that with the most usable impacts."""
        if len(self._all_channels) < 2:
            return self._options
        best = self._best()
        # Channels used together have one name.
        name = next((one for one in self._all_channels if best == one or best.startswith(f"{one}+")), best)
        return (*_without(self._options, ("--channel",)), "--channel", name)

    def _best(self) -> str:
        channels = self.channels
        return max(channels, key=lambda name: channels[name].n_usable)

    def _has_usable(self, n_impacts: int) -> bool:
        return self._labelled or self.channels[self._best()].n_usable >= n_impacts

    def _training(self) -> tuple[str, ...]:
        """Return the steps to train a model on this recording; none if it is too short."""
        if self._kind == "window":
            return self._training_on_windows()
        if not self._has_usable(_TRAINED):
            return ()
        model = _unused("mine", ".npz")
        if self._labelled:
            return (shlex.join(["cgid", "train", self._source, "-o", model]), self._predict_with(model))
        options, table = list(self._for_rows()), _unused("events", ".csv")
        if self.model.quantity == "level" and "--unit" not in options:
            options += ["--unit", "FS"]
        kept = ("--site", "--set")
        stated = [word for pair in pairwise(options) if pair[0] in kept for word in pair]
        return (
            shlex.join(["cgid", "events", self._source, *options, *self._beams, "-o", table]),
            InWords(f"fill in the label column of {table}"),
            shlex.join(["cgid", "train", table, *stated, "-o", model]),
            self._predict_with(model),
        )

    def _training_on_windows(self) -> tuple[str, ...]:
        """Return the steps to train a model on parts of this recording; none if train cannot read it."""
        table, model = _unused("parts", ".csv"), _unused("mine", ".npz")
        return (
            InWords(
                f"write {table} with the columns path, start_s, end_s and label, a row for each part of the recording"
            ),
            shlex.join(["cgid", "train", table, *as_keys(self._options, self._source), "--by", "window", "-o", model]),
            self._predict_with(model),
        )

    def _calibration(self, *, is_of_scene: bool) -> tuple[str, ...]:
        """Return the steps to calibrate this recording's beam; none if the shipped scene does not suit."""
        if not self._has_usable(CALIBRATED) or not rates_agree(self._rate, SCENE_RATE):
            return ()
        name = _unused("site", ".toml", "-modes.csv", ".npz")
        # From another beam the modes of the shipped one are sought for minutes in vain.
        channels = self.channels.values()
        alone = sum(one.n_usable for one in channels) >= _ALONE * sum(one.n_answers for one in channels)
        scene = OWN_SCENE if not is_of_scene else SCENE if alone else STREAM_SCENE
        given = as_keys(self._for_one(), self._source)
        return (
            *(() if is_of_scene else [InWords(f"write {scene}, a scene with the size and sensor of your beam")]),
            shlex.join(["cgid", "calibrate", self._source, *given, "--scene", scene, "-o", f"{name}.toml"]),
            f"cgid train {name}.toml -o {name}.npz",
            self._predict_with(f"{name}.npz"),
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


def _spellings(quantity: str) -> list[str]:
    """Return the units of a quantity, one spelling of each."""
    first: dict[float, str] = {}
    for unit, factor in UNITS[quantity].items():
        first.setdefault(factor, unit)
    return list(first.values())
