"""Learners of another kind on the signals of `rivals.py`, which starts a process for each.

    python peers.py NAME FOLDER ANSWER.json

It runs in an environment that need not contain cgid. FOLDER holds signals and features, to train on and to answer, and
labels. Boosters receive cgid's features and keep their own settings. The others receive the pulse and answer from it
directly, so that all of their time is that of the answer: MultiRocket-HYDRA as aeon has it, which does not normalise; a
convolutional network of 81,000 weights; and InceptionTime with the layers of Ismail Fawaz et al. (2020,
doi:10.1007/s10618-020-00710-y), one network of their five, and fewer epochs than their 1,500. Both networks receive the
pulse over its height, and the logarithm of the height as a second channel; a tenth of the signals is held out, and the
weights of the epoch with the least loss there are kept.
"""

from __future__ import annotations

import argparse
import copy
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClassifierMixin

Array = NDArray[Any]

CHUNK = 250  # signals at a time


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Return the result of a call and its processor time [s], which excludes other processes."""
    start = time.process_time()
    result = function(*arguments)
    return result, time.process_time() - start


def rows(folder: Path, name: str, *place: int | slice) -> Array:
    return np.array(np.load(folder / f"{name}.npy", mmap_mode="r")[place])


def _lightgbm() -> Any:
    from lightgbm import LGBMClassifier

    return LGBMClassifier(n_jobs=1, random_state=0, verbose=-1)


def _catboost() -> Any:
    from catboost import CatBoostClassifier

    return CatBoostClassifier(thread_count=1, random_seed=0, verbose=0, allow_writing_files=False)


def _multirocket_hydra() -> Any:
    from aeon.classification.convolution_based import MultiRocketHydraClassifier

    class Series(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
        """It, on series of one channel in units of the standard deviation of the training signals."""

        def fit(self, frames: Array, labels: Array) -> Any:
            self.unit_ = frames.std()
            self.own_ = MultiRocketHydraClassifier(n_jobs=1, random_state=0).fit(self._series(frames), labels)
            return self

        def _series(self, frames: Array) -> Array:
            return (frames[:, None, :] / self.unit_).astype(np.float32)

        def predict(self, frames: Array) -> Array:
            return np.asarray(self.own_.predict(self._series(frames)))

        def predict_proba(self, frames: Array) -> Array:
            return np.asarray(self.own_.predict_proba(self._series(frames)))

    return Series()


def convolutional() -> Any:
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


class Rival(NamedTuple):
    """A package, its classifier, whether it learns from cgid's features, and the most signals it can do with."""

    package: str
    classifier: Callable[[], Any]
    on_features: bool = False
    most: int = 150_000
    most_test: int = 20_000


RIVALS: dict[str, Rival] = {
    "LightGBM": Rival("lightgbm", _lightgbm, on_features=True),
    "CatBoost": Rival("catboost", _catboost, on_features=True),
    "1-D CNN": Rival("torch", lambda: Network(convolutional)),
    "MultiRocket-HYDRA": Rival("aeon", _multirocket_hydra, most=5000, most_test=4000),
    "InceptionTime": Rival("torch", lambda: Network(inception), most=5000, most_test=4000),
}


def signals(folder: Path, kind: str, rival: Rival, n: int | None) -> Array:
    if not rival.on_features:
        return rows(folder, kind, slice(n)).astype(np.float64)
    table = rows(folder, f"{kind}_features", slice(n))
    return np.where(np.isfinite(table), np.clip(table, -1e30, 1e30), np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=RIVALS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("answer", type=Path)
    parser.add_argument("--most", type=int, default=20_000, help="signals to answer")
    parser.add_argument("--to-train", type=int, help="default: all")
    parser.add_argument("--epochs", type=int, default=0, help="of a network")
    parser.add_argument("--probabilities", action="store_true", help="of the last label, of all test signals")
    a = parser.parse_args()
    rival = RIVALS[a.name]
    classifier = rival.classifier()
    if a.epochs and isinstance(classifier, Network):
        classifier.set_params(epochs=a.epochs)
    training, labels = signals(a.folder, "train", rival, a.to_train), rows(a.folder, "train_labels", slice(a.to_train))
    classifier, fit = timed(classifier.fit, training, labels)
    test = signals(a.folder, "test", rival, None if a.probabilities else min(a.most, rival.most_test))
    answer = classifier.predict_proba if a.probabilities else classifier.predict
    parts = [test[first : first + CHUNK] for first in range(0, len(test), CHUNK)]
    answer(parts[0])  # compiles
    found, seconds = timed(lambda: [answer(part) for part in parts])
    record = {"name": a.name, "fit": fit, "predict": seconds / len(test), "curve": getattr(classifier, "curve_", [])}
    if a.probabilities:
        record["probabilities"] = np.concatenate(found)[:, 1].tolist()
    else:
        record["predictions"] = np.concatenate([np.ravel(part) for part in found]).tolist()
    a.answer.write_text(json.dumps(record))


if __name__ == "__main__":
    main()
