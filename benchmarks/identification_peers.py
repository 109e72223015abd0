"""Alternatives to cgid's features and classifier: other packages on the same signals.

`identification.py` starts one process per peer and frame, in an environment that need not contain cgid:

    python identification_peers.py NAME FRAME FOLDER ANSWER.json

FOLDER holds train.npy (sets, signals, samples), test.npy (signals, samples) and their labels. Every peer gets the
settings that help it. The catch22 sets include mean and deviation (catch24), because the size of the force is
informative. Rocket does not normalise the series, for the same reason (on the pulse alone .88 instead of .84). Feature
sets are followed by the better of random forest and ridge in cross-validation on the training signals. Rocket and
MiniRocket are followed by the scaled ridge of aeon's own classifiers, separated so that features and answers are timed
individually. Times are processor times, not wall-clock, after a first call that compiles.

The rivals learn from more signals. Boosters receive cgid's features (frame "features") and keep their own settings. The
others receive the pulse and answer from it directly, so that all of their time is that of the answer: MultiRocket-HYDRA
as aeon has it, which does not normalise; a convolutional network of 81,000 weights; and InceptionTime with the layers
of Ismail Fawaz et al. (2020, doi:10.1007/s10618-020-00710-y), one network of their five, and fewer epochs than their
1,500. Both networks receive the pulse over its height, and the logarithm of the height as a second channel; a tenth of
the signals is held out, and the weights of the epoch with the least loss there are kept.
"""

from __future__ import annotations

import argparse
import copy
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
from sklearn.base import BaseEstimator, ClassifierMixin, clone
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
#: Instead of samples, cgid's features.
FEATURES = "features"
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


def _as_they_are(_: Array) -> Transform:
    return lambda table: table


def _series(train: Array) -> Transform:
    """Series of one channel in units of the standard deviation of the training signals."""
    unit = train.std()
    return lambda frames: (frames[:, None, :] / unit).astype(np.float32)


def _lightgbm() -> dict[str, Any]:
    from lightgbm import LGBMClassifier

    return {"boosting": LGBMClassifier(n_jobs=1, random_state=0, verbose=-1)}


def _catboost() -> dict[str, Any]:
    from catboost import CatBoostClassifier

    return {"boosting": CatBoostClassifier(thread_count=1, random_seed=0, verbose=0, allow_writing_files=False)}


def _multirocket_hydra() -> dict[str, Any]:
    from aeon.classification.convolution_based import MultiRocketHydraClassifier

    return {"ridge": MultiRocketHydraClassifier(n_jobs=1, random_state=0)}


def convolutional() -> Any:
    """Return four convolutions of stride 2 and a hidden layer, 81,000 weights."""
    from torch import nn

    layers: list[Any] = []
    for before, after, width in ((2, 32, 9), (32, 48, 7), (48, 64, 5), (64, 64, 5)):
        layers += [nn.Conv1d(before, after, width, 2, width // 2), nn.BatchNorm1d(after), nn.ReLU()]
    head = (nn.AdaptiveAvgPool1d(8), nn.Flatten(), nn.Linear(8 * 64, 64), nn.ReLU(), nn.Linear(64, 2))
    return nn.Sequential(*layers, *head)


def inception(filters: int = 32) -> Any:
    """Return one InceptionTime network: six modules, a residual connection around each three, 407,000 weights."""
    import torch
    from torch import nn

    class Module(nn.Module):  # type: ignore[misc]
        def __init__(self, before: int) -> None:
            super().__init__()
            inner = filters if before > 2 else before
            self.bottleneck = nn.Conv1d(before, filters, 1, bias=False) if before > 2 else nn.Identity()
            widths = (39, 19, 9)
            self.branches = nn.ModuleList(nn.Conv1d(inner, filters, w, padding=w // 2, bias=False) for w in widths)
            self.pooled = nn.Sequential(nn.MaxPool1d(3, 1, 1), nn.Conv1d(before, filters, 1, bias=False))
            self.end = nn.Sequential(nn.BatchNorm1d(4 * filters), nn.ReLU())

        def forward(self, x: Any) -> Any:
            inner = self.bottleneck(x)
            return self.end(torch.cat([*(branch(inner) for branch in self.branches), self.pooled(x)], 1))

    class Three(nn.Module):  # type: ignore[misc]
        def __init__(self, before: int) -> None:
            super().__init__()
            self.path = nn.Sequential(*(Module(width) for width in (before, 4 * filters, 4 * filters)))
            self.around = nn.Sequential(nn.Conv1d(before, 4 * filters, 1, bias=False), nn.BatchNorm1d(4 * filters))

        def forward(self, x: Any) -> Any:
            return torch.relu(self.path(x) + self.around(x))

    mean = (nn.AdaptiveAvgPool1d(1), nn.Flatten(), nn.Linear(4 * filters, 2))
    return nn.Sequential(Three(2), Three(4 * filters), *mean)


class Network(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A network of PyTorch: AdamW, one cycle of the rate; `epochs` 0: 40 of 1,500 signals, fewer of more.

    A tenth is held out; `curve_` is its loss after each epoch, and the weights of the least are kept.
    """

    def __init__(self, build: Callable[[], Any], epochs: int = 0, batch: int = 64, rate: float = 3e-3) -> None:
        self.build, self.epochs, self.batch, self.rate = build, epochs, batch, rate

    def fit(self, frames: Array, labels: Array) -> Network:
        """Fit to signals (n, samples)."""
        import torch

        torch.set_num_threads(1)
        torch.manual_seed(0)
        self.classes_, numbers = np.unique(labels, return_inverse=True)
        heights = np.log(np.abs(frames).max(1))
        self.scale_ = heights.mean(), heights.std()
        x, y = self._channels(frames), torch.from_numpy(numbers)
        self.net_, loss = self.build(), torch.nn.functional.cross_entropy
        held, own = torch.randperm(len(frames)).tensor_split([len(frames) // 10])
        n = len(own)
        epochs = self.epochs or round(40 * (1500 / len(frames)) ** 0.5)
        batch = self.batch if n < 10_000 else 4 * self.batch
        steps = -(-n // batch)
        optimiser = torch.optim.AdamW(self.net_.parameters(), weight_decay=0.01)
        cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, self.rate, total_steps=epochs * steps)
        self.curve_, best = [], {}
        for _ in range(epochs):
            self.net_.train()
            for chosen in own[torch.randperm(n)].tensor_split(steps):
                optimiser.zero_grad()
                loss(self.net_(x[chosen]), y[chosen]).backward()
                optimiser.step()
                cycle.step()
            self.net_.eval()
            self.curve_.append(float(loss(self._answers(x[held]), y[held])))
            if self.curve_[-1] == min(self.curve_):
                best = copy.deepcopy(self.net_.state_dict())
        self.net_.load_state_dict(best)
        return self

    def _answers(self, x: Any) -> Any:
        import torch

        with torch.no_grad():
            return torch.cat([self.net_(part) for part in x.split(CHUNK)])

    def _channels(self, frames: Array) -> Any:
        import torch

        height = np.abs(frames).max(1, keepdims=True)
        size = (np.log(height) - self.scale_[0]) / self.scale_[1]
        return torch.from_numpy(np.stack([frames / height, np.broadcast_to(size, frames.shape)], 1).astype(np.float32))

    def predict_proba(self, frames: Array) -> Array:
        """Return probabilities of the labels of signals (n, samples)."""
        return np.asarray(self._answers(self._channels(frames)).softmax(1).numpy())

    def predict(self, frames: Array) -> Array:
        """Return labels of signals (n, samples)."""
        return np.asarray(self.classes_[self.predict_proba(frames).argmax(1)])


class Peer(NamedTuple):
    """A package, the function that prepares its features from training signals, and its usual classifiers."""

    package: str
    prepare: Callable[[Array], Transform]
    classifiers: Callable[[], dict[str, Any]]
    learns: bool = False  # the features depend on the training signals
    on_features: bool = False  # cgid's
    most: int = 150_000  # training signals of a rival
    most_test: int = 20_000


#: By name, slow ones first, so that none runs alone at the end.
PEERS: dict[str, Peer] = {
    "tsfresh": Peer("tsfresh", tsfresh, _feature_classifiers),
    "Rocket": Peer("aeon", rocket, _kernel_classifiers, learns=True),
    "tsfel": Peer("tsfel", tsfel, _feature_classifiers),
    "pycatch22": Peer("pycatch22", pycatch22, _feature_classifiers),
    "MiniRocket": Peer("aeon", minirocket, _kernel_classifiers, learns=True),
    "aeon catch22": Peer("aeon", aeon_catch22, _feature_classifiers),
}


#: By name; these learn from more signals than the peers.
RIVALS: dict[str, Peer] = {
    "LightGBM": Peer("lightgbm", _as_they_are, _lightgbm, on_features=True),
    "CatBoost": Peer("catboost", _as_they_are, _catboost, on_features=True),
    "1-D CNN": Peer("torch", _as_they_are, lambda: {"network": Network(convolutional)}),
    "MultiRocket-HYDRA": Peer("aeon", _series, _multirocket_hydra, most=5000, most_test=4000),
    "InceptionTime": Peer("torch", _as_they_are, lambda: {"network": Network(inception)}, most=5000, most_test=4000),
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
    """One peer or rival on one frame of `FRAMES`, or on features; `folder` holds the signals.

    `to_train` are the signals of a training set that it learns from, by default all; `epochs` those of a network.
    """

    def __init__(self, name: str, frame: str, folder: Path, to_train: int | None = None, epochs: int = 0) -> None:
        self.name, self.frame, self.folder, self.to_train = name, frame, folder, to_train
        self.peer = (PEERS | RIVALS)[name]
        self.classifiers = self.peer.classifiers()
        if epochs:
            self.classifiers["network"].set_params(epochs=epochs)

    def signals(self, kind: str, *place: int | slice) -> Array:
        """Return frames as the peer receives them."""
        if self.frame == FEATURES:
            return rows(self.folder, f"{kind}_features", *place)
        return rows(self.folder, kind, *place)[..., FRAMES[self.frame]].astype(np.float64)

    def trained(self, number: int, choice: str = "") -> dict[str, Any]:
        """Return transform and classifier fitted to a set of training signals, with their times."""
        part = slice(self.to_train)
        train, labels = self.signals("train", number, part), rows(self.folder, "train_labels", number, part)
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
            predictions += np.ravel(found).tolist()
            predict += seconds
            if self.peer.learns:
                tables[k] = np.empty(0)  # large, and useless for another training set
        return {"predictions": predictions, "features": features / n, "predict": predict / n}

    def probabilities(self) -> dict[str, Any]:
        """Return the probability of the last label for each test signal, whose truth need not be known."""
        trained, n, found = self.trained(0), len(rows(self.folder, "test", slice(None))), []
        for first in range(0, n, CHUNK):
            frames = self.signals("test", slice(first, min(first + CHUNK, n)))
            found += trained["classifier"].predict_proba(sound(trained["transform"](frames)))[:, 1].tolist()
        curve = getattr(trained["classifier"], "curve_", [])
        return {"name": self.name, "fit": trained["fit"], "curve": curve, "probabilities": found}

    def run(self, seconds: float, least: int, most: int, sets: int) -> dict[str, Any]:
        """Return all measurements.

        `seconds` is the processor time for test signals; more training sets get half as much again. `least` and `most`
        limit the number of test signals. `sets` training sets are used if time allows all of them, otherwise one.
        """
        self.peer.prepare(self.signals("train", 0, slice(20)))(self.signals("train", 0, slice(20)))  # compiles
        trained = self.trained(0)
        n = int(np.clip(seconds / max(trained["a_signal"], 1e-9), least, min(most, self.peer.most_test)))
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
            "curve": getattr(trained["classifier"], "curve_", []),
            **answer,
            "accuracies": accuracies,
            "memory": peak_memory(),
        }


def main() -> None:
    """Run one peer on one frame and write the results as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=PEERS | RIVALS)
    parser.add_argument("frame", choices=[*FRAMES, FEATURES])
    parser.add_argument("folder", type=Path)
    parser.add_argument("answer", type=Path)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--least", type=int, default=500)
    parser.add_argument("--most", type=int, default=20_000)
    parser.add_argument("--sets", type=int, default=10)
    parser.add_argument("--to-train", type=int, help="of a training set; default: all")
    parser.add_argument("--epochs", type=int, default=0, help="of a network")
    parser.add_argument("--probabilities", action="store_true", help="of all test signals, nothing else")
    a = parser.parse_args()
    contest = Contest(a.name, a.frame, a.folder, a.to_train, a.epochs)
    answer = contest.probabilities() if a.probabilities else contest.run(a.seconds, a.least, a.most, a.sets)
    a.answer.write_text(json.dumps(answer))


if __name__ == "__main__":
    main()
