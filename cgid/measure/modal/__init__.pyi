from cgid.measure.modal.modes import Modes as Modes
from cgid.measure.modal.modes import read_modes as read_modes
