"""Recording an environment into a data set: episodes, workers, the whole run. No environment by name."""
