"""Former names of options, columns and Python objects: each still works, and one line gives the new name."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from cgid.cli.help import RENAMED
from cgid.cli.main import cli, run
from cgid.identification.answers import Answer

ROOT = Path(__file__).parents[1]
#: Former Python name -> the present one.
OBJECTS = {
    "cgid.strikers": "cgid.estimate_impactors",
    "cgid.striker.StrikerColumns": "cgid.impactor.ImpactorColumns",
    "cgid.striker.StrikerPopulation": "cgid.impactor.ImpactorPopulation",
    "cgid.striker.Strikers": "cgid.impactor.ImpactorEstimates",
    "cgid.striker.strikers": "cgid.impactor.estimate_impactors",
    "cgid.striker.size_distribution": "cgid.impactor.size_distribution",
}
#: Former option -> a command line with it.
OPTIONS = {
    "--cost": ("predict", "datasets/sample.csv", "--cost", "gangue=2"),
    "--gangue-cost": ("predict", "datasets/sample.csv", "--gangue-cost=2"),
    "--striker": ("predict", "datasets/sample.csv", "--striker", "reference"),
}


def test_objects() -> None:
    for old, new in OBJECTS.items():
        (old_module, _, old_name), (new_module, _, new_name) = old.rpartition("."), new.rpartition(".")
        with pytest.warns(FutureWarning, match=new.replace(".", r"\.")):
            found = getattr(importlib.import_module(old_module), old_name)
        assert found is getattr(importlib.import_module(new_module), new_name), old


def test_a_name_that_never_was() -> None:
    with pytest.raises(AttributeError, match="beaters"):
        importlib.import_module("cgid.striker").beaters  # noqa: B018


def test_attribute() -> None:
    answer = Answer(time=1.0, label="coal", probabilities={"coal": 1.0}, novelty=0.1, impactor={"mass": 2.0})
    with pytest.warns(FutureWarning, match="impactor"):
        assert answer.striker == {"mass": 2.0}


def test_every_option_is_tried() -> None:
    assert set(OPTIONS) == set(RENAMED)
    flags = {flag for command in cli.commands.values() for option in command.params for flag in option.opts}
    assert set(RENAMED.values()) <= flags and not set(RENAMED) & flags


@pytest.mark.parametrize("old", OPTIONS)
def test_option(old: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    new = tuple(argument.replace(old, RENAMED[old]) for argument in OPTIONS[old])
    assert run(list(new)) == 0
    expected = capsys.readouterr()
    assert run(list(OPTIONS[old])) == 0
    found = capsys.readouterr()
    assert found.out == expected.out
    assert sum(old in line and RENAMED[old] in line for line in found.err.splitlines()) == 1
