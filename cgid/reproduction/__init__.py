"""The figures and tables of Yang, Zeng & Wan (2018), recomputed, and a verdict on each of its claims."""

from cgid.reproduction.output import n_steps, reproduce

__all__ = ["n_steps", "reproduce"]
