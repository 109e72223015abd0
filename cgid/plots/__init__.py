"""All pictures. matplotlib (extra `plot`) is imported only here, and only on use."""

from cgid._lib.lazy import on_first_use

__all__, __getattr__, __dir__ = on_first_use(__name__)
