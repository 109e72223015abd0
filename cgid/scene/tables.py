"""What is asked of a scene as columns instead of signals, block by block: nothing is made that no column needs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cgid.errors import InvalidValue
from cgid.measure.features import extract_array, extract_truncated, samples_needed
from cgid.scene.impacts import impacts_by_coupling
from cgid.scene.plan import Plan, plan
from cgid.scene.population import Draw, draw, given, parameter_units
from cgid.scene.quantities import OF_TAPS, TRUE
from cgid.scene.randomness import BLOCK
from cgid.scene.range_warnings import unwarned
from cgid.scene.scene import Scene
from cgid.scene.synthesis import blocks, make_beginnings, make_frames, require_count, require_frames
from cgid.validation import Floats

#: Blocks measured at once: the fit shares its overhead among the signals of a batch.
_TOGETHER = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Columns:
    """Some rows of a table.

    Attributes
    ----------
    labels : ndarray of str, (n_signals,)
    specimen : ndarray of uint64, (n_signals,)
        Equal for impacts of an equal particle.
    values : dict of ndarray, each (n_signals,)
        Of `Plan.request.column_units`; nan where a number does not apply, or cannot be measured.
    n_unmeasured : int
        Signals of which a feature cannot be measured.
    """

    labels: NDArray[np.str_]
    specimen: NDArray[np.uint64]
    values: Mapping[str, Floats]
    n_unmeasured: int = 0

    def __len__(self) -> int:
        return len(self.labels)


def parameters_of(scene: Scene, n_signals: int, seed: int = 0, *, first: int = 0) -> Iterator[Columns]:
    """Yield what is drawn for the signals of a scene, no law of impact being asked; as `columns_of`."""
    return columns_of(plan(scene, ["parameters"]), n_signals, seed, first=first)


def closed_forms_of(
    scene: Scene, n_signals: int, seed: int = 0, *, quantities: Iterable[str] | None = None, first: int = 0
) -> Iterator[Columns]:
    """Yield quantities of the impacts of a scene without making a pulse; as `columns_of`.

    `quantities` are names out of `cgid.scene.quantities.QUANTITIES`, all of them by default.
    """
    return columns_of(plan(scene, ["closed-form"], quantities=quantities), n_signals, seed, first=first)


def features_of(
    scene: Scene, n_signals: int, seed: int = 0, *, features: Iterable[str] | None = None, first: int = 0
) -> Iterator[Columns]:
    """Yield features of the signals of a scene, which are kept nowhere; as `columns_of`.

    `features` are names out of `cgid.measure.features.FEATURES`, by default all of the kind that the sensor's
    quantity has, as far as sampling rate and frames allow. The numbers are those that
    `cgid.measure.features.extract` gives for float32 signals of `synthesise`.
    """
    return columns_of(plan(scene, ["features"], features=features), n_signals, seed, first=first)


def columns_of(asked: Plan, n_signals: int, seed: int = 0, *, first: int = 0) -> Iterator[Columns]:
    """Yield the columns of a plan, in batches of at most 1024 signals.

    Parameters
    ----------
    asked : Plan
        For parameters, closed forms or features.
    n_signals, seed, first : int
        As in `synthesise`: the same numbers belong to the same signals.

    Raises
    ------
    InvalidValue
        A number breaks its rule, or the plan is one for signals.
    """
    require_count(n_signals, first)
    require_frames(asked.request.scene)
    if asked.request.kept:
        raise InvalidValue(
            "columns are of parameters, closed forms or features, the plan keeps signals; use synthesise"
        )
    if "features" in asked.request.outputs:
        return _measured(asked, n_signals, seed, first)
    return (_untimed(asked, seed, block, part) for block, part in blocks(n_signals, first))


def _untimed(asked: Plan, seed: int, block: int, part: slice) -> Columns:
    """Return what needs no pulse."""
    drawn = given(asked.request.scene, seed, block)
    values = drawn.values | _named_otherwise(drawn.values, drawn.scene)
    for name in asked.request.quantities:
        values[name] = drawn.values[name].copy() if name in OF_TAPS else np.full(BLOCK, np.nan)
    if asked.request.quantities and drawn.fallen.size:
        with unwarned():
            for rows, impacts, _ in impacts_by_coupling(drawn.scene, drawn.impact, drawn.values, drawn.fallen):
                for name in asked.request.quantities:
                    values[name][rows] = getattr(impacts, name)
    return Columns(
        labels=drawn.labels[part],
        specimen=drawn.specimen[part],
        values={name: values[name][part] for name in asked.request.column_units},
    )


def _named_otherwise(values: Mapping[str, Floats], scene: Scene) -> dict[str, Floats]:
    rate = np.full(BLOCK, scene.sampling.sampling_rate)
    return {"asked_restitution": values["restitution"], "sampling_rate": rate}


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A block, which of its signals are asked for, and the plan for it."""

    block: int
    part: slice
    draw: Draw
    asked: Plan

    @property
    def labels(self) -> NDArray[np.str_]:
        return self.draw.labels[self.part]

    @property
    def beginning(self) -> int:
        """Samples of each frame that the features will most likely look at."""
        sampling, names = self.draw.scene.sampling, self.asked.request.features
        if self.asked.runs("rest of the frames"):
            return sampling.samples
        rate = sampling.sampling_rate
        needed = [
            samples_needed(names, strike.onset * rate, strike.pulses.contact_duration * rate).max()
            for strike in self.draw.strikes
        ]
        return int(min(max(needed), sampling.samples))


def _measured(asked: Plan, n_signals: int, seed: int, first: int) -> Iterator[Columns]:
    """Yield features; blocks of one sampling rate are measured together."""
    together = 1 if asked.request.drawn("sampling_rate") else _TOGETHER
    waiting: list[_Drawn] = []
    for block, part in blocks(n_signals, first):
        with unwarned():
            drawn = draw(asked.request.scene, seed, block)
        waiting.append(_Drawn(block, part, drawn, asked.for_block(drawn.scene)))
        if len(waiting) == together:
            yield _features(asked, seed, waiting)
            waiting = []
    if waiting:
        yield _features(asked, seed, waiting)


def _features(asked: Plan, seed: int, drawn: list[_Drawn]) -> Columns:
    names, sampling = asked.request.features, drawn[0].draw.scene.sampling
    length = max(one.beginning for one in drawn)
    made = [make_beginnings(one.asked, one.draw, seed, one.block, np.float32, length) for one in drawn]
    frames = np.concatenate([signals[one.part] for one, (signals, _) in zip(drawn, made, strict=True)])
    behind = np.concatenate([highest[one.part] for one, (_, highest) in zip(drawn, made, strict=True)])
    if length == sampling.samples:
        table = extract_array(frames, sampling.sampling_rate, names, pre_trigger=sampling.pre_trigger, invalid="nan")
    else:
        table, certain = extract_truncated(frames, sampling.sampling_rate, names, sampling.pre_trigger, behind)
        if not certain.all():
            table[~certain] = _from_whole_frames(names, seed, drawn, ~certain)
    labels = np.concatenate([one.labels for one in drawn])
    return Columns(
        labels=labels,
        specimen=np.concatenate([one.draw.specimen[one.part] for one in drawn]),
        values=_beside(asked, drawn, dict(zip(names, table.T, strict=True))),
        n_unmeasured=int(np.sum(~np.isfinite(table).all(axis=1))),
    )


def _from_whole_frames(names: tuple[str, ...], seed: int, drawn: list[_Drawn], wanted: NDArray[np.bool_]) -> Floats:
    """Return the features of the wanted signals, whose beginnings did not do, (n_wanted, n_features)."""
    sampling, rows, place = drawn[0].draw.scene.sampling, [], 0
    for one in drawn:
        here = wanted[place : place + len(one.labels)]
        place += len(one.labels)
        if here.any():
            rows.append(make_frames(one.asked, one.draw, seed, one.block, np.float32)[one.part][here])
    return extract_array(
        np.concatenate(rows), sampling.sampling_rate, names, pre_trigger=sampling.pre_trigger, invalid="nan"
    )


def _beside(asked: Plan, drawn: list[_Drawn], values: dict[str, Floats]) -> dict[str, Floats]:
    """Return features with the true numbers beside them."""
    for name in parameter_units(asked.request.scene):
        values[f"{TRUE}{name}"] = np.concatenate([one.draw.parameters[name][one.part] for one in drawn])
    if "sampling_rate" in asked.request.column_units:
        rates = [np.full(len(one.labels), one.draw.scene.sampling.sampling_rate) for one in drawn]
        values["sampling_rate"] = np.concatenate(rates)
    return values
