"""Sampled pulses against the pulses they were sampled from, and on their way through a scene's recorder."""

from pathlib import Path

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.physics import STEEL, YANG2018_SPHERES, Elastic, HalfSpace, HuntCrossley, Impact, Sphere, Viscoelastic
from cgid.physics.contact.sampled import SampledPulses, shares_of_contact
from cgid.scene import load_scene, synthesise, synthesise_given, varied
from cgid.scene.synthesis.impacts import draw
from studies.paper.sensitivity import dissipative_constant

DATASETS = Path(__file__).parents[1] / "datasets"


def sampled(impact, n_points=192):
    shares = shares_of_contact(n_points)
    duration = impact.contact_duration
    forces = np.atleast_2d(
        impact.force(shares * duration[:, None] if impact.contact_duration.ndim else shares * duration)
    )
    # Rounding may put the last point a hair inside contact, where a viscoelastic sphere still pushes.
    forces[:, -1] = 0.0
    return SampledPulses(shares=shares, forces=forces, contact_duration=duration)


def impacts(dissipation, n=5):
    return Impact(
        sphere=Sphere(material=YANG2018_SPHERES[1], radius=np.linspace(0.01, 0.08, n)),
        target=HalfSpace(material=STEEL),
        velocity=3.0,
        stiffness="hertz",
        dissipation=dissipation,
    )


def viscoelastic(restitution, n=5):
    asked = dissipative_constant(restitution, impacts(Elastic(), n))
    return impacts(Viscoelastic(dissipative_constant=asked), n)


@pytest.mark.parametrize("law", ["hunt-crossley", "viscoelastic"])
@pytest.mark.parametrize("restitution", [0.2, 0.5, 0.9])
def test_sampled_pulses_are_the_pulses_they_were_sampled_from(law, restitution):
    impact = impacts(HuntCrossley(restitution=restitution)) if law == "hunt-crossley" else viscoelastic(restitution)
    pulses = sampled(impact)
    times = np.linspace(-0.1, 1.1, 1201) * impact.contact_duration[:, None]
    error = np.abs(pulses.force(times) - impact.force(times)).max(axis=1) / impact.peak_force
    assert error.max() < 2e-6
    np.testing.assert_allclose(pulses.peak_force, impact.peak_force, rtol=3e-6)
    np.testing.assert_allclose(pulses.impulse, impact.impulse, rtol=1e-7)
    np.testing.assert_array_equal(pulses.end_of_contact, impact.contact_duration)


def test_frames_hold_the_force_and_each_may_have_a_rate_of_its_own():
    pulses = sampled(impacts(HuntCrossley(restitution=0.4)))
    onset, rates = np.linspace(-1e-4, 4e-4, 5), np.linspace(5e4, 5e5, 5)
    frames = np.ones((5, 300))
    pulses.add_to_frames(frames, rates, onset)
    times = np.arange(300) / rates[:, None] - onset[:, None]
    np.testing.assert_allclose(frames - 1, pulses.force(times), atol=1e-9 * pulses.peak_force.max())
    assert not pulses.force([[-1e-9, 0.0, 1.0]]).any()
    late = np.zeros((5, 10), np.float32)
    pulses.add_to_frames(late, 1e5, np.full(5, 1.0))
    assert not late.any()


@pytest.mark.parametrize("name", ["reference", "plate", "peers", "randomised"])
def test_the_same_pulses_give_the_signals_of_the_scene(name):
    """Through the chain, with noise: a force as it is, and what an accelerometer on a plate hears of it."""
    scene = load_scene(DATASETS / f"{name}.toml")
    if name == "plate":  # without a converter, whose steps would hide the difference; and as an endless plate, quick
        scene = scene.model_copy(
            update={
                "tail_beam": scene.tail_beam.model_copy(update={"coupling": "impedance"}),
                "sensor": scene.sensor.model_copy(update={"range": None, "bits": None}),
            }
        )
    drawn = draw(scene, 7, 0)
    n = 40
    pulses = sampled(drawn.impact).taken(slice(0, n))
    own = ("peak_force", "contact_duration", "onset", "relative_noise", "bandwidth")
    known = {k: v[:n] for k, v in drawn.parameters.items() if k not in own}
    (there,) = synthesise(scene, n, 7, dtype="float64")
    (here,) = synthesise_given(scene, pulses, drawn.labels[:n], known, 7, dtype="float64")
    peak = np.abs(there.signals).max(axis=1, keepdims=True)
    assert (np.abs(here.signals - there.signals) / peak).max() < 5e-5
    assert (here.unit, here.sampling_rate, here.pre_trigger) == (there.unit, there.sampling_rate, there.pre_trigger)
    np.testing.assert_array_equal(here.labels, there.labels)
    np.testing.assert_array_equal(here.specimen, there.specimen)
    assert here.parameters.keys() == there.parameters.keys()
    for column, values in there.parameters.items():
        np.testing.assert_allclose(here.parameters[column], values, rtol=1e-5, err_msg=column)


def test_a_recorder_with_filters_range_and_bits_treats_them_alike():
    scene = varied(load_scene(DATASETS / "reference.toml"), bandwidth="30 kHz", range="20 kN", bits=12)
    drawn = draw(scene, 7, 0)
    known = {"drop_height": drawn.parameters["drop_height"]}
    (there,) = synthesise(scene, 256, 7)
    (here,) = synthesise_given(scene, sampled(drawn.impact), drawn.labels, known, 7)
    step = 20e3 / 2**11
    # A value between two steps of the converter may fall to either.
    assert np.abs(here.signals - there.signals).max() <= 1.01 * step
    assert np.mean(here.signals != there.signals) < 1e-2
    assert there.signals.max() == here.signals.max() <= 20e3


def test_blocks_are_whole_and_batches_are_not(reference_scene):
    drawn = draw(reference_scene, 1, 0)
    pulses = sampled(drawn.impact)
    twice = pulses.taken(np.arange(300) % 256)
    batches = list(synthesise_given(reference_scene, twice, drawn.labels[np.arange(300) % 256], seed=1))
    assert [len(batch) for batch in batches] == [256, 44]
    (first,) = synthesise_given(reference_scene, twice.taken(slice(0, 10)), drawn.labels[:10], seed=1)
    np.testing.assert_array_equal(first.signals, batches[0].signals[:10])
    assert np.isnan(batches[0].parameters["radius"]).all()
    # Nobody said what fell: no two are taken for the same particle.
    assert np.unique(np.concatenate([batch.specimen for batch in batches])).size == 300
    assert (batches[1].signals[0] != batches[0].signals[0]).any()  # noise of its own


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shares": [0, 0.2, 0.1, 1]}, "shares must be 4 or more numbers that rise from 0 to 1"),
        ({"shares": [0.1, 0.2, 0.3, 1]}, "rise from 0 to 1, got 4 numbers from 0.1 to 1"),
        ({"forces": [[0, 1, 1, 0], [0, 1, 1, 0]]}, r"shape \(2, 4\) for durations of shape \(1,\)"),
        ({"forces": [[0, -1, 1, 0]]}, "forces must be 0 or more, got -1 N"),
        ({"forces": [[0, 0, 0, 0]]}, "above 0 somewhere in each pulse, got none in row 0"),
    ],
)
def test_impossible_pulses_are_refused(change, message):
    given = {"shares": [0, 0.3, 0.7, 1], "forces": [[0, 1, 1, 0]], "contact_duration": [1e-3]} | change
    with pytest.raises(InvalidValue, match=message):
        SampledPulses(**given)


def test_pulses_that_do_not_fit_a_scene_are_refused(reference_scene):
    pulses = sampled(impacts(HuntCrossley(restitution=0.5)))
    with pytest.raises(InvalidValue, match="labels must be one for each of 1 or more pulses, got 2 for 5"):
        next(synthesise_given(reference_scene, pulses, ["coal", "gangue"]))
    with pytest.raises(InvalidValue, match="radius must be one number for each of 5 pulses, got shape"):
        next(synthesise_given(reference_scene, pulses, ["coal"] * 5, {"radius": [0.1]}))
    with pytest.raises(InvalidValue, match="peak_force must be left out, it is that of the pulses"):
        next(synthesise_given(reference_scene, pulses, ["coal"] * 5, {"peak_force": np.ones(5)}))
    with pytest.raises(InvalidValue, match="relative_noise must be left out, it is that of the scene's sensor"):
        next(synthesise_given(reference_scene, pulses, ["coal"] * 5, {"relative_noise": np.full(5, 0.5)}))
    with pytest.raises(InvalidValue, match="stream must be left out"):
        next(synthesise_given(load_scene(DATASETS / "caving.toml"), pulses, ["coal"] * 5))
    with pytest.raises(InvalidValue, match="n_points must be 4 or more, got 3"):
        shares_of_contact(3)


def test_touch_and_points_of_impact_are_drawn_where_they_are_not_known():
    scene = load_scene(DATASETS / "plate.toml")
    pulses, labels = sampled(impacts(HuntCrossley(restitution=0.5))), ["steel"] * 5
    (drawn,) = synthesise_given(scene, pulses, labels, seed=3)
    names = ("onset", "impact_x", "impact_y")
    known = {name: np.where([0, 0, 1, 0, 0], 0.9 * drawn.parameters[name], np.nan) for name in names}
    (batch,) = synthesise_given(scene, pulses, labels, known, 3)
    others = [0, 1, 3, 4]
    for name in names:
        assert batch.parameters[name][2] == known[name][2]
        np.testing.assert_array_equal(batch.parameters[name][others], drawn.parameters[name][others])
    np.testing.assert_array_equal(batch.signals[others], drawn.signals[others])
    assert (batch.signals[2] != drawn.signals[2]).any()
    with pytest.raises(InvalidValue, match=r"impact_y must be on the beam, between 0 and 0.36 m, got 1 m at index 0"):
        next(synthesise_given(scene, pulses, labels, {"impact_y": np.ones(5)}))
