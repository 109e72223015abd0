"""The signals of a scene as several sensors of its beam record them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cgid.scene.file.schema import Scene
from cgid.scene.synthesis.draws import require_seed
from cgid.scene.synthesis.impacts import pulses_of_block
from cgid.scene.synthesis.plan import plan
from cgid.scene.synthesis.synthesis import batch_of, blocks, make_frames, require_count, require_frames
from cgid.scene.synthesis.through_beam import moved
from cgid.signals import Batch

#: Distance of the seeds of the noise of sensors that record together.
_NOISE_APART = 0x2545_F491_4F6C_DD1D


def recorded_together(
    scene: Scene, sensors: Sequence[tuple[float, float]], n_signals: int, seed: int = 0
) -> Iterator[Batch]:
    """Yield the signals of a scene as several sensors of its beam record them, each with noise of its own."""
    n_signals, _ = require_count(n_signals, 0)
    seed = require_seed(seed)
    require_frames(scene)
    plans = [plan(moved(scene, point), "frames") for point in sensors]
    for block, part in blocks(n_signals, 0):
        batches = []
        for number, one_plan in enumerate(plans):
            blows, noise_seed = pulses_of_block(one_plan, seed, block), (seed + number * _NOISE_APART) % 2**63
            batches.append(batch_of(one_plan.scene, blows, make_frames(blows, noise_seed, block, one_plan.dtype), part))
        yield replace(batches[0], signals=np.stack([batch.signals for batch in batches], axis=1), source=scene.sha256)
