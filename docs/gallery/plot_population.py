"""
A population of rocks
=====================

A scene file says how large, how stiff and how heavy the rocks are and how far they fall, as distributions. Here are
some signals of the shipped scene ``reference``, and what two features can and cannot show.
"""

# sphinx_gallery_thumbnail_number = 2
import numpy as np
from matplotlib import pyplot as plt

from cgid import extract, load_scene, synthesise

scene = load_scene("reference")
batches = list(synthesise(scene, 1024, seed=3))
signals = np.concatenate([batch.signals for batch in batches])
labels = np.concatenate([batch.labels for batch in batches])
rate, start = scene.sampling.sampling_rate, scene.sampling.pre_trigger

figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), sharey=True, layout="constrained")
time = (np.arange(signals.shape[1]) - start) / rate * 1e6
colours = {"coal": "#0072b2", "gangue": "#d55e00"}
for one, label in zip(axes, scene.labels, strict=True):
    one.plot(time, signals[labels == label][:40].T / 1e3, color=colours[label], alpha=0.4, linewidth=0.8)
    one.set(title=f"40 impacts of {label}", xlabel="time after touch [µs]", xlim=(-100, 600))
axes[0].set_ylabel("force [kN]")
plt.show()

# %%
# The peak alone says little, because it grows with the square of the radius. Peak over the square of the duration does
# not depend on the radius, and the asymmetry of the pulse depends on the restitution. The two classes separate, but not
# completely: no classifier can be right every time.

table = extract(signals, rate, ["peak_force", "contact_duration", "size_free_index", "asymmetry"], pre_trigger=start)
figure, axes = plt.subplots(1, 2, figsize=(8, 5), layout="constrained")
for label in scene.labels:
    own = table[labels == label]
    axes[0].loglog(
        own.contact_duration * 1e6, own.peak_force / 1e3, ".", markersize=6, color=colours[label], label=label
    )
    axes[1].semilogx(own.size_free_index, own.asymmetry, ".", markersize=6, color=colours[label], label=label)
axes[0].set(xlabel="contact duration [µs]", ylabel="peak force [kN]", title="Both follow the size")
axes[1].set(xlabel="peak over duration squared [N/s²]", ylabel="asymmetry", title="Free of the size")
axes[0].legend()
plt.show()
