"""The damped-Hertz pulse: its table, and the fit to samples by maximum likelihood."""
