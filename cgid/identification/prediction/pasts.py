"""The own pasts of channels, in a file beside that of their site: restarts keep them, only a person renews them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from cgid._lib.files import read_regular, write_whole
from cgid._lib.spelling import spelled
from cgid.errors import BadData, CgidError
from cgid.identification.prediction.explanation import Past
from cgid.identification.prediction.findings import Finding

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.recordings.site import Site

#: Largest file [bytes]: thousands of channels.
_MAX_SIZE = 32 << 20


class Pasts:
    """The references of channels, each of one model and sampling rate [Hz].

    A file that is damaged is told, not used, and stays until the references are taken anew, by `renew`. Without a
    `path` they are kept in memory.
    """

    def __init__(self, path: Path | None, model: StoredModel, sampling_rate: float, *, renew: bool = False) -> None:
        self._path, self._model, self.renews, self._is_damaged = path, model, renew, False
        self._key = {"model": model.identity, "rate_Hz": sampling_rate}
        self._others: list[Any] = []
        self._known: dict[str, Past] = {}
        self._told: list[Finding] = []
        if path is None or not path.exists():
            return
        try:
            self._read(path)
        except CgidError as error:
            self._others, self._known, self._is_damaged = [], {}, not renew
            self._say(f"{error}; it is not used, look at the sensors and give {spelled('renew')}")
        if renew and self._known:
            self._say(f"{path}: the past of {', '.join(self._known)} is replaced by the next impacts")

    @classmethod
    def of_site(cls, site: Site, model: StoredModel, sampling_rate: float, *, renew: bool = False) -> Self:
        """Return those of a site: of face.toml, face.past.json."""
        path = Path(site.path).with_suffix(".past.json") if site.path else None
        return cls(path, model, sampling_rate, renew=renew)

    def of(self, channel: str) -> Past | None:
        """Return the reference of a channel, if it has one of this model and rate."""
        return None if self.renews else self._known.get(channel)

    def keep(self, channel: str, past: Past | None) -> None:
        """Keep a reference that is new, in the file as well."""
        if past is None or past is self._known.get(channel):
            return
        self._known[channel] = past
        if self._path is None or self._is_damaged:
            return
        own = [{"channel": name, **self._key, **one.to_json()} for name, one in self._known.items()]
        try:
            write_whole(self._path, json.dumps({"pasts": self._others + own}, indent=0).encode())
        except CgidError as error:
            self._say(f"{error}; the past of channel {channel} ends with this run")

    def _say(self, text: str) -> None:
        self._told.append(Finding(kind="past", fields={"text": text}))

    def take_told(self) -> list[Finding]:
        """Return what there is to say since the last call."""
        told, self._told = self._told, []
        return told

    def _read(self, path: Path) -> None:
        raw = read_regular(path, "the past of channels", _MAX_SIZE)
        try:
            content = json.loads(raw)
            for one in content["pasts"]:
                if {name: one[name] for name in self._key} != self._key:
                    self._others.append(one)
                else:
                    self._known[str(one["channel"])] = Past.from_json(one, self._model)
        except CgidError as error:
            raise BadData(f"{path}: {error}") from None
        except (ValueError, TypeError, KeyError, RecursionError):
            raise BadData(f"{path}: the past of channels must be as cgid monitor wrote it, it is damaged") from None
