"""Hostile HDF5 files: a file of each kind that cgid reads, and attacks on it; see `benchmarks/hostile.py`."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cgid.recordings import open_recording
from cgid.signals import Batch
from cgid.store import Dataset, Rows, TableHeader, is_table, read_table, table_writer
from cgid.store.hdf5 import RecordingPlan, ShardBuilder, ShardPlan, writing
from cgid.store.reading import Recording

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
            Rows(
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
        """Make them in a folder."""
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
    "signals linked to a device": _linked("main", lambda out: h5py.ExternalLink("/dev/zero", "/x")),
    "a group linked to another file": _linked("group", lambda out: h5py.ExternalLink(out / "secret.h5", "/")),
    "a column linked to another file": _linked("column", lambda out: h5py.ExternalLink(out / "secret.h5", "/x")),
    "a soft link within the file": _linked("main", lambda out: h5py.SoftLink("/hidden")),
    "a soft link to itself": _linked("main", lambda out: h5py.SoftLink("/signals")),
    "signals stored in another file": _external("secret.raw"),
    "signals stored in a pipe": _external("pipe"),
    "signals stored in a device": _external("/dev/zero"),
    "signals stored in the list of users": _external("/etc/passwd"),
    "virtual signals": _virtual,
    "texts of variable length": _stored(dtype=h5py.string_dtype()),
    "rows of variable length": _stored(dtype=h5py.vlen_dtype(np.float32)),
    "references": _stored(dtype=h5py.ref_dtype),
    "references to regions": _stored(dtype=h5py.regionref_dtype),
    "compound numbers": _stored(dtype=_COMPOUND),
    "arrays of arrays": _stored(dtype=np.dtype("(3,4)f4")),
    "opaque bytes": _stored(dtype=np.dtype("V16")),
    "complex numbers": _stored(dtype=np.complex128),
    "the other byte order": _stored(dtype=">f4"),
    "a million million values in no bytes": _stored(shape=(10**12,), chunks=(1000,)),
    "a thousand million values, one chunk of them there": _one_chunk_of_many,
    "a whole in one piece that was never written": _stored(shape=(10**9,)),
    "thirty-two axes": _stored(shape=(2,) * 32, chunks=(1,) * 32),
    "a chunk of 100 MB": _stored(shape=(25 << 20,), chunks=(25 << 20,), compression="gzip"),
    "chunks that were never written": _never_written,
    "a bomb of 48 MB": _bomb(16 << 20, 3, 1),
    "a bomb in a bomb, 4 GB": _bomb(16 << 20, 256, 2),
    "a filter that nobody knows": _unknown_filter,
    "a filter that believes its parameters": _stored(scaleoffset=4, chunks=True, dtype="i4"),
    "an empty dataset": _put("main", lambda file: h5py.Empty("f4")),
    "one number": _put("main", lambda file: np.float32(1)),
    "a group for the signals": _put("main", lambda file: h5py.SoftLink("/nowhere")),
    "a type for the signals": _put("main", lambda file: np.dtype("f4")),
    "a dataset for the group": _put("group", lambda file: np.zeros(9)),
    "a rate that is none": _about("sampling_rate", np.nan),
    "a rate of minus one": _about("sampling_rate", -1.0),
    "a rate of next to nothing": _about("sampling_rate", 5e-324),
    "a rate beyond all numbers": _about("sampling_rate", 1e308),
    "a unit of a megabyte": _about("unit", np.bytes_(b"N" * (1 << 16 - 1))),
    "a format of variable length": _about("format", "cgid-dataset"),
    "a list of formats": _about("format", np.array([b"cgid-dataset"] * 3)),
    "a rate of sixteen bytes": _about("sampling_rate", np.longdouble(1e4)),
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


def _heap_that_hangs(content: bytes) -> bytes:
    changed = bytearray(content)
    place = content.find(b"GCOL")
    if place >= 0:
        changed[place + 24] ^= 0x80
    return bytes(changed)


#: Attacks on the bytes.
BYTES: dict[str, Callable[[bytes], bytes]] = {
    "cut in half": _cut,
    "the first eight bytes": lambda content: content[:8],
    "the first hundred bytes": lambda content: content[:100],
    "a signature and nothing but ones": lambda content: content[:8] + b"\xff" * 100_000,
    "a signature and nothing but zeros": lambda content: content[:8] + bytes(100_000),
    "behind a block of somebody else": lambda content: bytes(512) + content,
    "the end before the beginning": lambda content: content[:40] + struct.pack("<Q", 1) + content[48:],
    "its own address for the root": lambda content: content[:36] + struct.pack("<Q", 0) + content[44:],
    "a heap that hangs HDF5": _heap_that_hangs,
    "twice the same": lambda content: content + content,
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
