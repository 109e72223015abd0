"""Public recordings of real impacts, downloaded by name on request.

Each file has an address at a pinned commit, a size and a SHA-256; all three were taken from a copy of the repository.
The files are listed in `datasets/public.csv`.
"""

from __future__ import annotations

import csv
import hashlib
import http.client
import posixpath
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from threading import Thread
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from cgid import shipped
from cgid._lib import validation
from cgid._lib.files import looking_at, write_whole
from cgid._lib.spelling import spelled
from cgid.errors import BadData, CannotCreate, InvalidValue, NoInput

__all__ = ["PublicData", "fetch"]

#: Timeout of a response [s], and minimum rate of a download [bytes/s].
TIMEOUT, MIN_RATE = 30.0, 5e3
#: Address at which GitHub serves files of a commit.
_GITHUB = "https://raw.githubusercontent.com"


def _hint() -> str:
    return f"check the connection, or give {spelled('mirror')} with the address of a copy"


@dataclass(frozen=True)
class PublicFile:
    """A file of a public dataset."""

    path: str  # in the repository
    size: int  # [bytes]
    sha256: str


@dataclass(frozen=True)
class PublicData:
    """A public dataset.

    Attributes
    ----------
    name : str
    repository, commit : str
        On GitHub.
    licence : str
    content, good_for : str
        What it contains and its uses.
    """

    name: str
    repository: str
    commit: str
    licence: str
    content: str
    good_for: str

    @property
    def base(self) -> str:
        """Address before the paths of files."""
        return f"{_GITHUB}/{self.repository}/{self.commit}"

    @property
    def files(self) -> tuple[PublicFile, ...]:
        """The files, from `datasets/public.csv`."""
        with shipped.path_of("datasets", "public.csv").open(newline="", encoding="utf-8") as lines:
            rows = [row for row in csv.DictReader(lines) if row["dataset"] == self.name]
        return tuple(PublicFile(row["path"], int(row["size"]), row["sha256"]) for row in rows)

    @property
    def size(self) -> int:
        """Size of all files [bytes]."""
        return sum(file.size for file in self.files)


_ALL = (
    PublicData(
        "steel-balls",
        "hui30319/Analysis-of-Impact-Echo-Time-Signals-by-Deep-Learning",
        "f3230a1a271a7249f9a494840facc533ed04a55c",
        "MIT",
        "99 impacts of steel balls of 6 and 10 mm on concrete: displacement near the impact, 625 kHz, 5 ms",
        "contact times and sizes of impactors on real signals (benchmarks/identification/steel_balls.py)",
    ),
    PublicData(
        "bulk-ramp",
        "spatialaudio/classification_exercise",
        "b39dee8a81f189560571819c439284025143533d",
        "CC BY 4.0",
        "20 recordings of nuts, screws and plastic spheres on an aluminium ramp: structure-borne sound, 44.1 kHz",
        "many overlapping impacts of known bodies: detection, windows, training on few recordings",
    ),
    PublicData(
        "shock",
        "High-Rate-SHM-Working-Group/Dataset-5-Extended-Impact-Testing",
        "1bbfcf17dfd78a09790aa092a5dc07e6a6bae628",
        "CC BY-SA 4.0",
        "4 drop-tower shocks: acceleration of the table and of a board on it, 50 kHz",
        "clean half-sine pulses for the fit, and the ringing that they excite",
    ),
    PublicData(
        "taps-pyfrf",
        "ladisk/pyFRF",
        "55431fd3c328ddc719232cc34b891291c9982a2e",
        "LGPL-3.0",
        "5 hammer taps at one place: measured force and one accelerometer, 25.6 kHz, 1 s each",
        "cgid tap and cgid invert beside a measured force (benchmarks/beam/real_taps.py)",
    ),
    PublicData(
        "taps-dagnn",
        "Mulllky/DAGNN-impact-force-identification",
        "91247f7a677137a471fa5e6ce2dbaeb755720173",
        "Apache-2.0",
        "2 hammer taps on a metal plate: measured force and four sensors, 10 kHz, 2 s each",
        "cgid invert through the modes of several sensors (benchmarks/beam/real_taps.py)",
    ),
)
#: Name -> dataset.
PUBLIC = {one.name: one for one in _ALL}


def fetch(
    name: str,
    folder: str | Path,
    *,
    mirror: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> Path:
    """Download a public dataset; existing files are checked and kept.

    Parameters
    ----------
    name : str
        One of `PUBLIC`.
    folder : str or Path
        Parent of the new folder of this name.
    mirror : str, optional
        Address to use instead of that of the commit, such as that of your own server.
    progress : callable, optional
        Called with the size of each finished file [bytes].

    Returns
    -------
    Path
        The folder of the dataset.

    Raises
    ------
    InvalidValue
        There is no such dataset, or the mirror is not an address of a web server.
    NoInput
        A file cannot be downloaded.
    BadData
        The download is truncated or has another checksum.
    CannotCreate
        Another file has the name, or the folder cannot be created.
    WriteFailed
        The disk is full.
    """
    validation.choice("dataset", name, tuple(PUBLIC))
    data = PUBLIC[name]
    base = data.base if mirror is None else mirror.rstrip("/")
    _require_address(base)
    target = Path(folder) / name
    top = len(PurePosixPath(posixpath.commonpath([posixpath.dirname(file.path) for file in data.files])).parts)
    for file in data.files:
        path = target.joinpath(*PurePosixPath(file.path).parts[top:])
        with looking_at(path):
            there = path.exists()
        if there:
            _check_cached(path, file)
        else:
            content = _downloaded(f"{base}/{quote(file.path)}", file)
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise CannotCreate(f"{path.parent}: the folder cannot be made: {error.strerror or error}") from None
            write_whole(path, content, overwrite=False)
        if progress is not None:
            progress(file.size)
    return target


def _require_address(base: str) -> None:
    """Raise `InvalidValue` if a mirror is not a web address, or contains a password, which would not be used."""
    try:
        address = urlsplit(base)
        scheme, host, user = address.scheme, address.hostname, address.username
        _ = address.port  # raises, too
    except ValueError as error:
        raise InvalidValue(
            f"mirror must be an address such as http://[::1]:8000/copy, got {base!r} ({error})"
        ) from None
    if user is not None:
        raise InvalidValue("mirror must have no user and password, which are not used; leave them out of the address")
    if scheme not in ("https", "http") or not host:
        raise InvalidValue(f"mirror must be an address that begins with https:// or http://, got {base!r}")


def _check_cached(path: Path, file: PublicFile) -> None:
    """Raise `CannotCreate` if the existing file is another one."""
    if not path.is_file() or path.stat().st_size != file.size or _sum(path.read_bytes()) != file.sha256:
        raise CannotCreate(f"{path}: exists already and is not the public file; move it, or choose another folder")


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _downloaded(address: str, file: PublicFile) -> bytes:
    """Return a file, or raise `NoInput` if it takes too long: a server may send a byte now and then for days."""
    timeout = TIMEOUT + file.size / MIN_RATE
    results: list[bytes | Exception] = []

    def transfer() -> None:
        try:
            results.append(_transferred(address, file))
        except Exception as error:
            results.append(error)

    thread = Thread(target=transfer, daemon=True)  # names, handshakes and headers have no limit of their own
    thread.start()
    thread.join(timeout)
    if not results:
        raise NoInput(f"{address}: {file.size} bytes must arrive within {timeout:.3g} s, and did not; {_hint()}")
    if isinstance(results[0], Exception):
        raise results[0]
    return results[0]


class _Redirects(HTTPRedirectHandler):
    """Follows redirects to web addresses only."""

    def redirect_request(self, req: Request, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Request | None:
        is_web = urlsplit(newurl).scheme in ("http", "https")
        return super().redirect_request(req, fp, code, msg, headers, newurl) if is_web else None


def _transferred(address: str, file: PublicFile) -> bytes:
    try:
        with build_opener(_Redirects).open(Request(address, headers={"User-Agent": "cgid"}), timeout=TIMEOUT) as answer:
            content = bytes(answer.read(file.size + 1))  # no more than that, whatever a server sends
    except HTTPError as error:
        error.close()
        answer = f"the server answers {error.code} {validation.cut(str(error.reason))}"
        raise NoInput(f"{address}: cannot be downloaded, {answer}; {_hint()}") from None
    except http.client.IncompleteRead as error:
        content = error.partial
    except (OSError, URLError, http.client.HTTPException, ValueError) as error:
        reason = getattr(error, "reason", None) or error
        raise NoInput(f"{address}: cannot be downloaded: {validation.cut(str(reason))}; {_hint()}") from None
    if len(content) < file.size:
        raise BadData(f"{address}: must have {file.size} bytes, got {len(content)}; run the command again")
    if len(content) != file.size or _sum(content) != file.sha256:
        raise BadData(
            f"{address}: has changed, its SHA-256 must begin with {file.sha256[:12]}, got {_sum(content)[:12]}; "
            f"nothing was written, give {spelled('mirror')} with the address of an intact copy"
        )
    return content
