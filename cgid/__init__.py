"""Identify coal and gangue by the impact of a falling rock on steel.

Public names and modules are loaded on first use: `import cgid` alone imports neither numpy nor numba, scikit-learn,
pandas or matplotlib.
"""

from cgid._lib.lazy import on_first_use

__version__ = "0.2.0"

__all__, __getattr__, __dir__ = on_first_use(__name__)
__all__ += ["__version__"]
