"""Figures and tables as data, and their drawing: units of the columns, panels, layout, PNG."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cgid.plots.figure import COLOURS, png, require_matplotlib


@dataclass(frozen=True)
class Quantity:
    """A numeric column.

    unit : SI unit in CSV files; "1" if dimensionless
    label, shown_unit : text on an axis or in the head of a table
    factor : from `unit` to `shown_unit`
    """

    unit: str
    label: str
    shown_unit: str
    factor: float = 1.0

    @property
    def title(self) -> str:
        """Label of an axis."""
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
#: The quantities in which theories and finite elements are compared.
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
    """Return the head of a CSV column: its name, and the unit of a quantity."""
    return f"{column} [{QUANTITIES[column].unit}]" if column in QUANTITIES else column


def frame(columns: Mapping[str, ArrayLike]) -> Any:
    """Return a data frame of columns that are broadcast against each other, with a row for each element."""
    import pandas as pd

    arrays = np.broadcast_arrays(*columns.values())
    return pd.DataFrame({name: array.ravel() for name, array in zip(columns, arrays, strict=True)})


def joined(frames: Iterable[Any]) -> Any:
    """Concatenate data frames row by row."""
    import pandas as pd

    return pd.concat(frames, ignore_index=True)


#: Size of a panel [inches], with one, two or more panels in a row; size of a surface.
_PANEL_SIZES, _SURFACE_SIZE = ((5.2, 4.0), (4.2, 3.2), (3.4, 2.7)), (4.6, 3.7)
#: Margins left, right, below and above the axes [inches], with more than two panels in a row and with fewer.
_MARGINS, _LARGER_MARGINS = (0.75, 0.15, 0.55, 0.3), (0.9, 0.15, 0.55, 0.3)
#: Height of a legend row, width of a character and of a line sample, height of the caption [inches].
_LEGEND_ROW, _CHARACTER, _LEGEND_LINE, _CAPTION = 0.22, 0.085, 0.6, 0.3
#: Markup in the head of a table, which takes no width.
_MARKUP = re.compile(r"[${}_^]|\\[a-z]+")


@dataclass(frozen=True, kw_only=True)
class Lines:
    """A panel of lines, one for each value of the column `by`; a single line if `by` is empty.

    where : column values that select the rows of this panel
    labels : legend text for each value of `by`
    marker : "." or "o" at every point; "end" at the last point of each line, the first lines on top
    label : legend text of a single line; none if empty
    colour, style : as in matplotlib; without a colour, each line has its own
    over : lines drawn on top of this panel
    diagonal : draw the grey line x = y
    """

    x: str
    y: str
    by: str = ""
    where: Mapping[str, object] = field(default_factory=dict)
    title: str = ""
    labels: Mapping[Any, str] = field(default_factory=dict)
    marker: str = ""
    label: str = ""
    colour: str = ""
    style: str = "-"
    width: float = 1.5
    over: tuple[Lines, ...] = ()
    diagonal: bool = False
    logarithmic: bool = False


@dataclass(frozen=True, kw_only=True)
class Surface:
    """A response surface `z(x, y)`; the rows that `where` selects form a full grid."""

    x: str
    y: str
    z: str
    where: Mapping[str, object] = field(default_factory=dict)
    title: str = ""


Panel = Lines | Surface


@dataclass(frozen=True, kw_only=True)
class PaperFigure:
    """A computed figure of the paper.

    name : name of its files, without the ending
    note : choices made here because the paper leaves them open
    caption : text in the picture, above all panels
    data : data frame [SI units], columns named as in `QUANTITIES`
    panels : all `Lines` or all `Surface`
    columns : number of panels in a row
    """

    name: str
    title: str
    note: str = ""
    caption: str = ""
    data: Any
    panels: tuple[Panel, ...]
    columns: int = 1


#: Data and panels of a figure.
Drawn = tuple[Any, Sequence[Panel]]


class Figures(dict[str, Callable[..., PaperFigure]]):
    """The functions that make the figures, by file name."""

    def add(
        self, name: str, title: str, note: str = "", caption: str = "", *, columns: int = 1, **arguments: Any
    ) -> Callable[[Callable[..., Drawn]], Callable[..., Drawn]]:
        """Return a decorator that adds the figure that the function draws with these arguments."""

        def register(function: Callable[..., Drawn]) -> Callable[..., Drawn]:
            def make(*of: Any) -> PaperFigure:
                data, panels = function(*of, **arguments)
                return PaperFigure(
                    name=name, title=title, note=note, caption=caption, data=data, panels=tuple(panels),
                    columns=columns,
                )  # fmt: skip

            self[name] = make
            return function

        return register


def draw(drawn: PaperFigure) -> bytes:
    """Return a figure as PNG. Raises `MissingExtra` without matplotlib."""
    return png(drawing(drawn))


def drawing(drawn: PaperFigure) -> Any:
    """Return the matplotlib figure. Raises `MissingExtra` without matplotlib."""
    columns, rows = drawn.columns, -(-len(drawn.panels) // drawn.columns)
    if isinstance(drawn.panels[0], Surface):
        width, height = _SURFACE_SIZE
        figure = require_matplotlib()(figsize=(width * columns, height * rows), layout="constrained")
        for place, panel in enumerate(drawn.panels, start=1):
            assert isinstance(panel, Surface)
            _surface(figure.add_subplot(rows, columns, place, projection="3d"), _chosen(drawn.data, panel), panel)
        if drawn.caption:
            figure.suptitle(drawn.caption, fontsize="small")
        return figure
    width, height = _PANEL_SIZES[min(columns, 3) - 1]
    figure = require_matplotlib()(figsize=(width * columns, height * rows))
    named: dict[str, Any] = {}
    for place, panel in enumerate(drawn.panels, start=1):
        assert isinstance(panel, Lines)
        named |= _panel(figure.add_subplot(rows, columns, place), drawn.data, panel)
    _place(figure, rows, columns, _legend(figure, named), drawn.caption)
    return figure


def _legend(figure: Any, named: Mapping[str, Any]) -> float:
    """Put one legend below all panels and return its height [inches]."""
    if not named:
        return 0.0
    width, height = figure.get_size_inches()
    widths = [len(text) * _CHARACTER + _LEGEND_LINE for text in named]
    per_row = len(named) if sum(widths) < width else max(1, int(width / max(widths)))
    needed = _LEGEND_ROW * (-(-len(named) // per_row) + 0.5)
    figure.set_figheight(height + needed)
    figure.legend(named.values(), named.keys(), loc="lower center", ncols=per_row, frameon=False, columnspacing=1.2)
    return needed


def _place(figure: Any, rows: int, columns: int, legend: float, caption: str) -> None:
    """Space the panels evenly between the legend, of height `legend` [inches], and the caption.

    matplotlib's "constrained" layout would take half of the drawing time.
    """
    left, right, below, above = _MARGINS if columns > 2 else _LARGER_MARGINS
    width, height = figure.get_size_inches()
    heading = _CAPTION if caption else 0.0
    height += heading
    figure.set_figheight(height)
    if caption:
        figure.text(0.5, 1 - 0.5 * heading / height, caption, ha="center", va="center", fontsize="small")
    figure.subplots_adjust(
        left=left / width,
        right=1 - right / width,
        bottom=(legend + below) / height,
        top=1 - (heading + above) / height,
        wspace=(left + right) / (width / columns - left - right),
        hspace=(below + above) / ((height - heading - legend) / rows - below - above),
    )


def _chosen(data: Any, panel: Panel) -> Any:
    for name, value in panel.where.items():
        data = data[data[name] == value]
    return data


def _panel(axes: Any, data: Any, panel: Lines) -> dict[str, Any]:
    """Draw a panel with its overlays and return the lines of the legend by name."""
    named: dict[str, Any] = {}
    for level, lines in enumerate((panel, *panel.over)):
        named |= _lines(axes, _chosen(data, lines), lines, zorder=2.0 + level)
    if panel.diagonal:
        axes.axline((0, 0), slope=1, color="0.6", linewidth=1, zorder=1)
    if panel.logarithmic:
        axes.set_xscale("log")
    axes.set(xlabel=QUANTITIES[panel.x].title, ylabel=QUANTITIES[panel.y].title)
    # A fixed y skips matplotlib's slow search for a free position.
    axes.set_title(panel.title, fontsize="medium", y=1.0)
    axes.grid(alpha=0.3)
    return named


def _lines(axes: Any, data: Any, lines: Lines, zorder: float) -> dict[str, Any]:
    """Draw lines and return those of the legend by name."""
    x, y = QUANTITIES[lines.x], QUANTITIES[lines.y]
    groups = list(data.groupby(lines.by, sort=False)) if lines.by else [("", data)]
    named = {}
    for order, (value, rows) in enumerate(groups):
        xs, ys = rows[lines.x].to_numpy() * x.factor, rows[lines.y].to_numpy() * y.factor
        at_end = lines.marker == "end"
        (line,) = axes.plot(
            xs,
            ys,
            color=lines.colour or COLOURS[order % len(COLOURS)],
            linestyle=lines.style,
            linewidth=lines.width,
            marker="o" if at_end else lines.marker or None,
            markevery=[len(xs) - 1] if at_end else None,
            zorder=zorder + 1 - 0.1 * order if at_end else zorder,
        )
        name = lines.labels.get(value) or _label(lines.by, value) if lines.by else lines.label
        if name:
            named[name] = line
    return named


def _surface(axes: Any, data: Any, panel: Surface) -> None:
    x, y, z = QUANTITIES[panel.x], QUANTITIES[panel.y], QUANTITIES[panel.z]
    grid = data.pivot(index=panel.x, columns=panel.y, values=panel.z)
    xs, ys = np.meshgrid(grid.index.to_numpy() * x.factor, grid.columns.to_numpy() * y.factor, indexing="ij")
    axes.plot_surface(xs, ys, grid.to_numpy() * z.factor, cmap="viridis", rstride=1, cstride=1, linewidth=0)
    axes.set(xlabel=x.title, ylabel=y.title, zlabel=z.title)
    axes.set_title(panel.title, fontsize="medium")
    # Viewed from its lowest corner, a monotonic surface hides none of its parts.
    axes.view_init(elev=24, azim=-125 if grid.iloc[0, 0] < grid.iloc[-1, -1] else 40)
    axes.xaxis.labelpad = axes.yaxis.labelpad = 7
    axes.zaxis.labelpad = 9
    axes.locator_params(nbins=5)
    axes.set_box_aspect(None, zoom=0.9)


def _label(column: str, value: object) -> str:
    quantity = QUANTITIES.get(column)
    if quantity is None:
        return f"{column} {value}"
    return f"{value:g} {quantity.shown_unit}" if quantity.shown_unit else f"{quantity.label} {value:g}"


def draw_table(heads: Sequence[str], cells: Sequence[Sequence[str]]) -> bytes:
    """Return a table as PNG. Raises `MissingExtra` without matplotlib."""
    widths = [max(len(_MARKUP.sub("", text)) for text in column) + 3 for column in zip(heads, *cells, strict=True)]
    figure = require_matplotlib()(figsize=(0.085 * sum(widths), 0.3 * (len(cells) + 2)), layout="constrained")
    axes = figure.subplots()
    axes.axis("off")
    table = axes.table(
        [list(row) for row in cells],
        colLabels=list(heads),
        colWidths=[width / sum(widths) for width in widths],
        cellLoc="center",
        bbox=(0, 0, 1, 1),
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    for (row, _), cell in table.get_celld().items():
        cell.set(edgecolor="0.7", facecolor="0.93" if row == 0 else "white")
    return png(figure)
