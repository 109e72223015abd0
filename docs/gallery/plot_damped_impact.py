"""
One damped impact and its theories
==================================

A sphere of coal falls on steel.
"""

import matplotlib.pyplot as plt

plt.plot([1, 2])
