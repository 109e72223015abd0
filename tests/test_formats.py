"""Every format: a file written by its own library is read back; damaged ones are refused, warned of or read in part."""

import warnings

import numpy as np
import pytest

from benchmarks.fuzz_recordings import fuzz
from cgid.errors import CgidError, MissingOption
from cgid.recordings import open_recording, read_recording
from tests import few
from tests.recording_files import NAMES, SPECIMENS, UNIT, blows

RATE = 51_200.0
#: Formats that have a length to tell by, so that nothing may be missing without a word; and checksums on everything.
LENGTHS = {"WAV", "NPY", "NPZ", "HDF5", "MAT", "TDMS", "UFF-58", "FLAC", "OGG", "Parquet"}
CHECKSUMS = ("NPZ", "HDF5 of cgid", "FLAC")

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
