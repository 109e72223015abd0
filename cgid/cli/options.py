"""Shared by several commands: options, reading of inputs, errors per file, JSON lines, progress."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import click

from cgid.cli.output import say, stop_if_asked
from cgid.errors import CgidError, InvalidValue
from cgid.signals import Signal

if TYPE_CHECKING:
    from cgid.recordings import RecordingFile

F = TypeVar("F", bound=Callable[..., Any])
#: Version of the lines that --json prints.
JSON_VERSION = 1
#: Longest dead time [ms]; no struck body rings for longer.
LONGEST_DEAD_TIME = 1e4


class PathName(click.types.StringParamType):
    """The name of a file or folder; an empty one, as from an unset shell variable, is an error."""

    name = "path"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the name, or fail with a usage error."""
        if value == "":
            self.fail("a name must not be empty; give one, or leave it out", param, ctx)
        return super().convert(value, param, ctx)


PATH = PathName()


def _options(*options: Callable[[Any], Any]) -> Callable[[F], F]:
    """Return a decorator that adds options to a command."""

    def add(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return add


#: Options for reading a recording.
reading_options = _options(
    click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz], where the file does not say it."),
    click.option("--unit", help="Unit of the samples (N, kN, g, m/s^2, ...), where the file does not say it."),
    click.option(
        "--channel", multiple=True, help="Only this channel: its name or number from 1; several as 1+2, or again."
    ),
    click.option("--variable", help="Which array, table or group of the file, where it holds several."),
    click.option("--index", type=int, help="Only this signal of a dataset, from 0; else all of them."),
    click.option("--invert", is_flag=True, help="Turn the signal over: impacts must point upwards."),
    click.option("--dead-time", type=float, help="Ringing after a blow [ms]; 2 for pulses, 5 for vibrations."),
)
#: Options of commands that read recordings and print their contents.
recording_options = _options(
    reading_options,
    click.option("--json", "as_json", is_flag=True, help="One JSON object a line."),
    click.option("--strict", is_flag=True, help="Stop at the first file that fails."),
)
#: Options for worker processes and clusters; `require_one_crew` refuses both at once.
crew_options = _options(
    click.option("--jobs", type=int, default=1, show_default=True, help="Worker processes."),
    click.option("--scheduler", help="Of a dask cluster, such as tcp://192.168.0.7:8786: its workers do the work."),
)


def require_one_crew(context: click.Context) -> None:
    """Raise a usage error if both worker processes and a cluster are given."""
    given = context.get_parameter_source("jobs") is click.core.ParameterSource.COMMANDLINE
    if given and context.params["scheduler"] is not None:
        raise click.UsageError("--jobs is for this machine, --scheduler for a cluster; give one of them", context)


def read_signals(path: str, *, index: int | None, invert: bool, **reading: Any) -> list[Signal]:
    """Return the signals of a recording, or the chosen signal of a dataset."""
    from cgid.recordings import is_dataset

    if is_dataset(path):
        from cgid.store import Dataset

        signals = [Dataset(path).signal(index or 0)]
    else:
        signals = open_file(path, index=index, **reading).signals()
    return [signal.inverted() for signal in signals] if invert else signals


def open_file(
    path: str,
    *,
    sampling_rate: float | None,
    unit: str | None,
    channel: tuple[str, ...],
    variable: str | None,
    index: int | None = None,
) -> RecordingFile:
    """Open a recording with these options."""
    from cgid.recordings import open_recording

    if index is not None:
        raise InvalidValue(f"{path}: --index picks a signal of a dataset (HDF5), this is a recording; leave it out")
    return open_recording(path, sampling_rate=sampling_rate, unit=unit, channel=channel or None, variable=variable)


def asks_for_whole_dataset(path: str, *, index: int | None, **given: Any) -> bool:
    """Return whether this is a dataset without a chosen signal.

    Refuse the options for reading a recording, because a dataset describes itself.
    """
    from cgid.recordings import is_dataset

    if index is not None or not is_dataset(path):
        return False
    flags = ("unit", "channel", "variable", "mass")
    for name, flag in {"sampling_rate": "--rate", **{name: f"--{name}" for name in flags}}.items():
        if given.get(name) not in (None, ()):
            raise InvalidValue(f"{path}: {flag} is for recordings, a dataset says it itself; leave {flag} out")
    return True


def dead_time_in_seconds(milliseconds: float | None) -> float | None:
    """Return the dead time [s]; refuse one outside of the valid range."""
    if milliseconds is None:
        return None
    if not 0 <= milliseconds <= LONGEST_DEAD_TIME:
        raise InvalidValue(f"--dead-time must lie between 0 and {LONGEST_DEAD_TIME:g} ms, got {milliseconds:g} ms")
    return milliseconds * 1e-3


def each_file(files: Iterable[str], treat: Callable[[str], None], *, strict: bool = False) -> int:
    """Treat every file; report the error of one and go on, or stop if `strict`.

    Return the exit code of the first failed file.
    """
    code = 0
    for file in files:
        try:
            treat(file)
        except CgidError as error:
            if strict:
                raise
            say_error(error)
            code = code or error.exit_code
    return code


def say_error(error: CgidError) -> None:
    """Print an error on stderr, with a line for each mistake."""
    for mistake in error.args:
        say(f"cgid: error: {mistake}", err=True)


def print_json(content: dict[str, Any], version: int = JSON_VERSION) -> None:
    """Print one object as a line of JSON; values that are not finite become null."""
    # JSON escapes all other control characters, and all characters that are not ASCII.
    say(json.dumps({"version": version, **_finite(content)}).replace("\x7f", "\\u007f"))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def progress_bar(total: int | None, what: str) -> Iterator[Callable[[int], object]]:
    """Yield a function that moves a progress bar; the bar appears only if stderr is a terminal."""
    from tqdm import tqdm

    with tqdm(total=total, unit=f" {what}", disable=None, file=sys.stderr, unit_scale=True) as bar:

        def move(number: int) -> None:
            bar.update(number)
            stop_if_asked()

        yield move
