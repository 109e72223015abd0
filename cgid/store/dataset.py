"""Reading a dataset, whole or by batches; nothing is believed before it is checked."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cgid.errors import BadData, CgidError, InvalidValue, NoInput
from cgid.signals import Batch, Signal, quantity_of
from cgid.store.header import ShardHeader, read_header, text_of
from cgid.store.manifest import MANIFEST, read_manifest

#: Signals read at once.
_ROWS = 1024
#: What h5py raises on damaged headers.
DAMAGE = (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError)


class Dataset:
    """A dataset on disk: a file or a folder of shards.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    NoInput
        There is nothing.
    BadData
        It is no dataset, unfinished (no manifest), damaged, or its shards do not fit together.
    """

    #: What all shards have in common; the counts are those of the first.
    header: ShardHeader

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise NoInput(f"{path}: no such file or folder; give a dataset made by cgid generate")
        self._entries = read_manifest(self.path).shards if self.path.is_dir() else None
        names = [entry.file for entry in self._entries] if self._entries is not None else [self.path.name]
        folder = self.path if self.path.is_dir() else self.path.parent
        self._shards = [folder / name for name in names]
        self._counts: list[int] = []
        for shard in self._shards:
            with opened(shard) as file:
                header = read_header(file, str(shard))
            if not self._counts:
                self.header = header
            self._require_fit(shard, header)
            self._counts.append(header.n_signals)
        if self._entries is not None and self._counts != [entry.n_signals for entry in self._entries]:
            raise BadData(f"{path}: shards must hold as many signals as {MANIFEST} says; generate the dataset again")

    def _require_fit(self, shard: Path, header: ShardHeader) -> None:
        for name in ("n_samples", "sampling_rate", "pre_trigger", "unit", "parameter_units", "label_width"):
            here, there = getattr(header, name), getattr(self.header, name)
            if here != there:
                raise BadData(f"{shard}: {name} must be that of the other shards, {there}, got {here}")

    def __len__(self) -> int:
        return sum(self._counts)

    @property
    def sampling_rate(self) -> float:
        """[Hz]."""
        return self.header.sampling_rate

    @property
    def unit(self) -> str:
        """Unit of the signals."""
        return self.header.unit

    @property
    def quantity(self) -> str:
        """Quantity of the signals."""
        return quantity_of(self.header.unit)

    @property
    def pre_trigger(self) -> int:
        """Samples before touch."""
        return self.header.pre_trigger

    @property
    def source(self) -> str:
        """SHA-256 of the scene that the signals were made from; empty when they were not."""
        return str(self.header.attributes.get("scene_sha256", ""))

    def __iter__(self) -> Iterator[Batch]:
        return self.batches()

    def batches(self, n_rows: int = _ROWS) -> Iterator[Batch]:
        """Yield the signals in order, at most `n_rows` at once.

        Raises
        ------
        BadData
            A checksum does not fit: the file is damaged.
        """
        for shard, count in zip(self._shards, self._counts, strict=True):
            with opened(shard) as file:
                for first in range(0, count, n_rows):
                    yield self._batch(file, shard, slice(first, min(first + n_rows, count)))

    def _batch(self, file: h5py.File, shard: Path, rows: slice) -> Batch:
        try:
            signals: NDArray[Any] = file["signals"][rows]
            labels, specimen = file["labels"][rows], file["specimen"][rows]
            parameters = {name: file[f"parameters/{name}"][rows] for name in self.header.parameter_units}
        except OSError:
            raise BadData(
                f"{shard}: signals {rows.start} to {rows.stop - 1} must fit their checksum, they do not: the file is "
                "damaged; generate it again"
            ) from None
        return Batch(
            signals=signals,
            labels=text_of(labels),
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            pre_trigger=self.pre_trigger,
            specimen=specimen.astype(np.uint64),
            parameters=parameters,
            source=self.source,
        )

    def impact(self, index: int) -> Batch:
        """Return one signal with all that is stored of it.

        Raises
        ------
        InvalidValue
            The index is not within 0 and the number of signals.
        """
        if not 0 <= index < len(self):
            raise InvalidValue(f"{self.path}: index must lie between 0 and {len(self) - 1}, got {index}")
        first = 0
        for shard, count in zip(self._shards, self._counts, strict=True):
            if index < first + count:
                with opened(shard) as file:
                    return self._batch(file, shard, slice(index - first, index - first + 1))
            first += count
        raise AssertionError("unreachable: the index was checked")

    def signal(self, index: int) -> Signal:
        """Return one signal; raises as `impact`."""
        return Signal(
            samples=self.impact(index).signals[0],
            sampling_rate=self.sampling_rate,
            unit=self.unit,
            source=f"{self.path} index {index}",
            pre_trigger=self.pre_trigger,
        )

    def damaged_shards(self) -> list[str]:
        """Return the shards whose SHA-256 is not that of the manifest (none for a single file: it has no manifest)."""
        if self._entries is None:
            return []
        pairs = zip(self._shards, self._entries, strict=True)
        return [str(shard) for shard, entry in pairs if _sha256(shard) != entry.sha256]


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Yield an HDF5 file open for reading; what h5py raises on a damaged one becomes `BadData`."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if not path.exists():
            raise BadData(f"{path}: this shard of the dataset is missing; generate the dataset again") from None
        reason = "it is empty, truncated or no HDF5 file" if not isinstance(error, PermissionError) else "no permission"
        raise BadData(f"{path}: must be a readable HDF5 file, {reason}; copy it again, or generate it anew") from None
    try:
        yield file
    except CgidError:
        raise
    except DAMAGE as error:
        raise BadData(f"{path}: is damaged ({error}); copy it again, or generate it anew") from None
    finally:
        file.close()


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
