"""What recordings of a model's training are like, sound and spoilt, so that one that is not can be explained.

Some impacts of a channel are summarised in one vector of some 35 numbers. Each explanation (as the training, upside
down, clipped, ...) is a density of it, learned from simulated recordings (`models/faults.py`). A fault that moves
peaks and widths by a factor (a scale, a rate of forces, other rocks) is undone in the vector instead. An explanation is
possible where its odds against "as the training" exceed a limit of its own, which at most so many sound recordings do.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.identification.model.families import MIN_DIVISOR

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.answers import Answer

#: Latest impacts that count.
MOST_IMPACTS = 200


class Fault(StrEnum):
    """What may be wrong with a channel; the values are words for programs."""

    SCALE = "scale"  # samples are too large or too small, by `Explained.factor`
    RATE = "rate"  # the stated sampling rate is `Explained.factor` times the true one
    UPSIDE_DOWN = "upside_down"
    CLIPPED = "clipped"
    NOISE = "noise"
    RINGING = "ringing"  # the sensor or its mount has a resonance
    LOW_PASS = "low_pass"  # a filter, or a loose mount
    BEAM = "beam"  # another beam than the model's
    ROCKS = "rocks"  # of other sizes, hardness or falls; never of a beam, where any seam is sound
    UNKNOWN = "unknown"  # nothing that is known explains it


#: What `sampled` gives of an impact before its spectrum.
_HIGH, _LOW, _BASELINE, _NOISE, _N_HIGH, _N_LOW, _ROUGHNESS = range(7)
_N_SAMPLED = 7
#: Centres of the bands of a spectrum, 2 % apart [Hz]: the modes of a beam that its frames of 150 ms resolve.
BANDS = 400 * 1.02 ** np.arange(172)
#: Bands up to this fraction of the sampling rate are those of the recorder's pass band.
_PASSED = 0.45


def sampled(frames: NDArray[np.floating], sampling_rate: float, before: int, *, spectrum: bool) -> NDArray[np.float32]:
    """Return what samples of impacts show beside their features, (n, 7), or with their spectra (n, 7 + n_bands).

    Highest and lowest sample, baseline and standard deviation of the first samples `before` the impact, numbers of the
    highest and lowest samples, length of the way up and down over the range; logarithms of the shares of the power in
    `BANDS`, nan beyond the recorder's.
    """
    frames = frames.astype(np.float64, copy=False)
    high, low = frames.max(axis=1), frames.min(axis=1)
    quiet = frames[:, : max(before, 2)]
    columns = [high, low, quiet.mean(axis=1), quiet.std(axis=1)]
    columns += [(frames == one[:, None]).sum(axis=1) for one in (high, low)]
    columns.append(np.abs(np.diff(frames, axis=1)).sum(axis=1) / np.maximum(high - low, np.finfo(np.float64).tiny))
    if not spectrum:
        return np.stack(columns, axis=1).astype(np.float32)
    n = 2 * frames.shape[1]
    power = np.abs(np.fft.rfft(frames - columns[2][:, None], n)) ** 2
    total = np.concatenate([np.zeros((len(frames), 1)), np.cumsum(power, axis=1)], axis=1)
    edges = np.append(BANDS, BANDS[-1] * 1.02) / 1.01 * n / sampling_rate
    inside = edges[1:] < _PASSED * n
    first, last = (np.clip(np.round(part).astype(np.intp), 0, n // 2) for part in (edges[:-1], edges[1:]))
    last = np.maximum(last, first + 1)
    share = (total[:, last] - total[:, first]) / (last - first) / np.maximum(total[:, -1:], np.finfo(np.float64).tiny)
    spectra = np.where(inside, np.log(np.maximum(share, np.finfo(np.float64).tiny)), np.nan)
    return np.concatenate([np.stack(columns, axis=1), spectra], axis=1).astype(np.float32)


def heights_of(samples: NDArray[np.floating]) -> Floats:
    """Return how far pulses rise over their noise, (n,), from what `sampled` gives of them."""
    high, low, baseline, noise = samples[:, : _NOISE + 1].T
    rise = np.maximum(high - baseline, baseline - low)
    return np.asarray(rise / np.maximum(noise, np.maximum(_NO_NOISE * rise, np.finfo(np.float32).tiny)))


class Impacts(NamedTuple):
    """What is known of some impacts, in order of time; nan where nothing was measured."""

    values: Floats  # (n, n_measured) inputs and guards of the model
    sampled: Floats  # (n, 7 or more) of `sampled`
    novelty: Floats  # (n,)
    misshapen: Floats  # (n,)
    flagged: NDArray[np.bool_]  # (n,) overlapping or clipped

    @classmethod
    def of(cls, answers: Iterable[Answer], model: StoredModel) -> Self:
        """Return those of answers; impacts without samples, or cut off, do not count."""
        nothing = (np.nan,) * len(model.measured)
        shown = [answer for answer in answers if answer.sampled is not None and not answer.cut]
        n_sampled = _N_SAMPLED + (0 if model.beam is None else len(BANDS))
        return cls(
            np.array([answer.values or nothing for answer in shown]).reshape(-1, len(nothing)),
            np.array([answer.sampled for answer in shown], np.float64).reshape(-1, n_sampled),
            np.array([answer.novelty for answer in shown]),
            np.array([answer.misshapen for answer in shown]),
            np.array([answer.overlapping or answer.clipped for answer in shown], bool),
        )

    @property
    def spectra(self) -> Floats:
        """Their spectra, (n, n_bands); (n, 0) of a force."""
        return self.sampled[:, _N_SAMPLED:]

    def at(self, rows: Any) -> Impacts:
        """Return some of them."""
        return Impacts(*(column[rows] for column in self))


# -- the summary of some impacts ---------------------------------------------------------------------------

#: Features that a summary needs, of what a beam gives and of a force.
_NEEDED = (
    (
        *("beam_peak_force", "beam_pulse_width", "beam_restitution", "beam_peak_force_deviation", "beam_unexplained"),
        *("beam_peak_width_correlation", "beam_peak_restitution_correlation", "beam_width_restitution_correlation"),
    ),
    (
        *("fitted_peak", "fitted_width", "shrunken_restitution", "fitted_peak_deviation", "unexplained"),
        *("pulse_shape_1", "pulse_shape_2", "pulse_shape_3", "pulse_shape_4"),
    ),
)
_QUANTILES = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
_QUARTILES = np.array([0.25, 0.5, 0.75])
#: Where a summary has peaks, widths, the upper end of the levels, and the log odds of unknown impacts.
_PEAK, _WIDTH, _LEVEL, _ODDS = slice(0, 5), slice(5, 10), 10, 11
#: Smaller parts are nothing: what is unexplained and misshapen [%], the noise over the rise.
_NOTHING = 0.03
_NO_NOISE = 1e-6
#: Largest samples within this part of each other end at one limit.
_SAME_LIMIT = 5e-3
#: Width [bands] over which a spectrum is compared with its own mean, and the fewest bands that are compared.
_SMOOTH = 15
_LEAST_BANDS = 60
#: Impacts whose novelty is found anew for each move: more of them cost time and tell little.
_MOST_TRIED = 60
#: Fewer impacts have no correlation.
_FEW = 5
#: Numbers of a summary that its spectrum gives; wide bands of a spectrum.
_OF_SPECTRUM = 3
_WIDE_BANDS = 7
#: Shifts of a spectrum, in bands: rates up to 6 times the true one.
_SHIFTS = np.arange(-90, 91)


def needed(model: StoredModel) -> tuple[str, ...]:
    """Return the features that a summary of a model's impacts needs; none if it does not measure them."""
    return next((names for names in _NEEDED if set(names) <= set(model.measured)), ())


def summary(impacts: Impacts, model: StoredModel, spectrum: Floats, moves: Floats) -> Floats:
    """Return what impacts are like once peaks and widths are moved by logarithms (n_moves, 3), (n_moves, n_summary).

    `spectrum` is that of sound recordings, (n_bands,), not used of forces. What cannot be told is nan.
    """
    known = np.isfinite(impacts.novelty)
    n, names = len(known), needed(model)
    columns = impacts.values[known][:, [model.measured.index(name) for name in names]].T
    peak, width, restitution, deviation = np.log(columns[:4])
    unexplained = np.log(np.maximum(columns[4], 0) + _NOTHING)
    high, low, baseline, noise, n_high, n_low, rough = impacts.sampled[:, :_N_SAMPLED].T
    rise = np.maximum(high - baseline, np.finfo(np.float32).tiny)
    fall = np.maximum(baseline - low, _NO_NOISE * rise)
    clear = -np.log(np.maximum(noise / rise, _NO_NOISE))
    at_high, at_low = (np.abs(end) > (1 - _SAME_LIMIT) * np.abs(end).max() for end in (high, low))
    alike = len(peak) < _FEW or min(peak.std(), width.std()) == 0
    rest = [
        *_of(restitution, _QUARTILES),
        *_of(deviation, _QUARTILES),
        *_of(unexplained, _QUARTILES),
        *(_of(np.arctanh(0.999 * one) if model.beam else one, 0.5) for one in columns[5:]),
        *([_of(np.log(impacts.misshapen[np.isfinite(impacts.misshapen)] + _NOTHING), 0.5)] if model.beam else []),
        np.nan if alike else np.arctanh(0.99 * np.corrcoef(peak, width)[0, 1]),
        *(_log_odds(count, n) for count in (n - known.sum(), impacts.flagged.sum())),
        _log_odds(max(at_high.sum(), at_low.sum(), 1) - 1, n),
        # Small impacts end flat by the steps of a recorder.
        _log_odds(((at_high & (n_high > 2)) | (at_low & (n_low > 2))).sum(), n),
        *_of(clear, [0.5, 0.9]),
        _of(np.log(fall / rise), 0.5),
        np.log(fall.max() / rise.max()),
        _of(np.log(rough), 0.5),
        *(_shift(impacts.spectra, spectrum) if model.beam else []),
    ]
    out = np.empty((len(moves), 12 + len(rest)))
    out[:, 12:] = rest
    out[:, _PEAK], out[:, _WIDTH] = _of(peak, _QUANTILES) + moves[:, :1], _of(width, _QUANTILES) + moves[:, 1:2]
    some = impacts.values[known][:: -(-len(peak) // _MOST_TRIED) or 1]
    inputs, guards = np.split(some, [len(model.features)], axis=1)
    if not len(inputs):
        out[:, [_LEVEL, _ODDS]] = np.nan
        return out
    places = [model.features.index(name) for name in names[:2]]
    moved = np.tile(inputs, (len(moves), 1, 1))
    moved[:, :, places] *= np.exp(moves[:, None, :2])
    levels = model.levels(moved.reshape(-1, inputs.shape[1])).reshape(len(moves), -1)
    out[:, _LEVEL] = _of(levels.T, 0.5) + levels.std(axis=1)
    novelty = model.novelty(moved.reshape(-1, inputs.shape[1]), np.tile(guards, (len(moves), 1)))
    out[:, _ODDS] = _log_odds((novelty.reshape(len(moves), -1) > 1).sum(axis=1), len(inputs))
    return out


#: Largest number of a reference, and of an array of explanations.
MAX_NUMBER = 1e9
#: Impacts after a change from which on it is told (some 2 s; by a trial on 36 simulated seams).
LEAST_CHANGED = 20
#: Where a reference has its noise, before its spectrum.
FLOOR = -1
#: Impacts of a reference at least and at most: with fewer a change of 2 is told less often (by a trial on 36 seams).
LEAST_OF_PAST = 50
MOST_OF_PAST = 80


def reference(impacts: Impacts, model: StoredModel) -> Floats:
    """Return what impacts of a channel are like, for `difference`, (n_summary + n_more + n_bands,)."""
    own = np.nan_to_num(detrended(impacts.spectra))
    return np.concatenate([summary(impacts, model, own, np.zeros((1, 3)))[0], _more(impacts), own])


def difference(impacts: Impacts, model: StoredModel, past: Floats, moves: Floats) -> Floats:
    """Return how later impacts differ from a `reference`, moved as in `summary`, (n_moves, n_summary + n_more)."""
    more, n_bands = _more(impacts), impacts.spectra.shape[1]
    n = len(past) - n_bands - len(more)
    found = np.empty((len(moves), n + len(more)))
    found[:, :n] = summary(impacts, model, past[len(past) - n_bands :], moves)
    compared = n - _OF_SPECTRUM if n_bands else n
    found[:, :compared] -= past[:compared]
    found[:, n:] = more - past[n : n + len(more)]
    found[:, -1] += moves[:, 2]
    return found


def _more(impacts: Impacts) -> Floats:
    """Return the noise before impacts, and the mean shares of power in wide bands of a vibration, as logarithms."""
    floor = np.log(_of(impacts.sampled[:, _NOISE], 0.25) + np.finfo(np.float32).tiny)
    parts = np.array_split(impacts.spectra, _WIDE_BANDS, axis=1) if impacts.spectra.size else []
    shares = [np.nanmean(part) if np.isfinite(part).any() else np.nan for part in parts]
    return np.array([*shares, floor])


def _of(values: Floats, quantiles: Any) -> Any:
    """Return quantiles along the first axis as `np.quantile`, which would load masked arrays; of nan they are nan."""
    at = np.asarray(quantiles) * (len(values) - 1)
    if not len(values):
        return np.full(at.shape, np.nan)
    ordered, below = np.sort(values, axis=0), at.astype(np.intp)
    low, high = ordered[below], ordered[np.minimum(below + 1, len(values) - 1)]
    with np.errstate(invalid="ignore"):  # beside an infinite one, from the other
        found = np.where((at == below) | (low == high), low, low + (high - low) * (at - below))
        found = np.where(np.isnan(found), high + (high - low) * (at - below - 1), found)
    return np.where(np.isnan(ordered[-1]), np.nan, found)


def _log_odds(count: Any, n: float) -> Any:
    return np.log((count + 0.5) / (n - count + 0.5))


def detrended(spectra: Floats) -> Floats:
    """Return the mean of spectra (n, n_bands) less its own moving mean, (n_bands,); nan where none has a band."""
    found = np.full(spectra.shape[1], np.nan)
    known = np.isfinite(spectra).any(axis=0)
    if known.sum() > _SMOOTH:
        mean = np.nanmean(spectra[:, known], axis=0)
        padded = np.pad(mean, _SMOOTH // 2, mode="edge")
        found[known] = mean - np.convolve(padded, np.ones(_SMOOTH) / _SMOOTH, "valid")
    return found


def _shift(spectra: Floats, sound: Floats) -> tuple[float, float, float]:
    """Return by how many bands spectra lie above that of sound recordings, how well they fit there, and unmoved."""
    own, sound = detrended(spectra), sound.astype(np.float64)
    a, known_a, known_b = np.nan_to_num(own), np.isfinite(own) * 1.0, (sound != 0) * 1.0
    pairs = ((known_a, known_b), (a, known_b), (known_a, sound), (a * a, known_b), (known_a, sound * sound), (a, sound))
    # Sums over the bands that both have, at each shift.
    n, of_a, of_b, of_aa, of_bb, of_ab = (np.correlate(x, y, "full")[len(own) - 1 + _SHIFTS] for x, y in pairs)
    enough, n = n >= _LEAST_BANDS, np.maximum(n, 1.0)
    norm = np.sqrt(np.maximum(of_aa - of_a**2 / n, 0.0) * np.maximum(of_bb - of_b**2 / n, 0.0))
    fits = np.where(enough & (norm > 0), (of_ab - of_a * of_b / n) / np.where(norm > 0, norm, 1.0), -1.0)
    best = int(np.argmax(fits))
    return float(_SHIFTS[best]), float(fits[best]), float(fits[len(_SHIFTS) // 2])


# -- densities of summaries --------------------------------------------------------------------------------

#: A summary of n impacts has the density of the first of these bins that holds n.
BINS = (6, 14, 28, 60, MOST_IMPACTS)
#: Degrees of freedom of the densities: recordings are stranger than Gaussians (by cross-validation of a trial).
_FREEDOM = 8.0
#: Standard deviations of sound recordings from which on a summary counts logarithmically.
_FAR = 3.0
#: Densities of spoilt samples, after that of sound ones; of a force, then of a beam alone; the last is all together.
_SPOILT = (Fault.UPSIDE_DOWN, Fault.CLIPPED, Fault.NOISE, Fault.RINGING, Fault.LOW_PASS)
_OF_BEAM = (Fault.RATE, Fault.BEAM)
#: Logarithms of factors that are tried: of a scale, of a rate, of sizes and of moduli.
_SCALES = np.arange(-7.0, 7.05, 0.2)
_RATES = np.arange(-2.2, 2.25, 0.1)
_SIZES = np.arange(-2.0, 2.1, 0.4)
_MODULI = np.arange(-2.4, 2.5, 0.6)
#: How ln peak, ln width and ln noise move with them: by units, and by Hertz, F ~ R^2 E^.4, T ~ R E^-.4.
_MOVES = {
    Fault.SCALE: np.array([(one, 0.0, one) for one in _SCALES]),
    Fault.RATE: np.array([(0.0, -one, 0.0) for one in _RATES]),
    Fault.ROCKS: np.array([(2 * r + 0.4 * e, r - 0.4 * e, 0.0) for r in _SIZES for e in _MODULI]),
}


class Candidate(NamedTuple):
    """One explanation: what is told, its density (None: as the training), and what is undone before."""

    faults: tuple[Fault, ...]
    kind: Fault | None
    undone: Fault | None = None


#: Log odds of one fault against two at once, before any evidence (by eye).
_OF_PAIRS = 8.0


@cache
def kinds_of(is_beam: bool) -> tuple[Fault | None, ...]:
    """Return the explanations that have a density of their own: None is as the training, of forces on many rigs.

    The last of forces is as the training on the rig of its scenes, where recordings differ less.
    """
    return (None, *_SPOILT, *_OF_BEAM, Fault.UNKNOWN) if is_beam else (None, *_SPOILT, Fault.UNKNOWN, None)


@cache
def candidates_of(is_beam: bool) -> tuple[Candidate, ...]:
    """Return the explanations in the order of their limits."""
    found = [Candidate((one,), one) for one in kinds_of(is_beam) if one]
    found += [Candidate((one,), None, one) for one in ((Fault.SCALE,) if is_beam else _MOVES)]
    found += [Candidate((Fault.SCALE, one), one, Fault.SCALE) for one in (Fault.CLIPPED, Fault.NOISE)]
    of_rate = Candidate((Fault.RATE, Fault.CLIPPED), Fault.CLIPPED, Fault.RATE)
    return (*found, *(() if is_beam else (of_rate,)))


@cache
def moves_of(is_beam: bool) -> tuple[Floats, Mapping[Fault | None, slice]]:
    """Return the moves that undo all candidates, (n_moves, 3), the first none, and the rows of each."""
    names = [Fault.SCALE] if is_beam else list(_MOVES)
    ends = np.cumsum([1, *(len(_MOVES[one]) for one in names)]).tolist()
    rows: dict[Fault | None, slice] = {None: slice(0, 1)}
    rows |= zip(names, itertools.starmap(slice, itertools.pairwise(ends)), strict=True)
    return np.concatenate([np.zeros((1, 3)), *(-_MOVES[one] for one in names)]), rows


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Explanations:
    """The densities of all explanations of a model, as arrays in its file: of summaries, or of differences."""

    centre: Floats  # (n_summary,) of sound recordings
    scale: Floats  # (n_summary,) their standard deviations
    mean: Floats  # (n_kinds, n_bins, n_summary) in these units
    whitening: Floats  # (n_kinds, n_bins, n_summary (n_summary + 1) / 2), lower triangles
    limits: Floats  # (n_candidates, n_bins) least log odds against "as the training"
    spectrum: Floats  # (n_bands,) of sound recordings, 0 beyond the recorder's; one number of forces

    PREFIXES: ClassVar = ("explanations.", "changes.")
    ARRAYS: ClassVar = ("centre", "scale", "mean", "whitening", "limits", "spectrum")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self | None:
        """Return the explanations in the arrays of a model; None without any. Raise `BadData` if they do not fit."""
        stored = {name: arrays[prefix + name] for name in cls.ARRAYS if prefix + name in arrays}
        if not stored:
            return None
        for name in cls.ARRAYS:
            if name not in stored:
                raise BadData(f"array {prefix}{name} is missing")
        is_beam, n, n_bins = stored["spectrum"].size > 1, stored["centre"].size, len(BINS)
        shapes = {"centre": (n,), "scale": (n,), "mean": (len(kinds_of(is_beam)), n_bins, n)}
        shapes["whitening"] = (*shapes["mean"][:2], n * (n + 1) // 2)
        shapes["limits"] = (len(candidates_of(is_beam)), n_bins)
        shapes["spectrum"] = (len(BANDS) if is_beam else 1,)
        for name, shape in shapes.items():
            if stored[name].shape != shape:
                raise BadData(f"array {prefix}{name} must have shape {shape}, got {stored[name].shape}")
            if np.abs(stored[name]).max() > MAX_NUMBER:
                raise BadData(f"array {prefix}{name} must be at most {MAX_NUMBER:g}")
        diagonal = stored["whitening"][..., np.cumsum(np.arange(1, n + 1)) - 1]
        for name, values in (("scale", stored["scale"]), ("whitening", diagonal)):
            if values.min() < MIN_DIVISOR:
                raise BadData(f"array {prefix}{name} must be at least {MIN_DIVISOR:g}")
        return cls(**stored)

    @property
    def n_reference(self) -> int:
        """Numbers of a `reference` of differences."""
        return self.centre.size + (self.spectrum.size if self.spectrum.size > 1 else 0)

    def arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return the arrays in a model file."""
        return {prefix + name: np.ascontiguousarray(getattr(self, name), np.float32) for name in self.ARRAYS}

    def standardised(self, summaries: Floats) -> Floats:
        """Return summaries (n, n_summary) in standard deviations of sound recordings; what is not known is usual."""
        z = np.nan_to_num((summaries - self.centre) / self.scale)
        size = np.abs(z)
        return np.asarray(np.where(size > _FAR, np.sign(z) * (_FAR + np.log1p(np.maximum(size - _FAR, 0))), z))

    def densities(self, kind: Fault | None, in_bin: int, z: Floats) -> Floats:
        """Return the log density of a kind at standardised summaries (n, n_summary), (n,)."""
        found, n = [], z.shape[1]
        for number, one in enumerate(kinds_of(self.spectrum.size > 1)):
            if one is kind:
                whitening, volume = self._whitenings[0][number, in_bin], self._whitenings[1][number, in_bin]
                distance = np.square((z - self.mean[number, in_bin]) @ whitening.T).sum(axis=1)
                found.append(volume - (_FREEDOM + n) / 2 * np.log1p(distance / _FREEDOM))
        return np.asarray(np.logaddexp.reduce(found))

    @cached_property
    def _whitenings(self) -> tuple[Floats, Floats]:
        """The matrices (n_kinds, n_bins, n_summary, n_summary), and the logarithms of their determinants."""
        n = self.centre.size
        matrices = np.zeros((*self.whitening.shape[:2], n, n))
        matrices[:, :, *np.tril_indices(n)] = self.whitening
        return matrices, np.log(np.diagonal(matrices, axis1=2, axis2=3)).sum(axis=2)

    def odds(self, impacts: Impacts, model: StoredModel, past: Floats | None = None) -> tuple[Floats, Floats]:
        """Return the log odds of each candidate against "as the training", and its factor, (n_candidates,) each.

        With a `reference` as `past`, against "as before".
        """
        in_bin, is_beam = bin_of(len(impacts.novelty)), model.beam is not None
        moves, rows = moves_of(is_beam)
        if past is None:
            summaries = summary(impacts, model, self.spectrum, moves)
        else:
            summaries = difference(impacts, model, past, moves)
        z = self.standardised(summaries)
        sound = self.densities(None, in_bin, z[:1])[0]
        odds, factors = [], []
        for faults, kind, undone in candidates_of(is_beam):
            found = self.densities(kind, in_bin, z[rows[undone]])
            best = int(np.argmax(found))
            odds.append(np.logaddexp.reduce(found) - np.log(len(found)) - sound - _OF_PAIRS * (len(faults) - 1))
            move = moves[rows[undone]][best]
            factors.append(np.exp(move[1] - move[0]) if undone in (Fault.SCALE, Fault.RATE) else np.nan)
            if kind is Fault.RATE:
                shift = -_OF_SPECTRUM if past is None else -_OF_SPECTRUM - 1 - _WIDE_BANDS
                factors[-1] = 1.02 ** summaries[0, shift]
        return np.array(odds), np.array(factors)


def bin_of(n: int) -> int:
    """Return the bin of n impacts."""
    return int(np.searchsorted(BINS[:-1], n))
