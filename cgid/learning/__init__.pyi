from cgid.learning.transformer import ImpactFeatures as ImpactFeatures
from cgid.learning.transformer import TrainingStream as TrainingStream
from cgid.learning.transformer import stream as stream
