"""White noise by address: every sample of every signal has a number of its own, drawn only where it is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cgid.counting import count
from cgid.errors import InvalidValue
from cgid.scene._noise import LANES, TILE, add_normal
from cgid.scene.randomness import NOISE, require_seed
from cgid.validation import Floats

#: Samples of a signal that have an address: 93 hours at 51.2 kHz.
MOST_SAMPLES = TILE // LANES << 32
#: No sample of the noise is higher, in standard deviations: sqrt(2 ln 2^33) = 6.764, and room for rounding.
HIGHEST_NOISE = 6.77


def add_noise(
    frames: NDArray[Any], level: Floats, seed: int, block: int, *, first_sample: int = 0, purpose: int = NOISE
) -> None:
    """Add white Gaussian noise to frames, in place.

    The noise of a sample depends on the seed, the purpose, the block, the row and the number of the sample only: a
    window of a signal, or a long recording piece by piece, has the noise that the whole would have. It is drawn in
    tiles of 512 samples, in float32 whatever the frames hold; its tails end at 6.7 standard deviations. Python's lock
    is free meanwhile.

    Parameters
    ----------
    frames : (n, n_samples) array of float32 or float64
        Signals, or a window of each.
    level : (n,) array
        Standard deviation of each, in the unit of the frames.
    seed : int
        Between 0 and 2^63 - 1.
    block : int
        Number of the block of signals, or of the recording.
    first_sample : int
        Where the window begins within its signals.
    purpose : int
        What the noise is for, a number of `cgid.scene.randomness`; another purpose is other noise.

    Raises
    ------
    InvalidValue
        The seed, the block or the window is out of range.

    Examples
    --------
    >>> whole, window = np.zeros((1, 1000)), np.zeros((1, 10))
    >>> add_noise(whole, np.ones(1), seed=1, block=0)
    >>> add_noise(window, np.ones(1), seed=1, block=0, first_sample=700)
    >>> bool((whole[:, 700:710] == window).all())
    True
    """
    require_seed(seed)
    count("noise_samples", frames.size)
    if not 0 <= block < 2**56:
        raise InvalidValue(f"block must lie between 0 and 2^56 - 1, got {block}")
    if first_sample < 0 or first_sample + frames.shape[1] > MOST_SAMPLES:
        raise InvalidValue(
            f"samples with noise must lie between 0 and {MOST_SAMPLES - 1}, got {first_sample} to "
            f"{first_sample + frames.shape[1] - 1}"
        )
    # The last word of the counter holds the purpose and what the block has above 32 bits.
    high = purpose << 24 | block >> 32
    words = [np.uint64(word) for word in (block & 0xFFFFFFFF, high, seed & 0xFFFFFFFF, seed >> 32)]
    add_normal(frames, np.asarray(level, frames.dtype), first_sample, *words)
