"""The measuring chain from a sensor to the numbers of a file: sensitivity, gain and full scale of each channel.

A number of a file times full scale is a voltage; over the gain it is the output of the sensor; over the sensitivity it
is the measured quantity. The conversion is done once, on input: then samples are in N, m/s^2 or another SI unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from cgid._lib import validation
from cgid._lib.spelling import spelled
from cgid._lib.validation import shown
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.signals import channel_name
from cgid.units import ELECTRICAL, UNITS, known_unit, number_and_unit, quantity_of, ratio_of

if TYPE_CHECKING:
    from cgid.recordings.recording import Blocks

#: Settings of a chain: one value for all channels, a mapping of names or numbers (from 1) to values, or
#: several texts, each a value or NAME=VALUE.
Statement = float | str | Mapping[int | str, float | str] | Sequence[float | str]

#: Quantities of sensors with a sensitivity.
_MEASURED = ("force", "acceleration", "velocity", "displacement", "pressure")
#: Tolerance between values of file and user, relative, and limits of a factor of samples.
_TOLERANCE, _FACTORS = 1e-3, (1e-30, 1e30)
_MAX_BITS, _LONGEST = 64, 200
_LOUDEST = 400.0
_TIMES = re.compile(r"[x×]\s*(.+)|(.+?)\s*[x×]", re.IGNORECASE)
_FULL_SCALE = re.compile(r"(?:±|\+/?-)?\s*(.*?)(?:\s+at\s+([0-9]{1,3})\s*bits?)?", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True)
class Sensitivity:
    """The signal of a sensor per unit of the measured quantity, in SI units such as V/(m/s^2)."""

    value: float
    signal: str
    measured: str
    text: str = field(compare=False)

    @classmethod
    def of(cls, given: Any) -> Sensitivity:
        """Return the sensitivity of a text; raise `InvalidValue` if it is none."""
        text = _text(given)
        found = number_and_unit(text)
        ratio = None if found is None else ratio_of(found[1])
        if found is None or ratio is None or ratio[0] not in ELECTRICAL or ratio[1] not in _MEASURED:
            raise InvalidValue(
                "sensitivity must be a voltage or a charge for a unit of acceleration or force, such as '10.2 mV/g', "
                f"'2.3 mV/N' or '3.1 pC/g', got {shown(given)}"
            )
        value = found[0] * ratio[2]
        if not 0 < value < math.inf:
            raise InvalidValue(
                f"sensitivity must be above 0 and finite, got {text}; for a reversed sensor use "
                f"{spelled('invert', 'true')}"
            )
        return cls(value=value, signal=ratio[0], measured=ratio[1], text=text)


@dataclass(frozen=True, kw_only=True)
class Gain:
    """The factor of an amplifier; that of a charge amplifier is in V/C."""

    value: float
    is_of_charge: bool = False
    text: str = field(compare=False)

    @classmethod
    def of(cls, given: Any) -> Gain:
        """Return the gain of a number or a text; raise `InvalidValue` if it is none."""
        text = _text(given)
        times = _TIMES.fullmatch(text)
        number, unit = number_and_unit((times[1] or times[2]) if times else text) or (math.nan, "")
        ratio = ratio_of(unit)
        if unit.lower() == "db" and not times:
            if not abs(number) <= _LOUDEST:
                raise InvalidValue(f"gain must be between -{_LOUDEST:g} and {_LOUDEST:g} dB, got {number:g} dB")
            return cls(value=float(10.0 ** (number / 20)), text=text)
        is_of_charge = ratio is not None and ratio[:2] == ("voltage", "charge")
        if math.isnan(number) or (unit and not is_of_charge):
            raise InvalidValue(
                "gain must be a number, a factor or in dB, or that of a charge amplifier such as "
                f"'1 mV/pC', got {shown(given)}"
            )
        if not 0 < number < math.inf:
            raise InvalidValue(
                f"gain must be above 0 and finite, got {text}; to invert a signal use {spelled('invert', 'true')}"
            )
        return cls(value=number * (ratio[2] if ratio and is_of_charge else 1.0), is_of_charge=is_of_charge, text=text)


@dataclass(frozen=True, kw_only=True)
class FullScale:
    """The value of a sample at full scale; `bits` is the resolution of the converter of integers."""

    value: float
    unit: str | None = None
    bits: int | None = None
    text: str = field(compare=False)

    @classmethod
    def of(cls, given: Any) -> FullScale:
        """Return the full scale of a number or a text; raise `InvalidValue` if it is none."""
        text = _text(given)
        found = _FULL_SCALE.fullmatch(text)
        number, unit = number_and_unit(found[1] if found else "") or (math.nan, "")
        bits = int(found[2]) if found and found[2] else None
        if math.isnan(number) or (unit and known_unit(unit) in (None, "FS")):
            raise InvalidValue(
                "full_scale must be a number with a unit such as '10 V' or '50 g', or '10 V at 24 bit' for integers of "
                f"a converter, got {shown(given)}"
            )
        if not 0 < number < math.inf:
            raise InvalidValue(f"full_scale must be above 0 and finite, got {text}")
        if bits is not None and not 2 <= bits <= _MAX_BITS:
            raise InvalidValue(f"full_scale must be at 2 to {_MAX_BITS} bit, got {bits}")
        return cls(value=number, unit=known_unit(unit) if unit else None, bits=bits, text=text)


def _text(given: Any) -> str:
    """Return a short text with single blanks, a number with all its digits, "" for anything else."""
    if isinstance(given, Real) and not isinstance(given, bool):
        return repr(float(given)).removesuffix(".0")
    return " ".join(given.split()) if isinstance(given, str) and len(given) <= _LONGEST else ""


@dataclass(frozen=True)
class Unit:
    """The unit of samples."""

    text: str

    @classmethod
    def of(cls, given: Any) -> Unit:
        """Return a known unit; raise `InvalidValue` for another one."""
        validation.instance("unit", given, str)
        quantity_of(given)
        return cls(given)


Part = TypeVar("Part", Sensitivity, Gain, FullScale, Unit)
#: What may be stated of a chain, by the name of its option.
PARTS: Mapping[str, Any] = {"sensitivity": Sensitivity, "gain": Gain, "full_scale": FullScale, "unit": Unit}
_T = TypeVar("_T")


@dataclass(frozen=True)
class _Stated(Generic[Part]):
    """Values stated for all channels (key None) or for one, by name or number."""

    name: str
    values: tuple[tuple[int | str | None, Part], ...] = ()
    fallback: _Stated[Part] | None = None  # asked where these say nothing of a channel

    def at(self, index: int, contents: Blocks, source: str) -> tuple[Part | None, bool]:
        """Return the value for a channel, and whether it is only for this channel; two must not differ."""
        if not self.values:
            return (None, False) if self.fallback is None else self.fallback.at(index, contents, source)
        option = spelled(f"channels.CHANNEL.{self.name}", "VALUE")
        of_channel = [
            value for key, value in self.values if key is not None and index in contents.selected(key, source, option)
        ]
        values = of_channel or [value for key, value in self.values if key is None]
        for other in values[1:]:
            if other != values[0]:
                raise InvalidValue(
                    f"{source}: channel {contents.label(index)} must have one {self.name}, got {values[0].text} and "
                    f"{other.text}; leave one out"
                )
        if not values and self.fallback is not None:
            return self.fallback.at(index, contents, source)
        return (values[0] if values else None), bool(of_channel)


def _stated(name: str, kind: type[Part], given: Statement) -> _Stated[Part]:
    pairs: list[tuple[int | str | None, Any]] = []
    if isinstance(given, Mapping):
        pairs += given.items()
    else:
        is_list = isinstance(given, Sequence) and not isinstance(given, str | bytes)
        listed: Sequence[Any] = given if is_list else [given]  # type: ignore[assignment]
        for one in listed:
            channel, equals, value = one.rpartition("=") if isinstance(one, str) else ("", "", one)
            if equals and not channel.strip():
                raise InvalidValue(f"{name} must name the channel before =, as in 2=VALUE, got {shown(one)}")
            pairs.append((channel.strip() if equals else None, value))
    return _Stated(name, tuple((channel, kind.of(value)) for channel, value in pairs))


def units_of(given: str | None) -> _Stated[Unit]:
    """Return the units of a text: one for all channels, or NAME=UNIT of some, divided by commas."""
    is_by_name = isinstance(given, str) and "=" in given
    pairs = [one.strip() for one in given.split(",")] if is_by_name and given else given
    return _Stated("unit") if pairs is None else _stated("unit", Unit, pairs)


@dataclass(frozen=True, kw_only=True)
class Link:
    """Conversion of a channel: times `factor` samples are in `unit`; `origin` describes it, "" if unchanged."""

    unit: str | None
    factor: float = 1.0
    origin: str = ""

    def inverted(self) -> Link:
        """Return the link of a sensor that is upside down."""
        return replace(self, factor=-self.factor, origin=", ".join(filter(None, [self.origin, "inverted"])))


@dataclass(frozen=True, kw_only=True)
class Chain:
    """The user's statements about the measuring chains of a recording."""

    sensitivity: _Stated[Sensitivity] = _Stated("sensitivity")
    gain: _Stated[Gain] = _Stated("gain")
    full_scale: _Stated[FullScale] = _Stated("full_scale")
    unit: _Stated[Unit] = _Stated("unit")
    inverted: tuple[tuple[int | None, bool], ...] = ()  # whether channels point downwards, by number; None: all others

    @classmethod
    def of(
        cls, sensitivity: Statement | None = None, gain: Statement | None = None, full_scale: Statement | None = None
    ) -> Chain:
        """Return the chain of some statements; raise `InvalidValue` if one is wrong."""
        given = {"sensitivity": sensitivity, "gain": gain, "full_scale": full_scale}
        stated: dict[str, Any] = {
            name: _stated(name, PARTS[name], one) for name, one in given.items() if one is not None
        }
        return cls(**stated)

    @classmethod
    def of_site(cls, general: Mapping[str, Any], own: Mapping[int, Mapping[str, Any]]) -> Chain:
        """Return the chain of a site file: values of all channels, and those of some by number."""
        every: list[tuple[int | None, Mapping[str, Any]]] = [(None, general), *own.items()]
        stated: dict[str, Any] = {
            name: _Stated(name, tuple((number, kind.of(keys[name])) for number, keys in every if name in keys))
            for name, kind in PARTS.items()
        }
        turned = {number: keys["invert"] for number, keys in every if "invert" in keys}
        return cls(**stated, inverted=tuple(turned.items()))

    def beside(self, other: Chain) -> Chain:
        """Return this chain, where it says nothing of a channel the other one."""
        both: dict[str, Any] = {name: replace(getattr(self, name), fallback=getattr(other, name)) for name in PARTS}
        return Chain(**both, inverted=other.inverted)

    def links(self, contents: Blocks, channels: Sequence[int], unit: str | None, source: str) -> list[Link]:
        """Return the link of each channel, from the statements of user and file, which must agree."""
        # Nothing to convert: the file states units and no more, or the user a known one for all channels.
        of_file, is_of_file = (*contents.integers, *contents.sensitivities, *contents.gains), unit is None
        is_of_user = isinstance(unit, str) and not any(contents.units) and any(unit in of for of in UNITS.values())
        if self == Chain() and not any(of_file) and (is_of_file or is_of_user):
            return [Link(unit=contents.unit(index, None, source) if is_of_file else unit) for index in channels]
        # A sensitivity or charge gain for all channels applies to those in volts or coulombs; there must be at least
        # one.
        units = replace(units_of(unit), fallback=self.unit)
        scaled_links = [self._scaled(contents, index, units, source) for index in channels]
        is_some = any(link.unit and quantity_of(link.unit) in ELECTRICAL for link in scaled_links)
        found = [
            self._measured(link, contents, index, source, is_some=is_some)
            for index, link in zip(channels, scaled_links, strict=True)
        ]
        turned = dict(self.inverted)
        downwards = [turned.get(index + 1, turned.get(None, False)) for index in channels]
        return [link.inverted() if down else link for link, down in zip(found, downwards, strict=True)]

    def _scaled(self, contents: Blocks, index: int, units: _Stated[Unit], source: str) -> Link:
        """Return the link through full scale and amplification."""
        unit, _ = units.at(index, contents, source)
        unit_text, factor, origin = contents.unit(index, unit.text if unit else None, source), 1.0, []
        scale, _ = self.full_scale.at(index, contents, source)
        if scale is not None:
            unit_text, factor = _full_scale(scale, unit_text, contents, index, source)
            origin.append(f"{scale.text} at full scale")
        else:
            _require_full_scale(unit_text, contents, index, source)
        gain, _ = self.gain.at(index, contents, source)
        if gain is not None and not gain.is_of_charge:
            factor /= gain.value
            origin.append(f"gain {gain.text}")
        return Link(unit=unit_text, factor=factor, origin=", ".join(origin))

    def _measured(self, link: Link, contents: Blocks, index: int, source: str, *, is_some: bool) -> Link:
        """Return the link through charge gain and sensitivity, too."""
        sensitivity, is_own = self.sensitivity.at(index, contents, source)
        gain, is_own_gain = self.gain.at(index, contents, source)
        name = channel_name(source, contents.label(index))
        quantity = None if link.unit is None else quantity_of(link.unit)
        if quantity not in ELECTRICAL:
            is_meant = is_own or is_own_gain or not is_some
            of_charge = gain is not None and gain.is_of_charge
            if is_meant and (sensitivity is not None or of_charge):
                raise _not_electrical(name, link.unit, "sensitivity" if sensitivity is not None else "gain")
            return _bounded(link, name)
        assert link.unit is not None
        sensitivity = _agreed(sensitivity, _of_file(contents.sensitivities, index), name)
        if sensitivity is None:
            if gain is not None and gain.is_of_charge:
                raise MissingOption(
                    f"{name}: a gain of {gain.text} gives a charge, the sensitivity of the sensor is missing; give it "
                    f"as in {spelled('sensitivity', '3.1 pC/g')}"
                )
            return _bounded(link, name)
        factor, origin = link.factor * UNITS[str(quantity)][link.unit] / sensitivity.value, [link.origin]
        charge_gain = _charge_gain(gain, _of_file(contents.gains, index), sensitivity, str(quantity), name)
        if charge_gain is not None:
            factor /= charge_gain.value
            origin.append(f"gain {charge_gain.text}")
        return _bounded(
            Link(
                unit=next(iter(UNITS[sensitivity.measured])),
                factor=factor,
                origin=", ".join(filter(None, [f"from {link.unit}", *origin, f"sensitivity {sensitivity.text}"])),
            ),
            name,
        )


def _full_scale(scale: FullScale, stated: str | None, contents: Blocks, index: int, source: str) -> tuple[str, float]:
    """Return unit and factor of the numbers of a channel whose full scale is known."""
    name = channel_name(source, contents.label(index))
    stated = None if stated == "FS" else stated
    unit = scale.unit or stated
    if unit is None:
        raise MissingOption(
            f"{name}: the unit of full scale must be known, got {scale.text}; give it as in "
            f"{spelled('full_scale', '10 V')}"
        )
    if stated is not None and quantity_of(stated) != quantity_of(unit):
        raise InvalidValue(
            f"{name}: full_scale must be of the quantity of the samples, got {scale.text} where file or "
            f"{spelled('unit')} say {stated} ({quantity_of(stated)}); leave one out"
        )
    largest = _of_file(contents.full_scales, index)
    if scale.bits is not None:
        if largest == 1.0:
            raise InvalidValue(f"{name}: full_scale must leave out the bits, got {scale.text}, the file states them")
        largest = 2.0 ** (scale.bits - 1)
    if largest is None:
        cure = f"give the bits of the converter, as in '{scale.value:g} {unit} at 24 bit'"
        if stated is not None:
            others = f"a command of several files takes it for others alone as in 'OTHER.wav:{scale.value:g} {unit}'"
            cure = f"its numbers are in {stated}: leave it out ({others}), or {cure}"
        raise InvalidValue(
            f"{name}: full_scale must be that of a sound file or of signed integers of 16 bit, the file does not state "
            f"its largest number; {cure}"
        )
    return unit, scale.value / largest


def _require_full_scale(unit: str | None, contents: Blocks, index: int, source: str) -> None:
    """Raise `MissingOption` for integers of which only the unit is known, not how many of it one step is."""
    if not _of_file(contents.integers, index) or unit in (None, "FS"):
        return
    assert unit is not None
    bits = "" if _of_file(contents.full_scales, index) else " at 24 bit"
    example = {"acceleration": "500 g", "voltage": "10 V"}.get(quantity_of(unit), f"500 {unit}")
    raise MissingOption(
        f"{channel_name(source, contents.label(index))}: the samples are integers, and the unit ({unit}) does not "
        f"state how many {unit} full scale is; give it as in {spelled('full_scale', example + bits)}"
    )


def _charge_gain(
    gain: Gain | None, stated: str | None, sensitivity: Sensitivity, quantity: str, name: str
) -> Gain | None:
    """Return the gain of the charge amplifier between sensor and samples, None without one."""
    needed = sensitivity.signal == "charge" and quantity == "voltage"
    if gain is None and stated is not None:
        gain = _gain_of_file(stated, needed, name)
    if needed:
        if gain is None or not gain.is_of_charge:
            raise MissingOption(
                f"{name}: a sensitivity of {sensitivity.text} gives a charge and the samples are a voltage, the gain "
                f"of the charge amplifier is missing; give it as in {spelled('gain', '1 mV/pC')}"
            )
        return gain
    if sensitivity.signal != quantity:
        raise InvalidValue(
            f"{name}: sensitivity must be a charge for samples that are one, such as '3.1 pC/g', got {sensitivity.text}"
        )
    if gain is not None and gain.is_of_charge:
        raise InvalidValue(
            f"{name}: a gain of {gain.text} is for a sensor that gives a charge and samples in volts, the sensitivity "
            f"is {sensitivity.text} and the samples are a {quantity}; leave the gain out or correct it"
        )
    return None


def _gain_of_file(text: str, needed: bool, name: str) -> Gain | None:
    """Return the charge gain stated by a file; raise `MissingOption` if it may already be in the samples."""
    try:
        gain: Gain | None = Gain.of(text)
    except InvalidValue:
        gain = None
    if gain is not None and gain.is_of_charge == needed and (needed or gain.value == 1.0):
        return gain if needed else None
    raise MissingOption(
        f"{name}: the file states a gain ({text[:40]}) and not whether the samples contain it; give "
        f"{spelled('gain', 'VALUE')} to have it divided out, or {spelled('gain', '1')} if that is done"
    )


def _agreed(given: Sensitivity | None, stated: str | None, name: str) -> Sensitivity | None:
    """Return the sensitivity of user and file, which must agree to 0.1 %."""
    if stated is None:
        return given
    try:
        parsed = Sensitivity.of(stated)
    except InvalidValue as error:
        raise BadData(f"{name}: in the file, {error}") from None
    if given is None:
        return parsed
    alike = (given.signal, given.measured) == (parsed.signal, parsed.measured)
    if not alike or abs(given.value - parsed.value) > _TOLERANCE * min(given.value, parsed.value):
        raise InvalidValue(
            f"{name}: sensitivity must agree with the file to 0.1 %, got {given.text} where it states {parsed.text}; "
            "leave "
            "out the sensitivity, or correct it"
        )
    return given


def _not_electrical(name: str, unit: str | None, what: str) -> InvalidValue | MissingOption:
    if unit is None:
        return MissingOption(
            f"{name}: the file does not state the unit, and a {what} is for samples in volts or coulombs; give it as "
            f"in {spelled('unit', 'V')}"
        )
    if unit == "FS":
        return MissingOption(
            f"{name}: the file does not state how many volts full scale is, and a {what} is for volts; give it as in "
            f"{spelled('full_scale', '10 V')}"
        )
    return InvalidValue(
        f"{name}: a {what} is for samples in volts or coulombs, they are in {unit} ({quantity_of(unit)}); leave it "
        f"out, or name the channel that it is for, as in {spelled(f'channels.2.{what}', 'VALUE')}"
    )


def _bounded(link: Link, name: str) -> Link:
    if not _FACTORS[0] <= link.factor <= _FACTORS[1]:
        raise InvalidValue(
            f"{name}: sensitivity, gain and full scale must make a factor between {_FACTORS[0]:g} and {_FACTORS[1]:g}, "
            f"they make {link.factor:g}; correct them"
        )
    return link


def _of_file(stated: Sequence[_T | None], index: int) -> _T | None:
    return stated[index] if index < len(stated) else None


def scaled(blocks: Iterable[NDArray[Any]], factors: Sequence[float]) -> Iterable[NDArray[Any]]:
    """Return blocks (n_channels, n_samples) with channels multiplied by their factors."""
    if all(factor == 1.0 for factor in factors):
        return blocks
    column = np.array(factors)[:, np.newaxis]

    def times(block: NDArray[Any]) -> NDArray[Any]:
        with np.errstate(over="ignore"):  # infinite samples are refused later
            return np.asarray(block * column.astype(block.dtype))

    return map(times, blocks)


def require_measured(unit: str | None, name: str) -> None:
    """Raise `MissingOption` for samples in volts or coulombs without a sensitivity."""
    if unit is None or (quantity := quantity_of(unit)) not in ELECTRICAL:
        return
    example, other = ("10.2 mV/g", "2.3 mV/N") if quantity == "voltage" else ("3.1 pC/g", "4 pC/N")
    raise MissingOption(
        f"{name}: the samples are a {quantity} [{unit}], the sensitivity of the sensor is missing; give it as in "
        f"{spelled('sensitivity', example)}, or {other!r} of a force"
    )
