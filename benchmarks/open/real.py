"""Tracks of real recordings, for those who have fetched them (`cgid fetch`): whole recordings and taps, never windows.

The truth stands in the names of the files or in the hammer's channel, so these tracks ask for honesty: each recording
is answered by what was learned without it, those of the ramp without all recordings of its number.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.io import wavfile

from benchmarks.open.sets import LARGEST, write_rows
from cgid._lib.files import read_cells
from cgid._lib.validation import suggestion
from cgid.errors import BadData, MissingOption
from cgid.recordings.public import PUBLIC, PublicFile
from cgid.store.folder import sha256_of

#: Columns of answers: the name of a file, and a label or a number.
ANSWER_COLUMNS = ("set", "id", "answer")
#: In the column `truth` of results: the files have sums of their own, in `datasets/public.csv`.
PUBLIC_TRUTH = "public data"

Truths = Mapping[str, str | float]


class Track(NamedTuple):
    """A public dataset, which of its files count, and the truth of one: a label, or a number with a unit."""

    dataset: str
    about: str
    files: str
    truth: Callable[[Path], str | float]


TRACKS = {
    "ramp": Track(
        "bulk-ramp", "material of a recording of many impacts", r".*_[123]\.wav", lambda path: path.stem[:-2]
    ),
    "balls": Track(
        "steel-balls", "which of two steel balls hit concrete", r".*/(6|10)mm/.*\.txt", lambda path: path.parent.name
    ),
    "taps": Track(
        "taps-pyfrf",
        "peak force [N] of a hammer tap from the acceleration",
        r".*/measurements_\d\.npy",
        lambda path: float(np.load(path)[1].max()),
    ),
}


def files_of(folder: Path, name: str) -> dict[str, Path]:
    """Return the files of a track by name.

    Raises `MissingOption` without all of them, `BadData` if one is another file than the public one.
    """
    track, found = TRACKS[name], {}
    for file in PUBLIC[track.dataset].files:
        if re.fullmatch(track.files, file.path):
            found[Path(file.path).name] = _unchanged(folder, file, track.dataset)
    return found


def _unchanged(folder: Path, file: PublicFile, dataset: str) -> Path:
    own = Path(file.path)
    # `cgid fetch` keeps the folders of a dataset, others may not; names of balls are unique, too.
    there = sorted(folder.rglob(own.name))
    if not there:
        raise MissingOption(f"{folder}: must contain {own.name}; cgid fetch {dataset}, then --real with its folder")
    digest = sha256_of(there[0])
    if digest != file.sha256:
        raise BadData(
            f"{there[0]}: must have the SHA-256 {file.sha256[:12]}... of {dataset}, has {digest[:12]}...; "
            f"cgid fetch {dataset} into another folder"
        )
    return there[0]


def read_answers(path: Path, folder: Path | None) -> dict[str, tuple[Truths, Truths]]:
    """Return answers and truth by track; raises `BadData` with the line, `MissingOption` without the recordings."""
    truths: dict[str, Truths] = {}
    found: dict[str, dict[str, str | float]] = {}
    for number, cells in read_cells(path, "answers", LARGEST)[1:]:
        place = f"{path}, line {number}"
        if len(cells) != len(ANSWER_COLUMNS):
            raise BadData(f"{place}: must have {len(ANSWER_COLUMNS)} cells as the header has, got {len(cells)}")
        name, key, answer = cells
        if name not in TRACKS:
            raise BadData(f"{place}: set must be {', '.join(TRACKS)}, got {name[:40]!r}; take the line out")
        if folder is None:
            raise MissingOption(f"{path}: {name} needs recordings; cgid fetch {TRACKS[name].dataset}, then give --real")
        if name not in truths:
            truths[name] = {one: TRACKS[name].truth(file) for one, file in files_of(folder, name).items()}
        if key not in truths[name]:
            cure = suggestion(key, truths[name]) or f"; one is {next(iter(truths[name]))}"
            raise BadData(f"{place}: id must be a file of {name}, got {key[:60]!r}{cure}")
        if key in found.setdefault(name, {}):
            raise BadData(f"{place}: {key} must be answered once; take one line out")
        found[name][key] = _answer(place, answer, truths[name])
    for name, own in found.items():
        if missing := sorted(truths[name].keys() - own.keys()):
            raise BadData(f"{path}: a set must be complete, {name} lacks {missing[0]}; add it, or leave the set out")
    if not found:
        raise BadData(f"{path}: must have rows below its header, has none; answer at least one set")
    return {name: (own, truths[name]) for name, own in found.items()}


def _answer(place: str, answer: str, truth: Truths) -> str | float:
    labels = sorted({value for value in truth.values() if isinstance(value, str)})
    if labels:
        if answer not in labels:
            raise BadData(f"{place}: answer must be one of {', '.join(labels)}, got {answer[:40]!r}")
        return answer
    try:
        value = float(answer)
    except ValueError:
        value = float("nan")
    if not 0 < value < np.inf:
        raise BadData(f"{place}: answer must be a force above 0 N, got {answer[:40]!r}; write newtons")
    return value


# -- simple entries --------------------------------------------------------------------------------------------------


def simple(folder: Path) -> Iterator[tuple[str, str, Any]]:
    """Yield set, id and answer of simple statistics: what anybody tries first."""
    from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    from benchmarks.identification.ramp import log_mel
    from benchmarks.identification.steel_balls import ball
    from cgid.recordings import read_recording

    files = files_of(folder, "ramp")
    tables = {name: log_mel(read_recording(path, channel=1)[0].samples) for name, path in files.items()}
    truth = {name: str(TRACKS["ramp"].truth(path)) for name, path in files.items()}
    for name, table in tables.items():
        others = [other for other in files if Path(other).stem[-1] != Path(name).stem[-1]]
        known = np.repeat([truth[other] for other in others], [len(tables[other]) for other in others])
        model = make_pipeline(StandardScaler(), LinearDiscriminantAnalysis(solver="lsqr", shrinkage="auto"))
        model.fit(np.concatenate([tables[other] for other in others]), known)
        yield "ramp", name, model.classes_[model.predict_log_proba(table).clip(-20).sum(axis=0).argmax()]
    balls = files_of(folder, "balls")
    root = next(iter(balls.values())).parents[1]
    durations = {diameter: np.log(ball(root, diameter).duration) for diameter in (6, 10)}
    for diameter, own in durations.items():
        names = sorted(name for name, path in balls.items() if path.parent.name == f"{diameter}mm")
        for k, name in enumerate(names):
            middles = {one: np.median(np.delete(x, k) if one == diameter else x) for one, x in durations.items()}
            yield "balls", name, f"{min(middles, key=lambda one: abs(own[k] - middles[one]))}mm"
    taps = {name: np.abs(np.load(path)[1:3]).max(axis=1) for name, path in files_of(folder, "taps").items()}
    for name, (_, own_peak) in taps.items():
        ratio = np.mean([force / peak for other, (force, peak) in taps.items() if other != name])
        yield "taps", name, f"{own_peak * ratio:.5g}"


def own(folder: Path) -> Iterator[tuple[str, str, Any]]:
    """Yield set, id and answer of cgid: windows trained as a user trains them, modes from the other taps."""
    from benchmarks.identification.ramp import answers, command
    from cgid.calibration import tap_test
    from cgid.identification.inversion import recover_force

    files = files_of(folder, "ramp")
    with tempfile.TemporaryDirectory() as scratch:
        manifest, model = Path(scratch, "ramp.csv"), Path(scratch, "ramp.npz")
        for number in "123":
            others = [path for name, path in files.items() if not name.endswith(f"{number}.wav")]
            write_rows(manifest, ("path", "label", "channel"), [(one, TRACKS["ramp"].truth(one), 1) for one in others])
            command("train", str(manifest), "-o", str(model), "--overwrite")
            for name, path in files.items():
                if path not in others:
                    wavfile.write(Path(scratch, "one.wav"), *_first_channel(path))
                    told = [row["probabilities"] for row in answers(Path(scratch, "one.wav"), model, 0.0)]
                    sums = {one: sum(np.log(max(each[one], 1e-6)) for each in told if each) for one in told[0]}
                    yield "ramp", name, max(sums, key=lambda one: sums[one])
    every = {name: np.load(path) for name, path in sorted(files_of(folder, "taps").items())}
    for name, (times, force, response) in every.items():
        rest = [other for one, other in every.items() if one != name]
        rate, band = 1 / float(np.diff(times).mean()), (30.0, 10_000.0)
        hammer = np.concatenate([one[1] for one in rest])
        test = tap_test(np.concatenate([one[2] for one in rest])[None], rate, hammer=hammer, band=band, source="taps")
        onset = max(int(np.argmax(force)) - 14, 0) / rate
        found = recover_force(response[None], rate, test.response, [onset], band=band)[0]
        yield "taps", name, f"{found.force.max():.5g}"


def _first_channel(path: Path) -> tuple[int, Any]:
    rate, samples = wavfile.read(path)
    return rate, samples if samples.ndim == 1 else samples[:, 0]


def write_answers(path: Path, rows: Iterator[tuple[str, str, Any]]) -> Path:
    write_rows(path, ANSWER_COLUMNS, list(rows))
    return path


#: Our own entries for these tracks, by their names on the command line.
REAL = {"real": simple, "real-cgid": own}
