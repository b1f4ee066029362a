"""Expectation propagation: Gaussian factors of observations and constraints that are not Gaussian."""
