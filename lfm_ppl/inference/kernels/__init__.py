"""Kernels of numpyro.infer.MCMC.

Each sampler is a `SamplingAlgorithm`, and the kernels are one adapter over it. `lfm_ppl.fit` does not run MCMC:
`lfm_ppl.inference.sampling` runs the same algorithms in programs that have the data as an argument.
"""
