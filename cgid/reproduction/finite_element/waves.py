"""The vibration waves of a simulated impact, and the low-pass that takes them off."""

from __future__ import annotations

import numpy as np

from cgid.measure.filters import fft_filter
from cgid.reproduction.finite_element.cases import UNDAMPED
from cgid.reproduction.finite_element.study import Run, Study
from cgid.validation import Floats

#: A course has waves if its ripple, its largest distance from its own low-pass at 10/T over its peak, is beyond this.
WAVES = 0.05
_RIPPLE_EDGE = 10
#: A filtered peak is the force's within this part of it.
FILTERED = 0.015


def low_passed(samples: Floats, sampling_rate: float, edge: float) -> Floats:
    """Return a course behind the paper's FFT filter, a brick wall at an edge [Hz]."""
    # The filter is circular: before the touch there was nothing, and that must be said.
    whole = np.concatenate((np.zeros(samples.size), samples))
    return np.asarray(fft_filter(whole, sampling_rate, high=edge)[samples.size :], np.float64)


def ripple(run: Run, name: str) -> float:
    """Return how far a course is from its own low-pass at 10/T at most, over its largest value."""
    course = run.courses[name]
    rate = (course.size - 1) / run.duration
    smooth = low_passed(course, rate, _RIPPLE_EDGE / run.numbers["contact_duration"])
    touching = run.times <= run.numbers["contact_duration"]
    return float(np.abs(course - smooth)[touching].max() / course.max())


def ripples(study: Study, name: str) -> Floats:
    """Return the ripple of a course of each undamped impact."""
    return np.array([ripple(run, name) for run in study.of(UNDAMPED)])


def filtered_errors(study: Study, edge: int) -> Floats:
    """Return peak of the filtered centre node's force over that of the contact force - 1, edge in 1/T."""
    return study.values(UNDAMPED, f"filtered_at_{edge}") / study.values(UNDAMPED, "peak_force") - 1
