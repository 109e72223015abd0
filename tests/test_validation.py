"""What every entrance that takes numbers refuses: masks, arrays for one number, rates of no recorder."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cgid import Impact, Signal, Sphere, extract, fft_filter
from cgid._lib import validation
from cgid.errors import InvalidValue
from cgid.identification.detection import ImpactDetector
from cgid.measure.overview import OverviewStream
from cgid.physics import RIGID, STEEL, Elastic, HuntCrossley, Material, ThinPlate
from cgid.recordings import open_recording
from studies.impactor.estimation import estimate
from studies.impactor.likelihood import cramer_rao_bound

RATE = 2e5
PULSE = 800 * np.sin(np.pi * np.clip((np.arange(400) / RATE - 6e-4) / 5e-4, 0, 1)) ** 1.5
IMPACT = Impact(
    sphere=Sphere(material=STEEL, radius=0.025), target=RIGID, velocity=2.0, stiffness="hertz", dissipation=Elastic()
)

SAMPLES: dict[str, Callable[[Any], object]] = {
    "Signal": lambda samples: Signal(samples=samples, sampling_rate=RATE),
    "extract": lambda samples: extract(samples, RATE),
    "fft_filter": lambda samples: fft_filter(samples, RATE),
    "estimate": lambda samples: estimate(samples, RATE),
    "ImpactDetector": lambda samples: ImpactDetector(RATE, kind="pulse").feed(samples),
    "OverviewStream": lambda samples: OverviewStream(RATE).feed(samples[None]),
    "times": IMPACT.force,
    "noise": lambda noise: estimate(np.tile(PULSE, (400, 1)), RATE, noise=noise),
    "radius": lambda radius: Sphere(material=STEEL, radius=radius),
    "velocity": lambda velocity: free_fall(velocity),
    "thickness": lambda thickness: ThinPlate(material=STEEL, thickness=thickness),
    "density": lambda density: Material(density=density, youngs_modulus=2e11, poisson_ratio=0.3),
    "restitution": lambda restitution: HuntCrossley(restitution=restitution),
    "contact_duration": lambda duration: cramer_rao_bound(duration, 0.5, 0.01, RATE),
    "a list": lambda samples: fft_filter([samples, samples], RATE),
}
ONE_NUMBER: dict[str, Callable[[Any], object]] = {
    "Signal": lambda rate: Signal(samples=PULSE, sampling_rate=rate),
    "extract": lambda rate: extract(PULSE, rate),
    "fft_filter": lambda rate: fft_filter(PULSE, rate),
    "estimate": lambda rate: estimate(PULSE, rate),
    "ImpactDetector": lambda rate: ImpactDetector(rate, kind="pulse"),
    "OverviewStream": OverviewStream,
    "open_recording": lambda rate: open_recording("none.npy", sampling_rate=rate),
}


def free_fall(velocity: Any) -> Impact:
    return Impact(sphere=IMPACT.sphere, target=RIGID, velocity=velocity, stiffness="hertz", dissipation=Elastic())


@pytest.mark.parametrize("entrance", SAMPLES)
def test_masked_numbers_are_refused(entrance):
    masked = np.ma.array(PULSE, mask=np.arange(400) % 200 == 7)
    with pytest.raises(InvalidValue, match=r"must have no masked numbers, got [24] of [48]00; cut them out"):
        SAMPLES[entrance](masked)


def test_a_mask_that_hides_nothing_is_no_mask():
    for mask in (False, np.zeros(400, bool)):
        assert (fft_filter(np.ma.array(PULSE, mask=mask), RATE) == fft_filter(PULSE, RATE)).all()
        assert type(Signal(samples=np.ma.array(PULSE, mask=mask), sampling_rate=RATE).samples) is np.ndarray


@pytest.mark.parametrize("entrance", ONE_NUMBER)
@pytest.mark.parametrize("rate", [np.array([RATE, RATE]), np.array([RATE]), [RATE], []], ids=str)
def test_an_array_is_no_sampling_rate(entrance, rate):
    with pytest.raises(InvalidValue, match=r"sampling_rate must be one number, got an array of shape \("):
        ONE_NUMBER[entrance](rate)


@pytest.mark.parametrize("entrance", [*ONE_NUMBER, "cramer_rao_bound"])
@pytest.mark.parametrize("rate", [1e-300, 1e-7, 1e13, 1e300, np.inf, np.nan, 0.0, -1.0, "2e5", "endless"])
def test_no_recorder_has_such_a_sampling_rate(entrance, rate):
    entrances = ONE_NUMBER | {"cramer_rao_bound": lambda given: cramer_rao_bound(1e-3, 0.5, 0.01, given)}
    with pytest.raises(InvalidValue, match="sampling_rate must"):
        entrances[entrance](10**5000 if rate == "endless" else rate)


@pytest.mark.parametrize("rate", [1e-6, 1.0, 1e12])
def test_features_of_a_pulse_are_numbers_at_the_slowest_and_the_fastest_rate(rate):
    assert np.isfinite(extract(PULSE, rate).to_numpy()).all()
    assert np.isfinite(estimate(PULSE, rate).covariance).all()


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: validation.count("n", np.ma.array(3, mask=True)), "whole number of 1 or more"),
        (lambda: validation.count("n", np.array([3])), "whole number of 1 or more"),
        (lambda: validation.number("x", np.ma.masked), "masked"),
        (lambda: validation.real("x", np.array([["a"] * 50] * 50)), r"got array\(.{0,80}\.\.\.$"),
        (lambda: fft_filter(PULSE, RATE, high=[1e4, 2e4]), "high must be one number"),
        (lambda: fft_filter(PULSE, RATE, taper=np.array([0.5])), "taper must be one number"),
        (lambda: fft_filter(PULSE, RATE, taper=1.5), "taper must be between 0 and 1, got 1.5"),
        (lambda: ImpactDetector(RATE, kind="pulse", dead_time=np.array([1e-3, 2e-3])), "dead_time must be one number"),
        (lambda: Signal(samples=PULSE, sampling_rate=RATE, pre_trigger=-1), "pre_trigger .* between 0 and 399, got -1"),
    ],
)
def test_what_breaks_a_rule_is_named(call, says):
    with pytest.raises(InvalidValue, match=says):
        call()
