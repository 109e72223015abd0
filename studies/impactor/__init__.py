"""How heavy, large and fast was what struck: the posterior within the population of a scene."""
