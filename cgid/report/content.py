"""What a report is made of, and how recordings and models are described in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from cgid.identification.answers import Answer
from cgid.identification.model import Model
from cgid.identification.share import Share, Turn
from cgid.measure.overview import Overview
from cgid.plots import hertz, written
from cgid.recordings import Channel, RecordingFile
from cgid.validation import UNKNOWN

#: More names than these are not all listed.
_MOST_NAMES = 8


@dataclass(frozen=True, kw_only=True)
class Report:
    """What is told of one recording.

    Attributes
    ----------
    source : str
        Name of the recording.
    recording, model : dict of str
        Facts, in the order in which they are told: `recording_facts`, `model_facts`.
    overview : Overview
        Of the first channels.
    channels : sequence of Channel
        Those of the overview.
    answers : sequence of Answer
        In order of time.
    shares : sequence of Share
    turns : sequence of Turn
    threshold : float or None
        The share above which going on costs more than it brings.
    warnings : sequence of str
    unit_of_decision : {"impact", "window"}
        What an answer is about.
    """

    source: str
    recording: Mapping[str, str]
    model: Mapping[str, str]
    overview: Overview
    channels: Sequence[Channel]
    answers: Sequence[Answer]
    shares: Sequence[Share] = ()
    turns: Sequence[Turn] = ()
    threshold: float | None = None
    warnings: Sequence[str] = field(default_factory=tuple)
    unit_of_decision: str = "impact"

    @property
    def labels(self) -> list[str]:
        """The labels of the answers in the order of the alphabet, "unknown" last."""
        return sorted({answer.label for answer in self.answers}, key=lambda label: (label == UNKNOWN, label))

    def tiles(self) -> Iterator[tuple[str, str]]:
        """Yield the summary: figures, and what they count."""
        n = len(self.answers)
        yield f"{n}", self.unit_of_decision + ("" if n == 1 else "s")
        counts = Counter(answer.label for answer in self.answers)
        for label in self.labels:
            yield f"{counts[label]}", f"{label} ({counts[label] / n:.0%})"
        outside = sum(not answer.in_training_range for answer in self.answers)
        yield f"{outside}", "outside of the training"
        overlapping = sum(answer.overlapping for answer in self.answers)
        if overlapping:
            yield f"{overlapping}", "overlapping another"
        last = {share.channel: share for share in self.shares}
        for channel, share in last.items():
            where = f", channel {channel}" if len(last) > 1 else ""
            interval = f"{share.low:.0%} to {share.high:.0%}" if share.n_impacts else "not known"
            yield f"{share.share:.0%}" if share.n_impacts else "-", f"gangue at the end ({interval}{where})"

    @property
    def has_course(self) -> bool:
        """Whether the share of some channel is known at two times at least, so that it can be seen to change."""
        known = Counter(share.channel for share in self.shares if share.n_impacts)
        return max(known.values(), default=0) > 1


def recording_facts(recording: RecordingFile, overview: Overview, channels: Sequence[Channel]) -> dict[str, str]:
    """Return what a recording is, in words.

    Parameters
    ----------
    recording : RecordingFile
    overview : Overview
        Of all its length.
    channels : sequence of Channel
        Those of the overview.
    """
    facts = {
        "file": recording.source,
        "format": recording.format,
        "sampling rate": hertz(recording.sampling_rate),
        "length": f"{overview.duration:.6g} s ({overview.n_samples} samples a channel)",
    }
    if recording.start_time is not None:
        facts["started"] = recording.start_time.isoformat(sep=" ")
    if len(channels) < len(recording.channels):
        facts["channels"] = f"{len(recording.channels)}, of which {len(channels)} are drawn here"
    for k, channel in enumerate(channels):
        facts[f"channel {channel.name}"] = (
            f"{channel.quantity or 'signal'} [{written(channel.unit)}], from {overview.lowest[k].min():.4g} to "
            f"{overview.highest[k].max():.4g}, mean {overview.mean[k]:.3g}, deviation {overview.deviation[k]:.3g}"
        )
    return facts


def model_facts(model: Model, name: str) -> dict[str, str]:
    """Return what a model is, in words.

    Parameters
    ----------
    model : Model
    name : str
        Of its file.
    """
    low, high = min(model.sampling_rates), max(model.sampling_rates)
    rates = hertz(low) if low == high else f"{hertz(low, 3)} to {hertz(high, 3)}"
    facts = {
        "model": name,
        "tells apart": ", ".join(model.labels),
        "from": f"{model.quantity} [{written(model.unit)}], {model.kind}s, trained at {rates}",
        "family": model.family,
        "features": _listed(model.features),
    }
    metrics = model.training.get("metrics", {})
    if metrics.keys() >= {"accuracy", "accuracy_interval_95"}:
        low, high = metrics["accuracy_interval_95"]
        facts["accuracy in its test"] = f"{metrics['accuracy']:.3f} (95 % interval {low:.3f} to {high:.3f})"
    return facts


def _listed(names: Sequence[str]) -> str:
    """Return names, or some of them where they are many."""
    if len(names) <= _MOST_NAMES:
        return ", ".join(names)
    return f"{', '.join(names[: _MOST_NAMES // 2])} and {len(names) - _MOST_NAMES // 2} others"
