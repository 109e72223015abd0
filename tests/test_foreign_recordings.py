"""MATLAB, foreign HDF5, TDMS, UFF, Parquet: read as their own libraries do; refused or warned of where damaged."""

import struct
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from cgid.errors import BadData, CgidError, MissingOption
from cgid.recordings import open_recording
from cgid.recordings import tdms as tdms_reader
from cgid.recordings.recording import Asked
from cgid.recordings.variables import Variable, contents_of
from cgid.store.table import is_table
from tests import few, recording_files
from tests.beside import SHARED

RANDOM = np.random.default_rng(20261121)
N = 3001
SAMPLES = RANDOM.standard_normal((3, N))
REAL = SHARED / "realdata"


def read(path, length=700, **options):
    """Return the recording and all of its samples, read by blocks."""
    recording = open_recording(path, **options)
    blocks = list(recording.blocks(length))
    assert all(block.shape[1] == length for block in blocks[:-1]) and 0 < blocks[-1].shape[1] <= length
    return recording, np.concatenate(blocks, axis=1)


def refused(path, error=BadData, **options):
    with pytest.raises(error) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def units(recording):
    return [channel.unit for channel in recording.channels]


def names(recording):
    return [channel.name for channel in recording.channels]


# ---- HDF5 ----


@pytest.fixture
def hdf5(tmp_path):
    """Write an HDF5 file: `hdf5(fill)` calls `fill(file)`."""

    def written(fill, **options):
        path = tmp_path / "foreign.h5"
        with h5py.File(path, "w", **options) as file:
            fill(file)
        return path

    return written


@pytest.mark.parametrize("locking", [None, True, False, "best-effort"])
def test_hdf5_that_other_code_has_open_is_read_and_left_open(hdf5, locking):
    def fill(file):
        file["force"] = SAMPLES[0]
        file["force"].attrs["sampling_rate"] = 1e4

    path = hdf5(fill)
    with h5py.File(path, "r", locking=locking) as file:
        assert np.array_equal(read(path)[1], SAMPLES[:1])
        assert np.array_equal(file["force"][:], SAMPLES[0])


@pytest.mark.parametrize("dtype", ["f4", ">f4", "f8", ">f8", "f2", "i2", "u4"])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("chunks", [None, (3, 100), (1, 3001)])
def test_hdf5_of_any_type_and_layout_is_what_h5py_reads(hdf5, dtype, turned, chunks):
    values = (100 * SAMPLES).astype(dtype) if dtype != "u4" else np.abs(100 * SAMPLES).astype(dtype)
    stored = values.T if turned else values

    def fill(file):
        packing = {} if chunks is None else {"compression": "gzip", "shuffle": True, "fletcher32": True}
        shape = chunks[::-1] if chunks and turned else chunks
        file.create_dataset("x", data=stored, chunks=shape, **packing).attrs["fs"] = 1000

    path = hdf5(fill)
    recording, found = read(path)
    assert np.array_equal(found, values.astype(np.float64))
    assert found.dtype == (np.float32 if dtype.endswith("f4") else np.float64)
    assert (recording.sampling_rate, recording.n_samples, recording.format) == (1000.0, N, "HDF5")
    _, second = read(path, channel=[3, 1])
    assert np.array_equal(second, values[[2, 0]].astype(np.float64))


@pytest.mark.parametrize("variable_length", [False, True])
def test_attributes_of_array_group_and_root_are_found_the_nearest_first(hdf5, variable_length):
    def text(value):
        return value if variable_length else np.bytes_(value.encode())

    def fill(file):
        stored = file.create_dataset("day/run/acc", data=SAMPLES)
        stored.attrs["units"] = [value if variable_length else value.encode() for value in ("m/s^2", "µm", "furlong")]
        stored.attrs["channel_names"] = [value if variable_length else value.encode() for value in ("a", "b", "c")]
        file["day/run"].attrs["Sampling Rate [kHz]"] = 51.2
        file["day"].attrs["fs"] = 7.0
        file.attrs["dt"] = 3.0
        file.attrs["start_time"] = text("2026-03-04T10:11:12.500000")
        file.attrs["unit"] = text("V")

    recording, _ = read(hdf5(fill))
    assert recording.sampling_rate == 51_200.0 and recording.start_time == datetime(2026, 3, 4, 10, 11, 12, 500_000)
    assert units(recording) == ["m/s^2", "µm", None] and names(recording) == ["a", "b", "c"]
    assert not recording.warnings


@pytest.mark.parametrize(
    ("fill", "rate"),
    [
        (lambda file: file.create_dataset("fs", data=2000.0), 2000.0),
        (lambda file: file.create_dataset("sampling_interval_us", data=np.array([[500]])), 2000.0),
        (lambda file: file.create_dataset("dt", data=np.bytes_(b"0.5 ms")), 2000.0),
        (lambda file: file.create_dataset("Sample rate", data="2 kHz"), 2000.0),
        (lambda file: file.create_dataset("time", data=np.arange(N) / 2000 + 5), 2000.0),
        (lambda file: file.create_dataset("t (ms)", data=np.arange(N, dtype=np.float32) / 2), 2000.0),
        (lambda file: file.create_dataset("t", data=np.arange(N) * 500).attrs.create("unit", np.bytes_(b"us")), 2000.0),
    ],
)
def test_rate_from_what_lies_beside_the_array(hdf5, fill, rate):
    def both(file):
        file["x"] = SAMPLES[0]
        fill(file)

    assert read(hdf5(both))[0].sampling_rate == pytest.approx(rate, rel=1e-9)


def test_contradicting_and_impossible_rates_are_refused(hdf5):
    def fill(file, **attributes):
        file["x"] = SAMPLES[0]
        file["x"].attrs.update(attributes)

    message = refused(hdf5(lambda file: fill(file, fs=1000.0, dt=0.002)))
    assert "fs states 1000 Hz" in message and "dt states 500 Hz" in message

    def timed(file, times):
        fill(file, fs=1000.0)
        file["time"] = times

    assert "fs states 1000 Hz and array time states 500 Hz" in refused(
        hdf5(lambda file: timed(file, np.arange(N) / 500))
    )
    recording, _ = read(hdf5(lambda file: timed(file, np.arange(N) ** 2.0)))
    assert recording.sampling_rate == 1000.0 and "times of time are not even" in recording.warnings[0]
    assert "above 0" in refused(hdf5(lambda file: fill(file, fs=-3.0)))
    assert "above 0" in refused(hdf5(lambda file: fill(file, dt=0.0)))
    assert "sampling_rate=HZ" in refused(hdf5(lambda file: fill(file, FS=5.0)), MissingOption)
    assert "sampling_rate=HZ" in refused(hdf5(fill), MissingOption)
    assert read(hdf5(fill), sampling_rate=500.0)[0].sampling_rate == 500.0


@pytest.mark.parametrize("fault", ["gap", "slower later", "back", "coarse"])
def test_uneven_times_are_refused(hdf5, fault):
    times = np.arange(70_000) / 2000
    if fault == "gap":
        times[40_000:] += 0.0003
    elif fault == "slower later":
        times[66_000:] = times[66_000] + np.arange(4000) / 1900
    elif fault == "back":
        times[500] = times[499]
    else:
        times = (times + 1e5).astype(np.float32)

    def fill(file):
        file["x"], file["time"] = np.zeros(70_000), times

    assert "time" in refused(hdf5(fill))


def test_several_arrays_are_listed_and_picked_by_name_group_or_pattern(hdf5):
    def fill(file):
        file.attrs["fs"] = 100.0
        for index, name in enumerate(("run/ch1", "run/ch2", "other/ch3")):
            file[name] = SAMPLES[index]
        file["other/short"] = SAMPLES[0, :5]
        file["run/slow"] = SAMPLES[0]
        file["run/slow"].attrs["fs"] = 10.0
        file["unfit"] = np.zeros((3, 4, 5))
        file["flags"] = np.zeros(N, bool)
        file["one"] = 3.0

    path = hdf5(fill)
    message = refused(path)
    assert "variable=NAME" in message and all(f"{name} (3001)" in message for name in ("run/ch1", "other/ch3"))
    assert "unfit" not in message and "flags" not in message
    for variable in ("run/ch2", "/run/ch2", "ch2"):
        recording, found = read(path, variable=variable)
        assert np.array_equal(found, SAMPLES[1:2]) and names(recording) == ["1"]
    recording, found = read(path, variable="*/ch?")
    assert np.array_equal(found, SAMPLES[[2, 0, 1]]) and names(recording) == ["ch3", "ch1", "ch2"]
    assert "one sampling rate" in refused(path, variable="run")
    assert "one length" in refused(path, variable="other")
    assert "no variable" in refused(path, variable="gone")


def test_arrays_that_lie_elsewhere_are_not_read(hdf5, tmp_path):
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["x"] = SAMPLES[0]
    raw = tmp_path / "raw.bin"
    raw.write_bytes(SAMPLES[0].tobytes())

    def fill(file):
        file["linked"] = h5py.ExternalLink("secret.h5", "x")
        file["soft"] = h5py.SoftLink("/linked")
        layout = h5py.VirtualLayout((N,), "f8")
        layout[:] = h5py.VirtualSource("secret.h5", "x", (N,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("external", (N,), "f8", external=[("raw.bin", 0, N * 8)])
        file.create_dataset("ragged", (N,), h5py.vlen_dtype(np.float64))
        file.create_dataset("pointing", (N,), h5py.ref_dtype)
        file.create_dataset("words", (N,), h5py.string_dtype())

    assert "there is none" in refused(hdf5(fill), sampling_rate=10.0)


def test_hostile_shapes_of_hdf5_are_refused_before_anything_is_allocated(hdf5):
    def declared(file):
        file.create_dataset("x", (10**12,), "f8", chunks=(1000,)).attrs["fs"] = 1.0

    assert "declares 1000000000 chunks in a file of" in refused(hdf5(declared))

    def one_chunk(file):
        file.create_dataset("x", (10**10,), "f8", chunks=(10**6,)).attrs["fs"] = 1.0
        file["x"][:1000] = 1.0

    assert "declares 80000000000 bytes and contains 8000000" in refused(hdf5(one_chunk))

    def bomb(file):
        file.create_dataset("x", (1 << 25,), "f8", chunks=(1 << 25,)).attrs["fs"] = 1.0
        file["x"].id.write_direct_chunk((0,), bytes(300_000))

    assert "chunks of more than 64 MiB" in refused(hdf5(bomb))

    def crowd(file):
        for index in range(10_001):
            file.create_group(str(index))

    assert "10000 objects" in refused(hdf5(crowd))

    def deep(file):
        file["/".join("a" * 40)] = SAMPLES

    assert "32 levels" in refused(hdf5(deep))

    def ring(file):
        file["a/x"] = SAMPLES
        file["a/again"] = file["/"]

    assert read(hdf5(ring), sampling_rate=1.0)[0].n_samples == N


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("maxshape", [(3000,), (None,)])
@pytest.mark.parametrize("packing", [{}, {"compression": "gzip"}, {"compression": "lzf", "fletcher32": True}])
def test_chunks_that_were_never_written_are_warned_of(hdf5, libver, maxshape, packing):
    def fill(file):
        stored = file.create_dataset("x", (3000,), "f8", chunks=(1000,), maxshape=maxshape, fillvalue=0.25, **packing)
        stored.attrs["fs"] = 1.0
        stored[:2000] = [*SAMPLES[0, :1000], *np.zeros(1000)]

    recording, found = read(hdf5(fill, libver=libver))
    assert np.array_equal(found[0, :2000], [*SAMPLES[0, :1000], *np.zeros(1000)])
    assert (found[0, 2000:] == 0.25).all() and "x: 1 of 3 chunks were never written" in recording.warnings[0]


def test_a_damaged_index_of_chunks_is_refused_before_it_crashes_hdf5(hdf5):
    def fill(file):
        stored = file.create_dataset("x", data=SAMPLES, chunks=(1, 500), compression="gzip", fletcher32=True)
        stored.attrs["fs"] = 1.0

    path = hdf5(fill)
    with h5py.File(path) as file:
        size = file["x"].id.get_chunk_info(3).size
    content = path.read_bytes()
    assert content.count(struct.pack("<II", size, 0)) >= 1
    for wrong in (0, 3, 4, 10**9, 2**32 - 1):
        path.write_bytes(content.replace(struct.pack("<II", size, 0), struct.pack("<II", wrong, 0)))
        assert "damaged index of chunks" in refused(path) or wrong > 10**8


# ---- MATLAB ----


@pytest.mark.parametrize("packed", [False, True])
def test_structs_texts_and_times_of_mat_are_found(tmp_path, packed):
    path = tmp_path / "session.mat"
    rig = {"acc": SAMPLES.T.astype(np.float32), "fs": 25_600.0, "units": "m/s^2", "note": "no unit"}
    columns = {"force": SAMPLES[:1].T, "time": np.arange(N)[:, None] / 5000}
    savemat(
        path,
        {"rig": rig, "columns": columns, "spectrum": SAMPLES + 1j, "flags": SAMPLES > 0, "cells": np.array([rig, rig])},
        do_compression=packed,
    )
    message = refused(path)
    assert "rig/acc (3 x 3001)" in message and "columns/force (3001)" in message
    assert "spectrum" not in message and "flags" not in message
    recording, found = read(path, variable="rig/acc")
    assert np.array_equal(found, SAMPLES.astype(np.float32))
    assert (recording.sampling_rate, units(recording)) == (25_600.0, ["m/s^2"] * 3)
    recording, found = read(path, variable="columns")
    assert np.array_equal(found, SAMPLES[:1]) and recording.sampling_rate == pytest.approx(5000, rel=1e-12)


@pytest.mark.parametrize("write", [lambda path: savemat(path, {"x": SAMPLES}), lambda path: np.savez(path, x=SAMPLES)])
def test_arrays_too_large_to_be_read_whole_are_refused(tmp_path, monkeypatch, write):
    path = tmp_path / "x.npz"
    with path.open("wb") as file:
        write(file)
    assert np.array_equal(read(path, sampling_rate=1.0)[1], SAMPLES)
    monkeypatch.setattr("cgid.recordings.arrays.MAX_ARRAYS", SAMPLES.nbytes - 1)
    refused(path, sampling_rate=1.0)


# ---- TDMS ----


def write_tdms(path, segments, about=None, group=None, root=None):
    """Write a TDMS file: `segments` are lists of (group, channel, samples)."""
    nptdms = pytest.importorskip("nptdms")
    about = {"wf_increment": 1 / 25_600, "unit_string": "g"} if about is None else about
    with nptdms.TdmsWriter(str(path)) as writer:
        for segment in segments:
            channels = [nptdms.ChannelObject(g, name, np.asarray(values), about) for g, name, values in segment]
            groups = [nptdms.GroupObject(g, group or {}) for g in dict.fromkeys(g for g, _, _ in segment)]
            writer.write_segment([nptdms.RootObject(root or {}), *groups, *channels])
    return path


def whole(samples=SAMPLES, group="beam", parts=4):
    return [
        [(group, f"cDAQ1Mod1/ai{k}", row) for k, row in enumerate(part)]
        for part in np.array_split(samples, parts, axis=1)
    ]


@pytest.mark.parametrize("longest", [1 << 18, 100])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i2", "u4"])
def test_tdms_is_what_nptdms_reads(tmp_path, monkeypatch, dtype, longest):
    nptdms = pytest.importorskip("nptdms")
    # Channels of longer chunks are read completely.
    monkeypatch.setattr(tdms_reader, "MAX_CHUNK_SIZE", longest)
    values = (100 * np.abs(SAMPLES)).astype(dtype)
    path = write_tdms(tmp_path / "a.tdms", whole(values))
    # A unit does not say how many of it one step of integers is.
    scale = {} if dtype.startswith("f") else {"full_scale": "32768 g at 16 bit"}
    if scale:
        with pytest.raises(MissingOption, match="full_scale="):
            open_recording(path)
    recording, found = read(path, **scale)
    with nptdms.TdmsFile.open(path) as file:
        expected = np.stack([channel[:] for channel in file["beam"].channels()])
    assert np.array_equal(found, expected) and np.array_equal(found, values)
    assert found.dtype == (np.float32 if dtype == "f4" else np.float64)
    assert recording.sampling_rate == 25_600.0 and units(recording) == ["g"] * 3
    assert names(recording) == [f"cDAQ1Mod1/ai{k}" for k in range(3)]
    assert np.array_equal(read(path, variable="cDAQ1Mod1/ai2", **scale)[1][0], values[2])
    assert np.array_equal(read(path, variable="beam/cDAQ1Mod1/ai1", length=5000, **scale)[1][0], values[1])


def test_tdms_of_several_groups_lengths_and_rates(tmp_path):
    path = write_tdms(tmp_path / "groups.tdms", [whole(parts=1)[0] + whole(SAMPLES[:1, :50], "slow", 1)[0]])
    message = refused(path)
    assert all(f"{name})" in message for name in ("beam/cDAQ1Mod1/ai0 (3001", "slow/cDAQ1Mod1/ai0 (50"))
    assert "variable=NAME" in message
    assert read(path, variable="beam")[1].shape == (3, N) and read(path, variable="slow")[1].shape == (1, 50)
    assert "several" in refused(path, variable="cDAQ1Mod1/ai0")
    uneven = [[("g", "a", SAMPLES[0]), ("g", "b", SAMPLES[1, :100]), ("g", "c", SAMPLES[2])]]
    path = write_tdms(tmp_path / "uneven.tdms", uneven)
    message = refused(path)
    assert "one length" in message and "g/b (100)" in message and "variable=NAME" in message
    assert np.array_equal(read(path, variable="g/[ac]")[1], SAMPLES[[0, 2]])
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(tmp_path / "rates.tdms")) as writer:
        rates = [nptdms.ChannelObject("g", str(k), SAMPLES[k], {"wf_increment": 0.1 * (k + 1)}) for k in range(2)]
        writer.write_segment(rates)
    assert "one sampling rate" in refused(tmp_path / "rates.tdms")


def test_tdms_never_closed_by_labview_and_a_false_index_beside_it(tmp_path):
    path = write_tdms(tmp_path / "open.tdms", whole(parts=1))
    content = bytearray(path.read_bytes())
    content[12:20] = b"\xff" * 8
    path.write_bytes(content)
    (tmp_path / "open.tdms_index").write_bytes(b"TDSh" + bytes(100))
    recording, found = read(path)
    assert np.array_equal(found, SAMPLES) and "never closed" in recording.warnings[0]


@pytest.mark.parametrize("declared", [N + 1, 10**10, 10**12, 2**62, 2**64 - 1])
def test_hostile_counts_of_tdms_are_refused_or_end_with_the_file(tmp_path, declared):
    path = write_tdms(tmp_path / "huge.tdms", whole(SAMPLES[:1], parts=1))
    content = path.read_bytes()
    path.write_bytes(content.replace(struct.pack("<IQ", 1, N), struct.pack("<IQ", 1, declared)))
    try:
        recording, found = read(path)
    except CgidError as error:
        assert "\n" not in str(error) and declared > 10**10
    else:
        assert np.array_equal(found, SAMPLES[:1, : found.shape[1]]) and found.shape[1] <= N
        (warning,) = recording.warnings
        assert f"declares {declared} samples" in warning and f"{found.shape[1]} follow" in warning


# ---- universal files ----


def write_uff(path, sets, binary=0, id1=None, **about):
    """Write data sets 58 of a microphone by pyuff."""
    pytest.importorskip("pyuff")
    lines = {"id3": ["04-Mar-26 10:11:12"] * len(sets)}
    names = [id1 or f"mic {number}" for number in range(1, len(sets) + 1)]
    about = {"ordinate_spec_data_type": 15, **about}
    recording_files.write_uff(
        path, sets, 8192, binary=binary, names=names, units=["Pa"] * len(sets), about=about, **lines
    )
    return path


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("precision", [2, 4])
def test_uff_is_what_pyuff_reads(tmp_path, binary, precision):
    pyuff = pytest.importorskip("pyuff")
    path = write_uff(tmp_path / "a.uff", SAMPLES, binary=binary, ord_data_type=precision)
    if binary and precision == 2:
        # pyuff says single and writes double.
        refused(path)
        content = path.read_bytes()
        for row in SAMPLES:
            content = content.replace(row.tobytes(), row.astype("f4").tobytes())
        path.write_bytes(content)
    recording, found = read(path)
    expected = np.stack([pyuff.UFF(str(path)).read_sets(k)["data"][:N] for k in range(3)])
    assert np.array_equal(found, expected)
    assert np.allclose(found, SAMPLES, rtol=0, atol=1e-5 if precision == 2 else 1e-11)
    assert found.dtype == (np.float32 if binary and precision == 2 else np.float64)
    assert (recording.sampling_rate, recording.format) == (8192.0, "UFF")
    assert units(recording) == ["Pa"] * 3 and names(recording) == ["mic 1", "mic 2", "mic 3"]
    assert recording.start_time == datetime(2026, 3, 4, 10, 11, 12) and not recording.warnings
    assert np.array_equal(read(path, variable="2", length=5)[1], found[1:2])
    assert np.array_equal(read(path, variable="mic 3")[1], found[2:])
    assert "mic 2" in refused(path, variable="4")


@pytest.mark.parametrize("number", [0, 1])
def test_bytes_added_to_or_missing_in_a_binary_uff_are_found(tmp_path, number):
    path = write_uff(tmp_path / "a.uff", SAMPLES[:2], binary=1)
    content = path.read_bytes()
    start = content.index(SAMPLES[number].tobytes()) + 801
    for damaged in (content[:start] + b"x" + content[start:], content[:start] + content[start + 3 :]):
        path.write_bytes(damaged)
        refused(path)


@pytest.mark.long
def test_uff_that_is_no_recording_is_refused(tmp_path):
    path = tmp_path / "other.uff"
    frf = write_uff(path, [SAMPLES[0] + 1j], func_type=4, ord_data_type=6, abscissa_spec_data_type=18)
    assert "no data set is a response over time" in refused(frf)
    assert "no response over time" in refused(frf, variable="1")
    assert "complex" in refused(write_uff(path, [SAMPLES[0] + 1j], ord_data_type=6))
    assert not read(write_uff(path, SAMPLES[:1], abscissa_spacing=0))[0].warnings
    path.write_bytes(path.read_bytes().replace(b"3.66211e-04", b"3.96211e-04", 1))
    assert "even" in refused(path)
    assert names(read(write_uff(path, SAMPLES[:2], id1="rig"))[0]) == ["1+Z", "2+Z"]
    assert "one length and rate" in refused(write_uff(path, [SAMPLES[0], SAMPLES[1, :50]]))
    assert read(path, variable="2")[1].shape == (1, 50)
    path.write_bytes(b"    -1\n   151\n" + b"model\n" * 7 + b"    -1\n")
    assert "data set 58" in refused(path)
    # A column of numbers that begins like a universal file is none.
    path.write_bytes(b"-1\n58\n3\n")
    assert read(path, sampling_rate=1.0)[1].tolist() == [[-1, 58, 3]]


@pytest.mark.skipif(not REAL.is_dir(), reason=f"the measured recordings are not there: {REAL}")
def test_the_real_universal_file_is_what_pyuff_reads():
    pyuff = pytest.importorskip("pyuff")
    path = REAL / "shock" / "mic_sample_uff58b.uff"
    recording, found = read(path, length=4096)
    expected = pyuff.UFF(str(path)).read_sets(0)
    # pyuff takes the bytes of the end mark for two more samples.
    assert np.array_equal(found[0], expected["data"][:79_292]) and found.shape == (1, 79_292)
    assert (recording.sampling_rate, units(recording)) == (65_536.0, ["Pa"])
    assert recording.start_time == datetime(2016, 4, 18, 13, 49, 58) and not recording.warnings


# ---- Parquet ----


@pytest.fixture
def parquet(tmp_path):
    """Write columns to a Parquet file by pyarrow."""
    arrow = pytest.importorskip("pyarrow")
    writer = pytest.importorskip("pyarrow.parquet")

    def written(columns, metadata=None, fields=None, **options):
        table = arrow.table(columns)
        if fields:
            own = [field.with_metadata(fields.get(field.name)) for field in table.schema]
            table = table.cast(arrow.schema(own))
        path = tmp_path / "table.parquet"
        options = {"row_group_size": 800, "write_page_checksum": True} | options
        writer.write_table(table.replace_schema_metadata(metadata), path, **options)
        return path

    return written


@pytest.mark.parametrize("compression", ["none", "snappy", "gzip", "zstd"])
def test_parquet_is_what_was_written(parquet, compression):
    columns = {"t [ms]": np.arange(N) / 20, "force (kN)": SAMPLES[0], "n": (9 * SAMPLES[1]).astype("i2")}
    path = parquet(columns | {"acc": SAMPLES[2].astype("f4")}, {"unit": "g"}, compression=compression)
    assert not is_table(path)
    recording, found = read(path, full_scale={"n": "32768 g"})
    expected = [SAMPLES[0], columns["n"], SAMPLES[2].astype("f4")]
    assert np.array_equal(found, expected)
    assert recording.sampling_rate == pytest.approx(20_000, rel=1e-12) and recording.format == "Parquet"
    assert names(recording) == ["force", "n", "acc"] and units(recording) == ["kN", "g", "g"]
    assert np.array_equal(read(path, channel=["acc", 1])[1], [expected[2], expected[0]])


# ---- all ----


def test_channels_that_come_in_pieces_of_different_length_stay_together():
    def pieces(row, most):
        def blocks(length, channels):
            for first in range(0, len(row), min(length, most)):
                yield row[None, first : first + min(length, most)]

        return blocks

    parts = [
        Variable(name=f"c{k}", n_channels=1, n_samples=N, read=pieces(SAMPLES[k], most), about={"fs": 5.0})
        for k, most in enumerate((100, 37, 1000))
    ]
    contents = contents_of(parts, {}, "made", Asked(variable="c*"), [])
    for channels in ((0, 1, 2), (2,), (1, 0)):
        assert np.array_equal(np.concatenate(list(contents.read(64, channels)), axis=1), SAMPLES[list(channels)])
    short = Variable(name="short", n_channels=1, n_samples=N, read=pieces(SAMPLES[0, :9], 5))
    with pytest.raises(BadData, match="3001 samples are declared, the file contains 9"):
        list(contents_of([parts[0], short], {"": {"fs": 5.0}}, "made", Asked(variable="*"), []).read(64, (0, 1)))


_MEMORY = r"""
import re, sys
from pathlib import Path
from cgid.recordings import open_recording

def grown(path):
    rate = 8192.0 if path.endswith(".uff") else 1000.0
    recording = open_recording(path, sampling_rate=rate, variable=sys.argv[1] or None)
    count = sum(block.shape[1] for block in recording.blocks(8192))
    # ru_maxrss would begin with the peak of the process that started this one.
    return int(re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[1]), count

before, _ = grown(sys.argv[2])
after, count = grown(sys.argv[3])
print(after - before, count)
"""


def _write_long(kind, path, samples):
    about = {"wf_increment": 0.001}
    if kind == "tdms":
        write_tdms(path, whole(samples, "x", parts=max(samples.shape[1] // 5000, 1)), about)
    elif kind == "hdf5":
        with h5py.File(path, "w") as file:
            file.create_dataset(
                "x", data=samples.T, chunks=(5000, len(samples)), compression="gzip", compression_opts=1
            )
    else:
        pyarrow, writer = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
        columns = {"time": np.arange(samples.shape[1]) / 1000} | {str(k): row for k, row in enumerate(samples)}
        writer.write_table(pyarrow.table(columns), path, row_group_size=1 << 20, compression="none")


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux says the peak memory of a program")
@pytest.mark.parametrize("kind", few(["hdf5", "tdms", "parquet"], 3))
def test_memory_does_not_grow_with_the_recording(tmp_path, kind):
    # Whole they would take 16 MB more. pyarrow has buffers that fill up within the first million of rows.
    lengths = (1_000_000, 3_000_000) if kind == "parquet" else (15_000, 1_000_000)
    for name, n_samples in zip(("short", "long"), lengths, strict=True):
        _write_long(kind, tmp_path / f"{name}.{kind}", np.tile(SAMPLES[:2], n_samples // N + 1)[:, :n_samples].copy())
    variable = "" if kind == "parquet" else "x"
    done = subprocess.run(
        [sys.executable, "-c", _MEMORY, variable, str(tmp_path / f"short.{kind}"), str(tmp_path / f"long.{kind}")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert not done.returncode, done.stderr
    growth, count = map(int, done.stdout.split())
    assert count == n_samples and growth < 8_000, f"{growth} kB"
