"""Recordings by blocks: the same numbers as all at once, in flat memory; damaged ones; streams that never end."""

import io
import os
import struct
import tracemalloc
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cgid.errors import BadData
from cgid.identification.prediction.stream import _Quiet
from cgid.recordings import open_recording, read_recording
from cgid.recordings import text as rows
from cgid.recordings.gaps import Gaps, largest
from cgid.recordings.live import live_stream
from cgid.recordings.recording import Channel

SAMPLE = Path(__file__).parents[1] / "datasets" / "sample.csv"


@pytest.fixture
def write(tmp_path):
    def written(content, name="recording"):
        file = tmp_path / name
        file.write_bytes(content.encode() if isinstance(content, str) else content)
        return file

    return written


@pytest.fixture
def small_pieces(monkeypatch):
    """Text is read by pieces of a few rows, as if the file were long."""

    def shortened(size=200):
        monkeypatch.setattr(rows, "PIECE", size)

    return shortened


def whole(recording, length=1000):
    return np.concatenate(list(recording.blocks(length)), axis=1)


def peak_memory(recording):
    tracemalloc.start()
    try:
        n_samples = sum(block.shape[1] for block in recording.blocks())
        return n_samples, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# ---- text by pieces ----


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10**6),
    n_samples=st.integers(60, 300),
    size=st.integers(60, 900),
    length=st.sampled_from([1, 7, 100, 10**6]),
    comma=st.booleans(),
    comments=st.booleans(),
    encoding=st.sampled_from(["utf-8", "utf-16", "gbk"]),
)
def test_text_by_pieces_is_the_text_at_once(tmp_path_factory, seed, n_samples, size, length, comma, comments, encoding):
    random = np.random.default_rng(seed)
    table = random.normal(size=(n_samples, 2)).round(6)
    lines = [f"{k / 1000:.3f};{a};{b}" for k, (a, b) in enumerate(table.tolist())]
    if comma:
        lines = [line.replace(".", ",") for line in lines]
    if comments:
        lines += ["# a remark behind the last row", "", *["% another one"] * 40]
    path = tmp_path_factory.mktemp("text") / "long.csv"
    path.write_bytes("\n".join(["时间 (s);左 (g);right (m/s^2)", *lines, ""]).encode(encoding))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "PIECE", size)
        recording = open_recording(path)
        blocks = list(recording.blocks(length))
        (second,) = read_recording(path, channel="right")
    assert max(block.shape[1] for block in blocks) <= length
    assert np.array_equal(np.concatenate(blocks, axis=1), table.T)
    assert second.samples.tolist() == table[:, 1].tolist()
    assert recording.sampling_rate == pytest.approx(1000, rel=1e-9)
    assert [(channel.name, channel.unit) for channel in recording.channels] == [("左", "g"), ("right", "m/s^2")]


@pytest.mark.parametrize("size", [40, 57, 90])
def test_a_line_among_rows_is_found_whatever_the_pieces(write, small_pieces, size):
    small_pieces(size)
    rows_of_text = [f"{k}.5" for k in range(12)]
    for place in range(1, 12):
        lines = [*rows_of_text[:place], *["# N/A"] * (1 + place % 7), *rows_of_text[place:]]
        path = write("# sampling_rate: 1000 Hz\n" + "\n".join(lines) + "\n")
        with pytest.raises(BadData, match=rf"line {place + 2} before sample {place} is '# N/A'"):
            whole(open_recording(path))
    path = write("# sampling_rate: 1000 Hz\n" + "\n".join([*rows_of_text, *["# N/A"] * 9]))
    assert whole(open_recording(path)).tolist() == [[k + 0.5 for k in range(12)]]


def long_text(n_samples=300, rate=44100, digits=6):
    return ["t (s),a (g)", *(f"{k / rate:.{digits}f},{k % 7}" for k in range(n_samples))]


def test_rate_of_a_long_text_is_that_of_its_ends(write, small_pieces):
    small_pieces(6000)
    # 500 samples of times rounded to 1 us tell the rate to 1e-4, both ends of 3000 tell it to 1.5e-5.
    recording = open_recording(write("\n".join(long_text(3000))))
    assert recording.sampling_rate == pytest.approx(44100, rel=1.5e-5)
    assert whole(recording).shape == (1, 3000)
    # Coarser digits leave the number of samples open; then the rate is at least not worse than the beginning tells.
    recording = open_recording(write("\n".join(long_text(3000, digits=5))))
    assert recording.sampling_rate == pytest.approx(44100, rel=1e-3)


@pytest.mark.parametrize(
    ("at", "row", "words"),
    [
        (250, "0.1,oops", ["sample 249", "line 251", "'oops'"]),
        (250, "0.005646258", ["sample 249", "line 251", "has 1"]),
        (250, "0.005660,2", ["even steps to 1 %, sample 25", "sampling_rate"]),
        (250, "0.001,2", ["increase", "sample 249"]),
        (300, "0.0068,", ["sample 299", "line 301", "column 2 is empty"]),
    ],
)
def test_faults_far_behind_the_first_piece_are_told_by_their_place(write, small_pieces, at, row, words):
    small_pieces(600)
    lines = long_text()
    lines[at] = row
    recording = open_recording(write("\n".join(lines) + "\n"))
    with pytest.raises(BadData) as caught:
        whole(recording)
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize(
    ("header", "rate"),
    [
        ("# Sampling interval: 20 us", 5e4),
        ("dt = 1e-3", 1000),
        ("Delta_X;0.5", 2),
        ("采样率：51.2 kHz", 51200),
        ("采样间隔（ms）：0.5", 2000),
        ("Abtastrate: 10 kHz", 1e4),
        ("# fs = 1000\n# sample rate: 1 kHz", 1000),
    ],
)
def test_headers_that_give_the_rate(write, header, rate):
    assert open_recording(write(f"{header}\n1\n2\n")).sampling_rate == pytest.approx(rate)


# ---- WAV ----


def chunk(name, body):
    return name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)


def wav_file(samples, *, before=b"", after=b"", size=None, outer=None, align=2, byte_rate=None, bits=16):
    form = struct.pack("<HHIIHH", 1, 1, 1000, 1000 * align if byte_rate is None else byte_rate, align, bits)
    data = b"data" + struct.pack("<I", len(samples) if size is None else size) + samples + b"\0" * (len(samples) % 2)
    body = b"WAVE" + chunk(b"fmt ", form) + before + data + after
    return b"RIFF" + struct.pack("<I", len(body) if outer is None else outer) + body


WORDS = np.arange(1, 101, dtype="<i2")


@pytest.mark.parametrize("subtype", ["PCM_U8", "PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE"])
@pytest.mark.parametrize("container", ["WAV", "WAVEX", "RF64", "RIFX"])
def test_wav_is_what_libsndfile_reads(tmp_path, subtype, container):
    soundfile = pytest.importorskip("soundfile")
    path = tmp_path / "three.wav"
    samples = np.random.default_rng(1).uniform(-0.99, 0.99, (1001, 3))
    options = {"format": "WAV", "endian": "BIG"} if container == "RIFX" else {"format": container}
    soundfile.write(path, samples, 44100, subtype=subtype, **options)
    expected, rate = soundfile.read(path, always_2d=True)
    recording = open_recording(path)
    assert (recording.sampling_rate, recording.n_samples, recording.warnings) == (rate, 1001, ())
    for length in (10, 2000):
        assert np.array_equal(whole(recording, length), expected.T)
    assert np.array_equal(whole(open_recording(path, channel=[3, 1])), expected.T[[2, 0]])


def test_wav_cut_at_any_byte_gives_what_is_whole_and_a_warning(write):
    content = wav_file(WORDS.tobytes(), before=chunk(b"note", b"x"))
    expected = WORDS / 2**15
    for length in range(1, len(content)):
        path = write(content[:length])
        n_samples = (length - 54) // 2
        if n_samples < 1:
            with pytest.raises(BadData, match=r"cut off|at least one|fields|numbers"):
                read_recording(path, sampling_rate=1)
            continue
        (signal,) = read_recording(path)
        assert signal.samples.tolist() == expected[:n_samples].tolist()
        (warning,) = signal.warnings
        assert f"declares 200 bytes of sound and {length - 54} follow" in warning


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (wav_file(WORDS.tobytes(), size=150), "50 bytes after the declared sound"),
        (wav_file(WORDS.tobytes()[:-1]), "not complete frames of 2; the last 1 were left out"),
        (wav_file(WORDS.tobytes(), byte_rate=4000), "1000 Hz of 2 bytes each are not 4000 bytes/s"),
        (wav_file(WORDS.tobytes(), align=4), "16 bits do not take 4 bytes each"),
    ],
)
def test_wav_that_contradicts_itself_is_told(write, content, word):
    recording = open_recording(write(content))
    assert [word in warning for warning in recording.warnings] == [True]


@pytest.mark.parametrize("content", [wav_file(WORDS.tobytes()), wav_file(b"ab").replace(b"\xe8\x03", b"\0\0")])
def test_a_given_rate_is_used_instead_of_a_wrong_one_of_the_header_and_told(write, content):
    path = write(content)
    for recording in (open_recording(path, sampling_rate=1024), live_stream(io.BytesIO(content), sampling_rate=1024)):
        assert recording.sampling_rate == 1024
        assert ["Hz; 1024 Hz is used, as given" in warning for warning in recording.warnings][-1:] == [True]
    if b"\xe8\x03" in content:
        assert open_recording(path, sampling_rate=1000.05).warnings == ()
    else:
        with pytest.raises(BadData, match="states 0 Hz; give it with sampling_rate=HZ"):
            open_recording(path)


def test_absurd_headers_take_no_memory(write):
    content = bytearray(wav_file(WORDS.tobytes(), size=4_000_000_000))
    assert read_recording(write(content))[0].samples.size == 100
    content[22:24] = struct.pack("<H", 65535)
    content[32:34] = struct.pack("<H", 65535)
    with pytest.raises(BadData):
        read_recording(write(content))
    # Many empty chunks, and one that is larger than the file.
    for chunks in (chunk(b"fill", b"") * 5000, b"fill" + struct.pack("<I", 2**31)):
        with pytest.raises(BadData, match="chunk of sound"):
            read_recording(write(wav_file(WORDS.tobytes(), before=chunks)))


def sparse(path, head, size):
    with path.open("wb") as file:
        file.write(head)
        file.truncate(len(head) + size)
    return path


def test_memory_does_not_grow_with_the_recording(tmp_path, small_pieces):
    size = 24_000_000
    wav = sparse(tmp_path / "long.wav", wav_file(b"", size=size, outer=size + 36), size)
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": (4, size // 16)})
    npy = sparse(tmp_path / "long.npy", file.getvalue(), size)
    for path, n_samples in ((wav, size // 2), (npy, size // 16)):
        counted, peak = peak_memory(open_recording(path, sampling_rate=1000))
        assert counted == n_samples and peak < 8e6, path
    small_pieces(20_000)
    text = tmp_path / "long.csv"
    text.write_text("t,F\n" + "".join(f"{k / 1000:.3f},{k % 9}\n" for k in range(100_000)))
    counted, peak = peak_memory(open_recording(text))
    assert counted == 100_000 and peak < 1e6


# ---- LabVIEW measurement files ----


def lvm(
    rows,
    *,
    x_columns="No",
    separator="\t",
    named="Tab",
    decimal=".",
    samples=None,
    delta="1.000000E-3",
    x0="0.0",
    time="10:00:00.5",
    names=("F", "a"),
    units=("Newtons", "g"),
    head=True,
    special="",
    tags="",
):
    """Return a file, or a further segment, as "Write To Measurement File" writes it."""
    gap = separator if x_columns != "Multi" else separator * 2
    n_samples = samples if samples is not None else [len(rows)] * len(names)

    def line(tag, values):
        return tag + separator + gap.join(map(str, values)) + separator

    labels = (
        separator.join(f"X_Value{separator}{name}" for name in names)
        if x_columns == "Multi"
        else separator.join(["X_Value", *names])
    )
    above = [
        f"LabVIEW Measurement{separator}",
        f"Writer_Version{separator}2",
        f"Separator{separator}{named}",
        f"Decimal_Separator{separator}{decimal}",
        f"Multi_Headings{separator}Yes",
        f"X_Columns{separator}{x_columns}",
        f"Time_Pref{separator}Relative",
        f"Date{separator}2026/03/04",
        f"Time{separator}10:00:00.5",
        f"***End_of_Header***{separator}",
    ]
    segment = [
        separator,
        *([special] if special else []),
        line("Channels", [len(names)]),
        line("Samples", n_samples),
        line("Date", ["2026/03/04"] * len(names)),
        line("Time", [time] * len(names)),
        line("Y_Unit_Label", units),
        line("X_Dimension", ["Time"] * len(names)),
        line("X0", [x0] * len(names)),
        line("Delta_X", [delta] * len(names)),
        *([tags] if tags else []),
        f"***End_of_Header***{separator}",
        f"{labels}{separator}Comment",
        *rows,
    ]
    return "\r\n".join([*(above if head else []), *segment, ""])


def rows_of(table, x_columns="No", separator="\t", first=0, step=1e-3):
    for k, values in enumerate(table, first):
        x = f"{k * step:.6f}"
        fields = [str(value) for value in values]
        if x_columns == "Multi":
            yield separator.join(f"{x}{separator}{field}" for field in fields)
        else:
            yield separator.join([x if x_columns == "One" else "", *fields])


TABLE = np.random.default_rng(3).normal(size=(50, 2)).round(6)


@pytest.mark.parametrize("x_columns", ["No", "One", "Multi"])
@pytest.mark.parametrize(("separator", "named"), [("\t", "Tab"), (",", "Comma"), (";", ";")])
@pytest.mark.parametrize("decimal", [".", ","])
def test_lvm_in_every_way_of_writing_it(write, small_pieces, x_columns, separator, named, decimal):
    if separator == decimal:
        pytest.skip("one mark cannot do both")
    text = lvm(
        list(rows_of(TABLE, x_columns, separator)),
        x_columns=x_columns,
        separator=separator,
        named=named,
        decimal=decimal,
        special="***Start_Special***\r\nBinary_Data\r\nanything, 1.5\r\n***End_Special***",
    )
    if decimal == ",":
        text = text.replace(".", ",")
    for size in (1 << 20, 300):
        small_pieces(size)
        recording = open_recording(write(text))
        assert np.array_equal(whole(recording, 7), TABLE.T)
        assert recording.sampling_rate == pytest.approx(1000, rel=1e-12)
        assert [(channel.name, channel.unit) for channel in recording.channels] == [("F", "N"), ("a", "g")]
        assert recording.start_time == datetime(2026, 3, 4, 10, 0, 0, 500000)
        assert not recording.warnings


def test_lvm_segments_that_follow_each_other_are_one_recording(write):
    parts = np.split(TABLE, [20, 35])
    by_time = [
        lvm(list(rows_of(parts[0]))),
        lvm(list(rows_of(parts[1])), head=False, time="10:00:00,52"),
        lvm(list(rows_of(parts[2])), head=False, time="10:00:00,535"),
    ]
    by_x0 = [
        lvm(list(rows_of(parts[0], "One")), x_columns="One"),
        lvm(list(rows_of(parts[1], "One", first=20)), x_columns="One", head=False, x0="0.020"),
        lvm(list(rows_of(parts[2], "One", first=35)), x_columns="One", head=False, x0="0.035"),
    ]
    for segments in (by_time, by_x0):
        recording = open_recording(write("".join(segments)))
        assert np.array_equal(whole(recording), TABLE.T) and not recording.warnings
        (force, _) = read_recording(write("".join(segments)), variable="2")
        assert force.samples.tolist() == parts[1][:, 0].tolist()
    with pytest.raises(
        BadData, match=r"segment 2 .* must begin where the one before ends, .* such as 1, by variable=NUMBER"
    ):
        whole(open_recording(write("".join([by_time[0], by_time[2]]))))
    other = lvm(list(rows_of(parts[1])), head=False, delta="2.000000E-3", time="10:00:00,52")
    with pytest.raises(BadData, match=r"segment 2 .* must have the channels and the rate"):
        whole(open_recording(write(by_time[0] + other)))
    with pytest.raises(BadData, match="no segment 4"):
        open_recording(write("".join(by_time)), variable="4")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("X_Columns\tNo", "X_Columns\tSome"), "X_Columns No, One or Multi"),
        (("Channels\t2", "Channels\t999999"), "1 to 4096"),
        (("X_Dimension\tTime", "X_Dimension\tFrequency"), "x axis must be time"),
        ((f"\t{TABLE[7, 1]}", ""), r"sample 7 \(line 29\) column 3 is empty"),
        (("Samples\t50\t50", "Samples\t0\t0"), "no channel does"),
    ],
)
def test_bad_lvm_is_refused(write, change, word):
    text = lvm(list(rows_of(TABLE)))
    assert change[0] in text
    with pytest.raises(BadData, match=word):
        read_recording(write(text.replace(*change)))


# ---- NPY and NPZ ----


@settings(deadline=None, max_examples=40)
@given(
    shape=st.sampled_from([(50,), (1, 50), (50, 1), (3, 50), (50, 3)]),
    dtype=st.sampled_from(["<f8", ">f4", "<f2", "<i2", "|u1"]),
    fortran=st.booleans(),
    length=st.sampled_from([1, 7, 1000]),
    archive=st.booleans(),
    packed=st.booleans(),
)
def test_arrays_by_blocks_are_the_arrays(tmp_path_factory, shape, dtype, fortran, length, archive, packed):
    array = np.random.default_rng(5).integers(0, 200, shape).astype(dtype)
    array = np.asfortranarray(array) if fortran else array
    path = tmp_path_factory.mktemp("array") / "x"
    with path.open("wb") as file:
        if archive:
            (np.savez_compressed if packed else np.savez)(file, x=array)
        else:
            np.save(file, array)
    recording = open_recording(path, sampling_rate=1)
    rows = np.atleast_2d(array)
    rows = rows.T if rows.shape[1] < rows.shape[0] else rows
    found = whole(recording, length)
    assert np.array_equal(found, rows) and found.dtype == (np.float32 if dtype == ">f4" else np.float64)
    if len(rows) > 1:
        assert np.array_equal(whole(open_recording(path, sampling_rate=1, channel=[3, 2]), length), rows[[2, 1]])


def test_npz_says_rate_and_unit_by_named_values(tmp_path):
    path = tmp_path / "x.npz"
    samples = np.arange(40.0).reshape(2, 20)
    np.savez(path, acc=samples, fs=51200.0, unit="g", channel_names=["front", "rear"], note="long ago")
    recording = open_recording(path)
    assert recording.sampling_rate == 51200
    assert [(channel.name, channel.unit) for channel in recording.channels] == [("front", "g"), ("rear", "g")]
    np.savez(path, acc=samples[0], t=np.arange(20) / 500)
    assert open_recording(path).sampling_rate == pytest.approx(500)
    np.savez(path, left=samples[0], right=samples[1], dt=1e-3)
    with pytest.raises(BadData, match=r"left \(20\), right \(20\).*variable=NAME"):
        open_recording(path)
    (right,) = read_recording(path, variable="right")
    assert (right.samples.tolist(), right.sampling_rate) == (samples[1].tolist(), pytest.approx(1000))
    np.savez(path, acc=samples, fs=51200.0, sampling_rate=25600.0)
    with pytest.raises(BadData, match="51200 Hz and sampling_rate states 25600 Hz"):
        open_recording(path)


def test_an_npy_file_that_shrinks_while_it_is_read_is_refused(tmp_path):
    path = tmp_path / "x.npy"
    np.save(path, np.arange(3000.0))
    blocks = open_recording(path, sampling_rate=1).blocks(1000)
    next(blocks)
    os.truncate(path, 20_000)
    with pytest.raises(BadData, match="shorter"):
        list(blocks)


# ---- FLAC and OGG ----


def test_ogg_cut_off_or_damaged_is_refused(tmp_path):
    soundfile = pytest.importorskip("soundfile")
    path = tmp_path / "x.ogg"
    soundfile.write(path, np.random.default_rng(8).uniform(-0.5, 0.5, (100_000, 1)), 48000, subtype="VORBIS")
    recording = open_recording(path)
    assert whole(recording).shape == (1, 100_000) and not recording.warnings
    content = path.read_bytes()
    places = np.linspace(5000, len(content) - 1, 12).astype(int).tolist()
    flipped = [content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :] for place in places]
    for damaged in (content[: len(content) // 2], *flipped):
        path.write_bytes(damaged)
        with pytest.raises(BadData):
            whole(open_recording(path))


# ---- live streams ----


class Trickle:
    """A stream that gives what it likes, as pipes do."""

    def __init__(self, content, seed=0):
        self._file, self._random = io.BytesIO(content), np.random.default_rng(seed)

    def read(self, size):
        return self._file.read(size)

    def read1(self, size):
        return self._file.read(int(self._random.integers(1, min(size, 40) + 1)))


@settings(deadline=None, max_examples=40)
@given(
    name=st.sampled_from(["u8", "s16le", "s16be", "s24le", "s24be", "s32le", "f32le", "f64be"]),
    n_channels=st.integers(1, 5),
    seed=st.integers(0, 10**6),
)
def test_raw_streams_are_what_was_written(name, n_channels, seed):
    random = np.random.default_rng(seed)
    order = ">" if name.endswith("be") else "<"
    if name[0] == "f":
        numbers = random.normal(size=(100, n_channels)).astype(f"{order}f{int(name[1:3]) // 8}")
        content, expected = numbers.tobytes(), numbers
    else:
        bits = int(name.strip("usble"))
        numbers = random.integers(-(2 ** (bits - 1)), 2 ** (bits - 1), (100, n_channels))
        expected = numbers / 2 ** (bits - 1)
        offset = 128 if name == "u8" else 0
        content = b"".join(
            int(number + offset).to_bytes(bits // 8, "big" if order == ">" else "little", signed=name != "u8")
            for number in numbers.ravel()
        )
    stream = live_stream(Trickle(content, seed), sampling_rate=1000, n_channels=n_channels, sample_format=name)
    blocks = list(stream)
    assert all(block.shape[0] == n_channels and block.shape[1] for block in blocks)
    assert np.array_equal(np.concatenate(blocks, axis=1), expected.T)
    assert (stream.n_samples, stream.warnings, stream.channels[0].unit) == (100, [], None if name[0] == "f" else "FS")


@pytest.mark.parametrize("name", ["s16le", "s24be", "f32le", "f64be"])
def test_a_text_is_no_raw_stream(name):
    content = b"".join(b"%.4f,%.2f\n" % (k / 1000, k % 7) for k in range(50))
    with pytest.raises(BadData, match="text"):
        list(live_stream(Trickle(content, 1), sampling_rate=1000, n_channels=1, sample_format=name))
    for n_numbers in (1, 7, 20):  # numbers that look like letters are numbers
        file = io.BytesIO(b"@@@@" * n_numbers)
        blocks = list(live_stream(file, sampling_rate=1000, n_channels=1, sample_format="f32le"))
        assert np.concatenate(blocks, axis=1).shape == (1, n_numbers)


def test_live_stream_does_not_wait_for_a_full_block():
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as file, os.fdopen(writing, "wb", buffering=0) as source:
        source.write(WORDS[:7].tobytes())
        stream = live_stream(file, sampling_rate=10, n_channels=1, sample_format="s16le")
        blocks = iter(stream)
        # Nothing more comes and the stream is still open; a reader that waited would never return.
        got = next(blocks).shape[1]
        while got < 7:
            got += next(blocks).shape[1]
        source.write(WORDS[7:9].tobytes() + b"\1")
        assert next(blocks).tolist() == [(WORDS[7:9] / 2**15).tolist()]
        source.close()
        assert list(blocks) == []
    assert "ended within a sample of 2 bytes; the last 1 were left out" in stream.warnings[0]


# ---- gaps ----


def marked_by_hand(samples, limit, longest):
    """Mark the gaps of channels sample by sample, up to where none was readable for so long; return them and counts."""
    out, n_samples, n_gaps, unreadable = samples.copy(), [0, 0], [0, 0], 0
    for k, column in enumerate(samples.T):
        missing = [not abs(one) <= limit for one in column]
        for row in np.flatnonzero(missing).tolist():
            out[row, k] = np.nan
            n_samples[row] += 1
            n_gaps[row] += k == 0 or bool(abs(samples[row, k - 1]) <= limit)
        unreadable = unreadable + 1 if all(missing) else 0
        if unreadable == longest:
            return out[:, : k + 1], n_samples, n_gaps, True
    return out, n_samples, n_gaps, False


@settings(deadline=None, max_examples=60)
@given(
    st.integers(0, 2**32), st.lists(st.integers(0, 80), max_size=6), st.sampled_from(["N", "kN", "m/s^2", "g", None])
)
def test_gaps_are_the_same_sample_by_sample(seed, cuts, unit):
    random, limit = np.random.default_rng(seed), largest(unit)
    samples = (limit * random.uniform(-0.9, 0.9, (2, 80))).astype(np.float32)
    for row in range(2):
        for start in random.integers(0, 80, 4):
            own = samples[row, start : start + random.integers(1, 30)]
            own[:] = random.choice([np.nan, np.inf, -np.inf, 1e35, -1.2 * limit], own.size)
    lines = []
    channels = [Channel(name=name, unit=unit) for name in ("left", "right")]
    gaps = Gaps(channels, 10.0, lines.append, give_up=1.15)
    blocks = list(gaps.marked(np.split(samples, sorted(cuts), axis=1)))
    expected, n_samples, n_gaps, ended = marked_by_hand(samples, limit, 12)
    assert np.array_equal(np.concatenate(blocks, axis=1), expected, equal_nan=True)
    assert [gaps.n_samples.tolist(), gaps.n_gaps.tolist()] == [n_samples, n_gaps]
    assert len(lines) == bool(sum(n_samples))
    if lines:
        assert f" {np.flatnonzero(np.isnan(expected).any(axis=0))[0] / 10.0:.6g} s " in lines[0]
    if not ended:
        gaps.require("here")
        return
    with pytest.raises(BadData, match="here") as caught:
        gaps.require("here")
    at_once = Gaps(channels, 10.0, lines.append, give_up=1.15)
    list(at_once.marked([samples]))
    with pytest.raises(BadData) as other:
        at_once.require("here")
    assert str(other.value) == str(caught.value)  # whatever the blocks


def test_channel_without_a_quiet_moment_is_told_and_a_lost_sensor_is_none() -> None:
    rate, rng = 1000.0, np.random.default_rng(57)
    samples = rng.normal(0, 1, (3, 60_000))
    # Windows of 20 ms: flow on half of the first channel, on all of the second; the third is lost from 16 to 32 s.
    loud = 30.0 ** rng.uniform(0, 1, (2, 3000)).repeat(20, axis=1)
    samples[0] *= np.where(np.arange(60_000) % 400 < 200, loud[0], 1.0)
    samples[1] *= loud[1]
    samples[2, 16_000:32_000] *= 1e-3
    for length in (777, 60_000):
        watch, told = _Quiet(rate, 3), set[int]()
        for first in range(0, 60_000, length):
            told |= watch.loud(samples[:, first : first + length])
        assert told == {1}
