"""Contact laws of one's own, good and broken, on four targets, against a referee that shares nothing with the package.

    # a minute: a row for each law and target, then closed forms at every tolerance
    python benchmarks/impact/own_laws.py

The referee steps approach, speed and every mode by scipy's DOP853 (rtol 1e-12) from event to event: the contact ends
where the approach falls to that of the law's dent, or, for a law that pulls, where the force falls to 0; a structure
that runs from the sphere releases it. Each law is written twice: in x for the referee, in w for `cgid`. Errors of the
force are over its peak, at 400 times of the contact.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from cgid.errors import InvalidValue
from cgid.physics import STEEL, YANG2018_SPHERES, HalfSpace, Impact, Law, ModalImpact, Sphere, ThinPlate

Floats = NDArray[np.float64]
#: The plate [m], the pull [m/s^2], and modes: frequency [Hz], damping ratio, compliance [1/kg].
THICKNESS, GRAVITY = 0.012, 400.0
MODES = np.array([300.0, 900.0, 2500.0, 6000.0]), 0.02, np.array([1.0, 2.0, 2.0, 1.5])
TARGETS = ("half-space", "plate", "weight", "modes")
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
#: Longest contact that is followed [T0].
_LONGEST = 2000.0
#: Share of the largest approach that the dented law keeps, and what its other path makes of it.
_DENT = 0.3


@dataclass(frozen=True)
class Case:
    """A law for the referee, `rest` and `damping` of the approach x and of whether it has turned, and for `cgid`.

    `sound` tells whether it is a contact law. `kept` is the share of the largest approach at which it then ends.
    """

    name: str
    law: Law
    rest: Callable[[float, float], float] = lambda x, largest: 0.0
    damping: Callable[[float], float] = lambda x: 0.0
    pulls: bool = False
    sound: bool = True
    kept: float = 0.0


def made(force: Any, *, pulls: bool = False, corner: Any = None, turn: Any = None, closed: Any = None) -> Law:
    """Return a law of plain functions."""
    verbs = {"force": force, "corner": corner, "turn": turn}
    compiled = {name: staticmethod(njit(verb)) for name, verb in verbs.items() if verb is not None}
    more = {} if closed is None else {"closed": closed}
    law: Law = type("Own", (Law,), {"pulls": pulls, **compiled, **more})()
    return law


def linear_damping(restitution: float) -> float:
    """Return c of `f = x + c x'` whose free oscillation keeps this share of its speed in half a period."""
    ratio = -math.log(restitution) / math.pi
    return 2 * ratio / math.hypot(1, ratio)


def released_restitution(restitution: float) -> float:
    """Return the restitution of that contact if it ends where the force falls to 0 (Schwager & Poeschel 2007)."""
    ratio = -math.log(restitution) / math.pi
    return math.exp(-ratio * (math.pi - math.atan2(2 * ratio, 1 - ratio * ratio)))


def tsuji_damping(restitution: float) -> float:
    """Return the factor of `f = x^(3/2) + factor x^(1/4) x'` (Tsuji, Tanaka & Ishida 1992)."""
    loss = math.log(restitution)
    return -math.sqrt(5) * loss / math.hypot(loss, math.pi)


def dashpot(c: float, *, pulls: bool = True) -> Law:
    """Return a linear spring and dashpot."""
    return made(lambda p, history, w: (w * w, c), pulls=pulls)


def tsuji(factor: float) -> Law:
    """Return Tsuji's law."""
    return made(lambda p, history, w: (w * w * w, factor * math.sqrt(abs(w))), pulls=True)


def _stiffening(p: Any, history: Any, w: float) -> tuple[float, float]:
    x = w * w
    return (x if x < 0.5 else 0.5 + 5.0 * (x - 0.5)), 0.0


def _gap(p: Any, history: Any, w: float) -> tuple[float, float]:
    x = max(w * w - 0.2, 0.0)
    return x * math.sqrt(x), 0.0


def _at_kink(p: Any, history: Any) -> float:
    return 0.5 if history[2] == 0.0 else math.inf


def _past_kink(p: Any, history: Any, x: float) -> float:
    history[2] = 1.0
    return float(x - history[0])


def _dented(p: Any, history: Any, w: float) -> tuple[float, float]:
    g = w * w * w
    if history[2] == 1.0:
        g = g / 0.7**1.5
    return g, 0.0


def _largest(p: Any, history: Any) -> float:
    return float(history[1]) if history[2] == 1.0 else math.inf


def _dent(p: Any, history: Any, x: float) -> float:
    if history[2] == 0.0:
        history[0], history[1], history[2] = 0.3 * x, x, 1.0
    elif x >= history[1]:
        history[0], history[2] = 0.0, 0.0
    return float(x - history[0])


def _sticky(p: Any, history: Any, w: float) -> tuple[float, float]:
    g = w * w * w
    if history[2] == 1.0:
        g = g - 0.3 * w * math.sqrt(abs(w))
    return g, 0.0


def _outwards(p: Any, history: Any, x: float) -> float:
    history[0] = -x
    return float(x - history[0])


def _torn(p: Any, history: Any, x: float) -> float:
    history[0] = 0.3 * x
    return float(x)


def _late_nan(p: Any, history: Any, w: float) -> tuple[float, float]:
    return (w * w * w if w < 0.8 else math.nan), 0.0


def _dip(p: Any, history: Any, w: float) -> tuple[float, float]:
    x = w * w
    return w * w * w - 0.6 * math.exp(-(((x - 0.4) / 0.05) ** 2)), 0.0


_HERTZ = made(lambda p, history, w: (w * w * w, 0.0))
#: Nineteen laws of contact, then what is none.
CASES = (
    Case("Hertz", _HERTZ, lambda x, _: x**1.5),
    Case("Hunt-Crossley", made(lambda p, h, w: (w**3, 0.5 * w**3)), lambda x, _: x**1.5, lambda x: 0.5 * x**1.5),
    Case("Hunt-Crossley, D 50", made(lambda p, h, w: (w**3, 50 * w**3)), lambda x, _: x**1.5, lambda x: 50 * x**1.5),
    Case("cone, damped", made(lambda p, h, w: (w**4, 0.3 * w**4)), lambda x, _: x**2, lambda x: 0.3 * x**2),
    Case("spring", made(lambda p, h, w: (w * w, 0.0)), lambda x, _: x),
    Case("spring and dashpot", dashpot(0.3), lambda x, _: x, lambda x: 0.3, pulls=True),
    Case("spring and dashpot, overdamped", dashpot(3.0), lambda x, _: x, lambda x: 3.0, pulls=True),
    Case("Tsuji", tsuji(0.48), lambda x, _: x**1.5, lambda x: 0.48 * x**0.25, pulls=True),
    Case(
        "Kuwabara-Kono", made(lambda p, h, w: (w**3, 0.5 * w), pulls=True), lambda x, _: x**1.5,
        lambda x: 0.5 * x**0.5, pulls=True,
    ),
    Case("stiffer by 1e6", made(lambda p, h, w: (1e6 * w**3, 0.0)), lambda x, _: 1e6 * x**1.5),
    Case("softer by 1e3", made(lambda p, h, w: (1e-3 * w**3, 0.0)), lambda x, _: 1e-3 * x**1.5),
    Case("kink", made(_stiffening), lambda x, _: x if x < 0.5 else 0.5 + 5 * (x - 0.5)),
    Case(
        "kink, declared", made(_stiffening, corner=_at_kink, turn=_past_kink),
        lambda x, _: x if x < 0.5 else 0.5 + 5 * (x - 0.5),
    ),
    Case("softening", made(lambda p, h, w: (3 * w * w * math.exp(-w * w), 0.0)), lambda x, _: 3 * x * math.exp(-x)),
    Case(
        "two humps", made(lambda p, h, w: (w * w * (1 + 0.9 * math.sin(6 * w * w)), 0.0)),
        lambda x, _: x * (1 + 0.9 * math.sin(6 * x)),
    ),
    Case("gap", made(_gap), lambda x, _: max(x - 0.2, 0.0) ** 1.5),
    Case("force at touch", made(lambda p, h, w: (0.5 + w * w, 0.0)), lambda x, _: 0.5 + x),
    Case(
        "dent", made(_dented, corner=_largest, turn=_dent),
        lambda x, largest: x**1.5 if not largest else (max(x - _DENT * largest, 0.0) / (1 - _DENT)) ** 1.5,
        kept=_DENT,
    ),
    Case(
        "adhesive way back", made(_sticky, turn=_past_kink, pulls=True),
        lambda x, largest: x**1.5 - 0.3 * x**0.75 * bool(largest), pulls=True,
    ),
    Case("dashpot without pulls", dashpot(0.3, pulls=False), sound=False),
    Case("Kuwabara-Kono without pulls", made(lambda p, h, w: (w**3, 0.5 * w)), sound=False),
    Case("attracts at touch", made(lambda p, h, w: (w**3 - 0.3 * w, 0.0)), sound=False),
    Case("attracts at touch, pulls", made(lambda p, h, w: (w**3 - 0.3 * w, 0.0), pulls=True), sound=False),
    Case("attracts in between", made(_dip), sound=False),
    Case("repels outwards", made(lambda p, h, w: (-w, 0.0)), sound=False),
    Case("creates energy", made(lambda p, h, w: (w**3, -0.5 * w**3)), sound=False),
    Case("turn outwards", made(lambda p, h, w: (w**3, 0.0), turn=_outwards), sound=False),
    Case("turn tears", made(lambda p, h, w: (w**3, 0.0), turn=_torn), sound=False),
    Case("nan from .64 on", made(_late_nan), sound=False),
    Case("infinite", made(lambda p, h, w: (math.inf, 0.0)), sound=False),
    Case("no force", made(lambda p, h, w: (0.0, 0.0)), sound=False),
    Case("reads a number too many", made(lambda p, h, w: (p[0] * w**3, 0.0)), sound=False),
)  # fmt: skip


def impact_on(law: Law, target: str, **more: Any) -> Impact:
    """Return the impact of a coal sphere of 25 mm at 2 m/s on steel."""
    parts: dict[str, Any] = {
        "sphere": Sphere(material=YANG2018_SPHERES[1], radius=0.025),
        "target": HalfSpace(material=STEEL),
        "velocity": 2.0,
        "stiffness": "hertz",
        "dissipation": law,
        **more,
    }
    if target == "modes":
        frequency, damping, compliance = MODES
        return ModalImpact(**parts, frequency=frequency, damping_ratio=damping, compliance=compliance, window=0.0)
    if target == "plate":
        parts["target"] = ThinPlate(material=STEEL, thickness=THICKNESS)
    return Impact(**parts, gravity=GRAVITY if target == "weight" else 0.0)


class Refereed(NamedTuple):
    """Restitution, nan for a sphere that stays, duration of the contact [T0], and the force at times."""

    restitution: float
    duration: float
    force: Callable[[Floats], Floats]


def refereed(case: Case, impact: Impact, target: str) -> Refereed:
    """Return the contact by scipy, in units of L, T0 and v."""
    yields, weight = float(impact.inelasticity), float(impact.weight)
    shares, omega, loss = np.empty(0), np.empty(0), 0.0
    if target == "modes":
        frequency, loss, compliance = MODES
        shares, omega = compliance * float(impact.reduced_mass), 2 * np.pi * frequency * float(impact.time_scale)
    n = shares.size

    def parts(state: Floats, largest: float) -> tuple[float, float, float]:
        """Return approach, its rate and the force."""
        x, y = state[0] - shares @ state[2 : 2 + n], state[1] - shares @ state[2 + n :]
        inside = max(x, 0.0)
        g, c = case.rest(inside, largest), case.damping(inside)
        f = (g + c * y) / (1 + yields * c)
        return x, y - yields * f, f

    def rates(pushes: bool, state: Floats, largest: float) -> Floats:
        q, dq = state[2 : 2 + n], state[2 + n :]
        f = parts(state, largest)[2] if pushes else 0.0
        # The sphere's own way: on a plate the approach is less by what the plate yields.
        own = state[1] - yields * f
        return np.concatenate([[own, weight - f], dq, f - 2 * loss * omega * dq - omega**2 * q])

    def leg(begin: float, state: Floats, pushes: bool, turned: bool, largest: float) -> Any:
        """Follow a contact, or a flight on modes, to its next event."""
        now = largest if turned else 0.0

        def ends(t: float, s: Floats) -> float:
            return parts(s, now)[0] - case.kept * largest if t > begin else 1.0

        def turns(t: float, s: Floats) -> float:
            return parts(s, now)[1] if t > begin else (-1.0 if turned else 1.0)

        def pushes_on(t: float, s: Floats) -> float:
            f = parts(s, now)[2] if t > begin else 0.0
            return f or (1e-300 if pushes else -1e-300)  # no force is no event

        def deeper(t: float, s: Floats) -> float:
            return parts(s, now)[0] - largest if turned and case.kept and t > begin else -1.0

        events: list[Any] = [ends, turns, pushes_on, deeper]
        releases = case.pulls or target == "modes" or not pushes
        terminal = True, pushes and (not turned or weight > 0), releases, True
        for event, direction, last in zip(
            events, (-1, 1 if turned else -1, -1 if pushes else 1, 1), terminal, strict=True
        ):
            event.direction, event.terminal = direction, last
        found = solve_ivp(
            lambda t, s: rates(pushes, s, now), (begin, _LONGEST), state, method="DOP853", rtol=1e-12, atol=1e-14,
            first_step=1e-7, events=events, dense_output=True,
        )  # fmt: skip
        happened = [times.size > 0 and times[-1] == found.t[-1] for times in found.t_events]
        return found, happened, (begin, float(found.t[-1]), found.sol, pushes, now)

    state, time, largest, pieces = np.zeros(2 + 2 * n), 0.0, 0.0, []
    state[1], pushes, turned = 1.0, True, False
    while time < _LONGEST:
        found, (ended, turn, release, again), piece = leg(time, state, pushes, turned, largest)
        time, state = float(found.t[-1]), found.y[:, -1]
        pieces.append(piece)
        if ended or (release and pushes and target != "modes"):
            return Refereed(-state[1], time, _force_of(pieces, parts))
        if release:
            pushes = not pushes
        elif turn and not turned:
            turned, largest = True, parts(state, 0.0)[0]
        elif turn and weight > 0:
            break  # it is pressed again, with less energy than it began with
        elif again:
            turned = False  # a dented law follows its way back until it is as deep as before
    return Refereed(math.nan, time, _force_of(pieces, parts))


def _force_of(pieces: list[Any], parts: Callable[[Floats, float], tuple[float, float, float]]) -> Any:
    def force(times: Floats) -> Floats:
        out = np.zeros(times.size)
        for begin, end, solution, pushes, largest in pieces:
            for k in np.flatnonzero((times > begin) & (times <= end)) if pushes else ():
                out[k] = max(parts(solution(times[k]), largest)[2], 0.0)
        return out

    return force


class Row(NamedTuple):
    """What became of a law on a target: "held", "stays" or the error, and the errors of force and restitution."""

    outcome: str
    force: float = math.nan
    restitution: float = math.nan


def judged(case: Case, target: str) -> Row:
    """Return what `cgid` says of a law on a target, against the referee."""
    found: Impact | None = None
    outcome = "held"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = impact_on(case.law, target)
        except InvalidValue as error:
            outcome = str(error)
        if not case.sound:
            return Row(outcome)
        scales = impact_on(_HERTZ, target)
    exact = refereed(case, scales, target)
    if found is None:
        return Row("stays" if math.isnan(exact.restitution) and "holds it" in outcome else outcome)
    times = exact.duration * np.linspace(0, 1, 402)[1:-1]
    expected = exact.force(times)
    force = found.force(times * float(found.time_scale)) / float(found.force_scale)
    return Row(
        outcome, float(np.abs(force - expected).max() / expected.max()),
        abs(float(found.restitution) - exact.restitution),
    )  # fmt: skip


def closed_forms() -> list[tuple[str, float, float, list[float]]]:
    """Return law, asked restitution, its closed form and the errors at each tolerance."""
    rows = []
    for asked in (0.9, 0.5, 0.2):
        exact = released_restitution(asked)
        for name, law in (("dashpot", dashpot(linear_damping(asked))), ("Tsuji", tsuji(tsuji_damping(asked)))):
            found = [float(impact_on(law, "half-space", tolerance=one).restitution) for one in TOLERANCES]
            rows.append((name, asked, exact, [abs(one - exact) for one in found]))
    return rows


def main() -> None:
    """Print the tables."""
    print(f"{'law':<32}{'target':<12}{'force error':>12}{'restitution':>12}  outcome")
    for case in CASES:
        for target in TARGETS:
            row = judged(case, target)
            print(
                f"{case.name:<32}{target:<12}{row.force:>12.1e}{row.restitution:>12.1e}  {row.outcome[:110]}",
                flush=True,
            )
    print(
        f"\n{'closed form':<12}{'asked':>6}{'delivered':>14}  errors at {', '.join(f'{one:g}' for one in TOLERANCES)}"
    )
    for name, asked, exact, errors in closed_forms():
        print(f"{name:<12}{asked:>6}{exact:>14.10f}  " + "  ".join(f"{one:.1e}" for one in errors))


if __name__ == "__main__":
    main()
