"""Yang, Zeng & Wan (2018), reproduced: its figures and tables, and its claims judged by the numbers."""

from cgid.reproduction.output import n_steps, reproduce

__all__ = ["n_steps", "reproduce"]
