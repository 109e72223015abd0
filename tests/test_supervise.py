"""`docker/supervise`: what runs monitor in a container starts it again, and ends when it should."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a script of sh")


def supervised(tmp_path: Path, command: str, **options: object) -> subprocess.Popen[str]:
    script = tmp_path / "monitor"
    script.write_text(f"#!/bin/sh\necho run >> {tmp_path}/runs\n{command}\n")
    script.chmod(0o755)
    return subprocess.Popen(
        ["sh", str(ROOT / "docker" / "supervise"), str(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"SUPERVISE_SECONDS": "0.05"},
    )


def n_runs(tmp_path: Path) -> int:
    runs = tmp_path / "runs"
    return len(runs.read_text().split()) if runs.exists() else 0


def until(tmp_path: Path, n: int) -> None:
    for _ in range(400):
        if n_runs(tmp_path) >= n:
            return
        time.sleep(0.05)
    raise AssertionError(f"{n_runs(tmp_path)} runs")


@pytest.mark.parametrize("code", [0, 2, 64])
def test_the_end_of_the_stream_and_a_wrong_call_end_it(tmp_path: Path, code: int) -> None:
    with supervised(tmp_path, f"exit {code}") as process:
        assert process.wait(20) == code
    assert n_runs(tmp_path) == 1


def test_a_command_that_always_fails_is_given_up(tmp_path: Path) -> None:
    with supervised(tmp_path, "exit 65") as process:
        assert process.wait(30) == 65
    assert n_runs(tmp_path) == 5


def test_failures_and_kills_start_it_again_on_the_same_stream(tmp_path: Path) -> None:
    done = "[ $(wc -l < runs) -ge 3 ] && { read line; echo got $line; exit 0; }"
    with supervised(tmp_path, f"cd {tmp_path}; {done}; [ $(wc -l < runs) -eq 2 ] && kill -9 $$; exit 65") as process:
        output, error = process.communicate("samples\n", 20)
    assert output == "got samples\n" and process.returncode == 0
    assert re.findall("ended with ([0-9]+)", error) == ["65", "137"]


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_the_command_first(tmp_path: Path, sent: signal.Signals) -> None:
    with supervised(tmp_path, "trap 'echo ended; exit 0' TERM; while :; do sleep 0.05; done") as process:
        until(tmp_path, 1)
        time.sleep(0.2)
        process.send_signal(sent)
        output, _ = process.communicate(timeout=20)
    assert output == "ended\n" and process.returncode == 0 and n_runs(tmp_path) == 1
