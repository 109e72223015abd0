"""Where impacts are: onsets, events and their frames, and windows of a recording."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
