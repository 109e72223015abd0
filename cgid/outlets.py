"""The former name of `cgid.plant`."""

from cgid.deprecated import renamed

__getattr__ = renamed(__name__, {"Outlets": "cgid.plant.PlantOutputs"})
