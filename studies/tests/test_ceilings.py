"""Learners from above, the survey of a rig, and the command `python -m studies.ceilings`."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from cgid import shipped
from cgid.scene import Scene, load_scene
from studies.ceilings import learners
from studies.ceilings import limit as ceiling
from studies.ceilings.__main__ import main
from studies.ceilings.survey import changed, survey

SEED = 1_000_003
LAWS = Path(__file__).parents[2] / "docs" / "how-to" / "laws.md"


@pytest.fixture(scope="module")
def peers() -> Scene:
    return load_scene(shipped.scene_path("peers"))


@pytest.fixture
def _few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ceiling, "PRIOR_DRAWS", 1 << 15)
    monkeypatch.setattr(learners, "_EXACT_SIZES", (1 << 12, 1 << 14))
    monkeypatch.setattr(learners, "_HELD_DRAWS", 1 << 12)


@pytest.mark.long
@pytest.mark.usefixtures("_few_draws")
def test_exact_pulses_bound_the_limit_from_above(peers: Scene) -> None:
    limit, (*_, bound) = ceiling.ceiling(peers, 512, SEED), learners.above(peers, 512, SEED)
    gained = bound.hits.astype(float) - limit.hits
    assert gained.mean() > 0


@pytest.mark.long
def test_exact_pulses_are_told_apart_as_well_as_their_densities_allow(
    peers: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against Bayes' rule on exact peak, duration and restitution, by the densities of half a million draws."""
    monkeypatch.setattr(learners, "_EXACT_SIZES", (1 << 13, 1 << 15))
    monkeypatch.setattr(learners, "_HELD_DRAWS", 1 << 13)
    priors = [ceiling._Knowledge.of(peers, index, False).prior for index in range(2)]
    test = learners.exact(peers, 8192, SEED, False)
    density = np.stack([prior.log_density(*test.inputs[:, :3].T) for prior in priors])
    best = np.array(["coal", "gangue"])[density.argmax(axis=0)] == test.labels
    (*_, last) = learners.above(peers, 8192, SEED)
    lost = best.astype(float) - last.hits
    assert abs(lost.mean()) < 0.003 + 2 * lost.std() / np.sqrt(8192)


def test_what_cannot_be_measured_is_guessed() -> None:
    labels = np.array(["coal"] * 80 + ["gangue"] * 120)
    inputs = np.random.default_rng(0).normal(size=(200, 2)) + 3.0 * (labels == "gangue")[:, None]
    blind = learners.Rows(np.full((9, 2), np.nan), labels[:9])
    assert (learners.answers(learners.Rows(inputs, labels), blind) == "gangue").all()


@pytest.mark.long
def test_a_better_rig_never_has_a_lower_ceiling(peers: Scene) -> None:
    found = survey(peers, 128, SEED, snrs=(20.0, 40.0), sampling_rates=(1e4, 5e4, 5e5), size_spreads=(1.1, 16.0))
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


def test_the_spread_of_sizes_keeps_its_middle(peers: Scene) -> None:
    for population in changed(peers, "size_spread", 2.0).populations:
        low, high = population.laws["radius"].extremes
        assert high / low == pytest.approx(2.0, rel=1e-6)
        assert low * high == pytest.approx(0.01 * 0.08, rel=1e-3)
    assert changed(peers, "sampling_rate", 200e3) is peers
    assert changed(peers, "snr", 20.0).sensor.relative_noise == pytest.approx(0.1)


@pytest.mark.long
@pytest.mark.usefixtures("_few_draws")
def test_the_command_says_which_kind_of_limit_it_is(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = Path(shipped.scene_path("peers")).read_text()
    for name, line, kind in (
        ("pink", "noise_exponent = 1", "highest accuracy possible 0."),
        ("filtered", "anti_alias = { frequency = 3e4 }", "between"),
    ):
        (tmp_path / name).write_text(text.replace("relative_noise", f"{line}\nrelative_noise"))
        assert main([str(tmp_path / name), "-n", "64", "--learner", "300"]) == 0
        assert kind in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.usefixtures("_few_draws")
def test_a_law_of_ones_own_is_bound_by_two_learners(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cgid.physics.contact.own_laws._own", {})
    (tmp_path / "cone.py").write_text(re.findall(r"```python\n(.*?)```", LAWS.read_text(), re.DOTALL)[0])
    text = Path(shipped.scene_path("peers")).read_text().replace('"hunt-crossley"', '"cone"')
    (tmp_path / "corners.toml").write_text(text)
    arguments = [str(tmp_path / "corners.toml"), "-n", "64", "--learner", "300"]
    assert main(arguments) == 65
    assert main([*arguments, "--laws", str(tmp_path / "cone.py")]) == 0
    out = capsys.readouterr().out
    low, high = (float(found) for found in re.findall(r"(0\.\d+|1\.0+) \+-", out))
    assert 0.5 < low <= high <= 1 and "cone pulses are another family" in out


def test_the_survey_is_a_picture_and_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The figures are looked at in other tests.
    monkeypatch.setattr(ceiling, "PRIOR_DRAWS", 1 << 11)
    monkeypatch.setattr("studies.ceilings.survey._NODES", 3)
    short = {"snrs": (8.0, 40.0), "sampling_rates": (1e5,), "size_spreads": (2.0,)}
    monkeypatch.setattr("studies.ceilings.__main__.survey", partial(survey, **short))
    picture = tmp_path / "rig.png"
    arguments = ["peers", "-n", "16", "--survey", str(picture)]
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG") and out.count("\n") == 5 and out.count("left out") == 1
    assert main(arguments) == 73


@pytest.mark.parametrize(
    ("arguments", "exit_code"),
    [
        (["none.toml"], 66),
        (["peers", "-n", "0"], 65),
        (["peers", "--laws", "none.py"], 65),
        (["peers", "--learner", "20"], 65),
        (["caving"], 65),
        (["strangers"], 65),
        (["randomised", "--survey", "r.png"], 65),
        (["peers", "--survey", "r.pdf"], 73),
    ],
)
def test_bad_input_ends_with_one_line(
    arguments: list[str],
    exit_code: int,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == exit_code
    out, err = capsys.readouterr()
    assert out == "" and err.count("error: ") == 1 and list(tmp_path.iterdir()) == []
