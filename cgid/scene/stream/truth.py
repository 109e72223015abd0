"""The truth of every impact of a recording, stored beside it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.scene.population import PARAMETER_UNITS, POINT_UNITS
from cgid.scene.scene import Scene
from cgid.scene.stream.rocks import Rocks
from cgid.validation import Floats

#: Columns in the order in which they are stored, and their units.
_UNITS = {"time": "s", "rock": "1", "bounce": "1"} | {
    name: unit for name, unit in PARAMETER_UNITS.items() if name != "onset"
}
#: What only the impact itself tells.
DELIVERED = ("restitution", "peak_force", "contact_duration")
_NEIGHBOUR_UNITS = {"next_impact": "s", "overlapping": "1"}


def impact_units(scene: Scene) -> dict[str, str]:
    """Return the numbers that are known of each impact, and their units.

    time: of touch, from the first sample. rock: its number in the recording, by arrival. bounce: how many impacts it
    has behind it. restitution: as delivered, target and all. drop_height: nan but for a first fall from a height.
    velocity: the normal one. next_impact: time to the next touch of any rock, nan for the last. overlapping: 1 where
    the contact has a part in common with another. impact_x, impact_y: on a beam of known size.
    """
    place = {} if scene.panel is None else POINT_UNITS
    return {**_UNITS, **place, **_NEIGHBOUR_UNITS}


def truth_of(scene: Scene, rocks: Rocks, delivered: Mapping[str, Floats]) -> dict[str, NDArray[Any]]:
    """Return what is known of some impacts, their neighbours apart; delivered is of `DELIVERED`."""
    labels = np.array([population.label for population in scene.populations])
    truth = {
        **{name: rocks[name] for name in _UNITS.keys() & rocks.columns.keys()},
        **delivered,
        "label": labels[rocks["population"]],
        "specimen": rocks["specimen"],
    }
    if scene.panel is not None:
        truth |= {"impact_x": rocks["impact_x"], "impact_y": rocks["impact_y"]}
    return truth


def empty_truth(scene: Scene) -> dict[str, NDArray[Any]]:
    """Return the truth of no impacts."""
    width = max(len(label) for label in scene.labels)
    kinds: dict[str, np.dtype[Any]] = {
        name: np.dtype(np.float64) for name in impact_units(scene) if name not in _NEIGHBOUR_UNITS
    }
    kinds["rock"] = kinds["bounce"] = np.dtype(np.int64)
    kinds |= {"label": np.dtype(f"U{width}"), "specimen": np.dtype(np.uint64)}
    return {name: np.empty(0, kind) for name, kind in kinds.items()}


def joined(scene: Scene, parts: list[dict[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the truth of a whole recording from that of its parts in order, neighbours and all."""
    truth = {name: np.concatenate([part[name] for part in parts]) for name in empty_truth(scene)}
    touch = truth["time"]
    separation = touch + truth["contact_duration"]
    distance = np.append(np.diff(touch), np.nan)[: touch.size]
    earlier = np.append(-np.inf, np.maximum.accumulate(separation))[: touch.size]
    later = np.append(touch[1:], np.inf)[: touch.size]
    truth["next_impact"] = distance
    truth["overlapping"] = ((touch < earlier) | (later < separation)).astype(np.int64)
    return truth
