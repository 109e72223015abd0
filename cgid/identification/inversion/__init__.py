"""Location and contact force of an impact, from the acceleration of a beam."""
