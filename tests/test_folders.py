"""Folders of recordings where one recording is taken, with loggers of different chains, and errors of one channel."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest

from cgid.cli.main import run
from tests.streams_of_pulses import RATE, stream

SAMPLES = stream(["coal", "gangue"] * 3, 0.02)
#: Sensitivities of two loggers: newtons a volt.
FIRST, SECOND = 100.0, 250.0


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    header = f"# sampling_rate: {RATE:g} Hz\n{','.join(columns)}"
    np.savetxt(path, np.stack([*columns.values()], axis=1), "%.9g", delimiter=",", header=header, comments="")


@pytest.fixture
def loggers(tmp_path: Path) -> Path:
    """A folder of two loggers in volts, a third in newtons, and a file that is no recording."""
    folder = tmp_path / "day"
    folder.mkdir()
    write(folder / "a.csv", {"hammer (V)": SAMPLES / FIRST})
    write(folder / "b.csv", {"support (V)": SAMPLES / SECOND, "wall (N)": SAMPLES})
    write(folder / "c.csv", {"wall (N)": SAMPLES})
    (folder / "broken.wav").write_bytes(b"RIFF")
    (folder / "notes.md").write_text("no recording")
    return folder


CHAINS = ["--sensitivity", f"a.csv:1={1000 / FIRST} mV/N", "--sensitivity", f"b.csv:support={1000 / SECOND} mV/N"]


def test_a_folder_is_predicted_with_the_chain_of_each_logger(loggers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predict", str(loggers), *CHAINS]) == 65  # broken.wav
    out, err = capsys.readouterr()
    rows = list(csv.DictReader(io.StringIO(out)))
    channels = [("a.csv", "1"), ("b.csv", "support"), ("b.csv", "wall"), ("c.csv", "1")]
    assert sorted({(Path(row["source"]).name, row["channel"]) for row in rows}) == channels
    for channel in channels:
        own, alone = (
            [row for row in rows if (Path(row["source"]).name, row["channel"]) == one]
            for one in (channel, ("c.csv", "1"))
        )
        assert len(own) == 6 and [row["label"] for row in own] == [row["label"] for row in alone]
        for name in ("time_s", "p_coal", "novelty"):
            np.testing.assert_allclose(
                [float(row[name]) for row in own], [float(row[name]) for row in alone], rtol=1e-3
            )
    assert [line for line in err.splitlines() if "error" in line] == [
        f"cgid: error: {loggers / 'broken.wav'}: a WAV file must begin with RIFF and WAVE; the file looks cut off; "
        "export it again"
    ]


def test_a_chain_is_that_of_its_file_only(loggers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["predict", str(loggers / "a.csv"), str(loggers / "c.csv"), *CHAINS[:2]]) == 0
    assert "b.csv" not in capsys.readouterr().err
    assert run(["predict", str(loggers / "a.csv"), *CHAINS]) == 65
    assert "--sensitivity must name one of the files before :, got 'b.csv'" in capsys.readouterr().err


def test_info_describes_each_recording_of_a_folder(loggers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(loggers), "--json"]) == 65
    out, err = capsys.readouterr()
    described = [json.loads(line) for line in out.splitlines()]
    assert [Path(one["file"]).name for one in described] == ["a.csv", "b.csv", "c.csv"]
    # Volts are told of the channel that has them, and never "none".
    assert "channel support: the samples are a voltage [V]" in described[1]["warnings"][0]
    assert described[2]["warnings"] == "none" and described[2]["channel 1"]["impacts"] == 6
    assert [one["channel 1"].get("name") for one in (described[0], described[2])] == ["hammer", "wall"]
    assert "broken.wav" in err


def test_info_of_one_channel(loggers: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(loggers / "b.csv"), "--channel", "wall", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert [name for name in described if name.startswith("channel")] == ["channel wall"]
    assert described["warnings"] == "none"
    assert run(["info", str(loggers / "b.csv"), "--channel", "roof"]) == 65
    assert "channel 'roof' is none of them; choose one of 1 (support), 2 (wall)" in capsys.readouterr().err


FAULTS = {
    "nan": np.full(SAMPLES.size, np.nan),
    "constant": np.full(SAMPLES.size, 5.0),
    "huge": np.where(np.arange(SAMPLES.size) % 2, 1e300, -1e300),
    "inverted": -SAMPLES,
    "clipped": np.clip(SAMPLES, None, 0.1 * SAMPLES.max()),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("command", ["predict", "features", "info"])
def test_what_is_wrong_with_a_channel_is_said_with_its_name(
    command: str, fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if (command, fault) in (("features", "clipped"), ("info", "constant")):
        pytest.skip("a number of the table says it: the flag of each impact, or the lowest and highest sample")
    path = tmp_path / "two.csv"
    write(path, {"front (N)": SAMPLES, "rear (N)": FAULTS[fault]})
    assert run([command, str(path)]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" in line or "hint" in line]
    assert lines and all("channel rear" in line for line in lines)


@pytest.mark.parametrize(
    ("unit", "word"), [("V", "a voltage"), ("m/s^2", "one unit"), ("?", "does not state the unit")]
)
def test_a_unit_that_stops_a_table_of_events_is_that_of_a_channel(
    unit: str, word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "two.csv"
    write(path, {"front (N)": SAMPLES, f"rear ({unit})": SAMPLES})
    assert run(["events", str(path), "-o", "-"]) in (2, 65)
    out, err = capsys.readouterr()
    assert not out and f"{path} channel rear: " in err and word in err
