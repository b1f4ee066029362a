"""Kernels of numpyro.infer.MCMC.

`lfm_ppl.fit` does not run MCMC: it takes the settings of a kernel and moves chains by the transitions of
`lfm_ppl.inference.sampling`, in programs that have the data as an argument.
"""
