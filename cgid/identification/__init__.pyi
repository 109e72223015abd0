from cgid.identification import detection as detection
from cgid.identification import inversion as inversion
from cgid.identification import model as model
from cgid.identification import prediction as prediction
from cgid.identification import training as training
