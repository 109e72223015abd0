"""Alternatives to cgid's features and classifier: other packages on the same signals.

`identification.py` starts one process per peer and frame, in an environment that need not contain cgid:

    python identification_peers.py NAME FRAME FOLDER ANSWER.json

FOLDER holds train.npy (sets, signals, samples), test.npy (signals, samples) and their labels. Every peer gets the
settings that help it. The catch22 sets include mean and deviation (catch24), because the size of the force is
informative. Rocket does not normalise the series, for the same reason (on the pulse alone .88 instead of .84). Feature
sets are followed by the better of random forest and ridge in cross-validation on the training signals. Rocket and
MiniRocket are followed by the scaled ridge of aeon's own classifiers, separated so that features and answers are timed
individually. Times are processor times, not wall-clock, after a first call that compiles.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.ensemble import RandomForestClassifier
from sklearn.feature_selection import VarianceThreshold
from sklearn.impute import SimpleImputer
from sklearn.linear_model import RidgeClassifierCV
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

Array = NDArray[Any]
Transform = Callable[[Array], Array]

#: Samples that a peer receives. The pulse begins at sample 100 and ends before sample 342, so only noise is cut away;
#: cgid also receives the 100.
FRAMES = {"whole": slice(None), "pulse": slice(88, 344)}
CHUNK = 250  # signals at a time
FOLDS = 3
_ALPHAS = np.logspace(-3, 3, 10)  # aeon's own


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the result of a call and its processor time [s], which excludes other processes."""
    start = time.process_time()
    result = function(*arguments)
    return result, time.process_time() - start


def peak_memory() -> float:
    """Return the peak memory of this process [MB]."""
    # On Linux getrusage starts from the parent's memory at the fork.
    status = Path("/proc/self/status")
    if status.exists():
        return int(status.read_text().split("VmHWM:")[1].split()[0]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def rows(folder: Path, name: str, *place: int | slice) -> Array:
    """Return a part of a stored array; the file is reopened each time, so that pages already read are released."""
    return np.array(np.load(folder / f"{name}.npy", mmap_mode="r")[place])


def tsfresh(_: Array) -> Transform:
    """All features except the two whose cost is quadratic in the length."""
    import pandas
    from tsfresh import extract_features
    from tsfresh.feature_extraction import EfficientFCParameters

    settings = EfficientFCParameters()

    def transform(frames: Array) -> Array:
        n, samples = frames.shape
        columns = {"id": np.repeat(np.arange(n), samples), "time": np.tile(np.arange(samples), n)}
        series = pandas.DataFrame({**columns, "force": frames.ravel()})
        options = {"column_id": "id", "column_sort": "time", "column_value": "force", "n_jobs": 0}
        found = extract_features(series, default_fc_parameters=settings, disable_progressbar=True, **options)
        return found.to_numpy()

    return transform


def tsfel(_: Array) -> Transform:
    """All features of all domains, frame by frame, which is the fastest without a pool."""
    from tsfel import get_features_by_domain, time_series_features_extractor

    settings = get_features_by_domain()

    def transform(frames: Array) -> Array:
        found = [time_series_features_extractor(settings, frame, fs=200e3, verbose=0, n_jobs=None) for frame in frames]
        return np.concatenate([row.to_numpy() for row in found])

    return transform


def pycatch22(_: Array) -> Transform:
    """catch22 in C, with mean and deviation."""
    from pycatch22 import catch22_all

    return lambda frames: np.array([catch22_all(frame, catch24=True)["values"] for frame in frames])


def aeon_catch22(_: Array) -> Transform:
    """catch22 in numba, with mean and deviation."""
    from aeon.transformations.collection.feature_based import Catch22

    features = Catch22(catch24=True, replace_nans=True, n_jobs=1)
    return lambda frames: np.asarray(features.fit_transform(frames[:, None, :]))


def minirocket(train: Array) -> Transform:
    """Shares of positive values after 10,000 fixed kernels, with biases from the training signals."""
    from aeon.transformations.collection.convolution_based import MiniRocket

    return _convolutions(MiniRocket(n_jobs=1, random_state=0), train)


def rocket(train: Array) -> Transform:
    """Maxima and shares of positive values after 10,000 random kernels, without normalising the series."""
    from aeon.transformations.collection.convolution_based import Rocket

    return _convolutions(Rocket(normalise=False, n_jobs=1, random_state=0), train)


def _convolutions(kernels: Any, train: Array) -> Transform:
    kernels.fit(train[:, None, :].astype(np.float32))
    return lambda frames: np.asarray(kernels.transform(frames[:, None, :].astype(np.float32)))


def _feature_classifiers() -> dict[str, Any]:
    clean = [SimpleImputer(strategy="median"), VarianceThreshold()]
    return {
        "forest": make_pipeline(*clean, RandomForestClassifier(500, n_jobs=1, random_state=0)),
        "ridge": make_pipeline(*clean, StandardScaler(), RidgeClassifierCV(_ALPHAS)),
    }


def _kernel_classifiers() -> dict[str, Any]:
    return {"ridge": make_pipeline(StandardScaler(with_mean=False), RidgeClassifierCV(_ALPHAS))}


class Peer(NamedTuple):
    """A package, the function that prepares its features from training signals, and its usual classifiers."""

    package: str
    prepare: Callable[[Array], Transform]
    classifiers: Callable[[], dict[str, Any]]
    learns: bool = False  # the features depend on the training signals


#: By name, slow ones first, so that none runs alone at the end.
PEERS: dict[str, Peer] = {
    "tsfresh": Peer("tsfresh", tsfresh, _feature_classifiers),
    "Rocket": Peer("aeon", rocket, _kernel_classifiers, learns=True),
    "tsfel": Peer("tsfel", tsfel, _feature_classifiers),
    "pycatch22": Peer("pycatch22", pycatch22, _feature_classifiers),
    "MiniRocket": Peer("aeon", minirocket, _kernel_classifiers, learns=True),
    "aeon catch22": Peer("aeon", aeon_catch22, _feature_classifiers),
}


def sound(table: Array) -> Array:
    """Replace non-finite features by nan, and clip the others to the range of a forest's float32."""
    return np.where(np.isfinite(table), np.clip(table, -1e30, 1e30), np.nan)


def table_of(transform: Transform, frames: Array) -> Array:
    """Return the features of many frames, computed in chunks."""
    return np.concatenate([transform(frames[first : first + CHUNK]) for first in range(0, len(frames), CHUNK)])


def chosen(candidates: dict[str, Any], table: Array, labels: Array) -> str:
    """Return the name of the best classifier in cross-validation on the training signals."""
    if len(candidates) == 1:
        return next(iter(candidates))
    return max(candidates, key=lambda name: cross_val_score(candidates[name], table, labels, cv=FOLDS).mean())


class Contest:
    """One peer of `PEERS` on one frame of `FRAMES`; `folder` holds the signals."""

    def __init__(self, name: str, frame: str, folder: Path) -> None:
        self.name, self.frame, self.folder = name, frame, folder
        self.peer, self.classifiers = PEERS[name], PEERS[name].classifiers()

    def signals(self, kind: str, *place: int | slice) -> Array:
        """Return frames as the peer receives them."""
        return rows(self.folder, kind, *place)[..., FRAMES[self.frame]].astype(np.float64)

    def trained(self, number: int, choice: str = "") -> dict[str, Any]:
        """Return transform and classifier fitted to a set of training signals, with their times."""
        train, labels = self.signals("train", number), rows(self.folder, "train_labels", number)
        transform, preparation = timed(self.peer.prepare, train)
        table, seconds = timed(table_of, transform, train)
        table = sound(table)
        choice = choice or chosen(self.classifiers, table, labels)
        classifier, fit = timed(clone(self.classifiers[choice]).fit, table, labels)
        return {
            "transform": transform,
            "classifier": classifier,
            "choice": choice,
            "fit": preparation + fit,
            "a_signal": seconds / len(train),
        }

    def answers(self, trained: dict[str, Any], n: int, tables: list[Array]) -> dict[str, Any]:
        """Answer the first n test signals and return answers and times; `tables` caches the features."""
        predictions, features, predict = [], 0.0, 0.0
        for k, first in enumerate(range(0, n, CHUNK)):
            if k == len(tables):
                frames = self.signals("test", slice(first, min(first + CHUNK, n)))
                table, seconds = timed(trained["transform"], frames)
                tables += [sound(table)]
                features += seconds
            found, seconds = timed(trained["classifier"].predict, tables[k])
            predictions += found.tolist()
            predict += seconds
            if self.peer.learns:
                tables[k] = np.empty(0)  # large, and useless for another training set
        return {"predictions": predictions, "features": features / n, "predict": predict / n}

    def run(self, seconds: float, least: int, most: int, sets: int) -> dict[str, Any]:
        """Return all measurements.

        `seconds` is the processor time for test signals; more training sets get half as much again. `least` and `most`
        limit the number of test signals. `sets` training sets are used if time allows all of them, otherwise one.
        """
        self.peer.prepare(self.signals("train", 0, slice(20)))(self.signals("train", 0, slice(20)))  # compiles
        trained = self.trained(0)
        n = int(np.clip(seconds / trained["a_signal"], least, most))
        tables: list[Array] = []
        answer = self.answers(trained, n, tables)
        truth = rows(self.folder, "test_labels", slice(n))
        accuracies = [float(np.mean(np.array(answer["predictions"]) == truth))]
        size = len(rows(self.folder, "train_labels", 0))
        another = size * answer["features"] + trained["fit"] + n * answer["predict"]
        another += n * answer["features"] if self.peer.learns else 0
        if (sets - 1) * another <= 1.5 * seconds:
            for number in range(1, sets):
                other = self.trained(number, trained["choice"])
                found = self.answers(other, n, [] if self.peer.learns else tables)
                accuracies.append(float(np.mean(np.array(found["predictions"]) == truth)))
        return {
            "name": self.name,
            "version": f"{self.peer.package} {version(self.peer.package)}",
            "frame": self.frame,
            "classifier": trained["choice"],
            "fit": trained["fit"],
            **answer,
            "accuracies": accuracies,
            "memory": peak_memory(),
        }


def main() -> None:
    """Run one peer on one frame and write the results as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=PEERS)
    parser.add_argument("frame", choices=FRAMES)
    parser.add_argument("folder", type=Path)
    parser.add_argument("answer", type=Path)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--least", type=int, default=500)
    parser.add_argument("--most", type=int, default=20_000)
    parser.add_argument("--sets", type=int, default=10)
    a = parser.parse_args()
    answer = Contest(a.name, a.frame, a.folder).run(a.seconds, a.least, a.most, a.sets)
    a.answer.write_text(json.dumps(answer))


if __name__ == "__main__":
    main()
