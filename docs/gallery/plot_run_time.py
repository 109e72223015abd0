"""
Run time against error
======================

All damped Hertz impacts are one family of curves, which cgid holds as a table. A solver of differential equations can
be as exact, if it is given the time. The complete comparison with seven solvers is in :doc:`/benchmarks/impact`.
"""

from time import perf_counter

import numpy as np
from matplotlib import pyplot as plt
from scipy.integrate import solve_ivp

from cgid import HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics import STEEL, YANG2018_SPHERES, damping_number

impact = Impact(
    sphere=Sphere(material=YANG2018_SPHERES[1], radius=0.025),
    target=HalfSpace(material=STEEL),
    velocity=4.0,
    stiffness="hertz",
    dissipation=HuntCrossley(restitution=0.5),
)
duration, peak = float(impact.contact_duration), float(impact.peak_force)
times = np.linspace(0.02, 0.98, 200) * duration
exact = impact.force(times)

# %%
# The same impact as a differential equation: ``m x'' = -k x^1.5 (1 + c x')``. The stiffness is that of ``impact``, and
# ``damping_number`` gives c times the speed of the impact.

mass, stiffness = float(impact.reduced_mass), float(impact.contact_stiffness)
damping = float(damping_number(0.5)) / impact.velocity


def contact_force(x: np.ndarray, v: np.ndarray) -> np.ndarray:
    return stiffness * np.maximum(x, 0) ** 1.5 * (1 + damping * v)


def solved(tolerance: float) -> np.ndarray:
    found = solve_ivp(
        lambda _, y: (y[1], -contact_force(y[0], y[1]) / mass),
        (0, duration),
        (0.0, 4.0),
        t_eval=times,
        rtol=tolerance,
        atol=tolerance * 1e-6,
        method="DOP853",
    )
    return contact_force(found.y[0], found.y[1])


errors, seconds = [], []
for tolerance in (1e-3, 1e-5, 1e-7, 1e-9, 1e-11):
    spent = []
    for _ in range(3):  # the least of three
        started = perf_counter()
        force = solved(tolerance)
        spent.append(perf_counter() - started)
    seconds.append(min(spent))
    errors.append(np.abs(force - exact).max() / peak)

many = Impact(
    sphere=Sphere(material=YANG2018_SPHERES[1], radius=np.linspace(0.01, 0.05, 2000)),
    target=HalfSpace(material=STEEL),
    velocity=4.0,
    stiffness="hertz",
    dissipation=HuntCrossley(restitution=0.5),
)
many.force_frames(200e3, 256)  # the first call loads the compiled code
started = perf_counter()
many.force_frames(200e3, 256)
table = (perf_counter() - started) / 2000

figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
axes.loglog(errors, np.array(seconds) * 1e6, "o-", markersize=9, label="scipy, solve_ivp DOP853")
axes.axhline(table * 1e6, color="#d55e00", linewidth=4, label="cgid's table, error 1e-13 or less")
axes.set(xlabel="largest error over the peak force", ylabel="µs a pulse")
axes.invert_xaxis()
axes.legend()
plt.show()
