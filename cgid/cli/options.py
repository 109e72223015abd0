"""Options shared by several commands, their settings, and the inputs of commands."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

from cgid._lib import validation
from cgid.cli.output import say_error, warn
from cgid.errors import BadData, CannotCreate, CgidError, InvalidValue, MissingOption
from cgid.shipped import MODELS, SCENES
from cgid.signals import Signal, channel_name
from cgid.units import number_and_unit, parse

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction import PredictionSettings
    from cgid.identification.training.manifest import Manifest
    from cgid.identification.training.recordings import Reading
    from cgid.recordings import RecordingFile
    from cgid.recordings.recording import Channel

F = TypeVar("F", bound=Callable[..., Any])
#: Maximum dead time [ms]; no ring-down lasts longer.
MAX_DEAD_TIME = 1e4
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
    return {name: flag for name, flag in options.items() if context.get_parameter_source(name) is line}


def refuse(context: click.Context, flags: str, reason: str) -> None:
    """Raise `InvalidValue` for the first of these flags on the command line, instead of ignoring it."""
    given = given_flags(context).values()
    for flag in flags.split():
        if flag in given:
            raise InvalidValue(f"{flag} must be left out, {reason}")


def require_one_executor(context: click.Context) -> None:
    """Raise a usage error if both worker processes and a cluster are given."""
    if "jobs" in given_flags(context) and context.params["scheduler"] is not None:
        raise click.UsageError("--jobs is for this machine, --scheduler for a cluster; give one of them", context)


def warn_of_volts(recording: RecordingFile) -> list[str]:
    """Explain how volts and coulombs are converted to the measured quantity, if unknown; return what was said."""
    from cgid.recordings.chain import require_measured

    said = []
    for channel in recording.channels:
        try:
            require_measured(channel.unit, channel_name(recording.source, channel.name))
        except MissingOption as error:
            warn(error)
            said.append(str(error))
    return said


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ReadingOptions:
    """Settings for reading an input: the values of `reading_options` of a command."""

    sampling_rate: float | None = None
    unit: str | None = None
    channel: tuple[str, ...] = ()
    variable: str | None = None
    format: str | None = None
    index: int | None = None
    invert: bool = False
    milliseconds: float | None = None
    sensitivity: tuple[str, ...] = ()
    gain: tuple[str, ...] = ()
    full_scale: tuple[str, ...] = ()
    skip_broken: bool = False

    @property
    def chain(self) -> dict[str, tuple[str, ...] | None]:
        """The measuring chain, as arguments of `open_recording`."""
        return {name: getattr(self, name) or None for name in CHAIN}

    def chain_of(self, path: str) -> dict[str, tuple[str, ...] | None]:
        """Return the measuring chain of one file: values for all files, and those with its name: a.wav:1=VALUE."""
        kept = {
            name: tuple(value for file, value in map(_file_and_value, values or ()) if not file or _is_file(file, path))
            for name, values in self.chain.items()
        }
        return {name: values or None for name, values in kept.items()}

    def require_files(self, paths: Sequence[str]) -> None:
        """Raise `InvalidValue` for a value of the measuring chain that names none of these files."""
        for name, values in self.chain.items():
            for file, _ in map(_file_and_value, values or ()):
                if file and not any(_is_file(file, path) for path in paths):
                    flag = f"--{name.replace('_', '-')}"
                    raise InvalidValue(f"{flag} must name one of the files before :, got {file!r}; correct it")

    @property
    def common(self) -> dict[str, Any]:
        """Settings for any file, as arguments of `open_recording` and of manifests."""
        own = {name: getattr(self, name) for name in ("sampling_rate", "unit", "format", "skip_broken")}
        return {**own, **self.chain}

    @property
    def dead_time(self) -> float | None:
        """Dead time [s]; raises `InvalidValue` outside of the valid range."""
        if self.milliseconds is None:
            return None
        if not 0 <= self.milliseconds <= MAX_DEAD_TIME:
            raise InvalidValue(f"--dead-time must be between 0 and {MAX_DEAD_TIME:g} ms, got {self.milliseconds:g} ms")
        return self.milliseconds * 1e-3

    def of_manifest(self, *, strict: bool, same_beam: tuple[str, ...] = ()) -> Reading:
        """Return the settings for recordings of a manifest that do not state them."""
        from cgid.identification.training.recordings import Reading

        return Reading(
            channels=self.channel or None, same_beam=same_beam, strict=strict, failed=say_error, **self.common
        )

    def wants_complete_dataset(self, path: str, mass: float | None = None) -> bool:
        """Return whether this is a dataset without a chosen signal, which takes no options for reading a recording."""
        from cgid.recordings import is_dataset

        if not is_dataset(path):
            return False
        given: dict[str, Any] = {f"--{name.replace('_', '-')}": value for name, value in self.chain.items()}
        if self.index is None:
            given |= {"--rate": self.sampling_rate, "--unit": self.unit, "--channel": self.channel or None}
            given |= {"--variable": self.variable, "--format": self.format, "--mass": mass}
        for flag, value in given.items():
            if value is not None:
                raise InvalidValue(f"{path}: {flag} is for recordings, a dataset states it; leave {flag} out")
        return self.index is None

    def recording(self, path: str) -> RecordingFile:
        """Open a recording."""
        from cgid.recordings import open_recording

        if self.index is not None:
            raise InvalidValue(f"{path}: --index picks a signal of a dataset (HDF5), this is a recording; leave it out")
        chosen: dict[str, Any] = {"channel": self.channel or None, "variable": self.variable}
        return open_recording(path, **chosen, **{**self.common, **self.chain_of(path)})

    def signals(self, path: str, faults: list[BadData] | None = None) -> list[Signal]:
        """Return the signals of a recording, or the chosen signal of a dataset; `faults` gets unreadable channels."""
        from cgid.recordings import is_dataset

        if is_dataset(path):
            from cgid.store import Dataset

            signals = [Dataset(path).signal(self.index or 0)]
        else:
            signals, errors = self.recording(path).signals_and_faults()
            if errors and (faults is None or not signals):
                raise errors[0]
            if faults is not None:
                faults += errors
        return [signal.inverted() for signal in signals] if self.invert else signals


def _file_and_value(text: str) -> tuple[str, str]:
    """Return the file, "" for all, and the value of FILE:CHANNEL=VALUE; channels may contain colons, too."""
    from cgid.recordings.formats import ENDINGS

    at = next((at for at, sign in enumerate(text) if sign == ":" and text[:at].lower().endswith(ENDINGS)), -1)
    return text[: max(at, 0)], text[at + 1 :]


def _is_file(name: str, path: str) -> bool:
    return name in (path, Path(path).name)


# -- options, each described once, and groups of them -----------------------------------------------------


def _add_laws(_context: click.Context, _option: click.Parameter, modules: tuple[str, ...]) -> tuple[str, ...]:
    if modules:
        from cgid.physics.contact.own_laws import add_laws

        for module in modules:
            add_laws(module)
    return modules


def _options(*options: Callable[[Any], Any]) -> Callable[[F], F]:
    """Return a decorator that adds options to a command."""

    def add(command: F) -> F:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def _bundle(
    name: str, make: Callable[..., Any], options: Mapping[str, Callable[[Any], Any]]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds options; the command receives the object made from their values as `name`."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def bundled(**values: Any) -> Any:
            return command(**{name: make(**{part: values.pop(part) for part in options})}, **values)

        return _options(*options.values())(bundled)

    return add


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, one object per line.")
strict_option = click.option("--strict", is_flag=True, help="Stop at the first file that fails.")
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
#: Options of commands that print the contents of recordings.
printing_options = _options(json_option, strict_option)
#: Options for worker processes and clusters; `require_one_executor` refuses both at once.
worker_options = _options(
    click.option("--jobs", type=int, default=1, show_default=True, help="Use this many worker processes."),
    click.option(
        "--scheduler",
        help="Use the workers of a dask cluster with this address, such as tcp://192.168.0.7:8786.",
    ),
)
_laws_option = partial(
    click.option,
    "--laws",
    metavar="MODULE",
    multiple=True,
    is_eager=True,
    callback=_add_laws,
    help="Add the contact laws of your own module, by its name or the path of its file.",
)
laws_option, given_laws_option = _laws_option(expose_value=False), _laws_option()
#: Options for reading a recording: field of `ReadingOptions` -> option.
_READING: dict[str, Callable[[Any], Any]] = {
    "sampling_rate": click.option(
        "--rate", "sampling_rate", type=float, help="Set the sampling rate [Hz] that a file lacks, or states wrongly."
    ),
    "unit": click.option(
        "--unit",
        help="Set the unit of the samples (N, g, m/s^2, V, ...) if the file does not state it; for single channels "
        "1=N,2=m/s^2.",
    ),
    "channel": click.option(
        "--channel",
        multiple=True,
        help="Read only this channel: its name, or its number from 1; give the option again for several, or 1+2 for "
        "channels that a model uses together.",
    ),
    "variable": click.option("--variable", help="Choose an array, table or group if the file contains several."),
    "format": click.option(
        "--format",
        metavar="NAME",
        help="Read recordings as this format, such as WAV, text, or the reader of a package; by default detected.",
    ),
    "index": click.option("--index", type=click.IntRange(min=0), help="Read only this signal of a dataset, from 0."),
    "invert": click.option("--invert", is_flag=True, help="Invert the signal; impacts must point upwards."),
    "milliseconds": click.option(
        "--dead-time",
        "milliseconds",
        type=float,
        help="Set the ring-down time of an impact [ms], by default 2 for pulses and 5 for vibrations.",
    ),
    "sensitivity": click.option(
        "--sensitivity",
        multiple=True,
        metavar="[NAME=]VALUE",
        help="Set the sensitivity of a sensor with samples in volts: '10.2 mV/g', '2.3 mV/N', '3.1 pC/g'; "
        "for one channel as 2=VALUE.",
    ),
    "gain": click.option(
        "--gain",
        multiple=True,
        metavar="[NAME=]VALUE",
        help="Divide out this gain: 10, x10, '20 dB', or '1 mV/pC' of a charge amplifier.",
    ),
    "full_scale": click.option(
        "--full-scale",
        multiple=True,
        metavar="[NAME=]VALUE",
        help="Set the full scale of a sound file or of integers: '10 V', '50 g', '10 V at 24 bit'.",
    ),
    "skip_broken": click.option(
        "--skip-broken",
        is_flag=True,
        help="Leave out lines of a text that are no rows, as missing samples; count them.",
    ),
}


def reading_options_for(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the options for some fields of a `ReadingOptions`, which the command receives."""
    return _bundle("reading", ReadingOptions, {name: _READING[name] for name in names})


reading_options = reading_options_for(*_READING)
CHAIN = ("sensitivity", "gain", "full_scale")
same_beam_option = click.option(
    "--same-beam",
    multiple=True,
    metavar="CHANNELS",
    help="Count an impact once even if several channels of one beam measure it: 1+2; repeat the option for "
    "other beams.",
)
#: Plant outputs; the command receives the given ones as `outputs`, arguments of `PlantOutputs`.
plant_options = _bundle(
    "outputs",
    lambda **given: {name: value for name, value in given.items() if value is not None},
    {
        "mqtt": click.option(
            "--mqtt", metavar="URL", help="Publish each line below mqtt://HOST[:PORT]/TOPIC (mqtts: TLS)."
        ),
        "modbus": click.option(
            "--modbus", metavar="HOST:PORT", help="Serve state, gangue fraction and counts as Modbus TCP registers."
        ),
        "prometheus": click.option("--prometheus", metavar="[HOST]:PORT", help="Serve metrics at /metrics."),
        "live": click.option(
            "--live",
            type=OUTPUT,
            metavar="[HOST]:PORT|FILE",
            help="Show waveform, gangue fraction and decision on a page, or in FILE.html.",
        ),
        "on_shut": click.option(
            "--on-shut", metavar="COMMAND", help="Run this command at each SHUT; it gets the line on stdin."
        ),
        "on_open": click.option("--on-open", metavar="COMMAND", help="Run this command at each OPEN."),
        "on_blind": click.option(
            "--on-blind",
            metavar="COMMAND",
            help="Run this command when a support is blind, or the stream stops without its end.",
        ),
    },
)
#: Options for the model and its settings, as arguments of `settings_of`.
answering_options = _options(
    click.option(
        "--model",
        "model_path",
        type=MODEL,
        help="Use this model: a file, or a shipped one such as default-acceleration; by default chosen by the unit.",
    ),
    click.option(
        "--mass", type=float, help="Set the mass of the accelerated impactor [kg]: force = mass x acceleration."
    ),
    click.option("--drop-height", type=float, help="Set the drop height of the rocks [m], for a model that needs it."),
    click.option(
        "--miss-cost",
        "costs",
        multiple=True,
        metavar="LABEL=COST",
        help="Set the cost of missing this label, by default 1.",
    ),
    click.option(
        "--coverage",
        type=float,
        help="Reject impacts whose prediction set at this coverage (0.9) is not a single label.",
    ),
    click.option(
        "--class-conditional", is_flag=True, help="Guarantee the coverage for each label, not only for their mixture."
    ),
    click.option(
        "--vote",
        "vote_time",
        type=float,
        help="Set the time over which windows vote [s], by default 0.5; with 0, no vote.",
    ),
    click.option(
        "--sensor",
        "sensors",
        multiple=True,
        metavar="NAME",
        help="Name the sensor among those of the model's reference runs; once, or once per channel.",
    ),
    same_beam_option,
    click.option(
        "--lines/--no-lines",
        default=None,
        help="Remove machine tones from accelerations of a beam from the first sample on, or keep them; by default "
        "they are removed once they are detected, after two seconds.",
    ),
    click.option(
        "--window", "share_time", type=float, help="Set the window of the gangue fraction [s], by default 10."
    ),
    click.option(
        "--gangue", multiple=True, metavar="LABEL", help="Count this label as gangue; repeat the option for several."
    ),
    click.option(
        "--dilution-cost",
        type=float,
        help="Set the cost of drawn gangue in units of lost coal, by default 1; it decides when to shut.",
    ),
    click.option(
        "--cost-late",
        type=float,
        help="Set the loss of each second of drawing above the limit, for each unit of fraction above, by default 1.",
    ),
    click.option(
        "--cost-early",
        type=float,
        help="Set the loss of each second shut below the limit, for each unit of fraction below, by default 6.",
    ),
    click.option(
        "--hold", type=float, help="Hold SHUT or OPEN for at least this time [s], by default the length of the window."
    ),
    click.option(
        "--coal-until",
        type=SECONDS,
        metavar="TIME",
        help="State that only coal falls for this long (30s) at the beginning; the gangue fraction is then "
        "that of this seam.",
    ),
    click.option(
        "--cycle-pause",
        type=SECONDS,
        metavar="TIME",
        help="Start a new caving cycle at the first impact after a pause of this length (120s); with --coal-until.",
    ),
    click.option(
        "--labelled",
        type=PATH,
        metavar="TABLE",
        help="Use what this manifest or table of events labels coal in the recording, instead of --coal-until; some "
        "lumps labelled gangue make the fraction sharper, beside either.",
    ),
    click.option(
        "--trained-seam",
        is_flag=True,
        help="State that the seam is like that of the model's training: its coal and gangue, their sizes "
        "and drop heights.",
    ),
    click.option(
        "--blind-after",
        type=float,
        help="Call a support blind, and withdraw its decision, after this long without valid samples [s], "
        "by default 5.",
    ),
    click.option(
        "--give-up", type=float, help="End when no channel has been readable for this long [s]; by default go on."
    ),
)


def settings_with_coal(
    settings: PredictionSettings, labelled: Manifest, recording: str, channels: Sequence[Channel], model: StoredModel
) -> PredictionSettings:
    """Return settings with the spans of a recording that a manifest labels coal, and gangue if the model uses it."""
    from cgid.identification.training.manifest import labelled_in

    names, needs_coal = [channel.name for channel in channels], settings.coal_until is None
    given = labelled, recording, names, model.labels, settings.shares.gangue
    coal, lumps = labelled_in(*given, needs_coal=needs_coal)
    uses_lumps = model.seams is not None and model.seams.sharpened is not None
    return replace(settings, coal=coal, lumps=lumps if uses_lumps else ())


def settings_of(
    reading: ReadingOptions, *, model_path: str | None, costs: tuple[str, ...], **given: Any
) -> tuple[Models, PredictionSettings]:
    """Return the models and the settings; `given` are the other fields of the settings."""
    from cgid.identification.prediction import PredictionSettings

    settings = PredictionSettings(
        costs=dict(_cost(text) for text in costs), dead_time=reading.dead_time, invert=reading.invert, **given
    )
    return Models(model_path, settings), settings


def _cost(text: str) -> tuple[str, float]:
    """Return label and cost of LABEL=COST."""
    label, _, cost = text.partition("=")
    try:
        return label, float(cost)
    except ValueError:
        raise click.UsageError(f"--miss-cost must be LABEL=COST such as gangue=3, got {text!r}") from None


#: Options of outputs, which suggested commands omit.
_OUTPUT = ("as_json", "strict", "report", "output", "overwrite", "sample")


def given_options() -> tuple[list[str], list[str]]:
    """Return the options of the current command line: those for reading a recording, and those for prediction."""
    context = click.get_current_context()
    found: tuple[list[str], list[str]] = ([], [])
    given = given_flags(context)
    for option in context.command.params:
        name = option.name or ""
        if name not in given or not isinstance(option, click.Option) or name in _OUTPUT:
            continue
        values = context.params[name]
        for value in values if option.multiple else [values]:
            text = f"{value:.12g}" if isinstance(value, float) else f"{value}"
            found[name not in _READING].extend([option.opts[0]] if option.is_flag else [option.opts[0], text])
    return found


def prediction_by(path: Path, model: StoredModel, manifest: Manifest | None, reading: ReadingOptions) -> str:
    """Return the command for predictions by a new model, on a recording that is read like all of its manifest."""
    words, own = [], {**vars(reading), **reading.chain_of("")}
    flags = {"sampling_rate": "rate", "milliseconds": "dead-time", "full_scale": "full-scale"}
    fields = {"channel": "channels", "gain": "recording_gain"}
    rows = [] if manifest is None else [one for one in manifest.annotations if not one.reference]
    for name in _READING:
        stated = {getattr(one, fields.get(name, name), None) or getattr(one, name, None) or own[name] for one in rows}
        value = stated.pop() if len(stated) == 1 else None
        for part in value if isinstance(value, tuple) else (value,) if value else ():
            text = f"{part:.12g}" if isinstance(part, float) else f"{part}"
            words += [f"--{flags.get(name, name)}", *([] if part is True else [text])]
    return shlex.join(["cgid", "predict", "FILE", *words, "--model", str(path), *beam_words(model.same_beam)])


class Models:
    """The given model; else the default model of each quantity, loaded when a signal needs it."""

    def __init__(self, path: str | None, settings: PredictionSettings) -> None:
        self._path, self._settings = path, settings
        self._models: dict[str | None, StoredModel] = {}
        self._one_for_all = path is not None or settings.mass is not None or settings.drop_height is not None
        if self._one_for_all:
            self.of(None)

    def of(self, quantity: str | None) -> StoredModel:
        """Return the model for signals of a quantity."""
        key = self.key(quantity)
        if key not in self._models:
            from cgid.identification.prediction.prediction import default_model, read_model

            model = read_model(default_model(key, self._settings) if self._path is None else self._path)
            self._settings.check(model)
            self._models[key] = model
        return self._models[key]

    def key(self, quantity: str | None) -> str | None:
        """Return what signals that share a model have in common: their quantity, unless one model is for all."""
        return None if self._one_for_all else quantity

    @property
    def expects_acceleration(self) -> bool:
        """Whether the given model is one of acceleration."""
        return self._one_for_all and self.of(None).quantity == "acceleration"

    def name(self, model: StoredModel) -> str:
        """Return the file name of a model, or which default model it is."""
        if self._path is not None:
            return Path(self._path).name
        return "default model" + (" that knows the drop height" if model.known else f" of {model.quantity}")


def warn_of_model(
    source: str,
    name: str,
    sampling_rate: float,
    model: StoredModel,
    settings: PredictionSettings,
    channels: Sequence[str] = (),
) -> None:
    """Warn if a model was not trained for the sampling rate [Hz] of a signal, or needs its sensor or its channels."""
    if beams := untold_beams(model, channels, settings.same_beam):
        warn(
            f"{source}: the model was trained with channels of one beam together; give {shlex.join(beams)}, or the "
            "channels that this recording has on one beam"
        )
    if model.sensors and not settings.sensors:
        known = ", ".join(model.sensors)
        warn(
            f"{source}: the model corrects the responses of known sensors only; give --sensor NAME if this is one of "
            f"{known}"
        )
    if model.beam is not None and not model.beam.beam.region.any():
        warn(
            f"{source}: the model is of modes of one place: only impacts there are identified; for impacts anywhere "
            "tap a grid of places (cgid tap --taps places.csv --sensor X,Y), and train on that scene"
        )
    if model.is_of_few:
        warn(
            f"{source}: the model knows few recordings of each label; its probabilities are valid for recordings like "
            "those; expect lower accuracy on another day"
        )
    warn_of_chance(model, f"{source}: ", settings.shares.gangue)
    if not model.covers(sampling_rate):
        warn(f"{name}: sampled at {sampling_rate:g} Hz, the model was trained at {model.rates_text}")


def beam_words(beams: Iterable[str]) -> list[str]:
    """Return the options that name beams, each by its channels such as 1+2."""
    return [word for beam in beams for word in ("--same-beam", beam)]


def untold_beams(model: StoredModel, channels: Sequence[str], given: Sequence[Any]) -> list[str]:
    """Return the options that name the channels of a beam, as in the training, where several channels lack them."""
    if given or not model.same_beam or len(channels) < 2:
        return []
    is_known = all(set(beam.split("+")) <= set(channels) for beam in model.same_beam)
    n = min(len(model.same_beam[0].split("+")), len(channels))
    beams = model.same_beam if is_known else ("+".join(str(number) for number in range(1, n + 1)),)
    return beam_words(beams)


def warn_of_chance(model: StoredModel, source: str = "", gangue: Sequence[str] = ("gangue",)) -> None:
    """Warn if a model is not shown to be better than chance."""
    from cgid.identification.prediction.fraction import unproven

    if reason := unproven(model, gangue):
        warn(
            f"{source}the model is not shown to be better than chance, so neither SHUT nor OPEN follows from it: "
            f"{reason}; label impacts of more recordings"
        )


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
