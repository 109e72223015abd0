from cgid.identification.detection.detector import ImpactDetector as ImpactDetector
from cgid.identification.detection.detector import find_impacts as find_impacts
from cgid.identification.detection.events import Event as Event
