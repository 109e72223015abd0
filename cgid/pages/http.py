"""An HTTP server for pages of this machine: who asks is checked before what is asked, and nothing is from elsewhere."""

from __future__ import annotations

import hmac
import json
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from cgid.errors import CgidError, WriteFailed
from cgid.pages.server import Address, Server

#: Time for a request and its response [s], and largest body of a request [bytes].
TIMEOUT, MAX_BODY = 10.0, 4096
HTML, JSON, TEXT = "text/html; charset=utf-8", "application/json", "text/plain; charset=utf-8"
#: Type of a file that a page loads, by its ending.
_TYPES = {".css": "text/css; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".html": HTML, ".json": JSON}
#: Nothing is loaded from other sites, nothing runs that is not a file of this server, and no other page may embed it.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
#: Header with the key of a page.
KEY = "X-Cgid-Key"


class PageAnswer(NamedTuple):
    """What is sent back."""

    content: bytes
    kind: str = TEXT
    status: int = 200


class Request(NamedTuple):
    """What is asked: the values of the query, and the object of a POST."""

    query: dict[str, str]
    body: dict[str, Any]


class Route(NamedTuple):
    """The answer of one path; with `secret` only to who has the key, with `posts` only to a POST."""

    answer: Callable[[Request], PageAnswer]
    secret: bool = False
    posts: bool = False


class Refused(Exception):
    """A request that is not answered: its status and why."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


def of_bytes(make: Callable[[], bytes], kind: str) -> Route:
    """Return the route of a content that everybody may have."""
    return Route(lambda _: PageAnswer(make(), kind))


def of_file(path: Path) -> Route:
    """Return the route of a file that a page loads."""
    return of_bytes(lambda: _content(path), _TYPES[path.suffix])


@cache
def _content(path: Path) -> bytes:
    return path.read_bytes()


def of_json(content: Any, status: int = 200) -> PageAnswer:
    """Return an object as an answer; numbers that are not finite are null."""
    return PageAnswer(json.dumps(content, allow_nan=False, separators=(",", ":")).encode(), JSON, status)


#: Files that pages share: colours, and what they draw.
COMMON = {f"/{name}": of_file(Path(__file__).parent / name) for name in ("common.css", "common.js")}


class HttpServer(Server):
    """Serve a few paths; on a loopback address only under loopback names, and with a `key` only its own page."""

    def __init__(
        self,
        setting: str,
        address: Address,
        routes: Mapping[str, Route],
        warn: Callable[[str], None],
        key: str | None = None,
    ) -> None:
        class Handler(BaseHTTPRequestHandler):
            server_version, sys_version = "cgid", ""
            default_request_version = "HTTP/1.0"  # an answer to HTTP/0.9, or to nonsense, would have no headers

            def parse_request(self) -> bool:
                """Read the head of a request, and refuse who may not ask, whatever is asked."""
                if not super().parse_request():
                    return False
                try:
                    self._require_known()
                except Refused as error:
                    self._send(PageAnswer(f"{error}\n".encode(), TEXT, error.status))
                    return False
                return True

            def _answer(self) -> None:
                """Answer one request."""
                try:
                    found = self._found()
                except Refused as error:
                    found = PageAnswer(f"{error}\n".encode(), TEXT, error.status)
                except CgidError as error:
                    found = of_json({"error": str(error)}, 507 if isinstance(error, WriteFailed) else 409)
                self._send(found)

            def _send(self, found: PageAnswer) -> None:
                self.send_response(found.status)
                self.send_header("Content-Type", found.kind)
                self.send_header("Content-Length", str(len(found.content)))
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(found.content)

            def _found(self) -> PageAnswer:
                path, _, query = self.path.partition("?")
                route = routes.get(path)
                if route is None:
                    raise Refused(404, "nothing here")
                if (self.command == "POST") != route.posts:
                    raise Refused(405, "this path takes another method")
                if route.secret and key is not None:
                    given = self.headers.get_all(KEY, [])
                    if len(given) != 1 or not hmac.compare_digest(given[0].encode(), key.encode()):
                        raise Refused(403, "the address of this page lacks its key: open the one that cgid printed")
                body = self._body() if route.posts else {}
                return route.answer(Request(dict(parse_qsl(query, max_num_fields=20)), body))

            def _require_known(self) -> None:
                """Raise unless the host is of this machine and, with a key, the page is of this server, if any."""
                listening: Any = self.server.server_address
                hosts = self.headers.get_all("Host", [])
                if _is_loopback(listening[0]) and not all(_is_loopback(_host(one), address.host) for one in hosts):
                    raise Refused(421, "this server answers loopback names only")
                if key is None:
                    return
                if len(hosts) != 1:
                    raise Refused(421, "a request must name one host")
                for origin in self.headers.get_all("Origin", []):
                    if origin != f"http://{hosts[0]}":
                        raise Refused(403, "requests of other pages are not answered")
                for site in self.headers.get_all("Sec-Fetch-Site", []):
                    if site not in ("same-origin", "none"):
                        raise Refused(403, "requests of other sites are not answered")

            def _body(self) -> dict[str, Any]:
                if self.headers.get_content_type() != JSON or "Transfer-Encoding" in self.headers:
                    raise Refused(415, f"a body must be of {JSON}, with its length")
                length = str(self.headers.get("Content-Length", ""))
                if not re.fullmatch("[0-9]{1,9}", length):
                    raise Refused(411, "a body must state its length")
                if int(length) > MAX_BODY:
                    raise Refused(413, f"a body must be of {MAX_BODY} bytes at most")
                try:
                    content = json.loads(self.rfile.read(int(length)))
                except (ValueError, RecursionError):
                    content = None
                if not isinstance(content, dict):
                    raise Refused(400, "a body must be an object")
                return content

            def end_headers(self) -> None:
                """Add the headers of every answer, also of errors that `http.server` finds."""
                self.send_header("Content-Security-Policy", POLICY)
                self.send_header("X-Content-Type-Options", "nosniff")
                self.send_header("Referrer-Policy", "no-referrer")
                self.send_header("Cross-Origin-Resource-Policy", "same-origin")
                self.send_header("Cache-Control", "no-store")
                super().end_headers()

            do_GET = do_HEAD = do_POST = _answer  # noqa: N815 - names that http.server looks for

            def log_message(self, *_: Any) -> None:
                """Log nothing."""

        super().__init__(setting, address, Handler, TIMEOUT, warn)

    @property
    def port(self) -> int:
        """Port that it listens on."""
        return int(self._listener.server_address[1])


def _host(header: str) -> str:
    """Return the name in a Host header, without its port."""
    match = re.fullmatch(r"\[(.*)\](?::\d*)?|([^:]*)(?::\d*)?", header.strip())
    return (match[1] or match[2] or "") if match else header.strip()


def _is_loopback(name: str, given: str = "localhost") -> bool:
    """Return whether a name or an address is of this machine alone: a loopback one, or the one `given`."""
    with suppress(ValueError):
        return ip_address(name).is_loopback
    return name.lower() in ("localhost", given.lower())
