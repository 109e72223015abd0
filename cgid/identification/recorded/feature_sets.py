"""The sets of features that are chosen among when a model is trained on recordings, by kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from cgid.identification.measuring import DEFAULT_FEATURES, DEFAULT_VIBRATION_FEATURES
from cgid.measure.features import FEATURES
from cgid.measure.table import Kind

Sets = Mapping[str, tuple[str, ...]]
#: Features of windows that change with the gain of the sensor, beside the bands.
_WITH_GAIN = ("window_level", "window_peak")


def _windows(*wanted: Callable[[str], bool]) -> tuple[str, ...]:
    return tuple(name for name in FEATURES.names("window") if any(want(name) for want in wanted))


def _starting(*starts: str) -> Callable[[str], bool]:
    return lambda name: name.startswith(tuple(f"window_{start}_" for start in starts))


def _shape(name: str) -> bool:
    """Return whether a feature of windows is no band of a bank and does not change with the gain."""
    return not _starting("mel", "relative", "even", "level")(name) and name not in _WITH_GAIN


def _plain(name: str) -> bool:
    return _shape(name) or name in _WITH_GAIN


#: Kind -> name of a set -> its features, the first first where none is clearly better. A name that ends in
#: "level-free" promises that the gain of the sensor cancels.
FEATURE_SETS: Mapping[Kind, Sets] = {
    "window": {
        # First, for no gain was ever the same for long.
        "even bands and shape, level-free": _windows(_starting("relative_even", "even_deviation"), _shape),
        "even bands and shape": _windows(_starting("even"), _plain),
        "mel bands and shape": _windows(_starting("mel"), _plain),
        "mel bands": _windows(_starting("mel")),
        "mel bands and shape, level-free": _windows(_starting("relative_mel", "mel_deviation"), _shape),
    },
    "vibration": {
        "third octaves": DEFAULT_VIBRATION_FEATURES,
        "third octaves, level-free": tuple(name for name in FEATURES if name.startswith("relative_level_")),
    },
    "pulse": {"fitted pulse": DEFAULT_FEATURES},
}


def union_of(sets: Sets) -> tuple[str, ...]:
    """Return every feature of some sets once."""
    return tuple(dict.fromkeys(name for names in sets.values() for name in names))


def sets_for(kind: Kind, *, level_free: bool = False) -> Sets:
    """Return the sets of a kind; only those in which the gain cancels, if asked."""
    own = FEATURE_SETS[kind]
    return {name: names for name, names in own.items() if name.endswith("level-free")} if level_free else own
