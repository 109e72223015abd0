"""When to shut the window: as soon as going on is expected to cost more than it brings.

Going on takes the next impact whatever it is: a gangue costs `gangue_cost`, for it has to be carried, washed and
dumped. Shutting leaves it: a coal that stays behind costs 1, which is the unit. With a share q of gangue, going on
costs

    gangue_cost * q - (1 - q)

more than shutting, an impact. It is linear in q, so its expectation needs the mean of q alone, and its sign turns at
q = 1 / (1 + gangue_cost). Where the share is known and only rises, waiting beyond that never pays.
"""

from __future__ import annotations

from dataclasses import dataclass

from cgid import validation
from cgid.identification.answering.share import Share

#: Nothing is said on fewer impacts than these: before, the even density that the share starts from would decide.
FEWEST_IMPACTS = 10


@dataclass(frozen=True, kw_only=True)
class Turn:
    """Going on has begun to cost more than it brings, or less again.

    Attributes
    ----------
    time : float
        End of the first window that says so [s].
    shut : bool
        True: shut the window; False: going on pays again.
    cost : float
        Of going on, less that of shutting [lost coal impacts an impact].
    share : Share
    """

    time: float
    shut: bool
    cost: float
    share: Share


class Shutting:
    """Watches the share of one channel and says when the expected cost of going on turns.

    Each window of impacts speaks for itself: nothing depends on what was said before, but that it is said when it
    changes. At first, going on pays.

    Parameters
    ----------
    gangue_cost : float
        Of one drawn gangue impact, in lost coal impacts; above 0.

    Attributes
    ----------
    threshold : float
        The share above which going on costs more than it brings.

    Raises
    ------
    InvalidValue
        The cost is not above 0.

    Examples
    --------
    >>> round(Shutting(3.0).threshold, 3)
    0.25
    """

    def __init__(self, gangue_cost: float = 1.0) -> None:
        self.gangue_cost = validation.number("gangue_cost", gangue_cost, "", validation.positive)
        self.threshold = 1.0 / (1.0 + self.gangue_cost)
        self._shut = False

    def cost(self, share: Share) -> float:
        """Return what going on costs more than shutting [lost coal impacts an impact]; nan when no impact tells."""
        return self.gangue_cost * share.share - (1.0 - share.share)

    def watch(self, share: Share) -> Turn | None:
        """Return the turn that this window brings; None when all stays, or too few impacts tell."""
        if share.n_impacts < FEWEST_IMPACTS:
            return None
        cost = self.cost(share)
        if (cost > 0) == self._shut:
            return None
        self._shut = not self._shut
        return Turn(time=share.time, shut=self._shut, cost=cost, share=share)
