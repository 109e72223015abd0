"""The sets of the open benchmark (`sets.toml`) and their making: signals for entrants, the truth apart.

Signals are those of `cgid generate` for the same scene and seed, with the same bits on every x86-64 processor, so the
sums of the public ones can be kept (`SHA256SUMS`). They are stored as plain .npy files, which hold no label.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import secrets
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import shipped
from cgid._lib.files import read_regular, whole_file, write_whole
from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.scene import Scene, load_scene, parse_scene, record, synthesise
from cgid.scene.synthesis.draws import generator
from cgid.store.folder import SUMS, sha256_of, sums_text

HERE = Path(__file__).parent
#: Seeds of the training parts, which are always public, and of the public test parts; set k adds k.
TRAIN_SEED, PUBLIC_SEED = 7_250_000_000, 7_260_000_000
#: Address of the draws of mixtures among those of a scene.
_PURPOSE = 7_250
#: A private seed below this could be found by trying.
MIN_PRIVATE = 2**40
#: Labels of rocks; whatever else strikes is `OTHER` and should be called unknown.
COAL, GANGUE, OTHER = "coal", "gangue", "other"
#: Share of gangue above which a drawn rock costs more than it gains: a gangue costs as much as a lost coal.
LIMIT = 0.5
#: Sums of the public sets, as `sha256sum signals/[!S]* truth/[!S]*` prints them.
KEPT_SUMS = HERE / SUMS
#: Largest file of sums or of truth that is read [bytes].
LARGEST = 1 << 26

#: Files of labels, for learning in `signals` and for judging in `truth`, and their columns: `time` of touch [s],
#: `bounce` 0 for the first impact of a rock, `crossing` of the true share with `LIMIT` [s].
COLUMNS = {
    "labels.csv": ("set", "id", "label"),
    "impacts.csv": ("set", "id", "time", "bounce", "label"),
    "crossings.csv": ("set", "id", "crossing"),
}
_SET_COLUMNS = (
    *("file", "set", "part", "kind", "signals", "samples"),
    *("sampling_rate", "unit", "pre_trigger", "learn", "about"),
)

Rows = list[tuple[Any, ...]]


@dataclass(frozen=True, kw_only=True)
class Set:
    """One set: a scene, the number of its signals (frames or streams) in either part, and where to learn from."""

    name: str
    number: int
    about: str
    learn: str
    signals: Mapping[str, int]
    content: Mapping[str, Any]
    share: Sequence[float] | None = None
    shift: Sequence[float] | None = None

    @property
    def is_stream(self) -> bool:
        """Whether its signals are recordings of many rocks."""
        return "stream" in self.content

    @property
    def scene(self) -> Scene:
        """The scene; of streams, with the mixture of the shipped one."""
        return parse_scene({**self.content, "name": f"open benchmark, {self.name}"})

    def stream(self, seed: int, number: int) -> tuple[Scene, float]:
        """Return the scene of one stream, whose mixture is drawn, and when its share passes `LIMIT` [s]; nan: never."""
        drawn = float(generator(seed, _PURPOSE, number).random())
        mixture, crossing = self.content["stream"]["mixture"], float("nan")
        if self.share is not None:
            mixture = {"times": [0.0], GANGUE: [round(float(np.interp(drawn, (0, 1), self.share)), 3)]}
        elif self.shift is not None:
            later = round(float(np.interp(drawn, (0, 1), self.shift)), 1)
            times = [mixture["times"][0], *(round(time + later, 1) for time in mixture["times"][1:])]
            mixture, crossing = mixture | {"times": times}, float(np.interp(LIMIT, mixture[GANGUE], times))
        content = {**self.content, "stream": self.content["stream"] | {"mixture": mixture}}
        return parse_scene(content | {"name": f"open benchmark, {self.name}"}), crossing


def all_sets() -> dict[str, Set]:
    entries = tomllib.loads((HERE / "sets.toml").read_text(encoding="utf-8"))
    return {name: _set(name, number, entry) for number, (name, entry) in enumerate(entries.items())}


def _set(name: str, number: int, entry: dict[str, Any]) -> Set:
    own: dict[str, Any] = {key: entry.pop(key) for key in ("about", "signals", "share", "shift") if key in entry}
    learn, keep, of_label = entry.pop("learn", name), entry.pop("keep", None), entry.pop("populations", {})
    content = json.loads(load_scene(shipped.scene_path(entry.pop("base"))).text)
    if keep is not None:
        content["populations"] = [one for one in content["populations"] if _kept(one, keep)]
    content = _merged(content, entry)
    content["populations"] = [_merged(one, of_label.get(one["label"], {})) for one in content["populations"]]
    return Set(name=name, number=number, learn=learn, content=content, **own)


def _kept(population: Mapping[str, Any], keep: Mapping[str, Any]) -> bool:
    law = population.get("dissipation", "hunt-crossley")
    return ("curvature" in population) == keep["lumps"] and law in keep["laws"]


def _merged(old: Any, new: Any) -> Any:
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    changed = {key: _merged(old.get(key), value) for key, value in new.items() if value is not False}
    return {key: value for key, value in old.items() if key not in new} | changed


# -- making ----------------------------------------------------------------------------------------------------------


def make(output: Path, *, private: int | None = None, most: int | None = None) -> tuple[Path, Path]:
    """Make all sets: `signals`, for entrants, and `truth`, which they do not get; return both folders.

    `private` is the seed of the test parts, by default the public one; the training parts are always the public ones.
    `most` frames and streams of each part are made for a trial, and their sums are not compared.

    Raises `CannotCreate` if the folder exists and is not empty, `InvalidValue` if the private seed could be guessed,
    `BadData` if a file has another sum than the one kept in the repository.
    """
    if private is not None and not MIN_PRIVATE <= private < 2**63 - 100:
        raise InvalidValue(
            f"--private: must be between 2^40 and 2^63 - 101, as smaller seeds can be guessed, got {private}; leave "
            "the number out to draw one"
        )
    if most is not None and most < 1:
        raise InvalidValue(f"--most: must be 1 or more, got {most}; leave it out for all")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise CannotCreate(f"{output}: must be new or empty; choose another folder or move this one away")
    folders = {"train": output / "signals", "test": output / "truth"}
    try:
        for folder in folders.values():
            folder.mkdir(parents=True)
    except OSError as error:
        raise CannotCreate(f"{output}: cannot be made ({error.strerror}); choose another place") from None
    seeds = {"train": TRAIN_SEED, "test": PUBLIC_SEED if private is None else private}
    known: dict[str, dict[str, Rows]] = {part: {name: [] for name in COLUMNS} for part in folders}
    listed: Rows = []
    for one in all_sets().values():
        for part, n in one.signals.items():
            few = n if most is None else min(n, most)
            signals, rows = (_streams if one.is_stream else _frames)(one, seeds[part] + one.number, few)
            for name, own in rows.items():
                known[part][name] += own
            file = f"{one.name}-{part}.npy"
            with whole_file(output / "signals" / file) as temporary, temporary.open("wb") as stream:
                np.save(stream, signals)
            sampling, unit = one.scene.sampling, one.scene.sensor.unit
            kind, trigger = ("stream", 0) if one.is_stream else ("frame", sampling.pre_trigger)
            about = (kind, *signals.shape, f"{sampling.sampling_rate:g}", unit, trigger, one.learn, one.about)
            listed.append((file, one.name, part, *about))
    write_rows(output / "signals" / "sets.csv", _SET_COLUMNS, listed)
    for part, folder in folders.items():
        for name, columns in COLUMNS.items():
            write_rows(folder / name, columns, known[part][name])
    if private is not None:
        write_whole(output / "truth" / "seed.txt", f"{private}\n".encode())
    for folder in folders.values():
        write_whole(folder / SUMS, sums_text(sums_of(folder)))
    if most is None:
        _compare(output, private is None)
    return folders["train"], folders["test"]


def draw_seed() -> int:
    return MIN_PRIVATE + secrets.randbelow(2**62)


def _frames(one: Set, seed: int, n: int) -> tuple[NDArray[Any], dict[str, Rows]]:
    batches = list(synthesise(one.scene, n, seed))
    labels = np.concatenate([batch.labels for batch in batches]).tolist()
    rows: Rows = [(one.name, k, label if label in (COAL, GANGUE) else OTHER) for k, label in enumerate(labels)]
    return np.concatenate([batch.signals for batch in batches]), {"labels.csv": rows}


def _streams(one: Set, seed: int, n: int) -> tuple[NDArray[Any], dict[str, Rows]]:
    signals: list[NDArray[Any]] = []
    rows: dict[str, Rows] = {"impacts.csv": [], "crossings.csv": []}
    for number in range(n):
        scene, crossing = one.stream(seed, number)
        signal, truth = record(scene, seed, number)
        signals.append(signal.samples)
        columns = (truth[name].tolist() for name in ("time", "bounce", "label"))
        for time, bounce, label in zip(*columns, strict=True):
            rows["impacts.csv"].append((one.name, number, f"{time:.4f}", int(bounce), label))
        rows["crossings.csv"].append((one.name, number, "" if np.isnan(crossing) else f"{crossing:.3f}"))
    return np.stack(signals), rows


def write_rows(path: Path, columns: Sequence[str], rows: Rows) -> None:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([columns, *rows])
    write_whole(path, stream.getvalue().encode())


# -- sums ------------------------------------------------------------------------------------------------------------


def sums_of(folder: Path) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in sorted(folder.iterdir()) if path.name != SUMS}


def _compare(output: Path, public: bool) -> None:
    kept = dict(line.split("  ")[::-1] for line in KEPT_SUMS.read_text(encoding="utf-8").splitlines())
    for folder in ("signals", "truth") if public else ("signals",):
        for file, digest in sums_of(output / folder).items():
            name = f"{folder}/{file}"
            if (public or not file.endswith("-test.npy")) and kept.get(name) != digest:
                raise BadData(
                    f"{output / name}: must have the sum {kept.get(name, 'of no file')} of {KEPT_SUMS.name}, has "
                    f"{digest}; use the versions of cgid and of sets.toml that belong together"
                )


def unchanged_digest(folder: Path) -> str:
    """Return what tells a folder from another; raises `BadData` if it is not as `make` left it."""
    sums = read_regular(folder / SUMS, "sums", LARGEST, "make the sets anew")
    if sums != sums_text(sums_of(folder)):
        raise BadData(f"{folder}: must be as it was made, its files differ from {SUMS}; make the sets anew")
    return hashlib.sha256(sums).hexdigest()[:12]
