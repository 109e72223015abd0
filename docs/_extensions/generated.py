"""The directive `{generated}`: pages of the reference that are read off the code of this checkout.

Each function below returns MyST text; a page says where it goes, and keeps the words around it.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

import click
from docutils import nodes
from numpydoc.docscrape import NumpyDocString
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


def escaped(text: str) -> str:
    """Return text as MyST on one line; what stands between backticks is code, all else is plain."""
    special = "\\`*_{}[]<>()#|$~"
    parts = " ".join(str(text).split()).split("`")
    if len(parts) % 2 == 0:  # a single backtick
        parts = ["`".join(parts)]
    plain = ["".join(f"\\{sign}" if sign in special else sign for sign in part) for part in parts[::2]]
    code = [coded(part) for part in parts[1::2]]
    return "".join(text for pair in zip(plain, [*code, ""], strict=True) for text in pair)


def coded(text: str) -> str:
    """Return text as code, in a cell of a table, too."""
    fence = "``" if "`" in text else "`"
    return f"{fence}{' '.join(text.split())}{fence}".replace("|", "\\|")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; cells are MyST."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"


# -- commands -----------------------------------------------------------------------------------------


class _Page(click.HelpFormatter):
    """What click writes as help, as MyST: whatever sections a command has, in the order that it has them."""

    def __init__(self, path: str) -> None:
        super().__init__(width=100, max_width=100)
        self.path, self.parts = path, [""]

    def write_usage(self, prog: str, args: str = "", prefix: str | None = None) -> None:
        self.parts.append(f"```text\n{prog} {args}\n```")

    def write_heading(self, heading: str) -> None:
        self.parts.append(f"**{escaped(heading)}**")

    def write_text(self, text: str) -> None:
        for paragraph in text.strip("\n").split("\n\n"):
            verbatim = "\b" in paragraph
            body = paragraph.replace("\b", "").strip("\n")
            self.parts.append(f"```text\n{inspect.cleandoc(body)}\n```" if verbatim else escaped(body))

    def write_dl(self, rows: Iterable[tuple[str, str]], *_: Any, **__: Any) -> None:
        self.parts.append("\n".join(f"{coded(first)}\n: {escaped(second) or '-'}\n" for first, second in rows))

    def write_paragraph(self) -> None:
        pass

    def write(self, string: str) -> None:
        if string.strip():
            self.parts.append(f"```text\n{inspect.cleandoc(string.strip(chr(10)))}\n```")

    def indent(self) -> None:
        pass

    def dedent(self) -> None:
        pass

    @property
    def text(self) -> str:
        return "\n\n".join(self.parts)


def commands() -> str:
    """Return a table of the commands, in the groups of `cgid --help`."""
    from cgid.cli import cli
    from cgid.cli.help import _COMMANDS

    parts = []
    for heading, names in _COMMANDS.items():
        rows = [
            [f"{{doc}}`cgid {name} <commands/{name}>`", escaped(cli.commands[name].get_short_help_str(100))]
            for name in names.split()
        ]
        parts.append(f"## {heading}\n\n{table(('command', 'what it does'), rows)}")
    return "\n".join(parts)


def write_commands(app: Sphinx, _: Any) -> None:
    """Write a page for each command with its help, only if it has changed, so that Sphinx does not read it again."""
    from cgid.cli import cli

    folder = Path(app.srcdir) / "reference" / "commands"
    folder.mkdir(exist_ok=True)
    for name, command in cli.commands.items():
        with click.Context(command, info_name=f"cgid {name}", max_content_width=100) as context:
            page = _Page(name)
            command.format_help(context, page)
        text, path = f"# cgid {name}\n\n{page.text}\n", folder / f"{name}.md"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


# -- keys of scenes -----------------------------------------------------------------------------------


def _sections(annotation: Any) -> list[type[BaseModel]]:
    """Return the sections and distributions that an annotation names."""
    if inspect.isclass(annotation) and not get_args(annotation):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [section for inner in get_args(annotation) for section in _sections(inner)]


def _plain(annotation: Any) -> str:
    """Return the type of a value in words."""
    origin, inner = get_origin(annotation), [one for one in get_args(annotation) if one is not NoneType]
    if origin is Literal:
        return ", ".join(coded(f'"{one}"') for one in inner)
    if hasattr(annotation, "__metadata__"):
        return _plain(annotation.__origin__)
    if origin in (Union, UnionType):
        sections = [one for one in inner if _sections(one)]
        if len(sections) > 1 or (sections and _is_distribution(sections[0])):
            return "number or [distribution](#distributions)"
        return " or ".join(dict.fromkeys(_plain(one) for one in inner))
    if origin is tuple:
        of = "numbers or [distributions](#distributions)" if _is_distribution(inner[0]) else f"{_plain(inner[0])}s"
        return f"list of {of}".replace("numbers or strings", "numbers")
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        if _is_distribution(annotation):
            return "number or [distribution](#distributions)"
        return "table"
    return {float: "number", int: "whole number", str: "text", bool: "true or false"}.get(annotation, "number or text")


def _is_distribution(section: Any) -> bool:
    sections = _sections(section)
    return bool(sections) and all("distribution" in one.model_fields for one in sections)


def _rule(field: FieldInfo) -> str:
    """Return the unit of a number, its rule, and how many there may be."""
    from cgid.scene.file.distributions import quantity_of

    quantity, words = quantity_of(field), ""
    if quantity is not None:
        rule = quantity.rule.sentence().removeprefix("lie ").removeprefix("be ")
        words = (
            f" \\[{escaped(quantity.unit)}\\]" if quantity.unit else ""
        ) + f", {escaped(rule)}" * quantity.rule.limited
    most = [one.max_length for one in field.metadata if hasattr(one, "max_length")]
    return words + "".join(
        f", at most {number} {'characters' if field.annotation is str else 'of them'}" for number in most
    )


def _row(name: str, field: FieldInfo) -> list[str]:
    kind = _plain(field.annotation) + _rule(field)
    if field.is_required():
        default = "required"
    elif field.default in (None, PydanticUndefined) or field.default == () or isinstance(field.default, BaseModel):
        default = "-"
    else:
        default = coded(f'"{field.default}"' if isinstance(field.default, str) else f"{field.default}".lower())
    return [coded(name), kind, default, escaped(field.description or "")]


def _walk(section: type[BaseModel], path: str) -> Iterable[tuple[str, type[BaseModel]]]:
    """Yield the path in the file and the model of a section and of all inside, each once."""
    yield path, section
    for name, field in section.model_fields.items():
        for inner in dict.fromkeys(_sections(field.annotation)):
            if "distribution" in inner.model_fields:
                continue
            many = get_origin(field.annotation) is tuple or any(
                get_origin(one) is tuple for one in get_args(field.annotation)
            )
            here = f"{path}.{name}" if path else name
            yield from _walk(inner, f"[{here}]" if many else here)


def scene_sections() -> list[tuple[str, type[BaseModel]]]:
    """Return the sections of a scene file: the path (in brackets for a list of tables) and the model."""
    from cgid.scene import Scene

    return list(_walk(Scene, ""))


def distributions() -> list[type[BaseModel]]:
    """Return the distributions that a number of a population may have."""
    from cgid.scene.file.distributions import Distribution

    return _sections(Distribution)


def scene_keys() -> str:
    """Return every key of a scene file, section by section."""
    parts = []
    for path, section in scene_sections():
        rows = [_row(name, field) for name, field in section.model_fields.items()]
        title = coded(f"[{path}]") if path else "At the top"
        parts.append(f"## {title}\n\n{_first_paragraphs(section)}\n\n{table(_SCENE_HEADER, rows)}")
    return "\n".join(parts)


def scene_distributions() -> str:
    """Return every distribution with its keys."""
    parts = []
    for section in distributions():
        names = get_args(section.model_fields["distribution"].annotation)
        fields = {name: field for name, field in section.model_fields.items() if name != "distribution"}
        rows = [_row(name, field) for name, field in fields.items()]
        title = ", ".join(coded(f'"{name}"') for name in names)
        parts.append(f"### {title}\n\n{_first_paragraphs(section)}\n\n{table(_SCENE_HEADER, rows)}")
    return "\n".join(parts)


_SCENE_HEADER = ("key", "value", "default", "meaning")


def _first_paragraphs(section: type[BaseModel]) -> str:
    text = NumpyDocString(inspect.cleandoc(section.__doc__ or ""))
    return escaped(" ".join([*text["Summary"], *text["Extended Summary"]]))


# -- tables -------------------------------------------------------------------------------------------


def features() -> str:
    """Return the table of features, by the kind of signal that they are measured on."""
    from cgid.measure.features import FEATURES

    parts = []
    for kind, title in (("pulse", "Pulses"), ("vibration", "Vibrations"), ("window", "Windows of a recording")):
        rows = [
            [
                coded(entry.name) + (f" ({len(entry.columns)} columns)" if len(entry.columns) > 1 else ""),
                escaped(entry.unit),
                escaped(entry.definition) + (f" (extra `{entry.extra}`)" if entry.extra else ""),
                escaped(entry.source),
            ]
            for entry in FEATURES.entries
            if entry.kind == kind
        ]
        parts.append(f"## {title}\n\n{table(('feature', 'unit', 'definition', 'source'), rows)}")
    return "\n".join(parts)


def formats() -> str:
    """Return the formats in the order in which a file is held against them."""
    from cgid.recordings.formats import FORMATS

    rows = []
    for entry in FORMATS:
        module, _, function = entry.reader.partition(":")
        reader = getattr(importlib.import_module(f"cgid.recordings.{module}"), function)
        summary = (inspect.getdoc(reader) or "").split("\n\n")[0].replace("Return the", "The", 1)
        rows.append([entry.name, escaped(summary), "yes" if entry.takes_variable else "-"])
    return table(("format", "what is read", "`variable`"), rows)


def site_keys() -> str:
    """Return every key of a site file, section by section."""
    from cgid.recordings.site import CHANNEL_KEYS, KEYS

    parts = []
    for section, keys in ({"recorder": KEYS["recorder"], "channels.1": CHANNEL_KEYS} | KEYS).items():
        rows = [(coded(key), about.kind, escaped(about.help)) for key, about in keys.items()]
        parts.append(f"## {coded(f'[{section}]')}\n\n{table(('key', 'value', 'meaning'), rows)}")
    return "\n".join(parts)


def sample_units() -> str:
    """Return the units of samples, and what no sensor gives."""
    from cgid.units import LARGEST, UNITS

    rows = [
        [name, ", ".join(map(coded, units)), f"{LARGEST[name]:g} {next(iter(units))}"] for name, units in UNITS.items()
    ]
    return table(("quantity", "units, the SI unit first", "no sensor gives more than"), rows)


def scene_units() -> str:
    """Return the units of the numbers in scene files."""
    from cgid.units import DIMENSIONS

    rows = [[name, ", ".join(coded(unit) if unit else "none" for unit in units)] for name, units in DIMENSIONS.items()]
    return table(("dimension", "units, the SI unit first"), rows)


def errors() -> str:
    """Return the errors with their exit codes."""
    from cgid import errors as module

    found = [one for _, one in inspect.getmembers(module, inspect.isclass) if one.__module__ == module.__name__]
    found.sort(key=lambda one: (one.exit_code, one.__name__))
    rows = []
    for one in found:
        if one is module.CgidError:
            continue
        builtin = next(base.__name__ for base in one.__mro__ if base.__module__ == "builtins" and base is not one)
        meaning = (one.__doc__ or "").split(" (exit code")[0]
        rows.append([str(one.exit_code), coded(one.__name__), coded(builtin), escaped(meaning) + "."])
    return table(("exit code", "error in `cgid.errors`", "also a", "when"), rows)


PAGES: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (
        commands, site_keys, scene_keys, scene_distributions, features, formats, sample_units, scene_units, errors
    )
}  # fmt: skip


class Generated(SphinxDirective):
    """``{generated} features``: the text of the function of this name, with its headings."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the generated text."""
        return self.parse_text_to_nodes(PAGES[self.arguments[0]](), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive; pages are made anew in every build, because the code may have changed."""
    app.add_directive("generated", Generated)
    app.connect("config-inited", write_commands)
    return {"version": "1", "parallel_read_safe": True}
