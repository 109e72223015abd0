from cgid.identification.training.card import write_card as write_card
from cgid.identification.training.classifier import ImpactClassifier as ImpactClassifier
from cgid.identification.training.rows import Rows as Rows
from cgid.identification.training.rows import measure as measure
from cgid.identification.training.training import Training as Training
from cgid.identification.training.training import train_on_groups as train_on_groups
from cgid.identification.training.training import train_on_specimens as train_on_specimens
