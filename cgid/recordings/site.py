"""A site file: the recorder, the channels by name, the model, the decision and the outputs of a site, stated once."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cgid._lib.files import parse_toml, read_regular
from cgid._lib.spelling import spelled
from cgid._lib.validation import shown, similar
from cgid.errors import BadData, InvalidValue
from cgid.recordings.chain import PARTS, Chain
from cgid.shipped import MODELS
from cgid.units import number_and_unit, parse

if TYPE_CHECKING:
    from cgid.recordings.recording import Blocks, RecordingFile

#: Largest site file [bytes]: 4,096 channels with every key have 1 MB.
_MAX_SIZE = 4 << 20
#: Most keys of a site file, as many as these channels have.
_MAX_KEYS = 1 << 16
#: Longest name of a channel [characters]: one that a page shows on a phone.
_LONGEST_NAME = 60
#: Signs that options divide channels and values by.
_DIVIDERS = "+=,;"


class Key(NamedTuple):
    """A key of a site file: what its value is, and what it does; `field` is that of the settings in Python."""

    kind: str
    help: str
    field: str


def _keys() -> dict[str, dict[str, Key]]:
    """Return the keys by section: each is a row of `site_keys.csv`."""
    found: dict[str, dict[str, Key]] = {}
    with Path(__file__).with_name("site_keys.csv").open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            found.setdefault(row["section"], {})[row["key"]] = Key(row["value"], row["meaning"], row["field"])
    return found


#: Keys of a site file, by section; those of one channel, a table such as [channels.1]: its number, or its name in the
#: file.
KEYS = _keys()
CHANNEL_KEYS = KEYS.pop("channels")
#: Keys that Python's settings have, by section.
_SETTINGS = ("model", "decision")
#: Keys of these sections that are not settings of a prediction.
_NO_SETTINGS = ("model", "cycle_by", "labelled")


@dataclass(frozen=True, init=False)
class Site:
    r"""What a site states once, from a site file: the recorder, channels by name, model, decision and outputs.

    `cgid.predict`, `cgid.open_recording`, `cgid.read_recording`, `cgid.train_on_groups` and every command take it;
    their own arguments win. The page "Site file" of the reference lists the keys.

    Parameters
    ----------
    path : str or Path
        A TOML file. Paths in it are relative to its folder.
    values : mapping of str to values, optional
        Keys that replace those of the file, without their section: ``{"hold": 5}``.

    Attributes
    ----------
    path : str
        Its file, "" without one.
    given : dict of str to values
        The values that replace those of the file.
    values : dict of str to values
        Section -> key -> value, checked.
    channels : dict of int or str to dict
        Number or name of a channel in files -> its keys.

    Raises
    ------
    NoInput
        There is no such file.
    BadData
        The file is no TOML.
    InvalidValue
        A key is unknown, a value is wrong, or two channels have one name.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "face12.toml"
    ...     _ = file.write_text('[recorder]\nunit = "V"\n[channels.1]\nname = "support 12"\ngain = 10')
    ...     site = Site(file)
    >>> site.values["recorder"], site.channels[1]["name"]
    ({'unit': 'V'}, 'support 12')
    """

    path: str
    given: Mapping[str, Any]
    values: Mapping[str, Mapping[str, Any]]
    channels: Mapping[int | str, Mapping[str, Any]]

    def __init__(self, path: str | Path = "", values: Mapping[str, Any] | None = None) -> None:
        object.__setattr__(self, "path", str(path))
        content = {} if path == "" else _content(Path(path))
        channels = content.pop("channels", {})
        found = {name: self._section(name, content.get(name, {})) for name in KEYS}
        for name in content:
            self._known(name, [*KEYS, "channels"], f"section [{name}]" if isinstance(content[name], dict) else name)
        stated: dict[str, Any] = {}
        for key, value in (values or {}).items():
            if key.startswith("channels."):
                channel, _, name = key.removeprefix("channels.").rpartition(".")  # a name may contain dots
                channels = {**channels, channel: {**channels.get(channel, {}), name: value}}
                continue
            section = next((name for name, keys in KEYS.items() if key in keys), None)
            if section is None:
                raise InvalidValue(f"{key} must be a key of a site file{_meant(key, _all_keys())}")
            stated[key] = found[section][key] = self._value("", key, KEYS[section][key], value, Path())
        object.__setattr__(self, "values", found)
        object.__setattr__(self, "given", stated)
        object.__setattr__(self, "channels", self._channels(channels))

    @classmethod
    def of(cls, given: Site | str | Path | None) -> Site:
        """Return the site of an argument: an object, its file, or an empty one for None."""
        if given is None:
            return NOWHERE
        if not isinstance(given, Site | str | Path):
            raise InvalidValue(f"site must be a Site or the path of its file, got {shown(given)}")
        return given if isinstance(given, Site) else cls(given)

    # -- what others ask for ------------------------------------------------------------------------------

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of a key of any section but those of channels."""
        return next((keys[key] for keys in self.values.values() if key in keys), default)

    @property
    def settings(self) -> dict[str, Any]:
        """Fields of `PredictionSettings` that the site states."""
        stated = {key: self.values[section][key] for section in _SETTINGS for key in self.values[section]}
        return {
            next(KEYS[section][key].field or key for section in _SETTINGS if key in KEYS[section]): value
            for key, value in stated.items()
            if key not in _NO_SETTINGS
        }

    def applied(self, contents: Blocks, chain: Chain, source: str) -> tuple[Blocks, Chain]:
        """Return the contents of a recording with the names of the site, and the chain where `chain` says nothing."""
        recorder = self.values["recorder"]
        rows = {key: contents.selected(key, source, self._of_channels)[0] for key in self.channels}
        if len(set(rows.values())) < len(rows):
            raise InvalidValue(
                f"{self.path}: [channels] must have one table for each channel, two are of one; join them"
            )
        own = {rows[key]: values for key, values in self.channels.items()}
        chain = chain.beside(Chain.of_site(recorder, {row + 1: values for row, values in own.items()}))
        if not any("name" in values for values in own.values()):
            return contents, chain
        names = [own.get(row, {}).get("name", contents.name(row)) for row in range(contents.n_channels)]
        labels = [name or str(row) for row, name in enumerate(names, 1)]
        if twice := next((name for name in labels if labels.count(name) > 1), None):
            raise InvalidValue(
                f"{self.path}: names of channels must differ, {twice} is that of two in {source}; name both"
            )
        return replace(contents, names=names, is_named=True), chain

    def beams(self, contents: Blocks, source: str) -> tuple[tuple[str, ...], ...]:
        """Return the channels of each beam that has several, by label."""
        found: dict[str, list[str]] = {}
        for key, values in self.channels.items():
            if "beam" in values:
                name = values.get("name", "")
                (row,) = contents.selected(name if name in contents.names else key, source, self._of_channels)
                found.setdefault(values["beam"], []).append(contents.label(row))
        return tuple(tuple(labels) for labels in found.values() if len(labels) > 1)

    @property
    def _of_channels(self) -> str:
        return f"[channels] of {self.path}" if self.path else "channels of the site"

    # -- reading the file ---------------------------------------------------------------------------------

    def _section(self, section: str, content: Any) -> dict[str, Any]:
        if not isinstance(content, dict):
            raise InvalidValue(f"{self.path}: {section} must be a section [{section}] with keys, got {shown(content)}")
        for key in content:
            self._known(key, KEYS[section], f"[{section}] {key}")
        folder = Path(self.path).parent
        return {key: self._value(section, key, KEYS[section][key], value, folder) for key, value in content.items()}

    def _known(self, key: str, keys: Iterable[str], said: str) -> None:
        if key not in keys:
            elsewhere = next((name for name, known in KEYS.items() if key in known), None)
            where = f"; it is a key of [{elsewhere}]" if elsewhere else _meant(key, [*keys])
            raise InvalidValue(f"{self.path}: {said} must be a key of site files, it is none{where}")

    def _value(self, section: str, key: str, about: Key, value: Any, folder: Path) -> Any:
        """Return a checked value."""
        name = f"{self.path}: [{section}] {key}" if section else key
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        match about.kind:
            case "number" | "whole":
                if is_number and (about.kind == "number" or value == int(value)):
                    return value
                raise InvalidValue(
                    f"{name} must be a {about.kind.replace('whole', 'whole number')}, got {shown(value)}"
                )
            case "flag":
                if isinstance(value, bool):
                    return value
                raise InvalidValue(f"{name} must be true or false, got {shown(value)}")
            case "time":
                found = number_and_unit(value) if isinstance(value, str) else (value, "") if is_number else None
                try:
                    return float(found[0]) if found and not found[1] else parse(value, "time")
                except ValueError as error:
                    raise InvalidValue(f"{name} must be a time such as 30 or '2 min', got {shown(value)}") from error
            case "share":
                if is_number or isinstance(value, str):
                    return str(value)
                raise InvalidValue(f"{name} must be a share such as '1 %' or 0.01, got {shown(value)}")
            case "costs":
                return _costs(value, name)
            case "texts" | "paths":
                texts = value if isinstance(value, list) else [value]
                if not all(isinstance(one, str | int) and not isinstance(one, bool) for one in texts):
                    raise InvalidValue(f"{name} must be a text, or a list of texts, got {shown(value)}")
                return tuple(self._path(str(one), folder, name) if about.kind == "paths" else str(one) for one in texts)
        if not (isinstance(value, str) or (is_number and key in ("gain", "full_scale"))) or value == "":
            raise InvalidValue(f"{name} must be a text, got {shown(value)}")
        if about.kind in ("path", "model", "output"):
            is_name = about.kind == "model" and value.partition("@")[0] in MODELS
            is_port = about.kind == "output" and value.rpartition(":")[2].isdigit()
            return value if is_name or is_port else self._path(value, folder, name)
        return self._measured(key, value, name)

    def _measured(self, key: str, value: Any, name: str) -> Any:
        """Return a value that is checked as the option of this name is."""
        if key in PARTS:
            try:
                PARTS[key].of(value)
            except InvalidValue as error:
                raise InvalidValue(f"{error}" if name == key else f"{name}: {error}") from None
        return value

    def _path(self, text: str, folder: Path, name: str) -> str:
        """Return a path relative to the folder of the file, which it must not leave."""
        if Path(text).is_absolute() or text.isidentifier():  # the latter is an installed module
            return text
        if ".." in Path(text).parts and folder != Path():
            raise InvalidValue(f"{name} must be in the folder of the site file, or absolute, got {text}; move the file")
        return str(folder / text)

    def _channels(self, given: Any) -> dict[int | str, dict[str, Any]]:
        if not isinstance(given, dict) or not all(isinstance(one, dict) for one in given.values()):
            raise InvalidValue(f"{self.path}: channels must be tables such as [channels.1], got {shown(given)}")
        found: dict[int | str, dict[str, Any]] = {}
        for number, content in given.items():
            section = f"channels.{number}"
            for key in content:
                self._known(key, CHANNEL_KEYS, f"[{section}] {key}")
            values = {
                key: self._value(section, key, CHANNEL_KEYS[key], value, Path()) for key, value in content.items()
            }
            found[int(number) if number.isascii() and number.isdigit() else number] = values
        names = [values["name"] for values in found.values() if "name" in values]
        for name in names:
            if names.count(name) > 1:
                raise InvalidValue(f"{self.path}: names of channels must differ, two are called {name}; rename one")
            if len(name) > _LONGEST_NAME or not name.isprintable() or any(sign in name for sign in _DIVIDERS):
                raise InvalidValue(
                    f"{self.path}: the name of a channel must be at most {_LONGEST_NAME} printable characters without "
                    f"{' '.join(_DIVIDERS)}, got {shown(name)}"
                )
        return found


#: The site of what states none.
NOWHERE = Site()


def _content(path: Path) -> dict[str, Any]:
    """Return the content of a site file."""
    raw = read_regular(path, "a site file", _MAX_SIZE)
    try:
        content = parse_toml(raw.decode("utf-8-sig"), _MAX_KEYS)
    except ValueError as error:  # of decoding, too
        reason = " ".join(str(error).split()) if isinstance(raw, bytes) and b"\0" not in raw else "it is binary"
        raise BadData(
            f"{path}: a site file must be TOML, {reason}; cgid info RECORDING --write-site {path.stem}.toml writes one"
        ) from None
    if content.keys() & {"impact", "sampling"}:
        raise BadData(
            f"{path}: a site file must have sections such as [recorder] and [channels.1], this is a scene; give it as "
            f"{spelled('scene')}, or to cgid generate"
        )
    return content


def _costs(value: Any, name: str) -> dict[str, float]:
    """Return costs by label, of a table or of texts such as gangue=3."""
    listed = value if isinstance(value, list) else [value]
    pairs = [one.rpartition("=")[::2] for one in listed if isinstance(one, str)]
    try:
        given = value if isinstance(value, dict) else dict(pairs)
        return {str(label): float(cost) for label, cost in given.items()}
    except (TypeError, ValueError):
        raise InvalidValue(f"{name} must be LABEL=COST such as gangue=3, got {shown(value)}") from None


def site_text(recording: RecordingFile, stated: Mapping[str, Any]) -> str:
    """Return a site file for recordings like this one, with what the user states of it and a comment a line."""
    unit = "V" if any(key.endswith("sensitivity") for key in stated) else recording.channels[0].unit or "V"
    known = {"rate": f"{recording.sampling_rate:.12g}", "unit": unit}
    lines = [
        f"# Site file for recordings such as {Path(recording.source).name}. What a # precedes is not used.",
        "# All keys: cgid predict --help-all",
        "",
        "[recorder]",
    ]
    for key in ("rate", "unit", "sensitivity", "full_scale"):
        value = stated.get(key, {"sensitivity": "10.2 mV/g", "full_scale": "10 V"}.get(key, known.get(key)))
        text = value if key == "rate" else f'"{value}"'
        lines.append(f"{'' if key in stated else '# '}{key} = {text}  # {KEYS['recorder'][key].help}")
    for number, channel in enumerate(recording.channels, 1):
        own = {"name": _plain(channel.name, number)}
        for name, key in ((name, key) for name in (channel.name, str(number)) for key in CHANNEL_KEYS):
            own |= {key: stated[at]} if (at := f"channels.{name}.{key}") in stated else {}
        lines += ["", f"[channels.{number}]"]
        for key, value in ({"sensitivity": "10.2 mV/g", "beam": "A"} | own).items():
            lines.append(f"{'' if key in own else '# '}{key} = {json.dumps(value)}  # {CHANNEL_KEYS[key].help}")
    lines += ["", "[model]", f'# model = "mine.npz"  # {KEYS["model"]["model"].help}', "", "[decision]"]
    lines.append(f'# coal_until = "30s"  # {KEYS["decision"]["coal_until"].help}')
    return "\n".join([*lines, ""])


def _plain(name: str, number: int) -> str:
    """Return a name that a site file takes."""
    text = "".join(sign for sign in name if sign.isprintable() and sign not in f'{_DIVIDERS}"\\')[:_LONGEST_NAME]
    return text.strip() or f"channel {number}"


def _all_keys() -> list[str]:
    return [key for keys in KEYS.values() for key in keys]


def _meant(key: str, keys: Sequence[str]) -> str:
    meant = similar(key, keys)
    return f"; did you mean {meant[0]!r}?" if meant else "; check the spelling"
