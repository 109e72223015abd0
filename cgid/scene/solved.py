"""Impacts solved by finite elements, once, of spheres of 1 m: a test set of other physics, for every size.

Without gravity an impact has no size: at the same speed a sphere of R times the radius, of a material whose damping
time is R times as long, has R times the time and R^2 times the force.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid import validation
from cgid.errors import BadData
from cgid.files import read_regular
from cgid.physics.sampled import SampledPulses
from cgid.scene.given_pulses import synthesise_given
from cgid.scene.population import FALL, numbers_of
from cgid.scene.randomness import BLOCK
from cgid.scene.scene import Scene
from cgid.signals import Batch
from cgid.validation import Floats

#: Columns of a file beside its pulses: what is stored with each signal, and what made the impact.
PARAMETERS = ("density", "youngs_modulus", "poisson_ratio", "drop_height", "velocity", "restitution")
MAKING = ("restitution_asked", "retardation_time")
#: A larger file is none of ours.
_LARGEST_FILE = 64 << 20
_MAKER = "python datasets/make_finite_element.py"
#: Which of the numbers of a signal says its radius: the first says its population.
_RADIUS = 1 + FALL.index("radius")


@dataclass(frozen=True, kw_only=True, eq=False)
class SolvedImpacts:
    """Impacts of spheres of 1 m radius.

    Attributes
    ----------
    pulses : SampledPulses
        n of them: forces [N] and durations [s] of spheres of 1 m.
    labels : ndarray of str, (n,)
    columns : dict of ndarray, each (n,)
        `PARAMETERS`, in SI units, restitution as it came out; and `MAKING`: the one asked for, and the retardation
        time of the sphere's material [s].
    made : dict
        How: scene, seed, mesh, steps.
    """

    pulses: SampledPulses
    labels: NDArray[np.str_]
    columns: Mapping[str, Floats]
    made: Mapping[str, Any]

    def __len__(self) -> int:
        return len(self.pulses)

    def of_radius(self, radius: ArrayLike) -> SampledPulses:
        """Return the pulses of spheres of these radii [m], one or (n,)."""
        radius = validation.positive("radius", radius, "m")
        return self.pulses.stretched(radius**2, radius)

    def signals(self, scene: Scene, seed: int = 0) -> Iterator[Batch]:
        """Yield the signals of a scene with these pulses in batches of at most 256; another seed gives other sizes.

        Radii are drawn as the scene draws them, onsets and noise as `synthesise_given` says.
        """
        radius = radii(scene, self.labels, seed)
        known = {name: self.columns[name] for name in PARAMETERS} | {"radius": radius}
        yield from synthesise_given(scene, self.of_radius(radius), self.labels, known, seed)

    def to_bytes(self) -> bytes:
        """Return the content of a file; the same impacts give the same bytes."""
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
        """Return the impacts of a file.

        Raises
        ------
        NoInput
            The file cannot be read.
        BadData
            It holds something else.
        """
        content = read_regular(path, "solved impacts", _LARGEST_FILE, f"make them: {_MAKER}")
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as stored:
                held = {name: stored[name] for name in stored.files}
            pulses = SampledPulses(
                shares=held["shares"], forces=held["forces"], contact_duration=held["contact_duration"]
            )
            columns = {name: validation.real(name, held[name]) for name in (*PARAMETERS, *MAKING)}
            made = json.loads(held["made"].tobytes())
            _require_sound(held["labels"], columns, made, len(pulses))
        except Exception as error:
            raise BadData(f"{path}: no solved impacts ({error}); make them: {_MAKER}") from None
        return cls(pulses=pulses, labels=held["labels"], columns=columns, made=made)


def _require_sound(labels: NDArray[Any], columns: Mapping[str, Floats], made: Any, n: int) -> None:
    if any(column.shape != (n,) for column in (labels, *columns.values())):
        raise ValueError("columns must have a row for each pulse")
    if labels.dtype.kind != "U":
        raise ValueError(f"labels must be text, got {labels.dtype}")
    if not isinstance(made, dict) or "scene" not in made:
        raise ValueError("how they were made must be told by name, the scene too")
    for name, column in columns.items():
        if name == "poisson_ratio":
            validation.poisson_ratio(name, column)
        else:
            validation.positive(name, column)


def radii(scene: Scene, labels: NDArray[np.str_], seed: int) -> Floats:
    """Return radii [m] as a scene draws them for labels; of populations that share a label the first counts."""
    found = np.empty(len(labels))
    laws = {population.label: population.radius for population in reversed(scene.populations)}
    for first in range(0, len(labels), BLOCK):
        numbers = numbers_of(seed, first // BLOCK)[_RADIUS][: len(labels) - first]
        here = slice(first, first + len(numbers))
        for label in np.unique(labels[here]):
            validation.choice("label", str(label), laws)
            rows = np.flatnonzero(labels[here] == label)
            found[first + rows] = laws[str(label)].quantile(numbers[rows])
    return found
