"""Observation families: distributions of counts, binary, heavy-tailed and censored data given a predictor.

`family` defines the protocol, `links` the maps from predictors to rates and
probabilities. Gaussian observations are not a family, see `lfm_ppl.model.observation`. Public families are
`lfm_ppl.NAME`.
"""
