"""Random numbers by address: (seed, purpose, block of 256 samples) always gives the same ones.

Philox is a counter-based generator (Salmon et al. 2011): its key is the seed and the purpose, its counter the
block and, of a stream, the recording, so a sample comes out the same whatever the shard, the worker or the order.
White noise, of which there is far more, has a kernel of its own (`cgid.scene.noise`), Philox as well.
"""

from __future__ import annotations

import numpy as np

from cgid.errors import InvalidValue
from cgid.validation import Floats

#: Samples that share one address.
BLOCK = 256
#: What numbers are drawn for; a new purpose is a new number.
PARAMETERS, NOISE, TAPS, SECOND_HITS, CLIPPING, RANDOMISED = 1, 2, 3, 4, 5, 6
IMPACT_POINTS, ARRIVALS, HUM, COLOURED, RECORDED = 16, 17, 18, 19, 20


def require_seed(seed: int) -> None:
    """Raise `InvalidValue` if the seed is not within 0 and 2^63 - 1."""
    if not 0 <= seed < 2**63:
        raise InvalidValue(f"seed must lie between 0 and 2^63 - 1, got {seed}")


def generator(seed: int, purpose: int, block: int, recording: int = 0) -> np.random.Generator:
    """Return the generator of one address; raises as `require_seed`. `recording` numbers those of a stream."""
    require_seed(seed)
    key = np.array([seed, purpose], np.uint64)
    # The lower two words count what is drawn.
    counter = np.array([0, 0, recording, block], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def uniforms(seed: int, block: int, n_kinds: int, purpose: int = PARAMETERS, recording: int = 0) -> Floats:
    """Return uniform numbers strictly between 0 and 1, (n_kinds, `BLOCK`), for one purpose in one block."""
    raw = generator(seed, purpose, block, recording).random((BLOCK, n_kinds)).T
    return np.asarray(np.clip(raw, 2.0**-54, None))
