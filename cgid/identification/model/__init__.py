"""The trained model: its classifier, prediction sets, guards, and file."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
