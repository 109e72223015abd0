"""The highest accuracy possible in a scene: the Bayes limit, learners below it, and a survey of better rigs."""

from cgid.ceiling.bayes import Ceiling, ceiling, ceilings
from cgid.ceiling.learner import Bracket, Learner, bracket
from cgid.ceiling.survey import Point, Survey, survey

__all__ = ["Bracket", "Ceiling", "Learner", "Point", "Survey", "bracket", "ceiling", "ceilings", "survey"]
