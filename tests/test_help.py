"""The pages of --help: every option has a heading and a sentence, and every example runs."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import numpy as np
import pytest

from cgid.cli.help import Command
from cgid.cli.main import cli, run
from cgid.shipped import SCENES
from tests.tapped import taps

ROOT = Path(__file__).parents[1]
COMMANDS = {"cgid": cli, **cli.commands}
#: Of minutes.
SLOW = ("calibrate", "tap")


def test_mistyped_names_are_suggested(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predcit", "--sample"]) == 2
    assert "Did you mean 'predict'?" in capsys.readouterr().err
    assert run(["predict", "--smaple"]) == 2
    assert "--sample" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("cgid pre", ["predict"]),
        ("cgid check re", ["reference"]),
        ("cgid generate ", SCENES),
        ("cgid generate tail", ["tail_beam"]),
        ("cgid train p", ["peers", "plate"]),
        ("cgid predict --model default-", ["default-acceleration"]),
        ("cgid export-model default --to o", ["onnx"]),
        ("cgid info re", []),
    ],
)
def test_the_shell_completes(words: str, offered: list[str]) -> None:
    """By a new process, as bash asks; files are left to bash itself, which forgets what came before "file"."""
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_CGID_COMPLETE": "bash_complete"}
    done = subprocess.run(
        [sys.executable, "-m", "cgid"], env={**os.environ, **asked}, capture_output=True, text=True, check=True
    )
    lines = [line.partition(",") for line in done.stdout.splitlines()]
    assert [text for kind, _, text in lines if kind == "plain"] == list(offered)
    assert "file" not in [kind for kind, _, _ in lines][1:]
    if words.startswith(("cgid check", "cgid train", "cgid predict --model", "cgid info")):
        assert lines[0][0] == "file"
    assert done.stderr == ""


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_and_the_example_are_on_the_page(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert run([*([] if name == "cgid" else [name]), "--help"]) == 0
    page = capsys.readouterr().out
    assert max(len(line) for line in page.splitlines()) <= 110
    command = COMMANDS[name]
    assert isinstance(command, Command)
    for option in command.params:
        if isinstance(option, click.Option) and not option.hidden:
            assert f"  {', '.join(sorted(option.opts, key=len))}" in page
    assert not re.search(r"^ +-.* (FLOAT|INTEGER|TEXT)( |$)", page, re.MULTILINE)  # its name and unit instead
    assert command.example
    assert "Example:\n" + "".join(f"  {line}\n" for line in command.example.splitlines()) in page


@pytest.mark.parametrize(
    "name",
    # A page goes on until Ctrl-C: tests/test_label.py.
    [pytest.param(name, marks=[pytest.mark.long] * (name in SLOW)) for name in COMMANDS if name != "label"],
)
def test_every_example_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("datasets", "models"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    if name in ("tap", "invert"):
        response, force, _ = taps(4, gap=0.7)
        rows = np.column_stack([np.arange(response.size) / 25_600, response, force])
        np.savetxt("taps.csv", rows, "%.7g", ",", header="time [s],acceleration [m/s^2],force [N]", comments="")
    command = COMMANDS[name]
    assert isinstance(command, Command)
    for line in command.example.splitlines():
        program, *arguments = shlex.split(line)
        if program == "cgid":
            assert run(arguments) == 0, line
        else:
            assert program == "python"
            subprocess.run([sys.executable, *arguments], check=True)
