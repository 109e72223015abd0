"""The natural modes of a beam, and its response to a force, as arrays."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
