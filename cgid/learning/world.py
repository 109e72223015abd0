"""What recordings of the world of a training look like, so that a recording of another one can be told.

Simulated recordings are compared with each other as `cgid.identification.model.world` compares a recording: those of a
tenth with the others, so that the largest distance of each is exchangeable with that of a further one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from sklearn.covariance import ledoit_wolf
from threadpoolctl import threadpool_limits

from cgid._lib.validation import Floats
from cgid.identification.model.model import StoredModel
from cgid.identification.model.world import CHECKS, GROUPS, N_SUMMARY, World, powers, summary, trait_names

if TYPE_CHECKING:
    from cgid.learning.streams import StreamRows

#: Minimum number of recordings, of impacts of each, and the parts that are compared with the others in turn.
_MIN_RECORDINGS, _MIN_IMPACTS, _FOLDS = 8, 50, 10
#: Smallest standard deviation of a quantile.
_LEAST_SPREAD = 1e-3


def with_world(model: StoredModel, recordings: Iterable[tuple[Floats, float]], seed: int) -> StoredModel:
    """Return a model that tells recordings unlike these; the same model with too few of them.

    A recording has the `trait_names` of its impacts in order of time, (n, 5), and its fraction of gangue. One that is
    shorter than the last of `CHECKS` goes on with impacts drawn from its own.
    """
    rng = np.random.default_rng([seed, 31])
    parts = [(traits, fraction) for traits, fraction in recordings if len(traits) >= _MIN_IMPACTS]
    if len(parts) < _MIN_RECORDINGS:
        return model
    summaries = np.array([_summaries(traits, rng) for traits, _ in parts])
    fractions = np.array([fraction for _, fraction in parts])
    order = rng.permutation(len(parts)) % min(_FOLDS, len(parts))
    distances = np.empty((len(parts), len(CHECKS), len(GROUPS)))
    with threadpool_limits(1):
        for fold in np.unique(order):
            others = _world(summaries[order != fold], fractions[order != fold])
            distances[order == fold] = [_distances(others, one) for one in summaries[order == fold]]
        world = _world(summaries, fractions)
    centre, scale = distances.mean(axis=0), np.maximum(distances.std(axis=0), _LEAST_SPREAD)
    maxima = np.sort(((distances - centre) / scale).max(axis=(1, 2)))
    world = replace(world, centre=centre, scale=scale, maxima=maxima)
    told = {"n_recordings": len(parts), "rate": world.rate}
    return replace(model, arrays={**model.arrays, **world.arrays}, training={**model.training, "world": told})


def of_streams(streams: Iterable[StreamRows]) -> Iterator[tuple[Floats, float]]:
    """Yield simulated streams as recordings of `with_world`."""
    for stream in streams:
        yield stream.rows.columns(trait_names(stream.rows.names)), stream.fraction


def _summaries(traits: Floats, rng: np.random.Generator) -> Floats:
    """Return the summary after each of `CHECKS`, (n_checks, N_SUMMARY)."""
    more = traits[rng.integers(len(traits), size=max(CHECKS[-1] - len(traits), 0))]
    longer = np.concatenate([traits, more])
    return np.array([summary(longer[:n]) for n in CHECKS])


def _world(summaries: Floats, fractions: Floats) -> World:
    """Return the world of recordings with these summaries (n, n_checks, N_SUMMARY), with distances as they are."""
    design = powers(fractions)
    means, whitenings = [], []
    for column in np.moveaxis(summaries, 1, 0):
        mean = np.linalg.lstsq(design, column, rcond=None)[0]
        rest = column - design @ mean
        spread = np.maximum(rest.std(axis=0), _LEAST_SPREAD)
        whitening = np.zeros((N_SUMMARY, N_SUMMARY))
        for group in GROUPS:
            covariance = ledoit_wolf(rest[:, group] / spread[group])[0]
            whitening[group, group] = np.linalg.inv(np.linalg.cholesky(covariance)) / spread[group]
        means.append(mean)
        whitenings.append(whitening)
    zeros = np.zeros((len(CHECKS), len(GROUPS)))
    return World(
        mean=np.array(means), whitening=np.array(whitenings), centre=zeros, scale=zeros + 1, maxima=np.zeros(1)
    )


def _distances(world: World, summaries: Floats) -> Floats:
    """Return the distances of one recording, (n_checks, n_groups)."""
    return np.array([world.distances(check, one) for check, one in enumerate(summaries)])
