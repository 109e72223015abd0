"""The residual of a fitted damped-Hertz pulse: principal components of other laws of loss, and the unexplained part.

`tests/references/make_shapes.py` makes the components, in the bins of `cgid.measure.fit.search`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cgid._lib.validation import Floats
from cgid.measure.fit.search import BIN, N_BINS, NODES, Bins, Samples, bank
from cgid.measure.fit.template import SHAPES_PATH, relative_times

#: Root mean square that the components leave unexplained in pulses of other laws, over the peak.
SHAPE_ERROR = 0.01
#: Components that describe how a pulse differs from the family, see `tests/references/make_shapes.py`.
N_SHAPES = 4


def residual_bins(
    samples: Samples, peak: Floats, width: Floats, onset: Floats, shape: Floats
) -> tuple[Bins, Floats, NDArray[np.intp]]:
    """Return samples minus fitted pulse, over its peak, in bins around it, their unit (n,), and the nearest `NODES`."""
    node = np.argmin(np.abs(NODES - shape[:, None]), axis=1)
    bin_peak_time, bin_width = bank().conditions(shape)
    unit = width / bin_width
    origin = onset + relative_times(shape)[1] * width - bin_peak_time * unit
    bins = samples.bins(origin, unit, np.arange(len(peak)))
    # The pulses averaged over the bins: a parabola through three nodes of the bank.
    middle = np.clip(node, 1, NODES.size - 2)
    before, at, after = NODES[middle - 1], NODES[middle], NODES[middle + 1]
    shares = (
        (shape - at) * (shape - after) / ((before - at) * (before - after)),
        (shape - before) * (shape - after) / ((at - before) * (at - after)),
        (shape - before) * (shape - at) / ((after - before) * (after - at)),
    )
    pulses = bank().basis[:, :, 0]
    fitted = sum(share[:, None] * pulses[middle + k] for share, k in zip(shares, (-1, 0, 1), strict=True))
    left = bins.values / peak[:, None] - fitted
    return Bins(left if bins.inside is None else np.where(bins.inside, left, 0.0), bins.inside), unit, node


@cache
def _components() -> tuple[Floats, Floats, Floats, Floats]:
    """Return designs (tangents, components), their pseudo-inverses' last rows, orthonormal bases, and the spreads."""
    with np.load(SHAPES_PATH, allow_pickle=False) as stored:
        components, spreads = stored["components"], stored["spreads"]
    design = np.concatenate([bank().tangents, np.broadcast_to(components.T, (NODES.size, *components.T.shape))], axis=2)
    return design, np.linalg.pinv(design)[:, 4:], np.linalg.qr(design)[0], spreads


@dataclass(frozen=True, eq=False, repr=False)
class Residual:
    """The residual of a fitted damped-Hertz pulse."""

    components: Floats  # over the peak, (n, N_SHAPES), shrunk towards 0 in noise
    unexplained: Floats  # mean square of the rest over that expected of noise and `SHAPE_ERROR`, (n,)


def fit_residual(
    samples: Samples, peak: Floats, width: Floats, onset: Floats, shape: Floats, noise: Floats
) -> Residual:
    """Return the components of the residuals of fitted pulses; `noise` (n,) is a standard deviation."""
    bins, unit, node = residual_bins(samples, peak, width, onset, shape)
    left = bins.values
    designs, inverses, bases, spreads = _components()
    per_bin = (noise / peak) ** 2 / np.maximum(BIN * unit, 1.0)
    count = np.full(len(left), float(N_BINS))
    amplitudes = np.einsum("nkb,nb->nk", inverses[node], left)
    explained = np.sum(np.einsum("nbk,nb->nk", bases[node], left) ** 2, axis=1)
    if bins.inside is not None and (partial := bins.partial).size:
        inside = bins.inside[partial]
        design = designs[node[partial]] * inside[:, :, None]
        information = np.matmul(np.swapaxes(design, 1, 2), design)
        right = np.einsum("nbk,nb->nk", design, left[partial])
        # Missing bins leave some components undetermined; these are 0.
        prior = np.concatenate([np.full(4, 1e-9), 1e-4 / spreads**2])
        all_amplitudes = np.linalg.solve(information + np.diag(prior), right[..., None])[..., 0]
        amplitudes[partial], explained[partial] = all_amplitudes[:, 4:], np.sum(all_amplitudes * right, axis=1)
        count[partial] = inside.sum(axis=1)
    unexplained = np.maximum(np.sum(left**2, axis=1) - explained, 0.0)
    certain = spreads**2 / (spreads**2 + per_bin[:, None])
    free = np.maximum(count - 4 - N_SHAPES, 1.0)
    return Residual(amplitudes * certain, unexplained / (free * (per_bin + SHAPE_ERROR**2)))
