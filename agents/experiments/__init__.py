"""Many trainings side by side: several seeds of several configurations, and searches for hyperparameters."""
