"""
One impact, and what theories say of it
=======================================

A sphere of coal with a radius of 25 mm falls from 1 m onto a thick steel plate. How much of its speed it keeps is the
restitution. Several published factors of the damping claim to deliver the restitution that is asked for. Only the exact
one does; the later ones come within 0.03, the older ones lose far too little.
"""

# sphinx_gallery_thumbnail_number = 2
import numpy as np
from matplotlib import pyplot as plt

from cgid import HalfSpace, HuntCrossley, Impact, Sphere
from cgid.physics import HUNT_CROSSLEY_LAWS, STEEL, Material, free_fall_velocity

coal = Material(density=1400, youngs_modulus=3.1e9, poisson_ratio=0.3)


def impact(law: str, stiffness: str = "hertz", restitution: float = 0.5) -> Impact:
    return Impact(
        sphere=Sphere(material=coal, radius=0.025),
        target=HalfSpace(material=STEEL),
        velocity=free_fall_velocity(1.0),
        stiffness=stiffness,
        dissipation=HuntCrossley(restitution=restitution, law=law),
    )


# %%
# All damping factors, asked for a restitution of 0.5. The legend says what each one delivers: the ratio of the speeds
# after and before the impact.

times = np.linspace(0, 450e-6, 600)
figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
for law in HUNT_CROSSLEY_LAWS:
    one = impact(law)
    style = {"color": "black", "linewidth": 3, "zorder": 3} if law == "exact" else {"linewidth": 1.2}
    axes.plot(times * 1e6, one.force(times) / 1e3, label=f"{law}: {float(one.restitution):.3f}", **style)
axes.set(xlabel="time [µs]", ylabel="contact force [kN]", title="Damping factors, asked for a restitution of 0.5")
axes.legend(title="law: delivered")
plt.show()

# %%
# The stiffness of the contact is a theory, too. Finite elements support Hertz's.

figure, axes = plt.subplots(figsize=(6.5, 4.5), layout="constrained")
for stiffness in ("hertz", "rigid-sphere", "series"):
    one = impact("exact", stiffness)
    label = f"{stiffness}: {one.peak_force / 1e3:.1f} kN in {one.contact_duration * 1e6:.0f} µs"
    axes.plot(times * 1e6, one.force(times) / 1e3, label=label)
axes.set(xlabel="time [µs]", ylabel="contact force [kN]", title="Theories of the contact stiffness")
axes.legend()
plt.show()
