"""Every format: a file written by its own library is read back; damaged ones are refused, warned of or read in part."""

import re
import warnings
from datetime import UTC, datetime
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.safety.fuzz_recordings import fuzz
from cgid.cli import cli
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption
from cgid.recordings import Blocks, from_sep005, open_recording, read_recording, to_sep005
from cgid.signals import Signal
from tests import few
from tests.recording_files import NAMES, SPECIMENS, UNIT, WRITERS, Channel, blows

RATE = 51_200.0
#: Formats that have a length to tell by, so that nothing may be missing without a word; and checksums on everything.
LENGTHS = {"WAV", "NPY", "NPZ", "HDF5", "MAT", "TDMS", "UFF-58", "FLAC", "OGG", "W64", "AIFF", "CAF", "AU", "Parquet"}
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
    # The longest form: python benchmarks/safety/fuzz_recordings.py
    monkeypatch.setattr("benchmarks.safety.fuzz_recordings.TIME_LIMIT", 120.0)  # however busy the machine is
    found = fuzz(n, seed=11, folder=tmp_path, n_samples=1500)
    for name, rows in found.items():
        for mutation, outcome, _ in rows:
            assert not outcome.failed, (name, mutation, outcome)
            if name in CHECKSUMS:
                assert outcome.name != "changed", (name, mutation)


# ---- what channels of one file may differ in, in every format that can say it ----

N = 400
FRONT, REAR = blows(N, 1000.0) * 100


def table(name, folder, channels, times=None):
    """Write named channels in a format, and return the recording, or the error that refuses it."""
    suffix, write, library, _ = WRITERS[name]
    pytest.importorskip(library)
    path = folder / f"channels{suffix}"
    write(path, channels, times)
    options = {"variable": "*"} if name in ("NPZ", "MAT", "HDF5") else {}
    try:
        recording = open_recording(path, **options)
        found = np.concatenate(list(recording.blocks(61, gaps=True)), axis=1)
    except BadData as error:
        return None, str(error), {}
    return (
        recording,
        " ".join(recording.messages),
        dict(zip([one.name for one in recording.channels], found, strict=True)),
    )


def that_say(fact):
    return pytest.mark.parametrize("name", [name for name, row in WRITERS.items() if not fact or fact in row[3]])


@that_say("")
def test_channels_by_name_are_read_in_every_format(name, tmp_path):
    recording, said, found = table(name, tmp_path, {"front": Channel(FRONT), "rear": Channel(REAR)})
    assert recording.sampling_rate == pytest.approx(1000, rel=1e-9) and not said
    np.testing.assert_allclose([found["front"], found["rear"]], [FRONT, REAR], rtol=1e-10, atol=1e-9)


@that_say("length")
def test_a_channel_that_ends_early_is_told_or_refused(name, tmp_path):
    recording, said, found = table(name, tmp_path, {"front": Channel(FRONT), "rear": Channel(REAR[:-7])})
    if recording is not None:
        assert said and np.array_equal(found["front"], FRONT)
        assert "rear" not in found or np.isnan(found["rear"][-7:]).all()


@that_say("start")
@pytest.mark.parametrize("late", [0.01, 5.0])
def test_a_channel_that_begins_later_is_shifted_or_refused(name, tmp_path, late):
    recording, said, found = table(name, tmp_path, {"front": Channel(FRONT), "rear": Channel(REAR, late=late)})
    if name == "UFF" and late < 1:
        return  # its starts are in whole seconds
    if recording is not None:
        assert "10 samples" in said and late == 0.01
        np.testing.assert_array_equal([found["front"], found["rear"]], [FRONT[10:], REAR[:-10]])


@that_say("rate")
def test_a_channel_of_another_rate_is_left_out_or_refused(name, tmp_path):
    recording, said, found = table(name, tmp_path, {"front": Channel(FRONT), "rear": Channel(REAR, rate=500.0)})
    assert recording is None or ("rear" in said and "rear" not in found and np.array_equal(found["1"], FRONT))


@that_say("unit")
def test_an_unknown_unit_is_none(name, tmp_path):
    recording, *_ = table(name, tmp_path, {"front": Channel(FRONT, unit="furlong"), "rear": Channel(REAR)})
    assert [channel.unit for channel in recording.channels] == [None, UNIT]


@that_say("")
def test_a_counter_is_no_channel(name, tmp_path):
    counter = Channel(np.arange(N) % 256.0, unit="")
    _, said, found = table(name, tmp_path, {"front": Channel(FRONT, unit=""), "count": counter})
    assert "count" in said and len(found) == 1
    np.testing.assert_allclose(next(iter(found.values())), FRONT, rtol=1e-10, atol=1e-9)


@that_say("")
def test_samples_missing_between_even_times_are_a_gap(name, tmp_path):
    is_there = (np.arange(N) < 100) | (np.arange(N) >= 120)
    channels = {"front": Channel(FRONT[is_there]), "rear": Channel(REAR[is_there])}
    recording, said, found = table(name, tmp_path, channels, np.arange(N)[is_there] / 800)
    if recording is None:
        assert "even" in said and name == "UFF"
        return
    assert recording.sampling_rate == pytest.approx(800, rel=1e-9) and "20 samples in 1 gap" in said
    np.testing.assert_array_equal(found["rear"], np.where(is_there, REAR, np.nan))


# ---- time series of other readers ----


def test_signals_go_into_sep005_and_come_back():
    start = datetime(2026, 3, 4, 10, 11, tzinfo=UTC)
    given = [
        Signal(samples=FRONT, sampling_rate=1000.0, unit="m/s^2", channel="front", start_time=start),
        Signal(samples=REAR, sampling_rate=1000.0, channel="rear"),
    ]
    forms = to_sep005(given)
    assert [sorted(one) for one in forms][1] == ["data", "fs", "name", "unit_str"]
    for one, back in zip(given, from_sep005(forms), strict=True):
        assert np.array_equal(back.samples, one.samples)
        assert (back.sampling_rate, back.unit, back.channel) == (1000.0, one.unit, one.channel)
        assert back.start_time == one.start_time
    (timed,) = from_sep005([{"name": "a", "unit_str": "furlong", "data": FRONT.tolist(), "time": np.arange(N) / 500}])
    assert (timed.sampling_rate, timed.unit) == (pytest.approx(500, rel=1e-9), None)
    with pytest.raises(BadData, match=r"SEP005 a: .*is missing"):
        from_sep005([{"name": "a", "data": FRONT}])
    with pytest.raises(BadData, match="even"):
        from_sep005([{"name": "a", "unit_str": "g", "data": FRONT, "time": np.arange(N) ** 1.5}])


def test_the_checker_of_sdypy_accepts_the_signals():
    checker = pytest.importorskip("sdypy_sep005.sep005")
    start = datetime(2026, 3, 4, tzinfo=UTC)
    checker.assert_sep005(to_sep005([Signal(samples=FRONT, sampling_rate=1000.0, unit="N", start_time=start)]))


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
