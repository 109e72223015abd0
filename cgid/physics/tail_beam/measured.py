"""Modes measured by a tap test: what a user has instead of a model of his beam."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.files import read_regular
from cgid.validation import Floats

#: The columns of a table of modes, with their units.
COLUMNS = {
    "frequency": "Hz",
    "damping_ratio": "1",
    "modal_mass": "kg",
    "shape_impact": "1",
    "shape_sensor": "1",
}
#: No table of modes is longer [bytes].
_LARGEST_FILE = 8 << 20


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredModes:
    """Modes as a tap test gives them, for one place that is hit and one sensor.

    Parameters
    ----------
    frequency : array_like, (n_modes,)
        [Hz], above 0, ascending.
    damping_ratio : array_like, (n_modes,)
        Above 0, below 1.
    modal_mass : array_like, (n_modes,)
        [kg], above 0, in the scale of the shapes.
    shape_impact, shape_sensor : array_like, (n_modes,)
        Dimensionless, at the two places.

    Raises
    ------
    InvalidValue
        A value breaks its rule, or the columns are not equally long.
    """

    frequency: ArrayLike
    damping_ratio: ArrayLike
    modal_mass: ArrayLike
    shape_impact: ArrayLike
    shape_sensor: ArrayLike

    def __post_init__(self) -> None:
        columns = {name: _require_rule(name, getattr(self, name)) for name in COLUMNS}
        lengths = {name: column.shape for name, column in columns.items()}
        if len(set(lengths.values())) > 1 or columns["frequency"].ndim != 1 or not columns["frequency"].size:
            shapes = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
            raise InvalidValue(f"measured modes must be equally long rows of at least one number, got {shapes}")
        unsorted = np.flatnonzero(np.diff(columns["frequency"]) < 0)
        if unsorted.size:
            raise InvalidValue(
                "frequency must ascend from mode to mode, got "
                f"{columns['frequency'][unsorted[0] + 1]:g} Hz at index {unsorted[0] + 1} after "
                f"{columns['frequency'][unsorted[0]]:g} Hz; sort the modes"
            )
        for name, column in columns.items():
            object.__setattr__(self, name, column)
        validation.hold(self, *COLUMNS)

    def participation(self) -> Floats:
        """Return how much each mode carries from impact to sensor, `shape_impact shape_sensor / modal_mass` [1/kg].

        Returns
        -------
        ndarray, (n_modes,)
        """
        impact, sensor, mass = (
            np.asarray(getattr(self, name)) for name in ("shape_impact", "shape_sensor", "modal_mass")
        )
        return np.asarray(impact * sensor / mass)

    def up_to(self, frequency: float) -> MeasuredModes:
        """Return only the modes up to a frequency [Hz], of which there must be one."""
        highest, natural = validation.positive("frequency", frequency, "Hz"), np.asarray(self.frequency)
        if natural[0] > highest:
            raise InvalidValue(
                f"frequency must reach the lowest measured mode at {natural[0]:g} Hz, got {highest:g} Hz; "
                "raise it or measure lower modes"
            )
        return MeasuredModes(**{name: np.asarray(getattr(self, name))[natural <= highest] for name in COLUMNS})


def read_measured_modes(path: str | Path) -> MeasuredModes:
    r"""Read a table of modes from a comma-separated file.

    Parameters
    ----------
    path : str or Path
        UTF-8 text. The first line names the columns, in any order, each with its unit: `frequency [Hz]`,
        `damping_ratio [1]`, `modal_mass [kg]`, `shape_impact [1]`, `shape_sensor [1]`; others are passed over. A line
        a mode follows; empty lines and lines that begin with # are passed over.

    Raises
    ------
    NoInput
        The file cannot be opened.
    BadData
        It is no regular file or too large, a column or a number is missing, the rows are not sorted, or a number breaks
        its rule; with the line's number.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "tap.csv"
    ...     _ = file.write_text(
    ...         "frequency [Hz],damping_ratio [1],modal_mass [kg],shape_impact [1],shape_sensor [1]\n"
    ...         "118.5,0.012,210,0.9,0.4\n"
    ...         "187.0,0.010,180,0.3,-0.7\n"
    ...     )
    ...     modes = read_measured_modes(file)
    >>> modes.participation().round(6).tolist()
    [0.001714, -0.001167]
    """
    try:
        text = read_regular(path, "the table of modes", _LARGEST_FILE).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BadData(f"{path}: a table of modes must be UTF-8 text; save it as CSV in UTF-8") from None
    lines = [
        (number, next(csv.reader([line], skipinitialspace=True)))
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip(" ,\t") and not line.lstrip().startswith("#")
    ]
    if len(lines) < 2:
        raise BadData(f"{path}: a table of modes must have a line of column names and a line a mode, got {len(lines)}")
    places = _places(path, [title.strip() for title in lines[0][1]])
    rows = [_row(f"{path}, line {number}", cells, places) for number, cells in lines[1:]]
    for (number, _), before, row in zip(lines[2:], rows[:-1], rows[1:], strict=True):
        if row["frequency"] < before["frequency"]:
            raise BadData(
                f"{path}, line {number}: frequency must ascend from line to line, got {row['frequency']:g} Hz after "
                f"{before['frequency']:g} Hz; sort the modes"
            )
    return MeasuredModes(**{name: np.array([row[name] for row in rows]) for name in COLUMNS})


def _places(path: str | Path, titles: list[str]) -> dict[str, int]:
    """Return in which cell of a line each column stands."""
    wanted = {name: f"{name} [{unit}]" for name, unit in COLUMNS.items()}
    for name, title in wanted.items():
        if titles.count(title) != 1:
            # What a scene names may be any file of whoever loads it: only a table of modes is quoted.
            is_table = any(other in titles for other in wanted.values())
            others = f"only {', '.join(map(repr, titles))}" if is_table else "none of the columns of a table of modes"
            found = "twice" if title in titles else others
            raise BadData(f"{path}: the column {title!r} must be there once, got {found}; {name} needs its unit, too")
    return {name: titles.index(title) for name, title in wanted.items()}


def _row(place: str, cells: list[str], places: dict[str, int]) -> dict[str, float]:
    """Return the numbers of one mode, or raise with the place."""
    row = {}
    for name, index in places.items():
        cell = cells[index].strip() if index < len(cells) else ""
        try:
            row[name] = float(cell)
        except ValueError:
            raise BadData(f"{place}: {name} must be a number, got {cell!r}") from None
        try:
            _require_rule(name, row[name])
        except InvalidValue as error:
            raise BadData(f"{place}: {error}") from None
    return row


def _require_rule(name: str, value: ArrayLike) -> Floats:
    """Return a column or a cell as numbers, or raise."""
    unit = COLUMNS[name]
    if name.startswith("shape"):
        return validation.real(name, value)
    numbers = validation.positive(name, value, unit if unit != "1" else "")
    if name == "damping_ratio":
        over = np.flatnonzero(np.atleast_1d(numbers) >= 1)
        if over.size:
            index = f" at index {over[0]}" if numbers.ndim else ""
            raise InvalidValue(
                f"{name} must be below 1, where a mode ceases to ring, got {numbers.ravel()[over[0]]:g}{index}"
            )
    return numbers
