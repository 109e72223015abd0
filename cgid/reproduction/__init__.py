"""Yang, Zeng & Wan (2018), reproduced: its theoretical figures and tables, and its claims judged by the numbers."""

from cgid.reproduction.output import N_STEPS, reproduce

__all__ = ["N_STEPS", "reproduce"]
