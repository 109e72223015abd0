"""Signals: units, conversions, force from acceleration, and what is refused."""

import numpy as np
import pytest

from cgid import validation
from cgid.errors import BadData, InvalidValue
from cgid.signals import Batch, Signal
from cgid.units import DIMENSIONS, UNITS, hertz_of, known_unit, quantity_of, seconds_of


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


def test_the_si_unit_comes_first_and_has_factor_one():
    assert [next(iter(units.values())) for units in UNITS.values()] == [1.0] * len(UNITS)


def test_no_unit_belongs_to_two_quantities():
    names = [unit for units in UNITS.values() for unit in units]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(("unit", "quantity"), [("kN", "force"), ("g", "acceleration"), ("um/m", "strain")])
def test_a_unit_tells_its_quantity(unit, quantity):
    assert quantity_of(unit) == quantity
    assert one(unit=unit).quantity == quantity


@pytest.mark.parametrize("unit", ["", "n", "G", "kg", "newton"])
def test_unknown_unit_is_refused_with_the_known_ones(unit):
    with pytest.raises(InvalidValue, match=f"got {unit!r} .*force: N, kN"):
        one(unit=unit)


def test_conversion_keeps_everything_else():
    signal = one(unit="kN", source="a.csv", channel="2", pre_trigger=1).in_si()
    assert (signal.source, signal.channel, signal.pre_trigger, signal.sampling_rate) == ("a.csv", "2", 1, 1e5)


# -- force ----------------------------------------------------------------------------------------------------


def test_force_is_mass_times_acceleration():
    force = one([2.0], unit="g").as_force(0.5)
    assert (force.samples[0], force.unit, force.quantity) == (9.80665, "N", "force")


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_mass_is_above_zero(mass):
    with pytest.raises(InvalidValue, match="mass"):
        one(unit="g").as_force(mass)


@pytest.mark.parametrize("unit", ["N", "m/s", "V", None])
def test_only_an_acceleration_becomes_a_force(unit):
    with pytest.raises(InvalidValue, match="mass turns an acceleration into a force"):
        one(unit=unit).as_force(1.0)


def test_inverted_twice_is_the_same():
    signal = one(unit="N", pre_trigger=1)
    assert signal.inverted().samples.tolist() == [-1.0, 2.0, -3.0]
    assert signal.inverted().inverted().samples.tolist() == signal.samples.tolist()


# -- what a signal is -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_floats_keep_their_type(kind):
    signal = one(np.ones(3, kind), unit="kN")
    assert signal.samples.dtype == kind
    assert signal.in_si().samples.dtype == kind
    assert signal.inverted().samples.dtype == kind


@pytest.mark.parametrize("kind", [np.int16, np.uint8, np.int64, np.float16])
def test_other_numbers_become_double(kind):
    assert one(np.array([1, 2], kind)).samples.dtype == np.float64


def test_unsigned_numbers_can_be_inverted():
    assert one(np.array([1, 2], np.uint8)).inverted().samples.tolist() == [-1.0, -2.0]


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


def test_duration_counts_every_sample():
    assert one(np.zeros(250)).duration == 2.5e-3


STRANGE_LABELS = ["unknown", "", " coal", "-", "<script>", "a|b", "`x`", "a,b", "a=b", "a/b", "co\u202eal", "x" * 101]


@pytest.mark.parametrize("label", ["coal", "Kohle naß", "煤 1", "unknown 2", "Unknown", "a_b.c-d", "x" * 100])
def test_labels_of_any_script_are_labels(label: str) -> None:
    assert validation.label("label", label) == label


@pytest.mark.parametrize("label", [*STRANGE_LABELS, 7, None], ids=repr)
def test_what_options_and_pages_cannot_hold_is_no_label(label: object) -> None:
    with pytest.raises(InvalidValue, match="label must"):
        validation.label("label", label)


def test_batch_refuses_a_label_that_is_none() -> None:
    about = {"sampling_rate": 1e5, "unit": "N", "pre_trigger": 2, "specimen": np.arange(2, dtype=np.uint64)}
    with pytest.raises(InvalidValue, match="label must not be 'unknown'"):
        Batch(signals=np.zeros((2, 10)), labels=np.array(["coal", "unknown"]), **about)


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


def test_scenes_and_samples_share_their_factors():
    pairs = {"force": "force", "acceleration": "acceleration", "speed": "velocity", "length": "displacement"}
    assert all(DIMENSIONS[dimension] is UNITS[quantity] for dimension, quantity in pairs.items())
    assert all(next(iter(units.values())) == 1.0 for units in DIMENSIONS.values())
    assert [seconds_of(unit) for unit in ("", "sec", "µs", "min", "kN")] == [1.0, 1.0, 1e-6, None, None]
    assert [hertz_of(unit) for unit in ("", "khz", "S/s", "sps", "s")] == [1.0, 1e3, 1.0, 1.0, None]
