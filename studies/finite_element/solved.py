"""Impacts solved by finite elements: their file, their signals by a scene, and smooth courses of their forces."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.files import read_regular
from cgid._lib.validation import Floats
from cgid.errors import BadData, InvalidValue
from cgid.physics.contact.sampled import MIN_POINTS, SampledPulses, angle_of
from cgid.scene import Scene, synthesise_given
from cgid.scene.synthesis.draws import BLOCK, FALL, numbers_of
from cgid.signals import Batch

#: Columns of a file of solved impacts: those stored with each signal, and those that produced the impact.
PARAMETERS = ("density", "youngs_modulus", "poisson_ratio", "drop_height", "velocity", "restitution")
MAKING = ("restitution_asked", "retardation_time")
#: Largest file of solved impacts [bytes].
_MAX_FILE_SIZE = 64 << 20
_MAKER = "python datasets/make_finite_element.py, in a checkout of cgid"
#: Index of the random number of a signal's radius; the first one selects its population.
_RADIUS = 1 + FALL.index("radius")
#: Degree of the spline through a course.
_CUBIC = 3


def smoothed(times: ArrayLike, forces: ArrayLike, contact_duration: float, shares: ArrayLike, knots: int = 8) -> Floats:
    """Return the force [N] of one noisy pulse at fractions of its contact: a cubic spline by least squares."""
    # Eight knots fit a damped impact within .3 % of its peak, and remove the force steps of a mesh.
    from scipy.interpolate import BSpline

    since, values = validation.real("times", times, "s"), validation.real("forces", forces, "N")
    _require_samples(since, values)
    lasts = validation.number("contact_duration", contact_duration, "s", validation.positive)
    inside = (since > 0) & (since < lasts)
    if inside.sum() < 2 * (knots + MIN_POINTS):
        raise InvalidValue(
            f"forces must have {2 * (knots + MIN_POINTS)} samples or more within contact for {knots} knots, got "
            f"{inside.sum()}"
        )
    inner = np.linspace(0, np.pi, knots + 2)
    ends = np.concatenate([[0.0] * _CUBIC, inner, [np.pi] * _CUBIC])
    basis = BSpline.design_matrix(angle_of(since[inside] / lasts), ends, _CUBIC).toarray()
    # The first and last coefficients are the values at onset and separation: 0.
    coefficients = np.zeros(basis.shape[1])
    coefficients[1:-1], _, rank, _ = np.linalg.lstsq(basis[:, 1:-1], values[inside])
    if rank < coefficients.size - 2:
        raise InvalidValue(f"times must cover the contact for {knots} knots, and leave a part of it empty")
    spline = BSpline(ends, coefficients, _CUBIC)
    return np.asarray(np.maximum(spline(angle_of(validation.real("shares", shares))), 0.0))


def _require_samples(times: Floats, forces: Floats) -> None:
    if times.ndim != 1 or forces.shape != times.shape:
        raise InvalidValue(f"forces must be one for each of the times, got shape {forces.shape} for {times.shape}")
    falls = np.flatnonzero(np.diff(times) <= 0)
    if falls.size:
        row = falls[0]
        raise InvalidValue(f"times must rise, got {times[row + 1]:g} s after {times[row]:g} s at index {row + 1}")


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedImpacts:
    """Impacts of spheres of 1 m radius.

    Attributes
    ----------
    pulses : SampledPulses
        Forces [N] and durations [s] of n spheres of 1 m.
    labels : ndarray of str, (n,)
    columns : mapping of str to ndarray, (n,)
        `PARAMETERS` in SI units, with the restitution as solved, and `MAKING`: the requested restitution and the
        retardation time of the sphere's material [s].
    made : mapping
        Scene, seed, mesh and steps of the solution.
    """

    pulses: SampledPulses
    labels: NDArray[np.str_]
    columns: Mapping[str, Floats]
    made: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.pulses)

    def signals(self, scene: Scene, seed: int = 0) -> Iterator[Batch]:
        """Yield the signals of a scene with these pulses in batches of at most 256; the seed determines the radii.

        Radii are drawn as in the scene, onsets and noise as in `synthesise_given`.
        """
        radius = radii(scene, self.labels, seed)
        known = {name: self.columns[name] for name in PARAMETERS} | {"radius": radius}
        yield from synthesise_given(scene, self.pulses.stretched(radius**2, radius), self.labels, known, seed)

    def to_bytes(self) -> bytes:
        """Return the content of a file; equal impacts give equal bytes."""
        arrays: dict[str, NDArray[Any]] = {
            "made": np.frombuffer(json.dumps(dict(self.made), sort_keys=True).encode(), np.uint8),
            "shares": self.pulses.shares,
            "forces": self.pulses.forces.astype(np.float32),
            "contact_duration": self.pulses.contact_duration,
            "labels": self.labels,
        }
        arrays |= {name: self.columns[name] for name in (*PARAMETERS, *MAKING)}
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        return stream.getvalue()

    @classmethod
    def load(cls, path: str | Path) -> SolvedImpacts:
        """Return the impacts of a file; raises `NoInput` if it cannot be read, `BadData` for other content."""
        content = read_regular(path, "solved impacts", _MAX_FILE_SIZE, f"make them: {_MAKER}")
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            pulses = SampledPulses(
                shares=arrays["shares"], forces=arrays["forces"], contact_duration=arrays["contact_duration"]
            )
            columns = {name: validation.real(name, arrays[name]) for name in (*PARAMETERS, *MAKING)}
            made = json.loads(arrays["made"].tobytes())
            _require_sound(arrays["labels"], columns, made, len(pulses))
        except Exception as error:
            raise BadData(f"{path}: no solved impacts ({error}); make them: {_MAKER}") from None
        return cls(pulses=pulses, labels=arrays["labels"], columns=columns, made=made)


def _require_sound(labels: NDArray[Any], columns: Mapping[str, Floats], made: Any, n: int) -> None:
    if any(column.shape != (n,) for column in (labels, *columns.values())):
        raise ValueError("columns must have a row for each pulse")
    if labels.dtype.kind != "U":
        raise ValueError(f"labels must be text, got {labels.dtype}")
    if not isinstance(made, dict) or "scene" not in made:
        raise ValueError("made must be a mapping by name, the scene too")
    for name, column in columns.items():
        if name == "poisson_ratio":
            validation.poisson_ratio(name, column)
        else:
            validation.positive(name, column)


def radii(scene: Scene, labels: NDArray[np.str_], seed: int) -> Floats:
    """Return random radii [m] of a scene for labels, from the first population of each label."""
    sizes = np.empty(len(labels))
    laws = {population.label: population.radius for population in reversed(scene.populations)}
    for first in range(0, len(labels), BLOCK):
        numbers = numbers_of(seed, first // BLOCK)[_RADIUS][: len(labels) - first]
        here = slice(first, first + len(numbers))
        for label in np.unique(labels[here]):
            validation.choice("label", str(label), laws)
            rows = np.flatnonzero(labels[here] == label)
            sizes[first + rows] = laws[str(label)].quantile(numbers[rows])
    return sizes
