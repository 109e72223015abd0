"""The scene file, in TOML, and variations of a scene; validation reports every mistake with its path."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Self, get_args

from pydantic import BaseModel, Field, PrivateAttr, ValidationError, model_validator

from cgid._lib import validation
from cgid._lib.files import parse_toml, read_regular
from cgid._lib.notebook import facts_table
from cgid._lib.validation import cut, shown, similar, suggestion
from cgid.errors import BadData, InvalidValue
from cgid.physics.contact.bodies import Target
from cgid.physics.contact.laws import named
from cgid.physics.contact.own_laws import add_laws, how_to_add, own_law, sources
from cgid.physics.structure.tail_beam import TailBeam
from cgid.scene.file.background import HUM_FREQUENCY, BackgroundSection, with_spectrum
from cgid.scene.file.distributions import DISTRIBUTION_NAMES, Section, quantity_of
from cgid.scene.file.gravity import problem_of_law, problem_of_weight, problem_on_plate
from cgid.scene.file.sections import (
    CONTACT_SHAPE,
    DISSIPATIONS,
    NUMBERED_LAWS,
    PLASTIC,
    ImpactSection,
    Population,
    PrescribedPulses,
    RandomiseSection,
    SamplingSection,
    TailBeamSection,
    TargetSection,
    loss_key,
    with_table,
)
from cgid.scene.file.sensor import CHUNK, Sensor
from cgid.scene.file.stream_section import StreamSection
from cgid.shipped import scene_path

#: Largest scene file [bytes] and most keys in it: 10,000 measured modes have 60,000.
_MAX_FILE_SIZE, _MAX_KEYS = 8 << 20, 100_000
#: Maximum number of mistakes in one report.
_MAX_MISTAKES = 20


class Scene(Section):
    """A complete scene; see `load_scene`."""

    name: str = Field(min_length=1, max_length=64)
    """Name of the scene, which datasets and model cards include."""
    description: str = ""
    """Description of the scene for readers."""
    impact: ImpactSection
    """The laws of the impact and the target."""
    sampling: SamplingSection
    """How signals are sampled."""
    sensor: Sensor = Sensor()
    """The sensor; without it an exact recorder of the force."""
    tail_beam: TailBeamSection | None = None
    """The beam that the rocks hit, and on which a sensor of motion is mounted."""
    randomise: RandomiseSection | None = None
    """Settings that are random instead of fixed."""
    populations: tuple[Population, ...] = Field(default=(), max_length=64)
    """The rocks that fall."""
    taps: tuple[PrescribedPulses, ...] = Field(default=(), max_length=64)
    """Pulses of a prescribed shape, such as those of a hammer."""
    stream: StreamSection | None = None
    """One long recording of many rocks, instead of a frame for each impact."""
    background: BackgroundSection | None = None
    """Hum, noise or a recording that is added to the signals."""

    #: Modules of custom laws named by the user, for other processes; scene files cannot name one.
    _law_modules: tuple[str, ...] = PrivateAttr(default_factory=sources)

    def __setstate__(self, state: dict[Any, Any]) -> None:
        """Load the laws in another process."""
        super().__setstate__(state)
        for source in self._law_modules:
            if source not in sources():
                add_laws(source)

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        problems = []
        if not self.sources:
            problems.append("populations: must be at least 1 without taps, got none of either")
        problems += self._problems_of_dissipation()
        problems += self._problems_of_beam()
        if not problems:  # an invalid beam cannot be a target
            thickness = "impact.target.thickness" if self.tail_beam is None else "tail_beam.thickness"
            for index, population in enumerate(self.populations):
                problem = (
                    problem_of_law(self.impact, self.body, population)
                    or problem_on_plate(self.impact, self.body, population, thickness)
                    or problem_of_weight(self.impact, self.body, population)
                )
                if problem is not None:
                    problems.append(f"populations.{index}: {problem}")
        if self.impact.gravity_tolerance is not None and self.impact.gravity is None:
            problems.append("impact.gravity_tolerance: needs impact.gravity; give that, too, or leave it out")
        if self.impact.gravity is not None and self.tail_beam is not None:
            problems.append("impact.gravity: must be left out, an impact on a tail beam has no weight")
        problems += self._problems_of_band()
        period = (self.sampling.samples or CHUNK) / self.extreme_rates[0]
        drawn = () if self.randomise is None else tuple(self.randomise.laws)
        problems += self.sensor.problems((1 / period, self.extreme_rates[-1] / 2), drawn)
        problems += self._problems_of_hum()
        problems += self.sampling.frame_problems(self.stream is not None)
        if self.stream is not None:
            problems += self.stream.problems(self.populations, self.sensor, self.sampling.sampling_rate)
            for name in ("taps", "randomise"):
                if getattr(self, name):
                    problems.append(f"{name}: must be left out of a stream, one recording of rocks that fall")
        if self.background is not None:
            problems += self.background.problems(
                self.sensor.quantity, self.extreme_rates[0], is_stream=self.stream is not None
            )
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def __repr__(self) -> str:
        sources = ", ".join(dict.fromkeys(source.label for source in self.sources))
        size = f"frames of {samples_of(self)} samples"
        if self.stream is not None:
            size = f"a recording of {self.stream.duration:g} s"
        return f"Scene({self.name!r}: {sources}; {size} at {self._rate} [{self.sensor.unit}])"

    __str__ = __repr__

    @property
    def _rate(self) -> str:
        return "a random rate" if self.draws("sampling_rate") else f"{self.sampling.sampling_rate:g} Hz"

    def _repr_html_(self) -> str:
        facts = {
            "description": self.description,
            "labels": ", ".join(self.labels),
            "target": "tail beam" if self.tail_beam is not None else "half space or plate",
            "sensor": f"{self.sensor.quantity} [{self.sensor.unit}] at {self._rate}",
            "recording" if self.stream is not None else "frames": (
                f"{self.stream.duration:g} s" if self.stream is not None else f"{samples_of(self)} samples"
            ),
        }
        return facts_table(f"Scene {self.name}", facts)

    def plot(self, n: int = 20, seed: int = 0, axes: Any = None) -> Any:
        """Draw some signals of each label over time.

        Parameters
        ----------
        n : int
            Number of signals of each label, at most 200; fewer of a label that is rare.
        seed : int
            As in `cgid.synthesise`.
        axes : matplotlib.axes.Axes, optional
            New ones by default.

        Returns
        -------
        matplotlib.axes.Axes

        Raises
        ------
        InvalidValue
            The scene is a stream: generate its recording and draw that.
        MissingExtra
            matplotlib is not installed.
        """
        from cgid.plots.objects import MAX_LINES, plot_batches
        from cgid.scene.synthesis.synthesis import synthesise

        n = validation.whole("n", n, 1, MAX_LINES)
        return plot_batches(synthesise(self, 4 * n * len(self.labels), seed), n, f"scene {self.name}", axes)

    def _problems_of_dissipation(self) -> list[str]:
        problems = []
        for index, (population, dissipation) in enumerate(zip(self.populations, self.dissipations, strict=True)):
            needed, table = loss_key(dissipation), f"populations.{index}"
            instead = {"yield_pressure": "strength"}.get(needed or "")
            for name in ("restitution", "yield_pressure", "strength"):
                given = getattr(population, name) is not None
                if given and name not in (needed, instead):
                    hint = "; for viscous loss beside crushing give viscous_restitution" * (instead is not None)
                    hint += "; for rock that breaks give breaking_force" * (dissipation == "power-law")
                    problems.append(f"{table}.{name}: must be left out when dissipation is {dissipation}{hint}")
                if not given and name == needed and not (instead and getattr(population, instead) is not None):
                    other = f", or {instead}" * (instead is not None)
                    problems.append(f"{table}.{name}: is missing, {dissipation} dissipation needs it{other}")
            if population.yield_pressure is not None and population.strength is not None:
                problems.append(f"{table}.strength: must be left out with yield_pressure, which it replaces")
            for name in CONTACT_SHAPE:
                if getattr(population, name) is not None and name not in named(dissipation).keys:
                    problems.append(
                        f"{table}.{name}: must be left out when dissipation is {dissipation}, whose contact is a "
                        "sphere's; use power-law dissipation"
                    )
            if population.viscous_restitution is not None and "viscous_restitution" not in named(dissipation).keys:
                hint = "leave it out" if needed is None else "give restitution, which is viscous"
                problems.append(
                    f"{table}.viscous_restitution: must be left out when dissipation is {dissipation}; {hint}"
                )
        return problems

    def _problems_of_beam(self) -> list[str]:
        if self.tail_beam is None:
            if self.sensor.quantity == "force":
                return []
            return [f"tail_beam: is missing, a sensor of {self.sensor.quantity} needs one; or use quantity = 'force'"]
        target = self.impact.target
        if isinstance(target, str):
            return ["impact.target: must be the material of the tail beam, got 'rigid'"]
        if target.thickness is not None:
            return ["impact.target.thickness: must be left out, the tail beam has one"]
        try:
            _ = self.panel
        except InvalidValue as error:
            return [f"tail_beam: {error}"]
        return []

    def _problems_of_band(self) -> list[str]:
        nyquist = self.sampling.sampling_rate / 2
        limits = {"sensor.bandwidth": self.sensor.bandwidth, "sensor.ac_coupling": self.sensor.ac_coupling}
        if self.sensor.anti_alias is not None:
            limits["sensor.anti_alias.frequency"] = self.sensor.anti_alias.frequency
        return [
            f"{name}: must be below half the sampling rate, {nyquist:g} Hz, got {limit:g} Hz; leave it out for an "
            "unlimited sensor"
            for name, limit in limits.items()
            if limit is not None and limit >= nyquist
        ]

    def _problems_of_hum(self) -> list[str]:
        drawn = None if self.randomise is None else self.randomise.hum_frequency
        highest = HUM_FREQUENCY if drawn is None else drawn.extremes[1]
        if not self.draws("hum") or highest < self.extreme_rates[0] / 2:
            return []
        return [
            f"randomise.hum_frequency: must be below half the sampling rate, {self.extreme_rates[0] / 2:g} Hz, it can "
            f"be {highest:g} Hz; lower it, or raise the sampling rate"
        ]

    @cached_property
    def panel(self) -> TailBeam | None:
        """The tail beam, if it is given by its dimensions."""
        if self.tail_beam is None or not isinstance(self.impact.target, TargetSection):
            return None
        return self.tail_beam.panel(self.impact.target.material)

    @property
    def region(self) -> tuple[float, ...] | None:
        """Lowest and highest x, lowest and highest y of a beam that impacts may hit [m]; None for none or one place."""
        return None if self.tail_beam is None else self.tail_beam.region

    @cached_property
    def body(self) -> Target:
        """The target of every impact; a beam of known size counts as an infinite plate."""
        if self.panel is not None:
            return self.panel.plate
        return self.impact.body

    @cached_property
    def dissipations(self) -> tuple[str, ...]:
        """The dissipation of each population."""
        return tuple(population.dissipation or self.impact.dissipation for population in self.populations)

    @property
    def law_names(self) -> tuple[str, ...]:
        """The laws of loss by their index in data: `NUMBERED_LAWS`, then others in the order of populations."""
        return tuple(dict.fromkeys((*NUMBERED_LAWS, *self.dissipations)))

    @property
    def own_laws(self) -> dict[str, str]:
        """The custom laws of the scene, by name, and the SHA-256 of their modules."""
        own = {name: own_law(name) for name in dict.fromkeys(self.dissipations) if name not in DISSIPATIONS}
        return {name: law.sha256 for name, law in own.items() if law is not None}

    @property
    def plastic(self) -> tuple[str, ...]:
        """The dissipations with different paths of loading and unloading."""
        return tuple(name for name in PLASTIC if name in self.dissipations)

    @cached_property
    def mixes_laws(self) -> bool:
        """Whether populations differ in their dissipation."""
        return len(set(self.dissipations)) > 1

    @cached_property
    def sources(self) -> tuple[Population | PrescribedPulses, ...]:
        """Populations and taps, in the order used for drawing one."""
        return (*self.populations, *self.taps)

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels in alphabetical order."""
        return tuple(sorted({source.label for source in self.sources}))

    @property
    def extreme_rates(self) -> tuple[float, ...]:
        """The sampling rate, or the lowest and the highest that can be drawn [Hz]."""
        drawn = None if self.randomise is None else self.randomise.sampling_rate
        return (self.sampling.sampling_rate,) if drawn is None else drawn.extremes

    def draws(self, name: str) -> bool:
        """Return whether a setting of `randomise` is drawn for each block."""
        return self.randomise is not None and name in self.randomise.laws

    @property
    def text(self) -> str:
        """The complete scene as JSON with sorted keys, as stored in datasets and hashed."""
        content = self.model_dump(mode="json", exclude_none=True)
        # Unused parts are omitted, so adding a new kind of part does not change the identity of old scenes.
        if self.sensor.quantity == "force":
            del content["sensor"]["quantity"]
        return json.dumps({key: part for key, part in content.items() if part != []}, sort_keys=True)

    @cached_property  # set by `parse_scene`; not a field, because it must not change the identity of a scene
    def folder(self) -> Path:
        """Folder of the scene file; paths in the file are relative to it."""
        return Path()

    @cached_property  # every batch of signals carries it
    def sha256(self) -> str:
        """Identity of the scene: the hash of `text`, independent of the layout of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy without cached values of the replaced fields, but with the same identity."""
        copy = super().model_copy(update=update, deep=deep)
        for name in ("panel", "body", "dissipations", "mixes_laws", "sources"):
            copy.__dict__.pop(name, None)
        return copy


def samples_of(scene: Scene) -> int:
    """Return the number of samples of a frame, or of a recording of a stream."""
    if scene.stream is None:
        return scene.sampling.samples
    return max(round(scene.stream.duration * scene.sampling.sampling_rate), 1)


def load_scene(path: str | Path | Scene) -> Scene:
    """Load a scene from a TOML file, or one that is bundled with cgid.

    Parameters
    ----------
    path : str or Path
        A file, or the name of a shipped scene, as `cgid check --list` prints them; a `Path` is always a file. A `Scene`
        is returned as it is.

    Returns
    -------
    Scene

    Raises
    ------
    NoInput
        There is no such scene, or the file cannot be read.
    BadData
        The file is not valid TOML or breaks rules; one line for each mistake, with its path in the file.

    Examples
    --------
    >>> load_scene("reference").labels
    ('coal', 'gangue')
    """
    if isinstance(path, Scene):
        return path
    path = scene_path(path)
    try:
        text = read_regular(path, "a scene file", _MAX_FILE_SIZE, "give a .toml file").decode()
    except UnicodeDecodeError:
        raise BadData(
            f"{path}: a scene file must be UTF-8 text; this one is not; cgid.Dataset reads a dataset"
        ) from None
    try:
        content = parse_toml(text, _MAX_KEYS)
    except ValueError as error:  # also integers of thousands of digits
        raise BadData(f"{path}: a scene file must be valid TOML: {error}; correct it there") from None
    folder = Path(path).parent
    return parse_scene(with_spectrum(with_table(content, folder), folder), source=str(path), folder=folder)


def stored_scene(attributes: Mapping[str, Any], source: str) -> Scene | None:
    """Return the scene in the attributes of a dataset or recording; None without one."""
    try:
        content = json.loads(attributes["scene"])
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    return parse_scene(content, source=source) if isinstance(content, dict) else None


def parse_scene(content: dict[str, Any], source: str = "scene", folder: Path | None = None) -> Scene:
    """Return the scene of a mapping with the structure of the file.

    Parameters
    ----------
    content : dict
    source : str
        Name for error messages.
    folder : Path, optional
        Base of relative paths, by default the working directory.

    Returns
    -------
    Scene

    Raises
    ------
    BadData
        As in `load_scene`.
    """
    try:
        scene = Scene.model_validate(content)
        if folder is not None:
            scene.__dict__["folder"] = folder
        return scene
    except ValidationError as error:
        errors = error.errors(include_url=False)
        unknown = [entry["loc"] for entry in errors if entry["type"] == "extra_forbidden"]
        # A key that is misspelt is missing, too.
        misspelt = {(*location[:-1], key) for location in unknown for key in _similar_keys(location)}
        entries = [entry for entry in errors if entry["loc"] not in misspelt and not _secondary(entry, errors)]
        problems = _each_key_once([line for entry in entries for line in _lines(entry)])
        more = [f"and {len(problems) - _MAX_MISTAKES} more mistakes"] * (len(problems) > _MAX_MISTAKES)
        raise BadData(*(f"{source}: {line}" for line in problems[:_MAX_MISTAKES] + more)) from None


def _each_key_once(problems: Sequence[str]) -> list[str]:
    """Return the problems; one of several entries of a list is told once, with the places of the others."""
    places: dict[tuple[str, ...], list[str]] = {}
    for line in problems:
        path, colon, text = line.partition(": ")
        entry = re.match(r"(\w+\.)(\d+)(\..+)", path)
        section, index, key = entry.groups() if entry else (path, "", "")
        places.setdefault((section, key, colon, text), []).append(index)
    return [
        f"{section}{first}{key}{colon}{text}" + f" (also in {section}{', '.join(more[:8])})" * bool(more)
        for (section, key, colon, text), (first, *more) in places.items()
    ]


def _path(location: tuple[int | str, ...]) -> str:
    """Return a path without the names of alternatives that pydantic inserts."""
    left_out = {*DISTRIBUTION_NAMES, "TargetSection", "literal['rigid']"}
    parts = [str(part) for part in location if part not in left_out]
    return ".".join(cut(part if part.isprintable() else repr(part)) for part in parts) or "scene"


def _secondary(entry: Any, errors: Sequence[Any]) -> bool:
    """Return whether an error is a consequence of another, or concerns the unused form of target."""
    if entry["type"] == "too_short":  # a list all of whose rows are invalid
        location = entry["loc"]
        return any(other["loc"][: len(location)] == location and len(other["loc"]) > len(location) for other in errors)
    if "literal['rigid']" in entry["loc"]:
        return isinstance(entry["input"], dict)
    return "TargetSection" in entry["loc"] and entry["type"] == "model_type"


def _lines(entry: Any) -> list[str]:
    """Return one line for each problem; problems of the complete scene already carry their paths."""
    message = _message(entry)
    if not entry["loc"] and entry["type"] == "value_error":
        return message.split("\n")
    return [f"{_path(entry['loc'])}: {message}"]


def _message(entry: Any) -> str:
    if entry["type"] == "extra_forbidden":
        meant = _similar_keys(entry["loc"])
        return f"unknown key; {f'did you mean {meant[0]!r}?' if meant else 'check the spelling, or remove it'}"
    if entry["type"] == "missing":
        return f"is missing{_description(entry['loc'])}"
    if entry["type"] in ("too_short", "too_long"):
        context = entry["ctx"]
        minimum, bound = ("at least", "min_length") if entry["type"] == "too_short" else ("at most", "max_length")
        return f"must have {minimum} {context[bound]}, got {context['actual_length'] or 'none'}"
    if entry["type"] in ("union_tag_not_found", "union_tag_invalid"):
        got = f", got {shown(entry['ctx']['tag'])}" if "tag" in entry.get("ctx", {}) else ""
        return f"must name its distribution: one of {', '.join(DISTRIBUTION_NAMES)}{got}"
    text = str(entry["msg"]).removeprefix("Value error, ").replace("Input should", "must")
    given = entry["input"]
    if entry["type"] != "value_error" and isinstance(given, str | int | float):
        text += f", got {shown(given)}"
    if entry["type"] == "literal_error":
        hint = suggestion(given, re.findall("'([^']+)'", entry["ctx"]["expected"]))
        if "literal['rigid']" in entry["loc"]:
            hint = hint or "; or give its material as { density = ..., youngs_modulus = ..., poisson_ratio = ... }"
        text += hint or f"; {how_to_add()}" * ("dissipation" in entry["loc"])
    return text


def _similar_keys(location: Sequence[int | str]) -> list[str]:
    """Return the key that an unknown one may mean, if there is one."""
    keys = [key for section in _sections_at(location[:-1]) for key in section.model_fields]
    return similar(str(location[-1]), keys)


def _description(location: Sequence[int | str]) -> str:
    """Return the description of a key, for the end of a message."""
    name, fields = location[-1], [one.model_fields for one in _sections_at(location[:-1])]
    field = next((one[str(name)] for one in fields if name in one), None)
    if field is None or not field.description:
        return ""
    quantity = quantity_of(field)
    unit = f" [{quantity.unit}]" if quantity is not None and quantity.unit else ""
    return f": {re.split('[.;:] ', field.description)[0].rstrip('.')}{unit}"


def _sections_at(location: Sequence[int | str]) -> list[type[BaseModel]]:
    """Return the section at a path; all distributions, if it is one."""
    sections: list[type[BaseModel]] = [Scene]
    for part in location:  # row numbers and names of alternatives are not keys
        types = [one.model_fields[part].annotation for one in sections if part in one.model_fields]
        sections = [section for annotation in types for section in _sections_in(annotation)] or sections
    return sections


def _sections_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the sections in the type of a key."""
    if parts := get_args(annotation):
        return [section for part in parts for section in _sections_in(part)]
    return [annotation] if isinstance(annotation, type) and issubclass(annotation, BaseModel) else []


#: Minimum number of samples before onset with `keep_frame`: baseline and noise are measured there.
MIN_PRE_TRIGGER = 64
_SECTIONS: dict[str, type[BaseModel]] = {"impact": ImpactSection, "sampling": SamplingSection, "sensor": Sensor}
_LISTS: dict[str, type[BaseModel]] = {"populations": Population, "taps": PrescribedPulses}
#: Settings that replace each other, and randomised settings with another name than the fixed one.
_INSTEAD = {"velocity": "drop_height", "drop_height": "velocity", "range": "relative_range", "relative_range": "range"}
_RANDOMISED_AS = {"anti_alias": "anti_alias_frequency", "range": "relative_range"}
_SOURCE_KEYS = ("label", "weight", "dissipation")


def varied(scene: Scene | str | Path, *, keep_frame: bool = False, **changes: Any) -> Scene:
    """Return a validated copy of a scene with some settings changed.

    Parameters
    ----------
    scene : Scene, str or Path
    keep_frame : bool
        With a new `sampling_rate`, keep the durations before and after onset, with at least `MIN_PRE_TRIGGER` samples
        before onset; `samples` and `pre_trigger` must then be left out.
    **changes
        `name`, `description`, or any key of `impact`, `sampling` or `sensor`, such as `stiffness`, `target`, `range`;
        or any key of a population or tap except label, weight and dissipation, such as `radius`, `clipped_at`, which
        changes in all that have such a key. Values are those of a scene file (a number, a string with a unit, a
        mapping) or objects of a scene; None removes an optional setting. `velocity` replaces `drop_height`, `range`
        replaces `relative_range`, and vice versa. A setting given here is no longer randomised.

    Returns
    -------
    Scene

    Raises
    ------
    InvalidValue
        The scene has no such setting, or `keep_frame` does not apply.
    BadData
        The changed scene breaks rules.

    Examples
    --------
    >>> from cgid.scene import load_scene
    >>> slow = varied(load_scene("reference"), keep_frame=True, sampling_rate="50 kHz")
    >>> slow.sampling.samples, slow.sampling.pre_trigger
    (526, 64)
    """
    scene = load_scene(scene)
    content = json.loads(scene.text)
    if keep_frame:
        changes |= _same_frame(scene, changes)
    for name, value in changes.items():
        sections = _sections_with(content, name)
        if not sections:
            raise InvalidValue(f"{name} must be a setting of scene {scene.name}, which has no setting of this name")
        for section in sections:
            for other in (name, _INSTEAD.get(name, name)):
                section.pop(other, None)
            if value is not None:
                section[name] = value
    return parse_scene(content, source=f"variation of {scene.name}", folder=scene.folder)


def _sections_with(content: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the sections of a scene that may have this key, and remove it from `randomise`."""
    randomise = content.get("randomise", {})
    for drawn in (name, _RANDOMISED_AS.get(name, name)):
        if drawn in RandomiseSection.model_fields and randomise.pop(drawn, None) is not None and not randomise:
            del content["randomise"]
    if name in ("name", "description"):
        return [content]
    sections = [content.setdefault(part, {}) for part, section in _SECTIONS.items() if name in section.model_fields]
    if name not in _SOURCE_KEYS:
        for part, kind in _LISTS.items():
            sections += content.get(part, []) if name in kind.model_fields else []
    return sections


def _same_frame(scene: Scene, changes: dict[str, Any]) -> dict[str, Any]:
    """Return `pre_trigger` and `samples` that span the same time at another sampling rate."""
    given = sorted({"samples", "pre_trigger"} & changes.keys())
    if "sampling_rate" not in changes or given:
        raise InvalidValue(
            "keep_frame needs sampling_rate without samples and pre_trigger, which follow from it, got "
            f"{', '.join(sorted(changes)) or 'nothing'}"
        )
    old = scene.sampling
    # Parsed like the file, because it may be a string with a unit.
    new = varied(scene, sampling_rate=changes["sampling_rate"], bandwidth=None).sampling.sampling_rate
    ratio = new / old.sampling_rate
    before = max(MIN_PRE_TRIGGER, round(old.pre_trigger * ratio))
    return {"pre_trigger": before, "samples": before + round((old.samples - old.pre_trigger) * ratio)}
