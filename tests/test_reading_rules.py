"""One rule for all readers: of times, of integers with a unit, of what is no recording, of what is no reading."""

import gzip
import io
import json
import zipfile
from contextlib import suppress

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from cgid import predict
from cgid.cli import main
from cgid.errors import BadData, CgidError, MissingOption
from cgid.recordings import open_recording
from cgid.recordings.gaps import Gaps
from cgid.recordings.recording import Channel
from cgid.units import known_unit, meaning_of

RATE, N = 25_600.0, 360
TIMES = np.arange(N) / RATE
FORCE = np.round(np.random.default_rng(77).normal(0, 3, N), 4)
FORCE[80:110] += np.round(800 * np.sin(np.pi * np.arange(30) / 29), 4)
PEAK = FORCE.max()


@pytest.fixture
def write(tmp_path):
    def written(content, name="a.csv"):
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return tmp_path / name

    return written


def table(head, row, values=FORCE, rate=RATE):
    """Return a text with a row of the time [s], the value and the number of each sample."""
    return head + "".join(row(k / rate, value, k) + "\n" for k, value in enumerate(values))


def read(path, **options):
    recording = open_recording(path, **options)
    return recording, np.concatenate(list(recording.blocks(500, gaps=True)), axis=1)


def clock(t, date="", digits=6):
    minutes, second = divmod(t, 60)
    hours, minute = divmod(int(minutes), 60)
    return f"{date}{hours % 24:02d}:{minute:02d}:{second:0{digits + 3}.{digits}f}"


#: Head, row and rate of texts whose times are told by name, size or form.
TIMED = {
    "unit in capitals": ("TIME_MS,Force (N)\n", lambda t, x, k: f"{1e3 * t:.7f},{x}", RATE),
    "us in capitals": ("TIMESTAMP_US,Force (N)\n", lambda t, x, k: f"{1e6 * t:.4f},{x}", RATE),
    "s since 1970": ("timestamp,force_N\n", lambda t, x, k: f"170000000{t:.6f},{x}", RATE),
    "ms since 1970": ("timestamp,force_N\n", lambda t, x, k: f"{1.7e12 + 1e3 * t:.4f},{x}", 2000),
    "us since 1970": ("timestamp,force_N\n", lambda t, x, k: f"{round(1.7e15 + 1e6 * t)},{x}", 2000),
    "ns since 1970": ("%time,force_N\n", lambda t, x, k: f"{17 * 10**17 + round(1e9 * t)},{x}", 2000),
    "days of a spreadsheet": ("Time,force_N\n", lambda t, x, k: f"{45000.5 + t / 86400:.12f},{x}", 1000),
    "days of MATLAB": ("Time,force_N\n", lambda t, x, k: f"{739000.5 + t / 86400:.9f},{x}", 500),
    "year to ms": (
        "Year,Month,Day,Hour,Minute,Second,Ms,force_N\n",
        lambda t, x, k: f"2024,3,4,10,59,{59 + int(t)},{1e3 * (t % 1):.1f},{x}".replace(",60,", ",60,"),
        1000,
    ),
    "sec and nanosec": (
        "stamp.sec,stamp.nanosec,force_N\n",
        lambda t, x, k: f"{1700000000 + int(t + 0.995)},{round(1e9 * ((t + 0.995) % 1))},{x}",
        RATE,
    ),
    "date and time in two columns": ("Date,Time,Force (N)\n", lambda t, x, k: f"2024-03-04,{clock(t + 5)},{x}", RATE),
    "micros": ("micros,ax_mps2\n", lambda t, x, k: f"{round(1e6 * t) + 123456},{x}", 2500),
    "micros that begin again": (
        "micros,ax_mps2\n",
        lambda t, x, k: f"{(round(1e6 * t) + 2**32 - 40_000) % 2**32},{x}",
        2500,
    ),
    "millis": ("millis,ax_mps2\n", lambda t, x, k: f"{round(1e3 * t) + 99},{x}", 500),
    "midnight": ("Time;Force [N]\n", lambda t, x, k: f"{clock(86399.995 + t)};{x}", RATE),
    "date of MATLAB": ("Time,Force (N)\n", lambda t, x, k: f"{clock(t + 36000, '04-Mar-2024 ')},{x}", RATE),
    "units behind numbers": ("Time,Force\n", lambda t, x, k: f"{1e3 * t:.7f} ms,{x} N", RATE),
    "seconds of MATLAB": ("Time,Force (N)\n", lambda t, x, k: f"{t:.9f} sec,{x}", RATE),
    "words": ("time,force_N,note\n", lambda t, x, k: f"{t:.9f},{x},{'ab'[k % 2]}", RATE),
    "apostrophes": ("t [s];Kraft [N]\n", lambda t, x, k: f"{t:.9f};{x + 12000:,.4f}".replace(",", "'"), RATE),
    "thin spaces": ("t [s];Kraft [N]\n", lambda t, x, k: f"{t:.9f};{x + 12000:,.4f}".replace(",", "\u202f"), RATE),
    "step with a decimal comma": (
        "Delta t;3,90625E-05\nEinheit;N\nKraft\n",
        lambda t, x, k: f"{x:.4f}".replace(".", ","),
        RATE,
    ),
    "rate with a decimal comma": ("Abtastrate;25,6 kHz\nx;Kraft (N)\n", lambda t, x, k: f"a;{x}", RATE),
    "names and units above": (
        "Channel names :\tAI 1\tAI 2\nUnits :\tN\tN\n\n",
        lambda t, x, k: f"{t:.9f}\t{x}\t{x / 2:.5f}",
        RATE,
    ),
}


@pytest.mark.parametrize("name", TIMED)
def test_times_of_texts(write, name):
    head, row, rate = TIMED[name]
    recording, found = read(write(table(head, row, rate=rate)))
    assert recording.sampling_rate == pytest.approx(rate, rel=2e-3 if "days" in name else 2e-4)
    assert len(found) == (2 if name.startswith("names") else 1) and found.shape[1] == N
    np.testing.assert_allclose(found[0] - found[0].mean(), FORCE - FORCE.mean(), atol=1e-3)
    assert recording.channels[0].unit in ("N", "m/s^2")


#: A text that is refused, and words of the reason.
REFUSED = {
    "times go back": (table("t,F\n", lambda t, x, k: f"{t if k != 50 else 0:.9f},{x}"), ["must increase", "sample 50"]),
    "two times": (table("time,F,time\n", lambda t, x, k: f"{t:.9f},{x},{2 * t:.9f}"), ["one to 0.1 %"]),
    "size and unit": (table("timestamp_s,F\n", lambda t, x, k: f"{1.7e12 + k},{x}"), ["1970", "correct the unit"]),
    "size and step": (table("timestamp,F\n", lambda t, x, k: f"{5000000000 + 39 * k},{x}"), ["state their unit"]),
    "unit and unit": (table("t (s),F (kN)\n", lambda t, x, k: f"{t:.9f},{x} N"), ["kN", "numbers N"]),
    "more names": (table("Time, ms,Force\n", lambda t, x, k: f"{t:.9f},{x}"), ["3 fields", "rows have 2"]),
    "decimal comma later": ("Time(s), F (N)\n0,0\n3,9e-05,1\n7,8e-05,2\n", ["decimal comma", "skip_broken=True"]),
    "spectrum": (table("Frequency (Hz),Magnitude (N)\n", lambda t, x, k: f"{71.1 * k:.1f},{x}"), ["spectrum"]),
    "GCSV": (table("tscale,0.001\nt,gx,gy\n", lambda t, x, k: f"{k},{k % 7},{k % 5}"), ["GCSV"]),
    "JSON": (json.dumps({"payload": {"interval_ms": 1, "values": FORCE.tolist()}}), ["JSON"]),
    "endless JSON": ("[" * 100_000, ["JSON"]),
    "words alone": ("a,b\n" + "coal,x\n" * 50, ["numbers"]),
}


@pytest.mark.parametrize("name", REFUSED)
def test_texts_that_are_refused_say_why(write, name):
    text, words = REFUSED[name]
    with pytest.raises(BadData) as caught:
        open_recording(write(text), unit=None)
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize(("rate", "digits"), [(800, 3), (25_600, 4), (1652, 3)])
def test_a_given_rate_is_used_where_times_are_only_rounded(write, rate, digits):
    text = table("Time,F (N)\n", lambda t, x, k: f"{clock(t, '2025-01-08T', digits)},{x}", rate=rate)
    with pytest.raises(BadData, match="sampling_rate"):
        open_recording(write(text))
    recording, found = read(write(text), sampling_rate=rate)
    assert recording.sampling_rate == rate and not recording.messages
    np.testing.assert_array_equal(found[0], FORCE)
    with pytest.raises(BadData, match=r"even steps|must increase"):  # the times contradict it
        read(write(text), sampling_rate=1.02 * rate)
    lost = "".join(line for k, line in enumerate(text.splitlines(keepends=True)) if k not in range(100, 104))
    with pytest.raises(BadData, match=r"even steps|must increase"):
        read(write(lost), sampling_rate=rate)


def test_broken_lines_are_skipped_and_never_change_a_time(write):
    lines = table("t,F (N)\n", lambda t, x, k: f"{t:.9f},{x}").splitlines()
    lines[41], lines[61], lines[62] = "rubbish", "0.00,", "# mark"
    path = write("\n".join(lines) + "\n")
    with pytest.raises(BadData, match="skip_broken=True"):
        open_recording(path)
    recording, found = read(path, skip_broken=True)
    assert np.flatnonzero(np.isnan(found[0])).tolist() == [40, 60, 61] and found.shape[1] == N
    assert recording.sampling_rate == pytest.approx(RATE) and "3 broken lines" in " ".join(recording.messages)
    # Without times a broken line is one sample.
    path = write("\n".join(["F (N)", *(line.partition(",")[2] for line in lines[1:41]), "rubbish", "7", "8"]) + "\n")
    _, found = read(path, skip_broken=True, sampling_rate=RATE)
    assert np.flatnonzero(np.isnan(found[0])).tolist() == [40] and found[0, 41] == 7


def test_a_last_line_that_is_cut_off_is_a_warning(write):
    text = table("t,F (N)\n", lambda t, x, k: f"{t:.9f},{x}")
    recording, found = read(write(text[:-18]))
    assert found.shape[1] == N - 1 and "cut off" in recording.damage[0]


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_labels_of_a_column_are_those_of_impacts(write, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    twice = np.concatenate([FORCE, FORCE])
    write(table("t,F (N),label\n", lambda t, x, k: f"{t:.9f},{x},{'coal' if k < N else 'gangue'}", twice))
    pd.read_csv("a.csv").to_parquet("a.parquet")
    marks = open_recording(name).labels()
    assert [text for _, _, text in marks] == ["coal", "gangue"]
    np.testing.assert_allclose([mark[:2] for mark in marks], [[0, N / RATE], [N / RATE, 2 * N / RATE]], rtol=1e-6)
    assert main(["events", name, "-o", "e.csv"]) == 0
    rows = (tmp_path / "e.csv").read_text().splitlines()[1:]
    assert len(rows) == 2 and ",coal," in rows[0] and ",gangue," in rows[1]


def test_train_takes_a_column_of_labels(tmp_path, monkeypatch):
    """Four impacts of each label in turn, of two widths."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    rows = ["t,F (N),Label"]
    for hit in range(40):
        width = 22 if hit // 4 % 2 else 44
        force = rng.normal(0, 2, 600)
        force[100 : 100 + width] += rng.uniform(500, 900) * np.sin(np.pi * np.arange(width) / width)
        label = "gangue" if width == 22 else "coal"
        rows += [f"{(600 * hit + k) / RATE:.9f},{one:.3f},{label}" for k, one in enumerate(force)]
    (tmp_path / "a.csv").write_text("\n".join([*rows, ""]))
    assert main(["train", "a.csv", "-o", "mine.npz"]) == 0
    with pytest.warns(UserWarning, match="Label"):
        answers = predict("a.csv", model="mine.npz")
    assert answers["label"].tolist() == ["coal" if k // 4 % 2 == 0 else "gangue" for k in range(40)]
    assert main(["events", "a.csv", "-o", "e.csv"]) == 0


# ---- arrays ----


def hdf5(path, **datasets):
    """Write arrays, each an array or (array, attributes)."""
    with h5py.File(path, "w") as file:
        for name, given in datasets.items():
            samples, about = given if isinstance(given, tuple) else (given, {})
            file[name.replace("__", "/")] = samples
            file[name.replace("__", "/")].attrs.update(about)
    return path


@pytest.mark.parametrize("name", ["scale", "slope", "gain", "scale_factor"])
def test_integers_with_a_unit_need_a_scale(tmp_path, name):
    about = {"unit": "N", "fs": RATE}
    integers = np.rint(FORCE * 10).astype(np.int16)
    with pytest.raises(MissingOption, match="full_scale="):
        open_recording(hdf5(tmp_path / "a.h5", x=(integers, about)))
    recording, found = read(hdf5(tmp_path / "a.h5", x=(integers, {**about, name: 0.1})))
    np.testing.assert_allclose(found[0], integers * 0.1)
    assert recording.channels[0].unit == "N"
    with pytest.raises(BadData, match="scale of x"):
        open_recording(hdf5(tmp_path / "a.h5", x=(integers, {**about, name: 0.0})))
    floats, same = read(hdf5(tmp_path / "a.h5", x=(FORCE, {**about, "slope": 0.1})))
    np.testing.assert_array_equal(same[0], FORCE)
    assert floats.sampling_rate == RATE


def test_rates_of_structures_and_headers(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"meas": {"time": TIMES, "signals": {"values": FORCE}}})
    assert read(path)[0].sampling_rate == pytest.approx(RATE)
    savemat(path, {"Header": {"SampleFrequency": RATE}, "Data1_AI_1": FORCE})
    assert read(path)[0].sampling_rate == RATE
    stamp = {"sec": (TIMES + 1.7e9 + 0.995).astype("i8"), "nanosec": np.rint((TIMES + 0.995) % 1 * 1e9).astype("i8")}
    recording, found = read(hdf5(tmp_path / "a.h5", force=FORCE, **stamp))
    assert recording.sampling_rate == pytest.approx(RATE, rel=1e-4) and len(found) == 1


def test_units_behind_the_names_of_arrays(tmp_path):
    recording, _ = read(hdf5(tmp_path / "a.h5", **{"Force (kN)": (FORCE, {"fs": RATE})}))
    assert recording.channels[0].unit == "kN"


def tdms(path, group):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("g", name, *content) for name, content in group.items()])
    return path


def test_times_and_spectra_of_tdms(tmp_path):
    stamps = np.datetime64("2024-03-04T10:00:00") + np.rint(1e6 * TIMES).astype("timedelta64[us]")
    recording, found = read(tdms(tmp_path / "a.tdms", {"Stamps": (stamps,), "Force (N)": (FORCE,)}))
    assert recording.sampling_rate == pytest.approx(RATE, rel=1e-4) and len(found) == 1
    assert recording.channels[0].unit == "N"
    for unit, expected in (("ms", RATE), ("MS", RATE), ("s", RATE / 1e3)):
        about = {"wf_increment": 1e3 / RATE, "wf_xunit_string": unit}
        assert read(tdms(tmp_path / "a.tdms", {"F": (FORCE, about)}))[0].sampling_rate == pytest.approx(expected)
    with pytest.raises(BadData, match="spectrum"):
        open_recording(tdms(tmp_path / "a.tdms", {"F": (FORCE, {"wf_increment": 71.1, "wf_xunit_string": "Hz"})}))


def test_times_of_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    for name, values, rate in (
        ("TIME_MS", 1e3 * TIMES, RATE),
        ("timestamp", np.rint(1.7e15 + 500 * np.arange(N)).astype("i8"), 2000),
        ("micros", (400 * np.arange(N)).astype("i8"), 2500),
    ):
        pq.write_table(pa.table({name: values, "force (N)": FORCE}), tmp_path / "a.parquet")
        recording, found = read(tmp_path / "a.parquet")
        assert recording.sampling_rate == pytest.approx(rate, rel=1e-4) and len(found) == 1


def test_scale_and_start_of_a_column_of_parquet(tmp_path):
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    counts, seconds = (np.arange(N) % 97 - 50).astype("i2"), N // 2 / RATE

    def written(scale, *starts):
        fields = [
            pa.field(f"c{k}", pa.int16(), metadata={"unit": "N", "scale": scale, "start_time": start})
            for k, start in enumerate(starts)
        ]
        schema = pa.schema(fields, metadata={"sampling_rate": str(RATE)})
        pq.write_table(pa.table([counts] * len(starts), schema=schema), tmp_path / "a.parquet")
        return read(tmp_path / "a.parquet")[1]

    for one in written("0.01", "2026-01-01T00:00:00", "2026-01-01T00:00:00"):
        np.testing.assert_allclose(one, counts * 0.01)
    later = np.datetime64("2026-01-01T00:00:00", "us") + np.timedelta64(round(1e6 * seconds), "us")
    first, second = written("0.01", "2026-01-01T00:00:00", str(later))
    np.testing.assert_allclose(first, counts[N // 2 :] * 0.01)
    np.testing.assert_allclose(second, counts[: N - N // 2] * 0.01)
    with pytest.raises(BadData, match="scale of c0"):
        written("a hundredth", "2026-01-01T00:00:00")


# ---- what is no recording ----


def mat_object(path, *, alone):
    """Write a MATLAB file of version 5 with a table, an opaque element of a class, as MATLAB lays it out."""

    def element(kind, content):
        return np.array([kind, len(content)], "<u4").tobytes() + content + b"\0" * (-len(content) % 8)

    def matrix(flags, *parts):
        return element(14, element(6, np.array([flags, 0], "<u4").tobytes()) + b"".join(parts))

    metadata = matrix(13, element(5, np.array([6, 1], "<i4").tobytes()), element(1, b""), element(6, b"\0" * 24))
    opaque = matrix(17, *(element(1, name) for name in (b"T", b"MCOS", b"table")), metadata)
    savemat(path, {} if alone else {"force": FORCE, "fs": RATE})
    content = path.read_bytes()
    path.write_bytes(content[:128] + opaque + content[128:])
    return path


def test_objects_of_matlab_are_named_and_arrays_beside_them_read(tmp_path):
    recording, found = read(mat_object(tmp_path / "a.mat", alone=False))
    assert found[0].max() == PEAK and "T is a MATLAB table" in recording.messages[0]
    with pytest.raises(BadData, match="T is a MATLAB table"):
        open_recording(mat_object(tmp_path / "a.mat", alone=True))
    numbers = np.array([[3707764736, 2, 1, 1, 1, 1]], "u4")
    path = hdf5(tmp_path / "b.mat", T=(numbers, {"MATLAB_class": np.bytes_("table"), "MATLAB_object_decode": 3}))
    with pytest.raises(BadData, match="T is a MATLAB table"):
        open_recording(path)


def zipped(**members):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, text in members.items():
            archive.writestr(name.replace("__", "/"), text)
    return content.getvalue()


def test_the_one_recording_in_an_archive_is_read(write, tmp_path):
    text = table("t,F (N)\n", lambda t, x, k: f"{t:.9f},{x}")
    for content in (gzip.compress(text.encode()), zipped(a=text), zipped(**{"../../out.csv": text})):
        assert read(write(content, "a.gz"))[1].max() == PEAK
    assert not (tmp_path.parents[1] / "out.csv").exists()
    for content, word in (
        (zipped(a=text, b=text), "2 files"),
        (zipped(**{"[Content_Types].xml": "", "xl__workbook.xml": ""}), "Office"),
        (gzip.compress(text.encode())[:-20], "archive"),
        (gzip.compress(gzip.compress(text.encode())), "text"),
    ):
        with pytest.raises(BadData, match=word):
            open_recording(write(content, "a.gz"))


# ---- what is no reading ----


@pytest.mark.parametrize("filler", [-9999.0, -999.25, -32768.0])
def test_fillers_are_no_reading_whatever_the_format(tmp_path, write, filler):
    lost = np.where((np.arange(N) > 200) & (np.arange(N) < 212), filler, FORCE)
    for path, options in (
        (write(table("t,F (N)\n", lambda t, x, k: f"{t:.9f},{x}", lost)), {}),
        (hdf5(tmp_path / "a.h5", x=(lost, {"fs": RATE, "unit": "N"})), {}),
    ):
        _, found = read(path, **options)
        assert np.flatnonzero(np.isnan(found[0])).tolist() == [*range(201, 212)]
    near = np.where(np.arange(N) == 300, 0.8 * filler, lost)
    assert np.isfinite(read(hdf5(tmp_path / "a.h5", x=(near, {"fs": RATE, "unit": "N"})))[1]).all()
    integers = hdf5(tmp_path / "a.h5", x=(np.where(lost == filler, -32768, lost).astype("i2"), {"fs": RATE}))
    assert np.isnan(read(integers, full_scale="500 N")[1]).sum() == 11


def test_a_counter_in_a_stream_is_named_and_given_up():
    said = []
    gaps = Gaps([Channel(name="beam", unit="g"), Channel(name="packet", unit="g")], RATE, said.append, at_once=True)
    packet = (np.arange(N) // 4 * 3 % 200) * np.float32(0.1)
    blocks = [np.stack([FORCE, packet]).astype("f4")[:, first : first + 90] for first in range(0, N, 90)]
    *_, last = gaps.marked(iter(blocks))
    assert np.isnan(last[1]).all() and np.isfinite(last[0]).all()
    assert len(said) == 1 and "packet only counts" in said[0]


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        *(("lbs", 4.4482216152605), ("kgf", 9.80665), ("G", 9.80665), ("gn", 9.80665), ("cm/s^2", 0.01)),
        *(("in/s^2", 0.0254), ("ft/s^2", 0.3048), ("Gal", 0.01), ("m.s-2", 1), ("m s^-2", 1), ("in/s", 0.0254)),
    ],
)
def test_spellings_of_units(text, factor):
    assert meaning_of(known_unit(text))[1] == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_damaged_twins_are_told_or_read_to_the_damage(write, tmp_path, seed):
    rng = np.random.default_rng(seed)
    text = table("t,F (N),label\n", lambda t, x, k: f"{t:.9f},{x},coal").encode()
    whole = [
        text,
        gzip.compress(text),
        zipped(a=text.decode()),
        mat_object(tmp_path / "m.mat", alone=False).read_bytes(),
    ]
    for content in whole:
        for _ in range(10):
            damaged = bytearray(content[: rng.integers(1, len(content))] if rng.random() < 0.5 else content)
            damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
            with suppress(CgidError):
                read(write(bytes(damaged), "a.bin"), sampling_rate=RATE, unit="N")
