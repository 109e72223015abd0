"""Figures 12 to 15: what each parameter does, as curves and as response surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import ArrayLike

from cgid.physics import Impact
from cgid.physics.sensitivity import parameters_of, response_grid
from cgid.reproduction import impacts, paper
from cgid.reproduction.drawing import Lines, Surface
from cgid.reproduction.paper_figure import PaperFigure, frame, highest_strain, joined
from cgid.validation import Floats


def _responses(impact: Impact, ranges: Mapping[str, Floats]) -> tuple[Any, float]:
    """Return the peak responses over a grid, each row with all six parameters, and the largest strain."""
    grid = response_grid(impact, ranges)
    columns: dict[str, ArrayLike] = {"varied": " and ".join(ranges), **parameters_of(grid)}
    data = frame({**columns, "peak_displacement": grid.peak_displacement, "peak_force": grid.peak_force})
    return data, highest_strain(grid)


def _curves(number: int, title: str, names: tuple[str, ...]) -> PaperFigure:
    made = [_responses(impacts.table_4_impact(), {name: paper.TABLE_4[name].values}) for name in names]
    responses = ("peak_displacement", "peak_force")
    return PaperFigure(
        name=f"figure_{number}",
        title=title,
        note="Ranges of Table 4, series theory, 2 m/s (not said by the paper; it follows from its constants).",
        data=joined([data for data, _ in made]),
        panels=tuple(Lines(x=name, y=y, where={"varied": name}, marker=".") for y in responses for name in names),
        columns=len(names),
        highest_strain=max(strain for _, strain in made),
    )


def figure_12() -> PaperFigure:
    """Return Figure 12: effect of the sphere's density, Young's modulus and Poisson's ratio."""
    return _curves(
        12, "Effect of sphere parameters on DCS and contact force", ("density", "youngs_modulus", "poisson_ratio")
    )


def figure_13() -> PaperFigure:
    """Return Figure 13: effect of the plate's Young's modulus and Poisson's ratio."""
    return _curves(
        13,
        "Effect of metal plate parameters on DCS and contact force",
        ("target_youngs_modulus", "target_poisson_ratio"),
    )


def figure_14() -> PaperFigure:
    """Return Figure 14: response surfaces of both moduli and of both Poisson's ratios, equal materials (Table 5)."""
    pairs = (("youngs_modulus", "target_youngs_modulus"), ("poisson_ratio", "target_poisson_ratio"))
    made = [
        _responses(impacts.table_5_impact(), {name: paper.TABLE_5[name].values for name in (first, second)})
        for first, second in pairs
    ]
    return PaperFigure(
        name="figure_14",
        title="Response surfaces of two bodies with the same properties",
        note="Ranges of Table 5, series theory, 2 m/s. Which parameters span each surface is our reading of the text.",
        data=joined([data for data, _ in made]),
        panels=tuple(
            Surface(x=first, y=second, z=z, where={"varied": f"{first} and {second}"})
            for first, second in pairs
            for z in ("peak_displacement", "peak_force")
        ),
        columns=2,
        highest_strain=max(strain for _, strain in made),
    )


def figure_15() -> PaperFigure:
    """Return Figure 15: response surfaces of both moduli for a rock-like sphere on the metal plate (Table 4)."""
    first, second = "youngs_modulus", "target_youngs_modulus"
    ranges = {name: paper.TABLE_4[name].values for name in (first, second)}
    data, strain = _responses(impacts.table_4_impact(), ranges)
    return PaperFigure(
        name="figure_15",
        title="Response surfaces of both moduli, rock-like sphere on the metal plate",
        note="Ranges of Table 4, series theory, 2 m/s.",
        data=data,
        panels=tuple(Surface(x=first, y=second, z=z) for z in ("peak_displacement", "peak_force")),
        columns=2,
        highest_strain=strain,
    )
