"""The fraction of gangue in a seam that nobody described, from the coal with which a caving window begins.

No single impact tells its seam: a hard coal looks like a soft gangue. But a window begins with coal. The predictions
for this coal, the anchor, and those of the present window are summarised, and a network gives the density of the
fraction. It was trained on thousands of simulated seams (`cgid.learning.seams`), so it has seen which coals and gangues
look like this beside such an anchor. A second network sees the window alone: its density is as wide as the seams of the
training allow. A third one tells whether the window can be a mixture with the coal of the anchor. A fourth one sees
labelled lumps of gangue beside both. Whether these can be gangue beside this coal, the network of the anchor tells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import product
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.identification.model.confusion import logit
from cgid.identification.model.families import MIN_DIVISOR, Network, softmax

#: Peak, width and restitution of a pulse among the features of a model: through a beam, or of a force.
PULSES = (
    ("beam_peak_force", "beam_pulse_width", "beam_restitution"),
    ("fitted_peak", "fitted_width", "shrunken_restitution"),
)
#: Minimum number of identified impacts of an anchor, and of labelled lumps of gangue.
MIN_ANCHOR, MIN_LUMPS = 10, 6
#: Minimum number of identified impacts of a window for the networks, whose windows have 5 rocks and more.
MIN_WINDOW = 3
#: Coal of earlier cycles counts for so long, a shift [s].
SHIFT = 8 * 3600.0
#: Impacts to which it fills up the coal of a cycle: those of some 20 s at 8 rocks a second.
FULL = 200
#: While a span of coal of this length goes on, nothing is decided [s].
_STRETCH = 0.5
#: Classes of the fraction, evenly spaced in the angle of fraction = sin^2(angle): finer towards 0 and 1.
N_CLASSES = 24
#: Quantiles of a summary, and the edges of its histogram of log-odds.
_QUANTILES = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
_EDGES = np.array([-4.0, -2.5, -1.5, -0.75, 0.0, 0.75, 1.5, 2.5, 4.0])
#: Number of quantities with quantiles, and of all numbers of a summary besides the cells.
_QUANTITIES = 7
N_SUMMARY = _QUANTITIES * _QUANTILES.size + 2 + _EDGES.size + 1 + 2
#: Numbers of impacts outside of this range count as its ends, which the training reached.
_COUNTS = 3, 200
#: Standardised inputs are clipped at this.
_FARTHEST = 6.0
_MAX_CELLS, _MAX_NETWORKS = 1000, 100


def pulse_names(features: Sequence[str]) -> tuple[str, ...]:
    """Return which features are the peak, width and restitution of a pulse; none without all three."""
    return next((names for names in PULSES if set(names) <= set(features)), ())


class Impacts(NamedTuple):
    """The identified impacts of a window or an anchor, and the number of unknown ones."""

    pulses: Floats  # (n, 3) ln of peak, width and restitution
    logits: Floats  # (n,) of the probability of gangue
    n_unknown: int = 0


def summary(impacts: Impacts, cells: Floats, scale: Floats) -> Floats:
    """Return the summary of at least one impact, (N_SUMMARY + n_cells,), with a histogram of pulses over `cells`."""
    pulses, logits = impacts.pulses, impacts.logits
    n, (peak, width, _) = len(logits), pulses.T
    # Peak over squared width hardly depends on the size of a rock.
    columns = np.column_stack([pulses, logits, peak - width, peak + width, peak - 2 * width])
    columns.sort(axis=0)
    place = _QUANTILES * (n - 1)
    below = place.astype(np.intp)
    above = np.minimum(below + 1, n - 1)
    quantiles = columns[below] + (place - below)[:, None] * (columns[above] - columns[below])
    nearest = (np.square(cells).sum(axis=1) / 2 - pulses / scale @ cells.T).argmin(axis=1)  # cell of each pulse
    counts = (
        np.bincount(nearest, minlength=len(cells)),
        np.bincount(np.searchsorted(_EDGES, logits), minlength=_EDGES.size + 1),
    )
    return np.concatenate(
        [
            quantiles.T.ravel(),
            [logits.mean(), np.mean(1 / (1 + np.exp(-logits)))],
            *(np.sqrt(one / n) for one in counts),
            [impacts.n_unknown / (n + impacts.n_unknown), np.log(np.clip(n, *_COUNTS))],
        ]
    )


class Committee:
    """Networks of one shape, each of a training of its own, whose densities are averaged.

    A single training is right by luck: five by one recipe differ by a tenth of their error, and their mean is better
    than most of them.
    """

    def __init__(self, arrays: Mapping[str, NDArray[Any]], n_inputs: int, n_classes: int) -> None:
        self.arrays = arrays  # those of a network, each with a first axis of networks
        sizes = {len(a) if a.ndim else 0 for a in arrays.values()} or {1}
        if len(sizes) > 1 or not 0 < max(sizes) <= _MAX_NETWORKS:
            raise BadData(f"arrays of seams must be of one number of networks, at most {_MAX_NETWORKS}")
        self.networks = [
            Network({name: np.asarray(a[k], np.float64) for name, a in arrays.items()}, n_inputs, n_classes)
            for k in range(max(sizes))
        ]

    @classmethod
    def of(cls, networks: Sequence[Network]) -> Self:
        """Return a committee in single precision, which is enough for densities."""
        first = networks[0]
        stacked = {name: np.stack([one.arrays[name] for one in networks]).astype(np.float32) for name in first.arrays}
        return cls(stacked, first.n_features, first.n_classes)

    def density(self, inputs: Floats) -> Floats:
        """Return the mean probability of each class, (n, n_classes)."""
        return np.asarray(np.mean([softmax(one.scores(inputs)) for one in self.networks], axis=0))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class SeamNetworks:
    """What simulated seams taught about the fraction of gangue in a window."""

    cells: Floats  # (n_cells, 3) centres of the histogram of pulses, in units of `cell_scale`
    cell_scale: Floats  # (3,)
    mean: Floats  # of the inputs, (3 n_summary,): window, anchor, window - anchor
    scale: Floats
    limit: float  # score of `foreign` above which the anchor is not of this seam
    anchored: Committee
    alone: Committee
    foreign: Network
    sharpened: Committee
    lumps_limit: float  # least probability of more than half gangue of lumps of gangue, beside its coal

    PREFIX: ClassVar = "seams."
    NUMBERS: ClassVar = ("cells", "cell_scale", "mean", "scale")
    NETWORKS: ClassVar = ("anchored", "alone", "foreign", "sharpened")
    ARRAYS: ClassVar = (*NUMBERS, "limit", "lumps_limit", *map(".".join, product(NETWORKS, Network.AXES)))

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self | None:
        """Return the networks in the arrays of a model; None without them. Raise `BadData` if they do not fit."""
        stored = {name.removeprefix(cls.PREFIX): a for name, a in arrays.items() if name.startswith(cls.PREFIX)}
        if not stored:
            return None
        if missing := {*cls.NUMBERS, "limit", "lumps_limit"} - stored.keys():
            raise BadData(f"array {cls.PREFIX}{min(missing)} is missing")
        cells, cell_scale, mean, scale = (stored[name] for name in cls.NUMBERS)
        if cells.ndim != 2 or cells.shape[1] != 3 or len(cells) > _MAX_CELLS:
            raise BadData(f"array {cls.PREFIX}cells must be rows of 3 numbers, at most {_MAX_CELLS}")
        n = N_SUMMARY + len(cells)
        shapes = {"cell_scale": (3,), "mean": (3 * n,), "scale": (3 * n,), "limit": (1,), "lumps_limit": (1,)}
        for name, shape in shapes.items():
            if stored[name].shape != shape:
                raise BadData(f"array {cls.PREFIX}{name} must have shape {shape}, got {stored[name].shape}")
        if min(cell_scale.min(), scale.min()) < MIN_DIVISOR:
            raise BadData(f"arrays {cls.PREFIX}scale and {cls.PREFIX}cell_scale must be at least {MIN_DIVISOR:g}")

        def own(name: str) -> dict[str, NDArray[Any]]:
            return {part.removeprefix(f"{name}."): a for part, a in stored.items() if part.startswith(f"{name}.")}

        return cls(
            cells=cells,
            cell_scale=cell_scale,
            mean=mean,
            scale=scale,
            limit=float(stored["limit"][0]),
            anchored=Committee(own("anchored"), 3 * n, N_CLASSES),
            alone=Committee(own("alone"), n, N_CLASSES),
            foreign=Network(own("foreign"), 3 * n, 2),
            sharpened=Committee(own("sharpened"), 4 * n, N_CLASSES),
            lumps_limit=float(stored["lumps_limit"][0]),
        )

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays in a model file."""
        stored = {name: np.atleast_1d(getattr(self, name)) for name in (*self.NUMBERS, "limit", "lumps_limit")}
        for name in self.NETWORKS:
            stored |= {f"{name}.{part}": array for part, array in getattr(self, name).arrays.items()}
        return {self.PREFIX + name: np.ascontiguousarray(array) for name, array in stored.items()}

    def summary(self, impacts: Impacts) -> Floats:
        """Return the summary of at least one impact, (n_summary,)."""
        return summary(impacts, self.cells, self.cell_scale)

    def density(self, window: Floats, anchor: Floats | None = None, lumps: Floats | None = None) -> Floats:
        """Return the probability of each class of the fraction, (n, N_CLASSES), of one or more summaries."""
        if anchor is None:
            n = window.shape[-1]
            return self.alone.density(np.atleast_2d(_clipped(window, self.mean[:n], self.scale[:n])))
        networks = self.anchored if lumps is None else self.sharpened
        return networks.density(np.atleast_2d(inputs_of(window, anchor, self.mean, self.scale, lumps)))

    def gangue_of(self, lumps: Floats, anchor: Floats) -> Floats:
        """Return the probability that lumps beside the coal of an anchor are more than half gangue, (n,)."""
        return np.asarray(self.density(lumps, anchor)[:, N_CLASSES // 2 :].sum(axis=1))

    def foreignness(self, window: Floats, anchor: Floats) -> Floats:
        """Return a score that is above 0 where a window is hardly a mixture with the coal of the anchor."""
        inputs = inputs_of(window, anchor, self.mean, self.scale)
        return np.asarray(self.foreign.scores(np.atleast_2d(inputs)) - self.limit)


def inputs_of(window: Floats, anchor: Floats, mean: Floats, scale: Floats, lumps: Floats | None = None) -> Floats:
    """Return the standardised inputs of summaries, (..., 3 n_summary), 4 with lumps of gangue."""
    inputs = _clipped(np.concatenate([window, anchor, window - anchor], axis=-1), mean, scale)
    if lumps is None:
        return inputs
    n = window.shape[-1]
    # Lumps are as a window that is all gangue.
    return np.concatenate([inputs, _clipped(lumps, mean[:n], scale[:n])], axis=-1)


class Basis(StrEnum):
    """What a fraction rests on."""

    TRAINED = "trained_seam"  # the rates of the seam of the training, or the probabilities as they are
    ANCHOR = "anchor"  # the coal with which this cycle began
    ANY_SEAM = "any_seam"  # no coal is stated: the interval covers the seams of the simulation
    PENDING = "anchor_pending"  # its coal is still coming
    TOO_FEW = "anchor_too_few"  # its coal gave fewer than `MIN_ANCHOR` identified impacts
    FOREIGN = "anchor_foreign"  # the windows are hardly mixtures with its coal
    LUMPS = "anchor_and_gangue"  # this coal and labelled lumps of gangue
    FEW_LUMPS = "gangue_too_few"  # the coal alone: the lumps gave fewer than `MIN_LUMPS` identified impacts
    WRONG_LUMPS = "gangue_foreign"  # the coal alone: the lumps are hardly gangue beside it

    @property
    def is_any_seam(self) -> bool:
        """Whether the interval is for any seam."""
        return self in (Basis.ANY_SEAM, Basis.PENDING, Basis.TOO_FEW, Basis.FOREIGN)


class Anchor:
    """The impacts of the coal with which a caving cycle begins, or of spans of coal in a recording.

    Where a cycle's coal is short, the latest coal of earlier cycles fills it up, unless both are hardly of one seam.

    Parameters
    ----------
    coal_until : float [s]
        Only coal falls for so long from the start of a cycle; 0 with `spans`.
    cycle_pause : float, optional [s]
        The first impact after such a pause begins another cycle; None: the recording is one cycle.
    spans : sequence of (float, float) [s]
        Begin and end of spans of coal, such as of labelled impacts; or of lumps of gangue.
    least : int
        Minimum number of identified impacts.
    """

    def __init__(
        self,
        coal_until: float,
        cycle_pause: float | None = None,
        spans: Sequence[tuple[float, float]] = (),
        least: int = MIN_ANCHOR,
    ) -> None:
        self._spans, self._least = [(0.0, coal_until)] if coal_until else list(spans), least
        self._pause, self._last, self._next = cycle_pause, np.inf, np.inf
        #: Begin and last impact [s] of the first cycle that ended while its coal was still coming.
        self.short: tuple[float, float] | None = None
        self._earlier: list[tuple[float, float, tuple[float, ...] | None]] = []  # of earlier cycles
        self._impacts: list[tuple[float, float, tuple[float, ...] | None]] = []
        self.cycle, self.is_foreign = 0.0, False  # its begin [s]
        self._begin(0.0)

    def _begin(self, time: float) -> None:
        is_short = bool(self._impacts) and all(self._last < self.cycle + end for _, end in self._spans)
        if is_short and self.short is None:
            self.short = self.cycle, self._last
        # What was not only coal by its windows, or by its length, tells nothing of the next cycle's.
        coal = [] if self.is_foreign else self._earlier + (self._impacts if not is_short else [])
        self._earlier, self._impacts = [one for one in coal if one[0] > time - SHIFT][-FULL:], []
        self.cycle = time
        self.levels: list[float] = []  # of the coal, as in `Answer`
        self.summary: Floats | None = None  # by the networks, once the coal is complete
        self.is_foreign = False

    def begin_at(self, time: float) -> None:
        """Begin another cycle at a time [s], from which on no impact was added yet."""
        self._next = time

    def _begin_if_due(self, time: float) -> None:
        if time >= self._next:
            self._begin(self._next)
            self._next = np.inf

    def lose(self, time: float) -> None:
        """Take the time until `time` [s] as heard by nobody: no sample is no pause."""
        if self._last < np.inf:
            self._last = max(self._last, time)

    def add(self, time: float, probability: float, pulse: tuple[float, ...] | None) -> None:
        """Add an impact at a time [s], in order; the probability of gangue is nan if it is unknown."""
        self._begin_if_due(time)
        if self._pause is not None and time - self._last > self._pause:
            self._begin(time)
        self._last = time
        if self.has(time):
            self._impacts.append((time, probability, pulse))
            self.summary = None

    def forget(self, start: float, end: float) -> None:
        """Drop the impacts after a time and up to another [s], and what their windows said of its coal."""
        self._impacts, self._earlier = (
            [one for one in some if not start < one[0] <= end] for some in (self._impacts, self._earlier)
        )
        self.summary, self.is_foreign = None, False

    def has(self, time: float) -> bool:
        """Return whether an impact at a time [s] is of its coal."""
        return any(self.cycle + start <= time <= self.cycle + end for start, end in self._spans)

    @property
    def impacts(self) -> Impacts:
        """The impacts of its coal up to now."""
        return impacts_of([one[1:] for one in self._coal])

    @property
    def _coal(self) -> list[tuple[float, float, tuple[float, ...] | None]]:
        """The impacts of its coal, after so many earlier ones as make it full."""
        return (self._earlier + self._impacts)[-max(FULL, len(self._impacts)) :]

    def summarised(self, seams: SeamNetworks) -> Floats:
        """Return the summary of its coal by the networks; coal of earlier cycles that is hardly of its seam goes."""
        if self.summary is None:
            earlier, own = (impacts_of([one[1:] for one in some]) for some in (self._earlier, self._impacts))
            are_both = earlier.logits.size and own.logits.size >= MIN_WINDOW
            if are_both and seams.foreignness(seams.summary(own), seams.summary(earlier))[0] > 0:
                self._earlier = []
            self.summary = seams.summary(self.impacts)
        return self.summary

    def basis(self, time: float) -> Basis:
        """Return the basis of a window that ends at a time [s]."""
        self._begin_if_due(time)
        ends = [(start, end) for start, end in self._spans if time < self.cycle + end]
        is_enough = np.count_nonzero(np.isfinite([one[1] for one in self._coal])) >= self._least
        # A span of one labelled impact is over before a window ends.
        if any(self.cycle + start <= time and end - start >= _STRETCH for start, end in ends):
            return Basis.PENDING
        if not is_enough:
            return Basis.PENDING if ends else Basis.TOO_FEW
        return Basis.FOREIGN if self.is_foreign else Basis.ANCHOR


def impacts_of(answers: Sequence[tuple[float, tuple[float, ...] | None]]) -> Impacts:
    """Return the impacts of probabilities of gangue, nan if unknown, and their pulses."""
    known = [(probability, pulse) for probability, pulse in answers if np.isfinite(probability)]
    pulses = np.array([pulse or (1.0, 1.0, 1.0) for _, pulse in known]).reshape(-1, 3)
    return Impacts(np.log(pulses), logit(np.array([one for one, _ in known])), len(answers) - len(known))


def _clipped(inputs: Floats, mean: Floats, scale: Floats) -> Floats:
    return np.clip((inputs - mean) / scale, -_FARTHEST, _FARTHEST)


def class_edges() -> Floats:
    """Return the edges of the classes of the fraction, (N_CLASSES + 1,)."""
    return np.asarray(np.sin(np.linspace(0.0, np.pi / 2, N_CLASSES + 1)) ** 2)
