"""
A stream of caving
==================

Ten seconds of the shipped scene ``caving``: rocks arrive at random, bounce down the sloping beam, and overlap; pumps
hum and the conveyor rumbles. The truth of every impact is known. The gangue fraction rises from 5 to 90 % within the
ten seconds here, to have it all in one picture.
"""

import io

import numpy as np
from matplotlib import pyplot as plt

from cgid import find_impacts, load_scene
from cgid.measure.overview import OverviewStream
from cgid.plots import picture
from cgid.plots.recording import Mark, overview_figure
from cgid.recordings import Channel
from cgid.scene import parse_scene, record

content = load_scene("caving").model_dump(mode="json", exclude_none=True)
content["stream"]["duration"] = "10 s"
content["stream"]["mixture"] = {"times": ["0 s", "10 s"], "gangue": [0.05, 0.9]}
scene = parse_scene(content)
signal, truth = record(scene, seed=1)

stream = OverviewStream(signal.sampling_rate)
stream.feed(signal.samples[np.newaxis])
hits = zip(truth["time"].tolist(), truth["label"].tolist(), strict=True)
marks = [Mark(time=time, end=time, label=label) for time, label in hits]
drawn = overview_figure(stream.overview(), [Channel(name="1", unit=signal.unit)], title="caving", marks=marks)
figure, axes = plt.subplots(figsize=(9, 7), layout="constrained")
axes.imshow(plt.imread(io.BytesIO(picture(drawn, ".png"))))
axes.axis("off")
plt.show()

# %%
# Which of these impacts does the detector find? An impact is found if an event begins within 2 ms of it. Bounces that
# drown in the ringing of the rock before are lost.

events = find_impacts(signal)
found = np.array([event.onset / signal.sampling_rate for event in events])
first = truth["bounce"] == 0
distance = np.abs(truth["time"][:, None] - found[None]).min(axis=1)

figure, axes = plt.subplots(figsize=(9, 3.5), layout="constrained")
time = np.arange(signal.samples.size) / signal.sampling_rate
near = (time > 4) & (time < 4.6)
axes.plot(time[near], signal.samples[near], linewidth=0.6, color="grey")
for hit, bounce, missed in zip(truth["time"], truth["bounce"], distance > 2e-3, strict=True):
    if 4 < hit < 4.6:
        axes.axvline(hit, color="#d55e00" if missed else "#009e73", linestyle=":" if bounce else "-", linewidth=1)
axes.set(
    xlabel="time [s]",
    ylabel="acceleration [m/s²]",
    title=f"Of {first.sum()} rocks {np.sum(distance[first] < 2e-3)} are found, of {np.sum(~first)} bounces "
    f"{np.sum(distance[~first] < 2e-3)} (green: found, orange: not, dotted: a bounce)",
)
plt.show()
