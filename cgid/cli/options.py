"""Options that several commands share, what they ask for, and the inputs that they read."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from cgid.cli.output import say
from cgid.errors import InvalidValue, NoInput
from cgid.signals import Signal

if TYPE_CHECKING:
    from cgid.identification.model import Model
    from cgid.identification.question import Question
    from cgid.recordings import RecordingFile

F = TypeVar("F", bound=Callable[..., Any])
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


def chain_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for the measuring chain; the command receives them as `chain`, arguments of `open_recording`."""
    names = ("sensitivity", "gain", "full_scale")

    @wraps(command)
    def chained(**options: Any) -> Any:
        return command(chain={name: options.pop(name) or None for name in names}, **options)

    add = _options(
        click.option(
            "--sensitivity",
            multiple=True,
            metavar="[NAME=]VALUE",
            help="Of the sensor, for samples in volts: '10.2 mV/g', '2.3 mV/N', '3.1 pC/g'; of one channel as 2=VALUE.",
        ),
        click.option(
            "--gain",
            multiple=True,
            metavar="[NAME=]VALUE",
            help="To be divided out: 10, x10, '20 dB', or '1 mV/pC' of a charge amplifier.",
        ),
        click.option(
            "--full-scale",
            multiple=True,
            metavar="[NAME=]VALUE",
            help="What full scale stands for in a sound file or in integers: '10 V', '50 g', '10 V at 24 bit'.",
        ),
    )
    return add(chained)


def warn_of_volts(recording: RecordingFile) -> None:
    """Say how volts and coulombs become what the sensor measured, where it is not known."""
    from cgid.errors import MissingOption
    from cgid.recordings.chain import require_measured

    for channel in recording.channels:
        name = recording.source if channel.name == "1" else f"{recording.source} channel {channel.name}"
        try:
            require_measured(channel.unit, name)
        except MissingOption as error:
            say(f"cgid: warning: {error}", err=True)


def dead_time_in_seconds(milliseconds: float | None) -> float | None:
    """Return the dead time [s]; refuse one outside of the valid range."""
    if milliseconds is None:
        return None
    if not 0 <= milliseconds <= LONGEST_DEAD_TIME:
        raise InvalidValue(f"--dead-time must lie between 0 and {LONGEST_DEAD_TIME:g} ms, got {milliseconds:g} ms")
    return milliseconds * 1e-3


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How to read an input: the values of `reading_options`."""

    sampling_rate: float | None
    unit: str | None
    channel: tuple[str, ...]
    variable: str | None
    index: int | None
    invert: bool
    milliseconds: float | None
    chain: dict[str, tuple[str, ...] | None]

    @property
    def dead_time(self) -> float | None:
        """Dead time [s]; raises `InvalidValue` outside of the valid range."""
        return dead_time_in_seconds(self.milliseconds)

    def wants_whole_dataset(self, path: str, mass: float | None = None) -> bool:
        """Return whether this is a dataset without a chosen signal.

        Refuse the options for reading a recording, because a dataset describes itself.
        """
        from cgid.recordings import is_dataset

        if not is_dataset(path):
            return False
        given: dict[str, Any] = {f"--{name.replace('_', '-')}": value for name, value in self.chain.items()}
        if self.index is None:
            given |= {"--rate": self.sampling_rate, "--unit": self.unit, "--channel": self.channel or None}
            given |= {"--variable": self.variable, "--mass": mass}
        for flag, value in given.items():
            if value is not None:
                raise InvalidValue(f"{path}: {flag} is for recordings, a dataset says it itself; leave {flag} out")
        return self.index is None

    def recording(self, path: str) -> RecordingFile:
        """Open a recording."""
        from cgid.recordings import open_recording

        if self.index is not None:
            raise InvalidValue(f"{path}: --index picks a signal of a dataset (HDF5), this is a recording; leave it out")
        return open_recording(
            path,
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            channel=self.channel or None,
            variable=self.variable,
            **self.chain,
        )

    def signals(self, path: str) -> list[Signal]:
        """Return the signals of a recording, or the chosen signal of a dataset."""
        from cgid.recordings import is_dataset

        if is_dataset(path):
            from cgid.store import Dataset

            signals = [Dataset(path).signal(self.index or 0)]
        else:
            signals = self.recording(path).signals()
        return [signal.inverted() for signal in signals] if self.invert else signals


def reading_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for reading a recording; the command receives them as `reading`."""

    @wraps(command)
    def read(**options: Any) -> Any:
        own = {field.name: options.pop(field.name) for field in fields(Reading)}
        return command(reading=Reading(**own), **options)

    add = _options(
        click.option("--rate", "sampling_rate", type=float, help="Sampling rate [Hz], where the file does not say it."),
        click.option("--unit", help="Unit of the samples (N, g, m/s^2, V, ...), where the file does not say it."),
        click.option(
            "--channel", multiple=True, help="Only this channel: its name or number from 1; several as 1+2, or again."
        ),
        click.option("--variable", help="Which array, table or group of the file, where it holds several."),
        click.option("--index", type=int, help="Only this signal of a dataset, from 0; else all of them."),
        click.option("--invert", is_flag=True, help="Turn the signal over: impacts must point upwards."),
        dead_time_option,
    )
    return add(chain_options(read))


dead_time_option = click.option(
    "--dead-time", "milliseconds", type=float, help="Ringing after a blow [ms]; 2 for pulses, 5 for vibrations."
)
#: Options of commands that print the contents of recordings.
printing_options = _options(
    click.option("--json", "as_json", is_flag=True, help="One JSON object a line."),
    click.option("--strict", is_flag=True, help="Stop at the first file that fails."),
)
#: Options that choose the model and state the question, as `question_of` takes them.
answering_options = _options(
    click.option(
        "--model", "model_path", type=PATH, help="Model file; the default model of the quantity if not given."
    ),
    click.option("--mass", type=float, help="Mass of the accelerated striker [kg]: force = mass x acceleration."),
    click.option("--drop-height", type=float, help="How far the rocks fell [m], for a model that needs to know."),
    click.option(
        "--cost", "costs", multiple=True, metavar="LABEL=COST", help="What missing this label costs, 1 by default."
    ),
    click.option(
        "--coverage",
        type=float,
        help="Reject impacts whose prediction set at this coverage (0.9) is not a single label.",
    ),
    click.option(
        "--class-conditional", is_flag=True, help="The coverage holds for each label, not only for their mix."
    ),
    click.option(
        "--vote",
        "vote_time",
        type=float,
        help="Windows are decided on together over this time [s], 0.5; 0: each alone.",
    ),
    click.option(
        "--sensor",
        "sensors",
        multiple=True,
        metavar="NAME",
        help="Sensor of the model's reference runs; or one a channel.",
    ),
    click.option("--window", "share_time", type=float, help="The gangue share looks back this long [s], 10."),
    click.option("--gangue", multiple=True, metavar="LABEL", help="Label that is gangue; may be given again."),
    click.option("--gangue-cost", type=float, help="What a drawn gangue costs, in lost coal, 1: says when to shut."),
)


def question_of(
    *, model_path: str | None, costs: tuple[str, ...], milliseconds: float | None, **settings: Any
) -> tuple[Models, Question]:
    """Return the models and the question; `settings` are the other fields of the question."""
    from cgid import validation
    from cgid.identification.question import Question

    dead_time, by_label = dead_time_in_seconds(milliseconds), dict(_cost(text) for text in costs)
    flags = {"vote_time": ("--vote", "s"), "share_time": ("--window", "s"), "gangue_cost": ("--gangue-cost", "")}
    for name, (flag, unit) in flags.items():
        rule = validation.not_negative if flag == "--vote" else validation.positive
        if settings[name] is not None:
            settings[name] = float(rule(flag, settings[name], unit))
    question = Question(costs=by_label, dead_time=dead_time, **settings)
    return Models(model_path, question), question


def _cost(text: str) -> tuple[str, float]:
    """Return label and cost of LABEL=COST."""
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--cost must be LABEL=COST such as gangue=3, got {text!r}") from None


class Models:
    """The given model; else the default model of each quantity, loaded and checked when a signal needs it.

    A mass or a drop height implies a force.
    """

    def __init__(self, path: str | None, question: Question) -> None:
        self._path, self._question = path, question
        self._models: dict[str | None, Model] = {}
        self._one_for_all = path is not None or question.mass is not None or question.drop_height is not None
        if self._one_for_all:
            self.of(None)

    def of(self, quantity: str | None) -> Model:
        """Return the model for signals of a quantity."""
        key = None if self._one_for_all else quantity
        if key not in self._models:
            model = self._load(key)
            self._question.check(model)
            self._models[key] = model
        return self._models[key]

    def name(self, model: Model) -> str:
        """Return the file name of a model, or which default model it is."""
        if self._path is not None:
            return Path(self._path).name
        return "default model" + (" that knows the drop height" if model.known else f" of {model.quantity}")

    def _load(self, quantity: str | None) -> Model:
        """Load the given model, or a default one; anything but an acceleration counts as a force."""
        from cgid import shipped
        from cgid.identification.model import Model

        if self._path is not None:
            return Model.load(self._path)
        if self._question.drop_height is not None:
            with suppress(NoInput):
                return Model.load(shipped.path_of("models", shipped.DROP_HEIGHT_MODEL))
        if quantity != "acceleration":
            return Model.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
        try:
            return Model.load(shipped.path_of("models", shipped.ACCELERATION_MODEL))
        except NoInput as error:
            raise NoInput(
                f"{error}; or give --model, or --mass KG if the accelerated body is the striker (force = mass x "
                "acceleration)"
            ) from None


def warn_of_model(source: str, name: str, sampling_rate: float, model: Model, question: Question) -> None:
    """Warn if a model was not trained for the sampling rate [Hz] of a signal, or needs the name of its sensor."""
    if model.sensors and not question.sensors:
        known = ", ".join(model.sensors)
        say(
            f"cgid: warning: {source}: the model knows the response of some sensors, nothing makes up for that of "
            f"this one; give --sensor NAME if it is one of {known}",
            err=True,
        )
    low, high = model.sampling_rates
    if not model.covers(sampling_rate):
        trained = f"{low:g}" if low == high else f"{low:g} to {high:g}"
        say(f"cgid: warning: {name}: sampled at {sampling_rate:g} Hz, the model was trained at {trained} Hz", err=True)
