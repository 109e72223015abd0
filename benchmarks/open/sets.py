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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid import shipped
from cgid.errors import BadData, CannotCreate, InvalidValue
from cgid.files import read_regular, whole_file, write_whole
from cgid.scene import Scene, load_scene, parse_scene, synthesise
from cgid.scene.stream import record

HERE = Path(__file__).parent
#: Seeds of the training parts, which are always public, and of the public test parts; set k adds k.
TRAIN_SEED, PUBLIC_SEED = 7_250_000_000, 7_260_000_000
#: A private seed below this could be found by trying.
LEAST_PRIVATE = 2**40
#: Labels of rocks; whatever else strikes is `OTHER` and should be called unknown.
COAL, GANGUE, OTHER = "coal", "gangue", "other"
#: Share of gangue above which a drawn rock costs more than it gains: a gangue costs as much as a lost coal.
LIMIT = 0.5
SUMS = "SHA256SUMS"
#: Largest file of sums or of truth that is read [bytes].
LARGEST = 1 << 26

Truth = dict[str, list[tuple[Any, ...]]]
#: Files of truth and their columns; `time` of touch [s] of a rock's first blow, `crossing` [s] of the true share.
TRUTH_COLUMNS = {
    "labels.csv": ("set", "id", "label"),
    "rocks.csv": ("set", "id", "time", "label"),
    "crossings.csv": ("set", "id", "crossing"),
}


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
        """Return the scene of one stream, whose mixture is drawn, and the time at which its share passes `LIMIT` [s].

        Without a passage the time is nan.
        """
        content = json.loads(json.dumps(self.content))
        drawn = float(np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 1, number])).random())
        mixture = content["stream"]["mixture"]
        crossing = float("nan")
        if self.share is not None:
            mixture = {"times": [0.0], GANGUE: [round(self.share[0] + (self.share[1] - self.share[0]) * drawn, 3)]}
        elif self.shift is not None:
            later = round(self.shift[0] + (self.shift[1] - self.shift[0]) * drawn, 1)
            times = [mixture["times"][0], *(round(time + later, 1) for time in mixture["times"][1:])]
            mixture = {"times": times, GANGUE: mixture[GANGUE]}
            crossing = float(np.interp(LIMIT, mixture[GANGUE], times))
        content["stream"]["mixture"] = mixture
        return parse_scene({**content, "name": f"open benchmark, {self.name}"}), crossing


def all_sets() -> dict[str, Set]:
    """Return the sets of `sets.toml` by name."""
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
    """Return a section with changes; `false` takes a key out."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    changed = {key: _merged(old.get(key), value) for key, value in new.items() if value is not False}
    return {key: value for key, value in old.items() if key not in new} | changed


# -- making ----------------------------------------------------------------------------------------------------------


def make(output: Path, *, private: int | None = None, most: int | None = None) -> tuple[Path, Path]:
    """Make all sets: `signals`, for entrants, and `truth`, which they do not get; return both folders.

    Parameters
    ----------
    output : Path
        New folder.
    private : int, optional
        Seed of the test parts; by default the public one. The training parts are always the public ones.
    most : int, optional
        At most this many frames and streams of each part, for a trial; their sums are not compared.

    Returns
    -------
    tuple of two Paths

    Raises
    ------
    CannotCreate
        The folder exists and is not empty.
    InvalidValue
        The private seed could be guessed.
    BadData
        A file has another sum than the one kept in the repository.
    """
    if private is not None and not LEAST_PRIVATE <= private < 2**63 - 100:
        raise InvalidValue(
            f"--private: must lie between 2^40 and 2^63 - 101, as smaller seeds can be guessed, got {private}; leave "
            "the number out to draw one"
        )
    if most is not None and most < 1:
        raise InvalidValue(f"--most: must be 1 or more, got {most}; leave it out for all")
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise CannotCreate(f"{output}: must be new or empty; choose another folder or move this one away")
    folders = signals, truth = output / "signals", output / "truth"
    try:
        for folder in folders:
            folder.mkdir(parents=True)
    except OSError as error:
        raise CannotCreate(f"{output}: cannot be made ({error.strerror}); choose another place") from None
    listed: list[tuple[Any, ...]] = []
    known: Truth = {name: [] for name in TRUTH_COLUMNS}
    hits: list[tuple[Any, ...]] = []
    learned: list[tuple[Any, ...]] = []
    for one in all_sets().values():
        for part, n in one.signals.items():
            seed = one.number + (TRAIN_SEED if part == "train" else PUBLIC_SEED if private is None else private)
            few = n if most is None else min(n, most)
            samples, own = (_streams if one.is_stream else _frames)(one, seed, few, known if part == "test" else None)
            (hits if one.is_stream else learned).extend(own)
            name = f"{one.name}-{part}.npy"
            with whole_file(signals / name) as temporary, temporary.open("wb") as file:
                np.save(file, samples)
            listed.append((name, one.name, part, *_about(one, *samples.shape)))
    write_rows(signals / "sets.csv", _SET_COLUMNS, listed)
    write_rows(signals / "train_labels.csv", TRUTH_COLUMNS["labels.csv"], learned)
    write_rows(signals / "train_impacts.csv", ("set", "id", "time", "bounce", "label"), hits)
    for name, columns in TRUTH_COLUMNS.items():
        write_rows(truth / name, columns, known[name])
    if private is not None:
        write_whole(truth / "seed.txt", f"{private}\n".encode())
    for folder in folders:
        write_whole(folder / SUMS, sums_text(folder))
    if most is None:
        _compare(output, private is None)
    return folders


def draw_seed() -> int:
    """Return a seed that nobody can guess."""
    return LEAST_PRIVATE + secrets.randbelow(2**62)


_SET_COLUMNS = (
    *("file", "set", "part", "kind", "signals", "samples", "sampling_rate [Hz]", "unit", "pre_trigger"),
    *("learn", "about"),
)


def _about(one: Set, n: int, samples: int) -> tuple[Any, ...]:
    scene, kind = one.scene, "stream" if one.is_stream else "frame"
    trigger = 0 if one.is_stream else scene.sampling.pre_trigger
    rate = f"{scene.sampling.sampling_rate:g}"
    return kind, n, samples, rate, scene.sensor.unit, trigger, one.learn, one.about


def _frames(one: Set, seed: int, n: int, known: Truth | None) -> tuple[NDArray[Any], list[tuple[Any, ...]]]:
    """Return frames, and the rows of labels to learn from; the rows of a test part go to `known`."""
    batches = list(synthesise(one.scene, n, seed))
    labels = np.concatenate([batch.labels for batch in batches]).tolist()
    rows = [(one.name, k, label if label in (COAL, GANGUE) else OTHER) for k, label in enumerate(labels)]
    if known is not None:
        known["labels.csv"] += rows
    return np.concatenate([batch.signals for batch in batches]), [] if known is not None else rows


def _streams(one: Set, seed: int, n: int, known: Truth | None) -> tuple[NDArray[Any], list[tuple[Any, ...]]]:
    """Return streams, and the rows of blows to learn from; rocks and crossings of a test part go to `known`."""
    signals: list[NDArray[Any]] = []
    rows: list[tuple[Any, ...]] = []
    for number in range(n):
        scene, crossing = one.stream(seed, number)
        signal, truth = record(scene, seed, number)
        signals.append(signal.samples)
        columns = (truth[name].tolist() for name in ("time", "bounce", "label"))
        blows = [(one.name, number, f"{t:.4f}", int(bounce), label) for t, bounce, label in zip(*columns, strict=True)]
        if known is None:
            rows += blows
        else:
            known["rocks.csv"] += [(name, k, time, label) for name, k, time, bounce, label in blows if bounce == 0]
            known["crossings.csv"].append((one.name, number, "" if np.isnan(crossing) else f"{crossing:.3f}"))
    return np.stack(signals), rows


def write_rows(path: Path, columns: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([columns, *rows])
    write_whole(path, stream.getvalue().encode())


# -- sums ------------------------------------------------------------------------------------------------------------


def sums_text(folder: Path) -> bytes:
    """Return the lines of `sha256sum` for the files of a folder."""
    return "".join(f"{digest}  {name}\n" for name, digest in _sums(folder)).encode()


def _sums(folder: Path) -> Iterator[tuple[str, str]]:
    for path in sorted(folder.iterdir()):
        if path.name != SUMS:
            with path.open("rb") as file:
                yield path.name, hashlib.file_digest(file, "sha256").hexdigest()


def _compare(output: Path, public: bool) -> None:
    """Raise `BadData` if a file is not the one whose sum is kept: all of the public sets, else the training parts."""
    path = HERE / SUMS
    if not path.exists():  # about to be made
        return
    kept = dict(line.split("  ")[::-1] for line in path.read_text(encoding="utf-8").splitlines())
    for folder in ("signals", "truth"):
        for name, digest in _sums(output / folder):
            own = f"{folder}/{name}"
            if (public or "train" in name) and kept.get(own) != digest:
                raise BadData(
                    f"{output / own}: must have the sum {kept.get(own, 'of no file')} of {path.name}, has {digest}; "
                    "use the versions of cgid and of sets.toml that belong together"
                )


def require_unchanged(folder: Path) -> None:
    """Raise `BadData` if a folder is not as `make` left it."""
    if read_regular(folder / SUMS, "sums", LARGEST, "make the sets anew") != sums_text(folder):
        raise BadData(f"{folder}: must be as it was made, its files differ from {SUMS}; make the sets anew")
