"""`cgid label`: no label is lost, nobody else is answered, and what the page shows is what the recording says."""

from __future__ import annotations

import csv
import http.client
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from cgid.cli import main
from cgid.errors import BadData, CannotCreate, WriteFailed
from cgid.identification.training.manifest import read_manifest
from cgid.labelling.page import words
from cgid.labelling.table import LabelTable
from cgid.pages.http import POLICY
from tests.test_labels import RATE, rung

ROOT = Path(__file__).parents[1]
ROW = {"path": "a.npy", "start_s": "0.5", "end_s": "0.6", "time_s": "0.502"}


def rows_of(path: Path, separator: str = ",") -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        return list(csv.DictReader(file, delimiter=separator))


# -- the table ----------------------------------------------------------------------------------------------


def test_a_label_is_in_the_journal_before_the_table(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    table = LabelTable(path)
    table.add([dict(ROW), {**ROW, "time_s": "1.5", "start_s": "1.4", "end_s": "1.6"}])
    table.label(dict(ROW), "coal", "Anna", "random")
    assert not path.exists()
    assert json.loads(table.journal.read_text().splitlines()[-1])["row"]["label"] == "coal"
    os.close(os.dup(table._stream))
    os.close(table._stream)  # as if killed: nothing is written any more
    again = LabelTable(path)
    again.flush()
    (row,) = rows_of(path)  # the other row was only in memory, the page finds it again
    assert (row["label"], row["by"], row["chosen"], row["time_s"]) == ("coal", "Anna", "random", "0.502")
    n_lines = len(again.journal.read_text().splitlines())
    again.close()
    third = LabelTable(path)
    third.flush()
    assert len(third.journal.read_text().splitlines()) == n_lines  # nothing to write
    assert read_manifest(path).annotations[0].chosen == "random"
    third.close()


@pytest.mark.parametrize("cut", [1, 5, 40])
def test_a_line_of_the_journal_that_was_cut_off_is_left_out(cut: int, tmp_path: Path) -> None:
    table = LabelTable(tmp_path / "t.csv")
    table.label(dict(ROW), "coal", "", "random")
    table.label({**ROW, "time_s": "0.9"}, "gangue", "", "random")
    os.close(table._stream)
    content = table.journal.read_bytes()
    table.journal.write_bytes(content[:-cut])
    again = LabelTable(tmp_path / "t.csv")
    again.label({**ROW, "time_s": "1.2"}, "coal", "", "picked")
    again.close()
    assert [row["label"] for row in rows_of(tmp_path / "t.csv")] == ["coal", "coal"]


@pytest.mark.parametrize(
    "line", ["null", "[]", "5", '"a"', '{"row":[]}', '{"row":{"path":1}}', '{"written":[]}', "[" * 9999]
)
def test_a_line_of_the_journal_of_another_shape_is_left_out(line: str, tmp_path: Path) -> None:
    table = LabelTable(tmp_path / "t.csv")
    table.label(dict(ROW), "coal", "", "random")
    os.close(table._stream)
    table.journal.write_text(f"{line}\n{table.journal.read_text()}{line}\n")
    again = LabelTable(tmp_path / "t.csv")
    again.close()
    assert [row["label"] for row in rows_of(tmp_path / "t.csv")] == ["coal"]


def test_what_others_write_is_kept(tmp_path: Path) -> None:
    """A table with semicolons, decimal commas, comments, own columns and rows that are twice; changed meanwhile."""
    path = tmp_path / "t.csv"
    text = "# our table\nWetter;path;start_s;end_s;label;time_s;note\nRegen;a.npy;0,5;0,6;;0,502;x\n"
    text += 2 * ";b.wav;;;coal;;\n"
    path.write_text(text, encoding="utf-8-sig")
    table = LabelTable(path)
    table.label({"path": "a.npy", "time_s": "0.502"}, "gangue", "Bo", "random")
    table.label({"path": "a.npy", "start_s": "1.000000", "end_s": "2.500000"}, "coal", "Bo", "stretch")
    table.flush()
    assert path.read_text(encoding="utf-8-sig").startswith("# our table\n") and path.read_bytes()[:3] == b"\xef\xbb\xbf"
    first, *others = rows_of_comments(path)
    assert (first["Wetter"], first["label"], first["time_s"], first["start_s"], first["note"]) == (
        "Regen",
        "gangue",
        "0,502",
        "0,5",
        "x",
    )
    assert [row["path"] for row in others] == ["b.wav", "b.wav", "a.npy"]
    assert (others[-1]["start_s"], others[-1]["end_s"], others[-1]["label"]) == ("1,000000", "2,500000", "coal")
    # A spreadsheet that was opened before all this writes its own: a new label of its own, and the old ones.
    stale = (
        path.read_text(encoding="utf-8-sig")
        .replace("gangue", "")
        .replace(";coal;Bo;stretch", ";;;")
        .replace("Regen", "Sonne")
    )
    path.write_text(stale.replace("b.wav;;;coal", "b.wav;;;slate", 1), encoding="utf-8-sig")
    table.label({"path": "a.npy", "time_s": "3"}, "coal", "Bo", "random")
    table.close()
    first, second, third, stretch, last = rows_of_comments(path)
    assert (first["Wetter"], first["label"], second["label"], third["label"]) == ("Sonne", "gangue", "slate", "coal")
    assert (stretch["label"], last["label"]) == ("coal", "coal")


def rows_of_comments(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines, delimiter=";"))


def test_a_stretch_is_taken_away_by_undo(tmp_path: Path) -> None:
    stretch = {"path": "a.npy", "start_s": "1.000000", "end_s": "2.000000"}
    table = LabelTable(tmp_path / "t.csv")
    table.label(stretch, "coal", "", "stretch")
    table.flush()
    table.label(stretch, "", "", "")
    table.close()
    assert rows_of(tmp_path / "t.csv") == []
    assert LabelTable(tmp_path / "t.csv").rows == {}


def test_a_table_that_cannot_be_read_is_not_replaced(tmp_path: Path) -> None:
    table = LabelTable(tmp_path / "t.csv")
    table.label(dict(ROW), "coal", "", "random")
    table.flush()
    (tmp_path / "t.csv").write_bytes(b"\xff\xfe\x00 a spreadsheet's own format")
    table.label({**ROW, "time_s": "7"}, "gangue", "", "random")
    table.flush()
    assert "must be UTF-8" in table.problem and "safe in t.csv.journal" in table.problem
    assert (tmp_path / "t.csv").read_bytes().startswith(b"\xff\xfe")
    (tmp_path / "t.csv").unlink()
    table.close()
    assert [row["label"] for row in rows_of(tmp_path / "t.csv")] == ["coal", "gangue"]


def test_two_processes_do_not_label_one_table(tmp_path: Path) -> None:
    table = LabelTable(tmp_path / "t.csv")
    with pytest.raises(CannotCreate, match="one cgid label at a time, another one has it"):
        LabelTable(tmp_path / "t.csv")
    table.close()
    LabelTable(tmp_path / "t.csv").close()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("path,label\na,b,c\n", "row 2"),
        ("time_s,peak\n1,2\n", "columns path and label"),
        ("path,label\n,coal\n", "path must be"),
    ],
)
def test_a_table_that_is_none_is_one_line(content: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(content)
    with pytest.raises(BadData, match=says):
        LabelTable(tmp_path / "t.csv")
    (tmp_path / "t.csv").write_text("path,label\n")
    LabelTable(tmp_path / "t.csv").close()  # the lock was given back


def test_a_full_disk_takes_no_label_and_loses_none(tmp_path: Path) -> None:
    """By the limit of the size of a file, for which the system has the same answer."""
    table = LabelTable(tmp_path / "t.csv")
    answered, limits = [], resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))
        for number in range(60):
            try:
                table.label({**ROW, "time_s": f"{number}"}, "coal", "", "random")
                answered.append(f"{number}")
            except WriteFailed as error:
                assert "free some space" in str(error)
            table.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert 5 < len(answered) < 60
    os.close(table._stream)
    again = LabelTable(tmp_path / "t.csv")
    again.label({**ROW, "time_s": "100"}, "coal", "", "random")
    again.close()
    assert {row["time_s"] for row in rows_of(tmp_path / "t.csv")} == {*answered, "100"}


def test_a_hundred_thousand_rows_are_labelled_in_time(tmp_path: Path) -> None:
    lines = "".join(f"a.npy,{k}.0,{k}.5,,{k}.1\n" for k in range(100_000))
    (tmp_path / "t.csv").write_text("path,start_s,end_s,label,time_s\n" + lines)
    table = LabelTable(tmp_path / "t.csv")
    table.label({"path": "a.npy", "time_s": "77777.1"}, "coal", "", "random")
    table.close()
    assert (tmp_path / "t.csv").read_text().count("coal") == 1
    assert len(rows_of(tmp_path / "t.csv")) == 100_000


# -- the server ---------------------------------------------------------------------------------------------


class Page:
    """A page that runs in a process of its own."""

    opened: ClassVar[list[subprocess.Popen[str]]] = []

    def __init__(self, folder: Path, *options: str, program: Sequence[str] = (sys.executable, "-m", "cgid")) -> None:
        command = [*program, "label", "a.npy", "--rate", str(RATE), "--unit", "g", *options]
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        self.opened.append(self.process)
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        assert line.startswith("http://127.0.0.1:"), (line, self.process.stderr and self.process.stderr.read())
        self.port, self.key = int(line.split(":")[2].split("/")[0]), line.split("#")[1]

    def ask(
        self, path: str, body: Any = None, method: str | None = None, **headers: str
    ) -> tuple[int, Any, http.client.HTTPMessage]:
        client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        given = {"X-Cgid-Key": self.key} | ({} if body is None else {"Content-Type": "application/json"})
        given |= {name.replace("_", "-"): value for name, value in headers.items()}
        content = json.dumps(body).encode() if isinstance(body, dict) else body
        given = {name: value for name, value in given.items() if value is not None}
        client.request(method or ("GET" if body is None else "POST"), path, content, given)
        answer = client.getresponse()
        raw = answer.read()
        client.close()
        return (
            answer.status,
            json.loads(raw) if answer.headers["Content-Type"] == "application/json" else raw,
            answer.headers,
        )

    def get(self, path: str) -> Any:
        status, content, _ = self.ask(f"/api/{path}")
        assert status == 200, content
        return content

    def post(self, path: str, **body: Any) -> Any:
        return self.ask(f"/api/{path}", body)[:2]

    def wait(self, ready: Callable[[Any], bool], seconds: float = 60.0) -> Any:
        ends = time.monotonic() + seconds
        while not ready(state := self.get("state")):
            assert time.monotonic() < ends, state
            time.sleep(0.1)
        return state

    def end(self, how: int = signal.SIGINT) -> str:
        self.process.send_signal(how)
        _, err = self.process.communicate(timeout=20)
        return err


@pytest.fixture(scope="module", autouse=True)
def no_page_is_left() -> Iterator[None]:
    """End the pages of tests that failed."""
    yield
    for process in Page.opened:
        if process.poll() is None:
            process.kill()
            process.communicate()


def ended(state: Any) -> bool:
    return all(one["ended"] for one in state["recordings"])


def learned(state: Any) -> int:
    """Number of rows of the latest new model: on a busy machine an earlier one may know some of the labels only."""
    return int(state["learning"]["results"].get("new", {"n": 0})["n"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], np.ndarray]:
    folder = tmp_path_factory.mktemp("page")
    samples, labels, onsets = rung(8)
    np.save(folder / "a.npy", samples)
    return folder, labels, onsets


@pytest.fixture(scope="module")
def page(site: Any) -> Iterator[Page]:
    opened = Page(site[0])
    opened.wait(ended)
    yield opened
    opened.end()
    assert opened.process.returncode == 0  # Ctrl-C is how it ends


def test_impacts_of_the_page_are_those_of_events(site: Any, page: Page) -> None:
    folder, _, onsets = site
    found = page.get("impacts?r=0")["impacts"]
    assert [one[1] for one in found] == pytest.approx(onsets.tolist(), abs=2e-3)
    assert (
        main(
            [
                "events",
                str(folder / "a.npy"),
                "--rate",
                "10000",
                "--unit",
                "g",
                "-o",
                str(folder / "e.csv"),
                "--overwrite",
            ]
        )
        == 0
    )
    assert [one[1] for one in found] == pytest.approx(
        [float(row["time_s"]) for row in rows_of(folder / "e.csv")], abs=1e-3
    )
    assert page.get("impacts?r=0&since=9999")["impacts"] == []


def test_a_view_is_the_least_and_largest_at_any_zoom(site: Any, page: Page) -> None:
    samples = np.load(site[0] / "a.npy")
    for start, end, n in ((0, 16.0, 200), (2.0, 2.5, 300), (2.0, 2.01, 1000), (0.0, 16.9, 2)):
        view = page.get(f"view?r=0&from={start}&to={end}&n={n}")
        edges = np.linspace(view["start"], view["end"], len(view["channels"][0]["low"]) + 1)
        for row, channel in zip(samples, view["channels"], strict=True):
            first, last = round(view["start"] * RATE), round(view["end"] * RATE)
            part, scale = row[first:last], channel["scale"]
            assert min(channel["low"]) * scale == pytest.approx(part.min(), abs=2 * scale)
            assert max(channel["high"]) * scale == pytest.approx(part.max(), abs=2 * scale)
            middle = len(channel["low"]) // 2
            a, b = round(edges[middle] * RATE), max(round(edges[middle + 1] * RATE), round(edges[middle] * RATE) + 1)
            step = b - a
            around = row[max(a - step, 0) : b + step]
            assert (
                around.min() - scale
                <= channel["low"][middle] * scale
                <= channel["high"][middle] * scale
                <= around.max() + scale
            )
    detail = page.get("impact?r=0&k=5")
    time_of = page.get("impacts?r=0")["impacts"][5][1]
    first = round((time_of + detail["start"]) * RATE)
    channel = page.get("impacts?r=0")["impacts"][5][2]
    assert np.multiply(detail["samples"], detail["scale"]) == pytest.approx(
        samples[channel, first : first + len(detail["samples"])], abs=detail["scale"]
    )
    loudest = detail["frequency"][int(np.argmax(detail["level"]))]
    assert min(abs(loudest - 700), abs(loudest - 1900)) < 60
    status, sound, _ = page.ask("/api/sound?r=0&k=5")
    assert status == 200 and np.abs(np.frombuffer(sound, "<f4")).max() == pytest.approx(0.9, abs=1e-3)


def test_ten_minutes_of_a_new_user(site: Any, tmp_path: Path) -> None:
    """Label by key and by stretch, see the accuracy, save the model: the same as train makes of the table."""
    folder, labels, onsets = site
    (tmp_path / "a.npy").write_bytes((folder / "a.npy").read_bytes())
    page = Page(tmp_path)
    page.wait(ended)
    chosen = np.random.default_rng(1).permutation(38)[:30].tolist()
    for k in chosen:
        assert page.post("label", r=0, k=k, label=labels[k], by="Anna", chosen="random")[0] == 200
    # What falls in the last second is known by a stretch.
    assert page.post("label", r=0, **{"from": 15.4, "to": 16.5}, label=labels[-1], chosen="stretch")[0] == 200
    assert page.post("label", r=0, k=0, label="", chosen="unsure")[0] == 200
    known = {*chosen, *np.flatnonzero(onsets > 15.4).tolist()} - {0}
    state = page.wait(lambda state: learned(state) == 2 * len(known))  # both channels hear each rock
    assert state["recordings"][0]["done"] == len(known) + 1
    assert state["n_unsure"] == 1 and state["learning"]["results"]["new"]["text"].startswith("right on ")
    assert page.post("save", which="new") == (200, {"saved": ["labels.md", "labels.npz"]})
    page.end()
    rows = rows_of(tmp_path / "labels.csv")
    assert sum(row["chosen"] == "random" and row["by"] == "Anna" for row in rows) in (29, 30)
    assert main(["train", str(tmp_path / "labels.csv"), "-o", str(tmp_path / "again.npz")]) == 0
    assert (
        main(
            [
                "predict",
                str(tmp_path / "a.npy"),
                "--rate",
                "10000",
                "--unit",
                "g",
                "--model",
                str(tmp_path / "labels.npz"),
            ]
        )
        == 0
    )
    from cgid.identification.model.model import StoredModel

    first, second = (StoredModel.load(tmp_path / name) for name in ("labels.npz", "again.npz"))
    assert first.features == second.features and first.training["n_train"] == second.training["n_train"]
    for name, array in first.arrays.items():
        assert np.allclose(array, second.arrays[name], rtol=1e-9, atol=1e-12), name


@pytest.mark.long
def test_two_sensors_of_a_beam_are_one_row(site: Any, tmp_path: Path) -> None:
    folder, labels, onsets = site
    one, random = np.load(folder / "a.npy")[0], np.random.default_rng(4)
    noise = random.normal(0, 0.01 * np.std(one), (2, len(one)))
    np.save(tmp_path / "a.npy", np.stack([one, 0.6 * one + noise[0], np.roll(one, 900) + noise[1]], axis=1))
    page = Page(tmp_path, "--same-beam", "1+2")
    state = page.wait(ended)
    assert [part["name"] for part in state["recordings"]] == ["a.npy channel 1+2", "a.npy channel 3"]
    assert [len(part["channels"]) for part in state["recordings"]] == [2, 1]
    assert [one[1] for one in page.get("impacts?r=0")["impacts"]] == pytest.approx(onsets.tolist(), abs=4e-3)
    for k in range(len(labels)):
        assert page.post("label", r=0, k=k, label=labels[k], chosen="random")[0] == 200
    page.wait(lambda state: learned(state) == len(labels))
    # The impact of the other channel is another one, at another time.
    assert all(not impact[5] for impact in page.get("impacts?r=1")["impacts"])
    assert page.post("save", which="new")[0] == 200
    page.end()
    rows = [row for row in rows_of(tmp_path / "labels.csv") if row["label"]]
    assert {(row["channel"], row["same_beam"]) for row in rows} == {("1+2", "1+2")} and len(rows) == len(labels)
    assert main(["train", str(tmp_path / "labels.csv"), "-o", str(tmp_path / "again.npz")]) == 0
    from cgid.identification.model.model import StoredModel

    first, second = (StoredModel.load(tmp_path / name) for name in ("labels.npz", "again.npz"))
    assert list(first.training["same_beam"]) == ["1+2"] == list(second.training["same_beam"])
    assert first.training["n_train"] == second.training["n_train"] == len(labels)
    for name, array in first.arrays.items():
        assert np.allclose(array, second.arrays[name], rtol=1e-9, atol=1e-12), name
    again = Page(tmp_path, "--same-beam", "1+2")  # goes on with its table
    again.wait(ended)
    assert [impact[5] for impact in again.get("impacts?r=0")["impacts"]] == labels
    again.end()


REFUSED = [
    ("another host", 421, "/api/state", {"Host": "evil.example"}),
    ("a host that begins alike", 421, "/api/state", {"Host": "127.0.0.1.evil.example"}),
    ("another host, before the method", 421, "DELETE /api/state", {"Host": "evil.example"}),
    ("another origin", 403, "/api/state", {"Origin": "http://evil.example"}),
    ("another port of this machine", 403, "/api/state", {"Origin": "http://127.0.0.1:1"}),
    ("no origin", 403, "/api/state", {"Origin": "null"}),
    ("another site", 403, "/api/state", {"Sec-Fetch-Site": "cross-site"}),
    ("another port by fetch", 403, "/", {"Sec-Fetch-Site": "same-site"}),
    ("no key", 403, "/api/state", {"X-Cgid-Key": ""}),
    ("a wrong key", 403, "/api/state", {"X-Cgid-Key": "x" * 32}),
    ("a key in a cookie", 403, "/api/state", {"X-Cgid-Key": "", "Cookie": "key={key}"}),
    ("a path", 404, "/../../etc/passwd", {}),
    ("a path in code", 404, "/%2e%2e/%2e%2e/etc/passwd", {}),
    ("a file beside the page", 404, "/page.py", {}),
    ("a post of a view", 405, "POST /api/view?r=0&from=0&to=1", {}),
    ("a label by get", 405, "/api/label", {}),
    ("another method", 501, "PUT /api/label", {}),
    ("a recording that is none", 409, "/api/view?r=1&from=0&to=1", {}),
    ("a recording by name", 409, "/api/view?r=/etc/passwd&from=0&to=1", {}),
    ("a view that falls", 409, "/api/view?r=0&from=1&to=0", {}),
    ("a view of nan", 409, "/api/view?r=0&from=nan&to=1", {}),
    ("a view of inf", 409, "/api/view?r=0&from=0&to=1e999", {}),
    ("an impact that is none", 409, "/api/impact?r=0&k=999", {}),
    ("half an impact", 409, "/api/impact?r=0&k=0.5", {}),
]


@pytest.mark.parametrize(("status", "what", "headers"), [one[1:] for one in REFUSED], ids=[one[0] for one in REFUSED])
def test_what_is_refused(status: int, what: str, headers: dict[str, str], page: Page) -> None:
    method, _, path = what.rpartition(" ")
    given = {name.replace("-", "_"): value.format(key=page.key) for name, value in headers.items()}
    body = b"{}" if method in ("POST", "PUT") else None
    found, content, head = page.ask(path, body, method or "GET", **given)
    assert found == status, content
    assert head["Content-Security-Policy"] == POLICY and head["X-Content-Type-Options"] == "nosniff"
    assert b"impacts" not in (content if isinstance(content, bytes) else b"")


BODIES = [
    ("too large", 413, b"{" + b" " * 5000 + b"}", {}),
    ("no json", 400, b"label", {}),
    ("no object", 400, b"[1]", {}),
    ("deep", 400, b"[" * 4000, {}),
    ("a form", 415, b"r=0&k=0", {"Content-Type": "application/x-www-form-urlencoded"}),
    ("text", 415, b"{}", {"Content-Type": "text/plain"}),
    ("no length", 411, b"{}", {"Content-Length": "x"}),
    ("in chunks", 415, b"{}", {"Transfer-Encoding": "chunked"}),
    ("nothing", 409, b"{}", {}),
    ("a label as markup", 409, b'{"r":0,"k":1,"label":"<b>x</b>","chosen":"picked"}', {}),
    ("a label as formula", 409, b'{"r":0,"k":1,"label":"=cmd|x!A0","chosen":"picked"}', {}),
    ("a long label", 409, json.dumps({"r": 0, "k": 1, "label": "x" * 41}).encode(), {}),
    ("a label of unknown", 409, b'{"r":0,"k":1,"label":"unknown","chosen":""}', {}),
    ("a label with a line", 409, b'{"r":0,"k":1,"label":"a\\nb","chosen":""}', {}),
    ("another way to choose", 409, b'{"r":0,"k":1,"label":"coal","chosen":"best"}', {}),
    ("a stretch behind the end", 409, b'{"r":0,"from":1,"to":1e9,"label":"coal","chosen":"stretch"}', {}),
    ("a truth for a number", 409, b'{"r":false,"k":1,"label":"coal","chosen":""}', {}),
]


@pytest.mark.parametrize(("status", "body", "headers"), [one[1:] for one in BODIES], ids=[one[0] for one in BODIES])
def test_what_is_no_label(status: int, body: bytes, headers: dict[str, str], page: Page) -> None:
    given = {name.replace("-", "_"): value for name, value in headers.items()}
    found, content, _ = page.ask("/api/label", body, "POST", **given)
    assert found == status, content
    assert page.ask("/api/label", body, "POST", X_Cgid_Key="wrong", **given)[0] == 403


def test_a_name_is_text_wherever_it_goes(site: Any, page: Page) -> None:
    """No formula for a spreadsheet, and the page never makes elements of text (see the script of the browser)."""
    assert page.post("label", r=0, k=2, label="coal", by="=<b>x</b>", chosen="picked")[0] == 200
    assert page.get("impacts?r=0")["impacts"][2][6] == "=<b>x</b>"
    page.wait(lambda state: not state["problem"])
    time.sleep(1.5)
    assert "'=<b>x</b>" in (site[0] / "labels.csv").read_text()
    assert page.post("label", r=0, k=2, label="", chosen="")[0] == 200


def test_a_recording_that_changes_or_goes_is_told(site: Any, tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes((site[0] / "a.npy").read_bytes())
    page = Page(tmp_path)
    page.wait(ended)
    path.write_bytes(path.read_bytes()[:-800])
    status, content = page.ask("/api/impact?r=0&k=1")[:2]
    assert status == 409 and "has changed since it was opened" in content["error"]
    path.unlink()
    assert "has gone" in page.ask("/api/view?r=0&from=0&to=0.1")[1]["error"]
    assert page.post("label", r=0, k=1, label="coal", chosen="random")[0] == 200  # the label is not lost
    page.end()
    assert [row["label"] for row in rows_of(tmp_path / "labels.csv") if row["label"]] == ["coal"]


def test_labels_in_flight_survive_kill_9(site: Any, tmp_path: Path) -> None:
    """Two people label; the server is killed at a random moment, three times; every answered label is there."""
    import threading

    (tmp_path / "a.npy").write_bytes((site[0] / "a.npy").read_bytes())
    generator, answered = np.random.default_rng(3), dict[int, str]()

    def label(page: Page, mine: list[int], word: str) -> None:
        for k in mine:
            try:
                if page.post("label", r=0, k=k, label=f"{word}{k}", chosen="random")[0] == 200:
                    answered[k] = f"{word}{k}"
            except (OSError, http.client.HTTPException):
                return

    for round_ in range(3):
        page = Page(tmp_path)
        page.wait(ended)
        people = [
            threading.Thread(target=label, args=(page, list(range(odd, 40, 2)), f"{word}{round_}x"))
            for odd, word in ((0, "a"), (1, "b"))
        ]
        for one in people:
            one.start()
        time.sleep(generator.uniform(0.0, 0.25))
        page.end(signal.SIGKILL)
        for one in people:
            one.join()
    page = Page(tmp_path)
    page.wait(ended)
    found = {one[0]: one[5] for one in page.get("impacts?r=0")["impacts"]}
    # A label whose answer did not arrive may be there as well: of the same round, or a later one.
    lost = {k: word for k, word in answered.items() if found[k] != word and found[k][1] <= word[1]}
    assert answered and not lost
    assert "labels" in page.end()


def test_a_second_page_on_the_table_is_one_line(site: Any, page: Page, capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.chdir(site[0])
    assert main(["label", "a.npy", "--rate", "10000", "--unit", "g"]) == 73
    assert "one cgid label at a time" in capsys.readouterr().err


def test_a_site_names_and_turns_the_channels_that_are_labelled(site: Any, tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes((site[0] / "a.npy").read_bytes())
    (tmp_path / "face.toml").write_text('[channels.1]\nname = "support 41"\n[channels.2]\ninvert = true\n')
    plain = Page(tmp_path, "-o", "plain.csv")
    views = []
    for page in (plain, Page(tmp_path, "--site", "face.toml")):
        state = page.wait(ended)
        views.append(page.get("view?r=0&from=0&to=2&n=300")["channels"])
        page.end()
    assert state["recordings"][0]["channels"] == ["support 41", "2"]
    assert views[1][0]["low"] == views[0][0]["low"]
    np.testing.assert_allclose(views[1][1]["low"], -np.array(views[0][1]["high"]), atol=1)


def test_every_word_is_in_every_language() -> None:
    languages = words()
    assert set(languages) == {"en", "zh"} and set(languages["en"]) == set(languages["zh"])
    assert all(text.strip() for found in languages.values() for text in found.values())


def test_the_page_is_as_small_as_it_was_to_be() -> None:
    folder = ROOT / "cgid" / "labelling"
    assert len((folder / "label.js").read_text(encoding="utf-8").splitlines()) <= 600
    html = (folder / "label.html").read_text(encoding="utf-8")
    assert not any(word in html for word in ("<style", "style=", "onclick", "http:", "https:"))
