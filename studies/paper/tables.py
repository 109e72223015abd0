"""The tables of the paper: inputs with derived values, and the agreement of theory and simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgid.physics import Impact
from cgid.physics.contact.materials import STEEL, YANG2018_RADIUS, YANG2018_SPHERES, Material
from studies.paper import printed
from studies.paper.drawing import QUANTITIES, SYMBOLS
from studies.paper.printed import SECTION_4_VELOCITY, paper_impact, table_4_impact, table_5_impact
from studies.paper.sensitivity import PARAMETERS, parameters_of, range_influence
from studies.paper.study import Study
from studies.paper.theories import READINGS, SHARED, Agreement, agreement

#: Columns with five digits in the paper.
_FIVE_DIGITS = ("reduced_modulus", "printed_reduced_modulus", "contact_stiffness", "printed_contact_stiffness")


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A computed table of the paper.

    name : name of its files, without the ending
    note : choices made here because the paper leaves them open
    data : data frame [SI units], columns named as in `QUANTITIES`
    heads, cells : text of the picture, in the paper's units
    """

    name: str
    title: str
    note: str = ""
    data: Any
    heads: list[str]
    cells: list[list[str]]


def computed_contact(number: int) -> tuple[float, float]:
    """Return reduced modulus [Pa] and Hertz's stiffness K1 [N/m^(3/2)] of a sphere of Table 2 on the plate."""
    impact = paper_impact(number, SECTION_4_VELOCITY, "hertz")
    return float(impact.reduced_modulus), float(impact.contact_stiffness)


def _body(body: str, material: Material, radius: float = np.nan) -> dict[str, Any]:
    return {
        "body": body,
        "density": material.density,
        "youngs_modulus": material.youngs_modulus,
        "poisson_ratio": material.poisson_ratio,
        "radius": radius,
    }


def _contact(printed: printed.PrintedContact, number: int) -> dict[str, float]:
    modulus, stiffness = computed_contact(number)
    return {
        "printed_reduced_modulus": float(printed.reduced_modulus) * 1e9,
        "reduced_modulus": modulus,
        "printed_contact_stiffness": float(printed.stiffness),
        "contact_stiffness": stiffness,
    }


def _contact_table(name: str, title: str, rows: list[dict[str, Any]]) -> PaperTable:
    import pandas as pd

    data = pd.DataFrame(rows)
    # The columns hold both bodies, so the symbols lose their index.
    heads = [QUANTITIES[column].title.replace("_1", "") if column in QUANTITIES else column for column in data.columns]
    cells = [[_cell(column, row[column]) for column in data.columns] for row in data.to_dict("records")]
    return PaperTable(name=name, title=title, data=data, heads=heads, cells=cells)


def _cell(column: str, value: Any) -> str:
    if column not in QUANTITIES:
        return str(value)
    if np.isnan(value):
        return "\N{EM DASH}"
    return f"{value * QUANTITIES[column].factor:{'#' if column in _FIVE_DIGITS else ''}.5g}"


def table_1(_: Study) -> PaperTable:
    """Return Table 1: sphere 1 and the plate."""
    contact = _contact(printed.TABLE_1, 1)
    rows = [
        _body("elastic sphere", YANG2018_SPHERES[1], YANG2018_RADIUS) | contact,
        _body("metal plate", STEEL) | contact,
    ]
    return _contact_table("table_1", "Parameters of the contact model", rows)


def table_2(_: Study) -> PaperTable:
    """Return Table 2: the four spheres, and the plate with its size."""
    rows = [
        _body(f"sphere {number}", sphere, YANG2018_RADIUS) | _contact(printed.TABLE_2[number], number)
        for number, sphere in YANG2018_SPHERES.items()
    ]
    size = dict(zip(("length", "width", "thickness"), printed.PLATE_SIZE, strict=True))
    rows.append(_body("metal plate", STEEL) | size)
    return _contact_table("table_2", "Parameters of the four spheres and of the plate", rows)


def _range_table(
    name: str, title: str, note: str, impact: Impact, ranges: Mapping[str, printed.ParameterRange]
) -> PaperTable:
    import pandas as pd

    found = range_influence(impact, {parameter: values.values for parameter, values in ranges.items()})
    held = parameters_of(impact)
    rows, cells = [], []
    for parameter, values in ranges.items():
        influence = (float(found.peak_force[parameter]), float(found.peak_displacement[parameter]))
        rows.append({
            "body": "plate" if parameter.startswith("target_") else "sphere",
            "parameter": parameter.removeprefix("target_"),
            "unit": PARAMETERS[parameter] or "1",
            "held": float(held[parameter]),
            "start": values.start,
            "step": values.step,
            "stop": values.stop,
            "values": values.values.size,
            "peak_force_influence": influence[0],
            "peak_displacement_influence": influence[1],
        })  # fmt: skip
        shown = QUANTITIES[parameter]
        numbers = [
            f"{value * shown.factor:.5g}" for value in (float(held[parameter]), values.start, values.step, values.stop)
        ]
        cells.append([shown.title, numbers[0], " : ".join(numbers[1:]), *(f"{value:.4g}" for value in influence)])
    heads = ["parameter", "held at", "start : step : stop"]
    heads += [QUANTITIES[f"peak_{response}_influence"].title for response in ("force", "displacement")]
    return PaperTable(name=name, title=title, note=note, data=pd.DataFrame(rows), heads=heads, cells=cells)


def table_4(_: Study) -> PaperTable:
    """Return Table 4: ranges for sphere 1 on the metal plate, and the effect of each on the responses."""
    return _range_table(
        "table_4",
        "Ranges of the parameters, sphere on metal plate",
        "Both influences are computed here. A Poisson's ratio of 0.5 is taken as the largest float below it.",
        table_4_impact(),
        printed.TABLE_4,
    )


def table_5(_: Study) -> PaperTable:
    """Return Table 5: ranges for two bodies of equal properties, and the effect of each on the responses."""
    return _range_table(
        "table_5",
        "Ranges of the parameters, sphere and plate with the same properties",
        "Both influences are computed here, one parameter moved and the others held.",
        table_5_impact(),
        printed.TABLE_5,
    )


#: Columns of Table 3, with their heads.
_SHOWN = {
    "peak_displacement": r"$\delta$",
    "peak_force": "$F$",
    "peak_pressure": "$p$",
    "peak_sphere_energy": "$Q_{ball}$",
    "peak_plate_energy": "$Q_{plate}$",
}


def table_3(study: Study) -> PaperTable:
    """Return Table 3 for the three theories, with the paper's printed values for its own."""
    import pandas as pd

    rows, cells = [], []
    for sphere in YANG2018_SPHERES:
        cells.append([f"{sphere}", "printed", *(f"{printed.TABLE_3[sphere][name]:g}" for name in _SHOWN)])
        for reading in READINGS:
            found = {name: agreement(study, reading, name, sphere=sphere) for name in _SHOWN}
            rows += [
                {
                    "sphere": sphere,
                    "theory": reading,
                    "quantity": name,
                    "error": value.error,
                    "squared_correlation": value.squared_correlation,
                    "determination": value.determination,
                    "printed_squared_correlation": printed.TABLE_3[sphere][name] if reading == "series" else np.nan,
                }
                for name, value in found.items()
            ]
            # The two readings of K1 differ only in energy.
            own = [name for name in _SHOWN if reading != SHARED or name.endswith("energy")]
            shown = [_agreement_cell(found[name]) if name in own else "" for name in _SHOWN]
            cells.append(["", SYMBOLS.get(reading, "K1, shared"), *shown])
    return PaperTable(
        name="table_3",
        title="Squared correlation / 1 - SSres/SStot of simulated and theoretical values",
        note="Undamped finite elements, five speeds a sphere. In the paper's words all energy is in the sphere (K1), "
        'all in the plate (K2), or 4/7 and 3/7 (series); "K1, shared" gives each body its part of the compliance. A '
        "theory that gives a body no energy has no correlation (a dash). The paper prints its own theory's.",
        data=pd.DataFrame(rows),
        heads=["sphere", "theory", *_SHOWN.values()],
        cells=cells,
    )  # fmt: skip


def _agreement_cell(found: Agreement) -> str:
    first = "\N{EM DASH}" if np.isnan(found.squared_correlation) else f"{found.squared_correlation:.5f}"
    return f"{first} / {found.determination:.{3 if abs(found.determination) < 100 else 0}f}"


#: The functions that make the tables from the finite-element study, by file name.
TABLES: dict[str, Callable[[Study], PaperTable]] = {
    "table_1": table_1,
    "table_2": table_2,
    "table_3": table_3,
    "table_4": table_4,
    "table_5": table_5,
}
