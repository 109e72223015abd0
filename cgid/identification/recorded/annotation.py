"""What somebody says of a recording: one row of a manifest, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from cgid import validation
from cgid.errors import InvalidValue
from cgid.units import quantity_of

#: What may be said of a recording or an interval of it.
COLUMNS = (
    *("path", "label", "start", "end", "group", "channel", "gain", "sensor", "reference", "rate", "unit"),
    "variable",
)
#: Longer words are no labels, groups or sensors.
_LONGEST_WORD = 100


@dataclass(frozen=True, kw_only=True)
class Annotation:
    """What somebody says of a recording, or of an interval of it.

    Attributes
    ----------
    path : Path
    written : str
        The path as the manifest has it.
    label : str
        Empty for a reference run.
    group : str
        What stays together when recordings are split: a recording by itself if not said, a day, a support.
    start, end : float
        [s]; `end` is infinite where the recording ends.
    channels : tuple or None
        Numbers from 1 or names, looked at together; None for all.
    gain : float
        What the samples are divided by.
    sensor : str
        Whose reference run makes up for its response; empty for none.
    reference : bool
        Whether this is the reference run of the sensor.
    sampling_rate, unit, variable
        What the file does not say: see `cgid.recordings.open_recording`.
    """

    path: Path
    written: str
    label: str = ""
    group: str = ""
    start: float = 0.0
    end: float = math.inf
    channels: tuple[int | str, ...] | None = None
    gain: float = 1.0
    sensor: str = ""
    reference: bool = False
    sampling_rate: float | None = None
    unit: str | None = None
    variable: str | None = None

    @property
    def name(self) -> str:
        """The file, the channels where they are chosen, and the interval where it is one: no two have the same."""
        channels = "" if self.channels is None else f" channel {'+'.join(map(str, self.channels))}"
        if self.start == 0 and self.end == math.inf:
            return self.written + channels
        end = "its end" if self.end == math.inf else f"{self.end:g} s"
        return f"{self.written}{channels} from {self.start:g} to {end}"


def annotation_of(row: Mapping[str, Any], folder: Path, labels: tuple[str, ...] | None) -> Annotation:
    """Return what a row says; paths are relative to the folder, and `labels` are those allowed, None for any.

    Raises
    ------
    InvalidValue
        Something in it breaks its rule.
    """
    path = row.get("path")
    if not isinstance(path, str) or not path or "\0" in path:
        raise InvalidValue(f"path must be the name of a file, got {path!r}")
    reference = _truth("reference", row.get("reference", False))
    sensor, label = _word("sensor", row.get("sensor", "")), _word("label", row.get("label", ""))
    if reference:
        if label or not sensor:
            raise InvalidValue("a reference run must name its sensor and have no label")
    elif not label:
        raise InvalidValue("label must be said of every recording or interval; add it, or take the row out")
    else:
        validation.label("label", label)
        if labels is not None and label not in labels:
            raise InvalidValue(f"label must be one of {', '.join(map(repr, labels))}, got {label!r}")
    start, end = _number("start", row.get("start", 0.0), " in s"), _number("end", row.get("end", math.inf), " in s")
    if not 0 <= start < end:
        raise InvalidValue(f"start and end must rise from 0 s, got {start:g} and {end:g} s")
    rate, unit, variable = row.get("rate"), row.get("unit"), row.get("variable")
    if unit is not None:
        quantity_of(unit if isinstance(unit, str) else repr(unit))
    return Annotation(
        path=folder / path,
        written=path,
        label=label,
        group=_word("group", row.get("group", "")) or str(folder / path),
        start=start,
        end=end,
        channels=_channels(row.get("channel")),
        gain=_gain(row.get("gain", 1.0)),
        sensor=sensor,
        reference=reference,
        sampling_rate=None if rate is None else _positive("rate", rate, "Hz"),
        unit=unit,
        variable=None if variable is None else _word("variable", variable),
    )


def _word(name: str, value: Any) -> str:
    text = str(value).strip() if isinstance(value, str | int) and not isinstance(value, bool) else None
    if text is None or len(text) > _LONGEST_WORD or not (text.isprintable()):
        raise InvalidValue(f"{name} must be a word of at most {_LONGEST_WORD} characters, got {value!r}")
    return text


def _number(name: str, value: Any, what: str) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if math.isnan(number):
        raise InvalidValue(f"{name} must be a number{what}, got {value!r}")
    return number


def _positive(name: str, value: Any, unit: str) -> float:
    number = _number(name, value, f" in {unit}")
    if not 0 < number < math.inf:
        raise InvalidValue(f"{name} must be above 0 and finite, got {number:g} {unit}")
    return number


def _gain(value: Any) -> float:
    """Return a gain as a factor; a text may give it in dB."""
    if isinstance(value, str) and value.lower().endswith("db"):
        level = _number("gain", value[:-2], " in dB")
        if not abs(level) <= 400:
            raise InvalidValue(f"gain must lie between -400 and 400 dB, got {level:g} dB")
        return float(10.0 ** (level / 20))
    number = _number("gain", value, ", a factor or with dB behind it")
    if not 0 < number < math.inf:
        raise InvalidValue(f"gain must be above 0 and finite, got {number:g}")
    return number


def _truth(name: str, value: Any) -> bool:
    words = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}
    found = value if isinstance(value, bool) else words.get(str(value).lower())
    if found is None:
        raise InvalidValue(f"{name} must be yes or no, got {value!r}")
    return found


def _channels(value: Any) -> tuple[int | str, ...] | None:
    """Return the channels asked for: a number or a name, several in a list, or in one text with + between them."""
    if value is None:
        return None
    listed = value.split("+") if isinstance(value, str) else value if isinstance(value, list) else [value]
    good = all(isinstance(one, int | str) and not isinstance(one, bool) and str(one).strip() for one in listed)
    channels = tuple(one.strip() if isinstance(one, str) else one for one in listed) if good else ()
    if not channels or len({str(one) for one in channels}) != len(channels):
        raise InvalidValue(f"channel must be a name or a number from 1, or different ones (1+2), got {value!r}")
    return channels


def contradictions(annotations: Sequence[Annotation]) -> list[str]:
    """Return what cannot be true of annotations together."""
    found = []
    heard = {one.sensor for one in annotations if one.reference}
    for sensor in sorted({one.sensor for one in annotations if one.sensor} - heard):
        found.append(f"sensor {sensor} must have a reference run (reference = yes), there is none; add it")
    if heard and not all(one.sensor for one in annotations):
        found.append("sensor must be said of every recording where one has a reference run; add it to the others")
    by_file: dict[Path, list[Annotation]] = {}
    for one in annotations:
        by_file.setdefault(one.path, []).append(one)
    for path, own in by_file.items():
        groups = sorted({one.group for one in own if not one.reference})
        if len(groups) > 1:
            found.append(f"{path}: a recording must lie in one group as a whole, got {' and '.join(groups[:2])}")
        own.sort(key=lambda one: (str(one.channels), one.start))
        for before, after in pairwise(own):
            if before.channels == after.channels and after.start < before.end:
                what = f"{before.label or 'a reference run'} and {after.label or 'a reference run'}"
                found.append(f"{path}: intervals must not overlap, {what} do at {after.start:g} s")
    return found
