"""What is asked of a recording, and its answers as they are printed: impacts or windows, shares, turns, a summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import click

from cgid.cli.answer_lines import AnswerLines, RecordingTally
from cgid.cli.model_choice import Models, parse_cost, warn_of_rate
from cgid.errors import CgidError

if TYPE_CHECKING:
    from cgid.cli.report_pages import Pages

F = TypeVar("F", bound=Callable[..., Any])
#: So many rows wait at most for one that can be measured.
_MOST_HELD = 1000
#: So many channels without impacts are told one by one.
_MOST_SILENT = 3


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What is asked of every recording.

    Attributes
    ----------
    models : Models
    decision : Decision
    drop_height, mass, dead_time, vote_time : float or None
    invert : bool
    sensors : tuple of str
    settings : ShareSettings
    shares_asked : bool
        Whether an option speaks of shares, so that they must be told.
    """

    models: Models
    decision: Any
    drop_height: float | None
    mass: float | None
    dead_time: float | None
    vote_time: float | None
    invert: bool
    sensors: tuple[str, ...]
    settings: Any
    shares_asked: bool

    @property
    def how(self) -> dict[str, Any]:
        """Return the arguments that `identify` and `identify_frames` share."""
        return {name: getattr(self.decision, name) for name in ("costs", "coverage", "class_conditional")}

    def warn_of_sensor(self, source: str, model: Any) -> None:
        """Say so if a model knows sensors and nobody says which one it is."""
        if model.sensors and not self.sensors:
            known = ", ".join(model.sensors)
            click.echo(
                f"cgid: warning: {source}: the model knows the response of some sensors, nothing makes up for that of "
                f"this one; give --sensor NAME if it is one of {known}",
                err=True,
            )

    def require_use(self, kind: str) -> None:
        """Refuse what has no meaning for what a model decides on: it would be overlooked in silence."""
        from cgid.errors import InvalidValue

        stray = {"impact": ("--vote", self.vote_time), "window": ("--dead-time", self.dead_time)}
        flag, given = stray[kind]
        if given is not None:
            raise InvalidValue(f"{flag} must be left out, this model decides on {kind}s")

    def question(self, **changes: Any) -> Any:
        """Return what is asked of every impact or window."""
        from cgid.identification.answering.question import Question

        given: dict[str, Any] = {} if self.vote_time is None else {"vote_time": self.vote_time}
        return Question(
            decision=self.decision,
            drop_height=self.drop_height,
            dead_time=self.dead_time,
            sensors=self.sensors,
            **given,
            **changes,
        )


def answering_options(command: F) -> F:
    """Add the options that say by which model, and how, is answered."""
    options: list[Callable[[Any], Any]] = [
        click.option("--model", "model_path", help="Model file; the default model of the quantity if not given."),
        click.option("--mass", type=float, help="Mass of the accelerated striker [kg]: force = mass x acceleration."),
        click.option("--drop-height", type=float, help="How far the rocks fell [m], for a model that needs to know."),
        click.option(
            "--cost", "costs", multiple=True, metavar="LABEL=COST", help="What missing this label costs, 1 by default."
        ),
        click.option(
            "--coverage",
            type=float,
            help="Reject impacts whose prediction set at this coverage (0.9) is not a single label.",
        ),
        click.option(
            "--class-conditional", is_flag=True, help="The coverage holds for each label, not only for their mix."
        ),
        click.option(
            "--vote", type=float, help="Windows are decided on together over so long [s], 0.5; 0: each alone."
        ),
        click.option(
            "--sensor", multiple=True, metavar="NAME", help="Sensor of the model's reference runs; or one a channel."
        ),
        click.option("--window", type=float, help="The gangue share looks back so long [s], 10."),
        click.option("--gangue", multiple=True, metavar="LABEL", help="Label that is gangue; may be given again."),
        click.option(
            "--gangue-cost", type=float, help="What a drawn gangue costs, in lost coal, 1: says when to shut."
        ),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def asked_of(options: dict[str, Any], dead_time: float | None, steps: int = 2) -> tuple[Asked, dict[str, Any]]:
    """Return what is asked, and the options that are left: those that say how to read.

    A share is told so many times within its window.
    """
    from cgid import validation
    from cgid.identification.answering.watch import GANGUE, SHARE_TIME, ShareSettings
    from cgid.identification.answers import Decision

    left = dict(options)
    names = ("model_path", "mass", "drop_height", "costs", "coverage", "class_conditional")
    path, mass, drop_height, costs, coverage, class_conditional = (left.pop(name) for name in names)
    vote, window, gangue, gangue_cost = (left.pop(name) for name in ("vote", "window", "gangue", "gangue_cost"))
    weights = dict(parse_cost(text) for text in costs)
    decision = Decision(costs=weights, coverage=coverage, class_conditional=class_conditional)
    length = SHARE_TIME if window is None else float(validation.positive("--window", window, "s"))
    settings = ShareSettings(
        length=length,
        step=length / steps,
        gangue=gangue or (GANGUE,),
        gangue_cost=1.0 if gangue_cost is None else float(validation.positive("--gangue-cost", gangue_cost)),
    )
    asked = Asked(
        models=Models(path, mass, drop_height, decision),
        decision=decision,
        drop_height=drop_height,
        mass=mass,
        dead_time=dead_time,
        vote_time=None if vote is None else float(validation.not_negative("--vote", vote, "s")),
        invert=bool(left.pop("invert")),
        sensors=left.pop("sensor"),
        settings=settings,
        shares_asked=bool(gangue) or window is not None or gangue_cost is not None,
    )
    return asked, left


class Telling:
    """Prints the answers for the channels of one recording that one model answers for.

    Parameters
    ----------
    source : str
        The recording's name.
    model : Model
    channels : sequence of str
    sampling_rate : float
        [Hz].
    asked : Asked
    lines : AnswerLines
    keep : bool
        Whether answers, shares and turns are kept.
    always : bool
        Whether all leaves at once: else rows wait for one that can be measured, and shares for a second row.
    """

    def __init__(
        self,
        source: str,
        model: Any,
        channels: Sequence[str],
        sampling_rate: float,
        asked: Asked,
        lines: AnswerLines,
        *,
        keep: bool = False,
        always: bool = False,
    ) -> None:
        from cgid.identification.answering.shutting import Turn
        from cgid.identification.answering.watch import CavingWatch
        from cgid.identification.answering.windows import answering_channels, independence

        self.source, self.lines = source, lines
        self.kind = "window" if model.kind == "window" else "impact"
        asked.require_use(self.kind)
        self.tally = RecordingTally(self.kind)
        self.channels = answering_channels(model, channels)
        self.answers: list[Any] = []
        self.shares: list[Any] = []
        self.turns: list[Any] = []
        self._keep, self._always, self._turn, self._asked = keep, always, Turn, asked
        self._numbers: Counter[str] = Counter()
        self._measured = always
        self._held_answers: list[Any] = []
        self._held_shares: list[Any] = []
        self._watch: CavingWatch | None = None
        self.threshold: float | None = None
        if asked.shares_asked or asked.settings.serve(model):
            weight = independence(model, asked.question().vote_time)
            self._watch = CavingWatch(model, self.channels, asked.settings, weight)
            self.threshold = self._watch.threshold

    def feed(self, answers: Sequence[Any], until: float) -> None:
        """Print the next answers, and the shares of windows that end by now [s]."""
        self.tally.add(answers)
        if self._keep:
            self.answers += answers
        self._measured = self._measured or any(answer.probabilities for answer in answers)
        self._held_answers += answers
        if self._measured or len(self._held_answers) > _MOST_HELD:
            self._print_answers()
        if self._watch is not None:
            self._tell(self._watch.feed(answers, until))

    def finish(self, duration: float, silent: Sequence[str] = (), start_time: Any = None) -> None:
        """Print what is left to tell at the end of a recording of so long [s], and which channels were silent.

        Raises
        ------
        BadData
            There was nothing, or nothing could be measured.
        """
        from cgid.errors import BadData

        if silent and not self.tally.total:
            raise BadData(silent[0])
        for message in silent[:_MOST_SILENT]:
            self.lines.warning(self.source, message)
        if len(silent) > _MOST_SILENT:
            more = f"{self.source}: and {len(silent) - _MOST_SILENT} more channels without {self.kind}s"
            self.lines.warning(self.source, more)
        if not self._measured and self.tally.total:
            first = self._held_answers[0] if self._held_answers else None
            more = f" (and so for all {self.tally.total} {self.kind}s)" if self.tally.total > 1 else ""
            problem = first.problem if first else "nothing in it can be measured"
            raise BadData(f"{self.name(first.channel) if first else self.source}: {problem}{more}")
        self._print_answers()
        if self._watch is not None:
            self._tell(self._watch.finish(duration))
        if self.tally.total > 1 or self._always:
            self.lines.summary(self.source, self.tally, duration, start_time)

    def name(self, channel: str) -> str:
        """Return source and channel in one word; the first channel has no name in JSON, as ever."""
        plain = channel == "1" and (self.lines.as_json or len(self.channels) == 1)
        return self.source if plain else f"{self.source} channel {channel}"

    def _print_answers(self) -> None:
        for answer in self._held_answers:
            self._numbers[answer.channel] += 1
            self.lines.answer(self.name(answer.channel), self._numbers[answer.channel], answer, self.kind)
        self._held_answers = []

    def _tell(self, told: Iterable[Any]) -> None:
        """Print shares and turns; a recording of one impact has none unless they were asked for."""
        self._held_shares += told
        if not (self._always or self._asked.shares_asked or self.tally.total > 1):
            return
        for one in self._held_shares:
            if self._keep:
                (self.turns if isinstance(one, self._turn) else self.shares).append(one)
            if isinstance(one, self._turn):
                self.lines.turn(self.name(one.share.channel), one, self._asked.settings.gangue_cost)
            elif one.n_impacts or one.n_unknown or self._always:
                self.lines.share(self.name(one.channel), one)
        self._held_shares = []


def answer_recording(recording: Any, asked: Asked, lines: AnswerLines, pages: Pages | None = None) -> None:
    """Print the answers for a recording, which is read block by block: once for each model that its channels need.

    Raises
    ------
    CgidError
        It cannot be read, is of another quantity, or nothing in it can be measured.
    """
    groups = _models_of(recording, asked)
    errors: list[CgidError] = []
    try:
        for model, rows in groups:
            try:
                _answer_channels(recording, model, rows, asked, lines, pages)
            except CgidError as error:
                errors.append(error)
    finally:
        for warning in recording.warnings:
            lines.warning(recording.source, warning)
    if len(errors) == len(groups):
        raise errors[0]
    # Channels of another quantity do not hide those that can be answered for.
    for unanswered in errors:
        lines.warning(recording.source, str(unanswered))


def _answer_channels(
    recording: Any, model: Any, rows: list[int], asked: Asked, lines: AnswerLines, pages: Pages | None
) -> None:
    """Print the answers for those channels of a recording that one model answers for."""
    from cgid.identification.answering.stream import identify_blocks, model_blocks

    names, rate, source = [recording.channels[row].name for row in rows], recording.sampling_rate, recording.source
    passing = Passing() if pages is None else pages.drawing(recording, rows)
    blocks = model_blocks(recording, model, rows, mass=asked.mass, invert=asked.invert, seen=passing.see)
    asked.warn_of_sensor(source, model)
    telling = Telling(source, model, names, rate, asked, lines, keep=pages is not None)
    warn_of_rate(telling.name(telling.channels[0]), rate, model)
    silent: tuple[str, ...] = ()
    for step in identify_blocks(blocks, rate, model, names, asked.question(), source):
        telling.feed(step.answers, step.until)
        silent += step.silent
        for warning in step.warnings:
            lines.warning(source, warning)
    telling.finish(passing.n_samples / rate, silent, recording.start_time)
    if pages is not None:
        pages.add(recording, passing, model, asked, telling)


def _models_of(recording: Any, asked: Asked) -> list[tuple[Any, list[int]]]:
    """Return the models that answer for the channels of a recording, each with the numbers of its channels."""
    found: dict[int, tuple[Any, list[int]]] = {}
    for row, channel in enumerate(recording.channels):
        model = asked.models.of(channel.quantity)
        found.setdefault(id(model), (model, []))[1].append(row)
    return list(found.values())


class Passing:
    """Counts the samples of blocks that pass by."""

    def __init__(self) -> None:
        self.n_samples = 0

    def see(self, block: Any) -> None:
        """Look at a block, (n_channels, n_samples)."""
        self.n_samples += block.shape[1]
