"""HDF5 files made to attack: none ends the reader, makes it large or slow, or has another file opened."""

from __future__ import annotations

import ctypes
import os
import resource
import signal
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cgid.errors import CgidError
from cgid.recordings import open_recording
from cgid.signals import Batch
from cgid.store import Dataset, read_table
from cgid.store.hdf5 import RecordingPlan, ShardBuilder, ShardPlan, writing
from cgid.store.reading import Recording
from cgid.store.table import TableHeader, TableRows, is_table, table_writer

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="inotify and limits as on Linux")

#: Processor time [s] and memory in addition [bytes] for one file.
TIME_LIMIT, MEMORY_LIMIT = 4, 512 << 20
#: By exit code.
OUTCOMES = ("read", "refused", "two lines", "traceback", "memory", "crash", "hang")
_IN_ACCESS, _IN_OPEN = 0x1, 0x20


def judge(kind: str, path: Path) -> str:
    process = os.fork()
    if not process:
        os._exit(_read(kind, path))
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    if code in (-signal.SIGXCPU, -signal.SIGKILL):
        return "hang"
    return OUTCOMES[code] if code >= 0 else "crash"


def _read(kind: str, path: Path) -> int:
    used = resource.getrusage(resource.RUSAGE_SELF)
    seconds = int(used.ru_utime + used.ru_stime) + TIME_LIMIT
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    pages = int(Path("/proc/self/statm").read_bytes().split()[5])
    resource.setrlimit(resource.RLIMIT_DATA, (pages * resource.getpagesize() + MEMORY_LIMIT,) * 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    try:
        KINDS[kind].read(path)
    except CgidError as error:
        return OUTCOMES.index("two lines" if "\n" in str(error) else "refused")
    except MemoryError:
        return OUTCOMES.index("memory")
    except Exception:
        return OUTCOMES.index("traceback")
    return OUTCOMES.index("read")


class Watch:
    """Watches whether the files of a folder are opened."""

    def __init__(self, folder: Path) -> None:
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._number = self._libc.inotify_init1(os.O_NONBLOCK)
        if self._libc.inotify_add_watch(self._number, os.fsencode(folder), _IN_OPEN | _IN_ACCESS) < 0:
            raise OSError(ctypes.get_errno(), "inotify cannot watch", str(folder))

    def opened(self) -> list[str]:
        try:
            content = os.read(self._number, 1 << 20)
        except BlockingIOError:
            return []
        found, place = [], 0
        while place < len(content):
            (length,) = struct.unpack_from("<12xI", content, place)
            found.append(content[place + 16 : place + 16 + length].rstrip(b"\0").decode())
            place += 16 + length
        return found


N_ROWS, N_SAMPLES = 24, 16


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    write : writes a sound file
    read : reads all of it and returns the arrays
    main, group, column : paths of its signals, of a group, and of a dataset in that group
    """

    write: Callable[[Path], None]
    read: Callable[[Path], list[Any]]
    main: str
    group: str
    column: str


def _write_dataset(path: Path) -> None:
    random = np.random.default_rng(0)
    attributes = {"format": "cgid-dataset", "schema_version": 1, "seed": 1}
    plan = ShardPlan(
        n_samples=N_SAMPLES, dtype="float32", label_width=6, parameter_units={"radius": "m"}, attributes=attributes
    )
    builder = ShardBuilder(plan, 0, N_ROWS)
    builder.add(
        Batch(
            signals=random.standard_normal((N_ROWS, N_SAMPLES)).astype(np.float32),
            labels=np.array(["coal", "gangue"] * (N_ROWS // 2)),
            sampling_rate=1e5,
            unit="N",
            pre_trigger=4,
            specimen=np.arange(N_ROWS, dtype=np.uint64),
            parameters={"radius": random.random(N_ROWS)},
        )
    )
    path.write_bytes(builder.image())


def _read_dataset(path: Path) -> list[Any]:
    dataset = Dataset(path)
    batches = list(dataset.batches())
    dataset.impact(len(dataset) - 1)
    parts = [[batch.signals, batch.labels, batch.specimen, *batch.parameters.values()] for batch in batches]
    return [np.concatenate(columns) for columns in zip(*parts, strict=True)]


def _write_recording(path: Path) -> None:
    plan = RecordingPlan(n_samples=N_ROWS * N_SAMPLES, dtype="float32", sampling_rate=1e5, unit="N", attributes={})
    with writing(path, plan) as writer:
        writer.add(np.random.default_rng(1).standard_normal(N_ROWS * N_SAMPLES).astype(np.float32))
        writer.add_impacts({"time": np.arange(3) * 1e-4, "label": np.array(["coal", "gangue", "coal"])}, {"time": "s"})


def _read_recording(path: Path) -> list[Any]:
    recording = Recording(path)
    blocks = list(recording.blocks(8192))
    return [*recording.impacts().values(), np.concatenate(blocks)]


def _write_table(path: Path) -> None:
    header = TableHeader(kind="features", units={"peak": "N", "width": "s"}, attributes={"n_signals": N_ROWS})
    random = np.random.default_rng(2)
    with table_writer(path, header, 6) as writer:
        writer.add(
            TableRows(
                labels=np.array(["coal", "gangue"] * (N_ROWS // 2)),
                specimen=np.arange(N_ROWS, dtype=np.uint64),
                columns={name: random.random(N_ROWS) for name in ("peak", "width")},
            )
        )


def _read_table(path: Path) -> list[Any]:
    is_table(path)
    table = read_table(path)
    return [table.labels, table.specimen, *table.columns.values()]


def _write_foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        samples = np.random.default_rng(3).standard_normal((2, 500))
        stored = file.create_dataset("run/samples", data=samples, chunks=(1, 128), compression="gzip", fletcher32=True)
        stored.attrs["fs"] = 1e4
        stored.attrs["unit"] = "m/s^2"
        file["run/names"] = np.arange(3.0)


def _read_foreign(path: Path) -> list[Any]:
    recording = open_recording(path, sampling_rate=1e4, variable="run/samples")
    return list(recording.blocks(8192))


KINDS = {
    "dataset": Kind(_write_dataset, _read_dataset, "signals", "parameters", "parameters/radius"),
    "recording": Kind(_write_recording, _read_recording, "samples", "impacts", "impacts/time"),
    "table": Kind(_write_table, _read_table, "specimen", "columns", "columns/peak"),
    "foreign": Kind(_write_foreign, _read_foreign, "run/samples", "run", "run/names"),
}


@dataclass(frozen=True)
class Outside:
    """Files that must not be opened: an HDF5 file, a raw one, and a pipe, which blocks its reader."""

    folder: Path

    @classmethod
    def make(cls, folder: Path) -> Outside:
        folder.mkdir()
        with h5py.File(folder / "secret.h5", "w") as file:
            file["x"] = np.arange(float(N_ROWS * N_SAMPLES)).reshape(N_ROWS, N_SAMPLES)
        (folder / "secret.raw").write_bytes(bytes(1 << 16))
        os.mkfifo(folder / "pipe")
        return cls(folder)

    def __truediv__(self, name: str) -> str:
        return str(self.folder / name)


Attack = Callable[[h5py.File, Kind, Outside], None]


def _instead(file: h5py.File, name: str, make: Callable[[tuple[int, ...], np.dtype[Any]], Any]) -> None:
    """Replace a dataset, and keep its attributes where the replacement can have them."""
    about, shape, dtype = dict(file[name].attrs), file[name].shape, file[name].dtype
    del file[name]
    made = make(shape, dtype)
    if isinstance(made, h5py.Dataset):
        made.attrs.update(about)


def _linked(name: str, link: Callable[[Outside], Any]) -> Attack:
    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        place = getattr(kind, name)
        file.move(place, "hidden")
        file[place] = link(outside)

    return attack


def _stored(**options: Any) -> Attack:
    """Replace the main dataset by one of another type, shape or storage."""

    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
            return file.create_dataset(kind.main, **{"shape": shape, "dtype": dtype, **options})

        _instead(file, kind.main, make)

    return attack


def _external(target: str) -> Attack:
    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        where = target if target.startswith("/") else outside / target

        def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
            size = int(np.prod(shape)) * dtype.itemsize
            return file.create_dataset(kind.main, shape, dtype, external=[(where, 0, size)])

        _instead(file, kind.main, make)

    return attack


def _virtual(file: h5py.File, kind: Kind, outside: Outside) -> None:
    def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
        layout = h5py.VirtualLayout(shape, dtype)
        layout[...] = h5py.VirtualSource(outside / "secret.h5", "x", shape)
        return file.create_virtual_dataset(kind.main, layout)

    _instead(file, kind.main, make)


def _one_chunk_of_many(file: h5py.File, kind: Kind, outside: Outside) -> None:
    _stored(shape=(10**9,), chunks=(1000,))(file, kind, outside)
    file[kind.main][:1000] = np.ones(1000, file[kind.main].dtype)


@cache
def _packed(size: int, times: int) -> bytes:
    return zlib.compress(_packed(size, times - 1), 9) if times else bytes(size)


def _bomb(chunk_bytes: int, n_chunks: int, times: int) -> Attack:
    """Chunks of zeros, compressed once or twice."""

    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        packed = _packed(chunk_bytes, times)

        def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
            creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            length = chunk_bytes // dtype.itemsize
            rest = shape[1:] if kind.main == "signals" else ()
            rows = length // int(np.prod(rest, dtype=int))
            creation.set_chunk((rows, *rest))
            for _ in range(times):
                creation.set_deflate(9)
            space = h5py.h5s.create_simple((rows * n_chunks, *rest))
            made = h5py.h5d.create(file.id, kind.main.encode(), h5py.h5t.py_create(dtype), space, creation)
            for number in range(n_chunks):
                made.write_direct_chunk((number * rows, *(0 for _ in rest)), packed)
            return h5py.Dataset(made)

        _instead(file, kind.main, make)

    return attack


def _unknown_filter(file: h5py.File, kind: Kind, outside: Outside) -> None:
    def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
        creation = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        creation.set_chunk(shape)
        creation.set_filter(32_099, h5py.h5z.FLAG_OPTIONAL, (1, 2, 3))
        space = h5py.h5s.create_simple(shape)
        made = h5py.h5d.create(file.id, kind.main.encode(), h5py.h5t.py_create(dtype), space, creation)
        made.write_direct_chunk(tuple(0 for _ in shape), bytes(int(np.prod(shape)) * dtype.itemsize))
        return h5py.Dataset(made)

    _instead(file, kind.main, make)


def _about(name: str, value: Any) -> Attack:
    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        for item in (file, file[kind.main]):
            item.attrs[name] = value

    return attack


def _crowd(count: int) -> Attack:
    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        group = file[kind.group]
        one = group.create_group("0").id
        for number in range(1, count):
            h5py.h5o.link(one, group.id, str(number).encode())

    return attack


def _crowd_of_attributes(file: h5py.File, kind: Kind, outside: Outside) -> None:
    for number in range(300):
        file.attrs[str(number)] = number


def _deep(file: h5py.File, kind: Kind, outside: Outside) -> None:
    file[kind.group].create_group("/".join("a" * 2000))


def _ring(file: h5py.File, kind: Kind, outside: Outside) -> None:
    file[f"{kind.group}/again"] = file["/"]
    del file[kind.main]
    file[kind.main] = file[kind.group]


def _put(name: str, make: Callable[[h5py.File], Any]) -> Attack:
    def attack(file: h5py.File, kind: Kind, outside: Outside) -> None:
        place = getattr(kind, name)
        del file[place]
        file[place] = make(file)

    return attack


def _never_written(file: h5py.File, kind: Kind, outside: Outside) -> None:
    """Half of the chunks are missing, so that their fill value would replace them."""

    def make(shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
        made = file.create_dataset(kind.main, shape, dtype, chunks=(1, *shape[1:]), fillvalue=7)
        made[: shape[0] // 2] = 1
        return made

    _instead(file, kind.main, make)


_COMPOUND = np.dtype([("a", "f4"), ("b", "f8")])
#: Attacks through HDF5.
ATTACKS: dict[str, Attack] = {
    "signals linked to another file": _linked("main", lambda out: h5py.ExternalLink(out / "secret.h5", "/x")),
    "signals linked to a pipe": _linked("main", lambda out: h5py.ExternalLink(out / "pipe", "/x")),
    "a group linked to another file": _linked("group", lambda out: h5py.ExternalLink(out / "secret.h5", "/")),
    "a column linked to another file": _linked("column", lambda out: h5py.ExternalLink(out / "secret.h5", "/x")),
    "a soft link within the file": _linked("main", lambda out: h5py.SoftLink("/hidden")),
    "signals stored in another file": _external("secret.raw"),
    "virtual signals": _virtual,
    "texts of variable length": _stored(dtype=h5py.string_dtype()),
    "rows of variable length": _stored(dtype=h5py.vlen_dtype(np.float32)),
    "references": _stored(dtype=h5py.ref_dtype),
    "compound numbers": _stored(dtype=_COMPOUND),
    "the other byte order": _stored(dtype=">f4"),
    "a million million values in no bytes": _stored(shape=(10**12,), chunks=(1000,)),
    "a thousand million values, one chunk of them there": _one_chunk_of_many,
    "a whole in one piece that was never written": _stored(shape=(10**9,)),
    "a chunk of 100 MB": _stored(shape=(25 << 20,), chunks=(25 << 20,), compression="gzip"),
    "chunks that were never written": _never_written,
    "a bomb of 48 MB": _bomb(16 << 20, 3, 1),
    "a bomb in a bomb, 4 GB": _bomb(16 << 20, 256, 2),
    "a filter that nobody knows": _unknown_filter,
    "a filter that believes its parameters": _stored(scaleoffset=4, chunks=True, dtype="i4"),
    "an empty dataset": _put("main", lambda file: h5py.Empty("f4")),
    "a group for the signals": _put("main", lambda file: h5py.SoftLink("/nowhere")),
    "a type for the signals": _put("main", lambda file: np.dtype("f4")),
    "a dataset for the group": _put("group", lambda file: np.zeros(9)),
    "a rate that is none": _about("sampling_rate", np.nan),
    "a unit of a megabyte": _about("unit", np.bytes_(b"N" * (1 << 16 - 1))),
    "a format of variable length": _about("format", "cgid-dataset"),
    "a newer schema": _about("schema_version", 7),
    "a huge count": _about("n_impacts", 1 << 62),
    "a scene that was not hashed": _about("scene", np.bytes_(b"{}")),
    "ten thousand columns": _crowd(10_001),
    "three hundred attributes": _crowd_of_attributes,
    "two thousand levels": _deep,
    "a group within itself": _ring,
}


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


#: Attacks on the bytes.
BYTES: dict[str, Callable[[bytes], bytes]] = {
    "cut in half": _cut,
    "the first eight bytes": lambda content: content[:8],
    "a signature and nothing but ones": lambda content: content[:8] + b"\xff" * 100_000,
    "behind a block of somebody else": lambda content: bytes(512) + content,
    "its own address for the root": lambda content: content[:36] + struct.pack("<Q", 0) + content[44:],
}


def hostile_files(folder: Path, outside: Outside) -> list[tuple[str, str, Path]]:
    """Write all hostile files into a folder, and return kind, attack and path of each."""
    found = []
    for name, kind in KINDS.items():
        sound = folder / f"{name}.h5"
        kind.write(sound)
        content = sound.read_bytes()
        for attack, change in ATTACKS.items():
            path = folder / f"{name}-{len(found):03d}.h5"
            path.write_bytes(content)
            with h5py.File(path, "r+", libver="latest") as file:
                change(file, kind, outside)
            found.append((name, attack, path))
        for attack, made in BYTES.items():
            path = folder / f"{name}-{len(found):03d}.h5"
            path.write_bytes(made(content))
            found.append((name, attack, path))
    return found


def test_files_made_by_hand_are_read_or_refused(tmp_path):
    outside = Outside.make(tmp_path / "outside")
    files = hostile_files(tmp_path, outside)
    for name, kind in KINDS.items():
        kind.read(tmp_path / f"{name}.h5")  # loads what reading needs
    watch = Watch(outside.folder)
    found = {(kind, name): judge(kind, path) for kind, name, path in files}
    assert {one: outcome for one, outcome in found.items() if outcome not in ("read", "refused")} == {}
    assert not watch.opened()
