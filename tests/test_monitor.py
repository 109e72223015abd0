"""A live stream: what is said and when, that nothing is dropped, and how far behind it states it is."""

from __future__ import annotations

import errno
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import wavfile

from cgid.cli.main import run
from cgid.errors import INTERRUPTIONS
from cgid.plant.output import Stdout
from cgid.recordings.live import Inbox
from tests.streams_of_pulses import RATE, ROOT, stream, window_model

LABELS = ["coal"] * 14 + ["gangue"] * 14
RAW = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N"]


def rows_of(text: str, kind: str) -> list[dict]:
    return [row for row in map(json.loads, text.splitlines()) if row["kind"] == kind]


def monitored(content: bytes, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "cgid", "monitor", "-", "--json", *arguments]
    return subprocess.run(command, input=content, capture_output=True, cwd=ROOT)


@pytest.fixture(scope="module")
def force() -> np.ndarray:
    return stream(LABELS, 0.02)


@pytest.fixture
def raw(tmp_path: Path, force: np.ndarray) -> Path:
    (tmp_path / "stream.raw").write_bytes(force.astype("<f4").tobytes())
    return tmp_path / "stream.raw"


# -- gaps -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["predict", "monitor"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_gap_costs_one_warning_and_no_other_channel(
    command: str, value: float, force: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = np.stack([force, force[::-1]], axis=1).astype("<f4")

    def answered() -> tuple[list[dict], list[str]]:
        np.save(tmp_path / "s.npy", samples)
        samples.tofile(tmp_path / "s.f32")
        given = ["s.f32", "--channels", "2", "--sample-format", "f32le"] if command == "monitor" else ["s.npy"]
        assert run([command, str(tmp_path / given[0]), *given[1:], "--rate", str(RATE), "--unit", "N", "--json"]) == 0
        out = capsys.readouterr().out
        # Pulses that are turned round in time are no impacts of the training, and both channels have impacts at the
        # same times: that is told, too.
        own = [row["message"] for row in rows_of(out, "finding") if row["finding"] == "missing"]
        return rows_of(out, "impact"), own

    expected, said = answered()
    assert not said
    # Between two impacts, and in the middle of one: of 20 ms each, the impact after 10.
    samples[[round(0.202 * RATE), round(0.2501 * RATE)], 1] = value
    got, said = answered()
    assert len(said) == (1 if command == "predict" else len(said)) > 0
    assert "2 samples in 2 gaps" in said[-1]
    assert [row for row in got if row["channel"] == "1"] == [row for row in expected if row["channel"] == "1"]
    before, after = ([row for row in rows if row["channel"] == "2"] for rows in (expected, got))
    by_time = {row["time_s"]: row for row in before}
    differ = [row for row in after if by_time.get(row["time_s"]) != row]
    # Only frames that reach to a gap, and none with another label: at most unknown.
    assert len(before) - 1 <= len(after) <= len(before)
    assert 1 <= len(differ) <= 3
    assert all(0.18 < row["time_s"] < 0.26 for row in differ)
    assert all(row["label"] in ("unknown", by_time[row["time_s"]]["label"]) for row in differ)


@pytest.mark.parametrize("command", ["predict", "monitor"])
def test_a_channel_is_taken_again_and_the_end_comes_only_where_none_is_readable(
    command: str, force: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = np.stack([force, force], axis=1).astype("<f4")
    given = ["s.f32", "--channels", "2", "--sample-format", "f32le"] if command == "monitor" else ["s.npy"]

    def answered(*options: str) -> tuple[int, list[dict], list[str], str]:
        np.save(tmp_path / "s.npy", samples)
        samples.tofile(tmp_path / "s.f32")
        reading = [*given[1:], "--rate", str(RATE), "--unit", "N", "--json"]
        code = run([command, str(tmp_path / given[0]), *reading, *options])
        out, err = capsys.readouterr()
        return code, rows_of(out, "impact"), [row["message"] for row in rows_of(out, "finding")], err

    first = round(0.3 * RATE)
    samples[first:, 1] = np.nan
    samples[round(0.45 * RATE) :, 1] = force[round(0.45 * RATE) :]
    for options in (("--set", "give_up=0.1"), ()):
        code, impacts, said, _ = answered(*options)
        assert code == 0
        assert len([message for message in said if "no reading" in message]) == (1 if command == "predict" else 2)
        assert sum(row["channel"] == "1" for row in impacts) == 28
        assert sum(row["channel"] == "2" for row in impacts) == 15 + 6
    samples[first:] = 1e20
    code, impacts, said, err = answered("--set", "give_up=0.1")
    assert code == 65
    assert len(impacts) == 30
    assert len([line for line in err.splitlines() if line.startswith("cgid: error: ")]) == 1


@pytest.mark.parametrize("value", [0.0, 500.0, np.nan])
def test_dead_channels_end_a_watch_only_by_an_option(
    value: float, force: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = np.concatenate([force, np.full(round(1.5 * RATE), value)]).astype("<f4")
    samples.tofile(tmp_path / "s.f32")
    for options, expected in (([], 0), (["--set", "give_up=1"], 65)):
        assert run(["monitor", str(tmp_path / "s.f32"), *RAW, "--json", *options]) == expected
        out, err = capsys.readouterr()
        assert len(rows_of(out, "impact")) == 28
        assert len([line for line in err.splitlines() if line.startswith("cgid: error: ")]) == bool(expected)


def test_windows_with_a_gap_have_no_vote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "m.npz").write_bytes(window_model(hop_time=0.1).to_bytes())
    noise = (np.random.default_rng(4).normal(size=16_000) / 5).astype("<f4")
    noise[8500] = np.nan
    noise.tofile(tmp_path / "n.raw")
    arguments = ["monitor", str(tmp_path / "n.raw"), "--rate", "8000", "--channels", "1", "--sample-format", "f32le"]
    assert run([*arguments, "--unit", "FS", "--model", str(tmp_path / "m.npz"), "--json"]) == 0
    labels = [row["label"] for row in rows_of(capsys.readouterr().out, "window")]
    assert labels == ["gangue"] * 10 + ["unknown"] + ["gangue"] * 9


# -- what is said -----------------------------------------------------------------------------------------


def test_monitor_says_what_predict_says(
    raw: Path, tmp_path: Path, force: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "s.npy", force.astype(np.float32))
    assert run(["predict", str(tmp_path / "s.npy"), "--rate", str(RATE), "--unit", "N", "--json"]) == 0
    predicted = rows_of(capsys.readouterr().out, "impact")
    assert run(["monitor", str(raw), *RAW, "--json", "--set", "window=0.24"]) == 0
    out = capsys.readouterr().out
    impacts = rows_of(out, "impact")
    assert [row["label"] for row in impacts] == [row["label"] for row in predicted]
    assert [row["time_s"] for row in impacts] == [row["time_s"] for row in predicted]
    assert {row["source"] for row in impacts} == {str(raw)}
    shares = rows_of(out, "share")
    assert [row["to_s"] for row in shares] == pytest.approx(np.arange(1, len(shares) + 1) * 0.024)
    assert len(shares) == 23
    (summary,) = rows_of(out, "summary")
    assert (summary["impacts"], summary["duration_s"]) == (28, pytest.approx(0.56))


def test_stdin_is_raw_numbers_or_wav(force: np.ndarray) -> None:
    done = monitored(force.astype("<f4").tobytes(), *RAW)
    assert done.returncode == 0, done.stderr
    assert len(rows_of(done.stdout.decode(), "impact")) == 28
    peak = 1.2 * np.abs(force).max()
    file = io.BytesIO()
    both = np.stack([force, force[::-1]], axis=1) / peak
    wavfile.write(file, int(RATE), (both * 32767).astype(np.int16))
    done = monitored(file.getvalue(), "--unit", "N", "--full-scale", repr(float(peak)))
    assert done.returncode == 0, done.stderr
    impacts = rows_of(done.stdout.decode(), "impact")
    assert {row["channel"] for row in impacts} == {"1", "2"}
    own = [row["label"] for row in impacts if row["channel"] == "1"]
    assert np.mean([a == b for a, b in zip(own, LABELS, strict=True)]) > 0.85


def test_events_leave_before_the_stream_goes_on(force: np.ndarray) -> None:
    command = [sys.executable, "-u", "-m", "cgid", "monitor", "-", "--json", *RAW]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        part = force[: round(0.5 * RATE)].astype("<f4").tobytes()
        process.stdin.write(part[:-2])  # even within a number
        process.stdin.flush()
        row = json.loads(process.stdout.readline())
        assert (row["kind"], row["impact"]) == ("impact", 1)
        process.stdin.close()
        rest = process.stdout.read().decode()
        assert len(rows_of(rest, "impact")) == 24
        assert "left out" in rows_of(rest, "finding")[0]["message"]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.parametrize("number", INTERRUPTIONS)
def test_interruption_ends_with_a_summary(force: np.ndarray, number: signal.Signals) -> None:
    command = [sys.executable, "-u", "-m", "cgid", "monitor", "-", "--json", *RAW]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, cwd=ROOT, **pipes)
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdin.write(force.astype("<f4").tobytes())
    process.stdin.flush()
    json.loads(process.stdout.readline())
    process.send_signal(number)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 128 + number
    assert json.loads(out.splitlines()[-1])["kind"] == "summary"
    assert b"interrupted" in err
    assert b"Traceback" not in err
    assert b"Fatal" not in err


def test_a_stream_that_stalls_is_stopped_and_taken_up_again(force: np.ndarray) -> None:
    options = ["--set", "window=0.24", "--set", "blind_after=0.6"]
    command = [sys.executable, "-u", "-m", "cgid", "monitor", "-", "--json", *RAW, *options]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as process:
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        process.stdin.write(force.astype("<f4").tobytes())
        process.stdin.flush()
        states = (row for row in map(json.loads, process.stdout) if "ground" in row)
        stopped = next(row for row in states if row["ground"] != "seen")
        assert (stopped["kind"], stopped["ground"], stopped["decision"]) == ("state", "stopped", "none")
        process.stdin.write(force.astype("<f4").tobytes())
        process.stdin.flush()
        assert next(row for row in states if row["ground"] == "seen")["kind"] in ("share", "state")
        process.stdin.close()
        assert "stopped" not in [row["ground"] for row in states]
        assert b": stopped: " in process.stderr.read()
        assert process.wait(60) == 0


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
@pytest.mark.parametrize("program", ["", "nohup"])
def test_terminal_that_closes_ends_the_watch_unless_nohup(program: str, force: np.ndarray) -> None:
    import pty

    master, slave = pty.openpty()
    command = [*program.split(), sys.executable, "-u", "-m", "cgid", "monitor", "-", *RAW]
    # nohup would redirect a terminal to a file.
    out = subprocess.PIPE if program else slave
    process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=out, stderr=out, bufsize=0)
    os.close(slave)
    assert process.stdin is not None
    try:
        process.stdin.write(force.astype("<f4").tobytes())
        assert os.read(master if process.stdout is None else process.stdout.fileno(), 10)
        process.send_signal(signal.SIGSTOP)  # both reach it at once, as from a terminal that closes
        os.close(master)
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGCONT)
        process.communicate(timeout=300)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == (0 if program else 129)


# -- nothing is dropped -----------------------------------------------------------------------------------


def test_inbox_joins_what_waits_and_drops_nothing() -> None:
    blocks = [np.full((2, n), float(k)) for k, n in enumerate([1, 5, 900, 3, 1, 1, 4000, 2])]
    all_there = threading.Event()

    def coming():
        yield from blocks
        all_there.set()

    inbox = Inbox(1000.0)
    inbox.read(coming())
    taken = []
    for block in inbox:
        assert all_there.wait(60)  # more comes meanwhile
        taken.append(block)
    np.testing.assert_array_equal(np.concatenate(taken, axis=1), np.concatenate(blocks, axis=1))
    assert len(taken) < len(blocks)
    assert inbox.n_taken == sum(block.shape[1] for block in blocks)


def test_inbox_that_is_full_makes_the_stream_wait() -> None:
    block = np.zeros((1, 1000))

    def blocks():
        for _ in range(8):
            yield block

    inbox = Inbox(1e4, max_waiting=3 * block.nbytes)
    inbox.read(blocks())
    iterator = iter(inbox)
    total = next(iterator).shape[1]
    deadline = time.monotonic() + 60
    while inbox.n_given < total + 4000 and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.05)
    assert inbox.n_given == total + 4000  # more than three blocks wait, so the next one is not taken
    for part in iterator:
        total += part.shape[1]
    assert total == 8 * block.shape[1]


def test_a_live_stream_is_behind_by_what_waits_and_a_file_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.5}
    monkeypatch.setattr(Inbox, "_clock", property(lambda _: clock["now"]))
    taken, waiting, leave = (threading.Event() for _ in range(3))

    def live():
        yield np.zeros((1, 50))
        assert taken.wait(60)
        yield np.zeros((1, 50))
        waiting.set()
        assert leave.wait(60)

    inbox = Inbox(100.0)
    inbox.read(live())
    iterator = iter(inbox)
    assert next(iterator).shape[1] == 50
    taken.set()
    assert waiting.wait(60)
    # Half a second waits, but the clock is not ahead of the half second that was taken.
    assert inbox.behind == 0
    clock["now"] = 0.75
    assert inbox.behind == 0.25
    clock["now"] = 60.0
    assert inbox.behind == 0.5
    leave.set()
    assert sum(block.shape[1] for block in iterator) == 50


# -- stdout beside other outputs ------------------------------------------------------------------------------


def outbox_lines(n: int) -> list[str]:
    return [f"{k} " + "x" * 1000 for k in range(n)]


def test_a_slow_reader_loses_no_line_and_one_who_is_away_holds_nothing_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cgid.plant.output.UNREAD", 0.4)
    for is_slow in (True, False):
        reading, writing = os.pipe()
        said: list[str] = []
        lines, got = outbox_lines(300), []  # a pipe holds some 64
        begun = time.monotonic()
        with os.fdopen(reading, "rb") as reader:

            def read(reader: Any = reader, got: list[str] = got, is_slow: bool = is_slow) -> None:
                for line in reader:
                    got.append(line.decode().rstrip("\n"))
                    time.sleep(0.004 * is_slow)

            thread = threading.Thread(target=read)
            stdout = Stdout(writing, said.append, 20)
            stdout.start()
            if is_slow:
                thread.start()
            for line in lines:
                stdout.put(line)
            if not is_slow:
                assert time.monotonic() - begun < 30 * 0.4  # waits once for the time without a reader
                thread.start()
            stdout.request_end()
            stdout.wait(0.0)
            os.close(writing)
            thread.join()
        if is_slow:
            assert got == lines and said == []
        else:
            assert got == sorted(got, key=lambda one: int(one.split()[0])) and set(got) < set(lines)
            assert got[-1] == lines[-1]
            assert f"{len(lines) - len(got)} " in said[-1] and len(said) == 3  # nobody reads, again, so many lost


def test_what_a_full_disk_refuses_waits_for_room(monkeypatch: pytest.MonkeyPatch) -> None:
    got, said, is_full = bytearray(), list[str](), threading.Event()

    def write(_descriptor: int, line: bytes) -> int:
        if is_full.is_set() and len(got) >= 100:  # within a line
            raise OSError(errno.ENOSPC, "no room")
        got.extend(line[:7])
        return len(line[:7])

    monkeypatch.setattr("cgid.plant.output.os.write", write)
    stdout, lines = Stdout(1, said.append, 200), [f"line {number}" for number in range(100)]
    is_full.set()
    stdout.start()
    for line in lines:
        stdout.put(line)
    while stdout.up:
        time.sleep(0.01)
    is_full.clear()
    stdout.request_end()
    stdout.wait(0.0)
    assert got.decode().splitlines() == lines and stdout.dropped == 0
    assert len(said) == 2 and "no room" in said[0]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no full device")
def test_a_full_disk_behind_stdout_ends_no_other_output(raw: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "cgid", "monitor", str(raw), *RAW, "--live", str(tmp_path / "page.html")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0
    assert (
        len([line for line in done.stderr.splitlines() if "warning: stdout" in line]) == 2
    )  # when it begins, and how many
    assert '"ended": true' in (tmp_path / "page.html").read_text()
