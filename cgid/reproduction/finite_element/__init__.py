"""The paper's finite-element study, computed with cgid's own solver, and the three theories beside it."""

from cgid.reproduction.finite_element.study import Study
from cgid.reproduction.finite_element.study_file import STUDY_FILE, packed, read_study, shipped_study, unpacked

__all__ = ["STUDY_FILE", "Study", "packed", "read_study", "shipped_study", "unpacked"]
