"""From the drawn numbers of a block to its impacts: on a target, or on a beam that swings back."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.physics import Elastic, HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics.coupled import ModalImpact
from cgid.physics.materials import Material
from cgid.scene.response import TOLERANCE, beam_modes
from cgid.scene.scene import Scene
from cgid.scene.sections import TargetSection
from cgid.scene.weight import weighed
from cgid.validation import Floats

PARTICLE = ("density", "youngs_modulus", "poisson_ratio", "radius")
#: Below this lambda a beam takes so little that what its edges send back of it is left out: the restitution changes
#: by some lambda at most.
NEGLIGIBLE_ECHO = 0.02


def impact_of(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> Impact:
    """Return the impacts of some rows; a beam of known size gives way as a plate without edges."""
    return weighed(scene.impact, target=scene.body, **_collision(scene, values, rows))


def impacts_by_coupling(
    scene: Scene, impact: Impact, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], Impact | ModalImpact, Callable[[NDArray[np.intp]], Impact | ModalImpact]]]:
    """Yield rows, their impacts and what makes those of other rows alike, apart by how the beam gives way.

    impact is what `impact_of` makes of all the rows.
    """
    through_modes = _through_modes(scene, impact, values, rows)
    plain, modal = rows[~through_modes], rows[through_modes]
    if plain.size:
        make = partial(impact_of, scene, values)
        yield plain, impact if not modal.size else make(plain), make
    if modal.size:
        make_modal = partial(_modal_impact_of, scene, values)
        yield modal, make_modal(modal), make_modal


def share_through_modes(scene: Scene, impact: Impact, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> float:
    """Return the share of the impacts of some rows that are solved together with the modes of the beam."""
    return float(np.mean(_through_modes(scene, impact, values, rows)))


def _through_modes(
    scene: Scene, impact: Impact, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return which impacts feel the edges of the beam: its waves come back while they last, and matter."""
    if scene.tail_beam is None or scene.tail_beam.coupling == "impedance":
        return np.zeros(rows.size, bool)
    if scene.panel is None or scene.tail_beam.coupling == "modes":
        return np.ones(rows.size, bool)
    lasts = impact.contact_duration
    echo = scene.panel.echo_time(values["impact_x"][rows], values["impact_y"][rows], 1 / lasts)
    return np.asarray((echo < lasts) & (impact.inelasticity > NEGLIGIBLE_ECHO))


def _modal_impact_of(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> ModalImpact:
    assert scene.tail_beam is not None and isinstance(scene.impact.target, TargetSection)
    modes = beam_modes(scene)
    shape = modes.shape_at({name: column[rows] for name, column in values.items()})
    return ModalImpact(
        target=HalfSpace(material=scene.impact.target.material),
        frequency=modes.frequency,
        damping_ratio=modes.damping_ratio,
        compliance=shape**2 / modes.modal_mass,
        residual_compliance=_residual_compliance(scene, modes.frequency[-1]),
        tolerance=0.1 * TOLERANCE,
        **_collision(scene, values, rows),
    )


def _residual_compliance(scene: Scene, highest: float) -> float:
    """Return how far a panel gives way by the modes above a frequency [Hz], which follow a blow at once [m/N].

    The real part of its mobility is 1/Z at every frequency, so the static compliance above w is `2 / (pi Z w)`. Of a
    beam that was measured nothing is known above the last mode of its table.
    """
    return 0.0 if scene.panel is None else 1 / (math.pi * math.pi * scene.panel.impedance * highest)


def _collision(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> dict[str, Any]:
    """Return what an impact is given beside its target."""
    asked = {name: values[name][rows] for name in (*PARTICLE, "restitution", "velocity")}
    material = Material(
        density=asked["density"], youngs_modulus=asked["youngs_modulus"], poisson_ratio=asked["poisson_ratio"]
    )
    elastic = scene.impact.dissipation == "elastic"
    return {
        "sphere": Sphere(material=material, radius=asked["radius"]),
        "velocity": asked["velocity"],
        "stiffness": scene.impact.stiffness,
        "dissipation": Elastic() if elastic else HuntCrossley(restitution=asked["restitution"], law=scene.impact.law),
    }
