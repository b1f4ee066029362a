"""Bound models, samplers and modes: from a model with data to a posterior.

`samplers` lists the samplers of `lfm_ppl.fit`, `sampling` says how their chains move, `kernels` has kernels of
`numpyro.infer.MCMC`, and `map` the mode.
"""
