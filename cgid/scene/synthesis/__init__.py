"""From a scene to signals: draws, the plan, impacts, noise, streams."""
