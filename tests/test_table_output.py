"""Tables as others read them: stdout by plain `pandas.read_csv`, files by the library of their format."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pandas
import pyarrow.parquet
import pytest
from scipy.io import wavfile

from cgid.cli.main import run
from cgid.cli.output import finite
from cgid.cli.table import ENDINGS, TableOutput
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction import identify_recording
from cgid.identification.training.manifest import read_manifest
from cgid.recordings import open_recording
from cgid.units import numbers
from tests.streams_of_pulses import RATE, ROOT, stream, window_model

SAMPLE = str(ROOT / "datasets" / "sample.csv")
RAW = ["--rate", str(RATE), "--unit", "N"]
FLAGS = ["overlapping", "clipped", "cut_off"]


def printed(*arguments: str, code: int = 0, content: bytes = b"") -> tuple[pandas.DataFrame, str]:
    """Return what a command prints: stdout as pandas reads it, and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with (
        io.TextIOWrapper(tempfile.TemporaryFile()) as stdin,
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        stdin.buffer.write(content)
        stdin.buffer.seek(0)
        patch.setattr(sys, "stdin", stdin)
        assert run([*arguments]) == code, err.getvalue()
    out.seek(0)
    return pandas.read_csv(out), err.getvalue()


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "data.h5"
    assert run(["generate", "reference", "-o", str(path), "-n", "12"]) == 0
    return path


# -- stdout ------------------------------------------------------------------------------------------------


def test_predict_prints_a_table(tmp_path: Path) -> None:
    both = np.stack([stream(["coal", "gangue"] * 3, 0.02, seed=k) for k in (1, 2)])
    np.save(tmp_path / "two.npy", both)
    table, err = printed("predict", str(tmp_path / "two.npy"), *RAW)
    columns = ["source", "channel", "time_s", "label", "p_coal", "p_gangue", "novelty", *FLAGS, "problem"]
    assert list(table.columns) == columns
    answers = list(
        identify_recording(
            open_recording(tmp_path / "two.npy", sampling_rate=RATE, unit="N"),
            StoredModel.load(ROOT / "models" / "default.npz"),
        )
    )
    assert len(answers) == 12
    # To the sample, and to the fourth digit of a probability.
    np.testing.assert_allclose(table["time_s"] * RATE, [answer.time * RATE for answer in answers], rtol=0, atol=0.011)
    for label in ("coal", "gangue"):
        expected = [answer.probabilities[label] for answer in answers]
        np.testing.assert_allclose(table[f"p_{label}"], expected, rtol=0, atol=5.1e-5)
    assert table["channel"].tolist() == [int(answer.channel) for answer in answers]
    assert [table[name].dtype for name in FLAGS] == [bool] * 3
    assert err.count(": gangue fraction") == 2 and "in 0.12 s\n" in err and "source," not in err


def test_files_share_one_head_and_a_bad_one_costs_no_row(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("")
    table, err = printed("predict", SAMPLE, str(tmp_path / "bad.csv"), SAMPLE, code=65)
    assert table["label"].tolist() == ["coal", "gangue"] * 6
    assert "bad.csv" in err


def test_windows_sets_and_datasets_have_their_own_columns(tmp_path: Path, dataset: Path) -> None:
    rng = np.random.default_rng(4)
    (tmp_path / "m.npz").write_bytes(window_model(hop_time=0.1).to_bytes())
    wavfile.write(tmp_path / "n.wav", 8000, (rng.normal(size=(8000, 2)) / 5).astype(np.float32))
    table, _ = printed("predict", str(tmp_path / "n.wav"), "--model", str(tmp_path / "m.npz"))
    assert list(table.columns[:5]) == ["source", "channel", "time_s", "end_s", "label"]
    np.testing.assert_allclose(table["end_s"] - table["time_s"], 0.1)
    table, err = printed("predict", str(dataset), SAMPLE, "--set", "coverage=0.9")
    assert list(table.columns[-3:]) == ["prediction_set", "index", "truth"]
    assert table["index"].tolist()[:12] == list(range(12)) and table["index"][12:].isna().all()
    with h5py.File(dataset) as file:
        assert table["truth"].tolist()[:12] == [label.decode() for label in file["labels"]]
    assert set(table["prediction_set"].dropna()) <= {"coal", "gangue", "coal+gangue"}
    assert "of 12 labelled impacts" in err


def test_monitor_prints_a_table_even_of_silence() -> None:
    raw = ["--rate", str(RATE), "--channels", "1", "--sample-format", "f32le", "--unit", "N"]
    force = stream(["coal"] * 14 + ["gangue"] * 14, 0.02)
    table, err = printed("monitor", "-", *raw, "--set", "window=0.24", content=force.astype("<f4").tobytes())
    assert len(table) == 28 and set(table["source"]) == {"stdin"}
    assert "SHUT" not in err and "\nstdin: 28 impacts: " in err  # the first 25 s need 60
    table, err = printed("monitor", "-", *raw, content=bytes(4 * 100_000))
    assert table.empty and list(table.columns[:4]) == ["source", "channel", "time_s", "label"]
    assert "stdin: 0 impacts: none in 0.5 s" in err


def test_features_print_a_table(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, err = printed("features", SAMPLE, SAMPLE, "--features", "peak_force,width_10")
    assert list(table.columns) == ["source", "channel", "time_s", "peak_force_N", "width_10_s", "problem"]
    capsys.readouterr()
    assert run(["features", SAMPLE, "--features", "peak_force,width_10", "--json"]) == 0
    rows = [json.loads(line)["features"] for line in capsys.readouterr().out.splitlines()]
    for name, column in (("peak_force", "peak_force_N"), ("width_10", "width_10_s")):
        np.testing.assert_allclose(table[column], [row[name] for row in rows] * 2, rtol=1e-7)
    assert err == f"{SAMPLE}: 200000 Hz, 6 impacts, baseline removed\n" * 2
    table, err = printed("features", str(dataset))
    assert table["index"].tolist() == list(range(12)) and set(table["label"]) <= {"coal", "gangue"}
    assert err == f"{dataset}: 200000 Hz, 12 signals, baseline removed\n"


def test_channels_of_two_quantities_share_a_table_and_files_do_as_far_as_they_can(tmp_path: Path) -> None:
    force = stream(["coal", "gangue"], 0.02)
    times = np.arange(force.size) / RATE
    both = tmp_path / "both.csv"
    lines = [f"{t!r},{f!r},{f / 40!r}" for t, f in zip(times.tolist(), force.tolist(), strict=True)]
    both.write_text("time (s),hammer (N),beam (m/s^2)\n" + "\n".join(lines) + "\n")
    table, _ = printed("features", str(both))
    hammer, beam = table[table["channel"] == "hammer"], table[table["channel"] == "beam"]
    assert hammer["peak_force_N"].notna().all() and hammer["peak_amplitude_m_s2"].isna().all()
    assert beam["peak_force_N"].isna().all() and beam["peak_amplitude_m_s2"].notna().all()
    # The sample has the columns of the hammer alone.
    table, err = printed("features", SAMPLE, str(both))
    assert "peak_amplitude_m_s2" not in table and "skipped, a separate run has all" in err
    (tmp_path / "beam.csv").write_text(
        "\n".join(f"{t.rsplit(',', 2)[0]},{t.rsplit(',', 1)[1]}" for t in both.read_text().splitlines()) + "\n"
    )
    table, err = printed("features", SAMPLE, str(tmp_path / "beam.csv"), code=65)
    assert len(table) == 6 and "its features must be among those of the first file" in err


def test_names_are_quoted_and_cannot_command_the_terminal(tmp_path: Path) -> None:
    for name in ('a, "b"\nc.npy', "a\nb.npy"):
        strange = tmp_path / name
        np.save(strange, stream(["coal", "gangue"], 0.02))
        for command in ("predict", "features"):
            table, _ = printed(command, str(strange), *RAW)
            assert table["source"].tolist() == [str(strange)] * 2
    evil = tmp_path / "a\x1b[2J\rb.npy"
    strange.rename(evil)
    table, _ = printed("predict", str(evil), *RAW)
    assert set(table["source"]) == {str(evil).replace("\x1b", r"\x1b").replace("\r", r"\r")}
    assert run(["predict", str(evil), *RAW, "-o", str(tmp_path / "rows.csv")]) == 0
    assert set(pandas.read_csv(tmp_path / "rows.csv")["source"]) == {str(evil)}


@pytest.mark.parametrize("name", ["=cmd|calc!A0.npy", "+a.npy", "-a.npy", "@a.npy", "\ta.npy", "'=a.npy"])
def test_no_cell_is_a_formula(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither in the tables of answers and features nor in one of impacts, which names the file again."""
    monkeypatch.chdir(tmp_path)
    np.save(name, stream(["coal", "gangue"], 0.02))
    for command in ("predict", "features", "events"):
        assert run([command, *RAW, "-o", f"{command}.csv", "--", name]) == 0
        cells = pandas.read_csv(f"{command}.csv").iloc[:, 0].tolist()
        # A manifest names a file in this folder, too, where blanks at the beginning of a cell do not count.
        assert cells == [f"./{name}" if command == "events" and name[0] == "\t" else f"'{name}"] * 2
    text = Path("events.csv").read_text().replace(",,", ",coal,", 1)
    Path("labelled.csv").write_text("\n".join(text.splitlines()[:2]))
    (one,) = read_manifest("labelled.csv").annotations
    assert one.path == Path(name) and one.label == "coal"
    assert run(["predict", *RAW, "-o", "rows.jsonl", "--", name]) == 0
    assert json.loads(Path("rows.jsonl").read_text().splitlines()[0])["source"] == name


# -- files -------------------------------------------------------------------------------------------------


def read(path: Path) -> pandas.DataFrame:
    """Return a table file by the library of its format."""
    if path.suffix == ".csv":
        return pandas.read_csv(path)
    if path.suffix == ".jsonl":
        return pandas.read_json(path, lines=True)
    if path.suffix == ".parquet":
        return pandas.read_parquet(path)
    columns = {}
    with h5py.File(path) as file:
        for name, column in file["columns"].items():
            values = column.asstr()[:] if column.dtype.kind == "S" else column[:]
            columns[name] = values
            assert column.fletcher32
    return pandas.DataFrame(columns)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_holds_what_is_printed(
    ending: str, tmp_path: Path, dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = tmp_path / os.fsdecode(b"caf\xe9 \xc3\xa9.npy")  # the first letter is no text in UTF-8
    np.save(name, stream(["coal", "gangue"], 0.02))
    path = tmp_path / f"rows{ending}"
    for command in ("predict", "features"):
        assert run([command, str(dataset), SAMPLE]) == 0
        expected = pandas.read_csv(io.StringIO(capsys.readouterr().out))
        assert run([command, str(dataset), SAMPLE, "-o", str(path), "--overwrite"]) == 0
        out, err = capsys.readouterr()
        assert out == "" and err.endswith(f"wrote {path}\n")
        found = read(path)
        assert list(found.columns) == list(expected.columns)
        for column in expected.dropna(axis=1, how="all").select_dtypes("number").columns.drop("index"):
            places = {"novelty": 3, "time_s": 7}.get(column, 4 if column.startswith("p_") else 99)
            np.testing.assert_allclose(
                found[column].astype(float), expected[column], rtol=1e-7, atol=0.51 * 10.0**-places
            )
        assert found["index"].tolist()[:12] == list(range(12))
        for column in {"source", "label", "clipped"} & set(expected.columns):
            assert found[column].where(found[column].notna(), "").tolist() == expected[column].fillna("").tolist()
        assert run([command, str(name), *RAW, "-o", str(path), "--overwrite"]) == 0
        assert read(path)["source"].str.endswith(r"caf\udce9 é.npy").all()


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(("command", "kind"), [("predict", "answers"), ("features", "features")])
def test_a_table_is_known_again(
    command: str, kind: str, ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"rows{ending}"
    assert run([command, SAMPLE, "-o", str(path)]) == 0
    columns = list(read(path).columns)
    capsys.readouterr()
    assert run(["info", str(path), "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert (about["kind"], about["rows"]) == (f"table of {kind}", 6)
    assert sorted(about["columns"]) == sorted(columns)
    assert run(["verify", str(path)]) == 0
    out, err = capsys.readouterr()
    state = "whole" if ending in (".parquet", ".h5", ".hdf5") else "no checksum, readable"
    assert (out, err) == (f"{path}: table of {kind} of 1 file, {state}: 6 rows of {len(columns)} columns\n", "")
    # Broken off in a row, or a flipped bit where there are sums.
    content = bytearray(path.read_bytes())
    if ending in (".csv", ".jsonl"):
        content = content[: -len(content.splitlines()[-1]) // 2]
    elif ending == ".parquet":
        column = pyarrow.parquet.ParquetFile(path).metadata.row_group(0).column(0)
        start = column.dictionary_page_offset or column.data_page_offset
        content[start + column.total_compressed_size - 1] ^= 1  # the last byte of a page
    else:
        with h5py.File(path) as file:
            content[file["columns/time_s"].id.get_chunk_info(0).byte_offset] ^= 1
    path.write_bytes(content)
    for again in ("verify", "info"):
        assert run([again, str(path)]) == 65
    assert capsys.readouterr().out.startswith(f"{path}: table of 1 file, damaged")


def test_a_file_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bad.csv").write_text("")
    path = tmp_path / "rows.csv"
    assert run(["predict", str(tmp_path / "bad.csv"), "-o", str(path)]) == 65
    assert not path.exists()
    assert run(["predict", SAMPLE, str(tmp_path / "bad.csv"), "-o", str(path)]) == 65
    assert len(pandas.read_csv(path)) == 6
    before = path.read_bytes()
    assert run(["predict", SAMPLE, "-o", str(path)]) == 73
    assert run(["predict", str(tmp_path / "bad.csv"), "--overwrite", "-o", str(path)]) == 65
    assert path.read_bytes() == before
    failing = Path.open

    def opened(path: Path, *arguments: object, **settings: object) -> object:
        if "late" in path.name and arguments == ("xb",):
            monkeypatch.setattr(Path, "open", failing)  # there is room again for the second file
            raise OSError(28, "No space left on device")
        return failing(path, *arguments, **settings)

    monkeypatch.setattr(Path, "open", opened)
    assert run(["predict", SAMPLE, SAMPLE, "-o", str(tmp_path / "late.csv")]) == 73
    assert not (tmp_path / "late.csv").exists()
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert run(["predict", SAMPLE, "-o", str(tmp_path / "rows.parquet")]) == 69


@pytest.mark.parametrize("ending", [".parquet", ".h5"])
def test_rows_are_written_in_blocks(ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cgid.store.table._ROWS", 10)
    for n in (0, 10, 25):
        with TableOutput(str(tmp_path / f"{n}{ending}")) as table:
            table.begin([numbers("x", "m/s^2"), numbers("a/b"), numbers("y", "N"), numbers("y", "m/s^2")])
            for value in range(n):
                table.add({"x_m_s2": value / 3, "y_N": 1.0, "y_m_s2": 2.0})
        found = read(tmp_path / f"{n}{ending}")
        assert found["x_m_s2"].tolist() == [value / 3 for value in range(n)]
        assert len(found) == found.iloc[:, 1].isna().sum() == n
        assert found.filter(like="y").to_numpy().tolist() == [[1.0, 2.0]] * n


def test_json_has_no_nan_and_no_infinity():
    assert finite({"a": [math.nan, 1.0, 2], "b": {"c": -math.inf}}) == {"a": [None, 1.0, 2], "b": {"c": None}}
