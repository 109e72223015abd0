"""Makes impacts.csv: 240 dimensionless impacts in 32-digit arithmetic, to test the engine against.

Displacement x, sphere velocity y and contact force f obey x' = y - lambda f, y' = gamma - f from x = 0, y = 1, with
f = x^(3/2) + (D x^(3/2) + zeta x^(1/2)) x'. Contact ends at x = 0, or where f = 0 if zeta > 0. In the variable sigma,
d tau = w d sigma with x = w^2, the equations are rational and smooth through both ends of contact; they are integrated
by Gragg-Bulirsch-Stoer extrapolation of order 24 with a local error of 1e-22. All results are right to 17 digits,
forces to 17 digits of their peak: below 1e-18 of it a decaying, strongly damped force is rounding error.

    python tests/references/make_impacts.py            makes impacts.csv, in three minutes
    python tests/references/make_impacts.py --check    in ten minutes prints the largest relative difference between
        the table and                                                                   (forces: relative to the peak)
        all cases again with 48 digits, local error 1e-38, order 36:             5e-17, as printed
        the first integral of Hunt & Crossley (1975) and its quadrature:         5e-17
        energy, of which an elastic plate takes 1 - e^2:                         1.2e-15, of a small plate energy
        an elastic plate's x, which moves as with zeta = 3/2 lambda to its peak: 5e-17
"""

import csv
import random
import sys
from bisect import bisect_right
from pathlib import Path

from mpmath import exp, expm1, findroot, lambertw, log, mp, mpf, nstr, pi, quad, sin, sqrt

TABLE = Path(__file__).parent / "impacts.csv"
DIGITS = 32
SAMPLES = 22, 28  # before and after the largest displacement
LAWS = {
    "hunt-crossley": lambda e: 3 * (1 - e) / 2,
    "herbert-mcwhannell": lambda e: 6 * (1 - e) / ((2 * e - 1) ** 2 + 3),
    "lee-wang": lambda e: 3 * (1 - e) / 4,
    "lankarani-nikravesh": lambda e: 3 * (1 - e**2) / 4,
    "gonthier": lambda e: (1 - e**2) / e,
    "zhiying-qishao": lambda e: 3 * (1 - e**2) * exp(2 * (1 - e)) / 4,
    "flores": lambda e: 8 * (1 - e) / (5 * e),
    "hu-guo": lambda e: 3 * (1 - e) / (2 * e),
}
RESULTS = ["restitution", "contact_time", "peak_force", "time_of_peak", "peak_displacement"]
RESULTS += ["time_of_peak_displacement", "end_displacement", "plate_energy"]
HEADER = ["family", "law", "asked", "D", "zeta", "lambda", "gamma", "material_restitution", *RESULTS]
HEADER += [f"{name}_{k}" for name in ("tau", "force") for k in range(sum(SAMPLES))]


def delivered(damping):
    """Return the restitution of D alone: (1 + e) D = ln[(1 + D) / (1 - e D)] in Lambert form."""
    with mp.workdps(2 * mp.dps):
        start = 1 + damping
        return (1 + lambertw(-start * exp(-start)).real) / damping if damping else mpf(1)


def number(law, asked):
    """Return D, 0 without a law. The exact one lies between the laws of Hunt & Crossley and of Hu & Guo."""
    e = mpf(asked or 1)
    if law in LAWS or e == 1:
        return LAWS[law](e) if law in LAWS else mpf(0)
    bracket = LAWS["hunt-crossley"](e), LAWS["hu-guo"](e)
    return findroot(lambda damping: delivered(damping) - e, bracket, "anderson", maxsteps=100)


class Impact:
    """One impact: states (w, y, tau, plate energy) at the places sigma where the integrator stepped."""

    def __init__(self, damping, zeta, plate, gravity):
        self.damping, self.zeta, self.plate, self.gravity = damping, zeta, plate, gravity
        self.rows = 3 * mp.dps // 8
        tolerance, step = mpf(10) ** (10 - mp.dps), mpf("0.05")
        self.places, self.states = [mpf(0)], [[mpf(0), mpf(1), mpf(0), mpf(0)]]
        while len(self.places) == 1 or self.hold(self.states[-1]) > 0:
            state, error = self.extrapolate(self.states[-1], step)
            if error < tolerance:
                self.places.append(self.places[-1] + step)
                self.states.append(state)
            step *= min(2, max(0.2, 0.9 * float(tolerance / (error + tolerance**2)) ** (1 / (2 * self.rows - 1))))
        self.turn, self.crest, self.end = (self.root(g) for g in (self.velocity, self.force_rate, self.hold))
        late = [s for p, s in zip(self.places, self.states, strict=True) if self.turn < p < self.end]
        if max(map(self.velocity, late)) > 0 or max(map(self.force, late)) > self.force(self.at(self.crest)):
            raise ValueError("the sphere comes down again, or its first peak of force is not the largest")

    def force(self, state):
        w, y = state[:2]
        loss = w * (self.damping * w * w + self.zeta)
        return (w**3 + loss * y) / (1 + self.plate * loss)

    def velocity(self, state):
        return state[1] - self.plate * self.force(state)

    def rates(self, state):
        w, force = state[0], self.force(state)
        return (state[1] - self.plate * force) / 2, w * (self.gravity - force), w, self.plate * force * force * w

    def force_rate(self, state):
        (w, y), (dw, dy) = state[:2], self.rates(state)[:2]
        loss, dloss = w * (self.damping * w * w + self.zeta), (3 * self.damping * w * w + self.zeta) * dw
        rise = 3 * w * w * dw + dloss * y + loss * dy
        return (rise - self.plate * dloss * self.force(state)) / (1 + self.plate * loss)

    def hold(self, state):
        """Return the value that falls through zero at separation: w, less the w at which zeta leaves no force."""
        w, y = state[:2]
        return w - sqrt(max(-self.zeta * y / (1 + self.damping * y), 0)) if self.zeta else w

    def extrapolate(self, state, step):
        """Return the state after one step, and its error: midpoint rules of 2, 4, 6... parts, extrapolated to 0."""
        first, table = self.rates(state), []
        for row in range(1, self.rows + 1):
            whole = step / row
            a, b = state, [p + whole * q / 2 for p, q in zip(state, first, strict=True)]
            for _ in range(2 * row - 1):
                a, b = b, [p + whole * q for p, q in zip(a, self.rates(b), strict=True)]
            line = [b]
            for column, old in enumerate(table, 1):
                factor = mpf((row - column) ** 2) / (row**2 - (row - column) ** 2)
                line.append([p + factor * (p - q) for p, q in zip(line[-1], old, strict=True)])
            table = line
        return table[-1], max(abs(p - q) for p, q in zip(table[-1], table[-2], strict=True))

    def at(self, place):
        k = min(bisect_right(self.places, place), len(self.places) - 1) - 1
        return self.extrapolate(self.states[k], place - self.places[k])[0]

    def root(self, function):
        signs = [function(state) > 0 for state in self.states]
        k = next(k for k in range(1, len(signs)) if not signs[k] and (k == 1 or signs[k - 1]))
        return findroot(lambda place: function(self.at(place)), self.places[k - 1 : k + 1], "anderson", maxsteps=100)

    def results(self):
        turn, crest, end = self.at(self.turn), self.at(self.crest), self.at(self.end)
        values = [-end[1], end[2], self.force(crest), crest[2], turn[0] ** 2, turn[2]]
        values += [end[0] ** 2 if self.zeta else mpf(0), end[3]]
        before, after = ([(k + mpf("0.5")) / n for k in range(n)] for n in SAMPLES)
        places = [2 * self.turn * sin(pi * u / 4) ** 2 for u in before]
        # Twice, because the force of a strongly damped contact decays long before its end.
        places += [self.turn + (self.end - self.turn) * sin(pi / 2 * sin(pi * u / 2) ** 2) ** 2 for u in after]
        samples = [self.at(place) for place in places]
        return values + [s[2] for s in samples] + [self.force(s) for s in samples]


def cases():
    """Yield family, law, nominal restitution, zeta, lambda, gamma: some given ones, then log-uniform in a range."""
    generator, none, gravity = random.Random(1975), (0, 0), (1e-6, 2e-2, 2e-2)

    def draw(count, low, high, *given):
        drawn = (float(f"{low * (high / low) ** generator.random():.6g}") for _ in range(count - len(given)))
        return [*given, *drawn] if high else [0] * count

    for family, law, count, *ranges in (
        ("hunt-crossley", "exact", 60, (1e-3, 1, 1, 0.999999, 0.9, 0.5, 0.2, 1e-3), none, none, none),
        ("kuwabara-kono", "", 40, none, (1e-4, 3, 0.1965, 0.75, 1.5, 3), none, none),
        ("plate", "", 40, none, none, (1e-3, 1.5, 0.131, 0.5, 1, 1.5), none),
        ("plate hunt-crossley", "exact", 25, (0.1, 0.9, 0.5, 0.9, 0.7, 0.1), none, (1e-3, 1.5, 0.5, 1.5, 1, 0.3), none),
        ("plate kuwabara-kono", "", 10, none, (1e-2, 1), (1e-2, 1), none),
        ("gravity hunt-crossley", "exact", 15, (0.2, 1, 0.5), none, none, gravity),
        ("gravity kuwabara-kono", "", 5, none, (1e-2, 0.7, 0.3), none, gravity),
        ("gravity plate", "", 5, none, none, (1e-2, 0.7, 0.3), gravity),
    ):
        for numbers in zip(*(draw(count, *limits) for limits in ranges), strict=True):
            yield family, law, *numbers
    for law in LAWS:
        for e in (0.1, 0.3, 0.5, 0.7, 0.9):
            yield "published", law, e, 0, 0, 0


def row(family, law, asked, *numbers):
    numbers = [number(law, asked), *map(mpf, numbers)]
    return [family, law, mpf(asked) if law else "", *numbers, delivered(numbers[0]), *Impact(*numbers).results()]


def make():
    mp.dps = DIGITS
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        for case in cases():
            writer.writerow([cell if isinstance(cell, str) else nstr(cell, 17) for cell in row(*case)])


def first_integral(damping):
    """Return the results of a Hunt-Crossley impact from its first integral, by quadrature over p = ln(1 + D x')."""
    damping = damping or mpf(10) ** -20  # the elastic pulse is the limit
    e = delivered(damping)
    start = log(1 + damping)
    stop = start - (1 + e) * damping

    def integral(p, end):  # (2/5) D^2 x^(5/2)
        return p - end - exp(end) * expm1(p - end)

    def root(p, end):  # x^(1/2)
        return (5 * integral(p, end) / (2 * damping**2)) ** (mpf(1) / 5)

    def time(p, end):
        """Return the time between p and an end of contact, from where p lies a distance v^5."""
        sign = 1 if p > end else -1
        parts = [abs(p - end) ** (mpf(1) / 5) * k / 100 for k in (0, 50, 80, 90, 95, 98, 100)]
        return quad(lambda v: 5 * v**4 / (damping * root(end + sign * v**5, end) ** 3), parts, method="gauss-legendre")

    crest = findroot(lambda p: 3 * expm1(p) / 5 - integral(p, start), (0, start), "anderson", maxsteps=100)
    peak, displacement = root(crest, start) ** 3 * exp(crest), root(0, start) ** 2
    return [e, time(0, start) + time(0, stop), peak, time(crest, start), displacement, time(0, start)]


def check():
    mp.dps = 48
    worst = dict.fromkeys(("repeated", "first integral", "plate energy", "plate as zeta"), 0)

    def compare(name, line, columns, values):
        for column, value in zip(columns, values, strict=False):
            scale = line["peak_force"] if column.startswith("force") else line[column] or 1
            worst[name] = max(worst[name], float(abs(value - line[column]) / scale))

    with TABLE.open(newline="") as file:
        for case, cells in zip(cases(), csv.DictReader(file), strict=True):
            line = {name: mpf(cells[name]) for name in HEADER[3:]}
            compare("repeated", line, HEADER[3:], row(*case)[3:])
            if case[0] in ("hunt-crossley", "published"):
                compare("first integral", line, RESULTS, first_integral(number(*case[1:3])))
            if case[0] == "plate":
                compare("plate energy", line, ["plate_energy"], [(1 - line["restitution"] ** 2) / 2])
                twin = Impact(mpf(0), 3 * mpf(case[4]) / 2, mpf(0), mpf(0)).results()
                compare("plate as zeta", line, RESULTS[4:6], twin[4:6])
    print(worst)


if __name__ == "__main__":
    check() if "--check" in sys.argv else make()
