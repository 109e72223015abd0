"""From a signal to a material: find the impacts, measure them, answer.

Predicting needs `events`, `model` and `answers`, numpy only; training needs scikit-learn (`classifier`, `training`).
"""
