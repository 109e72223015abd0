"""How a message names a setting: by Python's keyword, or on a command line by its option or key."""

from __future__ import annotations

import shlex
from collections.abc import Callable

#: Keywords that are an option of their own in the commands; others are keys of --set.
_OPTIONS = {
    "band": "--band",
    "base": "--from",
    "by": "--by",
    "channel": "--channel",
    "channels": "--channels",
    "coal_until": "--coal-until",
    "features": "--features",
    "hammer": "--hammer",
    "labelled": "--labelled",
    "live": "--live",
    "mirror": "--mirror",
    "modbus": "--modbus",
    "model": "--model",
    "mqtt": "--mqtt",
    "on_blind": "--on-blind",
    "on_open": "--on-open",
    "on_shut": "--on-shut",
    "overwrite": "--overwrite",
    "port": "--port",
    "prometheus": "--prometheus",
    "renew": "--renew",
    "resume": "--resume",
    "same_beam": "--same-beam",
    "sample_format": "--sample-format",
    "sampling_rate": "--rate",
    "scene": "--scene",
    "sensor": "--sensor",
    "times": "--taps",
    "unit": "--unit",
    "window_time": "--window",
}
#: What is no keyword in Python: how it is stated there.
_CALLS = {"index": "cgid.Dataset(PATH)[{}]", "laws": "cgid.physics.add_laws({})"}


def as_argument(name: str, value: str = "") -> str:
    """Return a setting as Python's keyword; a value in capitals stands for one, beams are in lines.

    >>> as_argument("unit"), as_argument("unit", "V"), as_argument("invert", "true"), as_argument("mass", "KG")
    ('unit', "unit='V'", 'invert=True', 'mass=KG')
    >>> as_argument("same_beam", "1+2"), as_argument("coal_until", "30s")
    ("same_beam=[('1', '2')]", 'coal_until=30')
    >>> as_argument("overwrite", "true"), as_argument("channels.2.gain", "VALUE"), as_argument("laws", "MODULE")
    ('overwrite=True', 'gain={2: VALUE}', 'cgid.physics.add_laws(MODULE)')
    """
    if name == "same_beam" and value:
        return f"{name}={[tuple(beam.split('+')) for beam in value.splitlines()]!r}"
    if value and name in _CALLS:
        return _CALLS[name].format(value)
    if name.startswith("channels."):
        _, channel, key = name.split(".")
        return f"{key}={{{channel}: {value}}}"
    if not value or value in ("true", "false"):
        return f"{name}={value.title()}" if value else name
    number = value.removesuffix("s")  # [s]
    if number.replace(".", "", 1).isdigit():
        return f"{name}={number}"
    return f"{name}={value if value.isupper() and len(value) > 1 else repr(value)}"


def as_option(name: str, value: str = "") -> str:
    """Return a setting as an option of a command line, or as a key of --set.

    >>> as_option("unit"), as_option("unit", "m/s^2"), as_option("invert", "true"), as_option("full_scale", "10 V")
    ('--unit', '--unit m/s^2', '--set invert=true', "--set full_scale='10 V'")
    >>> as_option("overwrite", "true"), as_option("window_time"), as_option("channels.2.unit", "VALUE")
    ('--overwrite', '--window', '--unit 2=VALUE')
    """
    if name in _OPTIONS and value == "true":
        return _OPTIONS[name]
    of, _, key = name.rpartition(".")
    if key in _OPTIONS and of:
        return f"{_OPTIONS[key]} {of.removeprefix('channels.')}={value}"
    if name == "same_beam" and value:
        return " ".join(f"{_OPTIONS[name]} {shlex.quote(beam)}" for beam in value.splitlines())
    plain = value.replace("^", "")  # no sign of shells
    quoted = value if not plain or shlex.quote(plain) == plain else shlex.quote(value)
    if name in _OPTIONS:
        return f"{_OPTIONS[name]} {quoted}".rstrip()
    return f"--set {name}={quoted}" if value else name


#: What `spelled` gives; the command line sets `as_option` while it runs.
speak: Callable[[str, str], str] = as_argument


def spelled(name: str, value: str = "") -> str:
    """Return how whoever called states a setting, for the cure in a message."""
    return speak(name, value)
