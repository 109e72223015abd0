"""What is told while a recording is predicted: findings of its model, channels, grounds, cycles and coal, once each."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from cgid._lib.terminal import counted
from cgid.identification.model.anchor import MIN_ANCHOR, MIN_LUMPS, Basis
from cgid.identification.prediction.findings import Finding, Findings
from cgid.identification.prediction.fraction import followed, unproven

if TYPE_CHECKING:
    from cgid.identification.model.model import StoredModel
    from cgid.identification.prediction.fraction import Share
    from cgid.identification.prediction.settings import PredictionSettings
    from cgid.identification.prediction.support import CavingWatch, SupportReport

#: Impacts from which on it can be said what fell in a window.
_ENOUGH = 10
#: A caving cycle without a pause is told after this time [s]: it is some minutes long.
_LONGEST_CYCLE = 1800.0
#: What is no finding: a ground of which nothing is wrong, and one of the model, said of all supports.
_NO_FINDING = ("seen", "unproven")


def of_model(
    model: StoredModel,
    sampling_rate: float,
    settings: PredictionSettings,
    channels: Sequence[str] = (),
    *,
    decides: bool = True,
) -> list[Finding]:
    """Return what is known of a model before it identifies, or `decides`, anything at a sampling rate [Hz]."""
    found = []
    if len(channels) > 1 and (beams := untold_beams(model, channels, settings.same_beam)):
        found.append(Finding(kind="together", fields={"beam": "\n".join(beams)}))
    if model.beam is not None and not model.beam.beam.region.any():
        found.append(Finding(kind="one_place"))
    if model.is_of_few:
        found.append(Finding(kind="few_recordings"))
    if decides:
        found += of_chance(model, settings.shares.gangue)
    if not model.covers(sampling_rate):
        found.append(Finding(kind="untrained_rate", fields={"rate": sampling_rate, "rates": model.rates_text}))
    return found


def of_chance(model: StoredModel, gangue: Sequence[str]) -> list[Finding]:
    """Return why neither SHUT nor OPEN follows from a model, if so."""
    if not (reason := unproven(model, gangue)):
        return []
    return [Finding(kind="follows_machines" if followed(model.training) else "unproven", fields={"reason": reason})]


def untold_beams(model: StoredModel, channels: Sequence[str], given: Sequence[object]) -> tuple[str, ...]:
    """Return the channels of each beam, joined by "+" as in the training, where several channels lack them."""
    if given or not model.same_beam or len(channels) < 2:
        return ()
    is_known = all(set(beam.split("+")) <= set(channels) for beam in model.same_beam)
    n = min(len(model.same_beam[0].split("+")), len(channels))
    return tuple(model.same_beam) if is_known else ("+".join(str(number) for number in range(1, n + 1)),)


logging.getLogger("cgid").addHandler(logging.NullHandler())  # who wants the lines adds a handler


class Telling(Findings):
    """The findings of one recording; those of its supports are made from their reports."""

    def __init__(self, model: StoredModel, settings: PredictionSettings) -> None:
        self.all, self._model, self._settings = [], model, settings
        self._grounds: dict[str, tuple[str, bool]] = {}  # last ground, and whether something was decided
        self._bases: dict[str, Basis] = {}  # last basis of the gangue fraction
        self._endless: set[str] = set()  # supports whose caving cycle goes on without a pause
        self._short: set[str] = set()  # supports that had a caving cycle shorter than its coal

    def of_reports(self, reports: Iterable[SupportReport], watch: CavingWatch) -> list[Finding]:
        """Return what begins and ends with the reports of supports."""
        found = []
        for report in reports:
            state, share = report.state, report.state.share
            found += self._of_basis(share)
            if report.kind != "share":
                found += self._of_ground(report, watch)
            begun = watch.cycles().get(share.channel, share.time) if self._settings.cycle_pause else share.time
            if share.time - begun > _LONGEST_CYCLE:
                found += self._of_cycle(share.channel, begun, state.time)
        short = watch.short_cycles()
        for name in short.keys() - self._short:
            self._short.add(name)
            begun, until = short[name]
            fields = {"begun": begun, "until": until, "coal": self._settings.coal_until}
            found.append(Finding(kind="short_cycle", channels=(name,), fields=fields))
        return found

    def at_end(self, duration: float, watch: CavingWatch) -> list[Finding]:
        """Return what is known at the end of a recording of this duration [s]."""
        found, stated, pause = list[Finding](), self._settings.coal_until, self._settings.cycle_pause
        if stated is not None and stated > duration:
            found.append(Finding(kind="late_coal", fields={"duration": duration, "stated": stated}))
        if pause is not None and duration > (stated or 0.0) + pause:
            for name, begun in watch.cycles().items():
                found += [] if begun else self._of_cycle(name, begun, duration)
        for label, spans in (("coal", self._settings.coal), ("gangue", self._settings.lumps)):
            if late := sum(one.start > duration for one in spans):
                fields = {"label": label, "duration": duration, "late": counted(late, "row")}
                found.append(Finding(kind="late_labels", fields=fields))
        return found

    def _of_ground(self, report: SupportReport, watch: CavingWatch) -> list[Finding]:
        """Return that a ground is lost or won, unless a finding says why, or that too few impacts are identified."""
        state, channel, found = report.state, (report.state.share.channel,), list[Finding]()
        ground, decided = self._grounds.get(channel[0], ("seen", False))
        self._grounds[channel[0]] = str(state.ground), state.decision != "none"
        if not decided and state.decision != "none":
            found.append(Finding(kind="too_few", channels=channel, end=state.time))
        elif decided and state.decision == "none" and ground == state.ground == "seen":
            found.append(Finding(kind="too_few", channels=channel, begin=state.time))
        if state.ground == ground:
            return found
        if ground not in _NO_FINDING:
            found.append(Finding(kind=ground, channels=channel, end=state.time))
        if state.ground not in _NO_FINDING:
            fields = {"reason": state.reason}
            one = Finding(kind=str(state.ground), channels=channel, begin=state.since, fields=fields)
            found += [] if one.is_explained and watch.diagnosis.stands(channel[0]) else [one]
        return found

    def _of_cycle(self, channel: str, begun: float, until: float) -> list[Finding]:
        """Return that a support had no pause since its caving cycle has begun [s], once."""
        if channel in self._endless:
            return []
        self._endless.add(channel)
        fields = {"pause": self._settings.cycle_pause, "begun": begun, "until": until}
        return [Finding(kind="endless", channels=(channel,), fields=fields)]

    def _of_basis(self, share: Share) -> list[Finding]:
        """Return why the gangue fraction of a support is not that of its own seam, when that begins."""
        basis = share.basis
        if basis == self._bases.get(share.channel) or not (share.n_impacts or basis == Basis.TOO_FEW):
            return []
        if basis in (Basis.ANY_SEAM, Basis.TRAINED) and (
            share.n_impacts < _ENOUGH or share.time < self._settings.shares.window
        ):
            return []  # nobody can say what fell at the beginning of so short a recording
        self._bases[share.channel] = basis
        stated = self._settings.coal_until
        coal = "the labelled coal" if stated is None else f"the coal of {stated:.6g} s"
        kind = {
            Basis.TOO_FEW: "coal_too_few",
            Basis.FOREIGN: "coal_foreign",
            Basis.FEW_LUMPS: "lumps_too_few",
            Basis.WRONG_LUMPS: "lumps_foreign",
            Basis.TRAINED: "of_blows" if self._model.is_of_blows else "",
            Basis.ANY_SEAM: "any_seam" if len(self._bases) == 1 else "",
        }.get(basis)
        if not kind:
            return []
        fields = {"coal": coal, "until": share.time, "least": MIN_LUMPS if basis == Basis.FEW_LUMPS else MIN_ANCHOR}
        return [Finding(kind=kind, channels=(share.channel,), fields=fields)]


def warn(found: Iterable[Finding], source: str, n_channels: int, stacklevel: int) -> None:
    """Give findings to users of Python: each a `UserWarning`, but for notes, and a line of the logger "cgid"."""
    log = logging.getLogger("cgid")
    for one in found:
        if not one.is_of_fraction and (line := one.line(source, n_channels)):
            log.log(logging.INFO if one.is_note or one.is_over else logging.WARNING, line, extra={"finding": one})
            if not one.is_note and not one.is_over:
                warnings.warn(one.warning(line), stacklevel=stacklevel)
