"""Every format: a file written by its own library is read back; damaged ones are refused, warned of or read in part."""

import re
import warnings
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.fuzz_recordings import fuzz
from cgid.cli import cli
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption
from cgid.recordings import Blocks, open_recording, read_recording
from tests import few
from tests.recording_files import NAMES, SPECIMENS, UNIT, blows

RATE = 51_200.0
#: Formats that have a length to tell by, so that nothing may be missing without a word; and checksums on everything.
LENGTHS = {"WAV", "NPY", "NPZ", "HDF5", "MAT", "TDMS", "UFF-58", "FLAC", "OGG", "Parquet"}
CHECKSUMS = ("NPZ", "HDF5 of cgid")

by_name = pytest.mark.parametrize("specimen", SPECIMENS, ids=lambda specimen: specimen.name)


def written(specimen, folder, samples):
    if not specimen.is_possible:
        pytest.skip(f"{specimen.writer} is not installed, which writes {specimen.name}")
    path = folder / f"whole{specimen.suffix}"
    specimen.write(path, samples, RATE)
    return path


@by_name
def test_what_was_written_is_read(specimen, tmp_path):
    samples = blows(3000)
    path = written(specimen, tmp_path, samples)
    signals = read_recording(path, **specimen.options)
    assert len(signals) == (1 if specimen.name == "HDF5 of cgid" else 2)
    for signal, row in zip(signals, samples, strict=False):
        assert np.abs(signal.samples - row).max() <= specimen.resolution
        assert signal.sampling_rate == pytest.approx(RATE, rel=1e-9)
        assert signal.unit == UNIT and signal.quantity == "acceleration" and not signal.warnings
    if specimen.name in ("CSV", "TXT, decimal comma", "LVM", "TDMS", "Parquet"):
        assert tuple(signal.channel for signal in signals) == NAMES


@by_name
def test_what_a_file_does_not_say_is_asked_for(specimen, tmp_path):
    path = written(specimen, tmp_path, blows(3000))
    if not specimen.says_rate:
        with pytest.raises(MissingOption, match="--rate HZ"):
            open_recording(path)
    if not specimen.says_unit:
        rate = None if specimen.says_rate else RATE
        assert all(channel.unit in (None, "FS") for channel in open_recording(path, sampling_rate=rate).channels)


@by_name
def test_blocks_are_the_whole_whatever_their_length(specimen, tmp_path):
    path = written(specimen, tmp_path, blows(3000))
    whole = np.stack([signal.samples for signal in read_recording(path, **specimen.options)])
    for length in (7, 1000, 5000):
        blocks = list(open_recording(path, **specimen.options).blocks(length))
        assert max(block.shape[1] for block in blocks) <= length
        assert np.array_equal(np.concatenate(blocks, axis=1), whole)


@pytest.mark.long
@by_name
def test_a_file_cut_off_is_refused_or_warned_of(specimen, tmp_path):
    if specimen.name.split()[0] not in LENGTHS:
        pytest.skip(f"nothing in a {specimen.name} file tells where it should end")
    path = written(specimen, tmp_path, blows(3000))
    whole = np.stack([signal.samples for signal in read_recording(path, **specimen.options)])
    content = path.read_bytes()
    for place in [*np.linspace(1, len(content) - 1, 12).astype(int).tolist(), 20, len(content) - 2]:
        path.write_bytes(content[:place])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                signals = read_recording(path, **specimen.options)
        except CgidError as error:
            assert "\n" not in str(error)
            continue
        found = np.stack([signal.samples for signal in signals])
        # What is missing is said; a cut behind the last sample (in an index, a footer) takes nothing away.
        assert signals[0].warnings or np.array_equal(found, whole), place
        assert np.array_equal(found, whole[: len(found), : found.shape[1]]), place


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("n", few([21, 63]))
def test_damaged_files_are_never_more_than_refused(tmp_path, monkeypatch, n):
    # The longest form: python benchmarks/fuzz_recordings.py
    monkeypatch.setattr("benchmarks.fuzz_recordings.TIME_LIMIT", 120.0)  # however busy the machine is
    found = fuzz(n, seed=11, folder=tmp_path, n_samples=1500)
    for name, rows in found.items():
        for mutation, outcome, _ in rows:
            assert not outcome.failed, (name, mutation, outcome)
            if name in CHECKSUMS:
                assert outcome.name != "changed", (name, mutation)


# ---- readers of other packages ----

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "readers.md"


@pytest.fixture
def install(monkeypatch):
    def installed(name, **functions):
        entry = EntryPoint(name, "outside", "cgid.readers")
        monkeypatch.setattr(EntryPoint, "load", lambda self: SimpleNamespace(**functions))
        monkeypatch.setattr("importlib.metadata.entry_points", lambda **which: EntryPoints([entry]).select(**which))

    return installed


@pytest.mark.parametrize("n", [1, 2])
def test_the_readers_of_the_documentation_read_their_format(install, tmp_path, n):
    names = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[:n]:
        exec(code, names)
    install("XYLOG", is_format=names["is_format"], read=names["read"])
    samples = np.arange(-300, 300).reshape(300, 2)
    path = tmp_path / "hit.xyl"
    path.write_bytes(b"XYLOG001" + np.float64(51_200).tobytes() + samples.astype("<i2").tobytes())
    for name in (None, "xylog"):
        recording = open_recording(path, format=name, full_scale="10 V")
        assert (recording.format, recording.sampling_rate) == ("XYLOG", 51_200.0)
        for _ in range(2):  # a training reads a recording several times
            found = np.concatenate(list(recording.blocks(7)), axis=1)
            np.testing.assert_allclose(found, samples.T * 10 / 32768, rtol=1e-12)
    assert CliRunner().invoke(cli, ["info", str(path), "--format", "XYLOG"]).exit_code == 0
    # A name for text is text, whatever readers would say.
    (tmp_path / "hit.csv").write_text("t,F\n0,1\n1,2\n2,1\n")
    install("XYLOG", is_format=lambda head: True, read=names["read"])
    assert open_recording(tmp_path / "hit.csv").format == "text"


def test_a_gap_moves_no_later_time(install, tmp_path):
    pieces = [(0, np.ones((1, 3))), (5, np.full((1, 2), 2.0))]
    blocks = Blocks(n_channels=1, read=lambda length, channels: iter(pieces), sampling_rate=10.0)
    found = np.concatenate(list(blocks.joined(100, [0])), axis=1)
    np.testing.assert_array_equal(found, [[1, 1, 1, np.nan, np.nan, 2, 2]])
    install("gaps", is_format=lambda head: True, read=lambda path, variable: blocks)
    path = tmp_path / "hit.bin"
    path.write_bytes(b"anything")
    with pytest.raises(BadData):
        list(open_recording(path).blocks())


def refuse(path, variable):
    raise BadData("the file looks cut off")


@pytest.mark.parametrize(
    "read",
    [
        lambda path, variable: np.ones(3),
        lambda path, variable: 1 / 0,
        refuse,
        lambda path, variable: Blocks(1, lambda length, channels: 1 / 0, sampling_rate=1.0),
        lambda path, variable: Blocks.of_array(np.ones((1, 3)), sampling_rate=-1.0),
    ],
)
def test_a_reader_that_fails_is_told(install, tmp_path, read):
    install("broken", is_format=lambda head: True, read=read)
    path = tmp_path / "hit.bin"
    path.write_bytes(b"anything")
    with pytest.raises(BadData, match=r"hit.bin: .*(broken|sampling rate|cut off)"):
        list(open_recording(path).blocks())


def test_a_format_is_chosen_by_name(tmp_path):
    path = tmp_path / "hit.bin"
    path.write_text("1\n2\n1\n")
    assert open_recording(path, format="TEXT", sampling_rate=1.0).format == "text"
    for name in ("WAV", "NPY", "NPZ", "HDF5", "MATLAB", "FLAC"):
        with pytest.raises(BadData):
            open_recording(path, format=name, sampling_rate=1.0)
    with pytest.raises(InvalidValue, match="nothing"):
        open_recording(path, format="nothing", sampling_rate=1.0)
