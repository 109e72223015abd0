"""Every format: a file written by its own library is read back; damaged ones are refused, warned of or read in part."""

import re
import struct
import warnings
from datetime import UTC, datetime
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import loadmat, savemat

from benchmarks.safety.fuzz_recordings import fuzz
from cgid.cli import cli
from cgid.errors import BadData, CgidError, InvalidValue, MissingOption
from cgid.recordings import Blocks, from_sep005, open_recording, read_recording, to_sep005
from cgid.signals import Signal
from tests import few
from tests.recording_files import NAMES, SPECIMENS, UNIT, WRITERS, Channel, _uff_of, blows

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
        with pytest.raises(MissingOption, match="sampling_rate=HZ"):
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
def test_samples_of_a_part_are_those_of_the_whole(specimen, tmp_path, monkeypatch):
    """At the start, across blocks, at the end and behind it; a format that can be sought reads no more."""
    monkeypatch.setattr("cgid.recordings.recording.BLOCK_LENGTH", 700)
    recording = open_recording(written(specimen, tmp_path, blows(3000)), **specimen.options)
    whole = np.concatenate(list(recording.blocks()), axis=1)
    for start, stop in ((0, 1), (0, 3000), (1234, 1240), (650, 2999), (2990, 4000), (3000, 3001), (5000, 5001), (7, 7)):
        part = recording.samples(start, stop)
        assert np.array_equal(part, whole[:, start:stop]) and part.shape[0] == len(recording.channels), (start, stop)
    for wrong in ((-1, 5), (5, 4), (0.5, 2)):
        with pytest.raises(InvalidValue, match=r"st(art|op) must be"):
            recording.samples(*wrong)
    sought = [name for name in ("WAV", "NPY", "NPZ", "HDF5", "TDMS", "FLAC") if specimen.name.startswith(name)]
    assert recording._contents.seekable or not sought


def test_samples_of_a_part_know_gaps_and_units(tmp_path):
    """A row of text that is missing is nan, and volts are what the sensor measured."""
    rows = [f"{n / 1000:.3f},{n}" for n in range(100) if n not in (40, 41)]
    (tmp_path / "a.csv").write_text("time (s),beam (V)\n" + "\n".join(rows) + "\n")
    recording = open_recording(tmp_path / "a.csv", sensitivity="100 mV/g")
    part = recording.samples(38, 44)[0]
    assert np.isnan(part).tolist() == [False, False, True, True, False, False]
    assert part[[0, 1, 4, 5]] == pytest.approx(np.array([38, 39, 42, 43]) * 98.0665, rel=1e-12)


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
                assert outcome.name in ("same", "refused", "warned"), (name, mutation, outcome.told)


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


# ---- what only some files of a format have ----


def read(path, **options):
    """Return the numbers, (n_channels, n_samples), and the recording."""
    recording = open_recording(path, **options)
    return np.concatenate(list(recording.blocks(61, gaps=True)), axis=1), recording


@pytest.mark.parametrize("shift", [8, 0])
def test_24_bits_in_32_are_read_in_the_upper_bits_and_told_in_the_lower(tmp_path, shift):
    numbers = np.array([1, -1, 2**23 - 1, -(2**23), 4321], np.int32)
    stored = (numbers << shift).astype("<i4").tobytes()
    # WAVE_FORMAT_EXTENSIBLE: 24 valid bits, no speakers, and the GUID of PCM.
    form = struct.pack("<HHIIHHHHI", 0xFFFE, 1, 1000, 4000, 4, 32, 22, 24, 0)
    form += struct.pack("<H", 1) + bytes.fromhex("000000001000800000aa00389b71")
    body = b"WAVEfmt " + struct.pack("<I", len(form)) + form + b"data" + struct.pack("<I", len(stored)) + stored
    path = tmp_path / "hit.wav"
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    found, recording = read(path)
    np.testing.assert_array_equal(found[0], numbers / (2.0**23 if shift else 2.0**31))
    assert [("256 times too small" in one) for one in recording.messages] == [] if shift else [True]


def test_a_second_chunk_of_sound_is_told(tmp_path):
    sound = (FRONT * 300).astype("<i2").tobytes()
    chunk = b"data" + struct.pack("<I", len(sound)) + sound
    body = b"WAVEfmt " + struct.pack("<IHHIIHH", 16, 1, 1, 1000, 2000, 2, 16) + chunk + b"note\2\0\0\0ab" + chunk
    path = tmp_path / "hit.wav"
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    found, recording = read(path)
    assert found.shape == (1, N) and f"second chunk of {2 * N} bytes" in recording.messages[0]


SCALE = {
    "NI_Scaling_Status": "unscaled",
    "NI_Number_Of_Scales": 1,
    "NI_Scale[0]_Linear_Slope": 2.5,
    "NI_Scale[0]_Linear_Y_Intercept": 1.0,
    "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
}


def tdms(path, *channels, **of_file):
    """Write one channel for each mapping of properties, of the samples `FRONT`, and return the path."""
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(path)) as writer:
        objects = [nptdms.ChannelObject("beam", f"c{k}", FRONT, about) for k, about in enumerate(channels)]
        writer.write_segment([nptdms.RootObject(of_file), *objects])
    return path


@pytest.mark.parametrize(("kind", "unit", "word"), [("Linear", "N", ""), ("PieceWisePolynomial", None, "not known")])
def test_a_scale_of_tdms_is_applied_or_its_unit_is_not_known(tmp_path, kind, unit, word):
    about = {"wf_increment": 1e-3, "unit_string": "N", "NI_Scale[0]_Scale_Type": kind, **SCALE}
    found, recording = read(tdms(tmp_path / "hit.tdms", about))
    np.testing.assert_allclose(found[0], FRONT if word else 2.5 * FRONT + 1, rtol=1e-15)
    assert recording.channels[0].unit == unit
    assert [word in one for one in recording.messages] == [True] * bool(word)


@pytest.mark.parametrize("where", ["channel", "file", "nowhere"])
@pytest.mark.parametrize("offset", [0.01, -0.01, 5.0])
def test_offsets_of_tdms_shift_channels(tmp_path, where, offset):
    start = {"wf_start_time": np.datetime64("2026-03-04T10:11:12")}
    about = {"wf_increment": 1e-3, **(start if where == "channel" else {})}
    others = start if where == "file" else {}
    path = tdms(tmp_path / "hit.tdms", about, {**about, "wf_start_offset": offset}, **others)
    if offset > 1:
        with pytest.raises(BadData, match="5 s"):
            open_recording(path)
        return
    found, recording = read(path)
    late, early = (FRONT[:-10], FRONT[10:])
    np.testing.assert_array_equal(found, [early, late] if offset > 0 else [late, early])
    assert "first 10 samples" in recording.messages[0]
    expected = None if where == "nowhere" else datetime(2026, 3, 4, 10, 11, 12, 10_000 * (offset > 0), UTC)
    assert recording.start_time == expected


def test_a_timestamp_of_zero_is_no_start(tmp_path):
    path = tdms(tmp_path / "hit.tdms", {"wf_increment": 1e-3, "wf_start_time": np.datetime64("1904-01-01T00:00:00")})
    assert read(path)[1].start_time is None


def test_cells_of_matlab_are_chosen_by_number(tmp_path):
    cell = np.empty(2, object)
    cell[:] = [FRONT, REAR[:300]]
    savemat(tmp_path / "v5.mat", {"sig": cell, "fs": 1000.0})
    with h5py.File(tmp_path / "v73.mat", "w", userblock_size=512) as file:
        file["fs"] = [[1000.0]]
        parts = [file.create_dataset(f"#refs#/{key}", data=row[None]) for key, row in zip("ab", cell, strict=True)]
        stored = file.create_dataset("sig", (1, 2), h5py.ref_dtype)
        stored[0] = [part.ref for part in parts]
        stored.attrs["MATLAB_class"] = np.bytes_("cell")
    for path in (tmp_path / "v5.mat", tmp_path / "v73.mat"):
        with pytest.raises(BadData, match=re.escape("sig(1) (400), sig(2) (300)")):
            open_recording(path)
        found, recording = read(path, variable="sig(2)")
        np.testing.assert_array_equal(found, REAR[None, :300])
        assert recording.sampling_rate == 1000


@pytest.mark.parametrize("unit", ["s", "ms"])
def test_structs_of_axes_state_rate_and_unit(tmp_path, unit):
    axis = {"increment": 1e-3 if unit == "s" else 1.0, "quantity": {"label": unit}}
    signal = {"x_values": axis, "y_values": {"values": FRONT, "quantity": {"label": "N"}}}
    savemat(tmp_path / "hit.mat", {"Signal": signal})
    found, recording = read(tmp_path / "hit.mat")
    np.testing.assert_array_equal(found, FRONT[None])
    assert (recording.sampling_rate, recording.channels[0].unit) == (1000, "N")


def test_functions_of_matlab_are_no_samples(tmp_path):
    savemat(tmp_path / "hit.mat", {"force": FRONT, "fs": 1000.0})
    content = loadmat(tmp_path / "hit.mat") | {"__function_workspace__": np.ones((1, 900), np.uint8)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scipy.io.loadmat", lambda *_, **__: content)
        np.testing.assert_array_equal(read(tmp_path / "hit.mat")[0], FRONT[None])


def test_hdf5_open_in_a_writer_is_told(tmp_path):
    with h5py.File(tmp_path / "live.h5", "w", libver="latest") as file:
        file.create_dataset("force", data=FRONT, maxshape=(None,), chunks=(64,)).attrs["fs"] = 1000.0
        file.swmr_mode = True
        file.flush()
        (tmp_path / "copy.h5").write_bytes((tmp_path / "live.h5").read_bytes())
    with pytest.raises(BadData, match="h5clear -s"):
        open_recording(tmp_path / "copy.h5")
    np.testing.assert_array_equal(read(tmp_path / "live.h5")[0], FRONT[None])


@pytest.mark.parametrize("name", ["Blosc", "LZ4", "Zstd", "Bitshuffle"])
def test_filters_of_hdf5plugin(tmp_path, name):
    filters = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "hit.h5", "w") as file:
        stored = file.create_dataset("force", data=FRONT, chunks=(100,), **getattr(filters, name)())
        stored.attrs["fs"] = 1000.0
    if name == "Bitshuffle":
        with pytest.raises(BadData, match="filter 32008"):
            read(tmp_path / "hit.h5")
        return
    np.testing.assert_array_equal(read(tmp_path / "hit.h5")[0], FRONT[None])


@pytest.mark.parametrize("filling", [0.0, 7.0])
def test_a_last_row_of_uff_may_be_filled_with_zeros(tmp_path, filling):
    _uff_of(tmp_path / "hit.uff", {"front": Channel(FRONT[:-2])}, None)
    lines = (tmp_path / "hit.uff").read_text().splitlines()
    last = len(lines) - 2
    assert len(lines[last]) < 80
    lines[last] += f"{filling:>20.11E}" * ((80 - len(lines[last])) // 20)
    (tmp_path / "hit.uff").write_text("\n".join([*lines, ""]))
    if filling:
        with pytest.raises(BadData, match=f"must have {N - 2} numbers"):
            open_recording(tmp_path / "hit.uff")
        return
    np.testing.assert_allclose(read(tmp_path / "hit.uff")[0][0], FRONT[:-2], rtol=1e-10)


def test_a_data_set_of_uff_that_is_no_recording_is_told(tmp_path):
    """Its function type says that it is a frequency response."""
    specimen = next(one for one in SPECIMENS if one.name == "UFF-58 ASCII")
    path = tmp_path / "a.uff"
    specimen.write(path, blows(400), 51_200.0)
    path.write_bytes(path.read_bytes().replace(b"\n    1         0", b"\n    4         0", 1))
    recording = open_recording(path)
    assert len(recording.channels) == 1
    assert any("data set 1 " in warning for warning in recording.warnings) and not recording.damage


def test_a_row_of_parquet_that_is_a_whole_signal_is_refused(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pyarrow.table({"id": [1, 2], "force": [FRONT.tolist(), REAR.tolist()]}), tmp_path / "a.parquet")
    with pytest.raises(BadData, match="column force are whole signals"):
        open_recording(tmp_path / "a.parquet")


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
    samples = (np.arange(600) ** 2 % 601 - 300).reshape(300, 2)
    path = tmp_path / "hit.xyl"
    path.write_bytes(b"XYLOG001" + np.float64(51_200).tobytes() + samples.astype("<i2").tobytes())
    for name in (None, "xylog"):
        recording = open_recording(path, format=name, full_scale="10 V")
        assert (recording.format, recording.sampling_rate) == ("XYLOG", 51_200.0)
        for _ in range(2):  # a training reads a recording several times
            found = np.concatenate(list(recording.blocks(7)), axis=1)
            np.testing.assert_allclose(found, samples.T * 10 / 32768, rtol=1e-12)
    assert CliRunner().invoke(cli, ["info", str(path), "--set", "format=XYLOG"]).exit_code == 0
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
