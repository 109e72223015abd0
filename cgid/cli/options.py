"""Types and options shared by several commands, and checks of what a line gives."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

from cgid._lib import validation
from cgid.cli.site import field_of, the_site
from cgid.errors import CannotCreate, CgidError, InvalidValue
from cgid.shipped import MODELS, SCENES
from cgid.units import number_and_unit, parse

if TYPE_CHECKING:
    pass


F = TypeVar("F", bound=Callable[..., Any])
#: Largest size and number of keys of a TOML file that is searched for names of files.
_MAX_TOML = 16 << 20


class PathName(click.types.StringParamType):
    """A path, or the name of a bundled file; an empty one, as of an unset variable, is an error."""

    name = "path"

    def __init__(self, shipped: Iterable[str] = ()) -> None:
        self.shipped = shipped

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the name, or fail with a usage error."""
        if value == "":
            self.fail("a name must not be empty; give one, or leave it out", param, ctx)
        return super().convert(value, param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Let the shell complete files, and the names of shipped ones."""
        names = [name for name in self.shipped if name.startswith(incomplete)]
        # After the files, because bash drops earlier completions.
        return [CompletionItem(incomplete, type="file"), *map(CompletionItem, names)]


class OutputName(PathName):
    """The path of a file that the command writes; `beside` returns those that it writes with it."""

    def __init__(self, beside: Callable[[Path], Iterable[Path]] = lambda path: ()) -> None:
        super().__init__()
        self.beside = beside


class Seconds(click.types.FloatParamType):
    """A time in seconds, or with its unit, such as 30s, "2 min" or 500ms."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the time [s], or fail with a usage error."""
        found = number_and_unit(value) if isinstance(value, str) else (value, "")
        if found is not None and not found[1]:
            return float(found[0])
        try:
            return parse(value, "time")
        except ValueError as error:
            self.fail(str(error), param, ctx)


SECONDS = Seconds()
PATH, SCENE, MODEL = PathName(), PathName(SCENES), PathName(MODELS)
OUTPUT = OutputName()


def require_no_input_written(inputs: Iterable[str | Path] = ()) -> None:
    """Raise `CannotCreate` if a file that the current command writes is written twice, or is an input, or in `inputs`.

    Every command checks its arguments, and the files that they name, before it runs.
    """
    from cgid._lib.files import require_not_input

    context = click.get_current_context()
    written, read = [], list(inputs)
    parameters = [(one.name, one.type) for one in context.command.params if isinstance(one.type, PathName)]
    given = [(context.params.get(name or ""), kind) for name, kind in parameters]
    named = [([value] if isinstance(value, str) else value or (), kind) for value, kind in given]
    for names, kind in named:
        if isinstance(kind, OutputName):
            paths = [Path(name) for name in names if name != "-"]
            written += [*paths, *(other for path in paths for other in kind.beside(path))]
    real = [os.path.realpath(path) for path in written]
    for path, own in zip(written, real, strict=True):
        if real.count(own) > 1:
            raise CannotCreate(f"{path}: must be the name of one output, it is that of two; choose another name")
    if not written:
        return  # what inputs name takes a tenth of the start of predict to find out
    for names, kind in named:
        if not isinstance(kind, OutputName):
            read += [part for name in names if name not in kind.shipped for part in (name, *_named_by(name))]
    for path in written:
        require_not_input(path, read)


def _named_by(name: str) -> Iterator[Path]:
    """Yield the files that an input names: those of a folder, of a manifest, and the tables of a scene."""
    path = Path(name)
    try:
        if path.is_dir() or path.suffix.lower() == ".csv":
            from cgid.identification.training.manifest import is_manifest, named_recordings
            from cgid.store.folder import is_dataset_folder

            if is_dataset_folder(path):
                yield from path.iterdir()
            elif path.is_dir() or is_manifest(path):
                yield from named_recordings(path)
        elif path.suffix.lower() == ".toml":
            from cgid._lib.files import parse_toml, read_regular

            content = parse_toml(read_regular(path, "TOML", _MAX_TOML).decode(), _MAX_TOML)
            paths = (path.parent / text for text in _texts_in(content))
            # Folders are not: one may bear the scene's name. isfile, unlike Path, takes a text of any length.
            yield from (one for one in paths if os.path.isfile(one))  # noqa: PTH113
    except (CgidError, OSError, ValueError):
        return  # the command reports it


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts_in(part)


def given_flags(context: click.Context) -> dict[str, str]:
    """Return the options on the command line: parameter -> flag."""
    options = {option.name or "": max(option.opts, key=len) for option in context.command.params}
    line = click.core.ParameterSource.COMMANDLINE
    found = {name: flag for name, flag in options.items() if context.get_parameter_source(name) is line}
    return found | {field_of(key): f"--set {key}" for key in the_site().given}


def refuse(context: click.Context, flags: str, reason: str) -> None:
    """Raise `InvalidValue` for the first of these flags on the command line, instead of ignoring it."""
    refused = [flag.lstrip("-").replace("-", "_") for flag in flags.split()]
    for flag in given_flags(context).values():
        if flag.split()[-1].lstrip("-").replace("-", "_") in refused:
            raise InvalidValue(f"{flag} must be left out, {reason}")


def require_one_executor(context: click.Context) -> None:
    """Raise a usage error if both worker processes and a cluster are given."""
    if "jobs" in given_flags(context) and context.params["scheduler"] is not None:
        raise click.UsageError("--jobs is for this machine, scheduler for a cluster; give one of them", context)


def options_of(*options: Callable[[Any], Any]) -> Callable[[F], F]:
    """Return a decorator that adds options to a command."""

    def add(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def bundle(
    name: str, make: Callable[..., Any], options: Mapping[str, Callable[[Any], Any]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds options; the command receives the object made from their values as `name`."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def bundled(**values: Any) -> Any:
            return command(**{name: make(**{part: values.pop(part) for part in options})}, **values)

        return options_of(*options.values())(bundled)

    return add


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, one object per line.")
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace an existing file or folder, with all its contents."
)
seed_option = click.option(
    "--seed",
    type=int,
    default=0,
    show_default=True,
    help="Choose the random numbers; the same seed gives the same signals and splits.",
)
jobs_option = click.option("--jobs", type=int, default=1, show_default=True, help="Use this many worker processes.")


def point_of(text: str) -> tuple[float, float]:
    """Return the point [m] of a sensor."""
    try:
        x, y = (float(validation.not_negative("--sensor", float(part))) for part in text.split(","))
    except ValueError:
        raise InvalidValue(f"--sensor must be a point X,Y [m] of a beam, such as 0.5,0.45, got {text!r}") from None
    return x, y


def share_of(flag: str, text: str) -> float:
    """Return a fraction such as "1 %"."""
    try:
        return parse(float(text) if text.replace(".", "", 1).isdigit() else text, "ratio")
    except (CgidError, ValueError):
        raise InvalidValue(f"{flag} must be a share such as '1 %' or 0.01, got {text!r}") from None
