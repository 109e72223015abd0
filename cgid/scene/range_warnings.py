"""Populations reach past the range of a theory here and there: `cgid check` says how often, nobody else need."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from cgid.physics import HertzRangeWarning, ThinPlateWarning


@contextmanager
def unwarned() -> Iterator[None]:
    """Draw in silence where a population reaches past Hertz's or Zener's range."""
    with warnings.catch_warnings():
        for beyond in (HertzRangeWarning, ThinPlateWarning):
            warnings.simplefilter("ignore", beyond)
        yield
