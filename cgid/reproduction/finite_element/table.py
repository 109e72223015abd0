"""Table 3: how well theory and simulation agree, by the paper's yardstick and by one that sees a wrong factor."""

from __future__ import annotations

import numpy as np

from cgid.physics.materials import YANG2018_SPHERES
from cgid.reproduction import paper
from cgid.reproduction.finite_element.study import Study
from cgid.reproduction.finite_element.theories import READINGS, SHARED, agreement
from cgid.reproduction.quantities import SYMBOLS
from cgid.reproduction.tables import PaperTable

#: Columns of the table as printed.
_SHOWN = {
    "peak_displacement": r"$\delta$",
    "peak_force": "$F$",
    "peak_pressure": "$p$",
    "peak_sphere_energy": "$Q_{ball}$",
    "peak_plate_energy": "$Q_{plate}$",
}


def table_3(study: Study) -> PaperTable:
    """Return Table 3 for the three theories, beside what the paper prints for its own."""
    import pandas as pd

    rows, cells = [], []
    for sphere in YANG2018_SPHERES:
        cells.append([f"{sphere}", "printed", *(f"{paper.TABLE_3[sphere][name]:g}" for name in _SHOWN)])
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
                    "printed_squared_correlation": paper.TABLE_3[sphere][name] if reading == "series" else np.nan,
                }
                for name, value in found.items()
            ]
            shown = [
                # All but energy is K1's, and stands above.
                ""
                if reading == SHARED and not name.endswith("energy")
                else _cell(value.squared_correlation, value.determination)
                for name, value in found.items()
            ]
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


def _cell(squared_correlation: float, determination: float) -> str:
    first = "\N{EM DASH}" if np.isnan(squared_correlation) else f"{squared_correlation:.5f}"
    return f"{first} / {determination:.{3 if abs(determination) < 100 else 0}f}"
