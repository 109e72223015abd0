"""How a shard is built in memory: its file, its checksums, its chunks."""

import io
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest

from cgid.errors import BadData
from cgid.signals import Batch
from cgid.store._packing import fletcher32
from cgid.store.hdf5 import ShardBuilder, ShardMemory, ShardPlan

# ---- the checksum ----------------------------------------------------------------------------------------------------


def checksum_of_hdf5(words):
    with h5py.File.in_memory() as file:
        stored = file.create_dataset("words", data=words, chunks=words.shape, fletcher32=True)
        file.flush()
        content = stored.id.read_direct_chunk((0,))[1]
    assert content[:-4] == words.tobytes()
    return int.from_bytes(content[-4:], "little")


@pytest.mark.parametrize("size", [1, 2, 255, 256, 257, 360, 361, 4096, 65535, 65536, 300_001])
@pytest.mark.parametrize("kind", ["random", "zero", "highest", "one", "last"])
def test_checksum_is_that_of_hdf5(size, kind):
    words = np.zeros(size, "<u2")
    if kind == "random":
        words[:] = np.random.default_rng(size).integers(0, 65536, size)
    elif kind == "last":
        words[-1] = 0x0100
    else:
        words[:] = {"zero": 0, "highest": 65535, "one": 1}[kind]
    assert int(fletcher32(words)) == checksum_of_hdf5(words)


# ---- the shard -------------------------------------------------------------------------------------------------------

N, SAMPLES = 300, 1500


def plan(dtype="float32"):
    return ShardPlan(
        n_samples=SAMPLES,
        dtype=dtype,
        label_width=6,
        parameter_units={"radius": "m"},
        attributes={"format": "cgid-dataset", "note": "x" * 100},
    )


def batch(first, last, dtype="float32"):
    numbers = np.arange(first, last)
    return Batch(
        signals=np.random.default_rng(5).standard_normal((N, SAMPLES)).astype(dtype)[first:last],
        labels=np.where(numbers % 2, "coal", "gangue"),
        sampling_rate=1e5,
        unit="N",
        pre_trigger=16,
        specimen=numbers.astype(np.uint64),
        parameters={"radius": numbers / 7},
    )


def build(cuts, dtype="float32"):
    builder = ShardBuilder(plan(dtype), 0, N)
    for first, last in zip((0, *cuts), (*cuts, N), strict=True):
        builder.add(batch(first, last, dtype))
    return bytes(builder.image())


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_chunks_hold_what_was_added_however_it_was_cut(dtype):
    image = build((), dtype)
    assert all(build(cuts, dtype) == image for cuts in [(1, 2, 299), (87,), (86, 88, 175)])
    with h5py.File(io.BytesIO(image)) as file:
        signals = file["signals"]
        # Chunks that the number of signals is no multiple of.
        assert 1 < N / signals.chunks[0] != N // signals.chunks[0]
        assert signals.fletcher32
        np.testing.assert_array_equal(signals[:], batch(0, N, dtype).signals)
        np.testing.assert_array_equal(file["parameters/radius"][:], np.arange(N) / 7)
        np.testing.assert_array_equal(file["specimen"][:], np.arange(N))


def test_chunks_are_byte_for_byte_what_hdf5_writes():
    with h5py.File(io.BytesIO(build(()))) as file, h5py.File.in_memory() as other:
        ours, chunks = file["signals"].id, file["signals"].chunks
        theirs = other.create_dataset("signals", data=batch(0, N).signals, chunks=chunks, fletcher32=True).id
        other.flush()
        assert ours.get_num_chunks() == theirs.get_num_chunks() > 1
        for number in range(ours.get_num_chunks()):
            place = ours.get_chunk_info(number).chunk_offset
            assert ours.read_direct_chunk(place) == theirs.read_direct_chunk(place)


def test_no_flipped_bit_of_a_chunk_is_read_as_numbers():
    image = bytearray(build(()))
    with h5py.File(io.BytesIO(image)) as file:
        start, size = (getattr(file["signals"].id.get_chunk_info(1), name) for name in ("byte_offset", "size"))
    rng = np.random.default_rng(1)
    for place, bit in zip(start + rng.integers(0, size, 40), rng.integers(0, 8, 40), strict=True):
        image[place] ^= 1 << bit
        with h5py.File(io.BytesIO(image)) as file, pytest.raises(OSError, match=r"checksum|filter"):
            file["signals"][:]
        image[place] ^= 1 << bit


def test_too_few_and_too_many_signals():
    builder = ShardBuilder(plan(), 0, N)
    builder.add(batch(0, N - 1))
    with pytest.raises(BadData, match="a shard of 300 signals received 299"):
        builder.image()
    with pytest.raises(BadData, match="a shard of 300 signals received 301"):
        builder.add(batch(0, 2))


@pytest.mark.long
def test_an_unfinished_shard_is_closed_before_the_interpreter_ends():
    """HDF5 writes when it closes, and crashes if the memory and what writes to it are gone by then."""
    script = (
        "import atexit, builtins; atexit.register(lambda: print('open' if builtins.kept._file else 'closed')); "
        "from tests.test_shard import *; builtins.kept = ShardBuilder(plan(), 0, N); "
        "builtins.kept.add(batch(0, 100)); raise KeyboardInterrupt"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("closed\n", -signal.SIGINT), done.stderr


class _Interrupted(ShardMemory):
    """A file whose first large piece meets Ctrl-C."""

    def write(self, content):
        if len(content) > 1 << 18 and not self.pressed:
            self.pressed = True
            signal.raise_signal(signal.SIGINT)
        return super().write(content)

    pressed = False


def test_ctrl_c_in_the_middle_of_a_write_waits_for_hdf5(monkeypatch):
    monkeypatch.setattr("cgid.store.hdf5.ShardMemory", _Interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(())


@pytest.mark.parametrize("samples", [1, 7, 130, 4099])
@pytest.mark.parametrize("n_signals", [1, 2, 63, 4097])
def test_a_shard_of_any_shape_is_as_long_as_hdf5_says(tmp_path, samples, n_signals):
    """A file on a disk is filled up to its declared length, memory is not."""
    signals = np.arange(n_signals * samples, dtype=np.float32).reshape(n_signals, samples)
    about = ShardPlan(n_samples=samples, dtype="float32", label_width=2, parameter_units={"radius": "m"}, attributes={})
    builder = ShardBuilder(about, 0, n_signals)
    columns = {"labels": np.full(n_signals, "a"), "specimen": np.arange(n_signals, dtype=np.uint64)}
    columns["parameters"] = {"radius": np.ones(n_signals)}
    builder.add(Batch(signals=signals, sampling_rate=1e5, unit="N", pre_trigger=0, **columns))
    (tmp_path / "shard.h5").write_bytes(builder.image())
    with h5py.File(tmp_path / "shard.h5") as file:
        np.testing.assert_array_equal(file["signals"][:], signals)
        assert file["parameters/radius"][:].sum() == n_signals


def test_a_file_in_memory_is_that_of_python_and_forgets_the_one_before() -> None:
    memory, random = ShardMemory(), np.random.default_rng(3)
    for _ in range(20):
        memory.clear(int(random.integers(0, 300)))
        other = io.BytesIO()
        for _ in range(30):
            place, whence = int(random.integers(0, 400)), int(random.choice([0, 2]))
            content = random.bytes(random.integers(0, 90))
            for file in (memory, other):
                file.seek(place, whence)
                assert file.write(content) == len(content)
            assert memory.tell() == other.tell()
            if random.random() < 0.1:
                assert memory.truncate(place) == min(place, len(other.getvalue()))
                other.truncate(place)
            found, expected = bytearray(50), bytearray(50)
            assert memory.seek(place) == other.seek(place)
            assert memory.readinto(found) == other.readinto(expected)
            assert found == expected
        assert bytes(memory.getbuffer()) == other.getvalue()
