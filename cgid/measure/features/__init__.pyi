from cgid.measure.features.extraction import FEATURES as FEATURES
from cgid.measure.features.extraction import choose as choose
from cgid.measure.features.extraction import extract as extract
from cgid.measure.features.own import own_feature as own_feature
