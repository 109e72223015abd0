"""`cgid ceiling`, the bracket from below and the survey; the ceiling itself is tested in test_ceiling.py."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cgid import shipped
from cgid.ceiling import Bracket, Ceiling, bracket, ceilings, survey
from cgid.ceiling.learner import sizes_up_to
from cgid.ceiling.survey import N_POINTS, RATES, SNRS, SPREADS, changed, untrusted
from cgid.cli.main import run
from cgid.errors import InvalidValue
from cgid.scene import Scene, load_scene

N, SEED = 512, 1_000_003


@pytest.fixture(autouse=True, scope="module")
def _few_draws() -> Iterator[None]:
    """A sixteenth of the draws that the density of a population is made of: enough for shares, and quick."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cgid.ceiling.bayes.PRIOR_DRAWS", 1 << 15)
        yield


@pytest.fixture(scope="module")
def peers() -> Scene:
    return load_scene(shipped.scene_path("peers"))


@pytest.fixture(scope="module")
def limits(peers: Scene) -> tuple[Ceiling, ...]:
    return ceilings(peers, N, SEED, (False, True))


@pytest.mark.long
def test_a_learner_comes_near_the_ceiling_from_below(peers: Scene, limits: tuple[Ceiling, ...]) -> None:
    found = bracket(peers, (100, 3000), N, SEED, limit=limits[0])
    few, many = found.learners
    assert (few.n_signals, many.n_signals) == (100, 3000)
    assert found.unmeasured == 0
    assert few.regret > many.regret >= 0
    assert many.regret + 2 * many.regret_error < 0.02
    assert abs(many.difference - many.regret) < 4 * np.hypot(many.difference_error, many.regret_error)
    # The difference is that of the very same signals: less uncertain than either accuracy.
    assert many.difference_error < 0.7 * np.hypot(many.accuracy_error, limits[0].accuracy_error)


@pytest.mark.long
def test_a_known_drop_height_helps_learner_and_ceiling(peers: Scene, limits: tuple[Ceiling, ...]) -> None:
    unknown, known = limits
    assert known.accuracy > unknown.accuracy + 0.03
    (learner,) = bracket(peers, (3000,), N, SEED, drop_height_known=True, limit=known).learners
    assert unknown.accuracy + 0.02 < learner.accuracy
    assert 0 <= learner.regret < 0.02


def test_what_cannot_be_measured_is_guessed(limits: tuple[Ceiling, ...]) -> None:
    from cgid.ceiling.learner import _answers, _judged, _Rows

    labels = np.array(["coal"] * 80 + ["gangue"] * 120)
    inputs = np.random.default_rng(0).normal(size=(200, 2)) + 3.0 * (labels == "gangue")[:, None]
    rows, test = _Rows(inputs, labels, 2), _Rows(np.full((N, 2), np.nan), limits[0].truth, 2)
    learner = _judged(200, *_answers(rows, test), test.labels, limits[0], ())
    assert learner.accuracy == pytest.approx(np.mean(limits[0].truth == "gangue"))


def test_a_limit_of_other_signals_is_refused(peers: Scene, limits: tuple[Ceiling, ...]) -> None:
    with pytest.raises(InvalidValue, match=f"seed {SEED + 5}"):
        bracket(peers, (300,), N, SEED + 5, limit=limits[0])
    with pytest.raises(InvalidValue, match="at least 100 signals"):
        bracket(peers, (20,), N, SEED, limit=limits[0])


def test_sizes_of_training() -> None:
    assert sizes_up_to(500) == (500,)
    assert sizes_up_to(3000) == (1000, 3000)
    assert sizes_up_to(100_000) == (1000, 3000, 10_000, 30_000, 100_000)


@pytest.mark.long
def test_both_states_of_knowledge_are_those_of_one_at_a_time(peers: Scene) -> None:
    from cgid.ceiling import ceiling

    together = ceilings(peers, 64, SEED, (False, True))
    for one, known in zip(together, (False, True), strict=True):
        alone = ceiling(peers, 64, SEED, drop_height_known=known)
        assert np.array_equal(one.probabilities, alone.probabilities)


@pytest.mark.long
def test_a_better_rig_never_has_a_lower_ceiling(peers: Scene) -> None:
    found = survey(peers, 256, SEED, snrs=(20.0, 40.0), sampling_rates=(1e4, 5e4, 5e5), size_spreads=(1.1, 16.0))
    assert found.here.axis == "present"
    assert found.present["snr"] == pytest.approx(20 * np.log10(1 / 0.02))
    assert found.present["size_spread"] == pytest.approx(8.0)
    assert [p.value for p in found.along("snr")] == [20.0, 40.0]
    for axis, sign in (("snr", 1), ("sampling_rate", 1), ("size_spread", -1)):
        low, high = found.along(axis)
        for name in ("accuracy", "accuracy_known"):
            gain = sign * (getattr(high, name) - getattr(low, name))
            assert gain > -2 * np.hypot(getattr(low, f"{name}_error"), getattr(high, f"{name}_error")), (axis, name)
    assert found.along("snr")[1].accuracy > found.along("snr")[0].accuracy + 0.05
    # Rocks of one size: peak and duration tell the material once the speed is known.
    assert found.along("size_spread")[0].accuracy_known > 0.999
    left = [p for p in found.points if p.left_out]
    assert [(p.axis, p.value) for p in left] == [("sampling_rate", 1e4)]
    assert "samples" in left[0].left_out and np.isnan(left[0].accuracy)


def test_what_the_integration_does_not_tell_is_left_out(peers: Scene) -> None:
    faint = changed(peers, "snr", 8.0)
    assert "below 14 dB" in untrusted(faint) and untrusted(peers) == ""
    (point,) = survey(faint, 64, SEED, snrs=(9.0,), sampling_rates=(), size_spreads=()).points
    assert "9 dB" in point.left_out
    # Whatever becomes of a fit, a probability is one.
    (limit,) = ceilings(faint, 256, SEED, (False,), n_nodes=9)
    assert np.all(np.isfinite(limit.probabilities))


def test_the_spread_of_sizes_keeps_its_middle(peers: Scene) -> None:
    for population in changed(peers, "size_spread", 2.0).populations:
        low, high = population.laws["radius"].extremes
        assert high / low == pytest.approx(2.0, rel=1e-6)
        assert low * high == pytest.approx(0.01 * 0.08, rel=1e-3)
    assert changed(peers, "sampling_rate", 200e3) is peers
    assert changed(peers, "snr", 20.0).sensor.relative_noise == pytest.approx(0.1)


def test_the_command_prints_what_python_finds(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["ceiling", "peers", "-n", "64", "--learner", "300", "--seed", "8"]
    assert run([*arguments, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    (limit,) = ceilings(load_scene(shipped.scene_path("peers")), 64, 8, (False,))
    assert content["accuracy"] == limit.accuracy
    assert content["right_answers"] == limit.hits.mean()
    assert content["roc_area"] == {label: limit.roc_area(label) for label in ("coal", "gangue")}
    assert [row["n_signals"] for row in content["learners"]] == [300]
    assert run(arguments) == 0
    text = capsys.readouterr().out
    assert f"highest accuracy possible {limit.accuracy:.4f} +- {limit.accuracy_error:.4f}" in text
    assert f"Brier score {limit.brier_score:.4f} +- {limit.brier_error:.4f}" in text
    assert "drop height not known" in text


@pytest.fixture(scope="module")
def enclosed(peers: Scene) -> Bracket:
    """Both ends of the ceiling of scene peers, as if the integration did not cover it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cgid.ceiling.learner.uncovered", lambda scene: "something else")
        patch.setattr("cgid.ceiling.learner._HELD_DRAWS", 1 << 12)
        patch.setattr("cgid.ceiling.learner._EXACT_SIZES", (1 << 13, 1 << 15))
        return bracket(peers, (300, 3000), N, SEED)


@pytest.mark.long
def test_learners_enclose_the_ceiling(enclosed: Bracket, limits: tuple[Ceiling, ...]) -> None:
    assert enclosed.ceiling is None and enclosed.uncovered == "something else"
    assert [one.n_signals for one in enclosed.learners] == [300, 3000]
    # Judged on the same signals, so that differences are less uncertain than the accuracies.
    for below in enclosed.learners:
        lost = limits[0].hits.astype(float) - below.hits
        assert lost.mean() > -2 * lost.std() / np.sqrt(N)
    gained = enclosed.above[-1].hits.astype(float) - limits[0].hits
    assert gained.mean() > 0
    assert enclosed.learners[-1].difference == pytest.approx(
        enclosed.above[-1].accuracy - enclosed.learners[-1].accuracy
    )
    assert np.isnan(enclosed.learners[0].regret) and enclosed.above[-1].difference == 0


@pytest.mark.long
def test_exact_pulses_are_told_apart_as_well_as_their_densities_allow(peers: Scene) -> None:
    """Against Bayes' rule on exact peak, duration and restitution, by the densities of half a million draws."""
    from cgid.ceiling import bayes
    from cgid.ceiling.learner import _above, _exact

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cgid.ceiling.bayes.PRIOR_DRAWS", 1 << 19)
        priors = [bayes._Knowledge.of(peers, index, False).prior for index in range(2)]
    test = _exact(peers, 8192, SEED, False)
    peak, duration, shape = test.inputs[:, 0], test.inputs[:, 1], test.inputs[:, 2]
    density = np.stack([prior.log_density(peak, duration, shape) for prior in priors])
    best = np.array(["coal", "gangue"])[density.argmax(axis=0)] == test.labels
    (*_, last) = _above(peers, 8192, SEED, False)
    lost = best.astype(float) - last.hits
    assert abs(lost.mean()) < 0.003 + 2 * lost.std() / np.sqrt(8192)


@pytest.mark.long
def test_the_command_encloses_what_it_does_not_integrate(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cgid.ceiling.learner._EXACT_SIZES", (1 << 12, 1 << 13))
    monkeypatch.setattr("cgid.ceiling.learner._HELD_DRAWS", 1 << 12)
    text = (
        Path(shipped.scene_path("peers"))
        .read_text()
        .replace("relative_noise", "anti_alias = { frequency = 3e4 }\nrelative_noise")
    )
    (tmp_path / "filtered.toml").write_text(text)
    arguments = ["ceiling", str(tmp_path / "filtered.toml"), "-n", "64", "--learner", "300"]
    assert run([*arguments, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert "accuracy" not in content and "what a filter makes of it" in content["uncovered"]
    below, above = content["learners"][-1], content["above"][-1]
    assert "regret" not in below
    assert run(arguments) == 0
    out = capsys.readouterr().out
    assert (
        f"highest accuracy possible between {below['accuracy']:.4f} +- {below['accuracy_error']:.4f} and "
        f"{above['accuracy']:.4f} +- {above['accuracy_error']:.4f}" in out
    )
    assert "not integrated: that needs the force itself" in out


@pytest.mark.long
def test_the_survey_is_a_picture_and_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The figures are looked at in other tests.
    monkeypatch.setattr("cgid.ceiling.bayes.PRIOR_DRAWS", 1 << 11)
    monkeypatch.setattr(sys.modules[survey.__module__], "_NODES", 5)
    picture = tmp_path / "rig.png"
    arguments = ["ceiling", "peers", "-n", "16", "--drop-height", "--plot", str(picture)]
    assert run(arguments) == 0
    out, err = capsys.readouterr()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert str(picture) in err
    rows = out[out.index("survey, 16 signals a point") :].splitlines()[2:]
    assert len(rows) == N_POINTS == 1 + len(SNRS) + len(RATES) + len(SPREADS)
    assert sum("left out" in row for row in rows) == 2
    assert run(arguments) == 73
