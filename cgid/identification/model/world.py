"""Whether a recording is one of the world that a model was trained on: its forces, its seam, its beam and its noise.

Single impacts do not show it: a wet coal, a gain of two or a sensor beside its point gives impacts that each could be
of the training. A recording is a sample of hundreds. After 50, 100, 200, ... impacts the quantiles of a few quantities
are compared with those of simulated recordings of the same length, whose fractions of gangue cover 0 to 1: how far they
lie from those of the nearest fraction, in units of what such recordings vary. The largest distance so far is compared
with the largest of each simulated recording up to its end. However often one looks, a recording of this world is told
with a probability of at most `rate`: the rank of its maximum among theirs is uniform (Vovk, Gammerman & Shafer 2005).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.errors import BadData
from cgid.identification.model.families import MIN_DIVISOR

#: Peak, width and restitution of a pulse, the deviation of its peak, and what is unexplained: of a beam, of a force.
TRAITS = (
    (
        *("beam_peak_force", "beam_pulse_width", "beam_restitution"),
        *("beam_peak_force_deviation", "beam_unexplained"),
    ),
    (*("fitted_peak", "fitted_width", "shrunken_restitution"), *("fitted_peak_deviation", "unexplained")),
)
#: Numbers of impacts after which a recording is compared, up to some ten minutes of caving.
CHECKS = tuple(50 * 2**k for k in range(8))
#: Rate of false alarms, if there are enough simulated recordings for it.
RATE = 0.01
#: Quantiles of a summary; fractions of gangue that are tried.
_QUANTILES = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
_FRACTIONS = np.linspace(0.0, 1.0, 21)
#: Added to what is unexplained [%]: a smaller part is nothing.
_NOTHING = 0.03
#: Numbers of a summary: the quantiles of impulse, hardness, restitution, noise, and what is unexplained. Those of the
#: pulses are compared together.
N_SUMMARY = 25
GROUPS = slice(0, 15), slice(15, 20), slice(20, 25)
_IMPULSE, _HARDNESS, _OF_NOISE = slice(0, 5), slice(5, 10), 1
#: Peak over squared width grows by this power of the modulus (Hertz).
_OF_MODULUS = 1.2
#: Explanations that leave at most this many times what the best one leaves are told beside it.
_ALIKE = 2.0
_MAX_RECORDINGS = 10_000


class MisfitPart(StrEnum):
    """What of a recording is not as in the training."""

    SCALE = "scale"  # all forces are larger or smaller
    SIZES = "sizes"  # rocks, or the heights of their falls
    SEAM = "seam"  # moduli of coal or gangue
    BEAM = "beam"  # more than usual is unexplained: by the modes of the beam, or by one pulse
    NOISE = "noise"


class Misfit(NamedTuple):
    """What of a recording does not fit its model, after so many impacts.

    The factor is that of forces, impulses or moduli over those of the training; nan of a beam and of noise. `others`
    would explain it nearly as well, or do not fit either.
    """

    part: MisfitPart
    n_impacts: int
    factor: float
    others: tuple[Misfit, ...] = ()


def trait_names(measured: Sequence[str]) -> tuple[str, ...]:
    """Return which features and guards of a model are compared; none unless all of them are measured."""
    return next((names for names in TRAITS if set(names) <= set(measured)), ())


def summary(traits: Floats) -> Floats:
    """Return the quantiles of impacts, (N_SUMMARY,), from the values of `trait_names`, (n, 5)."""
    peak, width, restitution, deviation = np.log(traits[:, :4]).T
    unexplained = np.log(np.maximum(traits[:, 4], 0.0) + _NOTHING)
    # The impulse does not depend on the contact, and peak over squared width not on the size of a rock. Deviations are
    # relative to the peak.
    columns = np.stack([peak + width, peak - 2 * width, restitution, deviation + peak, unexplained])
    return np.asarray(np.quantile(columns, _QUANTILES, axis=1).T.ravel())


def powers(fractions: Floats) -> Floats:
    """Return 1, the fraction and its square, (n, 3)."""
    return np.stack([np.ones_like(fractions), fractions, fractions**2], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class World:
    """What recordings of the world of a training look like after `CHECKS` impacts."""

    mean: Floats  # (n_checks, 3, N_SUMMARY) summary over powers of the fraction
    whitening: Floats  # (n_checks, N_SUMMARY, N_SUMMARY) of the difference from the mean, by group
    centre: Floats  # (n_checks, n_groups) of the logarithm of distances
    scale: Floats  # its standard deviation
    maxima: Floats  # (n_recordings,) largest standardised distance of each recording, ascending

    PREFIX: ClassVar = "world."
    ARRAYS: ClassVar = ("mean", "whitening", "centre", "scale", "maxima")

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self | None:
        """Return the world in the arrays of a model; None without one. Raise `BadData` if they do not fit."""
        stored = {name: arrays[cls.PREFIX + name] for name in cls.ARRAYS if cls.PREFIX + name in arrays}
        if not stored:
            return None
        n, n_groups = len(CHECKS), len(GROUPS)
        shapes: dict[str, tuple[int, ...]] = {"mean": (n, 3, N_SUMMARY), "whitening": (n, N_SUMMARY, N_SUMMARY)}
        shapes |= {"centre": (n, n_groups), "scale": (n, n_groups)}
        for name in cls.ARRAYS:
            if name not in stored:
                raise BadData(f"array {cls.PREFIX}{name} is missing")
            if name in shapes and stored[name].shape != shapes[name]:
                raise BadData(f"array {cls.PREFIX}{name} must have shape {shapes[name]}, got {stored[name].shape}")
        maxima = stored["maxima"]
        if maxima.ndim != 1 or not 0 < maxima.size <= _MAX_RECORDINGS or (np.diff(maxima) < 0).any():
            raise BadData(f"array {cls.PREFIX}maxima must be up to {_MAX_RECORDINGS} ascending numbers")
        if stored["scale"].min() < MIN_DIVISOR:
            raise BadData(f"array {cls.PREFIX}scale must be at least {MIN_DIVISOR:g}")
        return cls(**stored)

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays in a model file."""
        return {self.PREFIX + name: np.ascontiguousarray(getattr(self, name)) for name in self.ARRAYS}

    @property
    def rate(self) -> float:
        """Probability that a recording of this world is told: `RATE`, or what so few simulated recordings allow."""
        return max(RATE, 1 / (len(self.maxima) + 1))

    def is_foreign(self, largest: float) -> bool:
        """Return whether recordings of this world have such a largest distance with a probability of `rate` at most."""
        as_large = len(self.maxima) - int(np.searchsorted(self.maxima, largest))
        return 1 + as_large <= self.rate * (len(self.maxima) + 1) * (1 + 1e-9)

    def distances(self, check: int, summary: Floats) -> Floats:
        """Return the standardised distance of each group after a check, (n_groups,)."""
        differences = self._differences(check, summary)
        found = [np.square(differences[:, group]).sum(axis=1).min() for group in GROUPS]
        return np.asarray((np.log1p(np.sqrt(found)) - self.centre[check]) / self.scale[check])

    def _differences(self, check: int, summary: Floats) -> Floats:
        """Return the whitened differences from recordings of each fraction, (n_fractions, N_SUMMARY)."""
        return np.asarray((summary - powers(_FRACTIONS) @ self.mean[check]) @ self.whitening[check].T)

    def misfit(self, check: int, summary: Floats) -> Misfit:
        """Return what of a foreign recording does not fit: the farthest group, and others that are told, too."""
        distances, found = self.distances(check, summary), list[Misfit]()
        for group in np.argsort(-distances).tolist():
            if found and not self.is_foreign(float(distances[group])):
                break
            if group:
                part = (MisfitPart.BEAM, MisfitPart.NOISE)[group == _OF_NOISE]
                found.append(Misfit(part, CHECKS[check], float("nan")))
            else:
                found += self._of_pulses(check, self._differences(check, summary)[:, GROUPS[0]])
        return found[0]._replace(others=tuple(found[1:]))

    def _of_pulses(self, check: int, differences: Floats) -> list[Misfit]:
        """Return which factors explain the differences of pulses (n_fractions, 15), the best first."""
        found = []
        for part, columns, power in (
            (MisfitPart.SCALE, (_IMPULSE, _HARDNESS), 1.0),
            (MisfitPart.SIZES, (_IMPULSE,), 1.0),
            (MisfitPart.SEAM, (_HARDNESS,), _OF_MODULUS),
        ):
            shift = np.zeros(N_SUMMARY)
            for column in columns:
                shift[column] = 1.0
            direction = (self.whitening[check] @ shift)[GROUPS[0]]
            along = differences @ direction / (direction @ direction)
            left = np.square(differences - along[:, None] * direction).sum(axis=1)
            best = int(np.argmin(left))
            found.append((float(left[best]), Misfit(part, CHECKS[check], float(np.exp(along[best] / power)))))
        found.sort(key=lambda one: one[0])
        return [misfit for left, misfit in found if left <= _ALIKE * found[0][0]]


class WorldTest:
    """The test of one recording: `misfit` is None until it is told as foreign."""

    def __init__(self, world: World) -> None:
        self._world, self._largest = world, -np.inf
        self.misfit: Misfit | None = None

    def look(self, traits: Sequence[tuple[float, ...]]) -> None:
        """Compare the impacts so far, as many as one of `CHECKS`, each with the values of `trait_names`; in order."""
        check = CHECKS.index(len(traits))
        with np.errstate(all="ignore"):
            seen = summary(np.array(traits))
        if self.misfit is None and np.isfinite(seen).all():
            self._largest = max(self._largest, float(self._world.distances(check, seen).max()))
            if self._world.is_foreign(self._largest):
                self.misfit = self._world.misfit(check, seen)
