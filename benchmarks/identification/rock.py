"""A model of the force on rock as it is: other laws of loss, lumps that are no spheres, noise that is not white.

    python benchmarks/identification/rock.py                          # all tables, Markdown; one core, some ten minutes
    python benchmarks/identification/rock.py --shows 2 --cases thornton "pink 1 %" --signals 1024

Rocks, pulses and recorder are those of `rock_pulses.py`, which shares no code with the package.

2. The model on each case, beside a learner that trains on that case alone: boosting, network or logistic regression on
   the features of the model, the best on a fifth that is held out. Accuracy counts *unknown* as wrong; recall,
   calibration and "forced" take the most probable label in spite of it, and guess where a pulse cannot be measured. The
   calibration error is over ten bins of p(coal); "by chance" is what a perfectly calibrated model would get. The
   pulses of "thornton and viscous", rock that crushes and damps, are the package's.
3. A law left out of the training, and the model judged on it, for each law. It trains as the shipped model of force
   does (`models/train.py`), on fewer impacts, and no scene has that law, that of the strangers neither. Corners, faces
   and breaking rock, which the scene `corners` has by a power law, are left out in the same way.
4. Strangers of the shipped scene, and the real shocks where they stand beside the checkout: the share that is flagged.
5. Contacts that are no spheres, rock that breaks, and an AC coupling: the share that the model answers, and of the
   answered those that are right, the mean probability of the answer, and the recall of each label.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from threadpoolctl import threadpool_limits

from benchmarks.impact.rock_pulses import CASES, LAWS, OTHERS, RATE, Case, Impacts, record
from cgid import shipped
from cgid.identification.model.model import StoredModel
from cgid.identification.prediction.answers import UNKNOWN, identify, identify_frames, suited
from cgid.identification.training import ImpactClassifier, Rows, measure, train_on_specimens
from cgid.measure.features.extraction import extract_array
from cgid.recordings import read_recording
from cgid.scene import Scene, load_scene, synthesise, varied

sys.path.insert(0, str(Path(__file__).parents[2] / "models"))
from train import force_scenes, stranger_scenes

Floats = NDArray[np.float64]
Line = dict[str, Any]
REAL_SHOCKS = Path(__file__).parents[3] / "shared" / "realdata" / "shock"
#: Seeds of what is judged, of learners, of the first rows with a law left out; blocks are so far apart that none meet.
_JUDGED, _LEARNED, _LEFT_OUT, _BLOCK = 2_000_003, 1, 2000, 10_000
#: Impacts made at once.
_AT_ONCE = 4096
#: Share of a learner's impacts that choose its family.
_HELD_BACK = 0.2
_FAMILIES = {
    "boosting": HistGradientBoostingClassifier(
        max_iter=200, max_leaf_nodes=15, learning_rate=0.08, l2_regularization=1.0, early_stopping=False
    ),
    "network": "network",
    "logistic": "logistic",
}
#: Law of a case of table 3, as scenes name it.
_KINDS = {law: law.removesuffix(" by strength") for law in LAWS} | dict.fromkeys(
    ("cone, 1%", "face, 1%", "fragmentation, 1%"), "power-law"
)
#: A case of table 2 whose pulses are the package's.
BOTH = "thornton and viscous"
#: Cases of other benchmarks.
_OTHERS = ("dull", "peers", "peers, pink 2 %")
_UNKNOWN_TO_IT = [name for name, case in CASES.items() if case.coupled or not {*OTHERS}.isdisjoint(case.laws)]


class Answered(NamedTuple):
    """What a model says of impacts: p(coal), .5 where it cannot measure; whether it states *unknown*; and the truth."""

    coal: Floats
    unknown: NDArray[np.bool_]
    labels: NDArray[np.str_]

    @property
    def hits(self) -> Floats:
        """1 where the most probable label is right, 0.5 where there is none."""
        right = (self.coal > 0.5) == (self.labels == "coal")
        return np.where(self.coal == 0.5, 0.5, right)

    def of(self, chosen: NDArray[np.bool_]) -> Answered:
        """Return some of the answers."""
        return Answered(*(column[chosen] for column in self))

    def calibration_error(self) -> tuple[float, float]:
        """Return the error over ten bins of p(coal), and its mean if the probabilities were right."""
        if not len(self.coal):
            return float("nan"), float("nan")
        place = np.minimum((self.coal * 10).astype(int), 9)
        spread = self.coal * (1 - self.coal)
        gap = np.bincount(place, self.coal - (self.labels == "coal"), 10)
        chance = np.sqrt(2 / np.pi * np.bincount(place, spread, 10))
        return float(np.abs(gap).sum() / len(self.coal)), float(chance.sum() / len(self.coal))

    def figures(self) -> Line:
        """Return the columns of the table."""
        answered, gangue = ~self.unknown, self.labels == "gangue"
        error, chance = self.calibration_error()
        return {
            "accuracy": float((self.hits * answered).mean()),
            "unknown": float(self.unknown.mean()),
            "of the answered": float(self.hits[answered].mean()) if answered.any() else float("nan"),
            "forced": float(self.hits.mean()),
            "recall of gangue": float(self.hits[gangue].mean()),
            "calibration error": error,
            "by chance": chance,
        }


def answered(model: StoredModel, signals: NDArray[Any], labels: NDArray[np.str_], trigger: int) -> Answered:
    answers = identify_frames(signals, RATE, model, pre_trigger=trigger)
    coal = np.array([answer.probabilities.get("coal", 0.5) for answer in answers])
    return Answered(coal, np.array([answer.label == UNKNOWN for answer in answers]), labels)


def blocks(case: Case, n: int, seed: int) -> Iterator[Impacts]:
    for number, first in enumerate(range(0, n, _AT_ONCE)):
        yield record(case, min(_AT_ONCE, n - first), seed + _BLOCK * number)


# -- a learner of one case --------------------------------------------------------------------------------


class Table(NamedTuple):
    """Features (n, n_features), nan where not measurable, and labels."""

    features: Floats
    labels: NDArray[np.str_]


def extracted(model: StoredModel, signals: NDArray[Any], trigger: int) -> Floats:
    return extract_array(signals, RATE, model.features, pre_trigger=trigger, invalid="nan")


def features_of(model: StoredModel, case: Case, n: int) -> Table:
    parts = [(extracted(model, one.signals, case.trigger), one.labels) for one in blocks(case, n, _LEARNED)]
    return Table(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def learned(training: Table, seed: int = 0) -> tuple[str, ImpactClassifier]:
    """Return the family with the lowest log loss on the impacts held back, and its classifier of the others."""
    measured = np.isfinite(training.features).all(axis=1)
    x, y = training.features[measured], training.labels[measured]
    cut = round((1 - _HELD_BACK) * len(x))
    fits, losses = {}, {}
    for family, own in _FAMILIES.items():
        fits[family] = ImpactClassifier(own, rejects=False, calibration_folds=0, random_state=seed)
        fits[family].fit(x[:cut], y[:cut])
        truth = y[cut:, None] == fits[family].classes_
        losses[family] = -np.log(np.maximum(fits[family].predict_proba(x[cut:])[truth], 1e-9)).mean()
    best = min(losses, key=losses.__getitem__)
    return best, fits[best]


def accuracy(classifier: ImpactClassifier, test: Table) -> float:
    """Return the accuracy; what cannot be measured is a guess."""
    measured = np.isfinite(test.features).all(axis=1)
    right = classifier.predict(test.features[measured]) == test.labels[measured]
    return float((right.sum() + 0.5 * (~measured).sum()) / len(measured))


def table_of_cases(model: StoredModel, names: Sequence[str], n: int, n_learner: int) -> Iterator[Line]:
    for name in names:
        if name == BOTH:
            trigger = with_both_losses().sampling.pre_trigger
            (signals, labels), training = (
                signals_of(with_both_losses(), *own) for own in ((n, _JUDGED), (n_learner, 1))
            )
            table = Table(extracted(model, training[0], trigger), training[1])
        else:
            impacts, trigger = record(CASES[name], n, _JUDGED), CASES[name].trigger
            signals, labels = impacts.signals, impacts.labels
            table = features_of(model, CASES[name], n_learner)
        family, classifier = learned(table)
        own = Table(extracted(model, signals, trigger), labels)
        figures = answered(model, signals, labels, trigger).figures()
        yield {"case": name, **figures, "learner": accuracy(classifier, own), "family": family}


def with_both_losses() -> Scene:
    """Return the spheres of `rock` that yield at given pressures, with viscous restitutions of .5 to .95 (assumed)."""
    rock = load_scene(shipped.scene_path("rock"))
    crushing = {one.label: one for one in reversed(rock.populations) if one.yield_pressure is not None}
    viscous = {"distribution": "uniform", "lowest": 0.5, "highest": 0.95}
    return varied(rock.model_copy(update={"populations": tuple(crushing.values())}), viscous_restitution=viscous)


def signals_of(scene: Scene, n: int, seed: int) -> tuple[NDArray[Any], NDArray[np.str_]]:
    batches = list(synthesise(scene, n, seed))
    return np.concatenate([one.signals for one in batches]), np.concatenate([one.labels for one in batches])


# -- a law left out ---------------------------------------------------------------------------------------


def rows_by_law(sizes: Sequence[tuple[Scene, int]], names: Sequence[str], seed: int) -> list[tuple[str, Rows]]:
    """Return the laws of some scenes, "" for taps, and rows of each, as many as the weights of its sources say."""
    found = []
    for scene, n in sizes:
        laws = [str(getattr(one, "dissipation", None) or scene.impact.dissipation) for one in scene.populations]
        laws += [""] * len(scene.taps)
        whole = sum(one.weight for one in scene.sources)
        for law in dict.fromkeys(laws):
            own = [one for one, its in zip(scene.sources, laws, strict=True) if its == law]
            kind = "populations" if law else "taps"
            part = scene.model_copy(update={"populations": (), "taps": ()} | {kind: tuple(own)})
            impacts = round(n * sum(one.weight for one in own) / whole)
            found.append((law, measure(synthesise(part, impacts, seed + len(found)), names)))
    return found


def joined(parts: Sequence[Rows]) -> Rows:
    """Return the rows of several laws as one, of distinct specimens."""
    first, starts = parts[0], np.cumsum([0, *(int(part.group.max()) + 1 for part in parts[:-1])])
    rates = [part.sampling_rates for part in parts]
    return replace(
        first,
        features=np.concatenate([part.features for part in parts]),
        labels=np.concatenate([part.labels for part in parts]),
        group=np.concatenate([part.group + start for part, start in zip(parts, starts.tolist(), strict=True)]),
        source=np.concatenate([np.full(len(part.labels), k) for k, part in enumerate(parts)]),
        sources=tuple(str(k) for k in range(len(parts))),
        sampling_rates=(min(low for low, _ in rates), max(high for _, high in rates)),
        left_out=sum(part.left_out for part in parts),
    )


def table_of_laws(model: StoredModel, n_rows: int, n: int) -> Iterator[Line]:
    """Yield the lines of table 3: what the models say of the law that they do not know, and of it when they do."""
    guards = [name for name in model.guards if name not in model.features]
    names = (*model.features, *guards)
    rows = rows_by_law(force_scenes(n_rows), names, _LEFT_OUT)
    strangers = rows_by_law(stranger_scenes(n_rows), names, _LEFT_OUT + _BLOCK)
    impacts = {case: record(CASES[case], n, _JUDGED) for case in _KINDS}
    for left_out in ("nothing", *dict.fromkeys(law for law, _ in rows)):
        kept, others = (joined([own for law, own in part if law != left_out]) for part in (rows, strangers))
        with threadpool_limits(1):
            trained = train_on_specimens(
                kept, guards=guards, family=model.family, judged_on=kept.sources[0], out_of_distribution=others
            ).model
        for case, law in _KINDS.items():
            if left_out in ("nothing", law):
                own = impacts[case]
                all_of_them = answered(trained, own.signals, own.labels, CASES[case].trigger)
                told = all_of_them.of(~all_of_them.unknown)
                error, chance = told.calibration_error()
                yield {
                    "left out": left_out,
                    "judged on": case,
                    "answered": 1 - float(all_of_them.unknown.mean()),
                    "of the answered": float(told.hits.mean()) if len(told.coal) else float("nan"),
                    "calibration error": error,
                    "by chance": chance,
                    "forced": float(all_of_them.hits.mean()),
                }


# -- strangers --------------------------------------------------------------------------------------------


def table_of_strangers(model: StoredModel, n: int) -> Iterator[Line]:
    """Yield the share flagged of each kind of stranger, at three noises, and of the real shocks."""
    scene = load_scene(shipped.scene_path("strangers"))
    flagged: dict[str, Line] = {}
    for noise in (0.001, 0.01, 0.1):
        found: dict[str, list[bool]] = {}
        for batch in synthesise(varied(scene, relative_noise=noise), n, _JUDGED):
            answers = identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger)
            for label, answer in zip(batch.labels.tolist(), answers, strict=True):
                found.setdefault(label, []).append(not answer.in_training_range)
        for label, flags in found.items():
            flagged.setdefault(label, {"stranger": label})[f"at {noise:.1%}"] = float(np.mean(flags))
    yield from flagged.values()
    files = sorted(REAL_SHOCKS.glob("acc_*.txt"))
    if files:
        share = float(np.mean([shock_is_flagged(model, file) for file in files]))
        yield {"stranger": f"{len(files)} real shocks", "at 0.1%": "-", "at 1.0%": share, "at 10.0%": "-"}


def shock_is_flagged(model: StoredModel, file: Path) -> bool:
    (recorded,) = read_recording(file)
    answers = identify(suited(recorded, model, 1.0), model)
    return not any(answer.in_training_range for answer in answers)


def table_of_unknown_contacts(model: StoredModel, names: Sequence[str], n: int) -> Iterator[Line]:
    """Yield what the model says of contacts and recorders that are not those of `reference`."""
    for name in names:
        impacts = record(CASES[name], n, _JUDGED)
        told = answered(model, impacts.signals, impacts.labels, CASES[name].trigger)
        sure = told.of(~told.unknown)
        right = {label: sure.hits[sure.labels == label] for label in ("coal", "gangue")}
        yield {
            "case": name,
            "answered": 1 - float(told.unknown.mean()),
            "of the answered": float(sure.hits.mean()),
            "said": float(np.maximum(sure.coal, 1 - sure.coal).mean()),
            **{f"recall of {label}": float(own.mean()) if own.size else float("nan") for label, own in right.items()},
        }


def limits() -> dict[str, Scene]:
    """Return the scenes of some cases, for ceilings and rivals."""
    reference, peers = (load_scene(shipped.scene_path(name)) for name in ("reference", "peers"))
    populations: tuple[Any, ...] = ()
    for population, (low, high) in zip(reference.populations, ((0.15, 0.40), (0.30, 0.60)), strict=True):
        alone = reference.model_copy(update={"populations": (population,)})
        span = {"distribution": "uniform", "lowest": low, "highest": high}
        populations += varied(alone, restitution=span).populations
    return {
        "dull": reference.model_copy(update={"populations": populations}),
        "peers": peers,
        "hunt-crossley": reference,
    }


# -- output -----------------------------------------------------------------------------------------------


def show(title: str, lines: Iterator[Line]) -> None:
    print(f"\n**{title}**\n", flush=True)
    for number, line in enumerate(lines):
        if not number:
            print(f"| {' | '.join(line)} |\n|{'---|' * len(line)}")
        cells = (f"{value:.3f}" if isinstance(value, float) else str(value) for value in line.values())
        print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shows", type=int, nargs="+", choices=range(2, 6), default=range(2, 6))
    cases = [*(name for name in CASES if name not in (*_OTHERS, *_UNKNOWN_TO_IT)), BOTH]
    parser.add_argument("--cases", nargs="+", choices=[*CASES, BOTH], default=cases)
    parser.add_argument("--signals", type=int, default=4096, help="to judge a line on")
    parser.add_argument("--learner-signals", type=int, default=20_000, help="that a learner trains on")
    parser.add_argument("--rows", type=int, default=10_000, help="of the largest scene in table 3")
    own = parser.parse_args()
    model = StoredModel.load(shipped.path_of("models", shipped.DEFAULT_MODEL))
    tables = {
        2: ("2. Laws, shapes, recorders", table_of_cases(model, own.cases, own.signals, own.learner_signals)),
        3: ("3. A law left out of the training", table_of_laws(model, own.rows, own.signals)),
        4: ("4. Strangers: share flagged", table_of_strangers(model, own.signals)),
        5: ("5. Contacts that are no spheres", table_of_unknown_contacts(model, _UNKNOWN_TO_IT, own.signals)),
    }
    for number in own.shows:
        show(*tables[number])


if __name__ == "__main__":
    main()
