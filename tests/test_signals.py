"""Signals: units, conversions, force from acceleration, and what is refused."""

import numpy as np
import pandas as pd
import pytest

import cgid
from cgid._lib import validation
from cgid.errors import BadData, InvalidValue
from cgid.signals import Batch, Signal
from cgid.units import known_unit


def one(samples=(1.0, -2.0, 3.0), **fields):
    return Signal(samples=np.asarray(samples), **{"sampling_rate": 1e5, **fields})


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("N", "N", 1.0),
        ("kN", "N", 1000.0),
        ("mN", "N", 1e-3),
        ("lbf", "N", 0.45359237 * 9.80665),
        ("m/s2", "m/s^2", 1.0),
        ("g", "m/s^2", 9.80665),
        ("mm/s", "m/s", 1e-3),
        ("um", "m", 1e-6),
        ("µm", "m", 1e-6),
        ("MPa", "Pa", 1e6),
        ("µV", "V", 1e-6),
        ("µm/m", "m/m", 1e-6),
    ],
)
def test_units_convert_to_si(unit, si, factor):
    converted = one(unit=unit).in_si()
    assert converted.unit == si
    assert converted.samples == pytest.approx(factor * np.array([1.0, -2.0, 3.0]), rel=1e-14)


@pytest.mark.parametrize("unit", ["", "n", "G", "kg", "newton"])
def test_unknown_unit_is_refused_with_the_known_ones(unit):
    with pytest.raises(InvalidValue, match=f"got {unit!r} .*force: N, kN"):
        one(unit=unit)


# -- what a signal is -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [["a"], [True], [1j], [None]])
def test_samples_are_real_numbers(samples):
    with pytest.raises(BadData, match="samples must be real numbers"):
        one(samples)


@pytest.mark.parametrize("shape", [(), (0,), (2, 3)])
def test_samples_are_one_row(shape):
    with pytest.raises(BadData, match="one row of at least one number"):
        one(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_the_first_sample_that_is_not_finite_is_named(value):
    with pytest.raises(BadData, match=rf"^a\.csv channel 3: .*sample 1 is {value} \(2 of 4 are not finite\)"):
        one([0.0, value, 1.0, value], source="a.csv", channel="3")


STRANGE_LABELS = ["unknown", "", " coal", "-", "<script>", "a|b", "`x`", "a,b", "a=b", "a/b", "co\u202eal", "x" * 101]


@pytest.mark.parametrize("label", [*STRANGE_LABELS, 7, None], ids=repr)
def test_what_options_and_pages_cannot_hold_is_no_label(label: object) -> None:
    with pytest.raises(InvalidValue, match="label must"):
        validation.label("label", label)


def test_batch_refuses_a_label_that_is_none() -> None:
    about = {"sampling_rate": 1e5, "unit": "N", "pre_trigger": 2, "specimen": np.arange(2, dtype=np.uint64)}
    with pytest.raises(InvalidValue, match="label must not be 'unknown'"):
        Batch(signals=np.zeros((2, 10)), labels=np.array(["coal", "unknown"]), **about)


SOUND: dict[str, object] = {"signals": np.zeros((3, 10)), "sampling_rate": 1e5, "unit": "N", "pre_trigger": 2}


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"signals": np.zeros(10)}, "signals must be rows"),
        ({"signals": [["a", "b"]]}, "signals must be rows"),
        ({"labels": np.array(["coal"] * 2)}, "labels must have one entry for each of 3"),
        ({"labels": ["coal", "", "coal"]}, "label must"),
        ({"specimen": np.arange(4)}, "specimen must have one entry for each of 3"),
        ({"specimen": [0.5, 1.5, 2.5]}, "specimen must be whole"),
        ({"specimen": [0, 1, -1]}, "specimen must be whole"),
        ({"parameters": {"radius": np.ones(2)}}, "radius must have one entry for each of 3"),
        ({"unit": "Newton"}, "unit must be a known one"),
        ({"sampling_rate": -1}, "sampling_rate must"),
        ({"pre_trigger": 10}, "pre_trigger must"),
    ],
)
def test_a_batch_is_checked_when_it_is_made(wrong: dict[str, object], says: str) -> None:
    with pytest.raises((BadData, InvalidValue), match=says):
        Batch(**(SOUND | wrong))


def test_a_batch_needs_neither_labels_nor_specimens() -> None:
    batch = next(cgid.synthesise("reference", 8, seed=3))
    known = {"sampling_rate": 200e3, "unit": "N", "pre_trigger": batch.pre_trigger}
    bare = Batch(signals=batch.signals.tolist(), **known)
    assert (bare.counts, bare.specimen.tolist(), bare.signals.dtype) == ({}, list(range(8)), np.float64)
    expected = cgid.predict(batch)
    pd.testing.assert_frame_equal(cgid.predict(Batch(signals=batch.signals, **known)), expected.drop(columns="truth"))
    with pytest.raises(BadData, match="must have labels for training"):
        cgid.train_on_specimens(bare)


@pytest.mark.parametrize(
    ("written", "unit"),
    [
        ("[kN]", "kN"),
        ("(m/s^2)", "m/s^2"),
        ("\u03bcm", "µm"),
        ("Newtons", "N"),
        ("strain", "m/m"),
        ("ms", None),
        ("", None),
    ],
)
def test_units_in_file_headers(written, unit):
    assert known_unit(written) == unit
