"""The Bayes limit of a scene against brute force (the likelihood averaged over very many pulses)"""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest

from cgid.measure.filters import fft_filter
from cgid.measure.fit.fit_samples import mixing_matrix
from cgid.scene import load_scene, parse_scene, synthesise, varied
from cgid.scene.synthesis.impacts import draw
from studies.ceilings.__main__ import main
from studies.ceilings.limit import ceiling, ceilings, learner, low_pass_response, untrusted
from studies.impactor.pulses import dimensionless_logarithms
from tests import few, naive
from tests.test_filters import FRAME, RATE, TOUCH, clean_pulse
from tests.test_scene import content

#: Two rocks of 10 to 16 mm whose pulses overlap: contacts of 10 to 40 samples.
ROCKS = {
    "coal": {"youngs_modulus": {"distribution": "lognormal", "median": 3.5e9, "sigma": 0.3}, "density": 1400,
             "restitution": {"distribution": "uniform", "lowest": 0.3, "highest": 0.6}},
    "gangue": {"youngs_modulus": {"distribution": "lognormal", "median": 6e9, "sigma": 0.4}, "density": 2000,
               "restitution": {"distribution": "uniform", "lowest": 0.45, "highest": 0.75}},
}  # fmt: skip
FALL = {
    "poisson_ratio": 0.3,
    "radius": {"distribution": "log-uniform", "lowest": 0.010, "highest": 0.016},
    "velocity": {"distribution": "uniform", "lowest": 3.0, "highest": 5.0},
}


def rocks(*labels, **changes):
    """A scene of these rocks, each given by its label and whose ranges it has."""
    populations = [{"label": label, **ROCKS[rock], **FALL} for label, rock in labels]
    return parse_scene(
        content(populations=populations, **{"sensor": {"relative_noise": 0.15}, "sampling__jitter": 0.0, **changes})
    )


PAIR = (("coal", "coal"), ("gangue", "gangue"))


def collected(scene, n_signals, seed):
    batches = list(synthesise(scene, n_signals, seed))
    signals = np.concatenate([batch.signals for batch in batches])
    return signals, np.concatenate([batch.parameters["peak_force"] for batch in batches])


@pytest.fixture(autouse=True, scope="module")
def _few_draws():
    """An eighth of the draws that the density of a population is made of: enough for overlapping rocks, and quick."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("studies.ceilings.limit.PRIOR_DRAWS", 1 << 15)
        yield


@cache
def drawn_pulses(text, index, n=40_000):
    """Very many pulses of one population as the sensor sees them, without noise."""
    scene = parse_scene(json.loads(text))
    sensor = scene.sensor.model_copy(update={"relative_noise": 0.0, "absolute_noise": 0.0})
    only = {"populations": (scene.populations[index],), "sensor": sensor, "background": None}
    quiet = scene.model_copy(update=only)
    return collected(quiet, n, seed=41)[0]


def by_brute_force(scene, n_signals, seed):
    """Probability of the first label for each signal, and its standard error."""
    signals, peak = collected(scene, n_signals, seed)
    first, second = (population.weight for population in scene.populations)
    out = []
    for samples, noise in zip(signals, scene.sensor.noise_level(peak, scene.sampling.sampling_rate), strict=True):
        logs, errors = zip(
            *(naive.log_evidence(samples, float(noise), drawn_pulses(scene.text, index)) for index in (0, 1)),
            strict=True,
        )
        expected = 1 / (1 + second / first * np.exp(logs[1] - logs[0]))
        out.append((expected, expected * (1 - expected) * np.hypot(*errors)))
    return np.array(out).T


@pytest.mark.parametrize(
    ("changes", "limit"),
    few(
        [
            ({}, 0.03),
            # Here, at 16 dB and some 20 samples in contact, touch is told to a sample: far from a Gaussian in a window.
            ({"sampling__jitter": 1.0}, 0.045),
            ({"sensor": {"relative_noise": 0.15, "bandwidth": "15 kHz"}}, 0.03),
        ]
    ),
    ids=["touch known", "touch within a sample", "low-pass"],
)
def test_ceiling_is_brute_force(changes, limit, monkeypatch):
    monkeypatch.setattr("studies.ceilings.limit.PRIOR_DRAWS", 1 << 18)
    scene = rocks(*PAIR, **changes)
    expected, error = by_brute_force(scene, 16, seed=42)
    apart = np.abs(ceiling(scene, 16, seed=42).probabilities[:, 0] - expected)
    assert np.sqrt(np.mean(apart**2)) < limit
    assert (apart < 4 * error + 2 * limit).all()


@pytest.mark.long
def test_populations_of_one_restitution_each_are_told_apart():
    def always(e):
        return {"distribution": "constant", "value": e}

    populations = [
        {"label": label, **ROCKS["coal"], **FALL, "restitution": always(e)} for label, e in (("a", 0.3), ("b", 0.8))
    ]
    scene = parse_scene(content(populations=populations, sensor={"relative_noise": 0.01}, sampling__jitter=0.0))
    assert ceiling(scene, 256).accuracy > 0.9999


def test_weights_of_the_populations_count():
    scene = rocks(*PAIR)
    heavy = scene.model_copy(
        update={"populations": (scene.populations[0].model_copy(update={"weight": 5.0}), scene.populations[1])}
    )
    signals = ceiling(heavy, 512, seed=43)
    assert np.mean(signals.truth == "coal") == pytest.approx(5 / 6, abs=0.05)
    assert signals.probabilities[:, 0].mean() == pytest.approx(5 / 6, abs=0.05)
    assert signals.accuracy >= 5 / 6 - 0.02  # always saying coal is right so often


@pytest.mark.long
def test_lumps_change_the_prior_alone():
    """Corners and eccentric blows: peak and duration vary more, restitution is as independent of them as before."""
    lump = {"curvature": {"distribution": "log-uniform", "lowest": 0.1, "highest": 1.0},
            "effective_mass": {"distribution": "uniform", "lowest": 0.4, "highest": 1.0}}  # fmt: skip
    populations = [{"label": rock, **ROCKS[rock], **FALL, **lump} for rock in ("coal", "gangue")]
    scene = parse_scene(content(populations=populations, sensor={"relative_noise": 0.02}, sampling__samples=256))
    values = draw(scene, 53, 0).parameters
    for block in range(1, 40):
        values = {name: np.append(column, draw(scene, 53, block).parameters[name]) for name, column in values.items()}
    coal = values["density"] == 1400
    scales = np.log(values["peak_force"]), np.log(values["contact_duration"])
    shape = np.log(values["restitution"])[coal]
    # What is left of peak and duration without the dimensionless pulse.
    contact, height = dimensionless_logarithms(shape, "contact", "peak")
    for scale in (scales[0][coal] - height, scales[1][coal] - contact):
        assert abs(np.corrcoef(scale, shape)[0, 1]) < 4 / np.sqrt(coal.sum())
    found = ceiling(scene, 512, seed=54)
    assert found.accuracy < ceiling(rocks(*PAIR, sensor={"relative_noise": 0.02}), 512, seed=54).accuracy
    difference = found.hits - found.probabilities.max(axis=1)
    assert abs(difference.mean()) < 3 * difference.std() / np.sqrt(len(difference))


# -- what must contain whatever the scene ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found():
    return ceiling(rocks(*PAIR, sensor={"relative_noise": 0.05}), 512, seed=44)


def test_accuracy_is_the_share_of_hits(found):
    """Both estimate the same: within three standard errors of the difference."""
    difference = found.hits - found.probabilities.max(axis=1)
    assert abs(difference.mean()) < 3 * difference.std() / np.sqrt(len(difference))
    assert found.accuracy_error == pytest.approx(found.probabilities.max(axis=1).std(ddof=1) / np.sqrt(512), rel=1e-12)


def test_probabilities_are_calibrated(found):
    """Among signals that are given a probability, the label is right as often: within three standard errors."""
    assert found.probabilities.sum(axis=1) == pytest.approx(np.ones(512))
    coal = found.truth == "coal"
    given = found.probabilities[:, found.labels.index("coal")]
    for low, high in ((0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 1.01)):
        some = (low <= given) & (given < high)
        assert some.sum() > 10
        spread = np.sqrt(np.mean(given[some] * (1 - given[some])) / some.sum())
        assert abs(coal[some].mean() - given[some].mean()) < 3 * spread


def test_scores_are_those_of_their_definitions(found):
    coal = found.truth == "coal"
    given = found.probabilities[:, found.labels.index("coal")]
    assert found.brier_score == pytest.approx(2 * np.mean((given - coal) ** 2))
    # The area under the curve is the share of pairs in the right order.
    pairs = given[coal][:, None] > given[~coal][None]
    assert found.roc_area("coal") == pytest.approx(pairs.mean(), abs=1e-6)
    assert found.roc_area("gangue") == pytest.approx(pairs.mean(), abs=1e-6)


def test_two_populations_of_one_label_add_up():
    """Coal and gangue, or three equal populations of which two are one label."""
    thirds = ceiling(rocks(("coal", "coal"), ("coal", "coal"), ("culm", "coal")), 256, seed=47)
    assert thirds.labels == ("coal", "culm")
    assert thirds.probabilities == pytest.approx(np.tile([2 / 3, 1 / 3], (256, 1)), abs=1e-12)


# -- what it does not cover ---------------------------------------------------------------------------------------


def tapped():
    return {**content(sensor__relative_noise=0.01),
            "taps": [{"label": "tap", "shape": "square", "peak_force": 100, "contact_duration": 1e-3}]}  # fmt: skip


# -- from below, and the command ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def peers():
    return load_scene("peers")


def test_a_learner_comes_near_the_limit_from_below(peers):
    unknown, known = ceilings(peers, 512, 8, (False, True))
    assert known.accuracy > unknown.accuracy + 0.03
    found = learner(peers, 3000, 512, 8, drop_height_known=True)
    assert found.accuracy > unknown.accuracy + 0.02
    lost = known.hits.astype(float) - found.hits  # on the very same signals
    error = lost.std(ddof=1) / np.sqrt(512)
    assert -2 * error < lost.mean() < 0.02 + 2 * error


def test_what_cannot_be_measured_is_answered_all_the_same(peers):
    """A tenth of the signals of this scene cannot be measured: too faint, or too few samples."""
    found = learner(load_scene("randomised"), 600, 300, 8)
    assert len(found.hits) == 300 and found.accuracy > 0.65
    # Frames that end before the contact does: some features are never measured.
    assert learner(varied(peers, samples=40, pre_trigger=32), 200, 200, 8).accuracy > 0.4


def test_laplaces_approximation_is_trusted_at_little_noise_alone(peers):
    faint = varied(peers, relative_noise=0.4)
    assert "below 14 dB" in untrusted(faint) and untrusted(peers) == ""
    assert "samples" in untrusted(varied(peers, sampling_rate=1e4, keep_frame=True))
    # Whatever becomes of a fit, a probability is one.
    (limit,) = ceilings(faint, 256, 8, (False,), n_nodes=9)
    assert np.all(np.isfinite(limit.probabilities))


def test_the_command_prints_what_python_finds(capsys, peers):
    assert main(["peers", "-n", "64", "--learner", "300", "--seed", "8"]) == 0
    out = capsys.readouterr().out
    (limit,) = ceilings(peers, 64, 8, (False,))
    assert f"highest accuracy possible {limit.accuracy:.4f} +- {limit.accuracy_error:.4f}" in out
    assert f"right answers of Bayes' rule {limit.hits.mean():.4f}" in out
    assert f"a learner on 300 measured signals {learner(peers, 300, 64, 8).accuracy:.4f}" in out


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["none.toml"], 66, "none.toml"),
        (["reference", "-n", "0"], 65, "signals"),
        (["reference", "-n", "99999999999999"], 65, "signals"),
        (["peers", "--learner", "99999999999999"], 65, "learner"),
        (["reference", "--learner", "20"], 65, "learner"),
        (["strangers"], 65, "strangers"),
        (["caving"], 65, "stream"),
    ],
)
def test_what_the_command_refuses_is_named(capsys, arguments, code, says):
    assert main(arguments) == code
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert line.startswith("error: ") and says in line


# -- the low-pass of a sensor as a response -----------------------------------------------------------------------


@pytest.mark.parametrize("edge", [0.05, 0.15, 0.3])
def test_response_is_what_the_filter_makes_of_an_impulse(edge: float) -> None:
    impulse = np.zeros(FRAME)
    impulse[TOUCH] = 1
    response = low_pass_response(RATE, edge * RATE)
    expected = fft_filter(impulse, RATE, high=edge * RATE, taper=0.5)[TOUCH:]
    assert np.abs(response - expected[: len(response)]).max() < 3e-5 * response[0]
    assert np.abs(expected[len(response) :]).max() < 3e-5 * response[0]


@pytest.mark.parametrize("restitution", [1.0, 0.5])
def test_mixing_matrix_filters_a_pulse(restitution: float) -> None:
    clean = clean_pulse(restitution, 2e-4)
    inside = slice(TOUCH - 300, TOUCH + 500)
    mixing = mixing_matrix(low_pass_response(RATE, 2e4), 800)
    assert (mixing == mixing.T).all()
    expected = fft_filter(clean, RATE, high=2e4, taper=0.5)[inside]
    assert np.abs(clean[inside] @ mixing - expected).max() < 2e-4
