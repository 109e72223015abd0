"""Columns of the reproduced data: the unit each has in CSV, and how a picture shows it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """A numeric column.

    Parameters
    ----------
    unit : str
        In CSV files, SI; "1" for a pure number.
    label, shown_unit : str
        On an axis or in a table's head.
    factor : float
        From `unit` to `shown_unit`.
    """

    unit: str
    label: str
    shown_unit: str
    factor: float = 1.0

    @property
    def title(self) -> str:
        """What stands at an axis."""
        return f"{self.label} [{self.shown_unit}]" if self.shown_unit else self.label


_GPA, _MPA, _MM, _KN = ("GPa", 1e-9), ("MPa", 1e-6), ("mm", 1e3), ("kN", 1e-3)
_MICROSECONDS = ("\N{MICRO SIGN}s", 1e6)

QUANTITIES = {
    "velocity": Quantity("m/s", "impact velocity", "m/s"),
    "drop_height": Quantity("m", "drop height H", "m"),
    "time": Quantity("s", "time", *_MICROSECONDS),
    "force": Quantity("N", "contact force", *_KN),
    "displacement": Quantity("m", "DCS", *_MM),
    "peak_force": Quantity("N", "maximum contact force", *_KN),
    "peak_displacement": Quantity("m", "maximum DCS", *_MM),
    "restitution": Quantity("1", "restitution", ""),
    "radius": Quantity("m", "$R$", *_MM),
    "density": Quantity("kg/m^3", r"$\rho_1$", "kg/m$^3$"),
    "youngs_modulus": Quantity("Pa", "$E_1$", *_GPA),
    "poisson_ratio": Quantity("1", r"$\nu_1$", ""),
    "target_youngs_modulus": Quantity("Pa", "$E_2$", *_GPA),
    "target_poisson_ratio": Quantity("1", r"$\nu_2$", ""),
    "reduced_modulus": Quantity("Pa", "$E$ computed", *_GPA),
    "printed_reduced_modulus": Quantity("Pa", "$E$ printed", *_GPA),
    "contact_stiffness": Quantity("N/m^(3/2)", "$K$ computed", "N/m$^{3/2}$"),
    "printed_contact_stiffness": Quantity("N/m^(3/2)", "$K$ printed", "N/m$^{3/2}$"),
    "length": Quantity("m", "length", *_MM),
    "width": Quantity("m", "width", *_MM),
    "thickness": Quantity("m", "thickness", *_MM),
    "peak_force_influence": Quantity("1", "$P$: largest/smallest - 1", ""),
    "peak_displacement_influence": Quantity("1", "DCS: largest/smallest - 1", ""),
}
#: What theories and finite elements are compared by.
_COMPARED = {
    "peak_displacement": Quantity("m", "DCS", *_MM),
    "peak_force": Quantity("N", "force", *_KN),
    "peak_pressure": Quantity("Pa", "pressure", *_MPA),
    "peak_sphere_energy": Quantity("J", "energy of sphere", "J"),
    "peak_plate_energy": Quantity("J", "energy of plate", "J"),
    "contact_duration": Quantity("s", "contact time", *_MICROSECONDS),
}
QUANTITIES |= {
    f"{prefix}_{name}": Quantity(found.unit, f"{found.label}, {of}", found.shown_unit, found.factor)
    for name, found in _COMPARED.items()
    for prefix, of in (("simulated", "simulated"), ("theoretical", "theory"))
}
QUANTITIES |= {
    "centre_node_force": Quantity("N", "mass x acc. of centre", *_KN),
    "filtered_force": Quantity("N", "the same below 4/T", *_KN),
    "penalty_factor": Quantity("1", "penalty factor", ""),
    "force_over_hard": Quantity("1", "force over hard contact's", ""),
    "displacement_over_hard": Quantity("1", "DCS over hard contact's", ""),
    "squared_correlation": Quantity("1", "squared correlation", ""),
    "printed_squared_correlation": Quantity("1", "squared correlation, printed", ""),
    "determination": Quantity("1", "1 - SSres/SStot", ""),
    "error": Quantity("1", "mean error", ""),
}
#: Symbols of parameters and theories in the report's text.
SYMBOLS = {
    "radius": "R",
    "density": "ρ1",
    "youngs_modulus": "E1",
    "poisson_ratio": "ν1",
    "target_youngs_modulus": "E2",
    "target_poisson_ratio": "ν2",
    "hertz": "K1",
    "rigid-sphere": "K2",
    "series": "series theory",
}


def csv_title(column: str) -> str:
    """Return the head of a CSV column: its name, with the unit if it is a quantity."""
    return f"{column} [{QUANTITIES[column].unit}]" if column in QUANTITIES else column
