from cgid.impactor.measured import MeasuredPulses as MeasuredPulses
from cgid.impactor.population import population_of as population_of
from cgid.impactor.posterior import ImpactorEstimates as ImpactorEstimates
from cgid.impactor.posterior import ImpactorPopulation as ImpactorPopulation
