"""Turn drawn numbers into pulses, and pulses into the recorder's response."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats, unchecked
from cgid.errors import InvalidValue
from cgid.measure.modal.modes import Modes
from cgid.physics.contact import laws
from cgid.physics.contact.bodies import Sphere
from cgid.physics.contact.curves import Law, is_builtin, own_code
from cgid.physics.contact.impact import Contacts, Impact
from cgid.physics.contact.laws import HuntCrossley
from cgid.physics.contact.materials import Material
from cgid.physics.contact.sampled import SampledPulses
from cgid.physics.structure.coupled import ModalContacts, ModalImpact
from cgid.physics.structure.places import PlacedShapes, placed
from cgid.physics.structure.plates import PanelShapes
from cgid.physics.structure.response import Response
from cgid.physics.structure.tail_beam import TailBeam
from cgid.scene.file.gravity import weighed
from cgid.scene.file.schema import Scene
from cgid.scene.file.sections import CONTACT_SHAPE, SHAPES, SceneTable, TailBeamSection
from cgid.scene.synthesis.draws import PARTICLE, SPHERE_SHAPE, at_once, drawn_block
from cgid.scene.synthesis.plan import NEGLIGIBLE_ECHO, RESPONSE_TOLERANCE, STORED, Plan, highest_frequency

#: Maximum number of blocks that are drawn at once.
_MAX_BLOCKS = 16

# -- the beam and the recorder ----------------------------------------------------------------------------


def beam_modes(scene: Scene) -> Modes:
    """Return the modes of a scene's tail beam in the band of its recorder, with its sensor; the result is cached."""
    assert scene.tail_beam is not None  # the scene has checked it
    return _beam_modes(scene.tail_beam, scene.panel, highest_frequency(scene))


#: The modes of a panel, which do not depend on where its sensor is; cached.
_panel_modes = lru_cache(maxsize=16)(TailBeam.modes)


@lru_cache(maxsize=16)
def _beam_modes(section: TailBeamSection, panel: TailBeam | None, highest: float) -> Modes:
    if panel is None:
        assert section.measured is not None and section.modes is not None
        measured = section.measured
        if section.shapes is not None:
            measured = replace(measured, at_impact=placed_shapes(section.modes, section.shapes).shapes)
        return _learned(section, measured)
    assert section.sensor_point is not None
    try:
        modes = _panel_modes(panel, highest)
    except InvalidValue as error:
        raise InvalidValue(
            f"tail_beam: {error}; that frequency follows from sensor.anti_alias.frequency, or else from "
            "sampling.sampling_rate: lower it, or take a smaller or thicker beam"
        ) from None
    if not modes.frequency.size:
        raise InvalidValue(
            f"tail_beam: must have a mode within the band of its recorder, it has none below {highest:.4g} Hz; "
            "raise sampling.sampling_rate or sensor.anti_alias.frequency, or take a larger or thinner beam"
        )
    return _learned(section, modes.measured_at(section.sensor_point.x, section.sensor_point.y))


@lru_cache(maxsize=4)
def placed_shapes(modes: SceneTable, shapes: SceneTable) -> PlacedShapes:
    """Return the shapes of measured modes between the places of a table of them [1/sqrt(kg)]."""
    places = np.stack([shapes["x"], shapes["y"]], axis=1)
    values = shapes["shape"] / np.sqrt(modes["modal_mass"])
    return placed(places, values, modes["frequency"], modes["damping_ratio"])


def _learned(section: TailBeamSection, modes: Modes) -> Modes:
    """Return a beam's modes with the learned corrections."""
    learned = section.learned_modes
    if learned is None:
        return modes
    if learned.frequency.size != modes.frequency.size:
        raise InvalidValue(
            f"tail_beam.learned: must have a row for each of the {modes.frequency.size} modes of this beam in the band "
            f"of its recorder, got {learned.frequency.size}; calibrate again (cgid calibrate), or leave it out"
        )
    return modes.as_learned(learned)


def locations_of(parameters: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Return x and y of each impact [m], each (n,); zeros where the modes are those of one point."""
    nowhere = np.zeros(len(next(iter(parameters.values()))))
    return parameters.get("impact_x", nowhere), parameters.get("impact_y", nowhere)


def _shapes(modes: Modes, parameters: Mapping[str, Floats]) -> Floats:
    """Return the shapes at the location of each impact, which is on the beam, (n, n_modes)."""
    x, y = locations_of(parameters)
    return modes.at_impact.inside(x, y) if isinstance(modes.at_impact, PanelShapes) else modes.shape(x, y)


@dataclass(frozen=True)
class Recorder:
    """The response of a scene's recorder; for a force, `modes` and `gain` are None."""

    response: Response
    modes: Modes | None
    gain: float | None = None

    def participation(self, parameters: Mapping[str, Floats]) -> Floats | None:
        """Return the participation of each mode in each impact, including the gain, (n, n_modes) [1/kg]."""
        if self.modes is None or self.modes.at_sensor is None:
            return None
        participation = _shapes(self.modes, parameters) * self.modes.at_sensor
        return participation if self.gain is None else self.gain * participation


def recorder_of(plan: Plan) -> Recorder | None:
    """Return the response of beam and sensor; None where the forces themselves are recorded."""
    if not plan.responds:
        return None
    chain = plan.runs("sensor chain")
    return _recorder(plan.scene, plan.runs("tail beam"), chain)


@lru_cache(maxsize=16)
def _recorder(scene: Scene, beam: bool, chain: bool) -> Recorder:
    sensor = scene.sensor
    modes = beam_modes(scene) if beam else None
    response = Response(
        sampling_rate=scene.sampling.sampling_rate,
        quantity=sensor.quantity,
        modes=modes,
        filters=sensor.filters if chain else (),
        tolerance=RESPONSE_TOLERANCE,
    )
    return Recorder(response, modes, sensor.gain)


# -- impacts ----------------------------------------------------------------------------------------------


def impacts_of(
    plan: Plan, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], Impact]]:
    """Yield groups of rows that lose energy in the same way, and their impacts, as from `impact_of`."""
    if not plan.scene.mixes_laws:
        yield rows, impact_of(plan, values, rows)
        return
    laws = values["dissipation"][rows]
    for law in np.unique(laws):
        own = rows[laws == law]
        yield own, impact_of(plan, values, own)


def impact_of(plan: Plan, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> Impact:
    """Return the impacts of some rows of the same dissipation; a beam of known size counts as an infinite plate."""
    scene = plan.scene
    parts = _collision(scene, values, rows)
    if not plan.runs("gravity"):
        return Contacts(target=scene.body, **parts)
    return weighed(scene.impact, target=scene.body, **parts)


def impacts_by_coupling(
    plan: Plan, impact: Impact, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], Impact | ModalImpact, Callable[[NDArray[np.intp]], Impact | ModalImpact]]]:
    """Yield groups of rows by coupling to the beam: the rows, their impacts, and a function from rows to impacts."""
    through_modes = _through_modes(plan, impact, values, rows)
    plain, modal = rows[~through_modes], rows[through_modes]
    if plain.size:
        make = partial(impact_of, plan, values)
        yield plain, impact if not modal.size else make(plain), make
    if modal.size:
        make_modal = partial(_modal_impact_of, plan.scene, values)
        yield modal, make_modal(modal), make_modal


def contacts_of(
    plan: Plan, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], Impact | ModalImpact]]:
    """Yield groups of rows of one law and one coupling, and their impacts."""
    for own, impact in impacts_of(plan, values, rows):
        for group, contacts, _ in impacts_by_coupling(plan, impact, values, own):
            yield group, contacts


def _through_modes(
    plan: Plan, impact: Impact, values: Mapping[str, Floats], rows: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return which impacts feel the edges of the beam: waves return during contact, and lambda is not negligible."""
    scene = plan.scene
    if not plan.runs("coupling"):
        return np.zeros(rows.size, bool)
    assert scene.tail_beam is not None
    if scene.tail_beam.couples_always:
        return np.ones(rows.size, bool)
    assert scene.panel is not None
    lasts = impact.contact_duration
    x, y = values["impact_x"][rows] / scene.panel.length, values["impact_y"][rows] / scene.panel.width
    echo = scene.panel.echoes(x, y, 1 / lasts)
    return np.asarray((echo < lasts) & (impact.inelasticity > NEGLIGIBLE_ECHO))


def _modal_impact_of(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> ModalImpact:
    modes = beam_modes(scene)
    shape = _shapes(modes, {name: column[rows] for name, column in values.items()})
    order = np.argsort(modes.frequency, kind="stable")  # learned modes may have swapped
    return ModalContacts(
        target=scene.impact.body,
        frequency=modes.frequency[order],
        damping_ratio=modes.damping_ratio[order],
        compliance=(shape**2)[:, order],
        residual_compliance=modes.residual,
        tolerance=0.1 * RESPONSE_TOLERANCE,
        **_collision(scene, values, rows),
    )


def _collision(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> dict[str, Any]:
    """Return the arguments of an impact except its target."""
    *of_material, radius = PARTICLE
    material = unchecked(Material, **{name: values[name][rows] for name in of_material})
    shape = {name: values[name][rows] for name in SPHERE_SHAPE if name in values}
    return {
        "sphere": unchecked(Sphere, material=material, radius=values[radius][rows], **shape),
        "velocity": values["velocity"][rows],
        "stiffness": scene.impact.stiffness,
        "dissipation": _dissipation(scene, values, rows),
    }


def _dissipation(scene: Scene, values: Mapping[str, Floats], rows: NDArray[np.intp]) -> Law:
    """Return the loss of some impacts, which all have the same law."""
    name = scene.dissipations[0] if scene.dissipations else scene.impact.dissipation
    if scene.mixes_laws and rows.size:
        name = scene.law_names[int(values["dissipation"][rows[0]])]
    law = laws.named(name)
    given: dict[str, Floats | None] = {key: values[key][rows] for key in law.keys if key in values}
    if "viscous_restitution" in given:
        viscous = values["viscous_restitution"][rows]
        has = np.isfinite(viscous)
        given["viscous_restitution"] = np.where(has, viscous, 1.0) if has.any() else None
    for key in CONTACT_SHAPE.keys() & given.keys():
        drawn = values[key][rows]
        given[key] = np.where(np.isfinite(drawn), drawn, getattr(law, key, CONTACT_SHAPE[key]))
    if not is_builtin(law):
        with own_code(law):
            return law(**given)
    return unchecked(law, **given, **({"law": scene.impact.law} if law is HuntCrossley else {}))


# -- the pulses of a block --------------------------------------------------------------------------------


@dataclass(frozen=True)
class TapPulses:
    """Pulses of prescribed shapes, one for each row: a hammer, a calibration, a fault."""

    shape: NDArray[np.intp]  # index in `SHAPES`, (n,)
    peak_force: Floats  # [N], (n,)
    contact_duration: Floats  # [s], (n,)

    @property
    def end_of_contact(self) -> Floats:
        """Time from onset to separation [s]."""
        return self.contact_duration

    def add_to_frames(
        self, frames: NDArray[Any], sampling_rate: float | Floats, onset: Floats, *, tolerance: float = 0.0
    ) -> None:
        """Add the exact pulses to frames (n, n_samples) in place, each from its onset [s] on."""
        shapes = tuple(SHAPES.values())
        place, length = onset * sampling_rate, self.contact_duration * sampling_rate
        # As for an impact, samples exactly at onset and separation hold no force, even for a square pulse.
        first = np.clip(np.floor(place) + 1, 0, frames.shape[1]).astype(np.intp)
        behind = np.clip(np.ceil(place + length), first, frames.shape[1]).astype(np.intp)
        for row, frame in enumerate(frames):
            samples = np.arange(first[row], behind[row])
            share = (samples - place[row]) / length[row]
            # Rounding may put a sample on the end just past it.
            force = np.where(share < 1, shapes[self.shape[row]](share), 0.0)
            frame[first[row] : behind[row]] += self.peak_force[row] * force


Pulses = Impact | ModalImpact | TapPulses | SampledPulses


@dataclass(frozen=True)
class Strike:
    """Pulses of one kind, with their rows in a block."""

    rows: NDArray[np.intp]  # their signals in the block, (n,)
    pulses: Pulses
    onset: Floats  # time of onset in the frame [s], (n,)
    ratio: Floats | None = None  # factor of each, (n,)

    def add_to_frames(self, frames: NDArray[Any], sampling_rate: float) -> None:
        """Add the pulses to the frames of the block, in place."""
        if self.ratio is None and self.rows.size == len(frames):
            self.pulses.add_to_frames(frames, sampling_rate, self.onset)
            return
        added = np.zeros((self.rows.size, frames.shape[1]), frames.dtype)
        self.pulses.add_to_frames(added, sampling_rate, self.onset)
        if self.ratio is not None:
            added *= self.ratio.astype(frames.dtype)[:, None]
        frames[self.rows] += added

    def add_response(self, frames: NDArray[Any], recorder: Recorder, parameters: Mapping[str, Floats]) -> None:
        """Add the recorder's response to the pulses to the frames of the block, in place."""
        selected = {name: values[self.rows] for name, values in parameters.items()}
        recorder.response.add_to_frames(
            frames, self.pulses, self.onset, recorder.participation(selected), rows=self.rows, ratio=self.ratio
        )


@dataclass(frozen=True)
class PulseBlock:
    """All pulses of one block of signals; `impacts` are all drawn ones, as if a beam had no edges."""

    # parameters : drawn and derived, (n_signals,), nan where not applicable; peak and duration are those of the first
    # hit

    labels: NDArray[np.str_]
    parameters: Mapping[str, Floats]
    specimen: NDArray[np.uint64]
    strikes: tuple[Strike, ...]
    plan: Plan
    impacts: tuple[Impact, ...] = ()

    @property
    def scene(self) -> Scene:
        """The scene of this block."""
        return self.plan.scene

    def add_to_frames(self, frames: NDArray[Any]) -> None:
        """Add the forces, or the response of beam and sensor to them, to the frames in place, as planned."""
        recorder = recorder_of(self.plan)
        for strike in self.strikes:
            if recorder is None:
                strike.add_to_frames(frames, self.scene.sampling.sampling_rate)
            else:
                strike.add_response(frames, recorder, self.parameters)

    @property
    def impact(self) -> Impact:
        """All drawn impacts of a scene whose populations have the same dissipation."""
        (impact,) = self.impacts
        return impact

    @property
    def strain(self) -> Floats:
        """Largest displacement of the first impacts over their radius, as if a beam had no edges, (n_impacts,)."""
        return np.concatenate([one.peak_displacement / one.reduced_radius for one in self.impacts])

    @property
    def inelasticity(self) -> Floats:
        """Zener's lambda of the first impacts, 0 for those coupled through modes, (n_impacts,)."""
        first = [strike.pulses for strike in self.strikes if strike.ratio is None]
        return np.concatenate([np.empty(0), *(p.inelasticity for p in first if isinstance(p, Impact))])


def draw(scene: Scene, seed: int, block: int) -> PulseBlock:
    """Return the true pulses of one block of 256, as `pulses_of_block`; rocks of a stream fall into frames."""
    return pulses_of_block(Plan(scene=scene, kind="pulses"), seed, block)


def draws(scene: Scene, seed: int, n_blocks: int = sys.maxsize) -> Iterator[PulseBlock]:
    """Yield the pulses of the first blocks, as `draw`, many at once where they share a rig."""
    plan, step = Plan(scene=scene, kind="pulses"), at_once(scene, _MAX_BLOCKS)
    for first in range(0, n_blocks, step):
        yield pulses_of_block(plan, seed, first, min(step, n_blocks - first))


def pulses_of_block(plan: Plan, seed: int, block: int, n_blocks: int = 1) -> PulseBlock:
    """Return the pulses of one block of 256, or of several of one rig, which takes a fifth of the time."""
    drawn = drawn_block(plan.scene, seed, block, n_blocks)
    block_plan, values = plan.for_block(drawn.scene), drawn.values
    strikes: list[Strike] = []
    groups = list(impacts_of(block_plan, values, drawn.fallen))
    for group, impact in groups if block_plan.runs("pulses") else ():
        for rows, pulses, pulses_of in impacts_by_coupling(block_plan, impact, values, group):
            strikes += _strikes(block_plan, pulses, pulses_of, rows, values)
            # Store the delivered values; the requested restitution may differ.
            for name in STORED:
                values[name][rows] = getattr(pulses, name)
    if block_plan.runs("taps"):
        tapped = partial(_taps, drawn.shapes, values)
        strikes += _strikes(block_plan, tapped(drawn.tapped), tapped, drawn.tapped, values)
    return PulseBlock(
        drawn.labels, values, drawn.specimen, tuple(strikes), block_plan, tuple(impact for _, impact in groups)
    )


def _strikes(
    plan: Plan,
    first: Pulses,
    pulses_of: Callable[[NDArray[np.intp]], Pulses],
    rows: NDArray[np.intp],
    values: Mapping[str, Floats],
) -> Iterator[Strike]:
    """Yield the first pulses of some signals, then the second hits, if any."""
    if rows.size:
        yield Strike(rows, first, values["onset"][rows])
    if not plan.runs("second hits"):
        return
    again = rows[np.isfinite(values["second_hit_delay"][rows])]
    if again.size:
        onset = values["onset"][again] + values["second_hit_delay"][again]
        yield Strike(again, pulses_of(again), onset, values["second_hit_ratio"][again])


def _taps(shapes: NDArray[np.intp], values: Mapping[str, Floats], rows: NDArray[np.intp]) -> TapPulses:
    return TapPulses(shapes[rows], values["peak_force"][rows], values["contact_duration"][rows])
