"""Public datasets: a server of our own gives whole, cut, wrong or no files."""

from __future__ import annotations

import hashlib
import re
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseRequestHandler, ThreadingTCPServer
from urllib.parse import unquote

import pytest

from cgid.cli.main import run
from cgid.errors import BadData, CannotCreate, NoInput
from cgid.recordings import public

CONTENT = {"data/6mm/a b.txt": b"first " * 400, "data/10mm/c.txt": b"second " * 300}


@pytest.fixture
def one(monkeypatch):
    files = tuple(
        public.PublicFile(path, len(content), hashlib.sha256(content).hexdigest()) for path, content in CONTENT.items()
    )
    monkeypatch.setattr(public.PublicData, "files", property(lambda self: files))
    return "steel-balls"


@pytest.fixture
def server():
    """Yield an address and the answers of the server there: path -> content, or a status; `asked` lists the paths."""
    answers, asked = dict(CONTENT), []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            path = unquote(self.path.removeprefix("/"))
            asked.append(path)
            answer = answers.get(path, 404)
            if isinstance(answer, int):
                self.send_error(answer)
                return
            if isinstance(answer, str):
                self.send_response(302)
                self.send_header("Location", answer)
                self.end_headers()
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(CONTENT[path]) if "cut" in answers else len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as own:
        thread = threading.Thread(target=own.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{own.server_address[1]}", answers, asked
        own.shutdown()
        thread.join()


def test_files_are_written_and_kept(one, server, tmp_path):
    address, _, asked = server
    done = []
    folder = public.fetch(one, tmp_path, mirror=address + "/", progress=done.append)
    assert folder == tmp_path / one
    assert (folder / "6mm" / "a b.txt").read_bytes() == CONTENT["data/6mm/a b.txt"]
    assert (folder / "10mm" / "c.txt").read_bytes() == CONTENT["data/10mm/c.txt"]
    assert sum(done) == sum(map(len, CONTENT.values())) and len(asked) == 2
    (folder / "10mm" / "c.txt").unlink()
    public.fetch(one, tmp_path, mirror=address)
    assert asked[2:] == ["data/10mm/c.txt"]


@pytest.mark.parametrize(
    ("change", "error", "says"),
    [
        ({"data/6mm/a b.txt": b"other " * 400}, BadData, "has changed, its SHA-256 must begin with"),
        ({"data/6mm/a b.txt": b"first " * 401}, BadData, "has changed"),
        ({"data/6mm/a b.txt": b"first " * 40, "cut": b""}, BadData, "must have 2400 bytes, got 240"),
        ({"data/6mm/a b.txt": 404}, NoInput, "the server answers 404 Not Found"),
        ({"data/6mm/a b.txt": 503}, NoInput, "the server answers 503"),
    ],
)
def test_what_arrives_is_checked(one, server, tmp_path, change, error, says):
    address, answers, _ = server
    answers |= change
    with pytest.raises(error, match=re.escape(says)) as caught:
        public.fetch(one, tmp_path, mirror=address)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.rglob("*.txt"))


@pytest.mark.parametrize("dripped", ["head", "body"])
def test_server_that_drips_is_given_up(one, tmp_path, monkeypatch, dripped):
    monkeypatch.setattr(public, "TIMEOUT", 0.3)
    monkeypatch.setattr(public, "MIN_RATE", 1e9)
    ended = threading.Event()

    class Dripping(BaseRequestHandler):
        def handle(self):
            self.request.recv(65536)
            head = b"HTTP/1.0 200 OK\r\n" + b"Content-Length: 2400\r\n\r\n" * (dripped == "body")
            self.request.sendall(head)
            while not ended.wait(0.05):  # each byte is in time
                self.request.sendall(b"a")

    with ThreadingTCPServer(("127.0.0.1", 0), Dripping) as own:
        threading.Thread(target=own.serve_forever, daemon=True).start()
        try:
            with pytest.raises(NoInput, match="2400 bytes"):
                public.fetch(one, tmp_path, mirror=f"http://127.0.0.1:{own.server_address[1]}")
        finally:
            ended.set()
            own.shutdown()
    assert not list(tmp_path.rglob("*.txt"))


def test_another_file_is_not_replaced(one, server, tmp_path):
    address, _, asked = server
    own = tmp_path / one / "6mm" / "a b.txt"
    own.parent.mkdir(parents=True)
    own.write_text("my notes")
    with pytest.raises(CannotCreate, match="exists already and is not the public file"):
        public.fetch(one, tmp_path, mirror=address)
    assert own.read_text() == "my notes" and not asked


def test_no_redirect_leaves_the_web(one, server, tmp_path, monkeypatch):
    monkeypatch.setattr(public, "TIMEOUT", 1.0)
    address, answers, _ = server
    with socket.create_server(("127.0.0.1", 0)) as other:
        answers["data/6mm/a b.txt"] = f"ftp://127.0.0.1:{other.getsockname()[1]}/a"
        with pytest.raises(NoInput, match="302"):
            public.fetch(one, tmp_path, mirror=address)
        other.setblocking(False)
        with pytest.raises(BlockingIOError):  # nobody has called
            other.accept()


def test_the_list_is_whole(capsys):
    assert run(["fetch"]) == 0
    out = capsys.readouterr().out
    for name, data in public.PUBLIC.items():
        assert f"{name}: " in out and data.licence in out
        assert re.fullmatch("[0-9a-f]{40}", data.commit) and len(data.files) > 0
        for file in data.files:
            assert re.fullmatch("[0-9a-f]{64}", file.sha256) and 0 < file.size < 2e6
            assert not file.path.startswith("/") and ".." not in file.path
    assert "99 files, 7.6 MB, MIT" in out
