"""Model files that mean harm do none: no code runs, no other file is opened, little memory, one clear line."""

import contextlib
import re
import sys
import tracemalloc
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from benchmarks.safety.fuzz_recordings import MUTATIONS
from cgid import shipped
from cgid.cli.main import run
from cgid.cli.output import print_json
from cgid.errors import BadData, CgidError
from cgid.identification.model.model import StoredModel
from cgid.identification.model.model_file import signed
from cgid.identification.prediction import identify_frames
from cgid.identification.prediction.explanation import explain
from cgid.measure.features import FEATURES
from tests import few
from tests.hostile_models import (
    CANARY,
    EXTREME,
    HOSTILE,
    archive,
    changed,
    entries_of,
    golden,
    golden_files,
    mended,
    signed_anew,
    written,
)

#: Most memory that a file may take [bytes].
MEMORY_LIMIT = 256 << 20


class Audit:
    """Every event of the interpreter while a file is loaded, but its own opening (PEP 578)."""

    def __init__(self):
        self.path, self.events = None, []
        sys.addaudithook(self._hear)

    def _hear(self, event, arguments):
        # numpy parses the headers of arrays by ast.literal_eval, which builds a tree and runs nothing.
        is_literal = event == "compile" and arguments[1] == "<unknown>"
        own = event == "open" and arguments[0] == self.path and arguments[1] == "r"
        if self.path and not is_literal and not own and event != "object.__getattr__":
            self.events.append(f"{event} {arguments!r:.200}")

    def outcome(self, path, original=None):
        """Return whether a file is refused in one line, the model that it was made from, or another."""
        self.path, self.events = str(path), []
        try:
            model = StoredModel.load(str(path))
            inputs = np.exp(np.random.default_rng(0).normal(size=(16, len(model.inputs)))) * 1e3
            probabilities = model.probabilities(inputs)
            novelty = model.novelty(inputs, np.ones((16, len(model.guards))))
            model.decide(probabilities)
            levels = model.levels(inputs)
            explain([], model)
        except CgidError as error:
            assert str(error).isprintable() and len(str(error)) < 1000
            return "digest" if "SHA-256" in str(error) else "refused"
        finally:
            self.path = None
            assert self.events == [] and not Path(CANARY).exists()
        np.testing.assert_allclose(probabilities.sum(axis=1), 1.0, atol=1e-9)
        assert (probabilities >= 0).all() and not np.isnan(novelty).any()
        assert np.isfinite(levels).all() == (model.level_deviation > 0)
        same = original is not None and signed(model.header, model.arrays) == signed(original.header, original.arrays)
        return "same" if same else "another"


@pytest.fixture(scope="module")
def audit():
    # What is imported late, and by what suggests a name in an error, is imported before; so are features of packages.
    list(FEATURES)
    for path in golden_files():
        StoredModel.load(path)
    for name in ("no JSON", "feature that does not exist", "family of another world"):
        with contextlib.suppress(CgidError):
            StoredModel.from_bytes(HOSTILE[name]())
    return Audit()


@pytest.mark.long
@pytest.mark.parametrize("name", HOSTILE | EXTREME)
def test_files_made_by_hand_do_no_harm(audit, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "m.npz"
    path.write_bytes((HOSTILE | EXTREME)[name]())
    tracemalloc.start()
    outcome = audit.outcome(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert outcome in ("refused", "digest") or (name in EXTREME and outcome == "another")
    assert peak < MEMORY_LIMIT


@pytest.mark.parametrize(
    "name", ["beam whose pole grows", "beam of errors of other modes", "beam upside down", "beam of 1,025 modes"]
)
def test_arrays_of_a_beam_must_fit_each_other(name):
    with pytest.raises(BadData):
        StoredModel.from_bytes(HOSTILE[name]())


@pytest.mark.parametrize("number", [150, pytest.param(1500, marks=pytest.mark.long)])
def test_mutants_do_no_harm_and_no_change_goes_unnoticed(audit, tmp_path, number):
    contents = {path: path.read_bytes() for path in golden_files()}
    everything, models = list(contents.values()), {path: StoredModel.load(path) for path in contents}
    found = {"damaged": [], "mended": [], "signed": []}
    for k in range(number):
        random = np.random.default_rng([1, k])
        kind = tuple(found)[k % 3]
        source = random.choice(list(contents))
        content, model = contents[source], models[source]
        if kind == "damaged":
            content = MUTATIONS[int(random.integers(len(MUTATIONS)))](bytearray(content), random, everything)
        else:
            content = mended(content, random) if kind == "mended" else signed_anew(model, random)
        (tmp_path / "m.npz").write_bytes(content)
        found[kind].append(audit.outcome(tmp_path / "m.npz", model))
    assert "another" not in found["damaged"] + found["mended"]
    # What was mended, only the digest tells: else it would be another model.
    assert found["mended"].count("digest") > number / 6
    # Some of those that were signed anew are models, too: else nothing behind the checks has been tried.
    assert set(found["signed"]) >= {"refused", "another"}


def test_whoever_loads_a_pickle_is_seen(audit, tmp_path, monkeypatch):
    """The audit would see it: numpy, told to trust, makes the canary's folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "m.npz"
    path.write_bytes(HOSTILE["header of objects"]())
    monkeypatch.setattr(StoredModel, "from_bytes", lambda _: np.load(path, allow_pickle=True)["header"])
    with pytest.raises(AssertionError):
        audit.outcome(path)
    assert any(CANARY in event for event in audit.events)


def test_features_in_another_order_are_found(tmp_path):
    content = golden("linear").to_bytes()
    wrong = content.replace(b'["peak_force", "width_50"]', b'["width_50", "peak_force"]')
    assert len(wrong) == len(content)
    assert wrong != content
    # With checksums that fit: only the digest can tell.
    (tmp_path / "m.npz").write_bytes(archive(entries_of(content) | {"header.npy": _header(wrong)}))
    with pytest.raises(BadData, match="must match the SHA-256"):
        StoredModel.load(tmp_path / "m.npz")


def _header(content):
    start = content.index(b"\x93NUMPY")
    return content[start : content.index(b"PK\x03\x04", start)]


def test_every_byte_of_header_and_arrays_is_in_the_digest():
    model = golden("network")
    text = signed(model.header, model.arrays)
    for name, array in model.arrays.items():
        other = array.copy()
        other.reshape(-1).view(np.uint8)[-1] ^= 1
        assert signed(model.header, {**model.arrays, name: other}) != text
        assert signed(model.header, {**model.arrays, name: array.reshape(1, *array.shape)}) != text
    for name in model.header:
        assert signed(model.header | {name: "other"}, model.arrays) != text


def test_large_models_answer_in_parts_as_in_whole(monkeypatch):
    for family in ("linear", "logistic", "network"):
        model = golden(family)
        inputs = np.exp(np.random.default_rng(2).normal(size=(40, 2))) * [2e4, 3e-4]
        whole = model.probabilities(inputs), model.novelty(inputs)
        with monkeypatch.context() as patched:
            patched.setattr("cgid.identification.model.model._MAX_BLOCK", 7)
            parts = model.probabilities(inputs), model.novelty(inputs)
        np.testing.assert_allclose(parts[0], whole[0], rtol=1e-12)
        np.testing.assert_allclose(parts[1], whole[1], rtol=1e-12)


def test_numbers_that_grow_too_large_are_said_once(tmp_path):
    (tmp_path / "m.npz").write_bytes(EXTREME["numbers that grow too large"]())
    model = StoredModel.load(tmp_path / "m.npz")
    with pytest.raises(BadData, match="gives no finite probabilities"):
        model.probabilities(np.array([[1e300, 1e-9]]))


@pytest.mark.parametrize("name", few([name for name in EXTREME if "beam" in name], 4))
def test_extreme_beams_answer_or_say_why_not(name):
    """No traceback, no warning, no memory without end when signals go through the tables of such a beam."""
    import resource

    model = StoredModel.from_bytes(EXTREME[name]())
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
    """Its name, what it states of its channels, and what a model says of its training."""
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


#: What makes an array degenerate, though its numbers are finite.
DEGENERATE = {
    "zeros": np.zeros_like,
    "5e-324": lambda array: np.full(array.shape, 5e-324),
    "1e-31": lambda array: np.full(array.shape, 1e-31),
    "1e99": lambda array: np.full(array.shape, 1e99),
    "1e308": lambda array: np.full(array.shape, 1e308),
    "equal columns": lambda array: np.broadcast_to(array[..., :1], array.shape).copy(),
    "equal rows": lambda array: np.broadcast_to(array[:1], array.shape).copy(),
}


@pytest.mark.parametrize("name", ["linear", "logistic", "network", "default", "default-acceleration"])
def test_an_array_of_degenerate_numbers_is_refused_or_harmless(audit, tmp_path, name):
    """Every array of a model in turn: loading says what is wrong, or the model answers."""
    model = StoredModel.load(shipped.model_path(name)) if name.startswith("default") else golden(name)
    time = np.arange(1920) / 25.6e3
    frames = np.random.default_rng(0).normal(0, 1e-2, (2, 2048))
    frames[:, 128:] += [[9.0], [30.0]] * np.exp(-60 * time) * np.sin(2500 * time)
    outcomes = {}
    for array, kind in product(model.arrays, DEGENERATE):
        numbers = model.arrays[array]
        if numbers.dtype.kind != "f":
            continue
        with np.errstate(over="ignore"):  # infinite in single precision
            degenerate = DEGENERATE[kind](numbers)
        (tmp_path / "m.npz").write_bytes(written(model.header, {**model.arrays, array: degenerate}))
        outcomes[array, kind] = audit.outcome(tmp_path / "m.npz")
        if outcomes[array, kind] == "another" and array.startswith("beam."):
            with contextlib.suppress(BadData):
                answers = identify_frames(frames, 25.6e3, StoredModel.load(tmp_path / "m.npz"), pre_trigger=128)
                assert all(one.problem or sum(one.probabilities.values()) == pytest.approx(1) for one in answers)
    assert all(outcome == "refused" for (_, kind), outcome in outcomes.items() if kind == "1e308")
    for array in ("standardiser.scale", "standardiser.floor", "contrast.scale", "neighbourhood.whitening"):
        if array in model.arrays:
            assert outcomes[array, "zeros"] == outcomes[array, "5e-324"] == "refused"
    assert outcomes["neighbourhood.whitening", "equal columns"] == "refused"
