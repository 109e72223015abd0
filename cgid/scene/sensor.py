"""The sensor: what becomes of the true force on its way into the frame."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cgid.filters import fft_filter
from cgid.scene.units import Force, Frequency, Level, Ratio, Whole
from cgid.validation import Floats


class Sensor(BaseModel):
    """A force sensor.

    The order is that of a measuring chain: bandwidth, noise, range, bits. Each stage is off when left out.

    Parameters
    ----------
    relative_noise : float
        Standard deviation of the white noise over the peak of each pulse.
    absolute_noise : float
        Standard deviation of the white noise [N]. Both together add in power.
    bandwidth : float, optional
        Edge of a zero-phase low-pass [Hz], gain 1/2 there, with a raised-cosine edge half as wide.
    range : float, optional
        Full scale [N]: what lies beyond +- this is clipped.
    bits : int, optional
        Of the converter over its full scale; needs `range`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    relative_noise: Ratio = Field(default=0.0, ge=0, le=1e6)
    absolute_noise: Level = 0.0
    bandwidth: Frequency | None = None
    range: Force | None = None
    bits: Whole | None = Field(default=None, ge=2, le=32)

    @model_validator(mode="after")
    def _bits_need_a_range(self) -> Self:
        if self.bits is not None and self.range is None:
            raise ValueError("bits must come with range: without a full scale there is no step")
        return self

    @property
    def noisy(self) -> bool:
        """Whether there is any noise to draw."""
        return self.relative_noise > 0 or self.absolute_noise > 0

    def noise_level(self, peak_force: Floats) -> Floats:
        """Return the standard deviation of the noise [N] for pulses of these peaks [N]."""
        return np.hypot(self.relative_noise * peak_force, self.absolute_noise)

    def limit_band(self, frames: NDArray[np.floating], sampling_rate: float) -> NDArray[np.floating]:
        """Return the frames after the sensor's low-pass."""
        if self.bandwidth is None:
            return frames
        return fft_filter(frames, sampling_rate, high=self.bandwidth, taper=0.5)

    def digitise(self, frames: NDArray[np.floating]) -> None:
        """Clip and round the frames in place, as far as the sensor has a range and bits."""
        if self.range is None:
            return
        highest = self.range
        if self.bits is not None:
            step = self.range / 2 ** (self.bits - 1)
            np.multiply(np.rint(frames / step), step, out=frames)
            highest = self.range - step
        np.clip(frames, -self.range, highest, out=frames)


def clip(frames: NDArray[np.floating], level: Floats) -> None:
    """Cut each frame off at +- its own level in place; a level of nan leaves it as it is."""
    rows = np.flatnonzero(np.isfinite(level))
    height = level[rows, None].astype(frames.dtype)
    frames[rows] = np.clip(frames[rows], -height, height)
