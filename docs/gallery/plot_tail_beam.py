"""
What an accelerometer on a tail beam records of one rock
========================================================

No support measures contact force: sensors sit on the beam. The same rock, once as the force of its contact, once as the
acceleration of the beam elsewhere. A blow of less than a millisecond rings for tens of milliseconds.
"""

import numpy as np
from matplotlib import pyplot as plt

from cgid import load_scene, synthesise
from cgid.scene import varied

scene = load_scene("tail_beam")
exact = {"quantity": "force", "mounting": None, "anti_alias": None, "noise_density": None, "range": None, "bits": None}
(force,) = synthesise(varied(scene, **exact), 1, seed=4)
(heard,) = synthesise(scene, 1, seed=4)

figure, axes = plt.subplots(2, 1, figsize=(7.5, 5.2), layout="constrained")
for one, batch, unit, title in (
    (axes[0], force, "contact force [N]", f"The force of a piece of {force.labels[0]}"),
    (axes[1], heard, "acceleration [m/s²]", "The beam at the sensor"),
):
    time = (np.arange(batch.signals.shape[1]) - batch.pre_trigger) / batch.sampling_rate * 1e3
    one.plot(time, batch.signals[0], linewidth=1.5, color="#d55e00" if batch.labels[0] == "gangue" else "#0072b2")
    one.set(ylabel=unit, title=title, xlim=(-2, 40))
axes[1].set_xlabel("time after touch [ms]")
plt.show()

# %%
# The beam is a plate with ribs, whose modes lie close together. Each of them rings at its own frequency, and the
# spectrum shows the beam more than the rock.

beam = scene.panel
modes = beam.modes(3000.0)
spectrum = np.abs(np.fft.rfft(heard.signals[0])) / heard.sampling_rate
frequency = np.fft.rfftfreq(heard.signals.shape[1], 1 / heard.sampling_rate)

figure, axes = plt.subplots(figsize=(9, 3.5), layout="constrained")
axes.semilogy(frequency, spectrum, linewidth=1.2, label="spectrum of the signal")
axes.plot(
    modes.frequency,
    np.full(modes.frequency.size, spectrum.max() * 1.6),
    "|",
    color="#d55e00",
    label="modes of the beam",
)
axes.set(
    xlim=(0, 3000),
    ylim=(spectrum.max() * 1e-3, spectrum.max() * 3),
    xlabel="frequency [Hz]",
    ylabel="amplitude [m/s² s]",
)
axes.legend(loc="lower right")
plt.show()
