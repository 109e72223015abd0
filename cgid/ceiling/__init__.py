"""The highest accuracy possible in a scene: the Bayes limit, learners that bound or estimate it, a survey of rigs."""

from cgid.ceiling.bayes import Ceiling, ceiling, ceilings
from cgid.ceiling.beam import BeamErrors, Pulses
from cgid.ceiling.learner import Bracket, Learner, bracket
from cgid.ceiling.survey import Point, Survey, survey

__all__ = [
    "BeamErrors",
    "Bracket",
    "Ceiling",
    "Learner",
    "Point",
    "Pulses",
    "Survey",
    "bracket",
    "ceiling",
    "ceilings",
    "survey",
]
