"""One figure of the paper: its data, and how it is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cgid.physics import Impact
from cgid.reproduction.drawing import Panel


@dataclass(frozen=True, kw_only=True)
class PaperFigure:
    """A figure of the paper, computed.

    Parameters
    ----------
    name : str
        Of its files, without the ending.
    title : str
    note : str
        What was chosen here because the paper does not say it.
    data : pandas.DataFrame
        Columns named as in `quantities`, in SI units.
    panels : tuple of Panel
    columns : int
        Panels beside each other.
    highest_strain : float
        Largest displacement over radius of its impacts; above 0.1 Hertz's theory is out of its range.
    """

    name: str
    title: str
    note: str = ""
    data: Any
    panels: tuple[Panel, ...]
    columns: int = 1
    highest_strain: float


def frame(columns: Mapping[str, ArrayLike]) -> Any:
    """Return a data frame of columns broadcast against each other, a row for each element."""
    import pandas as pd

    arrays = np.broadcast_arrays(*columns.values())
    return pd.DataFrame({name: array.ravel() for name, array in zip(columns, arrays, strict=True)})


def joined(frames: list[Any]) -> Any:
    """Return data frames below each other."""
    import pandas as pd

    return pd.concat(frames, ignore_index=True)


def highest_strain(*of: Impact) -> float:
    """Return the largest displacement over radius of these impacts."""
    return max(float(np.max(impact.peak_displacement / impact.reduced_radius)) for impact in of)
