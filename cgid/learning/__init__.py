"""For your own learners: a transformer, scenes as endless training data; and models finished on streams."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
