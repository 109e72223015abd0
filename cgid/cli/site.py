"""`--site`, `--set` and `--help-all` of every command: what a site file states, and keys without an option."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import wraps
from typing import Any

import click

from cgid.cli.output import say
from cgid.errors import InvalidValue
from cgid.recordings.site import CHANNEL_KEYS, KEYS, NOWHERE, Site

#: Where `click` keeps what a line says of the site, for all contexts of one line.
_FILES, _VALUES, _MADE = "cgid.site.files", "cgid.site.values", "cgid.site"


def _note_file(context: click.Context, _option: click.Parameter, files: tuple[str, ...]) -> None:
    context.meta.setdefault(_FILES, []).extend(files)


def _note_values(context: click.Context, _option: click.Parameter, pairs: tuple[str, ...]) -> None:
    for pair in pairs:
        key, equals, text = pair.partition("=")
        of_channel, dot, name = key.strip().removeprefix("--").rpartition(".")
        key = of_channel + dot + name.replace("-", "_")
        if not equals or not key:
            raise click.UsageError(f"--set must be KEY=VALUE such as hold=5, got {pair!r}", context)
        noted, value = context.meta.setdefault(_VALUES, {}), _value_of(text)
        if key in noted:  # given again, such as a second label
            before = noted[key] if isinstance(noted[key], list) else [noted[key]]
            value = [*before, value]
        noted[key] = value


def _value_of(text: str) -> Any:
    """Return a value as a site file would hold it; a text needs no quotes."""
    for read in (lambda: tomllib.loads(f"value = {text}")["value"], lambda: float(text)):
        with suppress(ValueError):
            return read()
    return text.strip()


def _print_all(context: click.Context, _option: click.Parameter, wanted: bool) -> None:
    if wanted:
        formatter = context.make_formatter()
        context.command.format_help(context, formatter)
        for section in sections_of(context.command):
            with formatter.section(f"Keys of [{section}] in a site file, or of --set"):
                formatter.write_dl([(key, about.help) for key, about in KEYS[section].items()])
        with formatter.section("Keys of each channel in a site file, such as [channels.1]"):
            formatter.write_dl([(key, about.help) for key, about in CHANNEL_KEYS.items()])
        for line in formatter.getvalue().splitlines():
            say(line)
        context.exit()


#: Options of every command, before or after its name.
COMMON = (
    click.Option(
        ["--site"],
        metavar="FILE",
        multiple=True,
        expose_value=False,
        is_eager=True,
        callback=_note_file,
        help="Read what a site file states: recorder, channels by name, model, decision, outputs (CGID_SITE).",
    ),
    click.Option(
        ["--set"],
        metavar="KEY=VALUE",
        multiple=True,
        expose_value=False,
        is_eager=True,
        callback=_note_values,
        help="Set a key of a site file for this command; --help-all lists them.",
    ),
    click.Option(
        ["--help-all"],
        is_flag=True,
        expose_value=False,
        is_eager=True,
        callback=_print_all,
        help="Show this page and the keys of a site file, and exit.",
    ),
)


def the_site() -> Site:
    """Return the site of the running command: its file, from --site or CGID_SITE, and the values of --set.

    Raises a usage error if two files are given, or a value of --set that the command does not use.
    """
    context = click.get_current_context(silent=True)
    if context is None:
        return NOWHERE
    meta = context.meta
    if _MADE not in meta:
        files, values = meta.get(_FILES, []), meta.get(_VALUES, {})
        if len(files) > 1:
            raise click.UsageError(f"--site must be given once, got {' and '.join(files)}; join the files", context)
        for key in values:
            if (section := section_of(key)) and section not in sections_of(context.command):
                raise InvalidValue(
                    f"--set {key} must be left out, cgid {context.command.name} does not use [{section}]"
                )
        path = files[0] if files else os.environ.get("CGID_SITE", "")
        if files == [""]:
            raise click.UsageError("--site must be the name of a file, it is empty", context)
        meta[_MADE] = Site(path, values) if path or values else NOWHERE
    made: Site = meta[_MADE]
    return made


def section_of(key: str) -> str | None:
    """Return the section of a key, None for an unknown one."""
    return next((name for name, keys in KEYS.items() if key in keys), None)


def field_of(key: str) -> str:
    """Return the name that the settings of Python have for a key."""
    section = section_of(key)
    return (KEYS[section][key].field if section else "") or key


#: Sections of a site file that each command uses; [scene], too.
_SECTIONS = {
    "predict": "recorder model decision",
    "monitor": "recorder model decision outputs",
    **dict.fromkeys(("events", "label", "features", "info", "plot", "verify"), "recorder"),
    "train": "recorder training calibration datasets",
    "generate": "datasets",
    **dict.fromkeys(("tap", "invert", "calibrate"), "recorder calibration"),
}


def sections_of(command: click.Command) -> Iterable[str]:
    """Return the sections of a site file that a command uses."""
    return [*_SECTIONS.get(command.name or "", "").split(), "scene"]


def keys(**defaults: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that gives a command the values of keys of its site, by the names of their fields."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def with_keys(*arguments: Any, **values: Any) -> Any:
            site = the_site()
            names = {field_of(key): key for one in KEYS.values() for key in one}
            found = {name: site.get(names[name], default) for name, default in defaults.items()}
            click.get_current_context().params.update(found)
            return command(*arguments, **found, **values)

        return with_keys

    return add


def site_words() -> tuple[list[str], list[str]]:
    """Return the words of the command line that state the site, for suggested commands: of the recorder, and others."""
    context = click.get_current_context(silent=True)
    meta = {} if context is None else context.meta
    words: tuple[list[str], list[str]] = [word for file in meta.get(_FILES, []) for word in ("--site", file)], []
    for key, value in meta.get(_VALUES, {}).items():
        for one in value if isinstance(value, list) else [value]:
            words[section_of(key) not in (None, "recorder")].extend(["--set", f"{key}={_text(one)}"])
    return words


def _text(value: Any) -> str:
    """Return a value as --set takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_text(one)}" for key, one in value.items()) + "}"
    return f"{value:.12g}" if isinstance(value, float) else str(value)
