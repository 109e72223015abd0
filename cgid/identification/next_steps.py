"""Why most answers of a recording are unknown, whether its beam has changed, and what to do next.

Each answer outside of the training says what puts it there (`Cause`). A `Diagnosis` counts the answers of a recording,
channel by channel, and gives one `Hint` where most are unknown. Every cause is tested: the impact stands barely above
the noise before it; another amplitude or another sampling rate alone would bring it inside; or one measured quantity
contributes most to its distance from the training.

A model that looks through a beam also tells where the beam has changed too little for single impacts to show it: where
it is the right one, half of the impacts leave next to nothing unexplained, however loud the noise is.
"""

from __future__ import annotations

import shlex
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cgid.errors import CgidError
from cgid.identification.events import EVENT_TIME
from cgid.measure.features import FEATURES, extract_array
from cgid.units import UNITS
from cgid.validation import UNKNOWN, Floats

if TYPE_CHECKING:
    from cgid.identification.answers import Answer
    from cgid.identification.model import Model

#: The start of a vibration, whose power is compared with that before it [s]; a vibration below this ratio of
#: amplitudes drowns.
_START_TIME, _CLEAR = 10e-3, 2.0
#: Factors of amplitude and duration that are tried; only one beyond `_FAR` times is a cause.
_SCALES, _FAR = 10.0 ** np.arange(-4.0, 4.25, 0.25), 3.0
#: A signal that falls below its baseline by this share of its peak swings both ways, which no contact force does.
_BOTH_WAYS = 0.4
#: Deviations of the training to either side that make the range of a quantity in messages.
_DEVIATIONS = 3.0
#: A live stream gets its hint when this many answers of a channel are there, and this share of them is unknown.
_ENOUGH, _CLEARLY = 20, 0.8
#: With this share unknown it is another beam rather than one that has changed, and labelled impacts are a way, too.
_ANOTHER = 0.95
#: The beam has changed where the latest impacts, so many, surely leave more than this share of their energy unexplained
#: [%] in the median; surely is by so many deviations of a median. Not less than so many times that of the training.
_LATEST, CHANGED, _SURE, _OVER_USUAL = (30, 100, 300), 0.5, 4.0, 3.0
#: Impacts from which on their levels are compared with those of the training, times as many to the next look at a live
#: stream, and the latest levels kept of a channel.
_ENOUGH_LEVELS, _NEXT_LOOK, _MOST_LEVELS = 10, 3, 10_000
#: Levels count up to so many standard deviations from their median; the upper end of n levels, their mean and standard
#: deviation together, is about this one in the training. In standard deviations of the training.
_CLIPPED, _UPPER = 2.0, 0.85
#: The upper end of n levels lies above and below that by more than sqrt(a / n + b) in less than one of 200 recordings
#: each, by simulation (benchmarks/wrong_scale.py): (a, b) above and below, for a force and for what a beam gives. Slow
#: rebounds on a beam only lower the level.
_SPREAD = {False: ((7.0, 0.10), (10.0, 0.12)), True: ((3.5, 0.05), (15.0, 0.34))}
#: Between these factors g and m/s^2 may have been confused.
_LIKE_G = (5.0, 20.0)
#: The shipped scene with a beam, and its sampling rate [Hz], which a recording to calibrate it by must have.
SCENE, SCENE_RATE = "tail_beam", 25_600.0
#: Fewest impacts that calibrate a scene, and that one recording trains on (in blocks of its time, with two labels).
CALIBRATED, _TRAINED = 20, 16
#: Decades by which an amplitude may miss the unit that explains it: it is known to a quarter of a decade.
_SAME_UNIT = 0.3
#: Share of answers without any mark from which these, and not the marks, decide on the cause.
_UNMARKED = 0.25


#: Causes that are no input or guard of a model.
_TESTED = ("noise", "drowned", "amplitude", "duration", "sampling_rate", "vibration")


@dataclass(frozen=True)
class Cause:
    """What puts an answer outside of the training.

    Attributes
    ----------
    name : an input or guard of the model; else noise, drowned, amplitude, duration, sampling_rate or vibration
    value : of the input or guard, as measured. Noise: amplitude of the impact over that before it. Drowned: the part of
        the novelty of a window that is due to noise. Amplitude and
        duration: how many times as large as those of the training. Sampling rate: the one at which the impact lies
        inside [Hz]. Vibration: how deep a pulse swings below its baseline, over its peak
    low, high : range of an input or guard in the training
    """

    name: str
    value: float
    low: float = float("nan")
    high: float = float("nan")


def causes_of(model: Model, inputs: Floats, guards: Floats) -> list[Cause]:
    """Return the cause for each row outside of the training, from inputs (n, n_inputs) and guards (n, n_guards)."""
    limits = np.array(model.guard_limits)
    amplitudes, durations = (_scale_of(model, inputs, guards, symbol) for symbol in ("U", "s"))
    foremost, (low, high), drowned = model.foremost(inputs), model.usual(_DEVIATIONS), model.drowned(inputs)
    found = []
    for row, own in enumerate(guards):
        scale, name = min((abs(np.log(x[row])), n) for x, n in ((amplitudes, "amplitude"), (durations, "duration")))
        if drowned[row] > 1:
            found.append(Cause("drowned", float(drowned[row])))
        elif own.size and (own / limits).max() > 1:
            guard = int(np.argmax(own / limits))
            found.append(Cause(model.guards[guard], float(own[guard]), 0.0, model.guard_limits[guard]))
        elif scale < np.inf:
            found.append(Cause(name, float((amplitudes if name == "amplitude" else durations)[row])))
        else:
            k = int(foremost[row])
            found.append(Cause(model.inputs[k], float(inputs[row, k]), float(low[k]), float(high[k])))
    return found


def _scale_of(model: Model, inputs: Floats, guards: Floats, symbol: str) -> Floats:
    """Return how many times as large as in the training the unit `symbol` of each row is; infinite where not that.

    It is that where a factor beyond `_FAR`, on all inputs with that unit, brings the row inside.
    """
    powers, logarithmic = _powers(model, symbol)
    if not len(inputs) or not powers.any():
        return np.full(len(inputs), np.inf)
    distances = []
    for factor in _SCALES:
        scaled = np.where(logarithmic, inputs + powers * np.log10(factor), inputs * factor**powers)
        distances.append(model.novelty(scaled, guards))
    size = 1 / _SCALES[np.argmin(distances, axis=0)]
    is_cause = (np.min(distances, axis=0) <= 1) & ((size >= _FAR) | (size <= 1 / _FAR))
    return np.where(is_cause, size, np.inf)


def _powers(model: Model, symbol: str) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the power of a unit in each input, and whether the input is a logarithm; of that, durations are ignored.

    The level of a vibration lasts as long as its window, so only pulses have durations.
    """
    names = [name.split(" of channel ")[0] for name in model.inputs]
    units = [FEATURES[name].unit if name in FEATURES else "" for name in names]
    logarithmic = np.array([unit.startswith("log10") for unit in units])
    units = ["U" if unit == "N" else unit for unit in units]  # a force that is recovered through a beam
    powers = np.array([2.0 if f"{symbol}^2" in unit else float(symbol in unit) for unit in units])
    if symbol == "s":
        powers[logarithmic] = 0.0
    return powers, logarithmic


def with_frames(
    answers: Sequence[Answer], frames: NDArray[np.floating], sampling_rate: float, model: Model, pre_trigger: int | None
) -> list[Answer]:
    """Return the answers for frames (n, n_samples), with the causes that only the samples show."""
    rows = [row for row, answer in enumerate(answers) if answer.cause is not None]
    found = list(answers)
    if not rows:
        return found
    own, causes = frames[rows], {}
    if not model.covers(sampling_rate) and not model.known:
        rate = min(max(sampling_rate, min(model.sampling_rates)), max(model.sampling_rates))
        causes = dict.fromkeys(
            np.flatnonzero(_inside(own, rate, model, pre_trigger)).tolist(), Cause("sampling_rate", rate)
        )
    if pre_trigger is not None and pre_trigger > 1:
        clear = _clearness(own, sampling_rate, pre_trigger)
        causes |= {k: Cause("noise", float(clear[k])) for k in np.flatnonzero(clear < _CLEAR).tolist()}
    elif model.kind == "pulse":
        middle = np.median(own, axis=1)
        depth = (middle - own.min(axis=1)) / np.maximum(own.max(axis=1) - middle, np.finfo(np.float64).tiny)
        causes |= {k: Cause("vibration", float(depth[k])) for k in np.flatnonzero(depth > _BOTH_WAYS).tolist()}
    for k, cause in causes.items():
        found[rows[k]] = replace(answers[rows[k]], cause=cause)
    return found


def _inside(frames: NDArray[np.floating], rate: float, model: Model, pre_trigger: int | None) -> NDArray[np.bool_]:
    """Return whether each frame would lie inside of the training at another sampling rate."""
    try:
        table = extract_array(
            frames, rate, model.measured, pre_trigger=pre_trigger, invalid="nan", detection_limit=0.0, beam=model.beam
        )
    except CgidError:  # at that rate the frames are too short for a feature
        return np.zeros(len(frames), bool)
    sound = np.asarray(np.isfinite(table).all(axis=1))
    features, guards = np.split(table[sound], [len(model.features)], axis=1)
    sound[sound] = model.novelty(features, guards) <= 1
    return sound


def _clearness(frames: NDArray[np.floating], sampling_rate: float, pre_trigger: int) -> Floats:
    """Return the amplitude at the start of each vibration over that before it, at the sensor that hears it best."""
    before = frames[..., :pre_trigger].astype(np.float64)
    middle = before.mean(axis=-1, keepdims=True)
    start = frames[..., pre_trigger : pre_trigger + max(round(_START_TIME * sampling_rate), 2)] - middle
    noise = np.sqrt(np.mean((before - middle) ** 2, axis=-1))
    signal = np.sqrt(np.mean(start**2, axis=-1))
    found = np.asarray(np.divide(signal, noise, out=np.full(noise.shape, np.inf), where=noise > 0))
    return np.asarray(found.reshape(len(frames), -1).max(axis=1))


@dataclass(frozen=True, kw_only=True)
class Hint:
    """Why most answers are unknown or the beam is not the model's, and what helps.

    Attributes
    ----------
    cause : one word for programs: noise, drowned, amplitude, duration, sampling_rate, clipped, cut_off, overlapping,
        vibration, shape, upside_down, features, coverage or unmeasured; or beam, where the beam has changed and answers
        are known
    reason : in words
    advice : what to do
    commands : the next steps, in order: commands, or words
    instead : other steps that may be taken in their place
    channels : where most answers are unknown; empty if in all
    n_unknown, n_answers : in these channels
    """

    cause: str
    reason: str
    advice: str
    commands: tuple[str, ...]
    instead: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    n_unknown: int = 0
    n_answers: int = 0

    @property
    def lines(self) -> list[str]:
        """The hint as text: why and what helps in one line, then a line for each step."""
        ways = [[f"  {number}. {step}" for number, step in enumerate(way, 1)] for way in (self.commands, self.instead)]
        between = ["  or:"] * (ways[0] != [] and ways[1] != [])
        steps = [*ways[0], *between, *ways[1]]
        return [f"{self.reason}; {self.advice}{':' * bool(steps)}", *steps]


@dataclass
class ChannelAnswers:
    """The unknown answers of a channel: how many for each cause, and for the causes of unmarked ones some examples."""

    n_answers: int = 0
    n_unmarked: int = 0
    n_unknown: int = 0
    n_usable: int = 0
    marks: Counter[str] = field(default_factory=Counter)
    unmarked: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[Answer]] = field(default_factory=dict)
    latest: float = -np.inf
    problems: Counter[str] = field(default_factory=Counter)
    unexplained: deque[float] = field(default_factory=lambda: deque(maxlen=_LATEST[-1]))
    levels: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_LEVELS))
    n_levels: int = 0

    def left(self) -> tuple[float, list[float]]:
        """Return what the median of the latest impacts surely leaves unexplained [%], and what these leave.

        Of few impacts or many, whichever leave more; not a number if there are too few.
        """
        found: list[tuple[float, list[float]]] = [(float("nan"), [])]
        for most in _LATEST if len(self.unexplained) >= _LATEST[0] else ():
            latest = list(self.unexplained)[-most:]
            # The rank of a sample that lies below the median but for a chance of 2e-5 (binomial).
            found.append((sorted(latest)[int(len(latest) / 2 - _SURE / 2 * np.sqrt(len(latest))) - 1], latest))
        return max(found[1:] or found, key=lambda one: one[0])


#: Most examples kept of each cause.
_MOST_EXAMPLES = 50


class Diagnosis:
    """Count the answers of a recording, and give a hint where most are unknown.

    Parameters
    ----------
    model : Model
    sampling_rate : float
        [Hz].
    source : str
        The file, as the next commands name it.
    options : sequence of str
        Options that all commands need to read the file, such as `--rate 25600`.
    answering : sequence of str
        Options of `cgid predict` alone, such as `--model mine.npz`.
    channels : sequence of str
        All channels that these options read, as `--channel` takes them.
    labelled : bool
        Whether the file is a dataset, which holds signals and the labels to train on.
    """

    def __init__(
        self,
        model: Model,
        sampling_rate: float,
        source: str,
        options: Sequence[str] = (),
        answering: Sequence[str] = (),
        *,
        channels: Sequence[str] = (),
        labelled: bool = False,
    ) -> None:
        self._model, self._rate, self._source = model, sampling_rate, source
        self._options, self._answering = tuple(options), tuple(answering)
        self._labelled, self._all_channels = labelled, tuple(channels)
        self._kind = "signal" if labelled else "window" if model.kind == "window" else "impact"
        self._channels: dict[str, ChannelAnswers] = {}
        self.upside_down: set[str] = set()
        self._next_look = _ENOUGH_LEVELS

    def add(self, answers: Iterable[Answer]) -> None:
        """Count more answers."""
        for answer in answers:
            channel = self._channels.setdefault(answer.channel, ChannelAnswers())
            after, channel.latest = answer.time - channel.latest, answer.time
            channel.n_answers += 1
            crowded = self._model.kind == "vibration" and 0 < after < EVENT_TIME
            name, marked = _cause_of(answer, crowded)
            channel.n_unmarked += not marked
            # Training leaves out impacts that begin within the event before.
            is_apart = not 0 < after < EVENT_TIME
            is_whole = not (answer.overlapping or answer.clipped or answer.cut)
            channel.n_usable += bool(answer.probabilities) and is_apart and is_whole
            if np.isfinite(answer.unexplained) and not (crowded or answer.overlapping or answer.clipped or answer.cut):
                channel.unexplained.append(answer.unexplained)
            if np.isfinite(answer.level):
                channel.levels.append(answer.level)
                channel.n_levels += 1
            if answer.label != UNKNOWN:
                continue
            channel.n_unknown += 1
            (channel.marks if marked else channel.unmarked)[name] += 1
            if answer.problem in channel.problems or len(channel.problems) < _MOST_EXAMPLES:
                channel.problems[answer.problem] += 1
            examples = channel.examples.setdefault(name, [])
            if len(examples) < _MOST_EXAMPLES:
                examples.append(answer)

    @property
    def is_clear(self) -> bool:
        """Whether a live stream can have its hint already."""
        enough = _ENOUGH if self._model.beam is None else _LATEST[0]  # by then it shows whether the beam has changed
        unknown = any(c.n_answers >= enough and c.n_unknown >= _CLEARLY * c.n_answers for c in self._channels.values())
        return unknown or bool(self._changed())

    def _changed(self) -> dict[str, list[float]]:
        """Return the channels whose beam has changed, with what their latest impacts leave unexplained [%]."""
        limit = max(CHANGED, _OVER_USUAL * self._model.unexplained)
        found = {name: channel.left() for name, channel in self._channels.items()}
        return {name: latest for name, (left, latest) in found.items() if left > limit}

    def hint(self) -> Hint | None:
        """Return the hint; None where no channel is upside down or mostly unknown, and no beam changed."""
        # What rebounds of a pulse that points down may be answered: then it is the wrong side that was.
        turned = {name: self._channels[name] for name in sorted(self.upside_down & self._channels.keys())}
        own = turned or {name: c for name, c in self._channels.items() if 2 * c.n_unknown > c.n_answers}
        if not own:
            return self._hint_of_change()
        counts: Counter[str] = Counter()
        for channel in own.values():
            decisive = channel.marks + channel.unmarked
            if channel.unmarked and channel.n_unmarked >= _UNMARKED * channel.n_answers:
                decisive = channel.unmarked
            counts += decisive
        cause = "upside_down" if turned else counts.most_common(1)[0][0]
        another = all(channel.n_unknown >= _ANOTHER * channel.n_answers for channel in own.values())
        if cause == "shape" and not another and own.keys() & self._changed().keys():
            return self._hint_of_change()
        examples = [answer for channel in own.values() for answer in channel.examples.get(cause, ())]
        problem = sum((channel.problems for channel in own.values()), Counter[str]()).most_common(1)
        n_unknown, n_answers = (sum(getattr(c, name) for c in own.values()) for name in ("n_unknown", "n_answers"))
        where = f"{n_unknown} of {n_answers} {self._kind}{'' if n_answers == 1 else 's'} unknown"
        told = self._told(cause, examples, problem[0][0] if problem else "")
        reason, advice, commands, instead = (*told, *[()] * 2)[:4]
        return Hint(
            cause=cause,
            reason=f"{where}: {reason}",
            advice=advice,
            commands=commands,
            instead=instead,
            channels=() if len(own) == len(self._channels) else tuple(own),
            n_unknown=n_unknown,
            n_answers=n_answers,
        )

    def _hint_of_change(self) -> Hint | None:
        """Return the hint of a beam that is no longer that of the model; None where it is."""
        own = self._changed()
        if not own:
            return None
        latest = np.concatenate(list(own.values()))
        usual = f", {self._model.unexplained:.2g} % in the training" if self._model.unexplained else ""
        steps = self._calibration()
        return Hint(
            cause="beam",
            reason="the beam has changed, or it is another: the modes of the model's leave "
            f"{np.median(latest):.2g} % of the energy of the last {len(latest)} {self._kind}s unexplained (median"
            f"{usual}), and answers are less often right",
            advice="learn its modes anew and train on them" + self._lacking(steps),
            commands=steps,
            channels=() if len(own) == len(self._channels) else tuple(own),
            n_unknown=sum(self._channels[name].n_unknown for name in own),
            n_answers=sum(self._channels[name].n_answers for name in own),
        )

    # -- the level ------------------------------------------------------------------------------------

    def level_warning(self, *, live: bool = False) -> str | None:
        """Return one line if the levels are not those of the training, None if they are or a hint says why not.

        A live stream is looked at when it has three times as many impacts as at the last look: a chance for each look.
        """
        if live:
            if max((channel.n_levels for channel in self._channels.values()), default=0) < self._next_look:
                return None
            self._next_look *= _NEXT_LOOK
        factors = {name: _factor_of(channel.levels, self._model) for name, channel in self._channels.items()}
        factors = {name: factor for name, factor in factors.items() if factor != 1}
        if not factors or self.hint() is not None:
            return None
        one = len(self._channels) == 1
        return "; ".join(
            ("" if one else f"channel {name}: ") + _level_text(factor, self._model) for name, factor in factors.items()
        )

    # -- words ----------------------------------------------------------------------------------------

    def _told(self, cause: str, examples: Sequence[Answer], problem: str) -> tuple[Any, ...]:
        """Return reason, advice and next steps, or the steps of two ways."""
        model, trained = self._model, _rates(self._model)
        causes = [answer.cause for answer in examples if answer.cause is not None]
        middle = float(np.median([one.value for one in causes])) if causes else float("nan")
        if cause == "noise":
            told = f"only {middle:.2g} times as strong as what is before them" if causes else "not clear of the noise"
            return f"they are too weak, {told}", "record nearer to the impacts, or with less noise", ()
        if cause == "drowned":
            return "they are drowned in noise that the training does not have", "record nearer, or with less noise", ()
        if cause == "clipped":
            return "they are clipped at the limit of the recorder", "record with a larger range", ()
        if cause == "cut_off":
            return (
                "the recording begins or ends within them",
                "record longer, with some milliseconds before the first impact",
                (),
            )
        if cause == "overlapping":
            return (
                "they follow too closely, each begins before the one before it is over",
                "place the sensor where fewer rocks are heard",
                (),
            )
        if cause == "upside_down":
            return "the signal falls far deeper than it rises", "turn it over", (self._turned(),)
        if cause == "coverage":
            return f"they are like those of the training, but {problem}", "ask for a lower coverage", ()
        if cause == "sampling_rate":
            return (
                f"sampled at {self._rate:g} Hz they are outside of the training, at {middle:g} Hz they would be inside",
                "if that is the true rate, " + self._cure("--rate"),
                self._corrected("--rate", f"{middle:g}"),
            )
        if cause == "amplitude":
            size = f"about {_times(middle)} times as {'strong' if middle > 1 else 'weak'} as"
            units = ", ".join(_spellings(model.quantity))
            return (
                f"they are {size} those of the training, otherwise like them",
                f"check gain, sensitivity and unit ({units}), and {self._cure('--unit')}",
                self._in_other_unit(middle),
            )
        if cause == "duration":
            size = f"about {_times(middle)} times as {'long' if middle > 1 else 'short'} as"
            return (
                f"they are {size} those of the training, otherwise like them",
                f"check the sampling rate, {self._rate:g} Hz, and {self._cure('--rate')}",
                (),
            )
        if cause == "unmeasured":
            return f"they cannot be measured ({problem})" if problem else "they cannot be measured", "record anew", ()
        training = self._training()
        if cause == "vibration":
            return (
                f"they swing below their baseline by {middle:.0%} of their peak, which no contact force does",
                f"if it is an acceleration, {self._cure('--unit')}, else label impacts and train on them"
                + self._lacking(training),
                *filter(None, (self._as_acceleration(), training)),
            )
        what = "parts of recordings" if self._kind == "window" else "impacts"
        reason = "they are clear, but unlike those of the training, as on another beam, mount or sensor"
        if cause == "shape" and model.beam is not None and not self._labelled:
            return (
                "they are clear, but unlike those of the training: the modes of the model's beam do not explain them, "
                "it is another beam, or it has changed"
                + (", or the channels are in another order" if model.together > 1 else ""),
                f"learn the modes of this beam, with a scene of its size at {self._rate:g} Hz, and train on them, or "
                f"label impacts{self._lacking(training)}",
                *filter(None, (self._calibration(), training)),
            )
        if cause == "shape":
            reason = "they are no single pulses like those of the training, as where the sensor rings or filters"
        elif causes:
            name = Counter(one.name for one in causes).most_common(1)[0][0]
            foremost = [one for one in causes if one.name == name]
            value, low, high = float(np.median([one.value for one in foremost])), foremost[0].low, foremost[0].high
            if not low <= value <= high:
                reason += f" (foremost {name}: {value:.3g}, in the training {low:.3g} to {high:.3g})"
        if not model.covers(self._rate):
            reason += f"; and sampled at {self._rate:g} Hz, not {trained} Hz"
        return reason, f"label {what} and train on them{self._lacking(training)}", training

    def _predict(self, *more: str) -> str:
        options = _without([*self._options, *self._answering], more)
        return shlex.join(["cgid", "predict", self._source, *options, *more])

    def _predict_with(self, model: str) -> str:
        """Return the command for a model made here; what only the former one asks for is left out."""
        is_for_all = self._model.together > 1 or self._channels.keys() >= set(self._all_channels)
        options = self._options if is_for_all else self._for_one()  # others may be of another quantity
        return shlex.join(["cgid", "predict", self._source, *options, "--model", model])

    def _turned(self) -> str:
        """Return the command that turns the signal over, without the channels that need it not."""
        options = [*self._options, *self._answering]
        others = self._channels.keys() - self.upside_down
        if others and self._model.together == 1:
            names = [name for name in self._channels if name in self.upside_down]
            options = _without(options, ("--channel",)) + [word for name in names for word in ("--channel", name)]
        turn = [] if "--invert" in options else ["--invert"]
        return shlex.join(["cgid", "predict", self._source, *_without(options, ("--invert",)), *turn])

    def _as_acceleration(self) -> tuple[str, ...]:
        if "--unit" not in self._options or self._is_converted("--unit"):
            return ()
        options = [*_without(self._options, ("--unit",)), "--unit", "m/s^2"]
        return (shlex.join(["cgid", "predict", self._source, *options]),)

    def _in_other_unit(self, factor: float) -> tuple[str, ...]:
        """Return the command with the unit that makes the signal so many times as small; none if no unit does."""
        given = dict(pairwise(self._options)).get("--unit", "")
        units = UNITS[self._model.quantity]
        if given not in units or self._is_converted("--unit"):
            return ()
        away = {unit: abs(np.log10(units[given] / units[unit] / factor)) for unit in _spellings(self._model.quantity)}
        nearest = min(away, key=lambda unit: away[unit])
        return (self._predict("--unit", nearest),) if away[nearest] < _SAME_UNIT else ()

    def _cure(self, flag: str) -> str:
        """Return how to correct what an option says: the option, or the file, which no option may contradict."""
        if self._is_converted(flag):
            flag = "--sensitivity"
        return f"correct it with {flag}" if flag in self._options else "correct it in the file"

    def _corrected(self, flag: str, value: str) -> tuple[str, ...]:
        is_open = flag in self._options and not self._is_converted(flag)
        return (self._predict(flag, value),) if is_open else ()

    def _is_converted(self, flag: str) -> bool:
        """Return whether a flag is the unit of volts, which a sensitivity converts."""
        return flag == "--unit" and "--sensitivity" in self._options

    def _for_one(self) -> tuple[str, ...]:
        """Return the options that read one channel alone: that with the most impacts to learn from."""
        if len(self._all_channels) < 2:
            return self._options
        best = self._best()
        # Channels that are looked at together have one name.
        name = next((one for one in self._all_channels if best == one or best.startswith(f"{one}+")), best)
        return (*_without(self._options, ("--channel",)), "--channel", name)

    def _best(self) -> str:
        return max(self._channels, key=lambda name: self._channels[name].n_usable)

    def _is_enough(self, n_impacts: int) -> bool:
        return self._labelled or self._channels[self._best()].n_usable >= n_impacts

    def _lacking(self, steps: Sequence[str]) -> str:
        """Return the end of an advice whose steps the recording is too short for."""
        is_enough = self._kind == "window" or self._is_enough(CALIBRATED)
        return "" if steps or is_enough else f"; record {CALIBRATED} clear impacts or more for that"

    def _training(self) -> tuple[str, ...]:
        """Return the steps that make a model of this recording's own; none if it is too short for that."""
        if self._kind == "window":
            return self._training_on_windows()
        if not self._is_enough(_TRAINED):
            return ()
        model = _unused("mine", ".npz")
        if self._labelled:
            return (shlex.join(["cgid", "train", self._source, "-o", model]), self._predict_with(model))
        options, table = list(self._for_one()), _unused("events", ".csv")
        if self._model.quantity == "level" and "--unit" not in options:
            options += ["--unit", "FS"]
        rings = [word for pair in pairwise(options) if pair[0] == "--dead-time" for word in pair]
        return (
            shlex.join(["cgid", "events", self._source, *options, "-o", table]),
            f"fill in the label column of {table}",
            shlex.join(["cgid", "train", table, *rings, "-o", model]),
            self._predict_with(model),
        )

    def _training_on_windows(self) -> tuple[str, ...]:
        """Return the steps that make a model of parts of this recording; none if train cannot read it alike."""
        if {"--variable", "--invert"} & set(self._options):
            return ()
        table, model = _unused("parts", ".csv"), _unused("mine", ".npz")
        return (
            shlex.join(["cgid", "train", self._source, *self._options, "--template", table]),
            f"fill in {table}: a row for each part, with its start, end and label",
            shlex.join(["cgid", "train", table, *self._options, "--by", "window", "-o", model]),
            self._predict_with(model),
        )

    def _calibration(self) -> tuple[str, ...]:
        """Return the steps that make a model of this recording's beam; none if the shipped scene cannot start them."""
        if not self._is_enough(CALIBRATED) or abs(self._rate / SCENE_RATE - 1) > 1e-3:
            return ()
        name = _unused("site", ".toml", "-modes.csv", ".npz")
        return (
            shlex.join(["cgid", "calibrate", self._source, *self._for_one(), "--scene", SCENE, "-o", f"{name}.toml"]),
            f"cgid train {name}.toml -o {name}.npz",
            self._predict_with(f"{name}.npz"),
        )


def _factor_of(levels: Sequence[float], model: Model) -> float:
    """Return the likely factor of a signal with these levels; 1 if they are as in recordings like the training's."""
    n, deviation = len(levels), model.level_deviation
    if n < _ENOUGH_LEVELS or not deviation:
        return 1.0
    scaled = np.array(levels) / deviation
    middle = np.median(scaled)
    scaled = np.clip(scaled, middle - _CLIPPED, middle + _CLIPPED)
    excess = float(scaled.mean() + scaled.std()) - _UPPER
    chance, spread = _SPREAD[model.beam is not None][0 if excess > 0 else 1]
    # What the training itself does not know for few impacts counts as well.
    limit = np.sqrt(chance / n + chance / model.training.get("n_train", np.inf) + spread)
    return float(np.exp(excess * deviation)) if abs(excess) > limit else 1.0


def _level_text(factor: float, model: Model) -> str:
    """Return both explanations of a level that is not that of the training."""
    size = max(factor, 1 / factor)
    side = "large" if factor > 1 else "small"
    is_like_g = model.quantity == "acceleration" and _LIKE_G[0] < size < _LIKE_G[1]
    as_g = " (g taken for m/s^2 or the other way round is a factor of 9.81)" if is_like_g else ""
    return (
        f"the forces are about {size:.2g} times as {side} as in the training: the scale of the samples is wrong{as_g}, "
        "or the rocks are of other sizes, drop heights or mixture; check unit, sensitivity, gain and full scale"
    )


def _unused(stem: str, *endings: str) -> str:
    """Return the name of a file that is not there yet, or of several without their endings."""
    names = chain([stem], (f"{stem}_{number}" for number in count(2)))
    name = next(one for one in names if not any(Path(one + ending).exists() for ending in endings))
    return name + endings[0] if len(endings) == 1 else name


def _without(options: Sequence[str], dropped: Sequence[str]) -> list[str]:
    """Return the options, pairs of flag and value or flags alone, without the flags in `dropped`."""
    kept: list[str] = []
    flag = ""
    for option in options:
        flag = option if option.startswith("--") else flag
        if flag not in dropped:
            kept.append(option)
    return kept


def _times(factor: float) -> str:
    """Return how many times larger or smaller: one digit, because only powers of 10^(1/4) are tried."""
    return f"{float(f'{max(factor, 1 / factor):.1g}'):.0f}"


def _spellings(quantity: str) -> list[str]:
    """Return the units of a quantity, one spelling of each."""
    first: dict[float, str] = {}
    for unit, factor in UNITS[quantity].items():
        first.setdefault(factor, unit)
    return list(first.values())


def _rates(model: Model) -> str:
    low, high = model.sampling_rates
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _cause_of(answer: Answer, crowded: bool) -> tuple[str, bool]:
    """Return the cause of an unknown answer, and whether a mark of its frame is that cause.

    `crowded` says that another impact began within a frame before it.
    """
    if answer.cut and not answer.probabilities:
        return "cut_off", True
    cause = "" if answer.cause is None else answer.cause.name
    if answer.clipped or cause == "overload":
        return "clipped", True
    weak = not answer.probabilities or cause == "noise"
    if answer.overlapping or (crowded and weak):
        return "overlapping", True
    if answer.cut:
        return "cut_off", True
    if not answer.probabilities:
        return ("noise" if answer.problem.startswith("no impact") else "unmeasured"), False
    if not cause:
        return "coverage", False
    if cause.endswith(("misfit", "unexplained")):
        return "shape", False
    return (cause if cause in _TESTED else "features"), False
