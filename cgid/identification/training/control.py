"""The negative control of a training: the answers must follow the rocks, not what sounds between them.

The silence between impacts is recorded, too. Each impact is measured again as it would be with another background: once
with silence of other recordings of its own label added, once with that of another label. Noise costs both the same;
only a model that listens to the machines answers the second otherwise. The same by a path: the impact behind a filter,
the ratio of two silences, tells gains and filters, which change rocks and silence alike. What silence does not know it
cannot tell: another place or mount of the sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from cgid._lib.validation import Floats, rates_agree
from cgid.errors import BadData
from cgid.identification.detection.events import SAME_IMPACT
from cgid.identification.detection.silence import SILENT_POWER
from cgid.measure.features.extraction import FEATURES, extract_array

if TYPE_CHECKING:
    from cgid.identification.detection.ear import Heard
    from cgid.identification.detection.events import Event
    from cgid.identification.training.manifest import Annotation
    from cgid.identification.training.recordings import AnnotatedFile
    from cgid.identification.training.rows import Rows

#: The ways in which an impact is measured again.
SAME = 0
OTHER = 1
PATH_SAME = 2
PATH_OTHER = 3
N_WAYS = 4
#: The level of all bands together, by kind: with it, a level says what a relative one does.
TOTALS = {"vibration": "level_total", "window": "window_level"}
#: More of the impacts that the other label's background turns wrong than its own, and by chance less often than this
#: (sign test of pairs): by benchmarks/identification/control.py.
_BACKGROUND_HARM = 0.10
_BACKGROUND_CHANCE = 0.01
#: The same for a path, which exaggerates what silence tells: with fewer groups of a label, it told 2 of 43 sound
#: trainings at .30; with more, at most .06 turned wrong in 83 of them (benchmarks/identification/control.py).
_PATH_HARM = 0.20
_PATH_CHANCE = 0.001
_PATH_GROUPS = 3
#: Most silent pieces kept of each label of a recording; a thousand have the same mean.
_MAX_PIECES = 32
#: Largest change of a path in amplitude, where a silence has almost nothing.
_LARGEST_PATH = 100.0
#: Nothing counts in a mended model below this many times the power of the loudest silence (15 dB): of 6 swapped states,
#: 4 times leave .71 to .82 right, 16 times .75 to .82, 32 times .76 to .88 (benchmarks/identification/control.py).
_FLOOR = 32.0
#: Rocks and silence of a recording are off by one factor: both by more than this, alike within this [dB].
_OFF_DB = 8.0
#: The labels differ by one factor where rocks and silence of all recordings of one are louder, by this on average [dB].
_APART_DB = 6.0
#: Two files are of the same rocks where one difference of times is that of more than this share of the impacts of the
#: shorter one, within this [s], and of at least so many: other recordings reach .38 of 8 impacts and .21 of 24.
_COPIED = 0.5
_SAME_TIME = 2e-3
_MIN_COPIED = 6
#: Most impacts of the shorter file that are compared: clocks drift.
_COMPARED = 60


@dataclass(eq=False)
class Source:
    """The impacts and the silence of one label in one file."""

    name: str
    label: str
    group: str
    rate: float
    n_stretches: int  # of this label, with others between them
    pieces: list[NDArray[Any]] = field(default_factory=list)  # (n_channels, n) each, in the unit of the rows
    peaks: list[float] = field(default_factory=list)  # of the impacts, in that unit
    powers: list[float] = field(default_factory=list)  # of their frames

    def settle(self) -> None:
        """Keep the quieter half of the pieces, and of these what is far below the impacts."""
        power = [float(np.max(np.var(one, axis=1))) for one in self.pieces]
        limit = min(float(np.median(power or [0.0])), SILENT_POWER * float(np.median(self.powers or [0.0])))
        self.pieces = [one for one, size in zip(self.pieces, power, strict=True) if 0 < size <= limit]

    def spectrum(self, n: int) -> Floats:
        """Return the mean power of silence by frequency, over a third octave, (n_channels, n // 2 + 1)."""
        power = np.mean(np.abs(np.fft.rfft([_fitted(one, n) for one in self.pieces])) ** 2, axis=0)
        sums = np.cumsum(np.pad(power, ((0, 0), (1, 0))), axis=1)
        bins = np.arange(power.shape[1])
        low = np.floor(bins * 2 ** (-1 / 6)).astype(int)
        high = np.minimum(np.ceil(bins * 2 ** (1 / 6)).astype(int) + 1, power.shape[1])
        return np.asarray((sums[:, high] - sums[:, low]) / (high - low))


def _fitted(piece: NDArray[Any], n: int) -> Floats:
    """Return a piece (n_channels, n_piece) less its mean, cut or repeated to n samples."""
    piece = piece - piece.mean(axis=1, keepdims=True)
    return np.asarray(np.take(piece, np.arange(n) % piece.shape[1], axis=1))


class Background:
    """What sounds between the impacts of labelled files, and the impacts as they would be with another background."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._sources: dict[tuple[int, str, str], Source] = {}
        self._times: dict[int, list[float]] = {}  # of all impacts of a file [s]
        self._files: dict[int, AnnotatedFile] = {}
        # Of each file: begin of the samples at hand, the first that may begin a silent piece, the samples.
        self._rest: dict[int, tuple[int, int, NDArray[Any]]] = {}
        self._paths: dict[tuple[Any, ...], NDArray[Any]] = {}

    @property
    def sources(self) -> list[Source]:
        """All labels of all files that were heard."""
        return list(self._sources.values())

    def _source(self, number: int, annotation: Annotation, rate: float) -> Source:
        key = number, annotation.label, annotation.group
        if key not in self._sources:
            file = self._files[number]
            n = sum(of == key[1:] for of, _ in groupby(file.annotations, lambda one: (one.label, one.group)))
            self._sources[key] = Source(str(annotation.written), annotation.label, annotation.group, rate, n)
        return self._sources[key]

    def hear(self, number: int, file: AnnotatedFile, heard: Heard, rate: float, n: int) -> None:
        """Take what further samples of a file tell; silent pieces have n samples."""
        self._files[number] = file
        begin, free, samples = self._rest.get(number, (0, n, heard.samples[:, :0]))
        samples = np.concatenate([samples, heard.samples], axis=1)
        onsets = sorted({event.onset for event in heard.events})
        for event in heard.events:
            self._times.setdefault(number, []).append(event.time)
            if (annotation := file.annotation_at(event.time)) is not None:
                source, scale = self._source(number, annotation, rate), file.scale(annotation, self._unit)
                frame = np.atleast_2d(event.samples) * scale
                source.peaks.append(float(np.max(np.abs(frame - np.median(frame, axis=1, keepdims=True)))))
                source.powers.append(float(np.max(np.var(frame, axis=1))))
        known = int(min(heard.until, begin + samples.shape[1]))
        for stop in (*onsets, known):
            # The rise of an impact precedes its onset.
            while free + n <= (stop - n // 16 if stop in onsets else stop):
                self._take(number, samples[:, free - begin : free - begin + n], (free + n / 2) / rate, rate)
                free += n
            free = max(free, stop + n) if stop in onsets else free
        keep = min(max(min(free, known), begin), begin + samples.shape[1])
        self._rest[number] = keep, free, samples[:, keep - begin :].copy()

    def _take(self, number: int, piece: NDArray[Any], middle: float, rate: float) -> None:
        file = self._files[number]
        annotation = file.annotation_around(middle)  # impacts may be labelled one by one
        if annotation is None or not np.isfinite(piece).all():
            return
        pieces = self._source(number, annotation, rate).pieces
        pieces.append((piece * file.scale(annotation, self._unit)).astype(np.float32))
        if len(pieces) > 4 * _MAX_PIECES:
            del pieces[::2]

    def settle(self) -> None:
        """Choose the silent pieces of each source; all files are heard."""
        self._rest.clear()
        for source in self.sources:
            source.settle()
            source.pieces = source.pieces[:: -(-len(source.pieces) // _MAX_PIECES) or 1]

    def require_others(self) -> None:
        """Raise `BadData` if two files of different groups hold the impacts of the same rocks."""
        for one, other in combinations(sorted(self._times), 2):
            first, second = self._files[one], self._files[other]
            groups = [{row.group for row in file.annotations} for file in (first, second)]
            if first.digest != second.digest and groups[0] != groups[1]:
                n, lag = in_common(self._times[one], self._times[other])
                if n:
                    raise BadData(
                        f"{second.recording.source}: recordings of different groups must be of other rocks, {n} "
                        f"impacts come {lag:.6g} s after those of {first.recording.source}; remove one, or give both "
                        "one group"
                    )

    # -- the impacts again ----------------------------------------------------------------------------------

    def donors(self, own: Source, *, other: bool) -> list[Source]:
        """Return the sources whose silence may stand for the own or another label's; never that of the own group."""
        found = [
            one
            for one in self.sources
            if one.pieces and (one.label != own.label) == other and rates_agree(one.rate, own.rate)
        ]
        of_others = [one for one in found if one.group != own.group]
        if of_others or other:
            return of_others or found
        return [own] if own.pieces and own.n_stretches > 1 else []

    def windows(
        self, number: int, annotation: Annotation, first: NDArray[np.integer], windows: NDArray[np.floating]
    ) -> tuple[list[Floats], list[str]]:
        """Return windows (n, n_channels, n_samples) in `N_WAYS` ways, nan without silence, and the giving groups."""
        changed, groups = [np.full(windows.shape, np.nan) for _ in range(N_WAYS)], [""] * len(windows)
        source = self._sources.get((number, annotation.label, annotation.group))
        for k in range(len(windows) if source is not None else 0):
            assert source is not None
            seed = int(self._files[number].digest[:8], 16), round(annotation.start * source.rate), int(first[k])
            if (found := self.frames(source, windows[k], range(windows.shape[1]), seed)) is not None:
                groups[k] = found[1]
                for way, frame in zip(changed, found[0], strict=True):
                    way[k] = frame
        return changed, groups

    def again(self, number: int, event: Event) -> tuple[list[Event], str] | None:
        """Return an impact in `N_WAYS` ways and the group that gave the other background; None without silence."""
        file = self._files[number]
        annotation = file.annotation_at(event.time)
        source = None if annotation is None else self._sources.get((number, annotation.label, annotation.group))
        if annotation is None or source is None:
            return None
        frames = np.atleast_2d(event.samples) * (scale := file.scale(annotation, self._unit))
        rows = [event.channel] if event.samples.ndim == 1 else list(range(len(frames)))
        found = self.frames(source, frames, rows, (int(file.digest[:8], 16), event.onset))
        if found is None:
            return None
        changed, group = found
        shape = event.samples.shape
        return [replace(event, samples=(one / scale).reshape(shape)) for one in changed], group

    def frames(
        self, source: Source, frames: NDArray[Any], rows: Sequence[int], seed: Sequence[int]
    ) -> tuple[list[Floats], str] | None:
        """Return frames (n_channels, n) of channels in `N_WAYS` ways, and the group that gave the other background."""
        same, other = (self.donors(source, other=one) for one in (False, True))
        if not (same and other and source.pieces):
            return None
        random, n = np.random.default_rng(seed), frames.shape[1]
        changed, group = list[Floats](), ""
        for donors in (same, other):
            donor = donors[int(random.integers(len(donors)))]
            piece = _fitted(donor.pieces[int(random.integers(len(donor.pieces)))], n)
            changed.append(frames + piece[np.array(rows) % len(piece)])
            group = donor.group
        for donors in (same, other):
            donor = donors[int(random.integers(len(donors)))]
            changed.append(_behind(frames, self._path(source, donor, 2 * n, rows)))
        return changed, group

    def _path(self, source: Source, donor: Source, n: int, rows: Sequence[int]) -> NDArray[np.complex128]:
        """Return the response (n_channels, n // 2 + 1) of least phase by which one silence would become the other."""
        key = id(source), id(donor), n, tuple(rows)
        if key not in self._paths:
            for one in (source, donor):
                if (id(one), n) not in self._paths:
                    self._paths[id(one), n] = one.spectrum(n)
            own, others = (self._paths[id(one), n] for one in (source, donor))
            ratio = np.sqrt(others[np.array(rows) % len(others)] / own[np.array(rows) % len(own)])
            cepstrum = np.fft.irfft(np.log(np.clip(ratio, 1 / _LARGEST_PATH, _LARGEST_PATH)), n)
            cepstrum[:, 1 : n // 2] *= 2
            cepstrum[:, n // 2 + 1 :] = 0
            self._paths[key] = np.exp(np.fft.rfft(cepstrum))
        return self._paths[key]

    def floor(self, names: Sequence[str], framed: Callable[[float], tuple[int, int | None]]) -> Floats:
        """Return the level below which nothing counts, for each feature; minus infinity for what is no level.

        `framed` gives the length and the pre-trigger [samples] of rows at a rate [Hz].
        """
        levels = [name for name in names if FEATURES[name].unit.startswith("log10") and "U" in FEATURES[name].unit]
        found = dict.fromkeys(names, -np.inf)
        for source in self.sources if levels else ():
            n, pre_trigger = framed(source.rate)
            frames = [_fitted(piece, n) for piece in source.pieces]
            if frames:
                table = extract_array(
                    np.concatenate(frames), source.rate, levels, pre_trigger=pre_trigger, invalid="nan",
                    detection_limit=0.0,
                )  # fmt: skip
                loudest = np.log10(_FLOOR * np.nanmean(10.0**table, axis=0))
                found |= {name: max(found[name], float(x)) for name, x in zip(levels, loudest, strict=True)}
        return np.array(list(found.values()))


def _behind(frames: NDArray[Any], path: NDArray[np.complex128]) -> Floats:
    """Return frames (n_channels, n) behind a response for twice their length."""
    n, middle = frames.shape[1], np.median(frames, axis=1, keepdims=True)
    return np.asarray(np.fft.irfft(np.fft.rfft(frames - middle, 2 * n) * path, 2 * n)[:, :n])


def in_common(times: Sequence[float], others: Sequence[float]) -> tuple[int, float]:
    """Return how many impacts of the shorter of two files are also in the other and the lag [s]; 0 if few are."""
    rocks = (np.sort(some) for some in (times, others))  # which several channels hear
    short, long = sorted((some[np.diff(some, prepend=-np.inf) > SAME_IMPACT] for some in rocks), key=len)
    if len(short) < _MIN_COPIED:
        return 0, 0.0
    first = max((len(short) - _COMPARED) // 2, 0)
    short = short[first : first + _COMPARED]
    lags = np.sort((long[None] - short[:, None]).ravel())
    counts = np.searchsorted(lags, lags + 2 * _SAME_TIME, side="right") - np.arange(len(lags))
    best = int(np.argmax(counts))
    n = min(int(counts[best]), len(short))
    # Of rocks at even times, many lags fit.
    next_best = int(np.max(counts[np.abs(lags - lags[best]) > 4 * _SAME_TIME], initial=0))
    lag = float(np.median(lags[best : best + n])) * (1 if len(times) <= len(others) else -1)
    return (n, lag) if n >= _MIN_COPIED and n > _COPIED * len(short) and next_best <= _COPIED * n else (0, lag)


# -- what follows -----------------------------------------------------------------------------------------


def judged(rows: Rows, own: NDArray[np.str_], again: NDArray[np.str_]) -> dict[str, Any]:
    """Return the control of a training from the answers for rows (n,), and for them again (n, N_WAYS).

    An answer "" was not tried.
    """
    tried = (again != "").all(axis=1) if again.size else np.zeros(0, bool)
    if not len(tried) or set(rows.labels[tried]) != set(rows.labels):
        return {"told": "", "why": _why_untried(rows)}
    if 0.5 ** (n := int(tried.sum())) >= _BACKGROUND_CHANCE:  # were all of them turned wrong, it might be chance
        return {"told": "", "why": f"{n} {rows.slicing.by if rows.slicing else 'row'}s are too few to tell"}
    right = again[tried] == rows.labels[tried, None]
    same, other, path_same, path_other = right.mean(axis=0).tolist()
    accuracy = float(np.mean(own[tried] == rows.labels[tried]))
    background, path = _chance(right[:, SAME], right[:, OTHER]), _chance(right[:, PATH_SAME], right[:, PATH_OTHER])
    n_groups = min(len(np.unique(rows.group[tried & (rows.labels == one)])) for one in np.unique(rows.labels))
    is_heard = same - other > _BACKGROUND_HARM and background < _BACKGROUND_CHANCE
    follows = path_same - path_other > _PATH_HARM and path < _PATH_CHANCE and n_groups >= _PATH_GROUPS and not is_heard
    return {
        "told": "background" if is_heard else "path" if follows else "",
        "n": n,
        "own": accuracy,
        "same": same,
        "other": other,
        "chance": background,
        "path": [path_same, path_other],
        # What swapped states leave, but for .12 (standard deviation over 72 trainings).
        "expected": float(np.clip(accuracy - (path_same - path_other if follows else 2 * (same - other)), 0.0, 1.0)),
    }


def in_backgrounds(predict: Callable[[Floats], NDArray[np.str_]], background: Floats) -> NDArray[np.str_]:
    """Return the labels of rows in other backgrounds (n_rows, n_ways, n_columns), "" where there is no silence."""
    table = background.reshape(-1, background.shape[-1])
    measured = np.isfinite(table).all(axis=1)
    answers = np.zeros(len(table), "<U100")
    if measured.any():
        answers[measured] = predict(table[measured])
    return answers.reshape(background.shape[:2])


def control_notes(control: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a control found besides what it tells, one line each; nothing of an empty one."""
    if not control:
        return
    if before := control.get("before"):
        yield (
            f"trained again without tones and weak levels: the answers, {before['own']:.2f} right in these recordings, "
            f"followed what sounds between the rocks (with silence of their own label added {before['same']:.2f}, of "
            f"the other {before['other']:.2f}); label both materials in each state of the machines for a better model"
        )
    if why := control.get("why"):
        yield f"not tried whether the answers follow what sounds between the rocks: {why}"
    elif not control["told"]:
        yield (
            f"the answers do not follow what sounds between the rocks: {control['own']:.2f} right, with silence of "
            f"their own label added {control['same']:.2f}, of the other {control['other']:.2f}"
        )


def _why_untried(rows: Rows) -> str:
    for label in np.unique(rows.labels).tolist():
        silent = [row["silence"] is not None for row in rows.levels_of_sources if row["label"] == label]
        if not any(silent):
            return f"{label} has no silence between its impacts"
        if sum(silent) < 2:
            return f"{label} has silence in one recording or stretch only"
    return "each label must have silence in two recordings of one sampling rate"


def _chance(same: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Return the probability by chance of as many pairs that only the own background answers rightly (sign test)."""
    worse, better = int(np.sum(same & ~other)), int(np.sum(other & ~same))
    return float(stats.binom.sf(worse - 1, worse + better, 0.5))


def table_of(sources: Iterable[Source]) -> list[dict[str, Any]]:
    """Return the levels of rocks and silence of each label in each file [dB], for JSON."""
    return [
        {
            "name": one.name,
            "label": one.label,
            "rocks": 20 * float(np.log10(np.median(one.peaks))),
            "silence": 10 * float(np.log10(np.median([np.var(piece) for piece in one.pieces]))) if one.pieces else None,
        }
        for one in sources
        if one.peaks
    ]


def odd_sources(table: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a warning for a recording or label whose rocks and silence are both off by one factor."""
    rows = [row for row in table if row["silence"] is not None]
    levels = np.array([[row["rocks"], row["silence"]] for row in rows]).reshape(-1, 2)
    labels = np.array([row["label"] for row in rows])
    for k, row in enumerate(rows):
        others = (labels == row["label"]) & (np.arange(len(rows)) != k)
        if others.sum() < 2:  # of two, either may be off
            continue
        differences = levels[k] - levels[others]
        off = differences[np.argmin(np.abs(differences).sum(axis=1))]  # from the nearest
        if np.abs(off).min() > _OFF_DB and abs(off[0] - off[1]) < _OFF_DB:
            yield (
                f"{row['name']}: rocks and silence are both about {10 ** (off.mean() / 20):.3g} times as large as in "
                f"the other recordings of {row['label']}: check its unit, sensitivity, gain and full scale"
            )
    for one, other in combinations(np.unique(labels).tolist(), 2):
        pair = levels[labels == one], levels[labels == other]
        low, high = sorted(pair, key=lambda some: some[:, 0].mean())
        if (
            min(map(len, pair)) > 1
            and ((high.mean(axis=0) - low.mean(axis=0) > _APART_DB) & (high.min(axis=0) > low.max(axis=0))).all()
        ):
            yield (
                f"labels {one} and {other}: rocks and silence of one are both louder in every recording: other "
                "machines, or another gain or unit; record both with the same settings, in each state of the machines"
            )
