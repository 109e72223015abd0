"""The stages that only a stream has: when rocks arrive, and their flight from one impact to the next."""

from __future__ import annotations

from cgid.scene.costs import UNIT_COSTS
from cgid.scene.request import Decision, Request

_NO_STREAM = Decision(runs=False, why="the scene is no stream")


def arrivals(request: Request) -> Decision:
    """Return how rocks arrive."""
    stream = request.scene.stream
    if stream is None:
        return _NO_STREAM
    why = "Poisson" if stream.arrivals.rate is not None else "listed"
    mixture = "" if stream.mixture is None else ", the mixture changes"
    return Decision(
        runs=True,
        why=f"{why}, {stream.duration:g} s{mixture}",
        cost=lambda work: UNIT_COSTS["arrival"] * work.sources,
    )


def flights(request: Request) -> Decision:
    """Return whether rocks are followed beyond their first impact."""
    stream = request.scene.stream
    if stream is None:
        return _NO_STREAM
    if stream.rebounds is None:
        return Decision(runs=False, why="off: no rock bounces")
    most, least = stream.rebounds.most, stream.rebounds.least_speed
    return Decision(
        runs=True,
        why=f"by formula, {most} rebounds at most, none slower than {least:g} m/s",
        cost=lambda work: UNIT_COSTS["flight"] * work.impacts,
    )
