"""The table of features: lookup by name, banks, and how a feature is added."""

import csv
from importlib.resources import files

import numpy as np
import pytest

from cgid.errors import InvalidValue
from cgid.measure.features import extraction as features
from cgid.measure.features import vibration, windows
from cgid.measure.features.extraction import FEATURES, choose, extract, extract_array
from cgid.measure.features.table import Bank, Feature, FeatureTable
from cgid.measure.spectra import MEL_BANDS
from tests.ringing import PRE_TRIGGER, RATE, ringing_batch


def half_sine(amplitude=700.0):
    return amplitude * np.sin(np.pi * np.clip((np.arange(400) - 100) / 100, 0, 1))


def test_a_feature_is_added_by_one_line(monkeypatch):
    """What a row of the descriptions and a line among the features of pulses make."""
    line = Feature(
        "form_factor",
        "1",
        "peak_force times contact_duration over impulse",
        "cgid",
        lambda p: p.peak * p.duration / p.moments[0],
        positive=True,
    )
    monkeypatch.setattr(features, "FEATURES", FeatureTable((line, *FEATURES.entries)))
    assert choose(None)[0] == "form_factor"
    assert extract(half_sine(), 1e5, ["form_factor"]).iloc[0, 0] == pytest.approx(np.pi / 2, rel=0.02)


def test_a_bank_is_added_by_one_line(monkeypatch):
    shares = (0.2, 0.8)
    line = Bank(
        "width_at_*",
        "s",
        "width at * of the peak",
        "cgid",
        lambda p, n: p.width(shares[n]),
        [f"{share:g}" for share in shares],
    )
    monkeypatch.setattr(features, "FEATURES", FeatureTable((*FEATURES.entries, line)))
    assert choose(["width_at_*"]) == ("width_at_0.2", "width_at_0.8")
    low, high = extract_array(half_sine(), 1e5, ["width_at_*"])[0]
    expected = [(1 - 2 * np.arcsin(share) / np.pi) * 1e-3 for share in shares]
    assert [low, high] == pytest.approx(expected, rel=1e-3)


def test_every_row_of_the_descriptions_is_measured():
    lines = files("cgid.measure.features").joinpath("features.csv").read_text(encoding="utf-8").splitlines()
    rows = {row["name"] for row in csv.DictReader(lines)}
    assert rows == {entry.name for entry in FEATURES.entries if "*" not in entry.name or "relative" not in entry.name}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("strong_rms", f"until {100 * vibration.STRONG_SHARE:g} %"),
        ("level_total", f"exp(-t/{1e3 * vibration.WINDOW_TIME:g} ms)"),
        ("second_frequency", f"{vibration.MIN_SEPARATION:g} Hz"),
        ("time_to_first_maximum", f"{100 * vibration.ONSET_OVER_PEAK:g} % of the peak"),
        ("early_level_0_500_hz", f"first {1e3 * vibration.EARLY_TIME:g} ms"),
        ("window_mel_1000_hz", f"frames of {1e3 * windows.FRAME_TIME:g} ms"),
        ("window_flux", f"{1e3 * windows.FRAME_TIME:g} ms"),
        ("window_second_frequency", f"{2 / windows.FRAME_TIME:g} Hz"),
        ("window_envelope_variation", f"{1e3 * windows.ENVELOPE_TIME:g} ms"),
        ("window_blow_rate", f"within {1e3 * windows.IMPACT_TIME:g} ms and above {windows.IMPACT_OVER_MEAN:g} times"),
    ],
)
def test_a_definition_states_the_constants_of_its_measurement(name, said):
    assert said in FEATURES[name].definition


@pytest.mark.parametrize("name", ["mel_*_hz", "mel_1001_hz", "mel__hz", "level_1000_hz ", "", "mel_delay_hz"])
def test_other_names_are_unknown(name):
    assert name not in FEATURES
    with pytest.raises(InvalidValue, match="feature must be one of the"):
        features.require_known(name)


def test_a_bank_stands_for_its_columns():
    names = choose(["decay_time", "mel_*_hz"])
    assert names == ("decay_time", *(f"mel_{centre:.0f}_hz" for centre in MEL_BANDS.centres))
    frames = ringing_batch(3, seed=4).signals
    whole = extract_array(frames, RATE, names[:20], pre_trigger=PRE_TRIGGER)
    for column, name in enumerate(names[:20]):
        alone = extract_array(frames, RATE, [name], pre_trigger=PRE_TRIGGER)[:, 0]
        np.testing.assert_array_equal(alone, whole[:, column])
    with pytest.raises(InvalidValue, match="once each"):
        choose(["mel_*_hz", names[1]])
