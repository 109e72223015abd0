"""The open benchmark: sets from seeds, metrics against slow twins, all that a file of predictions can get wrong."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cgid
from benchmarks.open import __main__ as program
from benchmarks.open import judge, sets
from benchmarks.open.entries import ENTRIES, write_predictions
from benchmarks.open.judge import (
    TIMES,
    Frames,
    Stream,
    Streams,
    Truth,
    calibration_error,
    judged_frames,
    judged_streams,
)
from cgid.errors import BadData
from cgid.recordings.public import PublicData, PublicFile
from cgid.scene import generate, generate_recordings
from cgid.store import Dataset
from cgid.store.reading import Recording

N = 40
ALL = sets.all_sets()
#: One stream of 12 s a part.
SHORT = replace(
    ALL["caving-constant"],
    signals={"train": 1, "test": 1},
    content={**ALL["caving-constant"].content, "stream": ALL["caving-constant"].content["stream"] | {"duration": 12.0}},
)


@pytest.fixture(scope="module")
def truth_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a benchmark's folder with the truth of a small set of frames, of strangers, and of two streams."""
    folder = tmp_path_factory.mktemp("open")
    (folder / "truth").mkdir()
    rng = np.random.default_rng(3)
    labels = [("reference", k, "gangue" if k % 3 == 0 else "coal") for k in range(N)]
    labels += [("strangers", k, "other") for k in range(4)]
    rocks = [
        ("caving-crossing", k, f"{time:.4f}", 0, "gangue" if rng.random() < time / 60 else "coal")
        for k in range(2)
        for time in np.sort(rng.uniform(0, 60, 400))
    ]
    rows = {
        "labels.csv": labels,
        "impacts.csv": rocks,
        "crossings.csv": [("caving-crossing", 0, "30.000"), ("caving-crossing", 1, "30.000")],
    }
    for name, columns in sets.COLUMNS.items():
        sets.write_rows(folder / "truth" / name, columns, rows[name])
    (folder / "truth" / sets.SUMS).write_bytes(sets.sums_text(sets.sums_of(folder / "truth")))
    return folder


def frames_text(change: Callable[[list[str]], object] = lambda lines: None, header: str = "set,id,coal,gangue") -> str:
    """Return predictions of the small set, with a change of its lines."""
    lines = [header, *(f"reference,{k},0.3,0.7" for k in range(N))]
    change(lines)
    return "\n".join(lines) + "\n"


def streams_text(change: Callable[[list[str]], object] = lambda lines: None) -> str:
    """Return predictions of the streams, with a change of their lines."""
    lines = ["set,id,time,share,shut", *(f"caving-crossing,{k},{t},0.4,0" for k in range(2) for t in TIMES)]
    change(lines)
    return "\n".join(lines) + "\n"


def row(line: str, number: int = 2) -> str:
    return frames_text(lambda lines: lines.__setitem__(number, line))


def second(line: str) -> str:
    return streams_text(lambda lines: lines.__setitem__(1, line))


_SHARE = "must be a number from 0 to 1, got"
#: Name, content of the file of predictions (None: no file), what the line says; the exit code is 65 but for no file.
BAD: list[tuple[str, str | bytes | None, tuple[str, ...]]] = [
    ("missing file", None, ("cannot be read (No such file", "check the name")),
    ("empty file", "", ("must have a header and rows, is empty",)),
    ("no text", b"\xff\xfe\x00set", ("must be UTF-8 text",)),
    ("endless cell", "set," + "1" * 200_000, ("must be comma-separated values",)),
    ("labels", "set,id,label\n", ("the header must be set,id,coal,gangue,unknown", "got 'set,id,label'")),
    ("other labels", frames_text(header="set,id,coal,shale"), ("got 'set,id,coal,shale'", "no other labels")),
    ("columns swapped", frames_text(header="set,id,gangue,coal"), ("got 'set,id,gangue,coal'",)),
    ("header alone", "set,id,coal,gangue\n", ("must have rows below its header",)),
    ("missing row", frames_text(lambda lines: lines.pop(8)), ("has 39 of 40 rows and lacks reference 7", "whole set")),
    ("twice", row("reference,3,0.5,0.5"), ("line 5: reference 3 must be given once, is also in line 3",)),
    ("unknown id", row("reference,40,0.3,0.7"), ("line 3: id must be a whole number from 0 to 39, got '40'",)),
    ("id is no number", row("reference,1.0,0.3,0.7"), ("line 3: id must be a whole number", "got '1.0'")),
    ("unknown set", row("refernce,1,0.3,0.7"), ("got 'refernce'; did you mean 'reference'?",)),
    ("set of streams", row("caving-crossing,1,.3,.7"), ("has streams, whose predictions have another header",)),
    ("sum", row("reference,1,0.3,0.8"), ("line 3: probabilities must sum to 1", "0.3 and 0.8 sum to 1.1; normalise")),
    ("nan", row("reference,1,nan,nan"), (f"line 3: coal {_SHARE} 'nan'; if unknown, give 0.5",)),
    ("infinite", row("reference,1,0.3,inf"), (f"gangue {_SHARE} 'inf'",)),
    ("logits", row("reference,1,-2.3,3.3"), (f"coal {_SHARE} '-2.3'",)),
    ("label for a probability", row("reference,1,gangue,1"), (f"coal {_SHARE} 'gangue'",)),
    ("too few cells", row("reference,1,0.3"), ("line 3: must have 4 cells as the header has, got 3",)),
    ("unknown", "set,id,coal,gangue,unknown\nreference,0,.5,.5,yes\n", ("unknown must be 0 or 1, got 'yes'",)),
    ("time", second("caving-crossing,0,9,.4,0"), ("time must be a whole number from 10 to 60 s, got '9'",)),
    ("share", second("caving-crossing,0,10,40,0"), (f"share {_SHARE} '40'",)),
    ("shut", second("caving-crossing,0,10,0.4,0.7"), ("shut must be 0 or 1, got '0.7'",)),
    ("missing second", streams_text(lambda lines: lines.pop(3)), ("has 101 of 102 rows and lacks", "0 at 12 s")),
]


@pytest.fixture(scope="module")
def failed(truth_folder: Path) -> Callable[..., str]:
    """Return what runs the program, and returns the line of its failure."""

    def run(code: int, *arguments: str | Path) -> str:
        with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
            assert program.run([str(one) for one in arguments]) == code, err.getvalue()
        text = err.getvalue()
        assert not out.getvalue() and text.startswith("benchmarks.open: error: ") and text.count("\n") == 1, text
        return text

    return run


@pytest.mark.parametrize(("content", "says"), [case[1:] for case in BAD], ids=[case[0] for case in BAD])
def test_bad_predictions_end_with_one_line(
    content: str | bytes | None, says: tuple[str, ...], truth_folder: Path, tmp_path: Path, failed: Callable[..., str]
) -> None:
    path, results = tmp_path / "mine.csv", tmp_path / "results.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    line = failed(66 if content is None else 65, "enter", "x", path, "-d", truth_folder, "--results", results)
    assert all(text in line for text in says), line
    assert not results.exists()


def test_a_changed_truth_is_refused(truth_folder: Path, tmp_path: Path) -> None:
    for path in (truth_folder / "truth").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes().replace(b",coal\n", b",gangue\n", 1))
    with pytest.raises(BadData, match="must be as it was made"):
        Truth.read(tmp_path)


# -- metrics ---------------------------------------------------------------------------------------------------------


def test_metrics_of_frames_are_those_by_hand() -> None:
    labels = np.array(["coal"] * 6 + ["gangue"] * 4)
    gangue = np.array([0.1, 0.1, 0.1, 0.1, 0.7, 0.5, 0.9, 0.9, 0.9, 0.1])
    unknown = np.array([0, 0, 0, 0, 1, 0, 0, 0, 0, 1], bool)
    found = {one.metric: one for one in judged_frames(Frames(gangue, unknown), labels)}
    assert found["accuracy"].value == pytest.approx((4 + 0.5 + 3) / 10)
    assert found["accuracy of the answered"].value == pytest.approx(7.5 / 8)
    assert found["unknown"].value == pytest.approx(0.2)
    # Bins of .1: 5 frames, one gangue; .5 and .7: one coal each; .9: three gangue.
    assert found["calibration error"].value == pytest.approx((abs(0.5 - 1) + 0.5 + 0.7 + abs(2.7 - 3)) / 10)
    for end in found["accuracy"][2:4]:  # Wilson's ends are where the score is the normal quantile
        assert (end - 0.75) ** 2 / (end * (1 - end) / 10) == pytest.approx(1.959963984540054**2)
    strangers = list(judged_frames(Frames(gangue, unknown), np.array(["other"] * 10)))
    assert [one.metric for one in strangers] == ["unknown"]


def test_calibration_error_and_its_resampling_are_those_of_a_slow_twin() -> None:
    rng = np.random.default_rng(0)
    p, truth = rng.random(300), rng.random(300) < 0.4
    weights = rng.multinomial(300, np.full(300, 1 / 300), 5)
    for row, found in zip(weights, calibration_error(p, truth, weights), strict=True):
        values, said = np.repeat(truth, row), np.repeat(p, row)
        bins = [(said >= k / 10) & (said < (k + 1) / 10) for k in range(10)]
        slow = sum(abs(said[own].mean() - values[own].mean()) * own.sum() for own in bins if own.any()) / 300
        assert found == pytest.approx(slow, rel=1e-12)


def test_shares_and_the_cost_of_a_wrong_time_are_counted_by_hand() -> None:
    # A rock each second at .5; coal until 20 s, then three gangue to one coal.
    time = np.arange(60) + 0.5
    gangue = (time > 20) & (np.arange(60) % 4 != 0)
    stream = Stream(time, gangue, 20.0)
    assert stream.shares()[[0, 10, 20]].tolist() == [0.0, 0.0, 0.7]
    slow = [gangue[(time > t - 10) & (time <= t)].mean() for t in TIMES]
    assert np.allclose(stream.shares(), slow)

    def cost(at: int | None) -> dict[str, float]:
        shut = np.zeros((1, TIMES.size), bool) if at is None else (at <= TIMES)[None]
        own = Streams(stream.shares()[None] + 0.1, shut)
        return {one.metric: one.value for one in judged_streams(own, [stream])}

    late, early, never = cost(28), cost(16), cost(None)
    assert late == pytest.approx(
        {
            "share error": 0.1,
            "cost of the wrong time": 4,
            "gangue let through": 6,
            "coal lost": 0,
            "delay": 8,
        }
    )
    assert (early["cost of the wrong time"], early["coal lost"], early["gangue let through"]) == (4, 4, 0)
    assert (never["cost of the wrong time"], never["gangue let through"], never["delay"]) == (20, 30, 40)
    steady = Stream(time, gangue & (time < 50), float("nan"))
    false = list(judged_streams(Streams(steady.shares()[None], (TIMES >= 50)[None]), [steady]))
    assert [(one.metric, one.value) for one in false] == [("share error", 0.0), ("false shut", 1.0)]


def test_an_entry_replaces_its_earlier_one_in_the_table(
    truth_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames, streams = tmp_path / "f.csv", tmp_path / "s.csv"
    frames.write_text(frames_text())
    streams.write_text(streams_text())
    results = ["--results", str(tmp_path / "results.csv")]
    truth = ["-d", str(truth_folder), *results]
    assert program.run(["enter", "first", str(frames), str(streams), *truth]) == 0
    assert program.run(["enter", "second", str(frames), *truth]) == 0
    frames.write_text(frames_text().replace("0.3,0.7", "0.7,0.3"))
    assert program.run(["enter", "first", str(frames), *truth]) == 0
    capsys.readouterr()
    assert program.run(["table", *results]) == 0
    text = capsys.readouterr().out
    assert "|  | first | second |" in text
    assert "| `reference` | 0.650 (0.495 to 0.779) | 0.350 (0.221 to 0.505) |" in text
    assert "Streams" not in text  # the first entry was replaced
    with (tmp_path / "results.csv").open() as file:
        assert {row["entry"] for row in csv.DictReader(file)} == {"first", "second"}


@pytest.fixture
def real_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of made-up recordings, which take the place of the public ones."""
    folder, listed = tmp_path / "real", {}
    contents = {f"data/steel_nut_M{k}_{number}.wav": b"%d %d" % (k, number) for k in (3, 4) for number in (1, 2, 4)}
    listed["bulk-ramp"] = contents
    listed["taps-pyfrf"] = {}
    for k in (1, 2):
        with io.BytesIO() as file:
            np.save(file, np.array([[0.0, 1.0, 2.0], [0.0, 50.0 * k, 1.0], [0.0, 5.0, -7.0]]))
            listed["taps-pyfrf"][f"data/measurements_{k}.npy"] = file.getvalue()
    for dataset, files in listed.items():
        for path, content in files.items():
            (folder / dataset).mkdir(parents=True, exist_ok=True)
            (folder / dataset / Path(path).name).write_bytes(content)
    rows = {
        dataset: tuple(PublicFile(path, len(one), hashlib.sha256(one).hexdigest()) for path, one in files.items())
        for dataset, files in listed.items()
    }
    monkeypatch.setattr(PublicData, "files", property(lambda data: rows[data.name]))
    return folder


ANSWERS = [
    "set,id,answer",
    *(f"ramp,steel_nut_M{k}_{number}.wav,steel_nut_M3" for k in (3, 4) for number in (1, 2)),
    *("taps,measurements_1.npy,50", "taps,measurements_2.npy,271.82818"),
]


def test_real_recordings_are_judged_by_recording_and_by_tap(real_folder: Path, tmp_path: Path) -> None:
    path, results = tmp_path / "answers.csv", tmp_path / "results.csv"
    path.write_text("\n".join(ANSWERS) + "\n")
    sums = tmp_path / "SHA256SUMS"
    sums.write_text(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  sent/answers.csv\n")
    stated = ["--version", "1.0", "--link", "https://example.org/mine", "--date", "2026-11-28", "--sums", str(sums)]
    enter = ["enter", "mine", str(path), "--real", str(real_folder), "--results", str(results)]
    assert program.run([*enter, *stated]) == 0
    with results.open() as file:
        rows = {row["set"]: row for row in csv.DictReader(file)}
    assert (rows["ramp"]["value"], rows["ramp"]["n"]) == ("0.5", "4")  # not the recordings of number 4
    assert float(rows["taps"]["value"]) == pytest.approx(np.sqrt(0.5), rel=1e-4) and rows["taps"]["n"] == "2"
    assert (rows["taps"]["date"], rows["taps"]["version"]) == ("2026-11-28", "1.0")
    table = judge.markdown(judge.read_results(results))
    assert "| mine | 2026-11-28 | 1.0 | https://example.org/mine |" in table and "| `ramp` | 0.500" in table


@pytest.mark.parametrize(
    ("line", "given", "code", "says"),
    [
        ("ramp,steel_nut_M3_1.wav,brass", [], 65, "answer must be one of steel_nut_M3, steel_nut_M4, got 'brass'"),
        ("ramp,steel_nut_M3_4.wav,steel_nut_M3", [], 65, "id must be a file of ramp, got 'steel_nut_M3_4.wav'"),
        ("taps,measurements_1.npy,-5", [], 65, "answer must be a force above 0 N, got '-5'"),
        ("taps,measurements_1.npy,nan", [], 65, "got 'nan'"),
        ("rump,steel_nut_M3_1.wav,steel_nut_M3", [], 65, "set must be ramp, balls, taps, got 'rump'"),
        ("ramp,steel_nut_M3_1.wav", [], 65, "must have 3 cells"),
        (ANSWERS[2], [], 65, "steel_nut_M3_2.wav must be answered once"),
        (ANSWERS[1], ["--link", "ftp://x"], 65, "--link must be an address that begins with https://"),
        (ANSWERS[1], ["--date", "28.11.2026"], 65, "--date must be a day such as 2026-11-28"),
        (ANSWERS[1], ["--version", "<b>"], 65, "--version must be"),
        (ANSWERS[1], ["--sums", "SHA256SUMS"], 65, "answers.csv: must have the SHA-256 0000"),
        (ANSWERS[1], ["--sums", "absent"], 66, "absent: sums cannot be read"),
        (ANSWERS[1], ["--real", "absent"], 2, "must contain steel_nut_M3_1.wav; cgid fetch bulk-ramp"),
        (ANSWERS[1], ["--real", "changed"], 65, "steel_nut_M3_1.wav: must have the SHA-256"),
    ],
)
def test_bad_entries_of_real_recordings_end_with_one_line(
    line: str,
    given: list[str],
    code: int,
    says: str,
    real_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    failed: Callable[..., str],
) -> None:
    (tmp_path / "away" / "changed").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "away")
    Path("answers.csv").write_text("\n".join([ANSWERS[0], line, *ANSWERS[2:]]) + "\n")
    Path("SHA256SUMS").write_text(f"{'0' * 64}  answers.csv\n")
    Path("changed", "steel_nut_M3_1.wav").write_bytes(b"another")
    results = Path("results.csv")
    options = [*(() if "--real" in given else ("--real", real_folder)), *given]
    assert says in failed(code, "enter", "x", "answers.csv", "--results", results, *options)
    assert not results.exists()


def test_files_need_what_judges_them(tmp_path: Path, failed: Callable[..., str]) -> None:
    for content, says in ((frames_text(), "give --sets"), ("\n".join(ANSWERS) + "\n", "then give --real")):
        (tmp_path / "mine.csv").write_text(content)
        assert says in failed(2, "enter", "x", tmp_path / "mine.csv", "--results", tmp_path / "results.csv")


def test_the_results_are_a_table_in_python() -> None:
    table = cgid.open_results()
    rows = judge.read_results(program.RESULTS)
    assert len(table) == len(rows) and list(table) == list(judge.RESULT_COLUMNS)
    assert table["value"].tolist() == [float(row["value"]) for row in rows]
    assert not table["low"].abs().between(1e-300, 1e-9).any()  # the rounding error of a bound is no bound
    assert (table["date"] >= "2026-11-01").all() and set(table.attrs["units"]) < set(table["metric"])


# -- making ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a trial of three sets, with one stream a part."""
    folder = tmp_path_factory.mktemp("made") / "sets"
    few = {name: ALL[name] for name in ("reference", "strangers")}
    few["caving-constant"] = SHORT
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sets, "all_sets", lambda: few)
        assert program.run(["make", "-o", str(folder), "--most", "3"]) == 0
        assert (
            program.run(["make", "-o", str(folder.with_name("private")), "--most", "3", "--private", str(2**50)]) == 0
        )
    return folder


@pytest.mark.long
def test_signals_are_those_of_cgid_generate(made: Path, tmp_path: Path) -> None:
    seed = sets.PUBLIC_SEED + ALL["reference"].number
    generate(ALL["reference"].scene, tmp_path / "r.h5", 3, seed)
    batch = next(Dataset(tmp_path / "r.h5").batches())
    assert np.load(made / "signals" / "reference-test.npy").tobytes() == batch.signals.tobytes()
    truth = Truth.read(made / "truth")
    assert truth.frames["reference"].tolist() == batch.labels.tolist()
    assert set(truth.frames["strangers"]) == {"other"}
    seed = sets.PUBLIC_SEED + SHORT.number
    scene, crossing = SHORT.stream(seed, 0)
    generate_recordings(scene, tmp_path / "s.h5", 1, seed)
    stored = np.load(made / "signals" / "caving-constant-test.npy")[0]
    assert stored.tobytes() == Recording(tmp_path / "s.h5").samples().tobytes()
    assert np.isnan(crossing) and truth.streams["caving-constant"][0].time.size > 60


@pytest.mark.long
@pytest.mark.parametrize("name", ["tail_beam", "laws", "force-pink"])
def test_public_sets_are_those_whose_sums_are_kept(name: str) -> None:
    one = ALL[name]
    stream = io.BytesIO()
    np.save(stream, sets._frames(one, sets.PUBLIC_SEED + one.number, one.signals["test"])[0])
    kept = dict(line.split("  ")[::-1] for line in sets.KEPT_SUMS.read_text().splitlines())
    assert hashlib.sha256(stream.getvalue()).hexdigest() == kept[f"signals/{name}-test.npy"], (
        "make refuses its own sets: if a change is meant to move their signals, make them, keep the new sums, and "
        "judge the entries again"
    )


def test_a_private_seed_changes_the_test_parts_alone_and_entrants_get_no_truth(made: Path) -> None:
    private = made.with_name("private")
    names = sorted(path.name for path in (made / "signals").iterdir())
    assert names == sorted(path.name for path in (private / "signals").iterdir())
    for name in names:
        same = (made / "signals" / name).read_bytes() == (private / "signals" / name).read_bytes()
        assert same == (not name.endswith("-test.npy") and name != sets.SUMS), name
    assert (private / "truth" / "seed.txt").read_text() == f"{2**50}\n" and not (made / "truth" / "seed.txt").exists()
    for folder in (private / "signals", private / "truth"):
        sets.unchanged_digest(folder)
    assert not any(str(2**50) in path.read_text() for path in (private / "signals").glob("*.csv"))


def test_a_stranger_reads_the_sets_as_the_readme_says(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(sets.HERE) / "README.md").read_text()
    found: dict[str, Any] = {}
    monkeypatch.chdir(made.parent)
    exec(text.split("```python\n")[1].split("```")[0], found)
    assert (
        found["signals"].shape == (3, 2048) and set(found["labels"]) <= {"coal", "gangue"} and len(found["labels"]) == 3
    )


@pytest.mark.long
def test_entries_write_files_that_can_be_entered(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.run(["answer", "constant", "-d", str(made), "-o", str(tmp_path)]) == 0
    for path in write_predictions(ENTRIES["defaults"][1](made / "signals"), tmp_path, "defaults"):
        assert path.exists()
    for name in ("constant", "defaults"):
        files = [str(tmp_path / f"{name}-{kind}.csv") for kind in ("frames", "streams")]
        assert program.run(["enter", name, *files, "-d", str(made), "--results", str(tmp_path / "results.csv")]) == 0
    assert program.run(["answer", "limit", "-d", str(made.with_name("private")), "-o", str(tmp_path)]) == 65
    assert "limit must have the public sets, reference has another seed" in capsys.readouterr().err
    with (tmp_path / "results.csv").open() as file:
        found = {(row["entry"], row["set"], row["metric"]): float(row["value"]) for row in csv.DictReader(file)}
    assert found["constant", "reference", "accuracy"] == 0.5 and found["constant", "strangers", "unknown"] == 0
    own = found["defaults", "caving-constant", "share error"]
    assert own < 0.2 and own < found["constant", "caving-constant", "share error"]
