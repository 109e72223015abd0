"""One recording in every format, written by the format's own library if it has one; for tests and benchmarks."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

#: Names of the two channels.
NAMES = ("front", "rear")
UNIT = "g"


@dataclass(frozen=True)
class Specimen:
    """A format, and the way to write a recording of two channels in it.

    write : `write(path, samples (2, n_samples), sampling_rate)`
    writer : library that writes it
    options : arguments of `cgid.recordings.open_recording` for facts that the file cannot state
    resolution : largest difference of the numbers read back
    says_rate, says_unit : whether the file states its sampling rate, and the unit of its channels
    """

    name: str
    suffix: str
    write: Callable[[Path, np.ndarray, float], None]
    writer: str
    options: dict[str, Any] = field(default_factory=dict)
    resolution: float = 0.0
    says_rate: bool = True
    says_unit: bool = True

    @property
    def is_possible(self) -> bool:
        return find_spec(self.writer) is not None


def blows(n_samples: int = 20_000, sampling_rate: float = 51_200.0, seed: int = 1) -> np.ndarray:
    """Return two channels of noise with decaying blows within +-1, exact in float32, (2, n_samples)."""
    random = np.random.default_rng(seed)
    out = 1e-3 * random.standard_normal((2, n_samples))
    time = np.arange(round(0.1 * sampling_rate)) / sampling_rate
    for onset in range(n_samples // 20, n_samples, max(n_samples // 5, 1)):
        decay = 0.6 * np.exp(-time / 0.01) * np.sin(2 * np.pi * 1500 * time)
        part = decay[: n_samples - onset]
        out[:, onset : onset + part.size] += np.array([[1.0], [0.5]]) * part
    return np.clip(out, -0.99, 0.99).astype(np.float32).astype(np.float64)


def _csv(path: Path, samples: np.ndarray, rate: float) -> None:
    import pandas

    time = np.arange(samples.shape[1]) / rate
    columns = {"time (s)": time, **{f"{name} ({UNIT})": row for name, row in zip(NAMES, samples, strict=True)}}
    pandas.DataFrame(columns).to_csv(path, index=False)


def _german(path: Path, samples: np.ndarray, rate: float) -> None:
    import pandas

    time = np.arange(samples.shape[1]) / rate
    columns = {"Zeit (s)": time, **{f"{name} ({UNIT})": row for name, row in zip(NAMES, samples, strict=True)}}
    pandas.DataFrame(columns).to_csv(path, index=False, sep=";", decimal=",")


def _lvm(path: Path, samples: np.ndarray, rate: float) -> None:
    """Write as LabVIEW's "Write To Measurement File" does, after National Instruments' description of the format."""
    n_samples = samples.shape[1]
    lines = [
        "LabVIEW Measurement\t",
        "Writer_Version\t2",
        "Reader_Version\t2",
        "Separator\tTab",
        "Decimal_Separator\t.",
        "Multi_Headings\tNo",
        "X_Columns\tNo",
        "Time_Pref\tAbsolute",
        "Operator\tnobody",
        "Date\t2026/03/04",
        "Time\t10:11:12.5",
        "***End_of_Header***\t",
        "",
        "Channels\t2\t\t",
        f"Samples\t{n_samples}\t{n_samples}\t",
        "Date\t2026/03/04\t2026/03/04\t",
        "Time\t10:11:12.5\t10:11:12.5\t",
        f"Y_Unit_Label\t{UNIT}\t{UNIT}\t",
        "X_Dimension\tTime\tTime\t",
        "X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t",
        f"Delta_X\t{1 / rate:.9E}\t{1 / rate:.9E}\t",
        "***End_of_Header***\t\t\t",
        f"X_Value\t{NAMES[0]}\t{NAMES[1]}\tComment",
        *(f"\t{first!r}\t{second!r}" for first, second in samples.T.tolist()),
    ]
    path.write_bytes("\r\n".join([*lines, ""]).encode())


def _wav(dtype: str) -> Callable[[Path, np.ndarray, float], None]:
    def write(path: Path, samples: np.ndarray, rate: float) -> None:
        from scipy.io import wavfile

        kind = np.dtype(dtype)
        if kind.kind == "f":
            stored = samples.astype(kind)
        elif kind.kind == "u":
            stored = np.rint(samples * 128 + 128).astype(kind)
        else:
            stored = np.rint(samples * 2.0 ** (8 * kind.itemsize - 1)).astype(kind)
        wavfile.write(path, round(rate), stored.T)

    return write


def _sound(subtype: str, container: str) -> Callable[[Path, np.ndarray, float], None]:
    def write(path: Path, samples: np.ndarray, rate: float) -> None:
        import soundfile

        soundfile.write(path, samples.T, round(rate), subtype=subtype, format=container)

    return write


def _npy(path: Path, samples: np.ndarray, rate: float) -> None:
    np.save(path, samples)


def _npz(path: Path, samples: np.ndarray, rate: float) -> None:
    np.savez_compressed(path, samples=samples, sampling_rate=rate, unit=UNIT)


def _own(path: Path, samples: np.ndarray, rate: float) -> None:
    from cgid.store.hdf5 import RecordingPlan, writing

    plan = RecordingPlan(n_samples=samples.shape[1], dtype="float64", sampling_rate=rate, unit=UNIT, attributes={})
    with writing(path, plan) as writer:
        writer.add(samples[0])
        writer.add_impacts({"time": np.array([0.0])}, {"time": "s"})


def _hdf5(path: Path, samples: np.ndarray, rate: float) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        stored = file.create_dataset("measured/acceleration", data=samples, chunks=(1, 1024), fletcher32=True)
        stored.attrs["sampling_rate"] = rate
        stored.attrs["unit"] = np.bytes_(UNIT.encode())


def _mat(path: Path, samples: np.ndarray, rate: float) -> None:
    from scipy.io import savemat

    savemat(path, {"acceleration": samples.T, "fs": rate}, do_compression=True)


def _mat73(path: Path, samples: np.ndarray, rate: float) -> None:
    import hdf5storage

    # hdf5storage adds to an existing file.
    path.unlink(missing_ok=True)
    hdf5storage.savemat(str(path), {"acceleration": samples.T, "fs": rate}, format="7.3")


def _tdms(path: Path, samples: np.ndarray, rate: float) -> None:
    from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter

    about = {"wf_increment": 1 / rate, "wf_start_offset": 0.0, "unit_string": UNIT, "wf_samples": 1}
    with TdmsWriter(str(path)) as writer:
        for part in np.array_split(samples, 4, axis=1):
            channels = [ChannelObject("beam", name, row, about) for name, row in zip(NAMES, part, strict=True)]
            writer.write_segment([RootObject({"name": "rig"}), GroupObject("beam"), *channels])


def write_uff(
    path: Path,
    samples: np.ndarray,
    rate: float,
    *,
    binary: int = 1,
    names: Sequence[str],
    units: Sequence[str],
    about: dict[str, Any] | None = None,
    **lines: Sequence[str],
) -> None:
    """Write a universal file with one set 58 a channel; `lines` are the texts of id2 to id5 of each, `about` of all."""
    import pyuff

    shared = {
        "func_type": 1,
        "rsp_dir": 3,
        "ref_node": 0,
        "ref_dir": 0,
        "ord_data_type": 4,
        "abscissa_spacing": 1,
        "abscissa_inc": 1 / rate,
        "abscissa_spec_data_type": 17,
        "ordinate_spec_data_type": 12,
        "orddenom_spec_data_type": 0,
        "abscissa_axis_units_lab": "s",
        **(about or {}),
    }
    sets = [
        pyuff.prepare_58(
            binary=binary,
            rsp_node=index + 1,
            data=row,
            x=np.arange(row.size) / rate,
            id1=name,
            ordinate_axis_units_lab=unit,
            **{name: texts[index] for name, texts in lines.items()},
            **shared,
        )
        for index, (name, row, unit) in enumerate(zip(names, samples, units, strict=False))
    ]
    with warnings.catch_warnings():
        # pyuff opens a binary file twice and leaves one handle to the garbage collector.
        warnings.simplefilter("ignore", ResourceWarning)
        # When it overwrites, it loses the first of several binary sets.
        path.unlink(missing_ok=True)
        pyuff.UFF(str(path)).write_sets(sets, mode="add", force_double=shared["ord_data_type"] in (4, 6))
        gc.collect()


def _uff(binary: int) -> Callable[[Path, np.ndarray, float], None]:
    def write(path: Path, samples: np.ndarray, rate: float) -> None:
        write_uff(path, samples, rate, binary=binary, names=NAMES, units=[UNIT] * len(samples))

    return write


def _parquet(path: Path, samples: np.ndarray, rate: float) -> None:
    import pyarrow
    from pyarrow import parquet

    time = np.arange(samples.shape[1]) / rate
    columns = {"time (s)": time, **{f"{name} ({UNIT})": row for name, row in zip(NAMES, samples, strict=True)}}
    parquet.write_table(pyarrow.table(columns), path, row_group_size=8192, write_page_checksum=True)


# ---- named channels of any length, unit, rate and start, as far as a format can say them ----


@dataclass(frozen=True)
class Channel:
    """One channel to write; `late` is its start behind the others [s]."""

    samples: np.ndarray
    unit: str = UNIT
    rate: float = 1000.0
    late: float = 0.0

    @property
    def start(self) -> datetime:
        return datetime(2026, 3, 4, 10, 11, 12) + timedelta(seconds=self.late)


Channels = Mapping[str, Channel]
Times = np.ndarray | None


def _frame(channels: Channels, times: Times) -> dict[str, np.ndarray]:
    longest = max(one.samples.size for one in channels.values())
    time = np.arange(longest) / next(iter(channels.values())).rate if times is None else times
    columns = {
        f"{name} ({one.unit})" if one.unit else name: np.pad(
            one.samples.astype(float), (0, longest - one.samples.size), constant_values=np.nan
        )
        for name, one in channels.items()
    }
    return {"time (s)": time, **columns}


def _csv_of(path: Path, channels: Channels, times: Times) -> None:
    import pandas

    pandas.DataFrame(_frame(channels, times)).to_csv(path, index=False)


def _parquet_of(path: Path, channels: Channels, times: Times) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.table(_frame(channels, times)), path)


def _records_of(path: Path, channels: Channels, times: Times) -> None:
    frame = _frame(channels, times)
    np.save(path, np.rec.fromarrays(list(frame.values()), names=list(frame)))


def _named(channels: Channels, times: Times) -> dict[str, Any]:
    about = {"fs": next(iter(channels.values())).rate} if times is None else {"time": times}
    return {**{name: one.samples for name, one in channels.items()}, **about}


def _npz_of(path: Path, channels: Channels, times: Times) -> None:
    np.savez(path, unit=next(iter(channels.values())).unit, **_named(channels, times))


def _mat_of(path: Path, channels: Channels, times: Times) -> None:
    from scipy.io import savemat

    savemat(path, {**_named(channels, times), "unit": next(iter(channels.values())).unit})


def _hdf5_of(path: Path, channels: Channels, times: Times) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, one in channels.items():
            about = {"unit": one.unit, "start_time": one.start.isoformat()}
            file.create_dataset(name, data=one.samples).attrs.update(about)
            if times is None:
                file[name].attrs["fs"] = one.rate
        if times is not None:
            file["time"] = times


def _tdms_of(path: Path, channels: Channels, times: Times) -> None:
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(str(path)) as writer:
        stored = []
        for name, one in channels.items():
            about = {"unit_string": one.unit, "wf_start_time": np.datetime64(one.start)}
            rate = {"wf_increment": 1 / one.rate} if times is None else {}
            stored.append(ChannelObject("beam", name, one.samples, {**about, **rate}))
        if times is not None:
            stored.append(ChannelObject("beam", "time", times))
        writer.write_segment(stored)


def _lvm_of(path: Path, channels: Channels, times: Times) -> None:
    def line(tag: str, values: Iterable[Any]) -> str:
        return "\t".join([tag, *map(str, values), ""])

    each, n = channels.values(), len(channels)
    longest = max(one.samples.size for one in each)
    x = [""] * longest if times is None else [f"{time:.9f}" for time in times]
    rows = [
        "\t".join([x[k], *(repr(float(one.samples[k])) if k < one.samples.size else "" for one in each)])
        for k in range(longest)
    ]
    lines = [
        "LabVIEW Measurement\t",
        "Separator\tTab",
        f"X_Columns\t{'No' if times is None else 'One'}",
        "***End_of_Header***\t",
        line("Channels", [n]),
        line("Samples", [one.samples.size for one in each]),
        line("Date", [one.start.strftime("%Y/%m/%d") for one in each]),
        line("Time", [one.start.strftime("%H:%M:%S.%f") for one in each]),
        line("Y_Unit_Label", [one.unit for one in each]),
        line("Delta_X", [f"{1 / one.rate:.9E}" if times is None else "0" for one in each]),
        line("***End_of_Header***", []),
        line("X_Value", [*channels, "Comment"]),
        *rows,
    ]
    path.write_text("\n".join([*lines, ""]))


def _uff_of(path: Path, channels: Channels, times: Times) -> None:
    import pyuff

    path.unlink(missing_ok=True)
    for node, (name, one) in enumerate(channels.items(), 1):
        x = np.arange(one.samples.size) / one.rate if times is None else times
        about: dict[str, Any] = {
            "binary": 0,
            "func_type": 1,
            "rsp_node": node,
            "rsp_dir": 3,
            "ref_node": 0,
            "ref_dir": 0,
            "ord_data_type": 4,
            "abscissa_spacing": int(times is None),
            "abscissa_inc": 1 / one.rate,
            "abscissa_spec_data_type": 17,
            "ordinate_spec_data_type": 12,
            "orddenom_spec_data_type": 0,
        }
        labels = {"id1": name, "id3": one.start.strftime("%d-%b-%y %H:%M:%S"), "ordinate_axis_units_lab": one.unit}
        pyuff.UFF(str(path)).write_sets(pyuff.prepare_58(x=x, data=one.samples, **labels, **about), mode="add")


#: Format -> suffix, writer, library; which of the facts of a single channel it can say: unit, rate, start, length.
WRITERS: dict[str, tuple[str, Callable[[Path, Channels, Times], None], str, frozenset[str]]] = {
    "CSV": (".csv", _csv_of, "pandas", frozenset(("unit", "length"))),
    "LVM": (".lvm", _lvm_of, "numpy", frozenset(("unit", "rate", "start", "length"))),
    "NPY": (".npy", _records_of, "numpy", frozenset(("unit",))),
    "NPZ": (".npz", _npz_of, "numpy", frozenset(("length",))),
    "MAT": (".mat", _mat_of, "scipy", frozenset(("length",))),
    "HDF5": (".h5", _hdf5_of, "h5py", frozenset(("unit", "rate", "start", "length"))),
    "TDMS": (".tdms", _tdms_of, "nptdms", frozenset(("unit", "rate", "start", "length"))),
    "UFF": (".uff", _uff_of, "pyuff", frozenset(("unit", "rate", "start", "length"))),
    "Parquet": (".parquet", _parquet_of, "pyarrow", frozenset(("unit",))),
}


_WITHOUT_UNIT: dict[str, Any] = {"options": {"unit": UNIT}, "says_unit": False}
_OF_FULL_SCALE: dict[str, Any] = {"options": {"unit": UNIT, "full_scale": 1}, "says_unit": False}

SPECIMENS: tuple[Specimen, ...] = (
    Specimen("CSV", ".csv", _csv, "pandas"),
    Specimen("TXT, decimal comma", ".txt", _german, "pandas"),
    Specimen("LVM", ".lvm", _lvm, "numpy"),
    Specimen("WAV 8 bit", ".wav", _wav("uint8"), "scipy", resolution=2**-8, **_OF_FULL_SCALE),
    Specimen("WAV 16 bit", ".wav", _wav("int16"), "scipy", resolution=2**-16, **_OF_FULL_SCALE),
    Specimen("WAV 24 bit", ".wav", _sound("PCM_24", "WAV"), "soundfile", resolution=2**-23, **_OF_FULL_SCALE),
    Specimen("WAV 32 bit", ".wav", _wav("int32"), "scipy", resolution=2**-32, **_OF_FULL_SCALE),
    Specimen("WAV float", ".wav", _wav("float32"), "scipy", **_WITHOUT_UNIT),
    Specimen("WAV double", ".wav", _wav("float64"), "scipy", **_WITHOUT_UNIT),
    Specimen(
        "NPY",
        ".npy",
        _npy,
        "numpy",
        options={"unit": UNIT, "sampling_rate": 51_200.0},
        says_rate=False,
        says_unit=False,
    ),
    Specimen("NPZ", ".npz", _npz, "numpy"),
    Specimen("HDF5 of cgid", ".h5", _own, "h5py"),
    Specimen("HDF5", ".h5", _hdf5, "h5py"),
    Specimen("MAT v5", ".mat", _mat, "scipy", **_WITHOUT_UNIT),
    Specimen("MAT v7.3", ".mat", _mat73, "hdf5storage", **_WITHOUT_UNIT),
    Specimen("TDMS", ".tdms", _tdms, "nptdms"),
    Specimen("UFF-58 ASCII", ".uff", _uff(0), "pyuff", resolution=1e-11),
    Specimen("UFF-58 binary", ".uff", _uff(1), "pyuff"),
    Specimen("FLAC", ".flac", _sound("PCM_24", "FLAC"), "soundfile", resolution=2**-23, **_OF_FULL_SCALE),
    Specimen("OGG", ".ogg", _sound("VORBIS", "OGG"), "soundfile", resolution=0.2, **_OF_FULL_SCALE),
    Specimen("W64", ".w64", _sound("PCM_24", "W64"), "soundfile", resolution=2**-23, **_OF_FULL_SCALE),
    Specimen("AIFF", ".aiff", _sound("PCM_16", "AIFF"), "soundfile", resolution=2**-15, **_OF_FULL_SCALE),
    Specimen("CAF", ".caf", _sound("FLOAT", "CAF"), "soundfile", **_WITHOUT_UNIT),
    Specimen("AU", ".au", _sound("DOUBLE", "AU"), "soundfile", **_WITHOUT_UNIT),
    Specimen("Parquet", ".parquet", _parquet, "pyarrow"),
)
