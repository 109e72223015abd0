"""The paper's finite-element study, computed with cgid's own solver, and the three theories beside it."""

from cgid.reproduction.finite_element.study import STUDY_FILE, Study, packed, read_study, shipped_study

__all__ = ["STUDY_FILE", "Study", "packed", "read_study", "shipped_study"]
