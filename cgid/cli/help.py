"""The pages of --help: options and commands under headings, and one working example."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any

import click

from cgid.cli import output
from cgid.cli.options import OutputName, require_no_input_written
from cgid.cli.site import COMMON, section_of, the_site
from cgid.recordings.site import KEYS

_OTHERS, _PLANT = "Other", "Plant outputs"
#: Heading -> the options below it; "command --option" if a command uses the name differently.
_OPTIONS = {
    "Task": "--labels --sample --list --explain --features-only --quantities --parameters-only --scene",
    "Reading the recording": "--rate --unit --sensitivity --full-scale --channel --channels --same-beam "
    "--sample-format --from --to --events",
    "Answers": "--model --coal-until --labelled --renew",
    "Model": "--family --by --window --sensor --features",
    "Signals": "--signals --seed",
    "Calibration": "--dimension-error",
    "Tap test": "--hammer --modes --band --taps",
    "Output": "--output --summary --fractions --port --audacity --mirror --report --plot --plots --write-site "
    "--overwrite --resume --json",
    _PLANT: "--mqtt --modbus --prometheus --live --on-shut --on-open --on-blind",
    "Speed": "--jobs",
    _OTHERS: "--site --set --help-all --help --version",
}
_EXCEPTIONS = {
    "train --from": "Task",
    "generate --features": "Signals",
    "features --features": "Task",
    "export-model --to": "Task",
}
_TO_PLANT = frozenset(_OPTIONS[_PLANT].split())
#: Unit in the help of an option -> what its number is called.
_UNITS = {"Hz": "HZ", "s": "SECONDS"}
#: What the texts of options are called; other numbers are NUMBER or N.
_TEXTS = {
    "--unit": "UNIT",
    "--features": "NAMES",
    "--quantities": "NAMES",
    "--labels": "NAMES",
    "--sample-format": "FORMAT",
    "--dimension-error": "ERROR",
}
#: Heading -> the commands below it.
_COMMANDS = {
    "Recordings": "predict monitor events label features info plot",
    "Models": "train export-model",
    "Datasets and scenes": "generate check tap invert calibrate verify export fetch",
}
#: One line for the startup file of each shell.
_COMPLETION = (
    ("bash", 'eval "$(_CGID_COMPLETE=bash_source cgid)"'),
    ("zsh", 'eval "$(_CGID_COMPLETE=zsh_source cgid)"'),
    ("fish", "_CGID_COMPLETE=fish_source cgid | source"),
)


def heading_of(command: str | None, option: click.Parameter) -> str | None:
    """Return the heading of an option of a command; None if its name is not known here."""
    flag = max(option.opts, key=len)
    special = _EXCEPTIONS.get(f"{command} {flag}")
    return special or next((heading for heading, flags in _OPTIONS.items() if flag in flags.split()), None)


def _metavar(option: click.Option) -> str | None:
    """Return what the value of an option is called, with its unit; None if click knows better."""
    if option.metavar is not None or option.is_flag or isinstance(option.type, click.Choice):
        return option.metavar
    if isinstance(option.type, click.types.IntParamType):
        return "N"
    if isinstance(option.type, click.types.FloatParamType):
        units = re.findall(r"\[(\w+)\]", option.help or "")
        return _UNITS.get(units[0] if units else "", "NUMBER")
    if type(option.type) is click.types.StringParamType:  # names of files have their own
        return _TEXTS.get(max(option.opts, key=len), "NAME")
    return None


class Command(click.Command):
    """A command whose help has headings and ends with an example, one or more lines for a shell."""

    def __init__(self, *args: Any, example: str = "", **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.example = example
        for option in self.params:
            if isinstance(option, click.Option):
                option.metavar = _metavar(option)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments, and note the flags for messages."""
        output.flags = {str(one.name): max(one.opts, key=len) for one in self.params if isinstance(one, click.Option)}
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if section := section_of(key := error.option_name.removeprefix("--no-").strip("-").replace("-", "_")):
                raise click.UsageError(
                    f"{error.option_name} is no option; give --set {key}=VALUE, or {key} in [{section}] of a site file"
                ) from None
            raise

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the options of this command, and those of all."""
        *own, helping = super().get_params(ctx)
        return [*own, *COMMON, helping]

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, unless it would write over its inputs."""
        if isinstance(self, Group):
            return super().invoke(ctx)
        site = the_site()
        for section, keys in KEYS.items():
            for key, about in keys.items():
                where = f"{site.path}: [{section}] {key}" if key in site.values[section] else f"--set {key}"
                output.flags.setdefault(about.field or key, where if key not in site.given else f"--set {key}")
        for module in site.get("laws", ()):
            from cgid.physics.contact.own_laws import add_laws

            add_laws(module)
        require_no_input_written([site.path] if site.path else [])
        for one in self.params:
            is_file = isinstance(one.type, OutputName) and one.name == "output"
            is_plant = not _TO_PLANT.isdisjoint(one.opts)
            if (is_file or is_plant) and ctx.params[str(one.name)] not in (None, "-"):
                output.allow_closed_stdout()
        return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options under their headings."""
        rows: dict[str, list[tuple[str, str]]] = {heading: [] for heading in _OPTIONS}
        for option in self.get_params(ctx):
            row = option.get_help_record(ctx) if isinstance(option, click.Option) else None
            if row is not None:
                rows[heading_of(self.name, option) or _OTHERS].append(row)
        _write(formatter, rows)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the example."""
        super().format_epilog(ctx, formatter)
        if self.example:
            with formatter.section("Example"):
                for line in self.example.splitlines():  # not wrapped, so that it can be copied
                    formatter.write(f"{'':>{formatter.current_indent}}{line}\n")


class CommandsOnDemand(Mapping[str, click.Command]):
    """The commands by name, each imported when it is asked for."""

    _names = " ".join(_COMMANDS.values()).split()

    def __getitem__(self, name: str) -> click.Command:
        if name not in self._names:
            raise KeyError(name)
        module = import_module(f"cgid.cli.{name.removesuffix('-model')}")
        command: click.Command = getattr(module, name.replace("-", "_"))
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Group(Command, click.Group):
    """The commands under headings, and how to enable completion by the shell."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands, then the options."""
        self.format_commands(ctx, formatter)
        super().format_options(ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one line for each command, under its heading."""
        _write(formatter, {heading: self._rows(names.split()) for heading, names in _COMMANDS.items()})

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the example, and the line for each shell."""
        super().format_epilog(ctx, formatter)
        with formatter.section("Completion by the shell, for its startup file"):
            formatter.write_dl(_COMPLETION)

    def _rows(self, names: Iterable[str]) -> list[tuple[str, str]]:
        return [(name, self.commands[name].short_help or "") for name in names]


def _write(formatter: click.HelpFormatter, rows: Mapping[str, list[tuple[str, str]]]) -> None:
    """Write the sections that have rows."""
    for heading, its_rows in rows.items():
        if its_rows:
            with formatter.section(heading):
                formatter.write_dl(its_rows)
