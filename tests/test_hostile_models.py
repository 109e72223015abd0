"""Model files that mean harm do none: no code runs, no other file is opened, little time and memory, one clear line.

The long form: python benchmarks/hostile_models.py
"""

import contextlib
import os
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.hostile_models import Watched, by_hand, failed_by_hand, failed_mutants, mutants
from cgid.cli.main import run
from cgid.cli.output import print_json
from cgid.errors import BadData
from cgid.identification.answers import identify_frames
from cgid.identification.model import Model
from cgid.identification.model_file import signed
from tests.hostile_models import EXTREME, HOSTILE, archive, changed, entries_of, golden

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked and watched as on Linux")


@pytest.fixture(autouse=True)
def _busy_machine(monkeypatch):
    """Two that share a processor are counted twice the time."""
    monkeypatch.setattr("benchmarks.hostile_models.TIME_LIMIT", 20.0)


@pytest.mark.long
def test_files_made_by_hand_do_no_harm(tmp_path):
    assert len(HOSTILE) > 100
    assert failed_by_hand(by_hand(tmp_path)) == {}


def test_mutants_do_no_harm_and_no_change_goes_unnoticed(tmp_path):
    found = mutants(150, 1, tmp_path)
    assert failed_mutants(found) == []
    # What was mended, only the digest tells: else it would be another model.
    assert sum("SHA-256" in outcome.told for mutant, outcome in found if mutant.kind == "mended") > 25
    # Some of those that were signed anew are models, too: else nothing behind the checks has been tried.
    assert {outcome.name for mutant, outcome in found if mutant.kind == "signed"} >= {"refused", "another"}


def test_whoever_loads_a_pickle_is_seen(tmp_path, monkeypatch):
    """The judge would see it: numpy, told to trust, makes the canary's folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "m.npz"
    path.write_bytes(HOSTILE["header of objects"]())
    monkeypatch.setattr(Model, "from_bytes", lambda _: np.load(path, allow_pickle=True)["header"])
    with Watched() as watched:
        told = watched.judge(path)
    assert told.name == "event"
    assert "cgid-canary" in told.told


def test_a_file_that_ends_the_process_or_swallows_memory_is_seen(tmp_path, monkeypatch):
    path = tmp_path / "models-4-linear.npz"
    path.write_bytes(golden("linear").to_bytes())
    true = Model.from_bytes

    def harmful(content):
        if len(content) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        if len(content) == 2:
            return np.ones(40 << 20).sum()
        return true(content)

    monkeypatch.setattr(Model, "from_bytes", harmful)
    with Watched() as watched:
        assert watched.judge(path, path.name).name == "same"
        (tmp_path / "two").write_bytes(b"22")
        assert not watched.judge(tmp_path / "two").within_limits
        (tmp_path / "one").write_bytes(b"1")
        assert watched.judge(tmp_path / "one").name == "crash (-9)"
        assert watched.judge(path, path.name).name == "same"


def test_features_in_another_order_are_found(tmp_path):
    content = golden("linear").to_bytes()
    wrong = content.replace(b'["peak_force", "width_50"]', b'["width_50", "peak_force"]')
    assert len(wrong) == len(content)
    assert wrong != content
    # With checksums that fit: only the digest can tell.
    (tmp_path / "m.npz").write_bytes(archive(entries_of(content) | {"header.npy": _header(wrong)}))
    with pytest.raises(BadData, match="must match the SHA-256"):
        Model.load(tmp_path / "m.npz")


def _header(content):
    start = content.index(b"\x93NUMPY")
    return content[start : content.index(b"PK\x03\x04", start)]


def test_every_byte_of_header_and_arrays_is_in_the_digest():
    model = golden("boosting")
    text = signed(model.header, model.arrays)
    for name, array in model.arrays.items():
        other = array.copy()
        other.reshape(-1).view(np.uint8)[-1] ^= 1
        assert signed(model.header, {**model.arrays, name: other}) != text
        assert signed(model.header, {**model.arrays, name: array.reshape(1, *array.shape)}) != text
    for name in model.header:
        assert signed(model.header | {name: "other"}, model.arrays) != text


def test_large_models_answer_in_parts_as_in_whole(monkeypatch):
    for family in ("boosting", "linear", "logistic", "network"):
        model = golden(family)
        inputs = np.exp(np.random.default_rng(2).normal(size=(40, 2))) * [2e4, 3e-4]
        whole = model.probabilities(inputs), model.novelty(inputs)
        with monkeypatch.context() as patched:
            patched.setattr("cgid.identification.model._MOST_HELD", 7)
            parts = model.probabilities(inputs), model.novelty(inputs)
        np.testing.assert_allclose(parts[0], whole[0], rtol=1e-12)
        np.testing.assert_allclose(parts[1], whole[1], rtol=1e-12)


def test_numbers_that_grow_too_large_are_said_once(tmp_path):
    (tmp_path / "m.npz").write_bytes(EXTREME["numbers that grow too large"]())
    model = Model.load(tmp_path / "m.npz")
    with pytest.raises(BadData, match="gives no probabilities"):
        model.probabilities(np.array([[1e9, 1e-9]]))


@pytest.mark.parametrize("name", [name for name in EXTREME if "beam" in name])
def test_extreme_beams_answer_or_say_why_not(name):
    """No traceback, no warning, no memory without end when signals go through the tables of such a beam."""
    import resource

    model = Model.from_bytes(EXTREME[name]())
    time = np.arange(560) / 8e3
    frames = np.random.default_rng(0).normal(0, 1e-2, (6, 640))
    frames[:, 80:] += np.arange(1, 7)[:, None] * np.exp(-60 * time) * np.sin(2500 * time)
    with contextlib.suppress(BadData):
        answers = identify_frames(frames, 8e3, model, pre_trigger=80)
        assert len(answers) == 6
        assert all(answer.problem or sum(answer.probabilities.values()) == pytest.approx(1) for answer in answers)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 2 << 20


# -- texts of strangers on the terminal ----------------------------------------------------------------------

EVIL = "\x1b]0;evil\x07\x1b[2J\u202egnp\x85\x9b1A"


def test_no_text_of_a_file_commands_the_terminal(tmp_path, capsys):
    """Its name, what it says of its channels, and what a model says of its training."""
    rows = "".join(f"{value:.3f}\n" for value in np.random.default_rng(0).normal(0, 20, 400))
    recording = tmp_path / f"a{EVIL}.csv"
    recording.write_text(f"# sampling_rate: 200000 Hz\n{EVIL} force (N)\n{rows}")
    model = tmp_path / "m.npz"
    model.write_bytes(changed("linear", {"training": {"sources": [EVIL], EVIL: {"deep": EVIL}}}))
    for arguments in (
        ["info", str(recording)],
        ["info", str(model)],
        ["info", str(model), "--json"],
        ["predict", str(recording)],
        ["features", str(recording)],
        ["plot", str(recording), "-o", str(tmp_path / f"{EVIL}.gif")],
        ["train", str(tmp_path / f"{EVIL}\nmanifest.csv"), "-o", str(tmp_path / "n.npz")],
        ["check", str(tmp_path / f"{EVIL}.toml")],
        ["generate", EVIL, "-o", str(tmp_path / f"{EVIL}.h5")],
        [EVIL],
    ):
        run(arguments)
        told = capsys.readouterr()
        text = told.out + told.err
        assert text
        assert all(line.replace("\t", "").isprintable() for line in text.split("\n")), (arguments, text)
        assert "evil" in text


def test_what_is_no_number_is_null_however_deep(capsys):
    print_json({"a": float("nan"), "b": [1.0, {"c": [float("-inf")]}]})
    assert capsys.readouterr().out == '{"version": 1, "a": null, "b": [1.0, {"c": [null]}]}\n'


def test_everything_that_a_command_says_goes_through_one_door():
    commands = Path(sys.modules["cgid.cli.main"].__file__).parent
    doors = {path.name for path in commands.glob("*.py") if re.search(r"click\.s?echo|\bprint\(", path.read_text())}
    assert doors == {"output.py"}
