"""From a signal to a material: find the impacts, measure them, answer; and train the models for it.

Prediction (`events`, `model`, `answers`) needs numpy only, training (`training`, `classifier`) scikit-learn.
"""
