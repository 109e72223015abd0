"""Recordings: what is read back equal, what the header states, and every fault with its place and cure."""

import io
import os
import re
import struct
import subprocess
import sys
import threading
import zipfile
from datetime import UTC
from pathlib import Path
from signal import SIGKILL
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import wavfile

import cgid
from cgid.errors import BadData, CgidError, InvalidValue, NoInput
from cgid.recordings import RecordingFile, is_dataset, open_recording, read_recording
from cgid.recordings.recording import MAX_CHANNELS
from tests.beside import SHARED

REAL = SHARED / "realdata"
real_data = pytest.mark.skipif(not REAL.is_dir(), reason=f"the measured recordings are not there: {REAL}")


@pytest.fixture
def write(tmp_path):
    def written(content, name="hit.csv"):
        file = tmp_path / name
        file.write_bytes(content.encode() if isinstance(content, str) else content)
        return file

    return written


def read_bytes(content, **options):
    """Read from the standard input, which spares the file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(content)))
        return read_recording("-", **options)


def read_text(content, **options):
    return read_bytes(content.encode(), **options)


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def npz(**arrays):
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def npy_header(text, version=(1, 0)):
    text = text.encode("latin-1") + b"\n"
    return b"\x93NUMPY" + bytes(version) + struct.pack("<H" if version == (1, 0) else "<I", len(text)) + text


def wav(samples, rate=44100):
    file = io.BytesIO()
    wavfile.write(file, rate, samples)
    return file.getvalue()


def wav_chunks(samples, *, bits, tag=1, channels=1, rate=1000, before=b"", after=b"", order="<", riff=b"RIFF"):
    align = channels * bits // 8
    form = struct.pack(order + "HHIIHH", tag, channels, rate, rate * align, align, bits)
    body = b"WAVE" + before + b"fmt " + struct.pack(order + "I", len(form)) + form
    body += b"data" + struct.pack(order + "I", len(samples)) + samples + b"\0" * (len(samples) % 2) + after
    return riff + struct.pack(order + "I", len(body)) + body


# ---- text that is read ----


@settings(deadline=None, max_examples=60)
@given(
    table=hnp.arrays(np.float64, st.tuples(st.integers(3, 12), st.integers(1, 4)), elements=st.floats(-1e300, 1e300)),
    delimiter=st.sampled_from([",", ";", "\t", " ", "   ", ", \t", " ; ", "|"]),
    header=st.booleans(),
    comma=st.booleans(),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "latin-1"]),
)
def test_any_numbers_in_any_layout_are_read_back_equal(table, delimiter, header, comma, end, encoding):
    rows, columns = table.shape
    # A signal must not look like an even time, so one is given.
    full = np.c_[np.arange(rows) * 0.25, table]
    lines = [delimiter.join(repr(float(value)) for value in row) for row in full]
    if comma and "," not in delimiter:
        lines = [line.replace(".", ",") for line in lines]
    names = [f"ch{k}" for k in range(columns)]
    if header:
        lines.insert(0, delimiter.join(["time (s)", *(f"{name} (µm)" for name in names)]))
    signals = read_bytes((end.join(lines) + end).encode(encoding))
    assert len(signals) == columns
    for k, signal in enumerate(signals):
        assert signal.samples.tolist() == table[:, k].tolist()
        assert signal.sampling_rate == 4.0
        assert signal.unit == ("µm" if header else None)
        assert signal.channel == ("1" if columns == 1 else names[k] if header else str(k + 1))


@pytest.mark.parametrize(
    ("header", "unit", "rate"),
    [
        ("time (s),force (N)", "N", 2.0),
        ("t [ms],force [kN]", "kN", 2000.0),
        ("t/us,F/kN", "kN", 2e6),
        ("time_ms,v_mm/s", "mm/s", 2000.0),
        ("ms,N", "N", 2000.0),
        ('"Zeit (ms)","Kraft (N)"', "N", 2000.0),
        ("Time,Channel A\n(ms),(mV)\n", "mV", 2000.0),
        ("# columns: time, force (N)\n# somebody, somewhere", "N", 2.0),
        ("% made by hand\n% t,x\n% unit: MPa", "MPa", 2.0),
        ("time,force (furlongs)", None, 2.0),
        ("\n\n# a title\nOperator: X, Y\ntime,mm\n\n", "mm", 2.0),
    ],
)
def test_header_gives_units_and_time(header, unit, rate):
    (signal,) = read_text(f"{header}\n0,1\n0.5,3\n1,2\n")
    assert signal.samples.tolist() == [1, 3, 2]
    assert (signal.unit, signal.sampling_rate) == (unit, pytest.approx(rate, rel=1e-12))
    assert signal.channel == "1"


def test_time_column_need_not_come_first_and_names_select():
    text = "force (N);t (ms);acc (g)\n1;0;4\n2;1;5\n0;2;6\n"
    force, acceleration = read_text(text)
    assert (force.channel, force.unit, force.samples.tolist()) == ("force", "N", [1, 2, 0])
    assert (acceleration.channel, acceleration.unit, acceleration.samples.tolist()) == ("acc", "g", [4, 5, 6])
    for choice in ("acc", 2, "2"):
        (chosen,) = read_text(text, channel=choice)
        assert (chosen.channel, chosen.samples.tolist()) == ("acc", [4, 5, 6])


@pytest.mark.parametrize(
    ("choice", "names"),
    [("1+3", ["a", "b+c"]), ("3 + 1", ["b+c", "a"]), ("b+c", ["b+c"]), (["a+2", 1], ["a", "2"]), ("1+1", ["a"])],
)
def test_several_channels_are_joined_by_a_plus(choice, names):
    signals = read_text("a,2,b+c\n1,2,3\n4,4,4\n", sampling_rate=10, channel=choice)
    assert [signal.channel for signal in signals] == names
    with pytest.raises(InvalidValue, match="channel '9' is none of them"):
        read_text("a,2,b+c\n1,2,3\n4,4,4\n", sampling_rate=10, channel="1+9")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1,2,\n5,3,\n", [[1, 5], [2, 3]]),
        ("a;b;\n1,5;2;\n5;3;\n", [[1.5, 5], [2, 3]]),
        ('"1","2"\n"5","3"\n', [[1, 5], [2, 3]]),
        ("1,5 2\n5 3,5\n", [[1.5, 5], [2, 3.5]]),
        ("5 2\n1 3,5\n", [[5, 1], [2, 3.5]]),
        ("1, 2\t7\n5,3 4\n", [[1, 5], [2, 3], [7, 4]]),
        ("\n# remark, 5\n% remark\n   \n1,2\n5,3 # end\n; nothing\n\n# 7\n", [[1, 5], [2, 3]]),
        ("1,2\n5,3\n// remark", [[1, 5], [2, 3]]),
        ("-.5e1,+2.\n5E-1,3\n\x1a", [[-5, 0.5], [2, 3]]),
        ("1000 samples\n2 rows\n1 2\n5 3\n", [[1, 5], [2, 3]]),
        ("force (N)\n3\n4\n", [[3, 4]]),
        ("3 4\n", [[3], [4]]),
    ],
)
def test_layouts(text, expected):
    signals = read_text(text, sampling_rate=10)
    assert [signal.samples.tolist() for signal in signals] == expected


def test_rate_of_time_column_is_exact_and_rounded_digits_are_allowed():
    times = np.arange(5000) / 44100
    for shown in ("%.6f", "%.7f", "%.6g", "%.18e", "%.5f"):
        text = "".join(f"{shown % time},{k % 7}\n" for k, time in enumerate(times))
        (signal,) = read_text(text)
        assert signal.sampling_rate == pytest.approx(44100, rel=3e-4)
    (signal,) = read_text("".join(f"{1e9 + k / 1000:.3f} {k % 5}\n" for k in range(50)))
    assert signal.sampling_rate == pytest.approx(1000, rel=1e-6)


def test_gaps_of_a_channel_matter_only_to_who_asks_for_it():
    text = "t,F,a,note\n0,1,5,\n1,2,nan,\n2,3,7,x\n"
    assert read_text(text, channel="F")[0].samples.tolist() == [1, 2, 3]
    with pytest.raises(BadData, match="sample 1 is nan"):
        read_text(text, channel="a")
    with pytest.raises(BadData, match=r"sample 1 \(line 3\) column 1 is empty"):
        read_text("t,F,a\n0,1,5\n,2,3\n2,3,7\n", channel="F")


@pytest.mark.parametrize(
    ("text", "start"),
    [
        ("time,F\n2026-03-04 10:00:00.998,1.5\n2026-03-04 10:00:00.999,-2\n2026-03-04 10:00:01.000,3\n", True),
        ("2026-03-04T10:00:00.998;1.5\n2026-03-04T10:00:00.999;-2\n2026-03-04T10:00:01;3\n", True),
        ("Datum;F (N)\n2026/3/4 23:59:59,999;1,5\n2026/3/5 00:00:00,000;-2\n2026/3/5 0:00:00,001;3\n", True),
        ("Start 09:00:00\nTime (hh:mm:ss)\tF\n10:00:00,998\t1,5\n10:00:00,999\t-2\n10:00:01,000\t3\n", False),
        ("F,clock\n1.5,10:00:00.998\n-2,10:00:00.999\n3,10:00:01.000\n", False),
    ],
)
def test_times_of_day_are_the_time_of_the_rows(text, start):
    (signal,) = read_text(text)
    assert signal.samples.tolist() == [1.5, -2, 3]
    assert signal.sampling_rate == pytest.approx(1000, rel=1e-3)
    assert (signal.start_time is not None) == start
    if start:
        assert signal.start_time.strftime("%Y-%m-%d") == "2026-03-04"


def rows(form, n=360, rate=1000.0, skip=()):
    """Return rows of a time and a sample k % 7 / 2, in which `form` may place both in any way."""
    return "\n".join(form(k / rate, k % 7 / 2) for k in range(n) if k not in skip) + "\n"


def german(time, x):
    return f"30.05.2025 13:35:{35 + time:09.6f};{x:.2f}".replace(".", ",").replace(",", ".", 2)


def lost(time, x):
    return f"{time:.5f},{x}"


#: What recorders write: header, rows, unit, options.
RECORDERS = {
    "quoted decimal commas": ('"time (s)","F (N)"\n', lambda t, x: f'"{t:.4f}","{x:.2f}"'.replace(".", ","), "N", {}),
    "quoted thousands": ("t (s),F (N)\n", lambda t, x: f'{t:.4f},"{x + 5000:,.1f}"', "N", {"offset": 5000}),
    "quotes without need": ('"t (s)","F (N)"\n', lambda t, x: f'"{t:.4f}","{x:.2f}"', "N", {}),
    "zone": ("time,F (N)\n", lambda t, x: f"2025-05-30T15:35:{35 + t:09.6f}+02:00,{x}", "N", {"hour": 15}),
    "Zulu": ("time,F (N)\n", lambda t, x: f"2025-05-30T13:35:{35 + t:09.6f}Z,{x}", "N", {"hour": 13}),
    "d.m.y": ("Zeit;Kraft [N]\n", german, "N", {"hour": 13}),
    "m/d/y PM": ("time,F (N)\n", lambda t, x: f"5/30/2025 1:35:{35 + t:09.6f} PM,{x}", "N", {"hour": 13}),
    "d/m/y": ("time;F (N)\n", lambda t, x: f"30/05/2025 13:35:{35 + t:09.6f};{x}", "N", {"hour": 13}),
    "D exponents": ("t(s) F(N)\n", lambda t, x: f"{t:.6E} {x:.3E}".replace("E", "D"), "N", {}),
    "units row": ("Time,CH1\nsec,Volt\n", lost, "V", {}),
    "units row with an unknown one": ("Time,CH1\ns,furlong\n", lost, None, {}),
    "increment": (
        "X,CH1,Start,Increment,\nSequence,Volt,-1e-2,1e-3\n",
        lambda t, x: f"{round(1000 * t)},{x},",
        "V",
        {"said": "column X only counts"},
    ),
    "rate in a comment": (
        "# LOGGER\n# Num. samples: 360\n# Config: data_rate = 1000.0 Hz, filter = 488 Hz\ncount,a (g)\n",
        lambda t, x: f"{round(1000 * t) % 256},{x}",
        "g",
        {"said": "column count only counts"},
    ),
    "counter of no name": ("# fs = 1000 Hz\n", lambda t, x: f"{round(1000 * t)},{x}", None, {"said": "column 1 only"}),
    "slow channel ends": (
        "t (s)\tF (N)\tT\n",
        lambda t, x: f"{t:.4f}\t{x}" + "\t20.5" * (t < 0.0995),
        "N",
        {"said": "columns T have no value"},
    ),
    "slow channel in some rows": (
        "t (s);F (N);T\n",
        lambda t, x: f"{t:.4f};{x};" + "20.5" * (round(1000 * t) % 10 == 0),
        "N",
        {"said": "column T has numbers in 36 of 360 rows"},
    ),
    "two units of time": ("time_ms (s),F (N)\n", lost, "N", {"said": "check the sampling rate of 1000 Hz"}),
    "ambiguous date": (
        "time,F (N)\n",
        lambda t, x: f"05/06/2025 13:35:{35 + t:09.6f},{x}",
        "N",
        {"said": "day or month"},
    ),
}


@pytest.mark.parametrize("name", RECORDERS)
def test_what_recorders_write_is_read_as_it_was_meant(name):
    header, form, unit, expected = RECORDERS[name]
    (signal,) = read_text(header + rows(form))
    assert signal.samples.tolist() == [k % 7 / 2 + expected.get("offset", 0) for k in range(360)]
    assert (signal.unit, signal.sampling_rate) == (unit, pytest.approx(1000, rel=1e-6))
    assert [warning for warning in signal.warnings if expected.get("said", "?") not in warning] == []
    assert bool(signal.warnings) == ("said" in expected)
    start = signal.start_time
    if "hour" not in expected:
        assert start is None
    else:
        assert (start.day, start.month, start.hour, start.minute) == (30, 5, expected["hour"], 35)
        assert start.tzinfo is None or start.astimezone(UTC).hour == 13


@pytest.mark.parametrize("piece", [10**6, 700])
def test_lost_rows_are_a_gap(write, monkeypatch, piece):
    monkeypatch.setattr("cgid.recordings.text.PIECE", piece)
    skip = {*range(100, 120), 300}
    recording = open_recording(write("t (s),F (N)\n" + rows(lost, rate=800.0, skip=skip)))
    found = np.concatenate(list(recording.blocks(64, gaps=True)), axis=1)[0]
    expected = [np.nan if k in skip else k % 7 / 2 for k in range(360)]
    np.testing.assert_array_equal(found, expected)
    assert recording.sampling_rate == pytest.approx(800, rel=1e-9)
    assert "21 samples in 2 gaps of the times are missing, the first before 0.15 s" in recording.warnings[0]


def test_a_recording_with_lost_samples_is_read_as_the_error_says(write):
    file = write("t (s),F (N),G (N)\n" + "".join(f"{k / 800},{k},{2 * k}\n" for k in range(90) if k not in (20, 21)))
    with pytest.raises(BadData, match=rf"{re.escape(str(file))}.*sample 20 is nan") as told:
        read_recording(file)
    (way,) = re.findall(r"cgid\.open_recording\(.*\)", str(told.value))
    found = eval(way.replace("...", "file"), {"cgid": cgid, "file": file})
    expected = np.where(np.isin(np.arange(90), (20, 21)), np.nan, np.arange(90.0))
    np.testing.assert_array_equal(found, [expected, 2 * expected])
    np.testing.assert_array_equal(open_recording(file).samples(30), found[:, 30:])


def test_lowest_numbers_of_a_converter_are_a_gap_unless_samples_come_near():
    text = "# fs = 1000 Hz\n" + "\n".join(str(-32768 if k in (5, 6) else k) for k in range(20))
    with pytest.raises(BadData, match="sample 5 is nan"):
        read_text(text)
    assert read_text(f"{text}\n-30000\n")[0].samples[5] == -32768


INPUTS = SHARED / "inputs"
#: Rate [Hz] or a word of the error, unit, number of channels and samples, largest sample, word of a message.
ANSWERS = {
    "quoted_decimal_comma.csv": (25_600, "N", 2, 360, 1499.66, ""),
    "quoted_thousands.csv": (25_600, "N", 1, 360, 6499.7, ""),
    "comma_decimals_comma_separated.csv": ("divide columns or decimals",),
    "scope_start_increment.csv": (25_600, "V", 1, 360, 1.4997, "X only counts"),
    "iso_with_offset.csv": (25_600, "N", 1, 220, 798.82, ""),
    "german_date.csv": (25_600, "N", 1, 220, 798.82, ""),
    "fortran_D.txt": (25_600, "N", 1, 360, 1500.0, ""),
    "rate_in_comment.csv": (25_600, None, 1, 360, 152.922, "count only counts"),
    "counter_channel.csv": ("sampling_rate",),
    "lost_rows.csv": (25_600, "N", 1, 360, 1499.66, "20 samples in 1 gap"),
    "lvm_no_header_slow_column.lvm": (200_000, None, 2, 360, 1499.657, "from 4 on"),
    "ext_24in32_right_justified.wav": (25_600, "FS", 1, 360, 0.00292902, "lower bits"),
    "uff_last_row_padded.uff": (25_600, "N", 1, 359, 1499.66, ""),
    "uff_uneven_flag_even_times.uff": (25_600, "N", 1, 360, 1499.66, ""),
    "tdms_channels_start_apart.tdms": ("1.5 s",),
    "tdms_unsupported_scale.tdms": (25_600, None, 1, 360, 1500.0, "PieceWisePolynomial"),
    "mat_cell_of_hits.mat": ("sig(1) (360), sig(2) (360)",),
    "npy_time_force_records.npy": (25_600, None, 1, 360, 1499.66, ""),
    "swmr_not_closed.h5": ("h5clear -s",),
    "epoch_ms.csv": (2000, "N", 1, 360, 1499.66, ""),
    "capital_TIME_MS.csv": (25_600, "N", 1, 360, 1499.66, ""),
    "imu_gcsv.gcsv": ("GCSV",),
    "sec_nanosec_columns.csv": (25_600, None, 1, 360, 1499.66, ""),
    "excel_serial_time.csv": (1000, None, 3, 360, 14.9966, "Sample only counts"),
    "micros_column.csv": (2500, "m/s^2", 1, 360, 1499.66, ""),
    "ms_rounded_800Hz.csv": ("sampling_rate",),
    "clock_over_midnight.csv": (25_600, "N", 1, 360, 1499.66, ""),
    "dd_MMM_date.csv": (1000, "N", 1, 360, 1499.66, ""),
    "time_decimal_comma_later.csv": ("decimal comma",),
    "structure_with_time.mat": (25_600, "N", 1, 360, 1499.66, ""),
    "delta_t_decimal_comma.csv": (25_600, "N", 1, 360, 1499.66, ""),
    "matlab_table_v73.mat": ("T is a MATLAB table",),
    "int16_with_scale_attribute.h5": (25_600, "N", 1, 360, 1499.7, "integers times 0.1"),
    "filler_-9999.csv": (25_600, "N", 1, 360, 1499.66, ""),
    "spectrum_export.csv": ("spectrum",),
    "thousands_apostrophe.csv": (25_600, "N", 1, 360, 13499.66, ""),
    "text_label_column.csv": (25_600, "N", 1, 360, 1499.66, "label contains words"),
    "unit_behind_number.csv": (25_600, "N", 1, 360, 1499.66, ""),
    "plain.csv.gz": (25_600, "N", 1, 360, 1499.66, ""),
    "payload_values.json": ("JSON",),
}


@pytest.mark.skipif(not INPUTS.is_dir(), reason=f"the small inputs are not there: {INPUTS}")
@pytest.mark.parametrize("name", ANSWERS)
def test_small_inputs_from_public_reports(name):
    answer = ANSWERS[name]
    if len(answer) == 1:
        with pytest.raises(CgidError, match=re.escape(answer[0])):
            read_recording(INPUTS / name)
        return
    rate, unit, n_channels, n_samples, peak, word = answer
    recording = open_recording(INPUTS / name)
    found = np.concatenate(list(recording.blocks(gaps=True)), axis=1)
    assert recording.sampling_rate == pytest.approx(rate, rel=1e-4)
    assert found.shape == (n_channels, n_samples) and np.nanmax(found) == pytest.approx(peak, rel=1e-5)
    assert {channel.unit for channel in recording.channels} == {unit}
    assert word in " ".join(recording.messages) and bool(recording.messages) == bool(word)


# ---- text that is refused ----


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["empty"]),
        ("time,force\n", ["no line", "numbers"]),
        ("0,1\n1,nan\n2,3\n", ["sample 1", "nan"]),
        ("t,F\n0,1\n1,inf\n2,3\n", ["sample 1", "inf"]),
        ("0,1\n1,\n2,3\n", ["sample 1", "line 2", "empty"]),
        ("time,force,note\n0,1\n1,2\n", ["3 fields", "rows have 2"]),
        ("1,2,\n1,,3,\n", ["sample 1", "3", "2 fields"]),
        ("0,1\n1,abc\n2,3\n", ["sample 1", "line 2", "'abc'"]),
        ("t;F\n0x0;1,5\n1;2\n2;3,5\n", ["sample 0", "line 2", "'0x0'"]),
        ("0,1\n1,٣\n", ["sample 1", "'٣'"]),
        ("1\n2\n#N/A\n4\n", ["line 3", "sample 2", "'#N/A'", "repair or cut"]),
        ("1\n%5\n3\n", ["line 2", "sample 1", "'%5'"]),
        ("1;2\n;;\n3;4\n", ["line 2", "sample 1", "';;'"]),
        ("1;2\n// 5\n# remark\n3;4", ["line 2", "sample 1", "'// 5'"]),
        ("# remark\n\n0,1\n1,2,3\n", ["sample 1", "line 4", "2 fields", "has 3"]),
        ("0,1\n1,2\n2,1e\n", ["sample 2", "line 3", "'1e'"]),
        ("0,1\n1,2\n2,1 \x00", ["neither text nor of a known format"]),
        ("\x02\x03junk", ["neither text nor of a known format"]),
        ("force (N)\n3,5\n4,5\n", ["comma", "decimal"]),
        ("t\n0\n1\n", ["channel besides time"]),
        ("time,F\n0,1\n1,2\n1,3\n", ["increase", "sample 2", "1 s"]),
        ("time,F\n0.00002,1\n0.00004,2\n0.00008,3\n0.0001,3\n", ["even", "sample 2", "sampling_rate"]),
        ("time,F\n-1.5e308,1\n1.5e308,1\n", ["finite time"]),
        ("time,F\n-1.7e308,1\n0,2\n1.7e308,1\n", ["sampling rate of 0 Hz"]),
        ("time (min),F\n0,1\n1,2\n", ["s, ms or us", "'min'"]),
        ("force,force2\n0,00,0,00\n0,90,0,45\n", ["'0,00,0,00'", "decimals"]),
        ("0,00,0,05\n0,90,0,45\n", ["'0,00,0,05'", "decimals"]),
        ('t,F\n0,"5,000"\n1,"5,001"\n', ["between thousands", "be both"]),
        ("time,F\n10h00,1.5\n10h01,2\n", ["line 2", "'10h00'", "not understood"]),
        ("# sampling_rate: 1000 Hz\ntime,F\n0,1\n1,2\n", ["1000 Hz", "1 Hz", "time column"]),
    ],
)
def test_bad_text_is_refused_with_its_place(text, words, write):
    file = write(text)
    with pytest.raises(BadData) as caught:
        read_recording(file)
    message = str(caught.value)
    assert message.startswith(f"{file}: ") and "\n" not in message
    assert [word for word in words if word not in message] == []


def test_options_that_contradict_the_file():
    text = "time (s),force (N)\n0,1\n0.001,2\n0.002,0\n"
    with pytest.raises(BadData, match=r"states N \(force\) and unit states g \(acceleration\)"):
        read_text(text, unit="g")
    with pytest.raises(BadData, match=r"states N \(force\) and unit states kN"):
        read_text(text, unit="kN")
    assert read_text(text, unit="N")[0].unit == "N"
    (signal,) = read_text(text, sampling_rate=1002)
    assert signal.sampling_rate == 1002 and "the time column states 1000 Hz; 1002 Hz is used" in signal.warnings[0]
    assert read_text(text.replace("(N)", ""), unit="g")[0].unit == "g"
    assert read_text(text.replace("(N)", "(m/s2)"), unit="m/s^2")[0].quantity == "acceleration"
    with pytest.raises(InvalidValue, match="stone"):
        read_text(text, unit="stone")


# ---- files and streams ----


def test_inputs_that_cannot_be_opened(tmp_path, monkeypatch):
    for name in (tmp_path / "none.csv", "", "a\0b", "x" * 5000, tmp_path / "hit.csv" / "below"):
        with pytest.raises(NoInput):
            read_recording(name)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda *_: (_ for _ in ()).throw(PermissionError(13, "denied")))
        with pytest.raises(NoInput, match="permission"):
            read_recording(tmp_path / "locked.csv")
    (tmp_path / "large.csv").write_text("1\n2\n")
    with monkeypatch.context() as patch:
        patch.setattr(RecordingFile, "_blocks", lambda *_: (_ for _ in ()).throw(MemoryError()))
        with pytest.raises(BadData, match="memory"):
            read_recording(tmp_path / "large.csv", sampling_rate=1)
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(NoInput):
        read_recording("-")


_KILLED = """
import os, signal, sys
from cgid.recordings import open_recording
recording = open_recording("-", sampling_rate=1e3, unit="N")
print(sum(block.size for block in recording.blocks()), flush=True)
if sys.argv[1] == "kill":
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize(("kind", "how"), [("text", "kill"), ("hdf5", "end")])
def test_nothing_of_a_stream_is_left_behind(how, kind, tmp_path, write):
    if kind == "text":
        content = b"1.5\n" * 400
    else:
        with h5py.File(tmp_path / "made.h5", "w") as file:
            file["force"] = np.arange(400.0)
        content = (tmp_path / "made.h5").read_bytes()
    (tmp_path / "tmp").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", _KILLED, how],
        input=content,
        capture_output=True,
        env={**os.environ, "TMPDIR": str(tmp_path / "tmp")},
    )
    assert (done.stdout, done.stderr) == (b"400\n", b"")
    assert done.returncode == (-SIGKILL if how == "kill" else 0)
    assert not list((tmp_path / "tmp").iterdir())


def test_a_pipe_that_nobody_writes_into_is_told_and_a_device_refused(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    said = threading.Event()
    monkeypatch.setattr("cgid.recordings.formats.WAITING_TIME", 0.01)
    monkeypatch.setattr("cgid.recordings.formats.warn_of_waiting", lambda source: said.set())

    def write_later():
        said.wait(60)
        (tmp_path / "pipe").write_text("1\n2\n")

    writer = threading.Thread(target=write_later)
    writer.start()
    (read,) = read_recording(tmp_path / "pipe", sampling_rate=1)
    writer.join()
    assert (read.samples.tolist(), said.is_set()) == ([1, 2], True)
    for device in ("/dev/zero", "/dev/null"):
        with pytest.raises(NoInput, match=rf"{device}: a recording must be a file or a pipe, this is a device"):
            read_recording(device, sampling_rate=1)


def test_a_stream_without_end_is_refused(monkeypatch):
    monkeypatch.setattr("cgid.recordings.formats.MAX_STREAM", 1000)
    monkeypatch.setattr("cgid.recordings.formats.PIECE_LENGTH", 300)
    assert len(read_bytes(b"1\n" * 500, sampling_rate=1)[0].samples) == 500
    with pytest.raises(BadData, match="cgid monitor"):
        read_bytes(b"1\n" * 5000, sampling_rate=1)


def test_datasets_are_told_apart(tmp_path, write):
    hdf5 = write(b"\x89HDF\r\n\x1a\n" + bytes(100), "set.dat")
    assert is_dataset(hdf5) and is_dataset(tmp_path)
    named = write("1\n2\n", "set.h5")
    assert not any(map(is_dataset, (named, tmp_path / "none", "-", "", "a\0b")))
    for path in (hdf5, tmp_path, named):
        with pytest.raises(BadData, match=r"cgid\.Dataset\(PATH\)\[0\]"):
            read_recording(path, sampling_rate=1)


def test_standard_input_and_content_before_suffix(write):
    samples = np.array([1.0, -2.0, 3.0])
    for content in (b"1\n-2\n3\n", npy(samples), wav(samples, 8)):
        (signal,) = read_bytes(content, sampling_rate=8)
        assert (signal.samples.tolist(), signal.source, signal.channel) == ([1, -2, 3], "stdin", "1")
        file = write(content, "misnamed.txt")
        (signal,) = read_recording(str(file), sampling_rate=8)
        assert (signal.samples.tolist(), signal.source, signal.name) == ([1, -2, 3], str(file), str(file))


def test_what_numpy_can_read_loads_nothing_else(tmp_path):
    np.save(tmp_path / "a", np.ones(9))
    np.savez(tmp_path / "b", x=np.ones(9))
    (tmp_path / "c.csv").write_text("t,F\n0,1\n1,2\n2,1\n")
    (tmp_path / "d.wav").write_bytes(wav(np.ones(9, np.int16)))
    code = (
        "import sys, pathlib; from cgid.recordings import read_recording\n"
        "print([read_recording(path, sampling_rate=None if path.suffix == '.csv' else 44100)[0].samples.size"
        " for path in sorted(pathlib.Path(sys.argv[1]).iterdir())])\n"
        "sys.exit(bool({'scipy', 'pandas', 'h5py', 'numba', 'soundfile'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path],
        cwd=Path(__file__).parents[1],
        check=False,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "[9, 9, 3, 9]\n"), done.stderr


# ---- NPY ----


@pytest.mark.parametrize("length", [8, 10, 10**12])
def test_npz_whose_array_declares_another_length_than_it_holds(tmp_path, length):
    samples, file = np.arange(9.0), io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (length,)})
    with zipfile.ZipFile(tmp_path / "two.npz", "w") as archive:
        archive.writestr("force.npy", file.getvalue() + samples.tobytes())
        archive.writestr("other.npy", npy(samples))
    with pytest.raises(BadData, match=r"force\.npy"):
        open_recording(tmp_path / "two.npz", sampling_rate=5)


def header_of(shape, descr="<f8"):
    return npy_header(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}}}")


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (npy(np.array([None, 1]), allow_pickle=True), "type object"),
        (npy(np.zeros(3, complex)), "complex128"),
        (npy(np.float64(1)), "one or two axes"),
        (npy(np.zeros(0)), "at least one sample"),
        (npy(np.ones(9))[:-1], "cut off"),
        (npy(np.ones(9)) + b"more", "save one array only"),
        (npy(np.zeros((MAX_CHANNELS + 1, MAX_CHANNELS + 1), "i1")), "channels"),
        (header_of(f"({10**18},)"), "cut off"),
        (header_of(f"({2**63}, {2**63})"), "cut off"),
        (header_of("(-1, -8)") + bytes(64), "axes"),
        (npy_header("(" * 5000), "damaged"),
        (npy_header("{}", (9, 9)), "damaged"),
        (b"\x93NUMPY", "damaged"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff{", "damaged"),
    ],
)
def test_bad_npy_is_refused(content, word):
    with pytest.raises(BadData, match=word) as caught:
        read_bytes(content, sampling_rate=5)
    assert str(caught.value).startswith("stdin: ")


# ---- WAV ----


WHOLE = wav_chunks(np.arange(100, dtype="<i2").tobytes(), bits=16)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        *[(WHOLE[:length], "at least one sample") for length in (44, 45)],
        (wav_chunks(b"", bits=16), "at least one sample"),
        (wav_chunks(b"abcd", bits=16, rate=0), "0 Hz"),
        (wav_chunks(b"abcd", bits=16, channels=0), "WAV"),
        (wav_chunks(b"abcd", bits=8, tag=7), "MULAW"),
        (b"RIFF" + struct.pack("<I", 4) + b"AVI ", "WAV"),
        (b"RIFF" + struct.pack("<I", 4) + b"WAVE", "WAV"),
        (wav(np.array([1, np.inf], np.float32)), "sample 1 is inf"),
    ],
)
def test_bad_wav_is_refused(content, word):
    with pytest.raises(BadData, match=word) as caught:
        read_bytes(content)
    assert str(caught.value).startswith("stdin: ")


# ---- measured recordings and hostile ones ----


@real_data
def test_measured_drop_tower_pulse():
    (signal,) = read_recording(REAL / "shock" / "acc_base_a0.txt")
    assert (len(signal.samples), signal.unit) == (1439, "g")
    assert signal.sampling_rate == pytest.approx(49993.05, abs=1)
    assert signal.samples.max() == pytest.approx(485.97, abs=0.01)
