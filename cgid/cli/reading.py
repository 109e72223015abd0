"""Options for reading recordings, and the object that commands receive of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cgid._lib.validation import whole
from cgid.cli.options import bundle, given_flags
from cgid.cli.output import say_error, warn
from cgid.cli.site import site_words, the_site
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.signals import Signal, channel_name

if TYPE_CHECKING:
    from cgid.identification.training.recordings import Reading
    from cgid.recordings import RecordingFile
    from cgid.recordings.site import Site


#: Keys that datasets state.
_OF_RECORDINGS = ("rate", "unit", "format", "variable", "channel", "sensitivity", "gain", "full_scale")
#: Maximum dead time [ms]; no ring-down lasts longer.
MAX_DEAD_TIME = 1e4


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
    """Settings for reading an input: the values of `reading_options` of a command, and its site."""

    sampling_rate: float | None = None
    unit: str | None = None
    channel: tuple[str, ...] = ()
    sensitivity: tuple[str, ...] = ()
    full_scale: tuple[str, ...] = ()
    same_beam: tuple[str, ...] = ()
    site: Site = field(default_factory=the_site)

    @property
    def chain(self) -> dict[str, tuple[str, ...] | None]:
        """The measuring chain on the command line, as arguments of `open_recording`."""
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
        return {"sampling_rate": self.sampling_rate, "unit": self.unit, "site": self.site, **self.chain}

    @property
    def stated(self) -> dict[str, Any]:
        """What the line and its site state of the recorder, as keys of a site file; channels.N.KEY of one channel."""
        found = dict(self.site.values["recorder"])
        for name, own in self.site.channels.items():
            found |= {f"channels.{name}.{key}": value for key, value in own.items()}
        found |= {"rate": self.sampling_rate} if self.sampling_rate else {}
        texts = {"unit": self.unit.split(",") if self.unit else (), **{key: getattr(self, key) for key in CHAIN}}
        for key, text in ((key, text) for key, listed in texts.items() for text in listed):
            channel, equals, value = _file_and_value(text)[1].rpartition("=")
            found[f"channels.{channel}.{key}" if equals else key] = value
        return found

    @property
    def index(self) -> int | None:
        """Number of the only signal of a dataset to read, None for all."""
        index = self.site.get("index")
        return None if index is None else whole("index", index, 0)

    @property
    def dead_time(self) -> float | None:
        """Dead time [s]; raises `InvalidValue` outside of the valid range."""
        given = self.site.get("dead_time")
        if given is None:
            return None
        if not 0 <= given <= MAX_DEAD_TIME:
            raise InvalidValue(f"dead_time must be between 0 and {MAX_DEAD_TIME:g} ms, got {given:g} ms")
        return float(given) * 1e-3

    @property
    def has_beams(self) -> bool:
        """Whether the line or the site says that channels are on one beam."""
        return bool(self.same_beam) or any("beam" in values for values in self.site.channels.values())

    def beams(self, recording: RecordingFile) -> tuple[tuple[str, ...], ...]:
        """Return the channels of each beam that has several, in a recording."""
        if not self.same_beam:
            return recording.beams
        from cgid.identification.prediction.settings import require_groups

        return recording.named(require_groups(self.same_beam), "--same-beam") or recording.beams

    def of_manifest(self) -> Reading:
        """Return the settings for recordings of a manifest that do not state them."""
        from cgid.identification.training.recordings import Reading

        return Reading(channels=self.channel or None, same_beam=self.same_beam, failed=say_error, **self.common)

    def wants_complete_dataset(self, path: str) -> bool:
        """Return whether this is a dataset without a chosen signal, which takes no options for reading a recording."""
        from cgid.recordings import is_dataset

        if not is_dataset(path):
            return False
        given: dict[str, Any] = {f"--{name.replace('_', '-')}": value for name, value in self.chain.items()}
        given["--same-beam"] = self.same_beam or None
        given |= {f"--set {key}": value for key, value in self.site.given.items() if key in _OF_RECORDINGS}
        if self.index is None:
            given |= {"--rate": self.sampling_rate, "--unit": self.unit, "--channel": self.channel or None}
        for flag, value in given.items():
            if value is not None:
                raise InvalidValue(f"{path}: {flag} is for recordings, a dataset states it; leave {flag} out")
        return self.index is None

    def recording(self, path: str) -> RecordingFile:
        """Open a recording."""
        from cgid.recordings import open_recording

        if self.index is not None:
            raise InvalidValue(f"{path}: index picks a signal of a dataset (HDF5), this is a recording; leave it out")
        return open_recording(path, channel=self.channel or None, **{**self.common, **self.chain_of(path)})

    def signals(
        self, path: str, faults: list[BadData] | None = None, recording: RecordingFile | None = None
    ) -> list[Signal]:
        """Return the signals of a recording, or the chosen signal of a dataset; `faults` gets unreadable channels."""
        from cgid.recordings import is_dataset

        if is_dataset(path):
            from cgid.store import Dataset

            signal = Dataset(path).signal(self.index or 0)
            signals = [signal.inverted() if self.site.get("invert") else signal]
        else:
            signals, errors = (recording or self.recording(path)).signals_and_faults()
            if errors and (faults is None or not signals):
                raise errors[0]
            if faults is not None:
                faults += errors
        return signals


def _file_and_value(text: str) -> tuple[str, str]:
    """Return the file, "" for all, and the value of FILE:CHANNEL=VALUE; channels may contain colons, too."""
    from cgid.recordings.formats import ENDINGS

    at = next((at for at, sign in enumerate(text) if sign == ":" and text[:at].lower().endswith(ENDINGS)), -1)
    return text[: max(at, 0)], text[at + 1 :]


def _is_file(name: str, path: str) -> bool:
    return name in (path, Path(path).name)


#: Options for reading a recording: field of `ReadingOptions` -> option.
READING: dict[str, Callable[[Any], Any]] = {
    "sampling_rate": click.option(
        "--rate", "sampling_rate", type=float, help="Sampling rate [Hz], if a file lacks it."
    ),
    "unit": click.option("--unit", help="Unit of the samples, if a file lacks it: N, g, m/s^2, V; or 1=N,2=m/s^2."),
    "channel": click.option("--channel", multiple=True, help="Read only this channel: its name or number; repeatable."),
    "sensitivity": click.option(
        "--sensitivity", multiple=True, metavar="[NAME=]VALUE", help="Of a sensor in volts: '10.2 mV/g', 2='2.3 mV/N'."
    ),
    "full_scale": click.option(
        "--full-scale", multiple=True, metavar="[NAME=]VALUE", help="Of sound files or integers: '10 V', '50 g'."
    ),
    "same_beam": click.option(
        "--same-beam", multiple=True, metavar="CHANNELS", help="One answer a rock for channels of one beam: 1+2."
    ),
}
#: What people state of a recording, at every command that reads one, and where they read many of a recorder.
_USUAL = ("sampling_rate", "unit", "channel")
CHAIN = ("sensitivity", "full_scale")


def reading_options_for(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the options for some fields of a `ReadingOptions`, which the command receives."""
    return bundle("reading", ReadingOptions, {name: READING[name] for name in names})


def reading_options(*more: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return `reading_options_for` the usual options, and some more."""
    return reading_options_for(*_USUAL, *more)


#: Options of outputs, which suggested commands omit.
_OUTPUT = ("as_json", "report", "output", "overwrite", "sample")


def given_options() -> tuple[list[str], list[str]]:
    """Return the options of the current command line: those for reading a recording, and those for prediction."""
    context = click.get_current_context()
    found = site_words()
    given = given_flags(context)
    for option in context.command.params:
        name = option.name or ""
        if name not in given or not isinstance(option, click.Option) or name in _OUTPUT:
            continue
        values = context.params[name]
        is_reading = name in READING and name != "same_beam"
        for value in values if option.multiple else [values]:
            text = f"{value:.12g}" if isinstance(value, float) else f"{value}"
            found[not is_reading].extend([option.opts[0]] if option.is_flag else [option.opts[0], text])
    return found


def as_keys(words: Sequence[str], source: str) -> list[str]:
    """Return pairs of option and value of one recording for a command without options of the measuring chain."""
    found: list[str] = []
    for flag, value in zip(words[::2], words[1::2], strict=True):
        key = flag.removeprefix("--").replace("-", "_")
        if key not in CHAIN:
            found += [flag, value]
            continue
        file, text = _file_and_value(value)
        channel, equals, amount = text.rpartition("=")
        if not file or _is_file(file, source):
            found += ["--set", f"channels.{channel}.{key}={amount}" if equals else f"{key}={amount}"]
    return found


def beam_words(beams: Iterable[str]) -> list[str]:
    """Return the options that name beams, each by its channels such as 1+2."""
    return [word for beam in beams for word in ("--same-beam", beam)]
