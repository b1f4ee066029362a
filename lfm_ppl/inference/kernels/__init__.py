"""Kernels of numpyro.infer.MCMC."""
