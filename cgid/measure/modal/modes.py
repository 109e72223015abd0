"""The natural modes of a beam, computed, measured by hammer taps, or learned from impacts, and their tables.

They turn a force into motion (`cgid.physics.structure.response`) and motion into the force (`cgid.measure.modal.beam`,
`cgid.identification.inversion.inversion`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.files import read_cells
from cgid._lib.validation import Complex, Floats
from cgid.errors import BadData, InvalidValue

__all__ = ["Modes", "read_modes"]

#: Corrected parameters of a mode; corrections are logarithms.
CORRECTED = ("frequency", "damping_ratio", "participation")
#: Columns of a table of measured modes, with their units.
COLUMNS = {"frequency": "Hz", "damping_ratio": "1", "modal_mass": "kg", "shape_impact": "1", "shape_sensor": "1"}
#: Columns of a table of learned modes, with their units. A deviation is that of the logarithm.
LEARNED_COLUMNS = {
    "frequency": "Hz",
    "damping_ratio": "1",
    "participation": "1",
    **{f"{name}_deviation": "1" for name in CORRECTED},
}
#: Columns of a complex participation, real and imaginary part, which a table of measured modes may lack.
COMPLEX_COLUMNS = {"in_phase": "1/kg", "quadrature": "1/kg"}
#: Columns of the band in which taps gave the modes, in each row the same, which a table may lack.
BAND_COLUMNS = {"band_low": "Hz", "band_high": "Hz"}
#: A participation is at least this [1/kg], so that shapes are finite. Modes are compared at frequencies so many
#: half-widths from each.
_LEAST, _BESIDE = 1e-12, (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
#: Damping ratio of the rows of a measured response that stand for modes outside of its band.
LINE_DAMPING = 0.5
#: Limits of a damping ratio that is corrected.
_MIN_DAMPING, _MAX_DAMPING = 1e-4, 0.7
#: Largest file of modes [bytes].
_MAX_FILE_SIZE = 8 << 20


class Shapes(Protocol):
    """The shapes of modes as a function of the point of impact."""

    def __call__(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the shapes at points [m], which broadcast, (..., n_modes)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Modes:
    """Natural modes of a beam.

    Under a force F mode r obeys `q_r'' + 2 damping_ratio_r w_r q_r' + w_r^2 q_r = at_impact_r F`, with `w_r = 2 pi
    frequency_r`; a sensor moves by the sum of `at_sensor_r q_r`. Shapes are divided by the square root of the modal
    mass. Those at impact and sensor are separate: a contact needs `at_impact^2`, a response the product.

    Parameters
    ----------
    frequency : ndarray, (n_modes,) [Hz]
        Undamped natural frequencies; ascending, unless modes learned from impacts have swapped.
    damping_ratio : ndarray, (n_modes,)
    at_impact : ndarray, (n_modes,), or function of x and y [1/sqrt(kg)]
        Shapes where the force acts: at one point, or anywhere.
    at_sensor : ndarray, (n_modes,) or (n_sensors, n_modes), optional [1/sqrt(kg)]
        Shapes at the sensors; complex where a sensor does not move in phase with the point of impact.
    deviation : ndarray, (3, n_modes), optional
        Standard deviations of ln frequency, ln damping ratio and ln participation; None for modes that are exact.
    scaled : bool
        Whether the scale of the shapes is known; otherwise only their ratios are.
    residual : float [m/N]
        Static compliance of the omitted higher modes where the force acts.
    band : tuple of float, optional [Hz]
        Where measured modes, with rows for those outside, respond like the beam.
    """

    frequency: Floats
    damping_ratio: Floats
    at_impact: Floats | Shapes
    at_sensor: Floats | None = None
    deviation: Floats | None = None
    scaled: bool = True
    residual: float = 0.0
    band: tuple[float, float] | None = None

    @classmethod
    def of(cls, columns: Mapping[str, ArrayLike]) -> Modes:
        """Return modes from columns of numbers: `LEARNED_COLUMNS`, or else `COLUMNS`, each (n_modes,).

        Raises `InvalidValue` if a column breaks its rule, or if measured modes do not ascend.
        """
        learned = "participation" in columns
        names = LEARNED_COLUMNS if learned else COLUMNS
        checked = {name: _require_rule(name, columns[name]) for name in names}
        lengths = {name: column.shape for name, column in checked.items()}
        if len(set(lengths.values())) > 1 or checked["frequency"].ndim != 1 or not checked["frequency"].size:
            shapes = ", ".join(f"{name} {shape}" for name, shape in lengths.items())
            raise InvalidValue(f"modes must be equally long rows of at least one number, got {shapes}")
        if learned:
            frequency, damping_ratio, participation, *deviation = checked.values()
            return cls.relative(frequency, damping_ratio, participation, np.stack(deviation))
        validation.ascending("frequency", checked["frequency"], "Hz")
        root = np.sqrt(checked["modal_mass"])
        return cls(
            frequency=checked["frequency"],
            damping_ratio=checked["damping_ratio"],
            at_impact=checked["shape_impact"] / root,
            at_sensor=checked["shape_sensor"] / root,
        )

    @classmethod
    def relative(
        cls, frequency: Floats, damping_ratio: Floats, participation: Floats, deviation: Floats | None = None
    ) -> Modes:
        """Return modes whose participations are factors of those of a beam's own modes."""
        return cls(
            frequency=frequency,
            damping_ratio=damping_ratio,
            at_impact=np.ones_like(frequency),
            at_sensor=participation,
            deviation=deviation if deviation is not None and deviation.any() else None,
            scaled=False,
        )

    @cached_property
    def poles(self) -> Complex:
        """Poles in the upper half-plane [rad/s], (n_modes,)."""
        return resonator_poles(self.frequency, self.damping_ratio)

    def shape(self, x: ArrayLike = 0.0, y: ArrayLike = 0.0) -> Floats:
        """Return the shapes of all modes at points [m], which broadcast, (..., n_modes) [1/sqrt(kg)].

        Where the shapes are known at one point, they are those at any. On a panel x is along the length from the held
        edge, y over the width from one side, and a point off it raises `InvalidValue`.
        """
        if callable(self.at_impact):
            return self.at_impact(x, y)
        return np.broadcast_to(self.at_impact, (*np.broadcast_shapes(np.shape(x), np.shape(y)), self.frequency.size))

    def measured_at(self, x: ArrayLike, y: ArrayLike) -> Modes:
        """Return the modes with a sensor at another point, or with several at several."""
        return replace(self, at_sensor=self.shape(x, y))

    def participation(self, x: ArrayLike = 0.0, y: ArrayLike = 0.0) -> Floats:
        """Return `shape(impact) shape(sensor) / modal mass` of each mode for impacts at points, (..., n_modes) [1/kg].

        >>> modes = Modes(
        ...     frequency=np.array([100.0]),
        ...     damping_ratio=np.array([0.01]),
        ...     at_impact=np.array([0.5]),
        ...     at_sensor=np.array([0.2]),
        ... )
        >>> modes.participation().tolist()
        [0.1]
        """
        assert self.at_sensor is not None
        return self.shape(x, y) * self.at_sensor

    def with_participation(self, participation: Floats | Complex) -> Modes:
        """Return the modes with other participations (n_modes,) at one point [1/kg]."""
        participation = participation if participation.imag.any() else participation.real
        at_impact = np.sqrt(np.maximum(np.abs(participation), _LEAST))
        at_sensor: Any = participation / at_impact
        return replace(self, at_impact=at_impact, at_sensor=at_sensor)

    def in_phase(self) -> Modes:
        """Return the modes with the real participations that respond most like complex ones, at one point."""
        own = self.participation()
        if not own.imag.any():
            return self
        half = np.maximum(-self.poles.real, 1e-3 * np.abs(self.poles))
        beside = np.outer(half, [*_BESIDE, *(-away for away in _BESIDE[1:])]) + np.abs(self.poles)[:, None]
        line = np.unique(beside[beside > 0.5 * np.abs(self.poles).min()])
        s, unit = 1j * line[:, None], residues(self.poles, 2)
        turning, returning = unit / (s - self.poles) + 1, unit.conj() / (s - self.poles.conj()) + 1
        both = turning + returning
        scale = 1 / np.linalg.norm(both, axis=0)
        target = turning @ own + returning @ own.conj()
        found = np.linalg.lstsq(
            np.concatenate([both.real, both.imag]) * scale, np.concatenate([target.real, target.imag]), rcond=1e-9
        )[0]
        return self.with_participation(found * scale)

    def taken(self, modes: NDArray[np.intp] | slice) -> Modes:
        """Return some of the modes, whose shapes are numbers."""
        at_impact = self.at_impact
        if isinstance(at_impact, NodeShapes):
            at_impact = NodeShapes(at_impact.values[modes], at_impact.region)
        assert isinstance(at_impact, NodeShapes | np.ndarray)
        return replace(
            self,
            frequency=self.frequency[modes],
            damping_ratio=self.damping_ratio[modes],
            at_impact=at_impact if isinstance(at_impact, NodeShapes) else at_impact[modes],
            at_sensor=None if self.at_sensor is None else self.at_sensor[..., modes],
            deviation=None if self.deviation is None else self.deviation[:, modes],
        )

    def corrected(self, correction: Floats) -> Modes:
        """Return the modes with corrections (3, n_modes) of ln frequency, ln damping ratio and ln participation."""
        return replace(
            self,
            frequency=self.frequency * np.exp(correction[0]),
            damping_ratio=np.clip(
                self.damping_ratio * np.exp(correction[1]),
                np.minimum(self.damping_ratio, _MIN_DAMPING),
                np.maximum(self.damping_ratio, _MAX_DAMPING),
            ),
            at_sensor=None if self.at_sensor is None else self.at_sensor * np.exp(correction[2]),
        )

    def sampled(self, normal: Floats) -> Modes:
        """Return exact modes sampled from uncertain ones for standard normal numbers (3, n_modes)."""
        return self if self.deviation is None else replace(self.corrected(self.deviation * normal), deviation=None)

    def as_learned(self, table: Modes) -> Modes:
        """Return a beam's modes corrected by a table of `relative` ones learned from impacts."""
        at_sensor = None if self.at_sensor is None else self.at_sensor * table.participation()
        learned = replace(
            self,
            frequency=table.frequency,
            damping_ratio=table.damping_ratio,
            at_sensor=at_sensor,
            deviation=table.deviation,
        )
        return learned if callable(learned.at_impact) else learned.taken(np.argsort(table.frequency, kind="stable"))

    @property
    def columns(self) -> dict[str, Floats]:
        """Columns of a table of learned modes."""
        deviation = np.zeros((3, self.frequency.size)) if self.deviation is None else self.deviation
        values = (self.frequency, self.damping_ratio, self.participation().real, *deviation)
        return dict(zip(LEARNED_COLUMNS, values, strict=True))


def resonator_poles(frequency: ArrayLike, damping_ratio: ArrayLike) -> Complex:
    """Return `-zeta w + i w sqrt(1 - zeta^2)` [rad/s]."""
    angular, ratio = 2 * np.pi * np.asarray(frequency), np.asarray(damping_ratio)
    return np.asarray(angular * (-ratio + 1j * np.sqrt((1 - ratio) * (1 + ratio))))


def residues(poles: Complex, derivatives: int) -> Complex:
    """Return factors of the states of poles (`x' = s x + F`) that make a motion of 0 to 2 derivatives."""
    return np.asarray(poles**derivatives / (1j * poles.imag))


def phi(x: Complex) -> tuple[Complex, Complex]:
    """Return (e^x - 1) / x and (e^x - 1 - x) / x^2, by series for small x, where these would cancel."""
    small = np.abs(x) < 0.5
    safe = np.where(small, 1.0, x)
    grown = np.exp(safe) - 1
    first, second = np.ones_like(x), np.full_like(x, 0.5)
    term = np.ones_like(x)
    for n in range(2, 20):
        term = term * np.where(small, x, 0.0) / n
        first, second = first + term, second + term / (n + 1)
    return np.where(small, first, grown / safe), np.where(small, second, (grown / safe - 1) / safe)


# -- shapes at nodes -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class NodeShapes:
    """Shapes at the Chebyshev `nodes` of a region, and between them."""

    values: Floats  # (n_modes, n_x, n_y)
    region: Floats  # lowest and highest x, lowest and highest y, (4,) [m]

    def __call__(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Return the shapes at points [m], which broadcast, (..., n_modes)."""
        x, y = np.broadcast_arrays(x, y)
        _, n_x, n_y = self.values.shape
        along = lagrange(n_x, self.region[0], self.region[1], x.ravel())[0]
        across = lagrange(n_y, self.region[2], self.region[3], y.ravel())[0]
        values = np.einsum("mxy,nx,ny->nm", self.values, along, across, optimize=True)
        return np.asarray(values.reshape(*x.shape, -1))


def nodes(n: int, lowest: float, highest: float) -> Floats:
    """Return n Chebyshev nodes between two ends, ascending; a single node is the middle."""
    return (lowest + highest) / 2 - (highest - lowest) / 2 * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def lagrange(n: int, lowest: float, highest: float, x: Floats) -> tuple[Floats, Floats]:
    """Return the weights of n Chebyshev nodes at points (n_points,) and their slopes, each (n_points, n)."""
    # `f(t) = sum_j c_j T_j(t)`, with `c_j` a cosine transform of the values at the nodes.
    half = (highest - lowest) / 2
    if n == 1 or half == 0:
        return np.full((x.size, n), 1 / n), np.zeros((x.size, n))
    angle = np.pi * (np.arange(n) + 0.5) / n
    order = np.arange(n)
    transform = np.cos(np.outer(order, np.pi - angle)) * (2 / n)
    transform[0] /= 2
    t = np.clip((x - (lowest + highest) / 2) / half, -1 + 1e-12, 1 - 1e-12)
    theta = np.arccos(t)
    values = np.cos(np.outer(theta, order))
    slopes = order * np.sin(np.outer(theta, order)) / np.sin(theta)[:, None] / half
    return values @ transform, slopes @ transform


# -- tables --------------------------------------------------------------------------------------------------------


def read_modes(path: str | Path, columns: Mapping[str, str] = COLUMNS) -> Modes:
    r"""Read a table of modes from a UTF-8 file of comma-separated values.

    The first line names the columns with their units, in any order: `frequency [Hz]`, `damping_ratio [1]`,
    `modal_mass [kg]`, `shape_impact [1]`, `shape_sensor [1]`; other columns are ignored. Each further line is one mode;
    empty lines and lines that begin with # are ignored. `in_phase [1/kg]` and `quadrature [1/kg]`, a complex
    participation in place of that of masses and shapes, may be missing, and so may `band_low [Hz]` and
    `band_high [Hz]`, the band in which the modes respond like the beam.

    Parameters
    ----------
    path : str or Path
    columns : dict of str to str
        Columns and their units, `COLUMNS` or, for a table that `cgid calibrate` has written, `LEARNED_COLUMNS`.

    Returns
    -------
    Modes

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
    ...     modes = read_modes(file)
    >>> modes.participation().round(6).tolist()
    [0.001714, -0.001167]
    """
    rows = rows_of_table(path, columns, COMPLEX_COLUMNS | BAND_COLUMNS if columns is COLUMNS else {})
    modes = Modes.of({name: [row[name] for row in rows] for name in columns})
    if BAND_COLUMNS.keys() <= rows[0].keys():
        low, high = (rows[0][name] for name in BAND_COLUMNS)
        if not low < high:
            raise BadData(f"{path}: band_low must be below band_high, got {low:g} and {high:g} Hz; correct them")
        modes = replace(modes, band=(low, high))
    if not COMPLEX_COLUMNS.keys() <= rows[0].keys():
        return modes
    real, imaginary = (np.array([row[name] for row in rows]) for name in COMPLEX_COLUMNS)
    return modes.with_participation(real + 1j * imaginary)


def rows_of_table(
    path: str | Path, columns: Mapping[str, str], optional: Mapping[str, str] = MappingProxyType({})
) -> list[dict[str, float]]:
    """Return the numbers of each mode of a table by column, and of optional ones if present; raises as `read_modes`."""
    # A table of measured modes states their own participations, which as corrections are factors of 1.
    lines = read_cells(path, "the table of modes", _MAX_FILE_SIZE)
    if len(lines) < 2:
        raise BadData(f"{path}: a table of modes must have a line of column names and a line a mode, got {len(lines)}")
    measured = columns is LEARNED_COLUMNS and f"modal_mass [{COLUMNS['modal_mass']}]" in lines[0][1]
    factors = {"participation": 1.0} if measured else {}
    needed = {name: columns[name] for name in columns.keys() - factors.keys()}
    present = {name: unit for name, unit in optional.items() if f"{name} [{unit}]" in lines[0][1]}
    indices = _column_indices(path, lines[0][1], needed | present)
    rows = [(number, _row(f"{path}, line {number}", cells, indices) | factors) for number, cells in lines[1:]]
    for (number, row), (_, before) in zip(rows[1:], rows[:-1], strict=True):
        if columns is COLUMNS and row["frequency"] < before["frequency"]:
            raise BadData(
                f"{path}, line {number}: frequency must ascend from line to line, got {row['frequency']:g} Hz after "
                f"{before['frequency']:g} Hz; sort the modes"
            )
    return [row for _, row in rows]


def rows_of_shapes(path: str | Path) -> list[dict[str, Any]]:
    """Return place and shapes of each row of a table of shapes: columns `x [m]`, `y [m]`, and `shape_1 [1]` and on."""
    lines = read_cells(path, "the table of shapes", _MAX_FILE_SIZE)
    titles = lines[0][1] if lines else []
    n = sum(title.startswith("shape_") for title in titles)
    columns = {"x": "m", "y": "m"} | {f"shape_{k + 1}": "1" for k in range(max(n, 1))}
    indices = _column_indices(path, titles, columns)
    rows = [_row(f"{path}, line {number}", cells, indices) for number, cells in lines[1:]]
    return [{"x": row["x"], "y": row["y"], "shape": [row[name] for name in list(columns)[2:]]} for row in rows]


def are_lines(damping_ratio: Floats) -> NDArray[np.bool_]:
    """Return which rows of a table stand for modes outside of its band, the mass line and the stiffness lines."""
    return np.asarray(damping_ratio > LINE_DAMPING / 2)


def shapes_beside(path: str | Path) -> Path:
    """Return the path of the table of shapes that a roving hammer gives beside a table of modes."""
    path = Path(path)
    return path.with_name(f"{path.stem}-shapes.csv")


def text_of_shapes(places: Floats, shapes: Floats) -> str:
    """Return the text of a table of shapes (n_places, n_modes) at places (n_places, 2) [m]."""
    titles = ["x [m]", "y [m]", *(f"shape_{k + 1} [1]" for k in range(shapes.shape[1]))]
    rows = (",".join(f"{value:.9g}" for value in row) for row in np.concatenate([places, shapes], axis=1).tolist())
    return "\n".join((",".join(titles), *rows)) + "\n"


def text_of_table(columns: Mapping[str, Floats], scale: str = "1") -> str:
    """Return columns of `COLUMNS` or `LEARNED_COLUMNS`, each (n_modes,), as the text of a table of modes."""
    units = COLUMNS | LEARNED_COLUMNS | BAND_COLUMNS
    units |= {"participation": scale, **dict.fromkeys(COMPLEX_COLUMNS, scale)}
    titles = ",".join(f"{name} [{units[name]}]" for name in columns)
    rows = (",".join(f"{float(value)!r}" for value in row) for row in zip(*columns.values(), strict=True))
    return "\n".join((titles, *rows)) + "\n"


def _column_indices(path: str | Path, titles: list[str], columns: Mapping[str, str]) -> dict[str, int]:
    """Return the cell index of each column."""
    titles_by_name = {name: f"{name} [{unit}]" for name, unit in columns.items()}
    for name, title in titles_by_name.items():
        if titles.count(title) != 1:
            # A scene may name any file that its user can read: quote only a table of modes.
            is_table = any(other in titles for other in titles_by_name.values())
            others = f"only {', '.join(map(repr, titles))}" if is_table else "none of the columns of a table of modes"
            count = "twice" if title in titles else others
            raise BadData(f"{path}: the column {title!r} must appear once, got {count}; write {name} with its unit")
    return {name: titles.index(title) for name, title in titles_by_name.items()}


def _row(line: str, cells: list[str], indices: Mapping[str, int]) -> dict[str, float]:
    """Return the numbers of one mode, or raise `BadData` that names the line."""
    row = {}
    for name, index in indices.items():
        cell = cells[index] if index < len(cells) else ""
        try:
            row[name] = float(_require_rule(name, float(cell)))
        except InvalidValue as error:
            raise BadData(f"{line}: {error}") from None
        except ValueError:
            raise BadData(f"{line}: {name} must be a number, got {cell!r}") from None
    return row


def _require_rule(name: str, value: ArrayLike) -> Floats:
    """Return a column or a cell as numbers, or raise `InvalidValue`."""
    if name.startswith("shape") or name in COMPLEX_COLUMNS:
        return validation.real(name, value)
    if name in ("x", "y"):
        return validation.not_negative(name, value, "m")
    if name == "damping_ratio":
        return validation.damping_ratio(name, value)
    if name.endswith("_deviation"):
        return validation.not_negative(name, value)
    return validation.positive(name, value, (COLUMNS | LEARNED_COLUMNS | BAND_COLUMNS)[name])
