"""Marginal likelihoods, samplers and modes: from a model with data to a posterior."""
