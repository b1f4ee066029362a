"""Observation families: how counts, yes or no, heavy-tailed and censored values come from a predictor; one a file.

`family` says what a family has to be, `links` has the maps from predictors to rates and probabilities. Gaussian
observations are no family, but `lfm_ppl.model.observation`. Public families are `lfm_ppl.NAME`.
"""
