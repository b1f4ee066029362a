"""Rules that turn a function and a Gaussian into an affine map.

`rule` says what a rule has to be, `sigma_points` has those with points, `taylor` the one without; `structure` says in
which inputs a function is not linear. Public rules are `lfm_ppl.NAME`.
"""
