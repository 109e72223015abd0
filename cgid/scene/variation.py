"""Scenes that differ from another in a few settings: another seam, another theory, another rig."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel

from cgid.errors import InvalidValue
from cgid.scene.scene import Scene, parse_scene
from cgid.scene.sections import ImpactSection, Population, RandomiseSection, SamplingSection, Tap
from cgid.scene.sensor import Sensor

#: A frame that is kept in seconds has at least so many samples before touch: the baseline and the noise come from them.
LEAST_PRE_TRIGGER = 64
_SECTIONS: dict[str, type[BaseModel]] = {"impact": ImpactSection, "sampling": SamplingSection, "sensor": Sensor}
_LISTS: dict[str, type[BaseModel]] = {"populations": Population, "taps": Tap}
_OF_ITS_OWN = ("label", "weight")


def varied(scene: Scene, *, keep_frame: bool = False, **changes: Any) -> Scene:
    """Return a copy of a scene with some settings changed, checked like a file.

    Parameters
    ----------
    scene : Scene
    keep_frame : bool
        With another `sampling_rate` the frame keeps its length in seconds before and after touch, but for at least
        `LEAST_PRE_TRIGGER` samples before it; `samples` and `pre_trigger` must then be left out.
    **changes
        Any key of `impact`, `sampling` or `sensor`, such as `stiffness`, `target`, `sampling_rate`, `range`; or any
        key of a population or tap but label and weight, such as `radius`, `clipped_at`, which is then changed in all
        of them that have such a key; or `name`, `description`. Values are those of a scene file (a number, a string
        with a unit, a mapping) or objects of a scene. None takes an optional setting out. `velocity` takes the place
        of `drop_height` and the other way round; what is given is no longer randomised.

    Raises
    ------
    InvalidValue
        There is no such setting in this scene, or nothing for `keep_frame` to do.
    BadData
        The changed scene breaks rules.

    Examples
    --------
    >>> from cgid.scene import load_scene
    >>> from cgid.shipped import scene_path
    >>> slow = varied(load_scene(scene_path("reference")), keep_frame=True, sampling_rate="50 kHz")
    >>> slow.sampling.samples, slow.sampling.pre_trigger
    (526, 64)
    """
    content = json.loads(scene.text)
    if keep_frame:
        changes |= _kept_frame(scene, changes)
    for name, value in changes.items():
        places = _places(content, name)
        if not places:
            raise InvalidValue(f"{name} must be a setting of scene {scene.name}, which has none of this name to change")
        for place in places:
            for other in {"velocity": ("drop_height",), "drop_height": ("velocity",)}.get(name, ()):
                place.pop(other, None)
            place.pop(name, None)
            if value is not None:
                place[name] = value
    return parse_scene(content, source=f"variation of {scene.name}", folder=scene.folder)


def _places(content: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the parts of a scene that may have this key; in `randomise` it is taken out."""
    randomise = content.get("randomise", {})
    if name in RandomiseSection.model_fields and randomise.pop(name, None) is not None and not randomise:
        del content["randomise"]
    if name in ("name", "description"):
        return [content]
    found = [content.setdefault(part, {}) for part, section in _SECTIONS.items() if name in section.model_fields]
    if name not in _OF_ITS_OWN:
        for part, kind in _LISTS.items():
            found += content.get(part, []) if name in kind.model_fields else []
    return found


def _kept_frame(scene: Scene, changes: dict[str, Any]) -> dict[str, Any]:
    """Return the samples before touch and in all that span the same time at another sampling rate."""
    given = sorted({"samples", "pre_trigger"} & changes.keys())
    if "sampling_rate" not in changes or given:
        raise InvalidValue(
            "keep_frame must come with sampling_rate and without samples and pre_trigger, which follow from it, "
            f"got {', '.join(sorted(changes)) or 'nothing'}"
        )
    old = scene.sampling
    # Read as the file would be: it may be a string with a unit.
    new = varied(scene, sampling_rate=changes["sampling_rate"], bandwidth=None).sampling.sampling_rate
    ratio = new / old.sampling_rate
    before = max(LEAST_PRE_TRIGGER, round(old.pre_trigger * ratio))
    return {"pre_trigger": before, "samples": before + round((old.samples - old.pre_trigger) * ratio)}
