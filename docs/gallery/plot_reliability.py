"""
How far to trust a probability
==============================

The default model gives each impact a probability of gangue. Among impacts with a probability of 0.8, about 80 % should
be gangue. 2048 fresh impacts of the scene ``reference`` show that this is so.
"""

import numpy as np
from matplotlib import pyplot as plt

from cgid import load_model, load_scene, synthesise
from cgid.identification.prediction import identify_frames

model = load_model("default")
scene = load_scene("reference")

probability, gangue = [], []
for batch in synthesise(scene, 2048, seed=11):
    for answer, label in zip(
        identify_frames(batch.signals, batch.sampling_rate, model, pre_trigger=batch.pre_trigger),
        batch.labels,
        strict=True,
    ):
        if answer.probabilities:
            probability.append(answer.probabilities["gangue"])
            gangue.append(label == "gangue")
probability, gangue = np.array(probability), np.array(gangue)

edges = np.linspace(0, 1, 11)
number = np.clip(np.digitize(probability, edges) - 1, 0, 9)
counts = np.bincount(number, minlength=10)
stated = np.bincount(number, probability, minlength=10) / counts
true = np.bincount(number, gangue, minlength=10) / counts
error = 1.96 * np.sqrt(true * (1 - true) / counts)

figure, axes = plt.subplots(2, 1, figsize=(6.5, 5.5), height_ratios=(3, 1), sharex=True, layout="constrained")
axes[0].plot([0, 1], [0, 1], color="grey", linewidth=1)
axes[0].errorbar(stated, true, yerr=error, fmt="o", markersize=9, capsize=4, color="#d55e00")
axes[0].set(
    ylabel="share that is gangue", title=f"{np.mean((probability > 0.5) == gangue):.1%} of the answers are right"
)
axes[1].bar(edges[:-1], counts, width=0.1, align="edge", edgecolor="white", color="#d55e00")
axes[1].set(xlabel="probability of gangue that the model states", ylabel="impacts")
plt.show()

# %%
# The bars are 95 % intervals of the number of impacts. Most probabilities are near 0 or 1: the model is seldom
# undecided, and is right when it is not.
