"""The state of a support: what is decided, on what ground, and how old it is.

Every output of `cgid monitor` and `cgid predict` is made from these records: rows, JSON, the live page, Modbus, MQTT,
Prometheus, commands, and the report.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from cgid.identification.share import Share

__all__ = ["Decision", "Ground", "SupportState"]


class Decision(StrEnum):
    """What is decided for the window of a support; none until the evidence for one side suffices."""

    NONE = "none"
    DRAW = "draw"
    SHUT = "shut"


class Ground(StrEnum):
    """What a decision rests on: only a support that is seen has one."""

    SEEN = "seen"
    BLIND = "blind"  # samples are missing, constant, or far below the channel's own earlier noise
    WRONG_SCALE = "wrong_scale"  # the levels are not those of the training
    MOSTLY_UNKNOWN = "mostly_unknown"  # most impacts of the last minutes are unknown
    STOPPED = "stopped"  # no samples arrive


@dataclass(frozen=True, kw_only=True)
class SupportState:
    """The record of one support at one time, computed from the last minutes of its samples and predictions.

    Attributes
    ----------
    time : float [s]
        Time of the record in the stream.
    decision : Decision
    ground : Ground
    since : float [s]
        Begin of the ground in the stream.
    reason : str
        Why the ground is not `SEEN`, in words; else empty.
    share : Share
        The gangue fraction of the window that ends at `time`.
    last_sound : float [s]
        Time of the last sound sample in the stream; nan before the first.
    last_identified : float [s]
        Time of the last identified impact in the stream; nan before the first.
    """

    time: float
    share: Share
    decision: Decision = Decision.NONE
    ground: Ground = Ground.SEEN
    since: float = 0.0
    reason: str = ""
    last_sound: float = float("nan")
    last_identified: float = float("nan")

    def content(self) -> dict[str, Any]:
        """Return the record for JSON; the line adds the wall clock."""
        share = self.share
        return {
            "channel": share.channel,
            "decision": str(self.decision),
            "ground": str(self.ground),
            "ground_since_s": self.since,
            "reason": self.reason,
            "gangue_share": share.share,
            "low": share.low,
            "high": share.high,
            "impacts": share.n_impacts,
            "unknown": share.n_unknown,
            "last_sound_s": self.last_sound,
            "last_identified_s": self.last_identified,
        }
