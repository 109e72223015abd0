"""What the two ways through time have in common: records of the motion, and when it is over."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from cgid.errors import InvalidValue
from cgid.finite_element.limits import require_followed
from cgid.finite_element.mesh import REACH
from cgid.finite_element.pair import Pair
from cgid.validation import Floats

#: Records of a Hertz impact's duration, and how many are made before it is asked again whether all is over.
PER_DURATION, AT_ONCE = 2000, 25
#: After the contact the bodies are followed for this part of Hertz's duration, and never longer than so many of them.
AFTERWARDS, LONGEST = 0.25, 12.0
#: Columns of `Records.values`, and those of the momenta of sphere and plate.
N_VALUES, MOMENTA = 9, slice(6, 8)

Progress = Callable[[float], object]


@dataclass(frozen=True)
class Records:
    """The motion at even intervals from first touch on.

    Parameters
    ----------
    interval, step : float
        Between records, and of the integration [s].
    forces : ndarray, (n_records, n_contact)
        Contact force of each node [N].
    values : ndarray, (n_records, 9)
        Displacements of the sphere's centre and mass centre [m], acceleration of its centre [m/s^2], internal energies
        of sphere and plate and kinetic energy of both [J], momentum of the sphere, of the plate, and impulse of the
        contact force until then [N s]; upwards is positive.
    """

    interval: float
    step: float
    forces: Floats
    values: Floats


def collected(
    chunks: Iterator[tuple[Floats, Floats]],
    pair: Pair,
    interval: float,
    step: float,
    duration: float,
    progress: Progress | None,
) -> Records:
    """Return the records of a run, which ends a while after the last contact force, when the mass centres move apart.

    A free plate that swings may still strike the sphere once more after that.

    Raises
    ------
    InvalidValue
        The contact outgrows the part of the mesh made for it, the bodies never part, or do so within a few steps.
    """
    forces: list[Floats] = []
    values: list[Floats] = []
    count = last = 0
    for some_forces, some_values in chunks:
        if some_forces[:, -1].any():
            raise InvalidValue(
                f"the contact must stay within {REACH:g} times Hertz's contact radius, which the mesh is made for, "
                "and it grew wider; use a stiffer contact, or a thicker plate"
            )
        pressed = np.flatnonzero(some_forces.any(axis=1))
        if pressed.size:
            last = count + int(pressed[-1]) + 1
        forces.append(some_forces)
        values.append(some_values)
        count += len(some_forces)
        if progress is not None:
            progress(count * interval / duration)
        is_quiet = (count - last) * interval >= AFTERWARDS * duration and count * interval >= duration / 2
        if is_quiet and pair.parting_speed(*some_values[-1, MOMENTA]) >= 0:
            require_followed((last - 1) * interval, step)
            kept = last + int(AFTERWARDS * duration / interval)
            return Records(interval, step, np.concatenate(forces)[:kept], np.concatenate(values)[:kept])
        if count * interval > LONGEST * duration:
            break
    raise InvalidValue(
        f"the sphere must part from the plate, it still touches or nears it after {count * interval:.3g} s, "
        f"{LONGEST:g} durations of an elastic impact; use a smaller retardation_time, or a heavier plate"
    )
