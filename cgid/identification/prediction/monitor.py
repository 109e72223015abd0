"""A live stream in Python: its blocks in, and what is new of it out, as `cgid monitor` prints it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import RLock, Thread
from types import TracebackType
from typing import TYPE_CHECKING, Any, NoReturn, Self, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cgid._lib import validation
from cgid._lib.validation import require_rate
from cgid.errors import BadData, InvalidValue, MissingOption
from cgid.identification.model.model import Model
from cgid.identification.prediction.answers import Answer
from cgid.identification.prediction.findings import Finding
from cgid.identification.prediction.pipeline import Pipeline
from cgid.identification.prediction.records import RecordingRows, Records
from cgid.identification.prediction.settings import GivenSettings, PredictionSettings
from cgid.identification.prediction.stream import Step
from cgid.identification.prediction.support import STEPS, SupportReport, SupportState
from cgid.recordings.chain import Chain, Statement, scaled
from cgid.recordings.live import Inbox, contents_of, described
from cgid.recordings.site import NOWHERE, Site
from cgid.recordings.variables import full_scale_of

if TYPE_CHECKING:
    from cgid.plant import PlantOutputs

__all__ = ["Monitor", "News"]


@dataclass(frozen=True, kw_only=True, eq=False)
class News:
    """What is new of a stream.

    Attributes
    ----------
    answers : list of Answer
        The impacts or windows that were identified, in order of time.
    reports : list of SupportReport
        The records of supports: each `kind` is "share" (a regular one), "state" (its ground or decision has changed),
        "shut" or "open"; each `state` is a `SupportState`.
    findings : list of Finding
        What begins and what ends.
    until : float [s]
        All before this time has been told.
    """

    answers: list[Answer]
    reports: list[SupportReport]
    findings: list[Finding]
    until: float

    @property
    def states(self) -> list[SupportState]:
        """The records of its reports, in order of time."""
        return [report.state for report in self.reports]


class Monitor:
    """Identify the impacts of a live stream block by block, and decide when to shut, as `cgid monitor` does.

    What is told of the same samples does not depend on the lengths of the blocks, but for last digits: on a beam they
    choose another optimum for some two impacts in a thousand. Methods may be called in any thread;
    one call runs at a time. `feed` takes as long as its samples need, some hundredth of their duration for a channel: a
    callback that must return at once puts its blocks into a `queue.Queue`, from which another thread feeds.

    Parameters
    ----------
    sampling_rate : float, optional [Hz]
        Required, unless the site states it; so are `channels` and `unit`.
    channels : int or sequence of str, optional
        Number or names of the channels.
    unit : str, optional
        One of `cgid.units.UNITS`, such as "m/s^2", "g", "N" or "V".
    model : Model, str or Path, optional
        A model, or an argument of `cgid.load_model`; by default the shipped one for this quantity.
    site : Site, str or Path, optional
        A site, or its file, which states what the other arguments do not.
    sensitivity, gain, full_scale : optional
        Conversion of volts, coulombs or integers, as in `cgid.open_recording`. With a `full_scale`, blocks of 8 or 16
        bit integers are parts of it.
    source : str
        Name of the stream in messages.
    renew : bool
        Whether the next impacts of each channel replace its own past, which is kept in a file beside the site's.
    outputs : PlantOutputs, optional
        Plant outputs, such as ``cgid.plant.PlantOutputs(live=":8080")``: they get what `cgid monitor` gives them, and
        end with the context.
    **settings
        Fields of `cgid.identification.prediction.PredictionSettings`, such as ``coal_until=30.0``.

    Raises
    ------
    InvalidValue, MissingOption, BadData, NoInput
        As `cgid.predict`.

    Examples
    --------
    >>> import numpy as np
    >>> time = np.arange(20_000) / 200e3
    >>> blow = 8e3 * np.sin(np.pi * np.clip((time - 40e-3) / 0.4e-3, 0, 1)) ** 1.5
    >>> samples = blow + np.random.default_rng(0).normal(0, 50, time.size)
    >>> with Monitor(200e3, 1, "N") as watch:
    ...     found = [one for block in samples.reshape(-1, 500) for one in watch.feed(block).answers]
    ...     found += watch.finish().answers
    >>> len(found), round(found[0].time, 4)
    (1, 0.04)
    """

    def __init__(  # noqa: PLR0913 - as open_recording
        self,
        sampling_rate: float | None = None,
        channels: int | Sequence[str] | None = None,
        unit: str | None = None,
        *,
        model: Model | str | Path | None = None,
        site: Site | str | Path | None = None,
        sensitivity: Statement | None = None,
        gain: Statement | None = None,
        full_scale: Statement | None = None,
        source: str = "stream",
        renew: bool = False,
        outputs: PlantOutputs | None = None,
        **settings: Unpack[GivenSettings],
    ) -> None:
        from cgid.identification.prediction.pasts import Pasts
        from cgid.identification.prediction.prediction import default_model, read_model

        for name in settings:
            validation.choice("setting", name, tuple(PredictionSettings.__dataclass_fields__))
        place = NOWHERE if site is None else Site.of(site)
        rate = place.get("rate") if sampling_rate is None else sampling_rate
        given = place.get("channels") if channels is None else channels
        for name, value in (("sampling_rate", rate), ("channels", given)):
            if value is None:
                raise MissingOption(f"{name} must be given, a stream of arrays does not state it; give {name}")
        names = None if isinstance(given, int) else [str(one) for one in given]
        count = validation.count("channels", given) if names is None else len(names)
        contents = contents_of(count, "FS" if full_scale is not None else None, names=names)
        described_as = described(contents, unit, Chain.of(sensitivity, gain, full_scale), place, source)
        self._channels, self._factors, beams = described_as
        applied = PredictionSettings(**{"batch": 1, "same_beam": beams, **place.settings, **settings})
        applied = replace(applied, share_step=applied.share_step or applied.shares.window / STEPS)
        model = place.get("model") if model is None else model
        loaded = read_model(default_model(self._channels[0].quantity, applied) if model is None else model)
        applied.check(loaded)
        self.sampling_rate: float = require_rate(rate)
        self.source = source
        pasts = Pasts.of_site(place, loaded, self.sampling_rate, renew=renew)
        self._pipeline = Pipeline(loaded, self._channels, self.sampling_rate, applied, source, live=True, pasts=pasts)
        self._inbox = Inbox(self.sampling_rate, patience=None)
        self._rows, self._outputs = RecordingRows(self._pipeline, Records()), outputs
        if outputs is not None:
            self._rows.attach(outputs, self._inbox)
        self._until = 0.0
        self._has_integers, self._is_over, self._lock = full_scale is not None, False, RLock()
        self._pump = _Pump(self._rows.steps, self._inbox)
        weakref.finalize(self, self._inbox.end)

    @property
    def supports(self) -> tuple[str, ...]:
        """Names of the channels of answers; those that are used together have one."""
        return self._pipeline.supports

    @property
    def duration(self) -> float:
        """Duration of the samples that were fed [s]."""
        return self._inbox.n_given / self.sampling_rate

    @property
    def states(self) -> list[SupportState]:
        """The latest record of each support."""
        with self._lock:
            return [] if self._pipeline.watch is None else self._pipeline.watch.states()

    def feed(self, block: ArrayLike) -> News:
        """Take the next samples, (n_samples,) or (n_samples, n_channels), and return what is new.

        They are copied. Raises `BadData` for samples of another shape, `InvalidValue` after `finish`.
        """
        with self._lock:
            if self._is_over:
                self._refuse()
            self._inbox.put(self._taken(block))
            return self._news(self._pump.taken())

    def finish(self) -> News:
        """Return what is new at the end of the stream.

        Raises `BadData` if it had no sample that a sensor can give.
        """
        with self._lock:
            if self._is_over:
                self._refuse()
            self._is_over = True
            self._inbox.end()
            news = self._news([*self._pump.taken(), self._rows.finish()])
            self._pipeline.require()
            return news

    def stopped(self, seconds: float) -> News:
        """Return what is new where no samples have come for some time [s]: nothing is decided until they come."""
        with self._lock:
            return self._news([self._rows.stopped(seconds)])

    def begin_cycle(self, support: str = "") -> None:
        """Begin a caving cycle now, with coal of its own: of a support, or of all."""
        with self._lock:
            if self._pipeline.watch is not None:
                self._pipeline.watch.begin_cycle(self.duration, support)

    def close(self) -> None:
        """End without the last news, and end the outputs; the context does so, too."""
        with self._lock:
            self._is_over = True
            self._inbox.end()
            if self._outputs is not None:
                self._outputs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _refuse(self) -> NoReturn:
        raise InvalidValue(f"{self.source}: a monitor must be fed before its end, it has ended; make another one")

    def _taken(self, block: ArrayLike) -> NDArray[Any]:
        samples = validation.plain("block", block)
        samples = samples[:, None] if samples.ndim == 1 else samples
        if samples.ndim != 2 or samples.shape[1] != len(self._channels):
            raise BadData(
                f"{self.source}: a block must be (n_samples, {len(self._channels)}), got shape {np.shape(block)}"
            )
        if samples.dtype.kind == "f":
            return self._scaled(np.array(samples.T, order="C"))
        largest = full_scale_of(samples.dtype) if self._has_integers else None
        if largest is None:
            raise BadData(
                f"{self.source}: a block must be of floats, or with full_scale of 8 or 16 bit integers, got "
                f"{samples.dtype}"
            )
        return self._scaled(np.ascontiguousarray(samples.T / largest))

    def _scaled(self, samples: NDArray[Any]) -> NDArray[Any]:
        (block,) = scaled([samples], self._factors)
        return block

    def _news(self, steps: list[Step]) -> News:
        self._until = max([self._until, *(step.until for step in steps)])
        return News(
            answers=[one for step in steps for one in step.answers],
            reports=[one for step in steps for one in step.reports],
            findings=[one for step in steps for one in step.found],
            until=self._until,
        )


class _Pump:
    """Run the steps of an inbox in a thread of their own; each call waits until they ask for more than there is."""

    # It does not know its monitor, which may be forgotten without its end.

    def __init__(self, steps: Callable[[Inbox], Iterator[Step]], inbox: Inbox) -> None:
        self._inbox = inbox
        self._steps: list[Step] = []
        self._fault: BaseException | None = None
        Thread(target=self._run, args=(steps,), daemon=True).start()

    def taken(self) -> list[Step]:
        """Return the steps of all samples that are enough for one."""
        self._inbox.wait_until_idle()
        steps, self._steps = self._steps, []
        fault, self._fault = self._fault, None
        if fault is not None:
            raise fault
        return steps

    def _run(self, steps: Callable[[Inbox], Iterator[Step]]) -> None:
        try:
            for step in steps(self._inbox):
                self._steps.append(step)
        except BaseException as error:  # raised again where the block was fed
            self._fault = error
        finally:
            self._inbox.close()
