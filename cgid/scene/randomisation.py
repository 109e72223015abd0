"""What a scene draws once for each block: another rig for every 256 signals."""

from __future__ import annotations

from cgid.scene.randomness import RANDOMISED, uniforms
from cgid.scene.scene import Scene

#: A low-pass whose edge lies above this part of the sampling rate would cut into what the frame cannot hold anyway
#: (its own edge is half as wide as its frequency): the sensor then counts as unlimited.
UNLIMITED = 0.45
#: One number each; a new one goes to the end.
_KINDS = ("sampling_rate", "relative_noise", "bandwidth")


def settled(scene: Scene, seed: int, block: int) -> Scene:
    """Return the scene as it holds in one block: what is randomised is drawn; the scene itself if nothing is."""
    if scene.randomise is None:
        return scene
    numbers = dict(zip(_KINDS, uniforms(seed, block, len(_KINDS), RANDOMISED)[:, :1], strict=True))
    values = {name: float(law.quantile(numbers[name])[0]) for name, law in scene.randomise.laws.items()}
    sampling_rate = values.get("sampling_rate", scene.sampling.sampling_rate)
    bandwidth = values.get("bandwidth", scene.sensor.bandwidth)
    sensor = {
        "relative_noise": values.get("relative_noise", scene.sensor.relative_noise),
        "bandwidth": None if bandwidth is None or bandwidth > UNLIMITED * sampling_rate else bandwidth,
    }
    return scene.model_copy(
        update={
            "sampling": scene.sampling.model_copy(update={"sampling_rate": sampling_rate}),
            "sensor": scene.sensor.model_copy(update=sensor),
            "randomise": None,
        }
    )
