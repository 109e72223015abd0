"""A new manifest from the shards that are there, where the old one is lost."""

from __future__ import annotations

import re
from collections import Counter
from itertools import accumulate
from pathlib import Path
from typing import Any

from cgid.errors import BadData
from cgid.files import write_whole
from cgid.scene.provenance import in_order
from cgid.store import Dataset
from cgid.store.examination import compression_of, damaged_rows, examine_file
from cgid.store.folder_text import read_text
from cgid.store.manifest import LINKED, MANIFEST, SHARD_NAME, Manifest, ShardEntry
from cgid.store.run import file_facts


def relist(file: Path) -> str:
    """Make a manifest from the shards that lie beside it, which must be whole and follow each other, and say so.

    Parameters
    ----------
    file : Path
        The manifest: damaged or not there.

    Raises
    ------
    BadData
        A shard is damaged or of another dataset, or some are missing.
    """
    folder = file.parent
    shards = sorted(path for path in folder.iterdir() if re.fullmatch(SHARD_NAME, path.name))
    _require_all(file, len(shards))
    entries: list[ShardEntry] = []
    attributes: dict[str, Any] = {}
    examined: dict[str, Any] = {}
    for shard in shards:
        if shard.is_symlink():
            raise BadData(f"{shard}: {LINKED}")
        examined = _examined(shard)
        said = dict(examined["attributes"])
        entries.append(_entry(shard, said.pop("first_signal", 0)))
        attributes = attributes or said
        if said != attributes:
            raise BadData(f"{shard}: is not of the dataset that {shards[0].name} is of; take it away, or generate anew")
    n_signals = sum(entry.n_signals for entry in entries)
    starts = list(accumulate((entry.n_signals for entry in entries), initial=0))[:-1]
    if not entries or [entry.first_signal for entry in entries] != starts:
        raise BadData(f"{folder}: its shards must follow each other from signal 0 on; generate the dataset again")
    header = Dataset(shards[0]).header
    made = Manifest(
        n_signals=n_signals,
        attributes=in_order(attributes),
        shards=tuple(entries),
        shard_signals=entries[0].n_signals,
        n_samples=header.n_samples,
        dtype=header.dtype,
        compression=compression_of(examined),
    )
    write_whole(file, made.to_bytes())
    return f"made again from the {len(entries)} shards that are there, of {n_signals} signals"


def _require_all(file: Path, n_there: int) -> None:
    """Raise `BadData` if a damaged manifest still names more shards: a new one would lose sight of them."""
    named = set(re.findall(SHARD_NAME.encode(), read_text(file) or b""))
    if len(named) > n_there:
        raise BadData(
            f"{file}: names {len(named)} shards, {n_there} are there, and without a manifest those that are missing "
            "cannot be made again; generate the dataset again"
        )


def _examined(shard: Path) -> dict[str, Any]:
    """Return what `examine_file` says of a shard that is whole."""
    examined = examine_file(shard)
    if examined["fault"] or any(damaged_rows(chunks) for chunks in examined["chunks"].values()):
        raise BadData(
            f"{shard}: must be whole to make a new {MANIFEST} from, it is not, and without a manifest it cannot be "
            "made again; generate the dataset again"
        )
    return examined


def _entry(shard: Path, first: int) -> ShardEntry:
    labels: Counter[str] = Counter()
    for batch in Dataset(shard).batches():
        labels.update(batch.labels.tolist())
    return ShardEntry(
        first_signal=first, n_signals=labels.total(), labels=dict(sorted(labels.items())), **file_facts(shard)
    )
