from cgid.identification.inversion.recovered import RecoveredForce as RecoveredForce
from cgid.identification.inversion.recovered import recover_force as recover_force
