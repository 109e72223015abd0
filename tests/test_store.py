"""Datasets: what comes back, what a file must contain, and damage of every kind."""

import errno
import functools
import hashlib
import json
import os
import shutil
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest

from cgid.errors import BadData, CannotCreate, InvalidValue, WriteFailed
from cgid.scene import generate, parse_scene, synthesise
from cgid.scene.synthesis.draws import PARAMETER_UNITS
from cgid.store import Dataset
from cgid.store.dataset import export
from cgid.store.verification import verify

N = 1000


def population(label, density):
    return {
        "label": label,
        "density": {"distribution": "uniform", "lowest": density, "highest": 1.1 * density},
        "youngs_modulus": "3 GPa",
        "poisson_ratio": 0.3,
        "radius": {"distribution": "uniform", "lowest": "20 mm", "highest": "30 mm"},
        "restitution": 0.5,
        "drop_height": "1 m",
    }


@functools.cache
def scene_of(samples=64):
    return parse_scene(
        {
            "name": "small",
            "impact": {"stiffness": "hertz", "dissipation": "hunt-crossley", "target": "rigid"},
            "sampling": {"sampling_rate": "100 kHz", "samples": samples, "pre_trigger": 16},
            "sensor": {"relative_noise": 0.01},
            "populations": [population("coal", 1400), population("gangue", 2400)],
        }
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """One dataset as a file, and as folders of several cuts, by one and by two processes."""
    folder = tmp_path_factory.mktemp("made")
    generate(scene_of(), folder / "one.h5", N, 7)
    for shard_signals in (256, 300, 1000):
        generate(scene_of(), folder / f"cut{shard_signals}", N, 7, shard_signals=shard_signals)
    generate(scene_of(), folder / "jobs", N, 7, shard_signals=300, jobs=2)
    return folder


@pytest.fixture
def folder(made, tmp_path):
    """A copy of a folder of four shards, to be damaged."""
    return Path(shutil.copytree(made / "cut300", tmp_path / "data"))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return generate(scene_of(32), tmp_path_factory.mktemp("tiny") / "tiny.h5", 48, 1)


@pytest.mark.parametrize("locking", [None, True, False, "best-effort"])
def test_a_dataset_that_other_code_has_open_is_read_and_left_open(tiny, locking):
    with h5py.File(tiny, "r", locking=locking) as file:
        assert np.array_equal(Dataset(tiny)[5].samples, file["signals"][5])
        assert len(file["signals"][:]) == 48


@pytest.fixture
def copy(tiny, tmp_path):
    return Path(shutil.copy(tiny, tmp_path / "copy.h5"))


def columns(path):
    dataset = Dataset(path)
    batches = list(dataset.batches())
    found = {name: np.concatenate([getattr(b, name) for b in batches]) for name in ("signals", "labels", "specimen")}
    for name in dataset.header.parameter_units:
        found[name] = np.concatenate([batch.parameters[name] for batch in batches])
    return found


def assert_equal(found, expected):
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)
        assert found[name].dtype.kind == values.dtype.kind


# ---- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["one.h5", "cut256", "cut300", "cut1000", "jobs"])
def test_what_comes_back_is_what_was_synthesised(made, name):
    batches = list(synthesise(scene_of(), N, 7))
    expected = {key: np.concatenate([getattr(b, key) for b in batches]) for key in ("signals", "labels", "specimen")}
    for key in PARAMETER_UNITS:
        expected[key] = np.concatenate([batch.parameters[key] for batch in batches])
    assert_equal(columns(made / name), expected)


def test_bytes_are_the_same_whoever_packs(tmp_path):
    for jobs in (1, 2):
        generate(scene_of(), tmp_path / str(jobs), 600, 7, shard_signals=300, jobs=jobs)
    for shard in ("shard-00000.h5", "shard-00001.h5"):
        assert (tmp_path / "1" / shard).read_bytes() == (tmp_path / "2" / shard).read_bytes()


# ---- the file --------------------------------------------------------------------------------------------------------


def items(path):
    """Return every dataset and attribute of a file by its name."""
    with h5py.File(path) as file:
        datasets, attributes = {}, {"/": dict(file.attrs)}

        def visit(name, item):
            attributes[name] = dict(item.attrs)
            if isinstance(item, h5py.Dataset):
                datasets[name] = (item.dtype, item.chunks, item.fletcher32, item.compression, item.shuffle)

        file.visititems(visit)
        return datasets, attributes


@pytest.mark.parametrize("name", ["one.h5", "cut300/shard-00003.h5", "exported.h5"])
def test_axes_are_named_as_in_netcdf4(made, tmp_path, name):
    """Each axis of each dataset has one scale, with a number, CLASS and NAME: what netCDF-4 readers look for."""
    path = export(made / "one.h5", tmp_path / name) if name == "exported.h5" else made / name
    first, n_signals = (900, 100) if "shard" in name else (0, N)
    with h5py.File(path) as file:
        scales = {name: file[name] for name in ("signal", "time")}
        assert [scale.attrs["_Netcdf4Dimid"] for scale in scales.values()] == [0, 1]
        for scale_name, scale in scales.items():
            assert (scale.attrs["CLASS"], scale.attrs["NAME"]) == (b"DIMENSION_SCALE", scale_name.encode())
            assert scale.fletcher32 and scale.attrs["_Netcdf4Dimid"].dtype == np.int32
        np.testing.assert_array_equal(scales["signal"], np.arange(first, first + n_signals))
        np.testing.assert_array_equal(scales["time"], np.arange(64) / 100e3)
        assert file["time"].attrs["unit"] == b"s"
        others = ["labels", "specimen", *(f"parameters/{name}" for name in file["parameters"])]
        found = {name: [list(axis.values()) for axis in file[name].dims] for name in ("signals", *others)}
        assert found.pop("signals") == [[scales["signal"]], [scales["time"]]]
        assert found == {name: [[scales["signal"]]] for name in others}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_xarray_opens_a_shard(made):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed; the attributes that it reads are tested above")
    expected = Dataset(made / "one.h5").signal(305)
    shard = made / "cut300" / "shard-00001.h5"
    with xarray.open_dataset(shard, engine="h5netcdf") as data:
        assert dict(data.sizes) == {"signal": 300, "time": 64} and set(data.coords) == {"signal", "time"}
        assert {name: array.dims for name, array in data.data_vars.items()} == {
            "signals": ("signal", "time"),
            "labels": ("signal",),
            "specimen": ("signal",),
        }
        np.testing.assert_array_equal(data.signals.sel(signal=305), expected.samples)
        np.testing.assert_array_equal(data.time, np.arange(64) / expected.sampling_rate)
    with xarray.open_dataset(shard, group="parameters", engine="h5netcdf") as data:
        assert {array.dims for array in data.data_vars.values()} == {("signal",)} and "radius" in data


@pytest.mark.parametrize("scale", ["signal", "time"])
def test_a_damaged_scale_is_found(copy, scale):
    with h5py.File(copy) as file:
        chunk = file[scale].id.get_chunk_info(0)
    content = bytearray(copy.read_bytes())
    content[chunk.byte_offset + 9] ^= 1
    copy.write_bytes(content)
    assert len(list(Dataset(copy).batches())) > 0  # nothing in cgid reads it
    (finding,) = verify(copy).findings
    assert finding.problem == "damaged" and f"{scale} 0 to" in finding.what


# ---- the description -------------------------------------------------------------------------------------------------


def rewrite(folder, **changes):
    """Change what a description says, and let the sums begin with its digest, as whoever means to deceive would."""
    file = folder / "description.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    lines = (folder / "SHA256SUMS").read_text().split("\n")
    lines[0] = f"{hashlib.sha256(file.read_bytes()).hexdigest()}  description.json"
    (folder / "SHA256SUMS").write_text("\n".join(lines))


def test_shards_carry_the_digest_of_the_description_and_have_their_sums(made):
    folder = made / "cut300"
    description = json.loads((folder / "description.json").read_text())
    assert (description["n_signals"], description["shard_signals"], description["attributes"]["seed"]) == (N, 300, 7)
    digest = hashlib.sha256((folder / "description.json").read_bytes()).hexdigest()
    lines = [f"{digest}  description.json"]
    for number, shard in enumerate(sorted(folder.glob("shard-*.h5"))):
        with h5py.File(shard) as file:
            assert file.attrs["description_sha256"].decode() == digest
            assert (file.attrs["first_signal"], file.attrs["seed"]) == (300 * number, 7)
        lines.append(f"{hashlib.sha256(shard.read_bytes()).hexdigest()}  {shard.name}")
    assert (folder / "SHA256SUMS").read_text().splitlines() == lines


@pytest.mark.parametrize("junk", [b"", b"\xff\xfe", b"[1, 2", b"[" * 100_000, b"[]", b'"text"', b'{"format": "other"}'])
def test_junk_for_a_description(folder, junk):
    (folder / "description.json").write_bytes(junk)
    with pytest.raises(BadData, match=r"description\.json"):
        Dataset(folder)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_signals", 0),
        ("n_signals", 10**400),
        ("shard_signals", True),
        ("dtype", ["float32"]),
        ("compression", "gzip"),
        ("attributes", {"seed": [1]}),
    ],
)
def test_fields_that_cannot_be(folder, name, value):
    rewrite(folder, **{name: value})
    with pytest.raises(BadData, match=rf"description\.json: {name}"):
        Dataset(folder)


@pytest.mark.parametrize(("name", "value"), [("n_signals", 901), ("n_signals", 999), ("n_samples", 63), ("seed", 8)])
def test_a_description_that_the_shards_do_not_follow_from(folder, name, value):
    attributes = json.loads((folder / "description.json").read_text())["attributes"]
    rewrite(folder, **({"attributes": {**attributes, "seed": 8}} if name == "seed" else {name: value}))
    with pytest.raises(BadData, match=r"shard-00000\.h5"):
        Dataset(folder)


@pytest.mark.parametrize("sums", ["kept", "lost", "of the exchanged"])
@pytest.mark.parametrize("change", ["repeated", "swapped", "longer", "seed", "scene", "frame"])
def test_a_shard_exchanged_for_another_is_not_read(made, folder, tiny, tmp_path, change, sums):
    first, second = folder / "shard-00000.h5", folder / "shard-00001.h5"
    if change == "repeated":
        shutil.copy(first, second)
    elif change == "swapped":
        first.rename(tmp_path / "kept")
        second.rename(first)
        (tmp_path / "kept").rename(second)
    elif change == "longer":
        second.write_bytes(second.read_bytes() + b"\0")
    elif change == "frame":
        shutil.copy(tiny, second)
    else:
        scene = json.loads(scene_of().text)
        scene["populations"][0]["density"] = 1500.0
        other = (scene_of(), 8) if change == "seed" else (parse_scene(scene), 7)
        generate(other[0], tmp_path / "other", 600, other[1], shard_signals=300)
        shutil.copy(tmp_path / "other" / "shard-00001.h5", second)
    file = folder / "SHA256SUMS"
    if sums == "lost":
        file.unlink()
    elif sums != "kept":
        names = [line.split()[1] for line in file.read_text().splitlines()]
        digests = [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names]
        file.write_text("".join(f"{digest}  {name}\n" for digest, name in zip(digests, names, strict=True)))
    if change == "longer" and sums != "kept":  # HDF5 leaves out what follows its end
        assert_equal(columns(folder), columns(made / "cut300"))
        return
    with pytest.raises(BadData, match=r"shard-0000[01]\.h5"):
        columns(folder)


def test_sums_that_do_not_begin_with_the_description_are_void(folder):
    """The shards and sums of one seed under the description of another, and sums that are lost."""
    before = columns(folder)
    lines = (folder / "SHA256SUMS").read_text().splitlines(keepends=True)
    for left in (lines[1:], lines[:2], [*lines[:-1], lines[-1][:-1]], [f"{'0' * 64}  description.json\n", *lines[1:]]):
        (folder / "SHA256SUMS").write_text("".join(left))
        assert_equal(columns(folder), before)


def test_sums_are_compared_when_a_shard_is_read_first(folder):
    """Not even a shard is read that says of itself what the others do: other numbers, with checksums of their own."""
    with h5py.File(folder / "shard-00001.h5", "r+") as file:
        file["signals"][5] += 1
    dataset = Dataset(folder)
    assert len(dataset) == N and len(dataset.impact(299)) == 1
    with pytest.raises(BadData, match=r"shard-00001\.h5"):
        dataset.impact(300)
    with pytest.raises(BadData, match=r"shard-00001\.h5"):
        list(dataset)


# ---- files that somebody else made -----------------------------------------------------------------------------------


def refused(path, says):
    with pytest.raises(BadData, match=says) as caught:
        columns(path)
    assert str(path) in str(caught.value)


def replaced(path, name, make):
    """Put another dataset in place of one, with the attributes of the old."""
    with h5py.File(path, "r+") as file:
        about, shape = dict(file[name].attrs), file[name].shape
        del file[name]
        make(file, shape)
        file[name].attrs.update(about)


@pytest.mark.parametrize(
    ("name", "shape", "kind", "says"),
    [
        ("signals", (48, 32), "i4", "rows of floats"),
        ("signals", (48,), "f4", "rows of floats"),
        ("signals", None, "f4", "rows of floats"),
        ("labels", (47,), "S6", "one value a signal"),
        ("specimen", (48,), "i8", "one value a signal"),
        ("parameters/radius", (48, 2), "f8", "one number a signal"),
    ],
)
def test_wrong_shape_or_type(copy, name, shape, kind, says):
    def make(file, _):
        content = h5py.Empty(kind) if shape is None else np.zeros(shape, kind)
        file.create_dataset(name, data=content)

    replaced(copy, name, make)
    refused(copy, says)


@pytest.mark.parametrize(("name", "shape", "kind"), [("signals", (10**6, 10**6), "f4"), ("labels", (48,), "S99999999")])
def test_a_huge_declared_size_is_refused_before_it_is_read(copy, name, shape, kind):
    chunks = tuple(min(length, 8) for length in shape)
    replaced(copy, name, lambda file, _: file.create_dataset(name, shape, kind, chunks=chunks))
    refused(copy, f"{name} declares [0-9]{{10,}} (bytes and contains 0|chunks in a file of)")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sampling_rate", None),
        ("sampling_rate", 0.0),
        ("sampling_rate", [1e5, 1e5]),
        ("sampling_rate", b"fast"),
        ("pre_trigger", -1),
        ("pre_trigger", 32),
        ("unit", np.bytes_(b"stone")),
    ],
)
def test_unsound_attributes_of_the_signals(copy, name, value):
    with h5py.File(copy, "r+") as file:
        del file["signals"].attrs[name]
        if value is not None:
            file["signals"].attrs[name] = value
    refused(copy, f"valid attribute {name}")


# ---- writing ---------------------------------------------------------------------------------------------------------


class Stop(Exception):
    pass


def test_what_a_stopped_worker_left_half_written_goes(tmp_path):
    def progress(_):
        (tmp_path / "data" / ".shard-00001.h5.0123456789ab.part").touch()
        raise Stop

    with pytest.raises(Stop):
        generate(scene_of(32), tmp_path / "data", 1000, shard_signals=300, progress=progress)
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_folder_can_be_made_again(tmp_path, folder):
    (folder / "description.json").unlink()
    (folder / "shard-00000.h5").unlink()
    (folder / ".shard-00001.h5.0123456789ab.part").write_bytes(b"killed")
    generate(scene_of(32), folder, 100, overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == [
        ".lock",
        "SHA256SUMS",
        "description.json",
        "shard-00000.h5",
    ]
    assert len(Dataset(folder)) == 100


@pytest.mark.parametrize("name", ["one.h5", "cut300"])
def test_an_existing_dataset_is_kept_unless_told_otherwise(made, name):
    before = columns(made / name)
    with pytest.raises(CannotCreate, match="exists already"):
        generate(scene_of(32), made / name, 10)
    assert_equal(columns(made / name), before)


@pytest.mark.parametrize("name", ["thesis.txt", "description.json", "manifest.json", "shard-1.h5"])
def test_a_folder_with_foreign_files_is_never_overwritten(tmp_path, name):
    (tmp_path / name).write_text("{}")
    with pytest.raises(CannotCreate, match=name):
        generate(scene_of(32), tmp_path, 10, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "{}"


def no_space(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_disk_full_in_the_middle_of_a_folder(tmp_path, monkeypatch):
    sync, files = os.fsync, []

    def third_fails(descriptor):
        if os.fstat(descriptor).st_size > 30_000:  # neither a folder nor a text
            files.append(descriptor)
        return no_space() if len(files) == 3 else sync(descriptor)

    monkeypatch.setattr(os, "fsync", third_fails)
    with pytest.raises(WriteFailed, match=r"shard-00002\.h5"):
        generate(scene_of(32), tmp_path / "data", 1000, shard_signals=256)
    left = [".lock", "SHA256SUMS", "description.json", "shard-00000.h5", "shard-00001.h5"]
    assert sorted(path.name for path in (tmp_path / "data").iterdir()) == left
    monkeypatch.undo()
    generate(scene_of(32), tmp_path / "data", 1000, shard_signals=256, resume=True)
    assert len(Dataset(tmp_path / "data")) == 1000


def test_a_file_above_2_gib_is_refused_with_the_cure(tmp_path):
    n_signals = (2 << 30) // (64 * 4) + 1
    with pytest.raises(InvalidValue, match=r"at most 2 GiB.*does not end in \.h5, for a folder"):
        generate(scene_of(), tmp_path / "large.h5", n_signals)
    with pytest.raises(InvalidValue, match="ask for smaller"):
        generate(scene_of(), tmp_path / "large", n_signals, shard_signals=n_signals)
    with pytest.raises(InvalidValue, match="shard_signals must be at least 4 for 1000000 signals, got 3"):
        generate(scene_of(), tmp_path / "many", 10**6, shard_signals=3)
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_the_number_of_signals(tmp_path, monkeypatch):
    # How many blocks there are at once is a matter of chance up to the most, which tests/test_overlap.py holds.
    monkeypatch.setattr("cgid.scene.output.generation._AHEAD_BLOCKS", 1)

    def peak(n_signals):
        tracemalloc.reset_peak()
        generate(scene_of(256), tmp_path / str(n_signals), n_signals, shard_signals=256)
        return tracemalloc.get_traced_memory()[1]

    generate(scene_of(256), tmp_path / "first", 256)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        few, many = (peak(n_signals) - before for n_signals in (1024, 4096))
    finally:
        tracemalloc.stop()
    assert few > 256 * 256 * 4
    assert many < 1.2 * few


@pytest.mark.parametrize(
    "index",
    [
        *(slice(0, 5), slice(3, 9), slice(None, None, -70), slice(5, 5)),
        *((slice(290, 310), slice(0, 100)), (3, slice(0, 9))),
        *([1, 2], np.array([250, -1, 7]), ([4, 280], slice(0, 9)), np.arange(1000) % 100 == 3, np.empty(0, int)),
    ],
)
def test_parts_of_a_dataset_are_arrays_as_dask_and_loaders_want_them(made, index):
    dataset = Dataset(made / "cut300")
    whole = np.stack([signal.samples for signal in dataset])
    assert (dataset.shape, dataset.dtype, dataset.ndim) == (whole.shape, whole.dtype, 2)
    np.testing.assert_array_equal(dataset[index], whole[index])
    dask = pytest.importorskip("dask.array")
    array = dask.from_array(dataset, chunks=(100, -1))
    np.testing.assert_array_equal(array[10:400:3, ::5].compute(), whole[10:400:3, ::5])


def test_a_loop_of_shuffled_batches_sees_each_signal_once(made):
    """As loaders of torch ask: `len`, then one index or a list of them."""
    dataset = Dataset(made / "cut300")
    order = np.random.default_rng(0).permutation(len(dataset)).tolist()
    one_by_one = np.stack([dataset[number].samples for number in order])
    by_lists = np.concatenate([dataset[order[first : first + 64]] for first in range(0, len(order), 64)])
    np.testing.assert_array_equal(one_by_one, by_lists)
    np.testing.assert_array_equal(one_by_one[np.argsort(order)], dataset[:])
    with pytest.raises(InvalidValue, match="index"):
        dataset[[0, len(dataset)]]
