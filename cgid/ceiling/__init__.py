"""How well a scene can be told apart at all: Bayes' limit, a learner below it, and what a better rig would bring."""

from cgid.ceiling.bayes import Bracket, Ceiling, Learner, bracket, ceiling, ceilings
from cgid.ceiling.survey import Point, Survey, survey

__all__ = ["Bracket", "Ceiling", "Learner", "Point", "Survey", "bracket", "ceiling", "ceilings", "survey"]
