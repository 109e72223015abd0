"""Modes of a tail beam: computed, measured by a tap test, or learned from blows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.files import read_cells
from cgid.physics.plates import Shapes
from cgid.validation import Floats

Point = tuple[ArrayLike, ArrayLike]

#: Columns of a table of measured modes, with their units.
COLUMNS = {"frequency": "Hz", "damping_ratio": "1", "modal_mass": "kg", "shape_impact": "1", "shape_sensor": "1"}
#: Columns of a table of learned modes, with their units. A deviation is that of the logarithm.
LEARNED_COLUMNS = {
    "frequency": "Hz",
    "damping_ratio": "1",
    "participation": "1",
    "frequency_deviation": "1",
    "damping_ratio_deviation": "1",
    "participation_deviation": "1",
}
#: Drawn damping ratios stay below this one.
_MOST_DAMPING = 0.7
#: Largest file of modes [bytes].
_LARGEST_FILE = 8 << 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Modes:
    """Natural modes of a rectangular panel, as returned by `TailBeam.modes`.

    Mode r obeys `q_r'' + 2 zeta_r omega_r q_r' + omega_r^2 q_r = shape_r(impact) P / m_r`; a point of the panel moves
    by the sum of `shape_r(point) q_r`.

    Parameters
    ----------
    frequency : ndarray, (n_modes,) [Hz]
        Undamped natural frequencies, ascending.
    damping_ratio : ndarray, (n_modes,)
    modal_mass : ndarray, (n_modes,) [kg]
        Integral of mass per area times squared shape.
    length, width : float [m]
        Size of the panel.
    shapes : callable
        Functions over the unit square, each with mean square 1/4.
    """

    frequency: Floats
    damping_ratio: Floats
    modal_mass: Floats
    length: float
    width: float
    shapes: Shapes

    def __post_init__(self) -> None:
        validation.hold(self, "frequency", "damping_ratio", "modal_mass")

    def shape(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the dimensionless shapes of all modes at points of the panel, (..., n_modes).

        x [m] is along the length from the held edge, y [m] over the width from one side; they broadcast. A point off
        the panel raises `InvalidValue`.
        """
        along, across = validation.broadcast(x=on_panel("x", x, self.length), y=on_panel("y", y, self.width))
        values = self.shapes.at(along.ravel(), across.ravel())
        return values.reshape(*along.shape, self.frequency.size)

    def participation(self, impact: Point, sensor: Point) -> Floats:
        """Return `shape(impact) shape(sensor) / modal_mass` of each mode, (..., n_modes) [1/kg].

        The points (x, y) [m] are those of the force and of the measured motion.
        """
        return self.shape(*impact) * self.shape(*sensor) / self.modal_mass

    def taken(self, modes: NDArray[np.intp]) -> Modes:
        """Return the modes with these indices, which must ascend."""
        return replace(
            self,
            frequency=self.frequency[modes],
            damping_ratio=self.damping_ratio[modes],
            modal_mass=self.modal_mass[modes],
            shapes=self.shapes.taken(modes),
        )


def on_panel(name: str, value: ArrayLike, extent: float) -> Floats:
    """Return positions on the panel as a fraction of its side, or raise `InvalidValue`."""
    place = validation.real(name, value, "m")
    off = np.flatnonzero((place < 0) | (place > extent))
    if off.size:
        index = f" at index {off[0]}" if place.ndim else ""
        raise InvalidValue(
            f"{name} must lie on the beam, from 0 to {extent:g} m, got {place.ravel()[off[0]]:g} m{index}"
        )
    return place / extent


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredModes:
    """Modes from a tap test, for one point of impact and one sensor; all fields are (n_modes,).

    Parameters
    ----------
    frequency : array_like [Hz]
        Above 0, ascending.
    damping_ratio : array_like
        Above 0 and below 1.
    modal_mass : array_like [kg]
        Above 0, consistent with the scale of the shapes.
    shape_impact, shape_sensor : array_like
        Dimensionless shapes at the two points.
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
        validation.ascending("frequency", columns["frequency"], "Hz")
        for name, column in columns.items():
            object.__setattr__(self, name, column)
        validation.hold(self, *COLUMNS)

    def participation(self) -> Floats:
        """Return `shape_impact shape_sensor / modal_mass` of each mode [1/kg], (n_modes,)."""
        impact, sensor, mass = (
            np.asarray(getattr(self, name)) for name in ("shape_impact", "shape_sensor", "modal_mass")
        )
        return np.asarray(impact * sensor / mass)


@dataclass(frozen=True, kw_only=True, eq=False)
class LearnedModes:
    """What blows have told of the modes of a beam; all fields are (n_modes,), in the order of the beam's own modes.

    Attributes
    ----------
    frequency : [Hz]; two modes may have changed places
    damping_ratio, participation : the second is a factor of that of the beam's own mode
    frequency_deviation, damping_ratio_deviation, participation_deviation : standard deviations of their logarithms
    """

    frequency: Floats
    damping_ratio: Floats
    participation: Floats
    frequency_deviation: Floats
    damping_ratio_deviation: Floats
    participation_deviation: Floats

    @classmethod
    def of(
        cls, frequency: Floats, damping_ratio: Floats, participation: Floats, deviations: Floats | float = 0.0
    ) -> LearnedModes:
        """Return modes with these deviations, (3, n_modes); without any they are certain."""
        own = np.broadcast_to(deviations, (3, frequency.size))
        values = (frequency, damping_ratio, participation, *own)
        return cls(**dict(zip(LEARNED_COLUMNS, values, strict=True)))

    @property
    def deviations(self) -> Floats | None:
        """Those of frequency, damping ratio and participation, (3, n_modes); None if all are 0."""
        found = np.stack([self.frequency_deviation, self.damping_ratio_deviation, self.participation_deviation])
        return found if found.any() else None

    def drawn(self, uniform: Floats) -> LearnedModes:
        """Return certain modes, drawn from these for uniform numbers (3, n_modes), each mode by itself."""
        normal = ndtri(uniform)
        damping = self.damping_ratio * np.exp(self.damping_ratio_deviation * normal[1])
        return LearnedModes.of(
            self.frequency * np.exp(self.frequency_deviation * normal[0]),
            np.minimum(damping, np.maximum(self.damping_ratio, _MOST_DAMPING)),
            self.participation * np.exp(self.participation_deviation * normal[2]),
        )


def read_measured_modes(path: str | Path) -> MeasuredModes:
    r"""Read a table of modes from a UTF-8 file of comma-separated values.

    The first line names the columns with their units, in any order: `frequency [Hz]`, `damping_ratio [1]`,
    `modal_mass [kg]`, `shape_impact [1]`, `shape_sensor [1]`; other columns are ignored. Each further line holds one
    mode; empty lines and lines that begin with # are ignored.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    MeasuredModes

    Raises
    ------
    NoInput
        The file cannot be opened.
    BadData
        The file is not regular, too large or invalid; the message names the line.

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
    rows = _rows(path, COLUMNS)
    for (number, row), (_, before) in zip(rows[1:], rows[:-1], strict=True):
        if row["frequency"] < before["frequency"]:
            raise BadData(
                f"{path}, line {number}: frequency must ascend from line to line, got {row['frequency']:g} Hz after "
                f"{before['frequency']:g} Hz; sort the modes"
            )
    return MeasuredModes(**{name: np.array([row[name] for _, row in rows]) for name in COLUMNS})


def read_learned_modes(path: str | Path) -> LearnedModes:
    """Read a table of learned modes, as `cgid calibrate` writes it; the file is like that of `read_measured_modes`.

    Its columns are `frequency [Hz]`, `damping_ratio [1]`, `participation [1]` and their deviations, such as
    `frequency_deviation [1]`. Lines are in the order of the beam's own modes. Raises as `read_measured_modes`.
    """
    rows = _rows(path, LEARNED_COLUMNS)
    return LearnedModes(**{name: np.array([row[name] for _, row in rows]) for name in LEARNED_COLUMNS})


def table_of(columns: Mapping[str, Floats]) -> str:
    """Return columns of `COLUMNS` or `LEARNED_COLUMNS`, each (n_modes,), as the text of a table of modes."""
    units = COLUMNS | LEARNED_COLUMNS
    titles = ",".join(f"{name} [{units[name]}]" for name in columns)
    rows = (",".join(f"{float(value)!r}" for value in row) for row in zip(*columns.values(), strict=True))
    return "\n".join((titles, *rows)) + "\n"


def _rows(path: str | Path, columns: dict[str, str]) -> list[tuple[int, dict[str, float]]]:
    """Return the numbers of each mode by column, with the number of its line."""
    lines = read_cells(path, "the table of modes", _LARGEST_FILE)
    if len(lines) < 2:
        raise BadData(f"{path}: a table of modes must have a line of column names and a line a mode, got {len(lines)}")
    places = _places(path, lines[0][1], columns)
    return [(number, _row(f"{path}, line {number}", cells, places)) for number, cells in lines[1:]]


def _places(path: str | Path, titles: list[str], columns: dict[str, str]) -> dict[str, int]:
    """Return the cell index of each column."""
    wanted = {name: f"{name} [{unit}]" for name, unit in columns.items()}
    for name, title in wanted.items():
        if titles.count(title) != 1:
            # A scene may name any file that its user can read: quote only a table of modes.
            is_table = any(other in titles for other in wanted.values())
            others = f"only {', '.join(map(repr, titles))}" if is_table else "none of the columns of a table of modes"
            found = "twice" if title in titles else others
            raise BadData(f"{path}: the column {title!r} must be there once, got {found}; {name} needs its unit, too")
    return {name: titles.index(title) for name, title in wanted.items()}


def _row(place: str, cells: list[str], places: dict[str, int]) -> dict[str, float]:
    """Return the numbers of one mode, or raise `BadData` that names the place."""
    row = {}
    for name, index in places.items():
        cell = cells[index] if index < len(cells) else ""
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
    """Return a column or a cell as numbers, or raise `InvalidValue`."""
    if name.startswith("shape"):
        return validation.real(name, value)
    if name == "damping_ratio":
        return validation.damping_ratio(name, value)
    if name.endswith("_deviation"):
        return validation.not_negative(name, value)
    return validation.positive(name, value, (COLUMNS | LEARNED_COLUMNS)[name])
