"""The Bayes limit in noise that is not white, against brute force by dense covariances."""

import numpy as np
import pytest
import scipy

from cgid.errors import InvalidValue
from cgid.scene import parse_scene
from studies.ceilings.coloured import limits, maps, noise_of
from studies.ceilings.limit import ceiling
from studies.tests.test_limit import PAIR, collected, drawn_pulses, rocks
from tests import naive
from tests.test_scene import content


@pytest.fixture(autouse=True, scope="module")
def _few_draws():
    """An eighth of the draws that the density of a population is made of: enough for overlapping rocks, and quick."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("studies.ceilings.limit.PRIOR_DRAWS", 1 << 15)
        yield


def limit(scene, n_signals, seed):
    return limits(scene, n_signals, seed)[0]


HUM = {"hum": [{"frequency": 2000, "relative_amplitude": 0.3}]}
#: With a part that goes with the peak, and one that does not: some 5 % of the peaks of these rocks.
BOTH = {"coloured": {"frequencies": [100, 1e5], "density": [0.6, 0.2]}, "hum": [{"frequency": 700, "amplitude": 40}]}


def covariance(scene, peak):
    """Return the covariance of the samples of one frame, by the sum over the lines of its spectrum."""
    rate, n = scene.sampling.sampling_rate, scene.sampling.samples
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    period = 2 * n
    line = np.arange(period // 2 + 1) * rate / period
    waves = np.cos(2 * np.pi * line[:, None] * np.arange(n) / rate)
    level = scene.sensor.relative_noise * peak
    found = level**2 * np.eye(n)
    if scene.sensor.noise_exponent is not None:
        power = np.maximum(line, rate / n) ** -scene.sensor.noise_exponent
        power[0] /= 2
        found = level**2 * (power @ waves / power.sum())[lags]
    if scene.background is not None:
        for hum in scene.background.hum:
            amplitude = hum.amplitude or hum.relative_amplitude * peak
            found = found + amplitude**2 / 2 * np.cos(2 * np.pi * hum.frequency * lags / rate)
        if scene.background.coloured is not None:
            (low, high), (first, last) = BOTH["coloured"]["frequencies"], BOTH["coloured"]["density"]
            inside = (line >= low) & (line <= high)
            slope = np.log(last / first) / np.log(high / low)
            power = np.where(inside, first**2 * (np.maximum(line, low) / low) ** (2 * slope), 0.0) * rate / period
            found = found + (power @ waves)[lags]
    return found


COLOURS = {
    "pink": {"sensor": {"relative_noise": 0.15, "noise_exponent": 1.0}},
    "brown and low-pass": {"sensor": {"relative_noise": 0.2, "noise_exponent": 2.0, "bandwidth": "40 kHz"}},
    "hum": {"sensor": {"relative_noise": 0.1}, "background": HUM},
    "two levels": {"sensor": {"relative_noise": 0.05}, "background": BOTH},
}


@pytest.mark.long
@pytest.mark.parametrize("colour", list(COLOURS))
def test_ceiling_in_coloured_noise_is_brute_force(colour, monkeypatch):
    monkeypatch.setattr("studies.ceilings.limit.PRIOR_DRAWS", 1 << 18)
    scene = rocks(*PAIR, **COLOURS[colour])
    signals, peak = collected(scene, 16, seed=42)
    expected = []
    for samples, height in zip(signals, peak, strict=True):
        white = np.linalg.inv(np.linalg.cholesky(covariance(scene, height))).T
        logs, errors = zip(
            *(naive.log_evidence(samples @ white, 1.0, drawn_pulses(scene.text, index) @ white) for index in (0, 1)),
            strict=True,
        )
        share = 1 / (1 + np.exp(logs[1] - logs[0]))
        expected.append((share, share * (1 - share) * np.hypot(*errors)))
    expected, error = np.array(expected).T
    apart = np.abs(limit(scene, 16, seed=42).probabilities[:, 0] - expected)
    assert np.sqrt(np.mean(apart**2)) < 0.03
    assert (apart < 4 * error + 0.06).all()


@pytest.mark.parametrize("colour", list(COLOURS))
def test_whitened_noise_is_white(colour):
    """The covariance is that of the noise that scenes are made with; a window keeps all that its frame tells."""
    scene = rocks(*PAIR, **COLOURS[colour], sampling__samples=256)
    noise = noise_of(scene)
    silent = scene.model_copy(
        update={"sensor": scene.sensor.model_copy(update={"relative_noise": 0.0}), "background": None}
    )
    (frames, peak), (pulses, _) = collected(scene, 100, seed=50), collected(silent, 100, seed=50)
    whole, window = [], []
    for sample, height in zip(frames - pulses.astype(float), peak, strict=True):
        dense = covariance(scene, height) + (1e-5 * height) ** 2 * np.eye(256)  # the accuracy of the curve
        assert noise.autocovariance(height, 1, 256) == pytest.approx(dense[0], abs=1e-9 * dense[0, 0])
        whole.append(np.linalg.solve(np.linalg.cholesky(dense), sample))
        found = maps(noise, height, 1, 256, 16, 40)
        window.append(sample @ found.data)
    # The inverse of the covariance of the whole frame, by a dense solution.
    inverse = np.linalg.inv(dense)[16:56]
    assert found.root @ found.root.T == pytest.approx(inverse[:, 16:56], abs=1e-8 * inverse.max())
    assert found.root @ found.data.T == pytest.approx(inverse, abs=1e-8 * inverse.max())
    for white in (np.array(whole), np.array(window)):
        spread = np.sqrt(2 / white.size)
        if colour == "hum":  # a sine of known amplitude and random phase is Gaussian only in its covariance
            spread *= 2
        assert abs(np.mean(white**2) - 1) < 4 * spread


def test_covariance_of_runs_is_that_of_their_means():
    noise = noise_of(rocks(*PAIR, **COLOURS["two levels"], sampling__samples=240))
    dense = scipy.linalg.toeplitz(noise.autocovariance(900.0, 1, 240))
    mean = np.kron(np.eye(60), np.full(4, 0.25))
    assert noise.autocovariance(900.0, 4, 60) == pytest.approx((mean @ dense @ mean.T)[0], rel=1e-9)


def test_long_contacts_lose_nothing_to_runs(monkeypatch):
    """Some 100 samples in contact, as they are or averaged over runs of 2 to 4."""
    scene = rocks(*PAIR, **COLOURS["pink"], sampling__sampling_rate=1e6, sampling__samples=600)
    whole = limit(scene, 64, seed=51).probabilities
    monkeypatch.setattr("studies.ceilings.coloured._LONGEST", 100)
    assert np.sqrt(np.mean((limit(scene, 64, seed=51).probabilities - whole) ** 2)) < 0.01


@pytest.mark.long
def test_white_noise_is_the_same_with_and_without_whitening():
    scene = rocks(*PAIR, sensor={"relative_noise": 0.05})
    one, other = ceiling(scene, 512, seed=44), limit(scene, 512, seed=44)
    assert one.accuracy == pytest.approx(other.accuracy, abs=1e-3)
    assert np.sqrt(np.mean((one.probabilities - other.probabilities) ** 2)) < 0.01


def test_offset_and_drift_are_known():
    plain = {"relative_noise": 0.05}
    moved = {**plain, "offset": 300.0, "drift": 1e6}
    one, other = (limit(rocks(*PAIR, sensor=sensor), 128, seed=52).probabilities for sensor in (plain, moved))
    assert one == pytest.approx(other, abs=2e-3)


def test_a_range_in_pink_noise_is_not_covered():
    scene = parse_scene(content(sensor={"relative_noise": 0.01, "noise_exponent": 1, "range": 5e3}))
    with pytest.raises(InvalidValue, match=r"sensor\.range"):
        limits(scene, 8, 1)
