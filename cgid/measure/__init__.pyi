from cgid.measure import features as features
from cgid.measure import filters as filters
from cgid.measure import modal as modal
