"""Linearisation rules: they approximate a function by an affine map, given a Gaussian distribution of its inputs.

`rule` defines the protocol, `sigma_points` contains the sigma-point rules, `taylor` the Taylor expansion; `structure`
describes the inputs in which a function is non-linear. Public rules are `lfm_ppl.NAME`.
"""
