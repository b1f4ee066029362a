"""Observation families: how counts, yes or no, heavy-tailed and censored values come from a predictor; one a file."""
