"""The damped-Hertz pulse fitted to samples: template, start values, maximum likelihood. Numpy only."""

from cgid.measure.estimation.fit import PulseFit, Start, fit_pulses

__all__ = ["PulseFit", "Start", "fit_pulses"]
