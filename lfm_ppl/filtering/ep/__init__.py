"""Expectation propagation: Gaussian sites of observations and constraints that are not Gaussian."""
